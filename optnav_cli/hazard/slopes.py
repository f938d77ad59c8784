"""How steep a terrain model is, its slopes, and the flattest pads on it: `optnav slopes`."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import rasterio
from affine import Affine

from catalog.arrays import ByteArray, Float32Array
from catalog.bodies.body import load_body
from catalog.errors import DataError
from catalog.files import check_file, make_prefix_test, replace_file
from catalog.geometry.latlon import wrap_longitude_deg
from catalog.places import check_apart
from catalog.rasters import DESCRIPTION, encode_geotiff, is_described
from catalog.tables import CsvTable
from catalog.terrain.dem.georeference import Georeference
from catalog.terrain.dem.source import DemSource
from catalog.terrain.slopes import (
    CRITICAL_DEG,
    DANGEROUS_DEG,
    SlopeSummary,
    measure_pixels,
    summarise_slopes,
)
from optnav_cli.frames.tables import REASON, count, number
from optnav_cli.hazard.ground_view import MIN_PAD_CELLS
from optnav_cli.hazard.output import MAX_SLOPE_DEG, OUTSIDE_COLOUR, TEXT_COLOUR, map_colours
from optnav_cli.hazard.pads import count_odd_cells
from optnav_cli.hazard.settings import load_hazard_model
from optnav_cli.output.canvas import Canvas, encode_picture
from optnav_cli.output.wording import align_table

MADE = "Slopes by optnav"
PNG = b"\x89PNG\r\n\x1a\n"
GRAPH_PX, MARGIN_PX = 240, 24  # the histogram's width and the room for its words
STEPS = 40  # of the histogram
SITE_PADS = CsvTable(
    (
        count("square_row", "row of the square from the upper left", empty=False),
        count("square_col", "column of the square", empty=False),
        number("lat_deg", "planetocentric latitude", "deg", "z.9f"),
        number("lon_deg", "longitude, -180 to 180, east positive", "deg", "z.9f"),
        number("dangerous_share", "share above 7 deg", "", "z.5f"),
        number("critical_share", "share above 15 deg", "", "z.5f"),
        number("mean_slope_deg", "mean slope", "deg", "z.3f"),
        REASON,
    )
)


IS_PADS = make_prefix_test(",".join(SITE_PADS.names).encode())


@dataclass(frozen=True)
class PadSearch:
    """Where the flattest pads of a terrain model are written, their side and that of squares."""

    path: Path
    pad_m: float
    square_m: float


@dataclass(frozen=True)
class MeasuredSlopes:
    """Slope statistics of a terrain model; squares and those with a pad where pads were sought."""

    dem: Path
    summary: SlopeSummary
    n_squares: int | None = None
    n_pads: int | None = None

    def figures(self) -> dict[str, object]:
        """Return the figures for programs."""
        summary = self.summary
        return {
            "dem": self.dem,
            "base_m": summary.base_m,
            "share_above_7_deg": summary.share_above(DANGEROUS_DEG),
            "share_above_15_deg": summary.share_above(CRITICAL_DEG),
            "rms_deg": summary.rms_deg,
            "median_deg": summary.quantile_deg(0.5),
            "p95_deg": summary.quantile_deg(0.95),
            "covered": summary.covered,
            **({} if self.n_pads is None else {"squares": self.n_squares, "pads": self.n_pads}),
        }

    def to_text(self) -> str:
        """Format as a table for people."""
        s = self.summary
        rows = [
            ("slopes on a base of", f"{s.base_m:.6g} m"),
            (f"above {DANGEROUS_DEG:g} deg", f"{s.share_above(DANGEROUS_DEG):.1%}"),
            (f"above {CRITICAL_DEG:g} deg", f"{s.share_above(CRITICAL_DEG):.1%}"),
            ("rms", f"{s.rms_deg:.2f} deg"),
            ("median, 95 %", f"{s.quantile_deg(0.5):.2f}, {s.quantile_deg(0.95):.2f} deg"),
            ("share with a slope", f"{s.covered:.1%}"),
        ]
        if self.n_pads is not None:
            rows.append(("squares with a pad", f"{self.n_pads} of {self.n_squares}"))
        return "\n".join(align_table(rows, left=(0, 1)))


def measure_slopes(
    dem: Path,
    base_m: float,
    body: str,
    output: Path | None = None,
    nodata: float | None = None,
    search: PadSearch | None = None,
) -> MeasuredSlopes:
    """Measure the slopes of a terrain model, and write them to a .tif or .png where one is named.

    nodata  the stored value of pixels without data; None: as the file says
    search  for the flattest pad of each square; None: no pads
    Raises DataError for a model that cannot be used, OutputError for the place.
    """
    if output is not None:
        check_file(output, make_prefix_test(PNG) if output.suffix.lower() == ".png" else _is_ours)
        check_apart(output, [dem])
    if search is not None:
        check_file(search.path, IS_PADS)
        check_apart(search.path, [dem])
    source = DemSource.open_alone(dem, load_body(body), nodata)
    try:
        summary, degrees = summarise_slopes(source, base_m)
        georeference = source.georeference
        rows = [] if search is None else list(find_flattest_pads(source, degrees, search))
    finally:
        source.close()
    if output is not None and output.suffix.lower() == ".png":
        with replace_file(output, make_prefix_test(PNG)) as path:
            path.write_bytes(encode_picture(_draw(degrees, summary), ".png"))
    elif output is not None:
        _write(output, degrees, georeference)
    if search is None:
        return MeasuredSlopes(dem, summary)
    with replace_file(search.path, IS_PADS) as path:
        SITE_PADS.write(path, rows)
    return MeasuredSlopes(dem, summary, len(rows), sum(not row["reason"] for row in rows))


def find_flattest_pads(
    source: DemSource, degrees: Float32Array, search: PadSearch
) -> Iterator[dict[str, object]]:
    """Find the flattest pad of each square of a terrain model: rows of SITE_PADS.

    degrees (rows, cols) slopes, NaN for none. A pad is rated as one in a picture: by its shares
    above 7 and 15 deg and its mean slope. Squares lie along the model's rows and columns; what is
    left at the lower and right border is no square. Memory goes with a band of squares.
    Raises DataError for pads under three pixels, or squares too small for pads or the model.
    """
    rows, cols = source.shape
    flatness = np.float32(np.radians(load_hazard_model().flatness))
    sizes = [float(size[0, cols // 2]) for size in measure_pixels(source, np.array([rows // 2]))]
    _check_sizes(source, search, sizes)
    high = round(search.square_m / sizes[1])
    for band_row, top in enumerate(range(0, rows - high + 1, high)):
        row = np.array([top + high // 2])
        across, down = (float(size[0, cols // 2]) for size in measure_pixels(source, row))
        pad = tuple(count_odd_cells(search.pad_m, size) for size in (down, across))
        wide = round(search.square_m / across)
        band = degrees[top : top + high]
        known = np.isfinite(band)
        slopes = np.where(known, band, np.float32(90.0))
        layers = [
            cv2.boxFilter(layer.astype(np.float32), -1, pad[::-1], borderType=cv2.BORDER_REPLICATE)
            for layer in (slopes > DANGEROUS_DEG, slopes > CRITICAL_DEG, slopes, ~known)
        ]
        score = layers[0] + layers[1] + flatness * layers[2]
        score[layers[3] > 1e-6] = np.inf
        for band_col, left in enumerate(range(0, cols - wide + 1, wide)):
            reach = pad[0] // 2, pad[1] // 2
            inside = (
                slice(reach[0], high - reach[0]),
                slice(left + reach[1], left + wide - reach[1]),
            )
            best = np.unravel_index(int(np.argmin(score[inside])), score[inside].shape)
            at = inside[0].start + int(best[0]), inside[1].start + int(best[1])
            square: dict[str, object] = {"square_row": band_row, "square_col": band_col}
            if not np.isfinite(score[at]):
                yield {**square, "reason": "no pad without holes"}
                continue
            lat, lon = source.georeference.latlon_from_pixel(float(at[1]), float(top + at[0]))
            shares = (float(layer[at]) for layer in layers[:3])
            yield {
                **square,
                "lat_deg": float(np.degrees(lat)),
                "lon_deg": float(wrap_longitude_deg(np.degrees(lon))),
                **dict(zip(("dangerous_share", "critical_share", "mean_slope_deg"), shares)),
                "reason": "",
            }


def _check_sizes(source: DemSource, search: PadSearch, pixel_m: list[float]) -> None:
    """Check the sides of pads and squares by the size of a pixel, across and down."""
    if search.pad_m < MIN_PAD_CELLS * max(pixel_m) * (1.0 - 1e-6):
        raise DataError(
            f"{source.path}: has pixels of {max(pixel_m):.4g} m; a pad of {search.pad_m:g} m is "
            f"under {MIN_PAD_CELLS} of them: name a wider --pad-m, or a finer model"
        )
    if search.square_m < search.pad_m + 2.0 * max(pixel_m):
        raise DataError(
            f"--square-m is {search.square_m:g}; wanted more than a pad of {search.pad_m:g} m and "
            "a pixel to each side"
        )
    wide_m = [size * pixels for size, pixels in zip(pixel_m, source.shape[::-1], strict=True)]
    if search.square_m > min(wide_m):
        raise DataError(
            f"{source.path}: is {min(wide_m):.4g} m wide; a square of {search.square_m:g} m does "
            "not fit in: name a smaller --square-m"
        )


def _write(path: Path, degrees: Float32Array, place: Georeference) -> None:
    """Write slopes as a GeoTIFF on the coordinate system of their model; NaN for none."""
    profile = {"crs": rasterio.CRS.from_wkt(place.wkt), "transform": Affine(*place.affine)}
    bands, tags = {"slope, deg": degrees}, {DESCRIPTION: MADE}
    with replace_file(path, _is_ours) as partial:
        partial.write_bytes(encode_geotiff(bands, {**profile, "nodata": np.nan}, tags))


def _is_ours(path: Path) -> bool:
    return is_described(path, MADE)


def _draw(degrees: Float32Array, summary: SlopeSummary) -> ByteArray:
    """Draw the map in colours and beside it the histogram in the same colours."""
    factor = min(1.0, 900 / max(degrees.shape))
    size = tuple(max(1, round(side * factor)) for side in degrees.shape[::-1])
    hole = ~np.isfinite(degrees)
    colours = map_colours(degrees, MAX_SLOPE_DEG)
    colours[hole] = OUTSIDE_COLOUR
    panel = cv2.resize(colours, size, interpolation=cv2.INTER_AREA)
    height = max(len(panel), GRAPH_PX)
    width = panel.shape[1] + GRAPH_PX + 2 * MARGIN_PX
    canvas = Canvas(np.full((height, width, 3), 16, np.uint8), 1.0)
    canvas.image[: len(panel), : panel.shape[1]] = panel
    shares = [
        summary.share_above(a) - summary.share_above(a + MAX_SLOPE_DEG / STEPS)
        for a in np.arange(STEPS) * MAX_SLOPE_DEG / STEPS
    ]
    left, bottom = panel.shape[1] + MARGIN_PX, GRAPH_PX - 2 * MARGIN_PX
    wide = GRAPH_PX // STEPS
    # all may lie beyond the graph
    scale = (bottom - MARGIN_PX) / max(*shares, 1e-9)
    tints = map_colours(np.arange(STEPS, dtype=np.float32)[None] + 0.5, STEPS)[0]
    for step, share in enumerate(shares):
        x = left + step * wide
        tint = [int(part) for part in tints[step]]
        cv2.rectangle(
            canvas.image, (x, bottom - round(share * scale)), (x + wide - 2, bottom), tint, -1
        )
    for degrees_at in (0.0, DANGEROUS_DEG, CRITICAL_DEG):
        x = left + degrees_at / MAX_SLOPE_DEG * STEPS * wide
        canvas.text(f"{degrees_at:g}", x - 3, bottom + 16, TEXT_COLOUR)
    words = f"deg; {summary.share_above(DANGEROUS_DEG):.1%} > 7, rms {summary.rms_deg:.1f}"
    canvas.text(words, left, bottom + 34, TEXT_COLOUR)
    return canvas.image
