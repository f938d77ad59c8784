"""All that a camera's pictures show besides the body, and the ground of a small body's mesh."""

from functools import lru_cache
from pathlib import Path

import cv2
import numpy as np
from scipy.special import ndtr

from catalog.arrays import BoolArray, Float32Array, FloatArray
from catalog.bodies.body import Body, load_body
from catalog.bodies.ephemeris import Ephemeris, compute_velocity_inertial
from catalog.bodies.stars import apply_aberration, load_bright_stars
from catalog.cache import Cache
from catalog.errors import ConfigError
from catalog.rendering.mesh_scene import MeshScene
from catalog.terrain.mesh.file import MeshSettings
from catalog.terrain.mesh.rays import MeshRays
from catalog.terrain.mesh.refine import FINEST_FACES, add_detail, refine_shape
from catalog.terrain.mesh.shape import load_shape
from optnav_cli.camera.camera import Camera
from optnav_cli.simulation.scenario_base import CAMERAS, Exposure, ScenarioBase, corner_rays
from optnav_cli.simulation.sections import (
    DetailSettings,
    GlareSettings,
    StructureSettings,
    relief_below,
)
from optnav_cli.simulation.sensor import Besides, Counts, add_hot_pixels

FINER = 4  # sub-pixels a side that outlines are drawn on
UNEVEN = 0.2  # how much the brightness of a part varies over it, of its mean
UNEVEN_PX = 160.0  # the distance over which it does
LIMB_SAMPLES = 8  # rays a side of a pixel at the limb: its share of sky is right to 0.01
MAX_SAMPLES = 32  # rays a side of any pixel: for a body that is smaller than that many faces
MARGIN_PX = 2.0  # about the ball that holds the body


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


class MeshGround:
    """The meshes of a scenario, one a seed; the last one asked for is kept.

    Raises ConfigError or DataError for a shape model that cannot be used.
    """

    def __init__(self, shape: MeshSettings, detail: DetailSettings, body: Body) -> None:
        self._detail, self._radius_m = detail, body.radius_m
        self._surface = body.photometry.surface
        model = load_shape(shape, Path.cwd(), body)
        smallest = detail.smallest_m
        # halved until there are about two edges to the finest relief
        halvings = max(0, round(float(np.log2(2.0 * model.posting_m / smallest))))
        if len(model.faces) * 4**halvings > FINEST_FACES:
            raise ConfigError(
                f"[detail] smallest_m is {smallest:g}, for which the {len(model.faces)} faces of "
                f"{Path(shape.path).name} would become {len(model.faces) * 4**halvings}; "
                f"up to {FINEST_FACES} are possible: raise it"
            )
        self._model_posting_m = model.posting_m
        self._shape = refine_shape(model, halvings)
        self.posting_m = self._shape.posting_m
        self._meshes: Cache[int | None, MeshRays] = Cache(1)
        self._corners = lru_cache(maxsize=CAMERAS)(corner_rays)

    def mesh(self, seed: int | None) -> MeshRays:
        """The mesh of a seed, with its relief; without any for None. The last one is kept."""
        return self._meshes.get(seed, lambda: self._made(seed))

    def _made(self, seed: int | None) -> MeshRays:
        shape, posting = self._shape, self._model_posting_m
        if seed is not None:
            shape = add_detail(shape, relief_below(self._detail, seed, posting, self._radius_m))
        return MeshRays(shape.vertices[shape.faces])

    def radiance(self, camera: Camera, exposure: Exposure) -> Float32Array:
        """Mean radiance factor over each pixel (height, width) of a picture, sky 0."""
        ground = self.mesh(exposure.ground_seed)
        out = np.zeros(camera.shape, np.float32)
        rays = self._corners(camera)
        box = _box(camera, rays, exposure, ground.reach_m)
        if box is None:
            return out
        rows, cols = box
        pixel_m = float(np.linalg.norm(exposure.position_m)) * camera.angular_resolution
        # so many rays that none stands for more ground than a face
        aside = int(np.clip(np.ceil(pixel_m / self.posting_m), 1, MAX_SAMPLES))
        corners = rays[rows.start : rows.stop + 1, cols.start : cols.stop + 1]
        fine_rays = _between(corners, aside) @ exposure.camera_from_body.as_matrix()
        scene = MeshScene(ground, exposure.sun_body, self._surface)
        fine = scene.picture(exposure.position_m, fine_rays, samples=-(-LIMB_SAMPLES // aside))
        shape = rows.stop - rows.start, aside, cols.stop - cols.start, aside
        out[rows, cols] = fine.reshape(shape).mean(axis=(1, 3))
        return out


def _box(
    camera: Camera, corners: FloatArray, exposure: Exposure, reach_m: float
) -> tuple[slice, slice] | None:
    """Rows and columns of the pixels that may show the body; None for none."""
    distance = float(np.linalg.norm(exposure.position_m))
    centre = exposure.camera_from_body.apply(-exposure.position_m / distance)
    angle = np.arcsin(reach_m / distance) + MARGIN_PX * camera.angular_resolution
    near = corners @ centre > np.cos(angle)  # NaN, where the lens sees nothing, is not
    if not near.any():
        return None
    spans = []
    for axis in (1, 0):
        at = np.flatnonzero(near.any(axis=axis))
        last = near.shape[1 - axis] - 1
        spans.append(slice(max(int(at[0]) - 1, 0), min(int(at[-1]) + 1, last)))
    return spans[0], spans[1]


def _between(corners: FloatArray, aside: int) -> FloatArray:
    """Corners (rows, cols, 3) with `aside` - 1 more between neighbours, straight lines apart."""
    if aside == 1:
        return corners
    for axis in (0, 1):
        steps = corners.shape[axis] - 1
        at = np.arange(steps * aside + 1) / aside
        low = np.minimum(at.astype(int), steps - 1)
        share = (at - low).reshape((-1, 1, 1) if axis == 0 else (1, -1, 1))
        first, second = np.take(corners, low, axis), np.take(corners, low + 1, axis)
        corners = first + share * (second - first)
    return corners
