"""The output folder of `optnav hazard`: rasters, pads, pictures and the recording."""

import base64
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import cv2
import numpy as np
import rasterio
from affine import Affine

from catalog.arrays import ByteArray, Float32Array, FloatArray
from catalog.bodies.body import Body
from catalog.rasters import encode_geotiff
from catalog.store.geopackage import (
    GREEN,
    RED,
    UNDATED,
    Feature,
    FeatureLayer,
    Rule,
    define_srs,
    describe_geopackage,
    encode_point,
    format_stereographic_wkt,
    format_style,
    open_new_geopackage,
)
from catalog.terrain.slopes import convert_to_degrees
from optnav_cli.camera.camera import Camera
from optnav_cli.frames.frames import Frame
from optnav_cli.frames.picture import Picture
from optnav_cli.frames.tables import CARRIED_PADS, PADS, ROCKS
from optnav_cli.hazard.hazard_map import HazardMap
from optnav_cli.hazard.pads import REFUSED, CarriedPad, Pad
from optnav_cli.hazard.rocks import ROCKS_FILE, find_cell
from optnav_cli.hazard.settings import CARRIED_FILE, LAYER_FILE, PADS_FILE, HazardSettings
from optnav_cli.output import foxglove
from optnav_cli.output.canvas import Canvas, encode_picture, scale_to_eight_bits, shade_picture
from optnav_cli.output.recording import MessageLog, encode_recorded_image, format_topic

PADS_LAYER = FeatureLayer(
    "landing_pads",
    "POINT",
    "Pads carried along a descent, with 1 sigma of their places",
    (
        *("first_file TEXT NOT NULL", "file TEXT NOT NULL", "n_seen INTEGER", "height_m DOUBLE"),
        *("sigma_east_m DOUBLE", "sigma_north_m DOUBLE", "correlation DOUBLE", "moved_m DOUBLE"),
        *("expected_dangerous_share DOUBLE", "expected_critical_share DOUBLE"),
        *("shadow_share DOUBLE", "mean_slope_deg DOUBLE", "prior_slope_deg DOUBLE"),
        *("n_rocks INTEGER", "rock_share DOUBLE", "status TEXT NOT NULL", "reason TEXT NOT NULL"),
    ),
    format_style(
        Rule("carried", "\"status\" = 'carried'", "circle", GREEN, 2.4),
        Rule("given up", "ELSE", "cross2", RED, 2.0),
    ),
)

ROCKS_LAYER = FeatureLayer(
    "rocks",
    "POINT",
    "Rocks with their heights by shadows",
    (
        *("file TEXT NOT NULL", "diameter_m DOUBLE", "height_m DOUBLE"),
        *("height_sigma_m DOUBLE", "chance DOUBLE"),
    ),
    format_style(Rule("rock", "ELSE", "circle", RED, 1.6)),
)


@dataclass(frozen=True)
class MapSummary:
    """Counts of a map, kept when its pixels are dropped."""

    squares: int
    found: int
    rocks: int
    first_reason: str


@dataclass
class MappedFrame:
    """A picture and its map, or the reason why it has none.

    row  of frames.csv; None for a single picture
    """

    file: str
    camera: Camera | None
    picture: Picture | None
    row: Frame | None = None
    mapped: HazardMap | None = None
    reason: str = ""
    kept: MapSummary | None = field(default=None, repr=False)

    @property
    def summary(self) -> MapSummary | None:
        """Counts of squares and pads; None where there is no map."""
        if self.mapped is None:
            return self.kept
        mapped = self.mapped
        reason = next((pad.reason for pad in mapped.pads if pad.cell is None), "")
        return MapSummary(len(mapped.pads), mapped.found, len(mapped.survey.rocks), reason)

    def drop_pixels(self) -> "MappedFrame":
        """Return a copy without pixels, for a list of many frames."""
        return replace(self, picture=None, mapped=None, kept=self.summary)


class HazardOutput:
    """Writes a hazard folder frame by frame.

    body  None where the picture has no place on one
    many  the files of each frame go into a folder of its own
    """

    def __init__(
        self, folder: Path, body: Body | None, settings: HazardSettings, *, many: bool
    ) -> None:
        self._folder, self._body, self._settings, self._many = folder, body, settings, many
        self._rows: list[dict[str, object]] = []
        self._rocks: list[dict[str, object]] = []
        self._log = MessageLog(folder / "hazard.mcap", {"made_by": "optnav hazard"})

    def __enter__(self) -> Self:
        self._log.__enter__()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._log.__exit__(kind, error, trace)
        if kind is not None:
            return
        PADS.write(self._folder / PADS_FILE, self._rows)
        ROCKS.write(self._folder / ROCKS_FILE, self._rocks)
        placed = [row for row in self._rocks if "lat_deg" in row]
        if self._body is not None and placed:
            path = (self._folder / ROCKS_FILE).with_suffix(".gpkg")
            write_layer(path, ROCKS_LAYER, placed, self._body)

    def add(self, frame: MappedFrame) -> None:
        """Write one frame's map or reason."""
        if frame.mapped is None:
            for rows in (self._rows, self._rocks):
                rows.append({"file": frame.file, "reason": frame.reason})
            self._record(frame)
        else:
            folder = self._folder / _make_folder_name(frame.file) if self._many else self._folder
            folder.mkdir(exist_ok=True)
            self._write_rasters(folder, frame.mapped)
            risk = encode_picture(draw_risk(frame.mapped), ".png")
            (folder / "risk.png").write_bytes(risk)
            (folder / "hazard.png").write_bytes(encode_picture(draw_overview(frame.mapped), ".png"))
            self._rows += [_make_row(frame, pad) for pad in frame.mapped.pads]
            self._rocks += _make_rock_rows(frame.file, frame.mapped)
            self._record(frame, risk)

    def add_carried(self, pads: Sequence[CarriedPad]) -> None:
        """Write the pads that were carried from frame to frame, as a table and for GIS programs."""
        rows = [_make_carried_row(pad, self._body) for pad in pads]
        CARRIED_PADS.write(self._folder / CARRIED_FILE, rows)
        if self._body is not None:
            write_layer(self._folder / LAYER_FILE, PADS_LAYER, rows, self._body)

    def _write_rasters(self, folder: Path, mapped: HazardMap) -> None:
        risk, view = mapped.risk, mapped.view
        a, b, c, d, e, f = view.affine
        corner = risk.origin + 0.5 - 0.5 * risk.step  # of the first pad's pixel, in cells
        grid = Affine(a, b, c + corner * a, d, e, f + corner * e) @ Affine.scale(risk.step)
        crs = _make_crs(self._body, mapped)
        code = {"crs": crs, "transform": grid, "nodata": None}
        words = "seed's code" if mapped.slopes is None else "254 x expected dangerous share"
        tags = {"CODE": f"{words}; {REFUSED} refused", "METHOD": self._settings.method}
        bands = {"risk of a pad about the pixel": risk.code}
        (folder / "risk.tif").write_bytes(encode_geotiff(bands, code, tags))
        if mapped.slopes is None:
            return
        slopes = mapped.slopes
        degrees = convert_to_degrees(np.stack([slopes.toward, slopes.across]))
        hidden = ~view.valid
        per_tangent = np.degrees(1.0 / (1.0 + np.tan(np.radians(degrees)) ** 2))
        real = {
            "slope, deg": degrees,
            "its 1 sigma, deg": (slopes.sigma * per_tangent).astype(np.float32),
            "share of shadow": slopes.shadow,
        }
        real = {name: np.where(hidden, np.float32(np.nan), grid) for name, grid in real.items()}
        profile = {"crs": crs, "transform": Affine(*view.affine), "nodata": np.nan}
        (folder / "slopes.tif").write_bytes(encode_geotiff(real, profile, {"BASE_M": "3"}))

    def _record(self, frame: MappedFrame, risk: bytes = b"") -> None:
        log, camera = self._log, frame.camera
        # A single picture has no time.
        log.set_time(frame.row.utc if frame.row else "1970-01-01T00:00:00Z")
        name = camera.name if camera else "camera"
        message = frame.reason
        if frame.mapped is not None and camera is not None and frame.picture is not None:
            image = encode_recorded_image(scale_to_eight_bits(frame.picture.values), camera)
            _add_image(log, format_topic(name, "image"), name, image, "jpeg")
            _add_image(log, format_topic(name, "risk"), name, risk, "png")
            n_pads, squares = frame.mapped.found, len(frame.mapped.pads)
            message = f"{frame.file}: pads in {n_pads} of {squares} squares"
            factor = min(1.0, 2048 / max(camera.shape))
            log.add(
                format_topic(name, "pads"),
                foxglove.IMAGE_ANNOTATIONS,
                _draw_circles(frame.mapped, factor),
            )
        content = {"level": foxglove.INFO, "message": message, "name": "optnav"}
        log.add("/log", foxglove.LOG, {**content, "file": frame.file, "line": 0})


def _make_folder_name(file: str) -> str:
    """Name the folder of a frame: its file without an ending, on one level."""
    return Path(file.replace("\\", "/")).with_suffix("").as_posix().replace("/", "_")


def _make_row(frame: MappedFrame, pad: Pad) -> dict[str, object]:
    """Make a row of pads.csv."""
    row, col = pad.square
    cells: dict[str, object] = {"file": frame.file, "square_row": row, "square_col": col}
    cells["reason"] = pad.reason
    if pad.cell is None or frame.mapped is None or frame.camera is None:
        return cells
    view = frame.mapped.view
    x, y = view.find_pixel(*pad.cell)
    cells |= {"x_px": x, "y_px": y}
    cells |= {name: value for name, value in pad.shares.items() if math.isfinite(value)}
    direction = frame.camera.unproject([x, y])
    cells |= _split_vector("dir_camera", direction)
    if view.projection is not None and frame.row is not None:
        lat, lon = view.projection.latlon(*view.xy_m(*pad.cell))
        cells |= {"lat_deg": math.degrees(float(lat)), "lon_deg": math.degrees(float(lon))}
        if frame.row.camera_from_body is not None:
            cells |= _split_vector("dir_body", frame.row.camera_from_body.inv().apply(direction))
    return cells


def _make_carried_row(pad: CarriedPad, body: Body | None) -> dict[str, object]:
    """Make a row of carried_pads.csv."""
    lat, lon, height_m = pad.centre
    east, north = (math.sqrt(pad.covariance[i, i]) for i in range(2))
    return {
        "id": pad.number,
        "first_file": pad.first_file,
        "file": pad.file,
        "n_seen": pad.n_seen,
        "lat_deg": math.degrees(lat),
        "lon_deg": math.degrees(lon),
        "height_m": height_m,
        "sigma_east_m": east,
        "sigma_north_m": north,
        "correlation": float(pad.covariance[0, 1]) / (east * north),
        "moved_m": pad.measure_move_m(body.radius_m if body else 0.0),
        **dict(zip(("x_px", "y_px"), pad.pixel)),
        **{name: value for name, value in pad.shares.items() if math.isfinite(value)},
        "status": "given_up" if pad.reason else "carried",
        "reason": pad.reason,
    }


def _make_rock_rows(file: str, mapped: HazardMap) -> Iterator[dict[str, object]]:
    """Make the rows of rocks.csv of a frame; one with the reason where none were looked for."""
    if mapped.survey.reason:
        yield {"file": file, "reason": mapped.survey.reason}
    for rock in mapped.survey.rocks:
        x, y = mapped.view.find_pixel(*find_cell(rock, mapped.view))
        cells = {"file": file, "x_px": x, "y_px": y, **asdict(rock)}
        if mapped.view.projection is not None:
            lat, lon = mapped.view.projection.latlon(np.array(rock.x_m), np.array(rock.y_m))
            cells |= {"lat_deg": math.degrees(float(lat)), "lon_deg": math.degrees(float(lon))}
        yield cells


def write_layer(
    path: Path, layer: FeatureLayer, rows: Sequence[Mapping[str, object]], body: Body
) -> None:
    """Write rows of a table as a layer of points, with its columns, to a new GeoPackage."""
    system = define_srs(body.name, body.radius_m)
    features: list[Feature] = []
    for number, row in enumerate(rows, 1):
        lon, lat = float(str(row["lon_deg"])), float(str(row["lat_deg"]))
        geometry = encode_point(lon, lat, system[0])
        cells = (row.get("id", number), geometry, *(row.get(name) for name in layer.names[2:]))
        features.append((cells, (lon, lat, lon, lat)))
    with open_new_geopackage(path) as db:
        describe_geopackage(db, body.name, body.radius_m, UNDATED)
        layer.create(db)
        layer.register(db, system[0], layer.fill(db, features), UNDATED)


def _split_vector(name: str, vector: FloatArray) -> dict[str, float]:
    return {f"{name}_{axis}": float(value) for axis, value in zip("xyz", vector, strict=True)}


def _make_crs(body: Body | None, mapped: HazardMap) -> Any:
    projection = mapped.view.projection
    if body is None or projection is None:
        return None
    centre_deg = math.degrees(projection.lat), math.degrees(projection.lon)
    wkt = format_stereographic_wkt(body.name, "the view", projection.radius_m, centre_deg)
    return rasterio.CRS.from_wkt(wkt)


def _add_image(log: MessageLog, topic: str, frame_id: str, image: bytes, kind: str) -> None:
    data = base64.b64encode(image).decode("ascii")
    log.add(topic, foxglove.COMPRESSED_IMAGE, {"data": data, "format": kind, "frame_id": frame_id})


def _draw_circles(mapped: HazardMap, factor: float) -> dict[str, Any]:
    """Draw the pads as circles in the recorded picture."""
    none = {"r": 0.0, "g": 0.0, "b": 0.0, "a": 0.0}
    view, circles = mapped.view, []
    for pad in mapped.pads:
        if pad.cell is None:
            continue
        row, col = pad.cell
        x, y = view.find_pixel(row, col)
        aside = view.find_pixel(row, col + 0.5 * mapped.risk.cells)
        # A mark in the recording has a diameter of at least 24 px.
        wide = max(2.0 * math.dist((x, y), aside) * factor, 24.0 * factor)
        circles.append(
            {
                "timestamp": {"sec": 0, "nsec": 0},
                "position": {"x": (x + 0.5) * factor, "y": (y + 0.5) * factor},
                "diameter": wide,
                "thickness": 2.0,
                "fill_color": none,
                "outline_color": {"r": 0.2, "g": 1.0, "b": 0.3, "a": 1.0},
                "metadata": [
                    {"key": key, "value": f"{value:.4g}"} for key, value in pad.shares.items()
                ],
            }
        )
    return {"circles": circles, "points": [], "texts": []}


GAP_PX, TITLE_PX = 8, 22
MAX_SLOPE_DEG = 20.0  # the brightest of the colours
TEXT_COLOUR, ROCK_COLOUR = (235, 235, 235), (40, 140, 255)
REFUSED_COLOUR, OUTSIDE_COLOUR = (60, 40, 50), (24, 24, 24)
# A safe pad is green, a dangerous one red: stops of a scale, BGR, and readable in gray as well
SCALE = np.array([[80, 170, 60], [90, 210, 190], [70, 190, 245], [50, 100, 235], [60, 20, 140]])


def map_colours(values: Float32Array, highest: float) -> ByteArray:
    """Map numbers from 0 to `highest` to colours (rows, cols, 3), BGR."""
    at = np.clip(np.nan_to_num(values) / highest, 0.0, 1.0) * (len(SCALE) - 1)
    near = np.minimum(at.astype(np.int64), len(SCALE) - 2)
    share = (at - near)[..., None]
    mixed: ByteArray = np.rint(SCALE[near] * (1.0 - share) + SCALE[near + 1] * share).astype(
        np.uint8
    )
    return mixed


def draw_risk(mapped: HazardMap) -> ByteArray:
    """Draw the risk map in colours, refused pads dark, with the chosen pads."""
    factor = min(1.0, 1024 / max(mapped.view.brightness.shape))
    return _mark_pads(mapped, _scale(_draw_risk_cells(mapped), factor), factor)


def _draw_risk_cells(mapped: HazardMap) -> ByteArray:
    """Draw the risk at each cell of a view."""
    colours = map_colours(mapped.risk.code.astype(np.float32), 0.6 * REFUSED)
    colours[mapped.risk.code == REFUSED] = REFUSED_COLOUR
    full = _expand_to_cells(mapped, colours)
    full[~mapped.view.valid] = OUTSIDE_COLOUR
    return full


def draw_overview(mapped: HazardMap) -> ByteArray:
    """Draw picture, risk, pads and slopes side by side with captions."""
    view = mapped.view
    factor = 330 / max(view.brightness.shape)
    gray = shade_picture(
        scale_to_eight_bits(np.where(view.valid, view.brightness, np.float32(0.0)))
    )
    title = "pads; orange: rocks" if mapped.survey.rocks else "pads"
    panels = [
        ("picture on the ground", _scale(gray, factor)),
        ("risk: green 0, red 0.6; dark refused", _scale(_draw_risk_cells(mapped), factor)),
        (title, _mark_pads(mapped, _scale(gray, factor), factor)),
    ]
    if mapped.slopes is not None:
        degrees = convert_to_degrees(np.stack([mapped.slopes.toward, mapped.slopes.across]))
        colours = map_colours(degrees, MAX_SLOPE_DEG)
        colours[~view.valid] = OUTSIDE_COLOUR
        title = f"slopes on 3 m: green 0, red {MAX_SLOPE_DEG:g} deg"
        panels.append((title, _mark_pads(mapped, _scale(colours, factor), factor)))
    height = TITLE_PX + max(len(panel) for _, panel in panels)
    width = sum(panel.shape[1] for _, panel in panels) + GAP_PX * (len(panels) - 1)
    canvas = Canvas(np.full((height, width, 3), 16, np.uint8), 1.0)
    left = 0
    for title, panel in panels:
        canvas.image[TITLE_PX : TITLE_PX + len(panel), left : left + panel.shape[1]] = panel
        canvas.text(title, left + 4, TITLE_PX - 7, TEXT_COLOUR)
        left += panel.shape[1] + GAP_PX
    return canvas.image


def _expand_to_cells(mapped: HazardMap, colours: ByteArray) -> ByteArray:
    """Expand colours of pads to the cells about each pad's middle; the border is refused."""
    risk, (rows, cols) = mapped.risk, mapped.view.brightness.shape
    places = [
        np.rint((np.arange(size) - risk.origin) / risk.step).astype(np.int64)
        for size in (rows, cols)
    ]
    full = np.empty((rows, cols, 3), np.uint8)
    full[:] = REFUSED_COLOUR
    inside = [(at >= 0) & (at < size) for at, size in zip(places, risk.code.shape, strict=True)]
    chosen = [at[good] for at, good in zip(places, inside, strict=True)]
    full[np.ix_(*inside)] = colours[np.ix_(*chosen)]
    return full


def _scale(picture: ByteArray, factor: float) -> ByteArray:
    """Scale a picture: averaged when smaller, nearest pixels when larger."""
    if factor == 1.0:
        return picture.copy()
    high, wide = (max(1, round(size * factor)) for size in picture.shape[:2])
    how = cv2.INTER_AREA if factor < 1.0 else cv2.INTER_NEAREST
    return cv2.resize(picture, (wide, high), interpolation=how).astype(np.uint8, copy=False)


def _mark_pads(mapped: HazardMap, picture: ByteArray, factor: float) -> ByteArray:
    """Draw rocks and a box at each chosen pad onto the picture; factor: pixels per cell."""
    for rock in mapped.survey.rocks:
        down, right = (round((at + 0.5) * factor) for at in find_cell(rock, mapped.view))
        wide = max(round(0.5 * rock.diameter_m / mapped.view.cell_m * factor), 2)
        cv2.circle(picture, (right, down), wide, ROCK_COLOUR, 1)
    half = 0.5 * mapped.risk.cells
    for pad in mapped.pads:
        if pad.cell is None:
            continue
        row, col = ((middle + 0.5) * factor for middle in pad.cell)
        reach = max(half * factor, 3.0)
        low = math.floor(col - reach), math.floor(row - reach)
        high = math.ceil(col + reach), math.ceil(row + reach)
        cv2.rectangle(picture, low, high, (0, 0, 0), 3)
        cv2.rectangle(picture, low, high, (255, 255, 255), 1)
    return picture
