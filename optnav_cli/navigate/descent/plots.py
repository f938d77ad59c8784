"""A descent's errors over the height with bands of 3 stated sigmas, its windows and landmarks."""

import numpy as np
from markupsafe import Markup

from catalog.arrays import FloatArray
from optnav_cli.fix import Method
from optnav_cli.output.run_folder import RunFolder
from optnav_cli.report.error_plots import AXES, collect_frames
from optnav_cli.report.page import figure, side_by_side
from optnav_cli.report.svg import NARROW, WIDE, Plot, PlotAxis, find_span

HEIGHT = "height above the reference sphere, km"
COUNTS = (("n_windows", "s1"), ("n_landmarks", "s3"))


def is_descent(run: RunFolder) -> bool:
    """Whether a run has frames of a descent."""
    return any(
        solution.method in (Method.DESCENT, Method.RELATIVE_LANDMARKS) for solution in run.solutions
    )


def draw_descent(run: RunFolder, stated: bool = False) -> list[Markup]:
    """Draw errors along R, N, B over height, or stated sigmas without a truth; and counts.

    stated  as for `error_plots`, of which the errors raised are the same
    """
    frames = collect_frames(run, stated)
    heights = frames.heights_km
    shown = frames.error if frames.compared else frames.sigma
    known = np.isfinite(heights) & np.isfinite(shown).all(axis=1)
    order = np.flatnonzero(known)[np.argsort(heights[known])]
    if order.size == 0:
        return []
    x, values, bound = heights[order], shown[order], 3.0 * frames.sigma[order]
    drawings = []
    for kind, width in (("wider", WIDE), ("narrow", NARROW)):
        plots = [
            _draw_errors(x, values[:, axis], bound[:, axis], AXES[axis][0], frames.compared, width)
            for axis in range(3)
        ]
        plots.append(_draw_counts(run, width))
        drawings.append(side_by_side(kind, plots))
    what = "Solution minus truth over the height; bands are 3 stated sigmas"
    if not frames.compared:
        what = "Stated sigmas over the height"
    keys = {"k1": "windows", "k3": "landmarks"}
    return [figure(Markup().join(drawings), f"{what}; what each frame's solution keeps.", keys)]


def _draw_errors(
    x: FloatArray, values: FloatArray, bound: FloatArray, letter: str, compared: bool, width: int
) -> Markup:
    low, high = (-bound, bound) if compared else (np.zeros_like(values), values)
    y = find_span(np.concatenate([values, low, high]), 0.08)
    label = f"{letter}, m" if compared else f"sigma {letter}, m"
    plot = Plot(PlotAxis(find_span(x, 0.03), ""), PlotAxis(y, label), width=width, height=190)
    if compared and len(x) > 1:
        plot.band(x, low, high, "s1")
        plot.level(0.0)
    plot.marks(x, values, "s1", "circle")
    outside = np.abs(values) > bound
    if compared and outside.any():
        plot.marks(x[outside], values[outside], "s4", "circle", 4.2)
    return plot.svg(f"{'Error' if compared else 'Stated sigma'} along {letter} over the height")


def _draw_counts(run: RunFolder, width: int) -> Markup:
    """Draw the windows and landmarks that each frame's solution keeps, over its height."""
    radius = run.attitude.body.radius_m
    solved = [s for s in run.solutions if s.position_m is not None]
    places = [s.position_m for s in solved if s.position_m is not None]
    x = np.array([float(np.linalg.norm(position)) - radius for position in places])
    x = x / 1e3
    counts = {name: np.array([getattr(s, name) or 0 for s in solved]) for name, _ in COUNTS}
    most = max(float(values.max(initial=1)) for values in counts.values())
    axes = PlotAxis(find_span(x, 0.03), HEIGHT), PlotAxis((0.0, 1.1 * most), "kept")
    plot = Plot(*axes, width=width, height=190)
    for name, series in COUNTS:
        plot.marks(x, counts[name], series, "circle")
    return plot.svg("Windows and landmarks over the height")
