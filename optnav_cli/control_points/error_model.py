"""Errors of matched control points beyond what their peaks show.

The curvature of the correlation peak shows noise and relief that the reference lacks. What
stays is small and does not average out as noise does. A part of it is each point's own: the
terrain model's interpolation, the averaging of coarse levels. A part is common to a frame, because
all points stand under one Sun: relief that the catalog lacks lengthens shadows, which moves every
pattern away from a low Sun; shading and sampling leave a small shift across it and a stretch about
the frame's middle. Without the common part the covariance of many points together would come out
too small.

The sizes are fitted numbers, in FILE (`make study-fit`).
"""

from dataclasses import dataclass
from functools import cache
from typing import Any

import msgspec
import numpy as np
from numpy.typing import ArrayLike

from catalog.arrays import BoolArray, FloatArray
from catalog.config import Positive, load_toml, resource
from catalog.geometry.vectors import unit

# Below it shadows fill the picture and the cotangent runs away.
MIN_SUN = np.radians(8.0)

FILE = "configs/models/control_points.toml"


class _Sizes(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A section of FILE, which says what each number is."""


class OwnSizes(_Sizes, frozen=True):
    """Sizes of the independent errors of each point."""

    level_nodes: Positive
    fixed_m: Positive
    shadow_m: Positive
    height_nodes: Positive
    skipped_share: Positive
    warped_m: Positive
    warped_low_sun: Positive


class CommonSizes(_Sizes, frozen=True):
    """Sizes of errors common to a frame."""

    height_nodes: Positive
    sunward_nodes: Positive
    shift_nodes: Positive
    shadow_m: Positive
    shift_m: Positive
    unexplained_m: Positive
    stretch_m: Positive
    shift_px: Positive
    stretch_px: Positive
    keystone_px: Positive
    scatter_shift: Positive
    scatter_stretch: Positive


class CurvedSizes(_Sizes, frozen=True):
    """Sizes of errors common to a frame that sees round the body.

    A coarse level is a mean of heights, a picture of it a mean of brightness. Sun and line of sight
    change from point to point, and with them how the relief is seen that the mean took away: the
    pattern stretches, alike or changing from side to side.
    """

    stretch_nodes: Positive
    keystone_nodes: Positive
    finest_stretch_nodes: Positive
    finest_keystone_nodes: Positive


class HiddenSizes(_Sizes, frozen=True):
    """Sizes of errors where a shape model is coarser than the patches that were cut from it."""

    own: Positive
    rise: Positive
    shift: Positive
    stretch: Positive
    keystone: Positive


class SunwardSizes(_Sizes, frozen=True):
    """Sizes of the shift away from the Sun, and of its remainder."""

    bias_m: Positive
    unexplained_m: Positive
    high_sun: Positive
    left: Positive


class AlbedoSizes(_Sizes, frozen=True):
    """Sizes of common errors left where albedo that follows relief was fitted."""

    shift_nodes: Positive


class TerrainSizes(_Sizes, frozen=True):
    """Shares of stated errors of terrain models, and what is common where they are right."""

    shift: Positive
    height: Positive
    right: Positive
    explained: Positive


class ImageSizes(_Sizes, frozen=True):
    """Sizes of errors of templates that are cut from an image."""

    own_nodes: Positive
    shift_nodes: Positive
    stretch_nodes: Positive


class PointErrorSizes(_Sizes, frozen=True):
    """All fitted numbers of FILE."""

    region_km: Positive
    own: OwnSizes
    common: CommonSizes
    curved: CurvedSizes
    hidden: HiddenSizes
    sunward: SunwardSizes
    albedo: AlbedoSizes
    terrain: TerrainSizes
    image: ImageSizes

    def convert_for_image(self, error_m: float, posting_m: float) -> "PointErrorSizes":
        """Return the sizes for templates of an image: nothing hangs on relief or the Sun.

        error_m  1 sigma per axis of the image's places;  posting_m  of its finest patches
        """

        def clear(sizes: Any) -> Any:
            return type(sizes)(**dict.fromkeys(type(sizes).__struct_fields__, 0.0))

        scale = float(_scale(posting_m))
        shift_m = float(np.hypot(error_m, self.image.shift_nodes * posting_m)) / scale
        stretch_m = self.image.stretch_nodes * posting_m / scale
        change = msgspec.structs.replace
        return change(
            self,
            region_km=1e9,  # common to all of a frame
            own=change(clear(self.own), level_nodes=self.image.own_nodes),
            common=change(clear(self.common), shift_m=shift_m, stretch_m=stretch_m),
            **{
                name: clear(getattr(self, name))
                for name in ("curved", "hidden", "sunward", "albedo")
            },
        )


@cache
def load_error_sizes() -> PointErrorSizes:
    """Load the sizes that ship with optnav. Raises ConfigError for a wrong file."""
    return load_toml(resource(FILE), PointErrorSizes)


def correlate_overlaps(masks: BoolArray) -> FloatArray:
    """Correlate (n, n) errors that the ground causes: common ground over the mean of both."""
    flat = masks.reshape(len(masks), -1).astype(np.float64)
    size = np.sqrt(np.maximum(flat.sum(axis=1), 1.0))
    correlation = (flat @ flat.T) / np.outer(size, size)
    np.fill_diagonal(correlation, 1.0)
    return correlation


def correlate_ground(places_m: FloatArray, widths_m: FloatArray) -> FloatArray:
    """Correlate (n, n) templates at points (n, 3), body frame, that the frame does not cut.

    widths_m  (n,) sides of the templates on the ground. Discs of their areas stand for them.
    """
    apart = np.linalg.norm(places_m[:, None] - places_m[None], axis=2)
    wider = np.maximum(widths_m[:, None], widths_m[None])
    narrower = np.minimum(widths_m[:, None], widths_m[None])
    t = np.minimum(apart / np.maximum((wider + narrower) / np.sqrt(np.pi), 1e-9), 1.0)
    common = 2.0 / np.pi * (np.arccos(t) - t * np.sqrt(1.0 - t * t))
    correlation: FloatArray = common * narrower / wider
    return correlation


@dataclass(frozen=True, eq=False)
class MatchedPoints:
    """Matched points, as far as their errors go.

    points_m              (n, 3)     their places, body frame
    pixel_per_metre       (n, 2, 3)  change of their pixels with these, px/m
    scores                (n,)       of the correlation peaks
    sun_elevation_deg     (n,)       at the points
    postings_m            (n,)       of the levels that were matched
    finest_postings_m     (n,)       of the terrain models that the points' catalogs were made from
    unresolved_posting_m  (n,)       posting of the terrain model where the patch is finer, else 0
    skipped_m             (n,)       by which the level is coarser than the picture resolves
    sizes_m               (n,)       sides of the templates on the ground
    terrain_sigmas_m      (n, 2)     shift an axis and height of each template by the stated error
                                     of its terrain model; None or 0 where none is stated
    terrain_errors        (n,)       stated errors of the terrain models over those of GLD100; None:
                                     as large
    albedo_postings_m     (n,)       of the levels where albedo that follows relief was fitted to
                                     the matches, else 0; None: to none
    """

    points_m: FloatArray
    pixel_per_metre: FloatArray
    scores: FloatArray
    sun_elevation_deg: FloatArray
    postings_m: FloatArray
    finest_postings_m: FloatArray
    unresolved_posting_m: FloatArray
    skipped_m: FloatArray
    sizes_m: FloatArray
    terrain_sigmas_m: FloatArray | None = None
    terrain_errors: FloatArray | None = None
    albedo_postings_m: FloatArray | None = None


def compute_point_sigma_m(
    posting_m: ArrayLike,
    finest_posting_m: ArrayLike,
    sun_elevation_deg: ArrayLike,
    sizes: PointErrorSizes | None = None,
) -> FloatArray:
    """Compute 1-sigma ground errors per axis, m, of each point that its peak does not show.

    posting_m  of the level that was matched; sun_elevation_deg at the point
    """
    point = (sizes or load_error_sizes()).own
    elevation = np.clip(np.radians(sun_elevation_deg), MIN_SUN, np.pi / 2.0)
    fixed = (point.fixed_m + point.shadow_m / np.tan(elevation) ** 2) * _scale(finest_posting_m)
    sigmas: FloatArray = np.hypot(np.multiply(point.level_nodes, posting_m), fixed)
    return sigmas


def compute_point_covariances_px2(
    points: MatchedPoints, sizes: PointErrorSizes | None = None
) -> FloatArray:
    """Compute the independent errors that peaks do not show, (n, 2, 2), px^2."""
    sizes = sizes or load_error_sizes()
    places, pixel_per_metre = points.points_m, points.pixel_per_metre
    up = unit(places)
    sigma = sizes.own.height_nodes * points.postings_m
    sigma = sigma / _compute_cos_emission(_compute_lines_of_sight(pixel_per_metre, up), up)
    rise = np.einsum("nij,nj->ni", pixel_per_metre, up) * sigma[:, None]
    # along the ground in every direction, by its mean scale in the picture
    level = np.eye(3) - up[:, :, None] * up[:, None, :]
    flat = pixel_per_metre @ level
    area = np.linalg.det(flat @ np.swapaxes(flat, 1, 2))
    finest, elevations = points.finest_postings_m, points.sun_elevation_deg
    sigmas = compute_point_sigma_m(points.postings_m, finest, elevations, sizes)
    terrain = np.zeros((len(places), 2))
    if points.terrain_sigmas_m is not None:
        terrain = points.terrain_sigmas_m * [sizes.terrain.shift, sizes.terrain.height]
    lift = np.einsum("nij,nj->ni", pixel_per_metre, up) * terrain[:, 1:]
    variance: FloatArray = sigmas**2 + (sizes.hidden.own * points.unresolved_posting_m) ** 2
    variance += terrain[:, 0] ** 2 + (sizes.own.skipped_share * points.skipped_m) ** 2
    variance += _compute_warped_m(points, sizes) ** 2
    variance = variance * np.sqrt(np.maximum(area, 0.0))
    covariances: FloatArray = rise[:, :, None] * rise[:, None, :]
    covariances += lift[:, :, None] * lift[:, None, :]
    return covariances + variance[:, None, None] * np.eye(2)


def compute_bias_px(
    points: MatchedPoints, sun_body: FloatArray, sizes: PointErrorSizes | None = None
) -> FloatArray:
    """Compute the mean shift of matched points from their true pixels, (n, 2) px.

    sun_body (3,) unit vector to the Sun, body frame
    """
    up = unit(points.points_m)
    along = sun_body - (up @ sun_body)[:, None] * up
    along /= np.maximum(np.linalg.norm(along, axis=1, keepdims=True), 1e-6)
    shifts = -along * _compute_sunward_m(points, sizes or load_error_sizes())[:, None]
    bias: FloatArray = np.einsum("nij,nj->ni", points.pixel_per_metre, shifts)
    return bias


def _compute_sunward_m(points: MatchedPoints, sizes: PointErrorSizes) -> FloatArray:
    """Compute the points' mean shift away from the Sun, (n,) m."""
    size = sizes.sunward
    elevation = np.clip(np.radians(points.sun_elevation_deg), MIN_SUN, np.pi / 2.0)
    low = np.maximum(1.0 / np.tan(elevation) - size.high_sun, 0.0)
    moved = size.bias_m + size.unexplained_m * (1.0 - np.clip(points.scores, 0.0, 1.0))
    known = points.unresolved_posting_m == 0.0  # behind a blur the sizes below hold instead
    shifts: FloatArray = moved * _scale(points.finest_postings_m) * low * known
    return shifts


def _compute_warped_m(points: MatchedPoints, sizes: PointErrorSizes) -> FloatArray:
    """Compute the sigma of shifts of whole templates, (n,) m per axis."""
    known = points.unresolved_posting_m == 0.0
    unexplained = 1.0 - np.clip(points.scores, 0.0, 1.0)
    elevation = np.clip(np.radians(points.sun_elevation_deg), MIN_SUN, np.pi / 2.0)
    low = np.hypot(1.0, sizes.own.warped_low_sun / np.tan(elevation))
    # `warped_m` is stated for a template of 9.5 km.
    sigmas: FloatArray = unexplained * (9.5e3 / points.sizes_m) * low * known
    return sizes.own.warped_m * sigmas


def compute_common_errors_px(
    points: MatchedPoints, sun_body: FloatArray, sizes: PointErrorSizes | None = None
) -> FloatArray:
    """Compute what one sigma of each common error moves every point by, (n, 2, 20), px.

    sun_body (3,) unit vector to the Sun, body frame
    The errors are independent: shadows along the Sun, shifts along and across it, stretches of the
    ground and of the picture, two changing stretches, the three of a view round the body, shifts
    along the picture's axes, a rise of the ground, equal on all sides and different toward the Sun
    and across it, shifts of the whole pattern, what is left of the shift away from the Sun, what is
    left of albedo along the Sun and across it.
    """
    sizes = sizes or load_error_sizes()
    share = _compute_common_share(points, sizes)
    common, curved, hidden = _scale_common(sizes.common, share), sizes.curved, sizes.hidden
    places, pixel_per_metre = points.points_m, points.pixel_per_metre
    finest_postings = points.finest_postings_m
    averaged = points.postings_m - finest_postings
    # what averaging to a coarser level moves does not shrink
    nodes_m = finest_postings + averaged / share
    unresolved = points.unresolved_posting_m
    middle = places.mean(axis=0)
    up = middle / np.linalg.norm(middle)
    level = sun_body - (sun_body @ up) * up
    length = float(np.linalg.norm(level))
    # under a Sun overhead no direction is the Sun's, and its shadows are short
    along = level / length if length > 1e-6 else np.linalg.svd(up[None])[2][1]
    across = np.cross(up, along)
    elevation = max(float(np.arcsin(np.clip(sun_body @ up, -1.0, 1.0))), MIN_SUN)
    unexplained = _measure_unexplained(points)
    shift = common.shift_m + common.unexplained_m * unexplained
    outward = places - middle
    outward = outward - (outward @ up)[:, None] * up
    reach = float(np.sqrt((outward**2).sum(axis=1).mean()))
    region = _scale(finest_postings)[:, None] / float(
        np.hypot(1.0, reach / (1e3 * sizes.region_km))
    )
    ones = np.ones((len(places), 1))
    fields = [
        along * (region * common.shadow_m / np.tan(elevation)),
        along * (region * shift),
        across * (region * shift),
        outward,
        *(outward * ((outward @ axis) / max(reach, 1.0))[:, None] for axis in (along, across)),
    ]
    *shifts, stretch, one_way, other_way = [
        np.einsum("nij,nj->ni", pixel_per_metre, f) for f in fields
    ]
    moved = [*shifts, stretch * (region * common.stretch_m / max(reach, 1.0))]
    moved += [_scale_field(stretch, common.stretch_px)]
    moved += [_scale_field(field, common.keystone_px) for field in (one_way, other_way)]
    distance = float(np.linalg.norm(middle))
    finest = (unresolved == 0.0) & (averaged == 0.0)
    round_m = np.where(finest, finest_postings, 0.0) * (reach / distance)
    even = curved.stretch_nodes * averaged + hidden.stretch * unresolved
    even += curved.finest_stretch_nodes * round_m
    changing = curved.keystone_nodes * averaged + hidden.keystone * unresolved
    changing += curved.finest_keystone_nodes * round_m
    moved.append(stretch * (even / distance)[:, None])
    moved += [field * (changing / distance)[:, None] for field in (one_way, other_way)]
    moved += [ones * common.shift_px * axis for axis in np.eye(2)]
    verticals = unit(places)
    sight = _compute_lines_of_sight(pixel_per_metre, verticals)
    sigma = common.height_nodes * nodes_m + hidden.rise * unresolved
    sigma = sigma / _compute_cos_emission(sight, verticals)
    rise = np.einsum("nij,nj->ni", pixel_per_metre, verticals) * sigma[:, None]
    moved += [rise, rise * (sight @ along)[:, None], rise * (sight @ across)[:, None]]
    for axis, nodes in ((along, common.sunward_nodes), (across, common.shift_nodes)):
        own_shifts = nodes * nodes_m + hidden.shift * unresolved
        moved.append(np.einsum("nij,j->ni", pixel_per_metre, axis) * own_shifts[:, None])
    left = along * (share * sizes.sunward.left * _compute_sunward_m(points, sizes))[:, None]
    moved.append(np.einsum("nij,nj->ni", pixel_per_metre, left))
    if points.albedo_postings_m is None:
        left_m = np.zeros(len(places))
    else:
        left_m = sizes.albedo.shift_nodes * unexplained * points.albedo_postings_m
    for axis in (along, across):
        moved.append(np.einsum("nij,j->ni", pixel_per_metre, axis) * left_m[:, None])
    return np.stack(moved, axis=2)


def compute_scatter_shares(
    points: MatchedPoints | None, sizes: PointErrorSizes | None = None
) -> tuple[float, float]:
    """Compute the shares of a frame's scatter that are a common shift per axis and a stretch."""
    sizes = sizes or load_error_sizes()
    share = 1.0 if points is None else _compute_common_share(points, sizes)
    return share * sizes.common.scatter_shift, share * sizes.common.scatter_stretch


def _compute_common_share(points: MatchedPoints, sizes: PointErrorSizes) -> float:
    """Compute the share of common errors left where a frame looks as its models predict.

    That takes both: models that are stated to be right, and scores that leave nothing open. A right
    model under uneven albedo leaves as much common to a frame as one that errs.
    """
    if points.terrain_errors is None:
        return 1.0
    stated = float(np.sqrt(np.square(points.terrain_errors).mean()))
    # The power is steep, since frames that show albedo or another truth lie close to it.
    left_open = (_measure_unexplained(points) / sizes.terrain.explained) ** 4.0
    return min(max(sizes.terrain.right, stated, float(left_open)), 1.0)


def _measure_unexplained(points: MatchedPoints) -> float:
    return float(1.0 - np.clip(points.scores, 0.0, 1.0).mean())


def _scale_common(common: CommonSizes, share: float) -> CommonSizes:
    return CommonSizes(**{n: share * v for n, v in msgspec.structs.asdict(common).items()})


def _compute_lines_of_sight(pixel_per_metre: FloatArray, up: FloatArray) -> FloatArray:
    """Compute unit vectors (n, 3) to the camera: a step along them moves no pixel."""
    sight: FloatArray = np.cross(pixel_per_metre[:, 0], pixel_per_metre[:, 1])
    sight = sight / np.maximum(np.linalg.norm(sight, axis=1, keepdims=True), 1e-30)
    return sight * np.where(np.einsum("ni,ni->n", sight, up) < 0.0, -1.0, 1.0)[:, None]


def _compute_cos_emission(sight: FloatArray, up: FloatArray) -> FloatArray:
    cosines: FloatArray = np.maximum(np.einsum("ni,ni->n", sight, up), 0.1)
    return cosines


def _scale_field(field_px: FloatArray, rms_px: float) -> FloatArray:
    """Scale a field to an rms length."""
    size = float(np.sqrt((field_px**2).sum(axis=1).mean()))
    return field_px * (rms_px / max(size, 1e-9))


def _scale(finest_posting_m: ArrayLike) -> FloatArray:
    # Sizes in metres are stated for a terrain model of 118.45 m. Catalogs of 118 m and 474 m on the
    # same pictures show that they grow as the root of the posting.
    return np.sqrt(np.asarray(finest_posting_m, dtype=np.float64) / 118.45)
