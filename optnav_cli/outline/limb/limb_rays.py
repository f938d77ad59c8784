"""Limb points as rays in the body frame, and their errors that residuals do not show."""

from dataclasses import dataclass, replace
from functools import cache

import msgspec
import numpy as np
from scipy.spatial.transform import Rotation

from catalog.arrays import BoolArray, FloatArray, IntArray
from catalog.bodies.body import Body
from catalog.config import Positive, load_toml, resource
from catalog.errors import NoSolutionError
from catalog.terrain.skyline.limb import make_nadir_axes
from optnav_cli.camera.camera import Camera
from optnav_cli.estimation.least_squares import Estimate
from optnav_cli.outline.limb.detection import LimbPoints
from optnav_cli.reasons import ReasonCode, format_distinct

FILE = "configs/models/horizon.toml"


class LightSizes(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """[light]: of edges."""

    noise_px: Positive
    sector_px: Positive
    sector_low_px: Positive
    sector_fall_deg: Positive
    rough_share: Positive
    rough_px: Positive


class CrestSizes(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """[crest]: of the skyline of a relief on a sphere."""

    top_share: Positive
    top_share_more: Positive
    posting_m: Positive
    noise_m: Positive
    sigma_m: Positive
    model_sector: Positive
    lift: Positive
    lift_sigma: Positive


class ShapeSizes(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """[shape]: of the silhouette of a shape, in its cells."""

    lift: Positive
    lift_sigma: Positive
    crest_noise: Positive
    sector_noise: Positive


class EllipsoidSizes(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """[ellipsoid]: of what relief does to the limb of a bare one."""

    mean_km: Positive
    heights_km: Positive
    angle_deg: tuple[float, ...]
    covariance_km2: tuple[float, ...]


class HorizonSizes(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """All numbers of FILE."""

    light: LightSizes
    crest: CrestSizes
    shape: ShapeSizes
    ellipsoid: EllipsoidSizes


@cache
def load_horizon_sizes() -> HorizonSizes:
    """The sizes that ship with optnav. Raises ConfigError for a wrong file."""
    return load_toml(resource(FILE), HorizonSizes)


ARC_BIN_DEG = 2.0
MIN_ARC_DEG = 100.0  # below it errors grow tens to hundreds of times (Zhukov 2025, ch. 2)
RELIEF_BINS = 120  # of azimuth, when relief is propagated
SECTOR_DEG = 30.0  # of azimuth, over which the light about crests moves edges together
ROUGH_DEG = 10.0  # and over which long shadows do: residuals are alike over 2 to 10 deg


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

    def compute_point_sigmas(self, light: LightSizes | None = None) -> FloatArray:
        """Compute the independent error (n,) of each point, rad, by the shipped sizes or others."""
        light = light or load_horizon_sizes().light
        return np.hypot(self.sigma_px, light.noise_px) * self.pixel_angle

    def compute_azimuths(self, position: FloatArray) -> FloatArray:
        """Compute azimuths (n,) about the nadir of a position (3,), rad; see `make_nadir_axes`."""
        x, y, _ = make_nadir_axes(position) @ self.rays.T
        azimuths: FloatArray = np.arctan2(y, x)
        return azimuths

    def subset(self, kept: BoolArray) -> "LimbRays":
        """The rays of a mask."""
        return replace(
            self,
            rays=self.rays[kept],
            pixel_angle=self.pixel_angle[kept],
            sigma_px=self.sigma_px[kept],
            numbers=self.numbers[kept],
        )


def make_limb_rays(points: LimbPoints, camera: Camera, camera_from_body: Rotation) -> LimbRays:
    """Rays of limb points. Raises NoSolutionError when the lens has none for them."""
    rays = camera.unproject(points.pixels)
    nearby = camera.unproject(points.pixels + points.inward)
    seen = np.isfinite(rays).all(axis=1) & np.isfinite(nearby).all(axis=1)
    if not seen.any():
        raise NoSolutionError(
            "the lens has no ray for any of the limb points", ReasonCode.BAD_PICTURE
        )
    angle = np.linalg.norm(np.cross(rays[seen], nearby[seen]), axis=1)
    turned = camera_from_body.apply(rays[seen], inverse=True)
    sigma_px, blur = points.sigma_px[seen], points.blur_px * float(np.median(angle))
    return LimbRays(turned, angle, sigma_px, blur, points.common_sigma_px, np.flatnonzero(seen))


def measure_arc_deg(azimuths: FloatArray) -> float:
    """Measure the azimuth range that points (rad) cover, degrees, in bins of about ARC_BIN_DEG.

    The few points of a small disc lie further apart: their steps are wide enough to hold one each.
    """
    gaps = np.diff(np.sort(np.degrees(azimuths)))
    wide = max(ARC_BIN_DEG, 1.5 * float(np.median(gaps))) if gaps.size else ARC_BIN_DEG
    count = max(round(360.0 / wide), 1)
    bins = np.floor(azimuths * (count / (2.0 * np.pi))).astype(np.int64)
    return float(np.unique(np.mod(bins, count)).size * (360.0 / count))


def require_arc(azimuths: FloatArray) -> float:
    """`arc_deg` of the points. Raises NoSolutionError for less than a position wants."""
    arc = measure_arc_deg(azimuths)
    if arc < MIN_ARC_DEG:
        seen, least = format_distinct(arc, MIN_ARC_DEG, 0)
        raise NoSolutionError(
            f"the lit limb covers {seen} deg of azimuth about the nadir; a position wants "
            f"{least} deg or more",
            ReasonCode.SHORT_ARC,
        )
    return arc


def compute_attitude_covariance(position: FloatArray, sigma_rad: float) -> FloatArray:
    """Compute (3, 3) m^2: a turn of all rays moves the position about the centre, not in height."""
    square = float(position @ position)
    return sigma_rad**2 * (square * np.eye(3) - np.outer(position, position))


def compute_edge_errors(
    rays: LimbRays, azimuths: FloatArray, sun_sine: FloatArray, light: LightSizes | None = None
) -> FloatArray:
    """Compute the edge errors that illumination makes common: (n, m) rad, one sigma of each.

    azimuths (n,) about the nadir;  sun_sine (n,) sine of the Sun's elevation at each limb point
    light    other sizes than the shipped ones
    """
    light = light or load_horizon_sizes().light
    elevation = np.degrees(np.arcsin(np.clip(sun_sine, 0.0, 1.0)))
    size_px = light.sector_px + light.sector_low_px * np.exp(-elevation / light.sector_fall_deg)
    sectors = group_by_sector(azimuths) * size_px[:, None]
    common = np.full((len(rays), 1), rays.common_px)
    return np.concatenate([common, sectors], axis=1) * rays.pixel_angle[:, None]


def compute_rough_errors(
    rays: LimbRays, azimuths: FloatArray, light: LightSizes | None = None
) -> FloatArray:
    """Compute the common edge errors on ground in long shadows: (n, m) rad, one sigma of each.

    azimuths (n,) about the nadir;  light  other sizes than the shipped ones

    There the edge model fits no profile well, which shows in the points' own sigmas, and fits those
    of neighbours wrong alike.
    """
    light = light or load_horizon_sizes().light
    size_px = light.rough_share * np.maximum(rays.sigma_px - light.rough_px, 0.0)
    return group_by_sector(azimuths, ROUGH_DEG) * (size_px * rays.pixel_angle)[:, None]


def group_by_sector(azimuths: FloatArray, sector_deg: float = SECTOR_DEG) -> BoolArray:
    """Return (n, m) which azimuths (n,) about the nadir, rad, lie in each sector."""
    count = round(360.0 / sector_deg)
    within: BoolArray = _bin_azimuths(azimuths, count)[:, None] == np.arange(count)
    return within


def compute_relief_covariance(
    fit: Estimate[FloatArray], body: Body, azimuths: FloatArray, distance_m: float, circle: float
) -> FloatArray:
    """Compute (3, 3) m^2: the effect of a body's relief on the fit of its bare ellipsoid.

    azimuths (n,) of the rays;  distance_m  to the limb;  circle  rad, angle at the body's centre
    from the nadir to the limb. Bodies other than the Moon take its statistics in units of their
    plausible heights.
    """
    sizes = load_horizon_sizes().ellipsoid
    low, high = body.plausible_heights_m
    unit = (high - low) / sizes.heights_km
    bins = _bin_azimuths(azimuths, RELIEF_BINS)
    rows = fit.measured.gain(fit.noise) / distance_m
    gain = np.stack([np.bincount(bins, row, RELIEF_BINS) for row in rows])
    at = 2.0 * np.pi * np.arange(RELIEF_BINS) / RELIEF_BINS
    cosine = np.cos(circle) ** 2 + np.sin(circle) ** 2 * np.cos(at[:, None] - at[None, :])
    angle = np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0)))
    covariance = np.interp(angle, sizes.angle_deg, sizes.covariance_km2) + sizes.mean_km**2
    moved: FloatArray = gain @ (covariance * unit**2) @ gain.T
    return moved


def _bin_azimuths(azimuths: FloatArray, count: int) -> IntArray:
    return np.floor((azimuths / (2.0 * np.pi) + 0.5) * count).astype(np.int64) % count
