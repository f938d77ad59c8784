"""Limb points as rays in the body frame, with what a pixel is worth at each."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from catalog.arrays import BoolArray, FloatArray, IntArray
from catalog.errors import NoSolutionError
from catalog.terrain.skyline.limb import nadir_axes
from optnav_cli.camera.camera import Camera
from optnav_cli.measurements.limb.detection import LimbPoints
from optnav_cli.reasons import ReasonCode


@dataclass(frozen=True, eq=False)
class HorizonFix:
    """A camera position from limb points.

    position_m       (3,)   body frame
    covariance_m2    (3, 3)
    arc_deg          azimuth about the nadir that the used points cover
    residual_rms_px  across the limb, of the used points
    residuals_px     (n_points,) of each, positive away from the body; NaN of those left out
    n_points         offered
    n_used           kept: lit by the relief, and not outvoted
    terrain          whether the relief's skyline was the model, or the bare ellipsoid
    passes           over the relief's skyline; 0 without it
    remark           what a reader should know; empty when nothing
    """

    position_m: FloatArray
    covariance_m2: FloatArray
    arc_deg: float
    residual_rms_px: float
    residuals_px: FloatArray
    n_points: int
    n_used: int
    terrain: bool
    passes: int
    remark: str


ARC_BIN_DEG = 2.0
MIN_ARC_DEG = 100.0  # below it errors grow tens to hundreds of times (Zhukov 2025, ch. 2)
# What a single edge keeps of light and slope that no model has.
EDGE_NOISE_PX = 0.05


@dataclass(frozen=True, eq=False)
class LimbRays:
    """Rays to the limb.

    rays         (n, 3) unit, body frame
    pixel_angle  (n,)   rad a pixel across the limb
    sigma_px     (n,)   stated error of each point, its own
    blur         rad    sigma of what one point averages along the limb
    common_px    sigma of an edge error that all points share
    numbers      (n,)   of the limb points among those that were found
    """

    rays: FloatArray
    pixel_angle: FloatArray
    sigma_px: FloatArray
    blur: float
    common_px: float
    numbers: IntArray

    def __len__(self) -> int:
        return len(self.rays)

    def own_sigmas(self) -> FloatArray:
        """(n,) rad, error of each point that is its own."""
        return np.asarray(np.hypot(self.sigma_px, EDGE_NOISE_PX) * self.pixel_angle)

    def azimuths(self, position: FloatArray) -> FloatArray:
        """(n,) rad about the nadir of a position (3,), as `nadir_axes` counts them."""
        x, y, _ = nadir_axes(position) @ self.rays.T
        return np.asarray(np.arctan2(y, x))

    def subset(self, kept: BoolArray) -> "LimbRays":
        """The rays of a mask."""
        return LimbRays(
            self.rays[kept],
            self.pixel_angle[kept],
            self.sigma_px[kept],
            self.blur,
            self.common_px,
            self.numbers[kept],
        )


def limb_rays_of(points: LimbPoints, camera: Camera, camera_from_body: Rotation) -> LimbRays:
    """Rays of limb points. Raises NoSolutionError when the lens has none for them."""
    rays = camera.unproject(points.pixels)
    nearby = camera.unproject(points.pixels + points.inward)
    seen = np.isfinite(rays).all(axis=1) & np.isfinite(nearby).all(axis=1)
    if not seen.any():
        raise NoSolutionError(
            "the lens has no ray for any of the limb points", ReasonCode.BAD_PICTURE
        )
    angle = np.linalg.norm(np.cross(rays[seen], nearby[seen]), axis=1)
    return LimbRays(
        camera_from_body.apply(rays[seen], inverse=True),
        angle,
        points.sigma_px[seen],
        points.blur_px * float(np.median(angle)),
        points.common_sigma_px,
        np.flatnonzero(seen),
    )


def arc_deg(azimuths: FloatArray) -> float:
    """Azimuth, in degrees, that points (rad) cover, in steps of about ARC_BIN_DEG.

    The few points of a small disc lie further apart: their steps are wide enough to hold one each.
    """
    gaps = np.diff(np.sort(np.degrees(azimuths)))
    wide = max(ARC_BIN_DEG, 1.5 * float(np.median(gaps))) if gaps.size else ARC_BIN_DEG
    count = max(round(360.0 / wide), 1)
    bins = np.floor(azimuths * (count / (2.0 * np.pi))).astype(np.int64)
    return float(np.unique(np.mod(bins, count)).size * (360.0 / count))


def require_arc(arc: float) -> float:
    """The same arc, in degrees. Raises NoSolutionError for less than a position wants."""
    if arc < MIN_ARC_DEG:
        raise NoSolutionError(
            f"the lit limb covers {arc:.0f} deg of azimuth about the nadir; a position wants "
            f"{MIN_ARC_DEG:.0f} deg or more",
            ReasonCode.SHORT_ARC,
        )
    return arc
