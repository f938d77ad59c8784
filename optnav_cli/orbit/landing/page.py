"""The page about landings: the path in section with its beams, touchdowns, errors, impulse."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from markupsafe import Markup

from catalog.arrays import FloatArray
from catalog.errors import DataError
from catalog.tables import CsvRow
from optnav_cli.frames.orbit_tables import LANDING, LANDING_IMPULSE, LANDING_PATH
from optnav_cli.orbit.landing.settings import IMPULSE_CSV, LANDING_CSV, PATH_CSV
from optnav_cli.output.manifest import read_manifest
from optnav_cli.output.wording import format_json
from optnav_cli.report import page as html
from optnav_cli.report.sheet import LegendEntry, Panel, draw_sheet
from optnav_cli.report.svg import HALF, WIDE, Plot, PlotAxis, find_span

LIMIT_M = 100.0  # circle about the target
HEADER = (
    *("trial", "arrival, m", "σ, m", "NEES", "end: height, m", "side, m", "east, m", "north, m"),
    *("down, m/s", "side, m/s", "Δv, m/s", "why not"),
)
COLUMNS = {
    "arrival_error_m": ".1f",
    "arrival_sigma_m": ".1f",
    "arrival_nees": ".2f",
    "end_height_error_m": ".1f",
    "end_side_error_m": ".1f",
    "east_m": ".1f",
    "north_m": ".1f",
    "down_m_s": ".2f",
    "side_m_s": ".2f",
    "dv_m_s": ".1f",
}


def landing_page(folder: Path) -> str:
    """The page. Raises DataError for a folder that lacks its tables or whose tables are damaged."""
    manifest = read_manifest(folder)
    rows = LANDING.rows(folder / LANDING_CSV)
    landed = [row for row in rows if row["status"] == "solved"]
    sections = [
        html.section("Result", html.tiles(_numbers(rows, landed))),
        html.section("Path", _section_figure(folder)),
    ]
    if landed:
        words = "Where trials touch down about the target (circle: 100 m), and how fast."
        pair = [touchdown_plot(landed).svg("Touchdowns"), _speed_plot(landed).svg("Velocities")]
        plots = html.figure(html.side_by_side("pair", pair), words)
        sections.append(html.section("Touchdown", plots))
    impulse = [
        (row["step"], f"{row.number('left_m_s') or 0.0:.3g}")
        for row in LANDING_IMPULSE.rows(folder / IMPULSE_CSV)
    ]
    table = html.table(HEADER, [_cells(row) for row in rows])
    sections += [
        html.section("Impulse", html.table(("step", "left to find, m/s"), impulse)),
        html.section("Trials", html.folded(f"{len(rows)} trials", table)),
        html.section("How it was made", html.format_listing(format_json(manifest))),
    ]
    return html.build_page("Landing", f"{len(landed)} of {len(rows)} trials land", sections)


def landing_sheet(folder: Path) -> str:
    """The path in section and the touchdowns as a picture that stands alone. Raises DataError."""
    landed = [row for row in LANDING.rows(folder / LANDING_CSV) if row["status"] == "solved"]
    panels = [Panel("path, in the plane of the transfer", section_plot(folder, HALF), "path")]
    if landed:
        panels.append(Panel("touchdowns", touchdown_plot(landed), "touchdowns"))
    legend = [
        LegendEntry("s1", "transfer", ""),
        LegendEntry("s2", "descent", ""),
        LegendEntry("s3 thin", "beams", ""),
        LegendEntry("s1", "touchdown", "circle", False),
    ]
    return draw_sheet(f"A landing: {len(landed)} trials touch down", legend, [panels])


def section_plot(folder: Path, width: int) -> Plot:
    """The path over the ground, in the plane of the transfer."""
    parts = _parts(folder)
    every = np.concatenate([*parts.values()])
    plot = Plot(
        PlotAxis(find_span(every[:, 0], 0.04), "along the transfer, km"),
        PlotAxis(find_span(every[:, 1], 0.04), "over the target, km"),
        width=width,
        height=HALF if width == HALF else 520,
        equal=True,
    )
    if "ground" in parts:
        ground = parts["ground"]
        low = np.full(len(ground), plot.y[0])
        x = np.concatenate([ground[:, 0], ground[::-1, 0]])
        plot.area(x, np.concatenate([ground[:, 1], low]), "muted")
    for foot in parts.get("beam", np.empty((0, 2))).reshape(-1, 2, 2):
        plot.line(foot[:, 0], foot[:, 1], "s3 thin")
    for kind, series in (("transfer", "s1"), ("descent", "s2")):
        if kind in parts:
            plot.line(parts[kind][:, 0], parts[kind][:, 1], series)
    plot.marks([0.0], [0.0], "s4", "diamond", 4.5)
    return plot


def touchdown_plot(rows: Sequence[CsvRow]) -> Plot:
    """Touchdowns about the target with a circle of 100 m."""
    x, y = (np.array([row.number(name) or 0.0 for row in rows]) for name in ("east_m", "north_m"))
    reach = 1.1 * max(LIMIT_M, float(np.hypot(x, y).max()))
    axes = PlotAxis((-reach, reach), "east, m"), PlotAxis((-reach, reach), "north, m")
    plot = Plot(*axes, width=HALF, height=HALF, equal=True)
    turn = np.linspace(0.0, 2.0 * np.pi, 73)
    plot.line(LIMIT_M * np.cos(turn), LIMIT_M * np.sin(turn), "muted dashed")
    plot.marks(x, y, "s1", "circle", 2.6)
    plot.marks([0.0], [0.0], "s4", "diamond", 5.0)
    return plot


def _speed_plot(rows: Sequence[CsvRow]) -> Plot:
    names = ("down_m_s", "side_m_s")
    x, y = (np.array([row.number(name) or 0.0 for row in rows]) for name in names)
    axes = (
        PlotAxis(find_span(x, 0.1), "down, m/s"),
        PlotAxis((0.0, 1.1 * float(y.max())), "across, m/s"),
    )
    plot = Plot(*axes, width=HALF, height=HALF)
    plot.marks(x, y, "s1", "circle", 2.6)
    return plot


def _section_figure(folder: Path) -> Markup:
    words = "The path in the plane of the transfer, the ground of the model, and beams on the way."
    keys = {"k1": "transfer", "k2": "descent of the first trial", "k3": "beams", "k4": "target"}
    return html.figure(section_plot(folder, WIDE).svg("The landing in section"), words, keys)


def _parts(folder: Path) -> dict[str, FloatArray]:
    """Points (n, 2), km, along and up, by kind."""
    by_kind: dict[str, list[tuple[float, float]]] = {}
    for row in LANDING_PATH.rows(folder / PATH_CSV):
        point = row.number("along_km") or 0.0, row.number("up_km") or 0.0
        by_kind.setdefault(row["kind"], []).append(point)
    if len(by_kind.get("beam", ())) % 2 or not by_kind:
        raise DataError(f"{folder / PATH_CSV}: is damaged; make the folder again")
    return {kind: np.array(points) for kind, points in by_kind.items()}


def _numbers(rows: Sequence[CsvRow], landed: Sequence[CsvRow]) -> list[tuple[str, str]]:
    numbers = [(f"{len(landed)} of {len(rows)}", "trials land")]
    if landed:
        distances = [
            np.hypot(r.number("east_m") or 0.0, r.number("north_m") or 0.0) for r in landed
        ]
        side = [row.number("side_m_s") or 0.0 for row in landed]
        numbers.append((f"{max(distances):.0f} m", "from the target at most"))
        numbers.append((f"{max(side):.2f} m/s", "across the ground at most"))
    return numbers


def _cells(row: CsvRow) -> tuple[str, ...]:
    shown = [row["trial"]]
    for name, form in COLUMNS.items():
        value = row.number(name)
        shown.append("" if value is None else format(value, form))
    return (*shown, row["reason"])
