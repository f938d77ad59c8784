"""What matching bears: recognition of control points against noise, scale, slant and roll.

Zhukov (2025), ch. 3, states for SURF-64 and for correlation that a signal to noise of 10, a scale
off by 10 %, a view 25 degrees off nadir and a roll off by 6 degrees hardly matter. Here the usable
points of the catalog of the bundled Tycho terrain (118 m) are looked for in pictures of the same
ground with craters and relief below 118 m added, by Hapke's law with cast shadows, blurred, noisy,
in 8 bits, a pixel as large as a node.

*Unaided* measures what the comparison itself bears: the pose that the matcher gets is wrong by
exactly that roll, distance or slant about the point (the point stays where it is but for a shift of
up to 5 nodes), and nothing but the place is searched, at the finest level. *Aided* is what the
navigator makes of it: rolls and scales searched as it plans them, the view known and the slant
taken out by resampling into the point's map projection, noise averaged one pyramid level up.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from catalog.progress import Progress
from optnav_cli.camera.camera_file import preset_camera
from optnav_cli.report.sheet import LegendEntry, Panel, draw_sheet
from optnav_cli.report.svg import Plot, PlotAxis
from tests.studies import matching_trials
from tests.studies.tables import StudyReport, StudyTable, columns, rms

CAMERA = "unk"
MAX_ERROR_NODES = 3.0  # a match further from the truth is a wrong one, as `evaluate` counts
RECOGNISED = 0.9  # the share down to which an error is said to be borne


@dataclass(frozen=True)
class MatchingRow:
    """All trials of one error by one matcher.

    recognised   share whose best place lies within MAX_ERROR_NODES of the truth
    accepted     share recognised and passed by the gates
    wrong        share passed by the gates, but further away
    error_nodes  rms of the recognised ones' places
    """

    axis: str
    value: float
    matcher: str
    aided: bool
    trials: int
    recognised: float
    accepted: float
    wrong: float
    error_nodes: float


def run(progress: Progress, scenes: int = 2, seed: int = 1) -> list[MatchingRow]:
    """All errors, on as many grounds under as many Suns as there are `scenes`."""
    camera = preset_camera(CAMERA)
    trials: list[matching_trials.Trial] = []
    with TemporaryDirectory(prefix="optnav-") as folder:
        points = matching_trials.references(Path(folder), progress)
    range_m = points[0].patches[0].posting_m * camera.focal_length_px
    for scene in matching_trials.draw_scenes(camera, range_m, scenes, progress):
        trials += matching_trials.trials_of(scene, points, camera, seed)
    return summarise(trials)


def summarise(trials: Iterable[matching_trials.Trial]) -> list[MatchingRow]:
    """Shares and errors, in the order of the axes."""
    groups: dict[tuple[str, float, str, bool], list[matching_trials.Trial]] = {}
    for trial in trials:
        key = (trial.axis, trial.value, trial.matcher, trial.aided)
        groups.setdefault(key, []).append(trial)
    rows = []
    for axis, name, aided in product(matching_trials.AXES, matching_trials.MATCHERS, (False, True)):
        keys = ((axis.name, value, name, aided) for value in axis.values)
        for key in filter(groups.__contains__, keys):
            own = groups[key]
            errors = np.array([np.inf if t.error_nodes is None else t.error_nodes for t in own])
            accepted = np.array([trial.accepted for trial in own])
            good = errors <= MAX_ERROR_NODES
            taken, wrong = float((good & accepted).mean()), float((~good & accepted).mean())
            shares = (float(good.mean()), taken, wrong)
            rows.append(MatchingRow(*key, len(own), *shares, rms(errors[good])))
    return rows


def tolerance(rows: Sequence[MatchingRow]) -> tuple[float, bool]:
    """The value at which recognition falls below RECOGNISED, and whether it does so at all.

    rows  of one error, matcher and aid, from the harmless value on; between two of them the share
          is taken to go straight. Without a fall: the last value.
    """
    values, shares = [r.value for r in rows], [r.recognised for r in rows]
    if shares[0] < RECOGNISED:
        return values[0], True
    for k in range(1, len(rows)):
        if shares[k] < RECOGNISED:
            part = (shares[k - 1] - RECOGNISED) / (shares[k - 1] - shares[k])
            return values[k - 1] + part * (values[k] - values[k - 1]), True
    return values[-1], False


COLUMNS = columns(
    "matcher; aid; value g; trials; recognised [%] .0f; "
    "error_nodes = error, rms [nodes] .2f; accepted [%] .0f; wrong [%] .0f"
)
BORNE_COLUMNS = columns(
    f"error; matcher; aid; borne = borne with {100.0 * RECOGNISED:.0f} % recognised; stated"
)


def report(rows: Sequence[MatchingRow]) -> StudyReport:
    """A table for every error, and what is borne at RECOGNISED."""
    tables, tolerances = [], []
    for axis in matching_trials.AXES:
        lines = []
        for name, aided, chosen in curves(rows, axis):
            aid = axis.aid if aided else "unaided"
            for r in chosen:
                start = (name, aid, r.value, r.trials, 100.0 * r.recognised, r.error_nodes)
                lines.append((*start, 100.0 * r.accepted, 100.0 * r.wrong))
            stated = quantity(axis, axis.stated)
            tolerances.append((axis.name, name, aid, borne(axis, chosen), stated))
        heads = tuple(replace(c, unit=axis.unit) if c.name == "value" else c for c in COLUMNS)
        tables.append(StudyTable(axis.name, heads, tuple(lines)))
    tables.append(StudyTable("", BORNE_COLUMNS, tuple(tolerances)))
    worst = max(rows, key=lambda row: row.wrong)
    notes = (
        f"recognised: within {MAX_ERROR_NODES:g} nodes of the truth; accepted: by the gates",
        f"wrong places accepted: at most {100.0 * worst.wrong:.0f} % ({worst.matcher}, "
        f"{worst.axis} {worst.value:g}, {'aided' if worst.aided else 'unaided'})",
    )
    return StudyReport(tuple(tables), notes)


def curves(
    rows: Sequence[MatchingRow], axis: matching_trials.Axis
) -> list[tuple[str, bool, list[MatchingRow]]]:
    """Matcher, aid and rows of each curve of an error."""
    found = []
    for name, aided in product(matching_trials.MATCHERS, (False, True)):
        key = (axis.name, name, aided)
        chosen = [row for row in rows if (row.axis, row.matcher, row.aided) == key]
        if chosen:
            found.append((name, aided, chosen))
    return found


def quantity(axis: matching_trials.Axis, value: float) -> str:
    """A value with its unit: SNR 10, 10 %, 25°."""
    if axis is matching_trials.NOISE:
        return f"SNR {value:.2g}"
    return f"{value:.3g}{axis.unit if axis.unit == '°' else ' ' + axis.unit}"


def borne(axis: matching_trials.Axis, rows: Sequence[MatchingRow]) -> str:
    """The tolerance in words; a mark where the share never falls so low, or is never so high."""
    if rows[0].recognised < RECOGNISED:
        return "never"
    value, falls = tolerance(rows)
    sign = "" if falls else ("< " if axis is matching_trials.NOISE else "> ")
    return sign + quantity(axis, value)


SIGNS = {"NCC": ("s1", "circle"), "SURF-64": ("s2", "triangle")}
WIDTH, HEIGHT = 300, 230
ERROR_NODES = (0.03, 3.0)  # range of the lower plots


def picture(rows: Sequence[MatchingRow]) -> str:
    """Recognition above, error of the place below, one column an error (SVG)."""
    legend = []
    for name, (series, shape) in SIGNS.items():
        legend.append(LegendEntry(series, f"{name}, unaided", shape))
        legend.append(LegendEntry(f"{series} dashed hollow", f"{name}, aided as above each", shape))
    legend.append(LegendEntry("muted dashed", f"{100.0 * RECOGNISED:.0f} %", ""))
    legend.append(LegendEntry("s4 dashed", "tolerance that the source states", ""))
    return draw_sheet(
        "What matching bears: control points recognised, and the error of their places",
        legend,
        [
            [_share(rows, axis) for axis in matching_trials.AXES],
            [_error(rows, axis) for axis in matching_trials.AXES],
        ],
    )


def _share(rows: Sequence[MatchingRow], axis: matching_trials.Axis) -> Panel:
    plot = _plot(axis, PlotAxis((0.0, 105.0), "recognised, %"))
    plot.level(100.0 * RECOGNISED, "muted dashed")
    _draw(plot, rows, axis, lambda row: 100.0 * row.recognised)
    return Panel(f"{axis.name} (aided: {axis.aid})", plot, f"Share recognised against {axis.name}")


def _error(rows: Sequence[MatchingRow], axis: matching_trials.Axis) -> Panel:
    low, high = np.log10(ERROR_NODES)
    plot = _plot(axis, PlotAxis((float(low), float(high)), "error of the place, nodes", True))
    _draw(plot, rows, axis, lambda row: float(np.log10(max(row.error_nodes, 1e-6))))
    return Panel("", plot, f"Error of the place against {axis.name}, log scale")


def _plot(axis: matching_trials.Axis, y: PlotAxis) -> Plot:
    low, high = _place(axis, min(axis.values)), _place(axis, max(axis.values))
    margin = 0.05 * (high - low)
    name = "SNR of a pixel" if axis is matching_trials.NOISE else f"error, {axis.unit}"
    if axis.name == "off nadir":
        name = "angle, °"
    x = PlotAxis((low - margin, high + margin), name, axis is matching_trials.NOISE, axis.values)
    return Plot(x, y, width=WIDTH, height=HEIGHT)


def _place(axis: matching_trials.Axis, value: float) -> float:
    """Along x, where noise has a log scale."""
    return float(np.log10(value)) if axis is matching_trials.NOISE else value


def _draw(
    plot: Plot,
    rows: Sequence[MatchingRow],
    axis: matching_trials.Axis,
    y: Callable[[MatchingRow], float],
) -> None:
    """The tolerance that the source states, and every curve of an error."""
    plot.line((_place(axis, axis.stated),) * 2, plot.y, "s4 dashed thin")
    for name, aided, chosen in curves(rows, axis):
        across, up = [_place(axis, row.value) for row in chosen], [y(row) for row in chosen]
        series, shape = SIGNS[name]
        plot.line(across, up, f"{series} dashed" if aided else series)
        plot.marks(across, up, f"{series} hollow" if aided else series, shape)
