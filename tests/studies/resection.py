"""How well control points can fix a camera: errors against their number and intersection angle.

Reproduces the behaviour that Zhukov (2025), ch. 3, reports: with the attitude measured apart the
horizontal error falls with the number of points and stays below the points' own error, the height
error grows fast below 20 degrees of intersection angle; solving the attitude from four points too
makes the horizontal error about four times larger at 80 degrees and over ten times at 40.

Every trial is solved by the navigator's own resection from noisy sightings; errors are counted
against the truth, not read from the covariance.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np
from scipy.spatial.transform import Rotation

from catalog.arrays import FloatArray
from catalog.errors import NoSolutionError
from catalog.progress import Progress
from optnav_cli.camera.camera import Camera
from optnav_cli.estimation.models.points import Pose, Sightings, predict
from optnav_cli.estimation.resection import resect
from optnav_cli.report.sheet import LegendEntry, Panel, draw_sheet
from optnav_cli.report.svg import Plot, PlotAxis
from tests.studies.tables import StudyReport, StudyTable, columns, rms

HEIGHT_M = 200e3
RADIUS_M = 1_737_400.0
POINT_SIGMA_M = 50.0
COUNTS = (2, 4, 8, 16, 32)
ANGLES_DEG = (5.0, 10.0, 20.0, 40.0, 80.0)
MIDDLE_ANGLE_DEG = 40.0  # at which the picture shows errors against the number of points
SERIES = ("s4", "s1", "s2", "s3", "s5")  # by number of points
SHAPES = ("down", "circle", "triangle", "square", "diamond")
CAMERA = Camera("ideal", "pinhole", 8000, 8000, 4000.0, (3999.5, 3999.5))
# straight down: camera x east, y south, z into the ground
CAMERA_FROM_LOCAL = np.array([[1.0, 0.0, 0.0], [0.0, -1.0, 0.0], [0.0, 0.0, -1.0]])


@dataclass(frozen=True)
class ResectionRow:
    """Errors of one geometry, rms over the trials, in units of the control points' own sigma."""

    count: int
    angle_deg: float
    free_attitude: bool
    horizontal: float
    height: float


def run(progress: Progress, trials: int = 300, seed: int = 1) -> list[ResectionRow]:
    """All geometries: with the attitude exact, and free with four points and more."""
    cases = [(n, a, False) for n, a in product(COUNTS, ANGLES_DEG)]
    cases += [(n, a, True) for n, a in product(COUNTS, ANGLES_DEG) if n >= 4]
    rows = []
    with progress.stage("resection", len(cases), "geometry") as bar:
        for count, angle, free in cases:
            rows.append(one_geometry(count, angle, free, trials, seed))
            bar.advance()
    return rows


def one_geometry(
    count: int, angle_deg: float, free_attitude: bool, trials: int, seed: int
) -> ResectionRow:
    """Rms errors over `trials` random draws of points and noise."""
    rng = np.random.default_rng([seed, count, int(angle_deg), int(free_attitude)])
    truth = Pose(np.array([0.0, 0.0, HEIGHT_M]), Rotation.from_matrix(CAMERA_FROM_LOCAL))
    errors = []
    for _ in range(trials):
        points = _ring_and_inside(rng, count, angle_deg)
        pixels, jacobian = predict(CAMERA, truth, points)
        # the points' error on the ground, as it shows in the picture
        pixel_per_metre = -jacobian[:, :, :3]
        covariance = pixel_per_metre @ np.swapaxes(pixel_per_metre, 1, 2) * POINT_SIGMA_M**2
        shift = rng.normal(0.0, POINT_SIGMA_M, (count, 3))
        pixels += np.einsum("nij,nj->ni", pixel_per_metre, shift)
        seen = Sightings(points, pixels, covariance)
        try:
            solution = resect(CAMERA, seen, truth, None if free_attitude else 0.0)
        except NoSolutionError:
            continue
        errors.append(solution.state.position_m - truth.position_m)
    found = np.array(errors) / POINT_SIGMA_M
    horizontal = float(np.sqrt((found[:, :2] ** 2).sum(axis=1).mean() / 2.0))
    return ResectionRow(count, angle_deg, free_attitude, horizontal, rms(found[:, 2]))


def report(rows: Sequence[ResectionRow]) -> StudyReport:
    """Two tables: rows by the number of points, columns by intersection angle."""
    angles = "; ".join(
        "; ".join(f"{x}_{a:g}_deg = {x} [σ, {a:g}°] .2f" for x in ("horizontal", "height"))
        for a in ANGLES_DEG
    )
    heads = columns(f"points; {angles}")
    tables = []
    for free in (False, True):
        chosen = [row for row in rows if row.free_attitude == free]
        lines = []
        for count in sorted({row.count for row in chosen}):
            cells = [row for row in chosen if row.count == count]
            errors = (error for cell in cells for error in (cell.horizontal, cell.height))
            lines.append((count, *errors))
        title = (
            f"attitude {'free' if free else 'known'}: horizontal (a component) and height error, "
            "point sigmas, by intersection angle"
        )
        tables.append(StudyTable(title, heads, tuple(lines)))
    known = {(r.count, r.angle_deg): r.horizontal for r in rows if not r.free_attitude}
    notes = [
        f"4 points, {row.angle_deg:.0f}°: free attitude makes the horizontal error "
        f"{row.horizontal / known[row.count, row.angle_deg]:.1f} times larger"
        for row in rows
        if row.free_attitude and row.count == 4 and row.angle_deg in (40.0, 80.0)
    ]
    return StudyReport(tuple(tables), tuple(notes))


def picture(rows: list[ResectionRow]) -> str:
    """The errors as curves (SVG): against the angle, and against the number of points."""
    legend = [
        LegendEntry(series, f"{count} points", shape)
        for series, shape, count in zip(SERIES, SHAPES, COUNTS, strict=True)
    ]
    legend.append(LegendEntry("muted dashed", "error of one point", ""))
    panels = []
    for free in (False, True):
        chosen = [row for row in rows if row.free_attitude == free]
        attitude = "attitude free" if free else "attitude known"
        reach = (0.05, 1000.0) if free else (0.05, 100.0)
        row = [_against_angle(chosen, name, attitude, reach) for name in ("horizontal", "height")]
        panels.append([*row, _against_number(chosen, attitude, reach)])
    return draw_sheet(
        "Error of a position from control points, in sigmas of a point", legend, panels
    )


def _against_angle(
    rows: list[ResectionRow], component: str, attitude: str, reach: tuple[float, float]
) -> Panel:
    plot = _plot(ANGLES_DEG, reach, "intersection angle, °")
    for series, shape, count in zip(SERIES, SHAPES, COUNTS, strict=True):
        points = [row for row in rows if row.count == count]
        angles, errors = [r.angle_deg for r in points], [getattr(r, component) for r in points]
        _curve(plot, angles, errors, series, shape)
    name = "horizontal, a component" if component == "horizontal" else "height"
    text = f"Error {component} against angle, {attitude}, log scales"
    return Panel(f"{name}, {attitude}", plot, text)


def _against_number(rows: list[ResectionRow], attitude: str, reach: tuple[float, float]) -> Panel:
    plot = _plot(COUNTS, reach, f"points, {MIDDLE_ANGLE_DEG:g}° between the outermost")
    points = [row for row in rows if row.angle_deg == MIDDLE_ANGLE_DEG]
    numbers = [float(row.count) for row in points]
    for shape, words in (("square", "height"), ("circle", "horizontal")):
        values = [getattr(row, words) for row in points]
        _curve(plot, numbers, values, "muted", shape)
        # the larger of the two carries its name above, so that no line runs through it
        above = words == ("horizontal" if "free" in attitude else "height")
        lift = 0.15 if above else -0.45
        plot.text(np.log10(numbers[0]), np.log10(values[0]) + lift, words)
    text = f"Errors against number, {attitude}, log scales"
    return Panel(f"against the number, {attitude}", plot, text)


def _plot(x: Sequence[float], reach: tuple[float, float], label: str) -> Plot:
    ends = np.log10([min(x), max(x)]) + [-0.08, 0.08]
    low, high = np.log10(reach)
    x_axis = PlotAxis((float(ends[0]), float(ends[1])), label, True, x)
    y_axis = PlotAxis((float(low), float(high)), "error, point sigmas", True)
    plot = Plot(x_axis, y_axis, width=330, height=260)
    plot.level(0.0, "muted dashed")
    return plot


def _curve(plot: Plot, x: Sequence[float], y: Sequence[float], series: str, shape: str) -> None:
    plot.line(np.log10(x), np.log10(y), series)
    plot.marks(np.log10(x), np.log10(y), series, shape)


def _ring_and_inside(rng: np.random.Generator, count: int, angle_deg: float) -> FloatArray:
    """Points on a rough sphere, two of them the intersection angle apart, the others between.

    Four points stand at the corners of the field, as a chooser of control points would take them.
    """
    half = np.radians(angle_deg / 2.0)
    turn = rng.uniform(0.0, 2.0 * np.pi)
    azimuth = turn + np.arange(count) * (2.0 * np.pi / min(count, 4))
    off = np.full(count, half)
    if count > 4:
        off[4:] = half * np.sqrt(rng.uniform(0.0, 1.0, count - 4))
        azimuth[4:] = rng.uniform(0.0, 2.0 * np.pi, count - 4)
    directions = np.stack(
        [np.sin(off) * np.cos(azimuth), np.sin(off) * np.sin(azimuth), -np.cos(off)], axis=1
    )
    # onto the sphere whose top is the origin below the camera
    centre = np.array([0.0, 0.0, -RADIUS_M])
    origin = np.array([0.0, 0.0, HEIGHT_M]) - centre
    along = directions @ origin
    distance = -along - np.sqrt(along**2 - (origin @ origin - RADIUS_M**2))
    points: FloatArray = np.array([0.0, 0.0, HEIGHT_M]) + directions * distance[:, None]
    points[:, 2] += rng.normal(0.0, 1000.0, count)
    return points
