"""All that a camera's pictures show besides the body, as a scenario says."""

import cv2
import numpy as np
from scipy.special import ndtr

from catalog.arrays import BoolArray, Float32Array, FloatArray
from catalog.bodies.body import load_body
from catalog.bodies.ephemeris import Ephemeris, compute_velocity_inertial
from catalog.bodies.stars import apply_aberration, load_bright_stars
from optnav_cli.camera.camera import Camera
from optnav_cli.simulation.exposure import Exposure
from optnav_cli.simulation.scenario_base import ScenarioBase
from optnav_cli.simulation.sections import GlareSettings, StructureSettings
from optnav_cli.simulation.sensor import Besides, Counts, add_hot_pixels

FINER = 4  # sub-pixels a side that outlines are drawn on
UNEVEN = 0.2  # how much the brightness of a part varies over it, of its mean
UNEVEN_PX = 160.0  # the distance over which it does


def structure_cover(
    parts: tuple[StructureSettings, ...], camera: Camera, seed: int
) -> tuple[Float32Array, Float32Array]:
    """Which share of each pixel parts of the ship cover, and their brightness: (rows, cols) each.

    Brightness is a share of the bright ground's, uneven as a lit surface is, by the seed. Of parts
    that overlap the later one lies in front.
    """
    rows, cols = camera.shape
    cover, brightness = np.zeros((rows, cols), np.float32), np.zeros((rows, cols), np.float32)
    for number, part in enumerate(parts):
        if part.camera not in ("", camera.name):
            continue
        # pixel centres are whole numbers; the drawn grid begins at the picture's corner
        corners = np.round((np.array(part.outline_px) + 0.5) * FINER).astype(np.int32)
        drawn = np.zeros((rows * FINER, cols * FINER), np.uint8)
        if part.width_px > 0.0:
            width = max(1, round(part.width_px * FINER))
            cv2.polylines(drawn, [corners], isClosed=False, color=1, thickness=width)
        else:
            cv2.fillPoly(drawn, [corners], color=1)
        share = drawn.reshape(rows, FINER, cols, FINER).mean(axis=(1, 3), dtype=np.float32)
        rng = np.random.default_rng([seed, number])
        coarse = rng.normal(size=[max(3, int(n / UNEVEN_PX) + 2) for n in (rows, cols)])
        uneven = cv2.resize(coarse.astype(np.float32), (cols, rows), interpolation=cv2.INTER_CUBIC)
        uneven_brightness = np.maximum(part.brightness * (1.0 + UNEVEN * uneven), 0.0)
        brightness = np.where(share > 0.0, uneven_brightness, brightness).astype(np.float32)
        cover = np.maximum(cover, share)
    return cover, brightness


def glare_veil(
    exposure: Exposure, rays_camera: FloatArray, settings: GlareSettings
) -> Float32Array:
    """Stray light (rows, cols) as a share of the bright ground.

    rays_camera  (rows, cols, 3) unit rays of the pixels' middles; NaN where the camera sees nothing
    """
    sun = exposure.camera_from_body.apply(exposure.sun_body)
    angle = np.degrees(np.arccos(np.clip(rays_camera @ sun, -1.0, 1.0)))
    nearest = float(np.nanmin(angle))
    veil = settings.strength * np.exp(-(angle - nearest) / settings.falloff_deg)
    light: Float32Array = np.nan_to_num(veil).astype(np.float32)
    return light


STAR_SIGMAS = 5.0  # the peak of a star of the stated magnitude, over the dark noise
SHARPEST_PX = 0.4  # stars are no sharper than a pixel shows
STAMP_PX = 6  # half a star's stamp
EARTH_RADIANCE = 0.3  # radiance factor at zero incidence: Bond albedo 0.3, Lambert's law
EARTH_SAMPLES = 6  # rays a side of a pixel


def star_light(
    exposure: Exposure, camera: Camera, motion: Ephemeris, scenario: ScenarioBase
) -> Float32Array:
    """Electrons (rows, cols) of the stars in view, as the lens blurs them.

    The brightest pixel of a star of stars_to_magnitude is STAR_SIGMAS of the dark noise, on the
    mean over places in a pixel.
    The body hides stars as a sphere; the terrain on its limb only where it is lit.
    Proper motion and the aberration by the body's motion about the Sun are in; that of the craft
    about the body, 1 arc second at the Moon, is not.
    """
    stars, sensor = load_bright_stars(), scenario.sensor
    to_magnitude = scenario.sky.stars_to_magnitude
    out = np.zeros(camera.shape, np.float32)
    seen = apply_aberration(
        stars.propagate(exposure.tdb_s), compute_velocity_inertial(motion.body, exposure.tdb_s)
    )
    directions = seen @ motion.body_from_inertial(exposure.tdb_s).T
    chosen = stars.magnitudes <= to_magnitude + 2.0
    chosen &= ~_behind(exposure.position_m, directions, motion.body.radius_m)
    pixels = camera.project(directions[chosen] @ exposure.camera_from_body.as_matrix().T)
    sigma = max(sensor.psf_sigma_px, SHARPEST_PX)
    # the middle pixel's share of a star that falls on its middle
    peak = float((ndtr(0.5 / sigma) - ndtr(-0.5 / sigma)) ** 2)
    dark = max(sensor.read_noise_e, 1.0)
    for (x, y), magnitude in zip(pixels, stars.magnitudes[chosen], strict=True):
        across = -STAMP_PX < x < camera.width_px + STAMP_PX
        if not (across and -STAMP_PX < y < camera.height_px + STAMP_PX):
            continue
        electrons = STAR_SIGMAS * dark / peak * 10.0 ** (-0.4 * (magnitude - to_magnitude))
        _add_point(out, x, y, electrons, sigma)
    return out


def _add_point(out: Float32Array, x: float, y: float, electrons: float, sigma: float) -> None:
    rows, cols = out.shape
    r0, r1 = max(round(y) - STAMP_PX, 0), min(round(y) + STAMP_PX + 1, rows)
    c0, c1 = max(round(x) - STAMP_PX, 0), min(round(x) + STAMP_PX + 1, cols)
    if r0 >= r1 or c0 >= c1:
        return
    down = ndtr((np.arange(r0, r1 + 1) - 0.5 - y) / sigma)
    across = ndtr((np.arange(c0, c1 + 1) - 0.5 - x) / sigma)
    out[r0:r1, c0:c1] += (electrons * np.outer(np.diff(down), np.diff(across))).astype(np.float32)


def add_earth(
    radiance: Float32Array, exposure: Exposure, camera: Camera, motion: Ephemeris
) -> None:
    """The Earth as a lit sphere without features, where nothing stands before it; in place."""
    radius = load_body("earth").radius_m
    body_from_inertial = motion.body_from_inertial(exposure.tdb_s)
    centre = body_from_inertial @ motion.position_m("earth", exposure.tdb_s) - exposure.position_m
    distance = float(np.linalg.norm(centre))
    in_camera = exposure.camera_from_body.apply(centre) / distance
    rim = _rim(in_camera, float(np.arcsin(radius / distance)))
    pixels = camera.project(rim)
    pixels = pixels[np.isfinite(pixels).all(axis=1)]
    if not pixels.size:
        return
    (x0, y0), (x1, y1) = pixels.min(axis=0) - 1.0, pixels.max(axis=0) + 2.0
    rows = slice(max(int(y0), 0), max(min(int(y1) + 1, camera.height_px), 0))
    cols = slice(max(int(x0), 0), max(min(int(x1) + 1, camera.width_px), 0))
    if rows.start >= rows.stop or cols.start >= cols.stop:
        return
    offset = (np.arange(EARTH_SAMPLES) + 0.5) / EARTH_SAMPLES - 0.5
    px = (np.arange(cols.start, cols.stop)[:, None] + offset).ravel()
    py = (np.arange(rows.start, rows.stop)[:, None] + offset).ravel()
    rays = camera.unproject(np.stack(np.meshgrid(px, py), axis=-1))
    along = distance * rays @ in_camera
    square = along**2 - distance**2 + radius**2
    with np.errstate(invalid="ignore"):
        hit = (square > 0.0) & (along > 0.0)
        point = (along - np.sqrt(np.maximum(square, 0.0)))[..., None] * rays
    normal = (point - distance * in_camera) / radius
    sun = exposure.camera_from_body.apply(exposure.sun_body)
    in_body = rays @ exposure.camera_from_body.as_matrix()
    hit &= ~_behind(exposure.position_m, in_body, motion.body.radius_m)
    value = np.where(hit, EARTH_RADIANCE * np.maximum(normal @ sun, 0.0), 0.0)
    n = EARTH_SAMPLES
    mean = value.reshape(value.shape[0] // n, n, value.shape[1] // n, n).mean(axis=(1, 3))
    window = radiance[rows, cols]
    window[window == 0.0] = mean[window == 0.0]


def _behind(position_m: FloatArray, directions: FloatArray, radius_m: float) -> BoolArray:
    """Whether unit rays (..., 3), body frame, from a place (3,) meet the body's sphere."""
    along = directions @ position_m
    hidden: BoolArray = (along < 0.0) & (position_m @ position_m - along**2 < radius_m**2)
    return hidden


def _rim(axis: FloatArray, half_angle: float) -> FloatArray:
    """Unit vectors (n, 3) on a cone about a unit vector, and the axis itself."""
    across = np.cross(axis, np.eye(3)[int(np.argmin(np.abs(axis)))])
    across /= np.linalg.norm(across)
    other = np.cross(axis, across)
    turn = np.linspace(0.0, 2.0 * np.pi, 48, endpoint=False)[:, None]
    around = np.cos(turn) * across + np.sin(turn) * other
    return np.vstack([np.cos(half_angle) * axis + np.sin(half_angle) * around, axis])


HOT, STRUCTURE = 23, 29  # streams of random numbers, apart from those of noise and trajectory


class Surroundings:
    """Sky, ship and faults of one camera; `motion` says where the stars and the Earth stand."""

    def __init__(self, scenario: ScenarioBase, camera: Camera, motion: Ephemeris) -> None:
        self._scenario, self._camera, self._motion = scenario, camera, motion
        seed = scenario.seed * 1000 + STRUCTURE
        parts = scenario.structure
        self._cover = structure_cover(parts, camera, seed) if parts else None
        self._rays = None
        if scenario.glare.strength > 0.0:
            x, y = np.meshgrid(np.arange(camera.width_px), np.arange(camera.height_px))
            self._rays = camera.unproject(np.stack([x, y], axis=-1).astype(np.float64))

    def besides(self, exposure: Exposure, radiance: Float32Array) -> Besides | None:
        """Return the light to expose beside the radiance of a picture, None for nothing.

        The Earth, where it is wanted and in view, is put into the radiance, in place.
        """
        sky = self._scenario.sky
        if sky.earth:
            add_earth(radiance, exposure, self._camera, self._motion)
        veil, stars = None, None
        if self._rays is not None:
            veil = glare_veil(exposure, self._rays, self._scenario.glare)
        if sky.stars_to_magnitude > 0.0:
            stars = star_light(exposure, self._camera, self._motion, self._scenario)
        if self._cover is None and veil is None and stars is None:
            return None
        cover, brightness = self._cover or (None, None)
        return Besides(cover, brightness, veil, stars)

    def with_hot_pixels(self, counts: Counts) -> Counts:
        """The counts with the camera's hot pixels, the same ones every time."""
        sensor = self._scenario.sensor
        if sensor.hot_pixels:
            rng = np.random.default_rng([self._scenario.seed, HOT, *self._camera.name.encode()])
            add_hot_pixels(counts, sensor.hot_pixels, sensor.bits, rng)
        return counts
