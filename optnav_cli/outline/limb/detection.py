"""The lit edge of a body against the sky, as one picture shows it.

Source: Zhukov 2025, ch. 2, step by step: candidates along rows and columns, stars and structure
rejected, the terminator by the Sun, a cone through the rest, the sector test, and again. Ours: the
cone is found by consensus, so that rods and craters do not bend it, and the edges are placed below
the pixel by a model of the blurred limb.

Counts may not be linear in light. Square-root tables and gamma steepen the dark side of an edge: an
edge model of linear counts puts it 0.2-0.4 px too far out, at a stated hundredth. The residuals of
the model then follow the same pattern in all profiles; decoded by the right exponent, noise is
left. Halos and rough ground leave patterns too, which no exponent removes: they stay.
"""

from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np

from catalog.arrays import BoolArray, Float32Array, FloatArray
from catalog.errors import NoSolutionError
from optnav_cli.camera.camera import Camera
from optnav_cli.frames.segmentation import Levels, Segmented
from optnav_cli.outline.disc.fit import MAX_BENT_LIMB_PX, measure_edge_bias_px
from optnav_cli.outline.limb import checks
from optnav_cli.outline.limb.candidates import (
    MIN_BLOB_PIXELS,
    Candidates,
    find_candidates,
    is_bounded_by_sky,
    is_sunlit,
    measure_sharpness,
    select_limb_candidates,
)
from optnav_cli.outline.limb.cone import (
    Cone,
    PixelRays,
    compute_pixel_rays,
    find_cone,
    fit_cone,
    measure_distances,
)
from optnav_cli.outline.limb.edge_fit import (
    EdgeShape,
    Profiles,
    compute_edge_residuals,
    fit_common_shape,
    locate_edges,
    sample_profiles,
)
from optnav_cli.reasons import ReasonCode

MAX_POINTS = 3000
MIN_POINTS = 12
RELIEF = 0.002  # of the body's radius: what the limb stands off a smooth one
# What the edge model may leave on all points, px: limbs of a known skyline show 0.011-0.017 from
# 50 to 200 km.
COMMON_SIGMA_PX = 0.015
# Refusals that other light than the body's may cause; thresholds that are tried then, as shares of
# the way from the sky to the lit ground's level. Enceladus' plumes reach 0.25 of it, 20 px from the
# limb.
OTHER_LIGHT_CODES = (ReasonCode.NO_LIMB, ReasonCode.COVERED_LIMB, ReasonCode.SHORT_ARC)
RAISED_SHARES = (0.16, 0.32)


@dataclass(frozen=True, eq=False)
class LimbPoints:
    """Points of the lit limb, ordered by azimuth about the body's centre in the picture.

    pixels            (n, 2)  x, y of the edge
    sigma_px          (n,)    1-sigma error along `inward`, each point's own (noise)
    inward            (n, 2)  unit vectors in the picture from the sky to the body, across the limb
    common_sigma_px   what the edge model may leave common to all points, along `inward`
    blur_px           sigma of the blur across the limb, as the edges show it
    cone_axis_camera  (3,)    unit vector to the centre of the circular cone that fits them best
    cone_angle        half angle of that cone, rad
    arc_deg           azimuth about the cone's axis that the points cover
    lit_pixels        area of the lit body in the picture
    cut_by_frame      whether the body reaches the picture's edge
    exponent          of counts that gives light, as the limb shows it; 1: counts are linear
    """

    pixels: FloatArray
    sigma_px: FloatArray
    inward: FloatArray
    common_sigma_px: float
    blur_px: float
    cone_axis_camera: FloatArray
    cone_angle: float
    arc_deg: float
    lit_pixels: int
    cut_by_frame: bool
    exponent: float = 1.0

    def __len__(self) -> int:
        return len(self.pixels)


def find_limb(
    picture: Float32Array,
    camera: Camera,
    sun_camera: FloatArray | None,
    *,
    saturation: float | None = None,
    stretch: FloatArray | None = None,
    relief: float = RELIEF,
    lit: Segmented | None = None,
) -> LimbPoints:
    """Find the lit limb of the one body in a picture.

    picture     (h, w)  counts; NaN where a pixel has no value
    sun_camera  (3,)    unit vector to the Sun, camera frame; None where it is not known
    saturation  counts at which a pixel is full; None where the format does not say
    stretch     (3, 3)  makes the body a sphere, from the camera frame: diag(1 / radii) @
                body_from_camera up to scale; None for a sphere
    relief      what the limb may stand off a smooth one, in body radii
    lit         the picture's lit areas, where they are at hand

    Raises NoSolutionError, with what the picture shows instead, when there is no lit limb to use.
    """
    areas = lit or Segmented(picture)
    full = np.inf if saturation is None else saturation
    space = _normalise_stretch(stretch)
    try:
        return _locate_limb(areas, camera, sun_camera, full, space, relief)[0]
    except NoSolutionError as error:
        if error.code not in OTHER_LIGHT_CODES:
            raise
        limb = _find_limb_beside_other_light(areas, camera, sun_camera, full, space, relief)
        if limb is None:
            raise
        return limb


def _find_limb_beside_other_light(
    areas: Segmented,
    camera: Camera,
    sun_camera: FloatArray | None,
    saturation: float,
    space: FloatArray,
    relief: float,
) -> LimbPoints | None:
    """The limb without the light that is not the body's; None where there is none either.

    Plumes, haze and halos have no edges of their own, which tells them from structure and from
    other ground. Burnt-in text and stars are small.
    """
    _, where = _get_edges(areas, camera, space)
    for share in RAISED_SHARES:
        with suppress(NoSolutionError):
            brighter = areas.raise_threshold(share)
            limb, cone = _locate_limb(brighter, camera, sun_camera, saturation, space, relief)
            # Edges beyond the limb, at the lower threshold, up to 10 % of the limb's points.
            if checks.count_beyond(cone, where, relief) <= 0.1 * len(limb):
                return limb
    alone = areas.select_largest(MIN_BLOB_PIXELS)
    if alone is not None:
        with suppress(NoSolutionError):
            return _locate_limb(alone, camera, sun_camera, saturation, space, relief)[0]
    return None


def _locate_limb(
    areas: Segmented,
    camera: Camera,
    sun_camera: FloatArray | None,
    full: float,
    space: FloatArray,
    relief: float,
) -> tuple[LimbPoints, Cone]:
    """The limb of a picture's lit areas, as `find_limb`, and the cone that fits it."""
    picture = areas.picture
    levels, blobs = areas.levels, areas.blobs
    checks.check_blobs(picture, blobs, levels, full)
    candidates, everywhere = _get_edges(areas, camera, space)
    cone, kept = _find_first_cone(
        picture, camera, candidates, everywhere, levels.threshold, sun_camera, relief, space
    )
    on_edge, where = candidates.subset(kept), everywhere.subset(kept)
    limb, where = select_limb_candidates(on_edge, where, cone, relief)
    pixel = float(np.median(np.linalg.norm(where.by_x, axis=1))) if len(limb) else 0.0
    arc = checks.measure_arc_deg(cone, where.rays, 3.0, pixel)
    checks.check_arc(arc, len(limb))
    checks.check_sharp(measure_sharpness(picture, limb))
    checks.check_others(picture, camera, candidates, everywhere, cone, levels, relief)
    checks.check_hidden(picture, camera, cone, where.rays, sun_camera)

    limb, where = _limit_points(cone, limb, where)
    profiles, places, bend = sample_profiles(picture, camera, limb, where, cone, sun_camera)
    edges = fit_edges(profiles, levels, full)
    depth, sigma, shape = edges.depth_px, edges.sigma_px, edges.shape
    distance, inward = measure_distances(cone, where)
    if sun_camera is not None and float(np.median(bend)) * MAX_BENT_LIMB_PX > 1.0:
        bias = measure_edge_bias_px(profiles, places, camera, cone, sun_camera, shape, edges.levels)
    else:
        # a convex limb's blur moves its half level inward by sigma^2 / (2 radius)
        bias = 0.5 * shape.blur_px**2 * bend
    depth = depth - bias
    pixels = limb.pixels + (depth - distance)[:, None] * inward
    good = np.isfinite(depth) & np.isfinite(sigma)
    if good.sum() < MIN_POINTS:
        raise NoSolutionError(
            f"only {int(good.sum())} limb points have an edge that stands out of the noise; "
            f"{MIN_POINTS} are needed",
            ReasonCode.NOISY_LIMB,
        )
    pixels, sigma = pixels[good], sigma[good]
    where = compute_pixel_rays(camera, pixels, space)
    cone = fit_cone(where, np.ones(len(pixels), dtype=bool), cone) or cone
    _, inward = measure_distances(cone, where)
    order = np.argsort(checks.compute_azimuths(cone, where.rays), kind="stable")
    limb_points = LimbPoints(
        pixels=pixels[order],
        sigma_px=sigma[order],
        inward=inward[order],
        common_sigma_px=float(np.hypot(COMMON_SIGMA_PX, shape.common_sigma_px)),
        blur_px=shape.blur_px,
        cone_axis_camera=cone.axis_camera(),
        cone_angle=cone.angle,
        arc_deg=checks.measure_arc_deg(cone, where.rays, 3.0, pixel),
        lit_pixels=int(blobs.area[0]),
        cut_by_frame=blobs.is_at_border(0),
        exponent=edges.exponent,
    )
    return limb_points, cone


def _normalise_stretch(stretch: FloatArray | None) -> FloatArray:
    """The stretch to unit size; of a sphere, whose stretch only turns, the unit matrix."""
    if stretch is None:
        return np.eye(3)
    unit = stretch / np.linalg.norm(stretch, 2)
    return np.eye(3) if np.allclose(unit @ unit.T, np.eye(3), atol=1e-9) else unit


def _get_edges(areas: Segmented, camera: Camera, space: FloatArray) -> tuple[Candidates, PixelRays]:
    """A picture's candidates for a limb, and their rays in the space; made once."""

    def make() -> tuple[Candidates, PixelRays]:
        candidates = find_candidates(areas.picture, camera, areas.levels, areas.blobs)
        return candidates, compute_pixel_rays(camera, candidates.pixels, space)

    made: tuple[Candidates, PixelRays] = areas.made.get(("edges", camera, space.tobytes()), make)
    return made


def _find_first_cone(
    picture: Float32Array,
    camera: Camera,
    candidates: Candidates,
    where: PixelRays,
    threshold: float,
    sun_camera: FloatArray | None,
    relief: float,
    space: FloatArray,
) -> tuple[Cone, BoolArray]:
    """A first cone, and which candidates may be lit limb; where: their rays in the space."""
    if sun_camera is None:
        # Without the Sun limbs are chosen by their sharpness, see `measure_sharpness`.
        kept = measure_sharpness(picture, candidates) > 0.6
    else:
        kept = is_sunlit(where, candidates.gradient, space, sun_camera)
    if kept.sum() < MIN_POINTS <= len(candidates):
        raise NoSolutionError(
            f"no lit limb in view: {len(candidates) - int(kept.sum())} of {len(candidates)} edges "
            "are terminator or face away from the Sun of this attitude and time",
            ReasonCode.NO_LIMB,
        )
    kept &= is_bounded_by_sky(picture, camera, candidates.pixels, candidates.gradient, threshold)
    if kept.sum() < MIN_POINTS:
        raise NoSolutionError(
            f"no limb in view: of {len(candidates)} edges from dark to bright in the picture "
            f"{int(kept.sum())} have sky on their dark side",
            ReasonCode.NO_LIMB,
        )
    lit = candidates.subset(kept)
    fit = find_cone(where.subset(kept), lit.gradient, space, relief)
    if fit is None or fit[1].sum() < MIN_POINTS:
        text = f"no limb in view: no curve joins the {len(lit)} edges of the picture"
        raise NoSolutionError(text, ReasonCode.NO_LIMB)
    return fit[0], kept


def _limit_points(cone: Cone, limb: Candidates, where: PixelRays) -> tuple[Candidates, PixelRays]:
    """At most MAX_POINTS, evenly in azimuth."""
    if len(limb) <= MAX_POINTS:
        return limb, where
    order = np.argsort(checks.compute_azimuths(cone, where.rays), kind="stable")
    some = order[np.linspace(0, len(order) - 1, MAX_POINTS).astype(np.int64)]
    return limb.subset(some), where.subset(some)


# Mean squares of the pattern's bins over their errors': drawn discs have 0.6-1.4 where counts are
# linear, 1.5-26 under a square root; these with 0.6-1.4 where they are decoded right.
MIN_PATTERN, MAX_PATTERN_LEFT = 2.0, 1.6
EXPONENTS = (1.2, 1.43, 1.7, 2.0, 2.2)  # of light over counts: square root 2, sRGB about 2.2


@dataclass(frozen=True, eq=False)
class LimbEdges:
    """The edges of a limb, and how counts were read for them.

    depth_px, sigma_px  (n,) as `locate_edges`
    shape     what they have in common
    levels    of the picture, decoded
    exponent  of counts that gives light; 1 where they are taken as linear
    """

    depth_px: FloatArray
    sigma_px: FloatArray
    shape: EdgeShape
    levels: Levels
    exponent: float = 1.0


def fit_edges(profiles: Profiles, levels: Levels, saturation: float) -> LimbEdges:
    """Edges of profiles in counts, as these are, or decoded where the limb shows a coding.

    Raises NoSolutionError when no profile has an edge.
    """
    as_stated = _fit_exponent(profiles, levels, saturation, 1.0)
    if as_stated[1] < MIN_PATTERN or levels.peak <= 0.0:
        return as_stated[0]
    # most patterns are the ground's: two exponents tell these from a coding's
    tried = [_fit_exponent(*_decode(profiles, levels, saturation, e), e) for e in EXPONENTS[1:4:2]]
    if min(pattern for _, pattern in tried) > as_stated[1]:
        return as_stated[0]
    tried = [_fit_exponent(*_decode(profiles, levels, saturation, e), e) for e in EXPONENTS]
    best = int(np.argmin([pattern for _, pattern in tried]))
    edges, pattern = tried[best]
    if pattern > MAX_PATTERN_LEFT or pattern > 0.5 * as_stated[1]:
        return as_stated[0]
    moved = float(np.nanmedian(edges.depth_px - as_stated[0].depth_px))
    # The best of the exponents has a 1-sigma error of 0.1.
    error = 0.1 * abs(moved) / (EXPONENTS[best] - 1.0)
    common = float(np.hypot(edges.shape.common_sigma_px, error))
    return replace(edges, shape=replace(edges.shape, common_sigma_px=common))


def _fit_exponent(
    profiles: Profiles, levels: Levels, saturation: float, exponent: float
) -> tuple[LimbEdges, float]:
    """Edges of profiles, and the size of the pattern that their model leaves."""
    shape = fit_common_shape(profiles, levels, saturation)
    depth, sigma = locate_edges(profiles, shape, levels, saturation)
    inside, residuals = compute_edge_residuals(profiles, shape, levels, saturation)
    edges = LimbEdges(depth, sigma, shape, levels, exponent)
    return edges, _measure_pattern(inside, residuals)


def _measure_pattern(inside_px: FloatArray, residuals: FloatArray) -> float:
    """Mean square of residuals (n,) in bins of the distance inside the edge, over its variance."""
    # Bins of half a pixel.
    bins = np.floor(inside_px / 0.5).astype(np.int64)
    bins -= bins.min(initial=0)
    number = np.bincount(bins)
    full = number >= 10
    if not full.any():
        return 0.0
    mean = np.bincount(bins, residuals)[full] / number[full]
    return float(np.mean(number[full] * mean**2))


def _decode(
    profiles: Profiles, levels: Levels, saturation: float, exponent: float
) -> tuple[Profiles, Levels, float]:
    """Profiles, levels and full scale in light, of which the peak has as much as in counts."""
    peak = levels.peak

    def decode_counts(counts: FloatArray | float) -> FloatArray:
        share = np.asarray(counts, np.float64) / peak
        decoded: FloatArray = peak * np.sign(share) * np.abs(share) ** exponent
        return decoded

    # No sky is darker than 1e-3 of the peak, where a power's slope vanishes.
    slope = exponent * max(levels.sky / peak, 1e-3) ** (exponent - 1.0)
    changed = replace(
        levels,
        sky=float(decode_counts(levels.sky)),
        noise=levels.noise * slope,
        bright=float(decode_counts(levels.bright)),
        threshold=float(decode_counts(levels.threshold)),
    )
    full = float(decode_counts(saturation)) if np.isfinite(saturation) else saturation
    return replace(profiles, values=decode_counts(profiles.values)), changed, full
