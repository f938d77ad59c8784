"""Moments of a small disc in a picture, and of an illuminated sphere, of which it is the blur."""

from dataclasses import dataclass
from functools import partial

import cv2
import numpy as np

from catalog.arrays import BoolArray, Float32Array, FloatArray, Int32Array, IntArray
from catalog.bodies.body import Body
from catalog.errors import NoSolutionError
from catalog.geometry.ellipsoid import project_to_surface
from catalog.geometry.kernel import kernel
from catalog.geometry.latlon import xyz_from_latlon
from catalog.photometry import hapke
from catalog.photometry.laws import lambert, lommel_seeliger
from catalog.terrain.relief.relief import GlobalRelief, interpolate_relief
from optnav_cli.frames.segmentation import ROUNDING_VARIANCE, Blobs, Segmented
from optnav_cli.reasons import ReasonCode

# Of Hapke's parameters the roughness moves a disc's light, by 0.006 radii and 2 % of its width;
# the others do by a tenth of that.
SMOOTH, ROUGH = (hapke.LUNAR._replace(theta_bar=np.radians(mean)) for mean in (15.0, 30.0))
LAWS = (
    hapke.reflectance,
    lommel_seeliger,
    lambert,
    partial(hapke.reflectance, surface=SMOOTH),
    partial(hapke.reflectance, surface=ROUGH),
)
SPHERE_NODES = 60  # a side of the half disc that is integrated
MIN_SKY_PIXELS = 100
MIN_PIXELS = 3  # lit; a hot pixel is one, two when they touch
MAX_SMALL_DISC_PX = 25.0  # radius; beyond it the limb's profiles are right to 0.01-0.05 px
MAX_SATURATED = 0.05  # of the pixels that hold its light
MAX_SATURATED_CORE = 0.25  # of those above half of the brightest


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


def compute_sphere_moments(phase: float) -> list[LightMoments]:
    """Moments of an illuminated sphere for each of LAWS, at a phase angle, rad."""
    # nodes on the lit half: x and y of the disc, brightness is even in y
    u = (np.arange(2 * SPHERE_NODES) + 0.5) / SPHERE_NODES - 1.0
    v = (np.arange(SPHERE_NODES) + 0.5) / SPHERE_NODES
    x, y = np.meshgrid(u, v)
    inside = x**2 + y**2 < 1.0
    x, y = x[inside], y[inside]
    mu = np.sqrt(1.0 - x**2 - y**2)
    mu0 = x * np.sin(phase) + mu * np.cos(phase)
    moments = []
    for law in LAWS:
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
    """Moments for each of LAWS.

    axes_body  (3, 3) rows: x and y of the picture and the direction to the camera, body frame
    sun_body   (3,) unit vector;  phase  rad, between Sun and camera
    """
    if is_round(body):
        return compute_sphere_moments(phase)
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
    for law in LAWS:
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
