"""The page about a delivery: the B-plane with boxes and trials, errors and dv by correction."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from catalog.arrays import FloatArray
from catalog.errors import DataError
from catalog.tables import CsvRow
from optnav_cli.frames.orbit_tables import DELIVERY_ARRIVALS, DELIVERY_BOXES, DELIVERY_STAGES
from optnav_cli.orbit.delivery.settings import ARRIVALS_CSV, BOXES_CSV, STAGES_CSV
from optnav_cli.output.manifest import read_manifest
from optnav_cli.output.wording import format_json
from optnav_cli.report import page as html
from optnav_cli.report.sheet import LegendEntry, Panel, draw_sheet
from optnav_cli.report.svg import HALF, WIDE, Plot, PlotAxis, find_span

MAX_DOTS = 450
HEADER = (
    *("before", "day", "condition", "ξ, km", "99.73 %", "η, km", "99.73 %", "τ, s", "99.73 %"),
    *("Δv, m/s", "99.73 %", "largest", "boxes"),
)
COLUMNS = (
    *("day", "condition", "bound_xi_km", "trials_xi_km", "bound_eta_km", "trials_eta_km"),
    *("bound_tau_s", "trials_tau_s", "bound_dv_m_s", "trials_dv_m_s", "largest_dv_m_s"),
)


def delivery_page(folder: Path) -> str:
    """The page. Raises DataError for a folder that lacks its tables or whose tables are damaged."""
    manifest = read_manifest(folder)
    results = _results(folder, manifest)
    rows = DELIVERY_STAGES.rows(folder / STAGES_CSV)
    target = str(manifest.get("options", {}).get("delivery", {}).get("target", "the target"))
    words = (
        "The arrival in the B-plane: all bounded errors lie in the boxes; dots are trials. Left "
        "about the target with the circle of impact, right the errors alone."
    )
    pair = [plot.svg(name) for name, plot in plane_plots(folder, results)]
    keys = {"k1": "trials", "k2": "boxes", "k4": "circle of impact"}
    dv = html.figure(
        dv_plot(rows).svg("Velocity change by correction"),
        "Velocity change of each correction: bound by the boxes, and 99.73 % of the trials.",
        {"k2": "bound", "k1": "99.73 % of trials"},
    )
    tiles = [
        (f"{results['bound_dv_m_s']:.1f} m/s", "all corrections, at most"),
        (f"{results['trials_dv_m_s']:.1f} m/s", "in 99.73 % of the trials"),
    ]
    sections = [
        html.section("Result", html.tiles(tiles)),
        html.section("Arrival", html.figure(html.side_by_side("pair", pair), words, keys)),
        html.section("Corrections", dv, html.table(HEADER, [_cells(row) for row in rows])),
        html.section("How it was made", html.format_listing(format_json(manifest))),
    ]
    return html.build_page(
        f"Delivery to {target.capitalize()}", "Bounds and trials of an arrival", sections
    )


def delivery_sheet(folder: Path) -> str:
    """The B-plane as a picture that stands alone. Raises DataError."""
    results = _results(folder, read_manifest(folder))
    panels = [Panel(name, plot, name) for name, plot in plane_plots(folder, results)]
    legend = [
        LegendEntry("s1", "trials", "circle", False),
        LegendEntry("s2", "boxes that hold all bounded errors", ""),
        LegendEntry("s4 dashed", "circle of impact", ""),
    ]
    return draw_sheet("A delivery: the arrival in the B-plane", legend, [panels])


def plane_plots(folder: Path, results: Mapping[str, float]) -> list[tuple[str, Plot]]:
    """The arrivals about the target, and about the aim."""
    boxes = np.array(
        [
            [row.number(name) or 0.0 for name in _SIDES]
            for row in DELIVERY_BOXES.rows(folder / BOXES_CSV)
        ]
    ).reshape(-1, 4)
    dots = np.array(
        [
            [row.number("xi_km") or 0.0, row.number("eta_km") or 0.0]
            for row in DELIVERY_ARRIVALS.rows(folder / ARRIVALS_CSV)[:MAX_DOTS]
        ]
    ).reshape(-1, 2)
    if not len(boxes) or not len(dots):
        raise DataError(f"{folder}: {BOXES_CSV} or {ARRIVALS_CSV} has no rows; make it again")
    aim = np.array([results["xi_km"], results["eta_km"]])
    turn = np.linspace(0.0, 2.0 * np.pi, 73)
    circle = results["impact_km"] * np.column_stack([np.cos(turn), np.sin(turn)])
    corners = np.vstack([boxes[:, :2], boxes[:, 2:]])
    plots = []
    for name, middle, around in (
        ("about the target", aim, np.vstack([corners + aim, circle])),
        ("errors", np.zeros(2), corners),
    ):
        axes = (
            PlotAxis(find_span(around[:, 0], 0.06), "ξ, km"),
            PlotAxis(find_span(around[:, 1], 0.06), "η, km"),
        )
        plot = Plot(*axes, width=HALF, height=440, equal=True)
        if name != "errors":
            plot.line(circle[:, 0], circle[:, 1], "s4 dashed")
            plot.marks([0.0], [0.0], "s4", "cross", 4.0)
        _outline(plot, boxes, middle)
        plot.dots(dots[:, 0] + middle[0], dots[:, 1] + middle[1], "s1", 1.4)
        plots.append((name, plot))
    return plots


_SIDES = ("xi_km_from", "eta_km_from", "xi_km_to", "eta_km_to")


def _outline(plot: Plot, boxes: FloatArray, middle: FloatArray) -> None:
    """The outer sides of boxes: those that no other box has as well."""
    counts: dict[tuple[float, float, float, float], int] = {}
    for a, b, c, d in np.round(boxes, 9).tolist():
        for side in ((a, b, c, b), (c, b, c, d), (a, d, c, d), (a, b, a, d)):
            counts[side] = counts.get(side, 0) + 1
    for (a, b, c, d), count in counts.items():
        if count == 1:
            plot.line([a + middle[0], c + middle[0]], [b + middle[1], d + middle[1]], "s2")


def dv_plot(rows: Sequence[CsvRow]) -> Plot:
    """The velocity change of each correction as bars."""
    corrections = [row for row in rows if row["bound_dv_m_s"]]
    bound = np.array([row.number("bound_dv_m_s") or 0.0 for row in corrections])
    trials = np.array([row.number("trials_dv_m_s") or 0.0 for row in corrections])
    numbers = [float(n + 1) for n in range(len(corrections))]
    axes = (
        PlotAxis((0.4, len(corrections) + 0.6), "correction", numbers=numbers),
        PlotAxis((0.0, 1.1 * float(bound.max(initial=1e-3))), "m/s"),
    )
    plot = Plot(*axes, width=WIDE, height=260)
    for number, high, low in zip(numbers, bound, trials, strict=True):
        plot.bars([number - 0.3, number], [float(high)], "s2")
        plot.bars([number, number + 0.3], [float(low)], "s1")
    return plot


def _results(folder: Path, manifest: Mapping[str, Any]) -> dict[str, float]:
    names = ("bound_dv_m_s", "trials_dv_m_s", "xi_km", "eta_km", "impact_km")
    try:
        return {name: float(manifest["results"][name]) for name in names}
    except (LookupError, TypeError, ValueError):
        raise DataError(f"{folder}: its manifest lacks results; make the folder again") from None


def _cells(row: CsvRow) -> tuple[str, ...]:
    shown = [row["stage"]]
    for name in COLUMNS:
        value = row.number(name)
        shown.append("" if value is None else f"{value:.4g}")
    return (*shown, row["boxes"])
