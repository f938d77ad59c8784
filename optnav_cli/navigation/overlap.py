"""Templates that show the same ground: how much of their evidence and of their errors is shared.

Templates of a coarse catalog are wider than its points are apart, and patches of a small body that
hold what its model knows overlap in the frame: relief that the model does not know moves them
together.
"""

from collections.abc import Sequence

import cv2
import numpy as np

from catalog.arrays import BoolArray, FloatArray
from optnav_cli.matching.point_match import SeenPart

# Side of the grid on which parts of the frame are counted: a template spans dozens of its cells.
CELLS = 128


def footprints(parts: Sequence[SeenPart], frame_size_px: tuple[int, int]) -> BoolArray:
    """What each part covers of the frame, (n, CELLS, CELLS).

    frame_size_px  (width, height)
    """
    scale = CELLS / np.array(frame_size_px, dtype=np.float64)
    masks = np.zeros((len(parts), CELLS, CELLS), dtype=np.uint8)
    for mask, part in zip(masks, parts, strict=True):
        corners = np.rint((part.corners_px + 0.5) * scale - 0.5)
        if np.isfinite(corners).all():
            # far corners of an oblique template are cut where integers end
            cv2.fillConvexPoly(mask, np.clip(corners, -1e6, 1e6).astype(np.int32), 1)
    return masks.astype(bool)


def own_shares(masks: BoolArray) -> FloatArray:
    """(n,) share of each part's evidence that is its own: ground seen k times counts once."""
    times = masks.sum(axis=0)
    each = masks / np.maximum(times, 1)
    return np.asarray(each.sum(axis=(1, 2)) / np.maximum(masks.sum(axis=(1, 2)), 1))


def alikeness(masks: BoolArray) -> FloatArray:
    """(n, n) correlation of errors that ground brings: common ground over the mean of both."""
    flat = masks.reshape(len(masks), -1).astype(np.float64)
    size = np.sqrt(np.maximum(flat.sum(axis=1), 1.0))
    alike = (flat @ flat.T) / np.outer(size, size)
    np.fill_diagonal(alike, 1.0)
    return np.asarray(alike)


def ground_alikeness(places_m: FloatArray, widths_m: FloatArray) -> FloatArray:
    """(n, n) correlation of errors that ground brings, of templates at places (n, 3), body frame.

    widths_m  (n,) sides of the templates on the ground. Discs of their areas stand for them.
    """
    apart = np.linalg.norm(places_m[:, None] - places_m[None], axis=2)
    wider = np.maximum(widths_m[:, None], widths_m[None])
    narrower = np.minimum(widths_m[:, None], widths_m[None])
    t = np.minimum(apart / np.maximum((wider + narrower) / np.sqrt(np.pi), 1e-9), 1.0)
    common = 2.0 / np.pi * (np.arccos(t) - t * np.sqrt(1.0 - t * t))
    return np.asarray(common * narrower / wider)
