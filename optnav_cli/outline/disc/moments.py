"""Moments and size of a small disc in a picture, and of the lit sphere whose blur it is."""

from dataclasses import dataclass
from functools import cache

import cv2
import msgspec
import numpy as np

from catalog.arrays import BoolArray, Float32Array, FloatArray, Int32Array, IntArray
from catalog.bodies.body import Body
from catalog.config import Positive, load_toml, resource
from catalog.errors import NoSolutionError
from catalog.geometry.ellipsoid import project_to_surface
from catalog.geometry.kernel import kernel
from catalog.geometry.latlon import xyz_from_latlon
from catalog.photometry.laws import SurfaceLaw, find_law
from catalog.photometry.sets import LUNAR, HapkeParameters
from catalog.terrain.relief.relief import GlobalRelief, interpolate_relief
from optnav_cli.frames.segmentation import ROUNDING_VARIANCE, Blobs, Segmented
from optnav_cli.reasons import ReasonCode

# Of Hapke's parameters the roughness moves a disc's light, by 0.006 radii and 2 % of its width;
# the others do by a tenth of that.
ROUGHNESSES_DEG = 15.0, 30.0
SPHERE_NODES = 60  # a side of the half disc that is integrated
MIN_SKY_PIXELS = 100
MIN_PIXELS = 3  # lit; a hot pixel is one, two when they touch
MAX_SMALL_DISC_PX = 25.0  # radius; beyond it the limb's profiles are right to 0.01-0.05 px
MAX_SATURATED = 0.05  # of the pixels that hold its light
MAX_SATURATED_CORE = 0.25  # of those above half of the brightest
RADII = 200  # first over all of them, then over the likely ones
UNLIKELY = 1e-6  # of the likeliest
FILE = "configs/models/disc.toml"


@dataclass(frozen=True, eq=False)
class DiscMoments:
    """Light of a small disc.

    centre         (2,)    x, y of its middle of light, px;  centre_covariance (2, 2), px^2
    second         (3,)    second moments about it, px^2, the blur's included: xx, yy, xy
    second_covariance      (3, 3), px^4
    """

    centre: FloatArray
    centre_covariance: FloatArray
    second: FloatArray
    second_covariance: FloatArray


@dataclass(frozen=True, eq=False)
class LightMoments:
    """Light of a body in units of its mean half axis; x toward the Sun in the picture, y beside it.

    offset (2,)   middle of light from the centre
    second (2, 2) second moments about it
    """

    offset: FloatArray
    second: FloatArray


def list_laws(surface: HapkeParameters = LUNAR) -> list[SurfaceLaw]:
    """The laws that a disc's light may follow: Hapke's, two simple ones, smoother and rougher."""
    laws = [find_law(name, surface) for name in ("hapke", "lommel_seeliger", "lambert")]
    for mean in ROUGHNESSES_DEG:
        laws.append(find_law("hapke", surface._replace(theta_bar=np.radians(mean))))
    return laws


def compute_sphere_moments(phase: float, surface: HapkeParameters = LUNAR) -> list[LightMoments]:
    """Moments of an illuminated sphere for each of `list_laws`, at a phase angle, rad."""
    # nodes on the lit half: x and y of the disc, brightness is even in y
    u = (np.arange(2 * SPHERE_NODES) + 0.5) / SPHERE_NODES - 1.0
    v = (np.arange(SPHERE_NODES) + 0.5) / SPHERE_NODES
    x, y = np.meshgrid(u, v)
    inside = x**2 + y**2 < 1.0
    x, y = x[inside], y[inside]
    mu = np.sqrt(1.0 - x**2 - y**2)
    mu0 = x * np.sin(phase) + mu * np.cos(phase)
    moments = []
    for law in list_laws(surface):
        light = law(mu0, mu, np.cos(phase))
        light = light / light.sum()
        offset = float(light @ x)
        second = np.diag([float(light @ x**2) - offset**2, float(light @ y**2)])
        moments.append(LightMoments(np.array([offset, 0.0]), second))
    return moments


def measure_disc(areas: Segmented, saturation: float | None) -> DiscMoments:
    """Moments of the brightest spot of a picture.

    Raises NoSolutionError when there is none, when another one rivals it, and for a disc that is
    cut by the frame, saturated or too large.
    """
    picture, levels, blobs = areas.picture, areas.levels, areas.blobs
    # the largest: the brightest spot of a picture is among them
    kept = np.flatnonzero(blobs.area >= MIN_PIXELS)[:50]
    if len(kept) == 0:
        text = f"no disc: nothing lit is larger than {MIN_PIXELS - 1} pixels; hot pixels or noise"
        raise NoSolutionError(text, ReasonCode.NO_BODY)
    light = [_sum_light(picture, blobs, number, levels.sky) for number in kept]
    first = int(np.argmax(light))
    rival = float(np.sort(light)[-2]) if len(light) > 1 else 0.0
    # A second spot with 30 % of the first one's light could be the body too.
    if rival > 0.3 * light[first]:
        raise NoSolutionError(
            f"{len(light)} bright spots, the second with {100.0 * rival / light[first]:.0f} % of "
            "the first one's light: stars, or two bodies; which is the body cannot be decided",
            ReasonCode.SEVERAL_BODIES,
        )
    chosen = int(kept[first])
    left, top, wide, high = (int(value) for value in blobs.box[chosen])
    radius = 0.5 * max(wide, high)
    if radius > MAX_SMALL_DISC_PX:
        raise NoSolutionError(
            f"a disc of {2.0 * radius:.0f} px is too large for its brightness centre; "
            "its limb is the measurement",
            ReasonCode.LARGE_DISC,
        )
    height, width = picture.shape
    cx, cy = left + 0.5 * (wide - 1), top + 0.5 * (high - 1)
    # The blur still holds light 4 px beyond the lit area.
    reach = radius + 4.0
    if min(cx, cy, width - 1 - cx, height - 1 - cy) < reach:
        raise NoSolutionError(
            "the frame cuts the disc: its middle of light is not the body's", ReasonCode.CUT_DISC
        )
    part = np.s_[int(cy - reach) : int(cy + reach) + 2, int(cx - reach) : int(cx + reach) + 2]
    window, labels = picture[part].astype(np.float64), blobs.labels[part]
    y, x = np.mgrid[part]
    disc_or_sky = (labels == 0) | (labels == blobs.label[chosen])
    use = disc_or_sky & (np.hypot(x - cx, y - cy) <= reach)
    if not np.isfinite(window[use]).all():
        raise NoSolutionError(
            "pixels without a value cut the disc: its middle of light is not the body's",
            ReasonCode.CUT_DISC,
        )
    if saturation is not None:
        full = window[use] >= saturation
        # a star that is burnt out looks as wide as a disc
        core = window[use] - levels.sky > 0.5 * float((window[use] - levels.sky).max())
        share = float(full.mean())
        if share > MAX_SATURATED or float(full[core].mean()) > MAX_SATURATED_CORE:
            raise NoSolutionError(
                f"saturated: {100.0 * share:.0f} % of the disc is at full scale, which moves its "
                "middle of light; expose shorter",
                ReasonCode.SATURATED,
            )
    sky, noise, sky_sigma = _measure_background(picture, blobs.labels, (cx, cy), reach)
    return _compute_moments(window[use] - sky, x[use], y[use], noise, sky_sigma)


def _sum_light(picture: Float32Array, blobs: Blobs, number: int, sky: float) -> float:
    """Sum of a lit area's counts over the sky."""
    left, top, wide, high = blobs.box[number]
    part = np.s_[top : top + high, left : left + wide]
    mask = (blobs.labels[part] == blobs.label[number]).view(np.uint8)
    return (cv2.mean(picture[part], mask)[0] - sky) * float(blobs.area[number])


def _measure_background(
    picture: Float32Array, labels: Int32Array, middle: tuple[float, float], reach: float
) -> tuple[float, float, float]:
    """Level and scatter of the sky about a disc, beyond the blur's reach; error of the level."""
    wide = int(2.0 * reach) + 8
    x0, y0 = max(round(middle[0]) - wide, 0), max(round(middle[1]) - wide, 0)
    part = np.s_[y0 : y0 + 2 * wide + 1, x0 : x0 + 2 * wide + 1]
    values = picture[part].astype(np.float64)
    y, x = np.mgrid[y0 : y0 + values.shape[0], x0 : x0 + values.shape[1]]
    dark = (labels[part] == 0) & np.isfinite(values)
    sky = values[dark & (np.hypot(x - middle[0], y - middle[1]) > reach)]
    if sky.size < MIN_SKY_PIXELS:
        raise NoSolutionError(
            f"only {sky.size} pixels of sky about the disc, {MIN_SKY_PIXELS} are needed to tell "
            "its light from the background's",
            ReasonCode.NO_SKY,
        )
    level = float(np.median(sky))
    calm = sky[np.abs(sky - level) <= 4.0 * max(float(np.std(sky)), 0.5)]
    scatter = float(calm.std())
    # noise below half a count does not average the rounding away
    # A sky that scatters by less than 0.4 counts is rounded alike in all pixels.
    hidden = ROUNDING_VARIANCE if scatter < 0.4 else 0.0
    error = float(np.sqrt(scatter**2 / calm.size + hidden))
    return float(calm.mean()), float(np.sqrt(max(scatter**2, ROUNDING_VARIANCE))), error


def _compute_moments(
    light: FloatArray, x: IntArray, y: IntArray, noise: float, sky_sigma: float
) -> DiscMoments:
    """Moments of pixels (n,) above the sky, with the errors of noise and of the sky's level."""
    total = float(light.sum())
    if not total > 0.0:
        raise NoSolutionError(
            "no disc: the light of the brightest spot drowns in the noise", ReasonCode.NO_BODY
        )
    places = np.stack([x, y], axis=1).astype(np.float64)
    centre = light @ places / total
    deviations = places - centre
    products = np.stack(
        [deviations[:, 0] ** 2, deviations[:, 1] ** 2, deviations[:, 0] * deviations[:, 1]], axis=1
    )
    # Pixels above 10 % of the brightest are lit, not the blur's wing.
    lit = float(light[light > 0.1 * light.max()].mean())
    # A lit pixel is taken to have a signal to noise ratio of 50: the disc is too small to measure
    # it.
    variance = noise**2 + np.maximum(light, 0.0) * lit / 50.0**2
    spread = (variance[:, None] * deviations).T @ deviations / total**2
    # what a count more in one pixel changes the second moments by
    second = light @ products / total
    change = (products - second) / total
    covariance = (variance[:, None] * change).T @ change
    lifted = sky_sigma * change.sum(axis=0)
    covariance += np.outer(lifted, lifted)
    moved = sky_sigma * deviations.sum(axis=0) / total
    spread = spread + np.outer(moved, moved)
    return DiscMoments(centre, spread, second, covariance)


STEPS = 60  # from pole to pole: moments are right to 0.2 %


def is_round(body: Body) -> bool:
    """Whether a body counts as a sphere here."""
    radii = np.array(body.radii_m)
    # Half axes within 1 % of their mean.
    return bool(np.ptp(radii) < 0.01 * radii.mean())


def compute_light_moments(
    body: Body,
    relief: GlobalRelief | None,
    axes_body: FloatArray,
    sun_body: FloatArray,
    phase: float,
) -> list[LightMoments]:
    """Moments for each of `list_laws`.

    axes_body  (3, 3) rows: x and y of the picture and the direction to the camera, body frame
    sun_body   (3,) unit vector;  phase  rad, between Sun and camera
    """
    if is_round(body):
        return compute_sphere_moments(phase, body.photometry.surface)
    middles, across = _sample_ground(body, relief)
    areas = np.linalg.norm(across, axis=1)
    normals = across / areas[:, None]
    mu, mu0 = normals @ axes_body[2], normals @ sun_body
    lit = (mu > 0.0) & (mu0 > 0.0)
    if relief is not None:
        places = np.ascontiguousarray(middles * np.mean(body.radii_m))
        highest = relief.radius_m + float(relief.heights.max())
        for direction in (sun_body, axes_body[2]):
            towards = np.ascontiguousarray(direction, dtype=np.float64)
            _shade(relief.heights, relief.radius_m, highest, places, towards, lit)
    places = middles[lit] @ axes_body[:2].T
    moments = []
    for law in list_laws(body.photometry.surface):
        light = law(mu0[lit], mu[lit], np.cos(phase)) * mu[lit] * areas[lit]
        light /= light.sum()
        offset = light @ places
        deviations = places - offset
        moments.append(LightMoments(offset, (light[:, None] * deviations).T @ deviations))
    return moments


@kernel
def _shade(
    heights: Float32Array,
    radius: float,
    highest: float,
    places: FloatArray,
    direction: FloatArray,
    free: BoolArray,
) -> None:
    """Clear `free` (n,) where ground stands in a direction (3,) from places (n, 3), m.

    highest  distance from the centre, m, beyond which there is no ground
    """
    for i in range(len(places)):
        if not free[i]:
            continue
        # The first 5 % of the radius are skipped: a cell's own bend hides nothing.
        along = 0.05 * radius
        while True:
            x = places[i, 0] + along * direction[0]
            y = places[i, 1] + along * direction[1]
            z = places[i, 2] + along * direction[2]
            out = np.sqrt(x * x + y * y + z * z)
            if out > highest:
                break
            above = out - radius - interpolate_relief(heights, np.arcsin(z / out), np.arctan2(y, x))
            if above < 0.0:
                free[i] = False
                break
            # A step is at least 2 % of the radius, as smaller relief hides nothing.
            along += max(0.5 * above, 0.02 * radius)


def _sample_ground(body: Body, relief: GlobalRelief | None) -> tuple[FloatArray, FloatArray]:
    """Middles (n, 3) of the body's ground in mean half axes, and its areas as outward vectors."""
    lat = np.linspace(0.5 * np.pi, -0.5 * np.pi, STEPS + 1)[:, None]
    lon = np.linspace(-np.pi, np.pi, 2 * STEPS + 1)[None, :]
    directions = xyz_from_latlon(lat, lon, 1.0)
    if relief is None:
        corners = project_to_surface(directions, body.radii_m)
    else:
        corners = directions * (relief.radius_m + relief.heights_at(lat, lon))[..., None]
    corners /= np.mean(body.radii_m)
    a, b, c, d = corners[:-1, :-1], corners[1:, :-1], corners[1:, 1:], corners[:-1, 1:]
    middles = 0.25 * (a + b + c + d)
    return middles.reshape(-1, 3), 0.5 * np.cross(c - a, d - b).reshape(-1, 3)


class DiscErrorSizes(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Fitted numbers of FILE, which says what each is; law_prior is in the order of `list_laws`."""

    blur_px: Positive
    blur_sigma_px: Positive
    blur_shape: Positive
    blur_centre: Positive
    law_prior: tuple[Positive, Positive, Positive, Positive, Positive]
    figure: Positive
    law: Positive
    relief: Positive
    ellipsoid: Positive
    shadow_power: Positive
    drawing_px: Positive


@cache
def load_disc_sizes() -> DiscErrorSizes:
    """The sizes that ship with optnav. Raises ConfigError for a wrong file."""
    return load_toml(resource(FILE), DiscErrorSizes)


def blur_prior(known_blur_px: tuple[float, float] | None) -> tuple[float, float]:
    """Blur with the pixel's own width and its 1-sigma error, px, also where it is not known."""
    sizes = load_disc_sizes()
    return known_blur_px or (sizes.blur_px, sizes.blur_sigma_px)


@dataclass(frozen=True, eq=False)
class DiscSize:
    """Posterior distribution of a disc's radius.

    radii_px      (n,)
    weights       (laws, n) how likely each is under each law; their sum is 1
    width_sigmas  by which the likeliest of all is likelier than a point
    misfit_sigmas by which even that one is off
    """

    radii_px: FloatArray
    weights: FloatArray
    width_sigmas: float
    misfit_sigmas: float


def estimate_radius(
    disc: DiscMoments,
    pixel_from_disc: FloatArray,
    moments: list[LightMoments],
    shape_sigma: float,
    known_blur_px: tuple[float, float] | None,
) -> DiscSize:
    """Weigh radii by a disc's second moments.

    pixel_from_disc  (2, 2) of area 1, from the axes of `moments`: toward the Sun and across
    moments          of each law, for a mean radius of 1
    shape_sigma      what the body's shape may differ from the known one, of the radius
    known_blur_px    sigma of the blur and its 1-sigma error; None where not known
    """
    a, b, c, d = np.linalg.inv(pixel_from_disc).ravel()
    # xx, yy and xy of the picture's axes to those of the disc's
    turn = np.array(
        [[a * a, b * b, 2 * a * b], [c * c, d * d, 2 * c * d], [a * c, b * d, a * d + b * c]]
    )
    second, noise = turn @ disc.second, turn @ disc.second_covariance @ turn.T
    round_blur = turn @ np.array([1.0, 1.0, 0.0])
    middle, sigma = blur_prior(known_blur_px)
    # Blurs up to 3.5 sigmas off are weighed.
    reach = 3.5 * sigma
    blurs = np.linspace(max(middle - reach, 0.0), middle + reach, 51)

    def weigh(radii: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Logarithms (laws, n) of how likely radii are, and squared misfits at the best blur."""
        blur_misfit = ((blurs - middle) / sigma) ** 2
        area = radii[:, None] ** 2
        logs = np.empty((len(moments), len(radii)))
        squares = np.empty(logs.shape)
        for k, light in enumerate(moments):
            along, beside = light.second[0, 0], light.second[1, 1]
            shape = np.array([along, beside, light.second[0, 1]])
            # a shape that is not the known one changes its moments by twice its share, and its
            # shadows by half as much again
            off = 3.0 * shape_sigma * np.array([along, beside, 0.5 * np.sqrt(along * beside)])
            covariance = noise + (area**2)[..., None] * np.diag(off**2)
            miss = second - area[..., None] * shape - blurs[:, None] ** 2 * round_blur
            inverse = np.linalg.inv(covariance)
            total = np.einsum("rbi,rij,rbj->rb", miss, inverse, miss) + blur_misfit
            squares[k] = total.min(axis=1)
            each = -0.5 * (total + np.log(np.linalg.det(covariance))[:, None])
            logs[k] = np.logaddexp.reduce(each, axis=1) + np.log(load_disc_sizes().law_prior[k])
        return logs, squares

    # Equal steps of the logarithm of the radius, 0.3 to 30 px, are equally likely.
    radii = np.geomspace(0.3, 30.0, RADII)
    logs, _ = weigh(radii)
    point = float(logs[:, 0].max())
    likely = np.flatnonzero((logs > logs.max() + np.log(UNLIKELY)).any(axis=0))
    low, high = max(int(likely[0]) - 1, 0), min(int(likely[-1]) + 1, RADII - 1)
    radii = np.geomspace(radii[low], radii[high], RADII)
    logs, squares = weigh(radii)
    best = float(logs.max())
    weights = np.exp(logs - best)
    weights /= weights.sum()
    return DiscSize(
        radii, weights, float(np.sqrt(2.0 * max(best - point, 0.0))), float(np.sqrt(squares.min()))
    )
