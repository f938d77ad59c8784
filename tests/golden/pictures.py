"""The README's pictures, made anew from the bundled terrain and the real frame."""

from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from catalog.arrays import ByteArray, FloatArray
from catalog.bodies.body import load_body
from catalog.geometry.latlon import wrap_longitude_deg
from catalog.geometry.projection import Stereographic
from catalog.inspect.draw import draw_pyramid
from catalog.pipeline.config import load_build_config
from catalog.rendering.map_view import render_map
from catalog.store.reader import Catalog
from catalog.terrain.dem.mosaic import Mosaic
from optnav_cli.camera.camera_file import preset_camera
from optnav_cli.frames.folder import read_folder
from optnav_cli.frames.picture import load_picture
from optnav_cli.frames.truth import read_truth
from optnav_cli.hazard.ground_view import look_down
from optnav_cli.hazard.hazard_map import map_hazard
from optnav_cli.hazard.output import draw_overview
from optnav_cli.hazard.settings import HazardSettings
from optnav_cli.output.canvas import scale_to_eight_bits
from optnav_cli.output.overlay import draw_overlay, project_patches
from optnav_cli.output.run_folder import RunFolder, read_run
from optnav_cli.report.body_sides import draw_sides_picture
from tests.golden import sketch
from tests.studies import hazard as study
from tests.studies.hazard_fields import make_field, perspective_picture

# From good to bad, as in the reports (viridis), blue green red.
CLASSES = ((5, 181, 227), (81, 209, 122), (132, 168, 34), (142, 120, 42))
FOUND, OUTLINE, REFUSED = (90, 240, 110), (210, 170, 80), (150, 150, 150)
MAP_SUN = (-0.72, 0.62, 0.40)  # east, north, up: from the north-west, 23 degrees high
MAP_PX, MAP_NODES = 860, 1032
FRAME_PX, WIDE_PX, HALF_PX = 800, 1000, 500


Drawn = tuple[ByteArray, str]  # a picture and its caption


def catalog_map(catalog_path: Path, config: Path, work: Path) -> Drawn:
    """The ground of a catalog under one Sun, its cells, its points by expected match error."""
    settings = load_build_config(config)
    body = load_body(settings.body.name)
    ground = Mosaic.from_files(settings.dem, config.parent, body, work / "overviews")
    with Catalog.open(catalog_path) as catalog:
        west, east, south, north = _extent(catalog)
        middle = np.radians([(south + north) / 2.0, (west + east) / 2.0])
        projection = Stereographic(*middle, body.radius_m)
        across = np.radians(max(north - south, (east - west) * np.cos(middle[0]))) * body.radius_m
        posting = across / (MAP_NODES - 1)
        heights = ground.local_grid(projection, posting, MAP_NODES)
        shade = render_map(heights, posting, MAP_SUN, radius_m=body.radius_m)
        shade = shade[np.isfinite(shade).any(axis=1)]
        image = sketch.gray_picture(shade, MAP_PX, gamma=1.1)

        def place(lat_deg: FloatArray, lon_deg: FloatArray) -> FloatArray:
            x, y = projection.xy_from_latlon(np.radians(lat_deg), np.radians(lon_deg))
            at = np.stack([np.asarray(x), -np.asarray(y)], axis=-1) / posting * MAP_PX / MAP_NODES
            return at + (MAP_PX / 2.0, image.shape[0] / 2.0)

        for cell in catalog.ids:
            bounds = catalog.grid.bounds_deg(int(cell))
            sketch.line(image, place(*_border(bounds)), (130, 110, 70))
        errors = catalog.records["localisation_nodes"][catalog.usable]
        limits = np.quantile(errors, (0.25, 0.5, 0.75))
        places = place(catalog.lat_deg, catalog.lon_deg)
        for at in places[~catalog.usable]:
            sketch.cross(image, at, 4.0, REFUSED)
        for at, error in zip(places[catalog.usable], errors, strict=True):
            sketch.dot(image, at, 5.0, CLASSES[int(np.searchsorted(limits, error))])
        legend = _map_legend(catalog, limits)
        caption = (
            f"The bundled terrain of Tycho in cells of {catalog.meta.cell_deg:g}°: "
            f"{int(catalog.usable.sum())} of {len(catalog)} control points are usable, coloured by "
            f"predicted match error; a node is {catalog.meta.posting_m:.0f} m."
        )
    ground.close()
    return np.vstack([image, legend]), caption


def _extent(catalog: Catalog) -> tuple[float, float, float, float]:
    bounds = np.array([catalog.grid.bounds_deg(int(cell)) for cell in catalog.ids])
    west, south, east, north = bounds[:, 0].min(), bounds[:, 1].min(), bounds[:, 2], bounds[:, 3]
    return float(west), float(east.max()), float(south), float(north.max())


def _border(bounds: tuple[float, float, float, float]) -> tuple[FloatArray, FloatArray]:
    west, south, east, north = bounds
    along = np.linspace(0.0, 1.0, 9)
    lon = np.concatenate([west + (east - west) * along, np.full(9, east)])
    lat = np.concatenate([np.full(9, north), north + (south - north) * along])
    return lat, np.asarray(wrap_longitude_deg(lon))


def _map_legend(catalog: Catalog, limits: NDArray[np.floating]) -> ByteArray:
    legend = sketch.strip(MAP_PX, 34)
    x = 14
    edges = [f"< {limits[0]:.2f}", *(f"{a:.2f}-{b:.2f}" for a, b in pairwise(limits))]
    sketch.words(legend, "match error, nodes:", x, 22)
    x += sketch.text_width("match error, nodes:") + 22
    for colour, text in zip(CLASSES, [*edges, f"> {limits[-1]:.2f}"], strict=True):
        sketch.dot(legend, (x, 17), 5.0, colour)
        sketch.words(legend, text, x + 12, 22)
        x += sketch.text_width(text) + 38
    refused = f"not usable ({int((~catalog.usable).sum())} of {len(catalog)})"
    sketch.cross(legend, (x, 17), 4.0, REFUSED)
    sketch.words(legend, refused, x + 12, 22)
    return legend


def point_levels(catalog_path: Path, lat_deg: float, lon_deg: float) -> Drawn:
    """The levels of the usable point nearest to a place."""
    with Catalog.open(catalog_path) as catalog:
        usable = catalog.ids[catalog.usable]
        near = [p for p in catalog.within(lat_deg, lon_deg, 2.0) if p in usable]
        gap = [
            abs(catalog.point(int(p)).lat_deg - lat_deg)
            + abs(catalog.point(int(p)).lon_deg - lon_deg)
            for p in near
        ]
        chosen = int(near[int(np.argmin(gap))])
        picture = draw_pyramid(catalog.pyramid(chosen), catalog.meta.radius_m)
        finest, meta = catalog.meta.posting_m, catalog.meta
        caption = (
            f"Control point {chosen} by Tycho's central peak: heights (above) and brightness "
            f"(below) of its {meta.levels} levels, {finest:.0f} m to "
            f"{finest * 2 ** (meta.levels - 1):.0f} m a node."
        )
    return _wide(picture), caption


def _wide(picture: ByteArray) -> ByteArray:
    size = WIDE_PX, round(WIDE_PX * picture.shape[0] / picture.shape[1])
    return np.asarray(cv2.resize(picture, size, interpolation=cv2.INTER_AREA), np.uint8)


def hazard_map(seed: int, elevation_deg: float, square_m: float) -> Drawn:
    """A picture of synthetic ground from 500 m, its risk, slopes and pads."""
    ground = make_field("rough", seed, study.PICTURE_NODES, study.PICTURE_DRAWN_M)
    camera, height_m = preset_camera(study.PICTURE_CAMERA), study.PICTURE_HEIGHT_M
    picture = perspective_picture(ground, camera, height_m, elevation_deg, study.PICTURE_DRAWN_M)
    view = look_down(picture, camera, height_m, elevation_deg, ground.azimuth_deg())
    mapped = map_hazard(view, HazardSettings(square_m=square_m))
    found = 100.0 * np.array(study.pads_below(ground, view, mapped.pads)).mean(axis=0)
    caption = (
        f"Where to land: synthetic ground, {100.0 * ground.share_above(7.0):.0f} % of it above "
        f"7°, under a Sun of {elevation_deg:g}°, seen from {height_m:g} m; its risk and its slopes "
        f"by shading. Boxes are the pads of 20 m chosen in squares of {square_m:g} m: "
        f"{found[0]:.1f} % of them is expected above 7°, {found[1]:.1f} % is."
    )
    return _wide(draw_overview(mapped)), caption


def body_sides(catalog_path: Path) -> Drawn:
    """A small body with its points from its six sides."""
    with Catalog.open(catalog_path) as catalog:
        picture = draw_sides_picture(catalog)
        caption = (
            f"{catalog.meta.body.capitalize()} from six sides: {int(catalog.usable.sum())} of "
            f"{len(catalog)} control points are usable."
        )
    return _wide(picture), caption


def _patch_outlines(
    run: RunFolder, file: str, catalog_path: Path
) -> dict[tuple[str, int], list[FloatArray]]:
    """The border of each used point's matched patch, px, by id."""
    solution = next(s for s in run.solutions if s.file == file)
    if solution.position_m is None or solution.camera_from_body is None:
        raise ValueError(f"{run.path}: {file} is not solved: {solution.reason}")
    outlines = {}
    with Catalog.open(catalog_path) as catalog:
        meta = catalog.meta
        for match in (m for m in run.matches if m.file == file and m.used):
            point = catalog.point(match.cp_id)
            half = (meta.size - 1) / 2.0 * meta.posting_m * 2.0**match.level
            outlines[match.catalog, match.cp_id] = project_patches(
                point.projection(meta.radius_m), point.radius_m - meta.radius_m, [half],
                run.cameras[file], solution.position_m, solution.camera_from_body,
            )  # fmt: skip
    return outlines


def frame_overlay(
    run: Path, pictures: Path, file: str, catalog_path: Path | None, what: str
) -> Drawn:
    """A navigated frame as `optnav navigate` draws it, smaller; with a catalog, patches too."""
    found = read_run(run)
    solution = next(s for s in found.solutions if s.file == file)
    matches = [m for m in found.matches if m.file == file]
    outlines = _patch_outlines(found, file, catalog_path) if catalog_path else {}
    gray = scale_to_eight_bits(load_picture(pictures / file, found.cameras[file]).values)
    caption = (
        f"{what}: {solution.n_used} of {solution.n_predicted} control points are used, residual "
        f"{solution.residual_rms_px:.2f} px."
    )
    return draw_overlay(gray, solution, matches, outlines, FRAME_PX), caption


def opening(run: Path, pictures: Path, catalog_path: Path) -> Drawn:
    """The fisheye picture as it came, and with what was found in it."""
    found = read_run(run)
    solution, camera = found.solutions[0], found.cameras[found.solutions[0].file]
    picture = load_picture(pictures / solution.file, camera).values
    rows, cols = (np.flatnonzero((picture > 40).any(axis=axis)) for axis in (1, 0))
    half = max(np.ptp(rows), np.ptp(cols)) // 2 + 20
    row, col = (int(edges[0] + edges[-1]) // 2 for edges in (rows, cols))
    part = picture[row - half : row + half, col - half : col + half]
    left = sketch.gray_picture(part, HALF_PX)
    right = np.asarray(left * 0.8, np.uint8)
    scale = HALF_PX / (2.0 * half)

    def shown(pixels: FloatArray) -> FloatArray:
        return (np.asarray(pixels) - (col - half, row - half) + 0.5) * scale - 0.5

    used = [m for m in found.matches if m.used and m.measured_px is not None]
    for outlines in _patch_outlines(found, solution.file, catalog_path).values():
        for outline in outlines:
            sketch.line(right, shown(np.vstack([outline, outline[:1]])), OUTLINE)
    for match in used:
        sketch.dot(right, shown(match.measured_px), 2.5, FOUND)
    truth = read_truth(pictures / "truth.csv", found.attitude)[0]
    error = float(np.linalg.norm(solution.position_m - truth.position_m))
    legend = sketch.strip(2 * HALF_PX, 34)
    prior = read_folder(pictures).frames[0].position_m
    guess = float(np.linalg.norm(prior - truth.position_m)) / 1e3
    sketch.words(
        legend, f"in: a picture (simulated, fisheye, 200 km), a guess {guess:.1f} km off", 14, 22
    )
    sketch.words(
        legend, f"out: {len(used)} control points, position {error:.0f} m from truth",
        HALF_PX + 14, 22,
    )  # fmt: skip
    caption = (
        "A simulated fisheye picture from 200 km, and what is found in it from a prior that is "
        f"{guess:.1f} km off: {len(used)} control points, and a position {error:.0f} m from the "
        "truth."
    )
    return np.vstack([np.hstack([left, right]), legend]), caption
