"""The peak of a correlation surface: sub-node place, covariance, best rival.

The surface near its peak is modelled as score - 1/2 d' H d. With the reference true up to gain
and the remainder of the image behaving as noise, the share of unexplained variance is
1 - score^2, and the covariance of the peak's place is (1 - score^2) / (score n_eff) H^-1, the
usual least-squares result written for correlation. n_eff counts independent samples: high-passed
terrain decorrelates over a few nodes, so it is far below the number of nodes.

That is quick and right for noise alone. Relief and albedo that a reference lacks are correlated
over many nodes: see `remainder`, which takes their spectrum from what the match leaves over.
"""

from typing import NamedTuple

import numpy as np

from catalog.arrays import Float32Array, FloatArray
from catalog.geometry.kernel import kernel

# Nodes of high-passed lunar relief that share one independent brightness error: fitted to the
# errors of 900 matches on simulated frames, with scores from 0.4 to 0.97.
NODES_PER_SAMPLE = 1.6
# A rival nearer than this many nodes is the same peak.
RIVAL_DISTANCE = 5


class Match(NamedTuple):
    """Where a reference was found in a search grid.

    dx, dy      offset of the reference's centre from the search grid's centre, nodes;
                x along columns (east), y along rows (south)
    score       correlation at the peak, -1..1
    runner_up   the best score away from the peak, -1 when the search leaves no room for one
    covariance  (2, 2) of (dx, dy), nodes^2, from the curvature of the peak
    """

    dx: float
    dy: float
    score: float
    runner_up: float
    covariance: FloatArray


# Least-squares quadratic over a 3 x 3 neighbourhood: rows give 1, x, y, x^2, xy, y^2.
_X, _Y = np.meshgrid([-1.0, 0.0, 1.0], [-1.0, 0.0, 1.0])
_QUADRATIC = np.linalg.pinv(
    np.stack([g.ravel() for g in (np.ones((3, 3)), _X, _Y, _X**2, _X * _Y, _Y**2)], axis=1)
)


def locate_peak(surface: Float32Array, nodes: int) -> Match:
    """Find the best place of a correlation surface.

    surface  (rows, cols)  score at integer offsets; the middle element is offset zero
             (both sides odd)
    nodes    how many nodes of the reference took part
    Returns the match; a peak on the surface's border has an infinite covariance, for it is no
    peak: the true place may lie outside.
    """
    row, col = divmod(int(surface.argmax()), surface.shape[1])
    dx, dy, best, runner_up, xx, xy, yy = _fit_peak(np.ascontiguousarray(surface), row, col)
    covariance = np.array([[xx, xy], [xy, yy]])
    if np.isfinite(xx):
        samples = max(nodes / NODES_PER_SAMPLE, 1.0)
        covariance *= max(1.0 - best * best, 0.0) / (max(best, 0.05) * samples)
    rows, cols = surface.shape
    return Match(dx - cols // 2, dy - rows // 2, best, runner_up, covariance)


@kernel
def _fit_peak(
    surface: Float32Array, row: int, col: int
) -> tuple[float, float, float, float, float, float, float]:
    """Sub-node place (x, y) of the peak at (row, col), its score, the runner-up, H^-1 (xx, xy, yy).

    H^-1 is that of `locate_peak`'s model; diagonal and infinite where the peak is none.
    """
    rows, cols = surface.shape
    best = float(surface[row, col])
    runner_up = _find_runner_up(surface, row, col)
    none = float(col), float(row), best, runner_up, np.inf, 0.0, np.inf
    if not (0 < row < rows - 1 and 0 < col < cols - 1):
        return none
    fit = np.zeros(6)
    for k in range(9):
        score = float(surface[row - 1 + k // 3, col - 1 + k % 3])
        for i in range(6):
            fit[i] += _QUADRATIC[i, k] * score
    gx, gy = fit[1], fit[2]
    xx, xy, yy = -2.0 * fit[3], -fit[4], -2.0 * fit[5]
    determinant = xx * yy - xy * xy
    if xx <= 0.0 or determinant <= 1e-12:
        return none
    xx, xy, yy = yy / determinant, -xy / determinant, xx / determinant
    # the true peak of a sampled surface lies within a node of its largest sample
    x = min(max(xx * gx + xy * gy, -0.75), 0.75)
    y = min(max(xy * gx + yy * gy, -0.75), 0.75)
    return col + x, row + y, best, runner_up, xx, xy, yy


@kernel
def _find_runner_up(surface: Float32Array, row: int, col: int) -> float:
    """Highest local maximum at least RIVAL_DISTANCE nodes from the peak; its slope is no rival."""
    rows, cols = surface.shape
    best = -1.0
    for r in range(1, rows - 1):
        for c in range(1, cols - 1):
            here = surface[r, c]
            if (
                here > best
                and max(abs(r - row), abs(c - col)) > RIVAL_DISTANCE
                and here >= surface[r - 1, c]
                and here >= surface[r + 1, c]
                and here >= surface[r, c - 1]
                and here >= surface[r, c + 1]
            ):
                best = float(here)
    return best
