"""How much limb a horizon needs: errors against the arc in view and the correlation of its errors.

Zhukov (2025), ch. 2, states for a sphere, in units of the error delta of one limb point: errors of
the direction to the centre and of the angular radius of 0.01-1 delta at arcs of 180-360 degrees
for correlation intervals of 0.01-10 degrees, 0.1-3 delta at 100 degrees, and tens to hundreds of
delta below. So 100 degrees of limb are the least that a solution should rest on.

Points stand every 0.01 degrees along the arc. Their errors are normal and correlated as
exp(-distance / interval) along the limb, as relief makes them. The fit is the navigator's own, and
beside it the linear one (e . s = 1) that the seed solves. Errors are counted against the truth.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from catalog.arrays import FloatArray
from catalog.errors import NoSolutionError
from catalog.progress import Progress
from optnav_cli.outline.limb.model import fit_limb, solve_linear_position
from optnav_cli.report.sheet import LegendEntry, Panel, draw_sheet
from optnav_cli.report.svg import Plot, PlotAxis
from tests.studies.tables import StudyReport, StudyTable, columns, rms

RADIUS_M = 1_737_400.0
STEP_DEG = 0.01
ROUND = round(360.0 / STEP_DEG)  # points of a whole limb
DELTA_RAD = np.radians(1.0 / 60.0)
ARCS_DEG = (360.0, 300.0, 240.0, 180.0, 150.0, 120.0, 100.0, 80.0, 60.0, 40.0, 30.0, 20.0)
INTERVALS_DEG = (0.01, 0.1, 1.0, 10.0)
FITS = {"navigator's": "fit", "linear": "linear"}
COMPARED_DEG = 0.01  # the interval at which the two fits are drawn side by side
SERIES, SHAPES = ("s1", "s3", "s2", "s4"), ("circle", "triangle", "square", "diamond")


@dataclass(frozen=True)
class ArcRow:
    """Errors of one arc and interval, rms over the trials, in units of delta.

    direction  angle between the true and the found direction to the centre
    radius     angular radius of the body;  radius_bias its mean
    unsolved   share of trials without an answer
    """

    fit: str
    arc_deg: float
    interval_deg: float
    direction: float
    radius: float
    radius_bias: float
    unsolved: float


def run(
    progress: Progress, trials: int = 100, height_km: float = 200.0, seed: int = 1
) -> list[ArcRow]:
    """All arcs, intervals and both fits, of the Moon's sphere seen from a height."""
    rows = []
    with progress.stage("arc", len(ARCS_DEG) * len(INTERVALS_DEG), "case") as bar:
        for interval in INTERVALS_DEG:
            rng = np.random.default_rng([seed, round(interval / STEP_DEG)])
            drawn = limb_errors(rng, interval, trials)
            for arc in ARCS_DEG:
                rows += one_arc(arc, interval, height_km, drawn)
                bar.advance()
    return rows


def one_arc(
    arc_deg: float, interval_deg: float, height_km: float, errors: Sequence[FloatArray]
) -> list[ArcRow]:
    """Both fits of one arc; `errors` (ROUND,) of a whole limb's points, in units of delta."""
    sine = RADIUS_M / (RADIUS_M + height_km * 1e3)
    chi = float(np.arcsin(sine))
    count = round(arc_deg / STEP_DEG)
    azimuth = np.radians(STEP_DEG) * np.arange(count)
    radii = np.full(3, RADIUS_M)
    found: dict[str, list[FloatArray]] = {name: [] for name in FITS}
    for error in errors:
        angle = chi + DELTA_RAD * error[:count]
        across = np.sin(angle)
        rays = np.stack(
            [across * np.cos(azimuth), across * np.sin(azimuth), -np.cos(angle)], axis=1
        )
        for name in FITS:
            try:
                if name == "linear":
                    found[name].append(solve_linear_position(rays, radii))
                else:
                    found[name].append(fit_limb(rays, DELTA_RAD, radii).state)
            except NoSolutionError:
                continue
    rows = []
    for name in FITS:
        places = np.array(found[name]).reshape(-1, 3)
        # the camera truly stands on +z
        off = np.arctan2(np.hypot(places[:, 0], places[:, 1]), places[:, 2]) / DELTA_RAD
        radius = (np.arcsin(RADIUS_M / np.linalg.norm(places, axis=1)) - chi) / DELTA_RAD
        bias = float(radius.mean()) if len(radius) else np.nan
        unsolved = 1.0 - len(places) / len(errors)
        rows.append(ArcRow(name, arc_deg, interval_deg, rms(off), rms(radius), bias, unsolved))
    return rows


def limb_errors(rng: np.random.Generator, interval_deg: float, count: int) -> list[FloatArray]:
    """`count` times the errors (ROUND,) of unit variance around a limb, correlated along it."""
    apart = STEP_DEG * np.minimum(np.arange(ROUND), ROUND - np.arange(ROUND))
    # a correlation on a circle: its spectrum is not negative but for rounding
    power = np.maximum(np.fft.rfft(np.exp(-apart / interval_deg)).real, 0.0)
    amplitude = np.sqrt(power)
    return [
        np.asarray(np.fft.irfft(np.fft.rfft(rng.normal(size=ROUND)) * amplitude, ROUND))
        for _ in range(count)
    ]


def report(rows: Sequence[ArcRow]) -> StudyReport:
    """A table a fit: rows by arc, columns by interval."""
    intervals = "; ".join(
        "; ".join(f"{x}_{c:g}_deg = {x} [σ, {c:g}°] .3g" for x in ("direction", "radius"))
        for c in INTERVALS_DEG
    )
    heads = columns(f"arc_deg = arc [°] .0f; {intervals}; unsolved [%] .0f")
    tables = []
    for fit in FITS:
        lines = []
        for arc in ARCS_DEG:
            cells = [r for r in rows if r.fit == fit and r.arc_deg == arc]
            errors = (error for c in cells for error in (c.direction, c.radius))
            lines.append((arc, *errors, 100.0 * max(cell.unsolved for cell in cells)))
        title = (
            f"{fit} fit: errors of direction and angular radius, in sigmas of one point, "
            "by the interval over which points' errors are correlated"
        )
        tables.append(StudyTable(title, heads, tuple(lines)))
    return StudyReport(tuple(tables))


def picture(rows: Sequence[ArcRow]) -> str:
    """The errors as curves (SVG)."""
    own = [row for row in rows if row.fit == next(iter(FITS))]
    legend = [
        LegendEntry(series, f"errors correlated over {interval:g}°", shape)
        for series, shape, interval in zip(SERIES, SHAPES, INTERVALS_DEG, strict=True)
    ]
    legend.append(LegendEntry("muted dashed", "error of one point", ""))
    legend.append(LegendEntry("s1 dashed", f"linear fit, {COMPARED_DEG:g}°", ""))
    linear = [r for r in rows if r.fit == "linear" and r.interval_deg == COMPARED_DEG]
    panels = []
    for name, quantity in (("direction to the centre", "direction"), ("angular radius", "radius")):
        panels.append(_panel(own, name, quantity))
        x, y = [r.arc_deg for r in linear], [getattr(r, quantity) for r in linear]
        panels[-1].plot.line(x, np.log10(y), "s1 dashed")
    return draw_sheet(
        "Errors of a horizon by its arc in view, in sigmas of a point", legend, [panels]
    )


def _panel(rows: Sequence[ArcRow], name: str, quantity: str) -> Panel:
    x_numbers = (20, 60, 100, 150, 180, 240, 300, 360)
    x_axis = PlotAxis((10.0, 370.0), "arc of limb, °", numbers=x_numbers)
    y_axis = PlotAxis((-2.5, 3.0), "error, point sigmas", log=True)
    plot = Plot(x_axis, y_axis, width=480, height=340)
    plot.level(0.0, "muted dashed")
    for series, shape, interval in zip(SERIES, SHAPES, INTERVALS_DEG, strict=True):
        chosen = [row for row in rows if row.interval_deg == interval]
        x = [row.arc_deg for row in chosen]
        y = np.log10([getattr(row, quantity) for row in chosen])
        plot.line(x, y, series)
        plot.marks(x, y, series, shape)
    return Panel(name, plot, f"Error of the {name} against the arc, log scale")
