"""A cylinder run as plots and as a page: distance and light angle over time, and the path."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from catalog.arrays import FloatArray
from catalog.bodies.epochs import utc_to_tdb_s
from catalog.errors import DataError
from catalog.tables import CsvRow
from optnav_cli.frames.tables import CYLINDER
from optnav_cli.output.manifest import read_manifest
from optnav_cli.output.wording import format_json
from optnav_cli.report import page as html
from optnav_cli.report.sheet import LegendEntry, Panel, draw_sheet
from optnav_cli.report.svg import HALF, Plot, PlotAxis, find_span

CYLINDER_KIND, CYLINDER_CSV = "cylinder", "cylinder.csv"
# zones, and how they are drawn
ZONES = (("ok", "s1"), ("full_face", "s3"), ("crescent", "s2"), ("cut", "s5"), ("glare", "s4"))
HEIGHT = 300
HEADER = ("file", "zone", "d, m", "σ, mm", "θ, °", "σ, °", "v, mm/s", "σ, mm/s", "why not")


def build_cylinder_page(folder: Path) -> str:
    """Build the page of a run. Raises DataError for a folder that lacks its table."""
    manifest = read_manifest(folder)
    rows = CYLINDER.rows(folder / CYLINDER_CSV)
    solved = [row for row in rows if row["status"] == "solved"]
    numbers = [(f"{len(solved)} of {len(rows)}", "pictures have a distance")]
    keys = {f"k{kind[1]}": zone.replace("_", " ") for zone, kind in ZONES}
    drawn = [
        panel.plot.svg(panel.description) for panel in _plot_panels(rows, _read_radius(manifest))
    ]
    words = (
        "Distance to the surface, angle of the light, and the path about the axis, with the light "
        "from the right; zones other than ok are shaded."
    )
    sections = [
        html.section("Result", html.tiles(numbers)),
        html.section("Motion", html.figure(html.side_by_side("triple", drawn), words, keys)),
        html.section("Pictures", html.table(HEADER, [_format_cells(row) for row in rows], 2)),
        html.section("How it was made", html.format_listing(format_json(manifest))),
    ]
    return html.build_page("A lit cylinder", f"{len(rows)} pictures", sections)


def draw_cylinder_sheet(folder: Path, radius_m: float | None = None) -> str:
    """Draw the three plots as one picture (SVG) that stands alone.

    radius_m  of the cylinder; by the folder's manifest if None
    """
    radius = _read_radius(read_manifest(folder)) if radius_m is None else radius_m
    rows = CYLINDER.rows(folder / CYLINDER_CSV)
    legend = [LegendEntry(kind, zone.replace("_", " "), line=False) for zone, kind in ZONES]
    return draw_sheet("A lit cylinder", legend, [list(_plot_panels(rows, radius))])


def _plot_panels(rows: Sequence[CsvRow], radius_m: float) -> list[Panel]:
    solved = [row for row in rows if row["status"] == "solved"]
    seconds = np.array([_parse_seconds(row) for row in solved])
    seconds = seconds - np.nanmin(seconds) if np.isfinite(seconds).any() else seconds
    d_m, theta = (_read_column(solved, name) for name in ("d_m", "theta_deg"))
    panels = []
    for values, name, label in (
        (d_m, "d", "distance to the surface, m"),
        (theta, "θ", "angle of the light, °"),
    ):
        axes = PlotAxis(find_span(seconds, 0.03), "seconds"), PlotAxis(find_span(values), label)
        plot = Plot(*axes, width=HALF, height=HEIGHT)
        low, high = axes[1].ends
        for kind, part in _split_zones(solved):
            first, last = _find_midway_ends(seconds, part)
            plot.area([first, last, last, first], [low, low, high, high], kind)
        plot.line(seconds, values, "muted thin")
        _plot_zones(plot, solved, seconds, values)
        panels.append(Panel(name, plot, f"{label} over time"))
    reach = d_m + radius_m
    x, y = reach * np.cos(np.radians(theta)), reach * np.sin(np.radians(theta))
    ends = (min(0.0, *x, 0.0), max(0.0, *x, 0.0)), (min(0.0, *y, 0.0), max(0.0, *y, 0.0))
    plot = Plot(
        PlotAxis(find_span(ends[0], 0.1), "towards the light, m"),
        PlotAxis(find_span(ends[1], 0.1), "across, m"),
        width=HALF,
        height=HEIGHT,
        equal=True,
    )
    farthest = 1.05 * float(np.nanmax(reach, initial=radius_m))
    for kind, part in _split_zones(solved):
        turned = np.unwrap(np.radians(theta))
        swept = np.linspace(*_find_midway_ends(turned, part), 24)
        plot.area(
            np.append(0.0, farthest * np.cos(swept)), np.append(0.0, farthest * np.sin(swept)), kind
        )
    turn = np.linspace(0.0, 2.0 * np.pi, 61)
    plot.area(radius_m * np.cos(turn), radius_m * np.sin(turn), "muted")
    plot.marks([0.0], [0.0], "muted", "cross")
    plot.line(x, y, "muted thin")
    _plot_zones(plot, solved, x, y)
    return [*panels, Panel("path", plot, "path of the camera about the axis")]


def _split_zones(rows: Sequence[CsvRow]) -> list[tuple[str, slice]]:
    """Split rows into series that follow each other in one zone other than ok."""
    kinds = dict(ZONES)
    names = [row["zone"] or "ok" for row in rows]
    starts = [n for n in range(len(names)) if n == 0 or names[n] != names[n - 1]]
    ends = [*starts, len(names)][1:]
    return [
        (f"{kinds.get(names[start], 'muted')} band", slice(start, end))
        for start, end in zip(starts, ends, strict=True)
        if names[start] != "ok"
    ]


def _find_midway_ends(values: FloatArray, part: slice) -> tuple[float, float]:
    """Find the points half way to the row before and half way to the row after."""
    first, last = part.start, part.stop - 1
    before, after = max(first - 1, 0), min(last + 1, len(values) - 1)
    low, high = 0.5 * (values[first] + values[before]), 0.5 * (values[last] + values[after])
    return float(low), float(high)


def _plot_zones(plot: Plot, rows: Sequence[CsvRow], x: FloatArray, y: FloatArray) -> None:
    for zone, kind in ZONES:
        chosen = [n for n, row in enumerate(rows) if (row["zone"] or "ok") == zone]
        plot.marks(x[chosen], y[chosen], kind, "circle")


def _parse_seconds(row: CsvRow) -> float:
    try:
        return utc_to_tdb_s(row["utc"])
    except DataError:
        return float("nan")


def _read_column(rows: Sequence[CsvRow], name: str) -> FloatArray:
    values = [row.number(name) for row in rows]
    return np.array([np.nan if value is None else value for value in values], np.float64)


def _read_radius(manifest: dict[str, object]) -> float:
    inputs = manifest.get("inputs")
    radius = inputs.get("radius_m") if isinstance(inputs, dict) else None
    return float(radius) if isinstance(radius, int | float) else 0.0


def _format_cells(row: CsvRow) -> tuple[str, ...]:
    def format_value(name: str, form: str, scale: float = 1.0) -> str:
        value = row.number(name)
        return "" if value is None else format(scale * value, form)

    speed = ""
    if row["vx_m_s"]:
        speed = f"{1e3 * np.hypot(row.number('vx_m_s') or 0.0, row.number('vy_m_s') or 0.0):.1f}"
    return (
        *(
            row["file"],
            row["zone"],
            format_value("d_m", ".4f"),
            format_value("d_sigma_m", ".2f", 1e3),
        ),
        *(format_value("theta_deg", ".2f"), format_value("theta_sigma_deg", ".2f")),
        *(speed, format_value("v_sigma_m_s", ".2f", 1e3), row["reason"]),
    )
