"""Picked points on a run's page: where they lie with their residuals, and errors of the places.

A narrow picture leaves the distance along its line of sight the least known: the ellipses, in the
plane of the vertical and of the horizontal part of that line, are long along it.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from markupsafe import Markup

from catalog.arrays import FloatArray
from catalog.geometry.vectors import perpendicular_basis, unit
from optnav_cli.fix import Fix, MatchKind, MatchRow, Solution
from optnav_cli.output.run_folder import RunFolder
from optnav_cli.report.page import figure, side_by_side
from optnav_cli.report.sheet import LegendEntry, Panel, draw_sheet
from optnav_cli.report.svg import HALF, Plot, PlotAxis

MAX_FRAMES = 6  # that are drawn; of more, evenly through the run
ENLARGED = 0.06  # of the longer side of the picture: the median residual's length as it is drawn
LONGEST = 0.25  # of that side: a blunder's residual would leave the picture
HEIGHT = 300
LEGEND = (
    LegendEntry("s1", "used", line=False),
    LegendEntry("s4", "not used", "cross", line=False),
    LegendEntry("s2", "residual, enlarged", ""),
    LegendEntry("s3", "3 stated sigmas", ""),
    LegendEntry("muted", "line of sight", ""),
)


@dataclass(frozen=True, eq=False)
class PickedFrame:
    """A solved frame, its fix, its points and the size of its picture."""

    solution: Solution
    fix: Fix
    points: list[MatchRow]
    size_px: tuple[float, float]


def is_picked(run: RunFolder) -> bool:
    """Whether a run has frames solved by picked points."""
    return bool(_collect_frames(run))


def plot_picked_points(run: RunFolder) -> list[Markup]:
    """Plot a map of the points and an ellipse for each of a few frames, for the page."""
    frames = _collect_frames(run)
    drawn = [panel.plot.svg(panel.description) for row in _plot_panels(frames) for panel in row]
    some = "" if len(frames) <= MAX_FRAMES else f" {MAX_FRAMES} of {len(frames)} frames."
    words = (
        "Left: picked points in the picture with their residuals, enlarged so that the median one "
        "has the same length everywhere. Right: 3 stated sigmas of the place, in the plane of the "
        f"vertical and the line of sight (thin, towards the points).{some}"
    )
    keys = {"k1": "used", "k4": "not used", "k2": "residuals", "k3": "3 sigmas"}
    return [figure(side_by_side("pair", drawn), words, keys)]


def draw_picked_sheet(run: RunFolder) -> str:
    """Draw the plots as one picture (SVG) that stands alone."""
    return draw_sheet("Picked points", LEGEND, _plot_panels(_collect_frames(run)))


def _collect_frames(run: RunFolder) -> list[PickedFrame]:
    frames = []
    for solution in run.solutions:
        points = [
            match
            for match in run.matches
            if match.file == solution.file
            and match.kind == MatchKind.PICKED_POINT
            and match.measured_px is not None
        ]
        camera = run.cameras.get(solution.file)
        fix = solution.outcome
        if not isinstance(fix, Fix) or not points or camera is None:
            continue
        size = float(camera.width_px), float(camera.height_px)
        frames.append(PickedFrame(solution, fix, points, size))
    return frames


def _plot_panels(frames: Sequence[PickedFrame]) -> list[list[Panel]]:
    count = min(len(frames), MAX_FRAMES)
    chosen = np.linspace(0, len(frames) - 1, count).round().astype(int)
    return [[_plot_map(frames[k]), _plot_ellipse(frames[k])] for k in chosen]


def _plot_map(frame: PickedFrame) -> Panel:
    """Plot the points in the picture and their residuals."""
    width, height = frame.size_px
    # rows of a picture count downwards
    axes = PlotAxis((0.0, width), "x, px"), PlotAxis((-height, 0.0), "-y, px")
    plot = Plot(*axes, width=HALF, height=HEIGHT, equal=True)
    plot.line([0.0, width, width, 0.0], [0.0, 0.0, -height, -height], "muted thin", closed=True)
    flip, longer = np.array([1.0, -1.0]), max(frame.size_px)
    residuals = [np.zeros(2) if p.residual_px is None else p.residual_px for p in frame.points]
    lengths = [float(np.hypot(*r)) for r, p in zip(residuals, frame.points, strict=True) if p.used]
    scale = ENLARGED * longer / max(float(np.median(lengths or [1.0])), 1e-6)
    for point, residual in zip(frame.points, residuals, strict=True):
        if point.measured_px is None:
            continue
        pixel, drawn = point.measured_px * flip, residual * flip * scale
        drawn = drawn * min(1.0, LONGEST * longer / max(float(np.hypot(*drawn)), 1e-9))
        end = pixel + drawn
        plot.line([pixel[0], end[0]], [pixel[1], end[1]], "s2")
        series, shape, size = ("s1", "circle", 3.2) if point.used else ("s4", "cross", 5.0)
        words = f"{point.name} {point.reason}".strip()
        plot.marks([pixel[0]], [pixel[1]], series, shape, size, [words])
    name = frame.solution.file
    return Panel(f"{name}, residuals x {scale:.0f}", plot, f"Picked points of {name}")


def _plot_ellipse(frame: PickedFrame) -> Panel:
    """Plot the error of the place, in the plane of the vertical and the line of sight."""
    up = unit(frame.fix.position_m)
    sight = np.mean([point.cp_position_m for point in frame.points], axis=0) - frame.fix.position_m
    level = sight - (sight @ up) * up
    if not np.linalg.norm(level) > 1e-6 * np.linalg.norm(sight):  # straight down
        level, _ = perpendicular_basis(up)
    plane = np.array([unit(level), up])
    values, vectors = np.linalg.eigh(plane @ frame.fix.covariance_m2 @ plane.T)
    angle = np.linspace(0.0, 2.0 * np.pi, 73)
    circle = np.stack([np.cos(angle), np.sin(angle)])
    outline = 3e-3 * (vectors * np.sqrt(np.maximum(values, 0.0))) @ circle
    reach = 1.15 * max(float(np.abs(outline).max()), 1e-6)
    axes = (
        PlotAxis((-reach, reach), "towards the points, km"),
        PlotAxis((-reach, reach), "up, km"),
    )
    plot = Plot(*axes, width=HALF, height=HEIGHT, equal=True)
    end: FloatArray = unit(plane @ sight) * reach
    plot.line([0.0, end[0]], [0.0, end[1]], "muted thin")
    plot.line(outline[0], outline[1], "s3", closed=True)
    plot.marks([0.0], [0.0], "s1", "circle")
    name = frame.solution.file
    return Panel("3 sigmas of the place", plot, f"Error ellipse of the place of {name}")
