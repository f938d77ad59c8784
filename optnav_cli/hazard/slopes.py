"""How steep a terrain model is, and its slopes as a raster or a picture: `optnav slopes`."""

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import rasterio
from affine import Affine

from catalog.arrays import ByteArray, Float32Array
from catalog.bodies.body import load_body
from catalog.files import check_file, make_prefix_test, replace_file
from catalog.places import check_apart
from catalog.rasters import DESCRIPTION, encode_geotiff, is_described
from catalog.terrain.dem.georeference import Georeference
from catalog.terrain.dem.source import DemSource
from catalog.terrain.slopes import CRITICAL_DEG, DANGEROUS_DEG, SlopeSummary, summarise_slopes
from optnav_cli.hazard.output import MAX_SLOPE_DEG, OUTSIDE_COLOUR, TEXT_COLOUR, map_colours
from optnav_cli.output.canvas import Canvas, encode_picture
from optnav_cli.output.wording import align_table

MADE = "Slopes by optnav"
PNG = b"\x89PNG\r\n\x1a\n"
GRAPH_PX, MARGIN_PX = 240, 24  # the histogram's width and the room for its words
STEPS = 40  # of the histogram


@dataclass(frozen=True)
class MeasuredSlopes:
    """Slope statistics of a terrain model."""

    dem: Path
    summary: SlopeSummary

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
        return "\n".join(align_table(rows, left=(0, 1)))


def measure_slopes(
    dem: Path,
    base_m: float,
    body: str,
    output: Path | None = None,
    nodata: float | None = None,
) -> MeasuredSlopes:
    """Measure the slopes of a terrain model, and write them to a .tif or .png where one is named.

    nodata  the stored value of pixels without data; None: as the file says
    Raises DataError for a model that cannot be used, OutputError for the place.
    """
    if output is not None:
        check_file(output, make_prefix_test(PNG) if output.suffix.lower() == ".png" else _is_ours)
        check_apart(output, [dem])
    source = DemSource.open_alone(dem, load_body(body), nodata)
    try:
        summary, degrees = summarise_slopes(source, base_m)
        georeference = source.georeference
    finally:
        source.close()
    if output is not None and output.suffix.lower() == ".png":
        with replace_file(output, make_prefix_test(PNG)) as path:
            path.write_bytes(encode_picture(_draw(degrees, summary), ".png"))
    elif output is not None:
        _write(output, degrees, georeference)
    return MeasuredSlopes(dem, summary)


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
    for number, share in enumerate(shares):
        x = left + number * wide
        tint = [int(part) for part in tints[number]]
        cv2.rectangle(
            canvas.image, (x, bottom - round(share * scale)), (x + wide - 2, bottom), tint, -1
        )
    for degrees_at in (0.0, DANGEROUS_DEG, CRITICAL_DEG):
        x = left + degrees_at / MAX_SLOPE_DEG * STEPS * wide
        canvas.text(f"{degrees_at:g}", x - 3, bottom + 16, TEXT_COLOUR)
    words = f"deg; {summary.share_above(DANGEROUS_DEG):.1%} > 7, rms {summary.rms_deg:.1f}"
    canvas.text(words, left, bottom + 34, TEXT_COLOUR)
    return canvas.image
