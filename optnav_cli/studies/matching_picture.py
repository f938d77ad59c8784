"""The curves of the matching study as a picture."""

from collections.abc import Sequence

import numpy as np

from optnav_cli.output.report.sheet import Entry, Panel, sheet
from optnav_cli.output.report.svg import Plot
from optnav_cli.studies.matching import RECOGNISED, MatchingRow, curves
from optnav_cli.studies.matching_trials import AXES, NOISE, Axis

SIGNS = {"NCC": ("s1", "circle"), "SURF-64": ("s2", "triangle")}
WIDTH, HEIGHT = 300, 230
ERROR_NODES = (0.03, 3.0)  # range of the lower plots


def picture(rows: Sequence[MatchingRow]) -> str:
    """Recognition above, error of the place below, one column an error (SVG)."""
    legend = []
    for name, (series, shape) in SIGNS.items():
        legend.append(Entry(series, f"{name}, unaided", shape))
        legend.append(Entry(f"{series} dashed hollow", f"{name}, aided as above each", shape))
    legend.append(Entry("muted dashed", f"{100.0 * RECOGNISED:.0f} %", ""))
    legend.append(Entry("s4 dashed", "tolerance that the source states", ""))
    return sheet(
        "What matching bears: control points recognised, and the error of their places",
        legend,
        [[_share(rows, axis) for axis in AXES], [_error(rows, axis) for axis in AXES]],
    )


def _share(rows: Sequence[MatchingRow], axis: Axis) -> Panel:
    plot = _plot(axis, (0.0, 105.0), "recognised, %", log_y=False)
    plot.level(100.0 * RECOGNISED, "muted dashed")
    _stated(plot, axis)
    for name, aided, chosen in curves(rows, axis):
        _curve(plot, axis, name, aided, chosen, [100.0 * row.recognised for row in chosen])
    return Panel(f"{axis.name} (aided: {axis.aid})", plot, f"Share recognised against {axis.name}")


def _error(rows: Sequence[MatchingRow], axis: Axis) -> Panel:
    low, high = np.log10(ERROR_NODES)
    plot = _plot(axis, (float(low), float(high)), "error of the place, nodes", log_y=True)
    _stated(plot, axis)
    for name, aided, chosen in curves(rows, axis):
        values = [float(np.log10(max(row.error_nodes, 1e-6))) for row in chosen]
        _curve(plot, axis, name, aided, chosen, values)
    return Panel("", plot, f"Error of the place against {axis.name}, log scale")


def _plot(axis: Axis, y: tuple[float, float], label: str, log_y: bool) -> Plot:
    log = axis is NOISE
    values = axis.values
    ends = np.log10([min(values), max(values)]) if log else np.array([min(values), max(values)])
    margin = 0.05 * (ends[1] - ends[0])
    name = "SNR of a pixel" if log else f"error, {axis.unit}"
    if axis.name == "off nadir":
        name = "angle, °"
    return Plot(
        (float(ends[0] - margin), float(ends[1] + margin)), y, x_label=name, y_label=label,
        width=WIDTH, height=HEIGHT, log_x=log, log_y=log_y, x_numbers=values,
    )  # fmt: skip


def _stated(plot: Plot, axis: Axis) -> None:
    place = float(np.log10(axis.stated)) if axis is NOISE else axis.stated
    plot.line((place, place), plot.y, "s4 dashed thin")


def _curve(
    plot: Plot, axis: Axis, name: str, aided: bool, rows: Sequence[MatchingRow], y: Sequence[float]
) -> None:
    x = np.array([row.value for row in rows])
    x = np.log10(x) if axis is NOISE else x
    series, shape = SIGNS[name]
    plot.line(x, y, f"{series} dashed" if aided else series)
    plot.marks(x, y, f"{series} hollow" if aided else series, shape)
