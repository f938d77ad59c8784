"""How the ship moves about each frame of a route: what a clock's offset shifts.

Velocities come from the stated positions of the frame and its neighbours by a parabola through the
three: for frames 10 s apart in a low lunar orbit it errs by 0.3 m/s, 0.03 m over an offset of
80 ms, beside what the positions' own errors make (10 m: 1 m/s, 0.1 m). The ship is taken to keep
its attitude to the local vertical, as one that looks down does.
"""

from collections.abc import Sequence

import numpy as np

from catalog.arrays import FloatArray
from optnav_cli.calibration.model import FrameMotion

MAX_GAP_S = 120.0  # between neighbours: beyond, a parabola errs by metres a second


def estimate_frame_motions(
    times_s: Sequence[float], positions_m: Sequence[FloatArray | None]
) -> list[FrameMotion | None]:
    """Estimate the motion about each frame; None where two neighbours near in time are missing.

    times_s      of the frames, in any order
    positions_m  (3,) as stated, body frame; None where not
    """
    order = [int(n) for n in np.argsort(times_s, kind="stable") if positions_m[n] is not None]
    motions: list[FrameMotion | None] = [None] * len(times_s)
    for here, number in enumerate(order):
        near = _find_neighbours(order, here, times_s)
        if len(near) < 3:
            continue
        after = np.array([times_s[n] - times_s[number] for n in near])
        places = np.array([positions_m[n] for n in near], dtype=np.float64)
        velocity = np.linalg.solve(np.vander(after, 3, increasing=True), places)[1]
        position = np.asarray(positions_m[number], dtype=np.float64)
        motions[number] = FrameMotion(
            velocity, np.cross(position, velocity) / float(position @ position)
        )
    return motions


def _find_neighbours(order: Sequence[int], here: int, times_s: Sequence[float]) -> list[int]:
    """Find three frames about one without a gap between them; fewer where there are not so many."""
    for first in (here - 1, here - 2, here):
        if first < 0 or first + 3 > len(order):
            continue
        chosen = list(order[first : first + 3])
        gaps = np.diff([times_s[n] for n in chosen])
        if gaps.min() > 0.0 and gaps.max() <= MAX_GAP_S:
            return chosen
    return []
