"""A piece of ground under one Sun, ready to be looked at from anywhere."""

import numpy as np
from numpy.typing import ArrayLike

from catalog.arrays import ByteArray, Float32Array, FloatArray
from catalog.geometry.vectors import unit
from catalog.photometry.hapke import LUNAR, HapkeParameters
from catalog.rendering.rays.ground import Ground, surroundings
from catalog.rendering.rays.light import BLOCK, light_blocks, shade_blocks
from catalog.rendering.rays.picture import (
    add_with_neighbours,
    first_hits,
    mark_blocks,
    mean_radiance,
)
from catalog.rendering.rays.trace import FINE, WIDE

SHADOW_REACH = 0.06  # rad


class Scene:
    """Nested grounds under one Sun. What is in shadow is worked out once, where it is looked at.

    fine      the ground inside its box
    wide      the ground outside it; see `ground.whole_sphere`
    sun_body  (3,) direction to the Sun, body frame, any length
    between   a coarser grid around `fine` that only casts shadows on it
    surface   Hapke's parameters
    """

    def __init__(
        self,
        fine: Ground,
        wide: Ground,
        sun_body: ArrayLike,
        between: Ground | None = None,
        surface: HapkeParameters = LUNAR,
    ) -> None:
        self.fine, self.wide, self.surface = fine, wide, surface
        self.sun = unit(sun_body)
        # mountains beyond the fine ground's border shade it from as far as this, about 100 km
        self._around = surroundings(wide, fine, SHADOW_REACH)
        self.between = self._around if between is None else between
        self._fine_lit, self._fine_wanted = _masks(fine)
        self._wide_lit, self._wide_wanted = _masks(wide)

    def picture(
        self, origin_m: ArrayLike, corner_rays: ArrayLike, samples: int = 5, limb_samples: int = 5
    ) -> Float32Array:
        """Mean radiance factor (rows, cols) of the pixels of a camera.

        origin_m     (3,) the camera, body frame, m
        corner_rays  (rows + 1, cols + 1, 3) unit rays through the pixels' corners, body frame; NaN
                     where the camera sees nothing
        samples      most rays a side of a pixel
        limb_samples rays a side of a pixel at the limb

        Rays inside a pixel lie between those of its corners, 3e-4 px from the exact ones in a
        fisheye of 316 arcsec a pixel.
        """
        origin = np.ascontiguousarray(origin_m, dtype=np.float64)
        corners = np.ascontiguousarray(corner_rays, dtype=np.float64)
        shape = corners.shape[0] - 1, corners.shape[1] - 1
        kind = np.zeros(shape, np.uint8)
        distance, row, col = (np.zeros(shape, np.float32) for _ in range(3))
        first_hits(self.fine, self.wide, origin, corners, kind, distance, row, col)

        mark_blocks(WIDE, kind, row, col, self._wide_wanted)
        light_blocks(self.wide, self.wide, self.wide, self.sun, self._wide_wanted, self._wide_lit)
        wanted = np.zeros_like(self._fine_wanted)
        mark_blocks(FINE, kind, row, col, wanted)
        shaded = np.full(self.fine.heights.shape, np.nan, np.float32)
        out = np.full(shape, np.nan, np.float32)
        while True:
            self._shade(wanted, origin, shaded)
            missing = np.zeros_like(wanted)
            mean_radiance(
                self.fine, self.wide, origin, corners, kind, distance, row, col, shaded,
                self._wide_lit, self.sun, self.surface, samples, limb_samples, missing, out,
            )  # fmt: skip
            # between the middles of pixels a few rays find ground that these did not see
            if not missing.any():
                return out
            done = wanted.astype(bool)
            add_with_neighbours(missing, wanted)
            wanted[done] = 0

    def _shade(self, wanted: ByteArray, origin: FloatArray, shaded: Float32Array) -> None:
        # blocks that an earlier picture lit stay lit
        self._fine_wanted[(wanted == 1) & (self._fine_wanted == 0)] = 1
        light_blocks(
            self.fine, self.between, self._around, self.sun, self._fine_wanted, self._fine_lit
        )
        shade_blocks(self.fine, self.sun, origin, self.surface, wanted, self._fine_lit, shaded)


def _masks(ground: Ground) -> tuple[ByteArray, ByteArray]:
    """Lit shares of the nodes and the state of their blocks, both empty."""
    rows, cols = ground.heights.shape
    blocks = (rows + BLOCK - 1) // BLOCK, (cols + BLOCK - 1) // BLOCK
    return np.zeros((rows, cols), np.uint8), np.zeros(blocks, np.uint8)
