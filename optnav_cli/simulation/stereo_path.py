"""A ship with two mounted cameras low over rough ground: pairs of pictures for stereo.

Every pass has its own place, ground, height and Sun. The ground is that of [detail] alone, from
`largest_m` down to the pixel, on the body's reference sphere.
"""

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import Annotated, Self

import msgspec
import numpy as np
from msgspec import Meta
from scipy.spatial.transform import Rotation

from catalog.arrays import Float32Array, FloatArray
from catalog.bodies.body import Body
from catalog.bodies.ephemeris import Ephemeris
from catalog.bodies.epochs import compute_tdb_s_after
from catalog.cache import Cache
from catalog.config import Count, Seconds, Turn
from catalog.errors import ConfigError
from catalog.geometry.latlon import body_from_local, xyz_from_latlon
from catalog.rendering.rays.ground import Ground, make_ground, make_whole_sphere
from catalog.rendering.rays.scene import Scene
from catalog.terrain.synthetic.relief import SyntheticRelief
from optnav_cli.camera.camera import Camera
from optnav_cli.frames.run_settings import MountSettings, check_mounts, select_stereo_pair
from optnav_cli.simulation import sections
from optnav_cli.simulation.passes import SunSettings, sun_over
from optnav_cli.simulation.scenario_base import PLACE, Epoch, Exposure, ScenarioBase, corner_rays
from optnav_cli.simulation.sections import Elevation, Latitude

MOUNTING = 41  # a stream of random numbers
KEPT_SCENES = 2
COARSE_ROWS = 64  # of the sphere around
NODES_A_PIXEL = 1.5
SHADOW_SHARE = 0.6  # of the seen ground's width that the drawn ground reaches beyond it
MAX_NODES = 40_000_000
MIN_HEIGHT_M = 1.0  # of a camera over the ground
MAX_SUN = 89.0

Height = Annotated[float, Meta(ge=2.0, le=20_000.0)]  # m
Speed = Annotated[float, Meta(ge=-1e4, le=1e4)]
Largest = Annotated[float, Meta(ge=1.0, le=10_000.0)]  # m


class StereoSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Passes of a ship with two cameras.

    heights_m      over the ground below at the first pair, a pass each
    pairs          of each pass
    velocity_m_s   forward, right, down
    place_deg      longitude and latitude of the first pass; the others lie within 1 deg
    largest_m      largest craters and spacing of the random relief
    sun_elevation_deg  lowest and highest; the passes share the range evenly
    """

    heights_m: Annotated[tuple[Height, ...], Meta(min_length=1, max_length=1000)]
    place_deg: tuple[Turn, Latitude]
    pairs: Count = 2
    spacing_s: Seconds = 1.0
    velocity_m_s: tuple[Speed, Speed, Speed] = (0.0, 0.0, 0.0)
    heading_deg: Turn = 0.0
    sun_elevation_deg: tuple[Elevation, Elevation] = (10.0, 60.0)
    largest_m: Largest = 400.0
    start_utc: str = "2026-01-01T00:00:00Z"
    pass_interval_s: Seconds = 60.0


class StereoScenario(ScenarioBase, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Pairs of pictures of a ship whose cameras are mounted as [[mount]] says; or of one camera.

    One needs an [altimeter].

    Both cameras are copies of [camera], named as the mounts name them. With [truth] camera =
    "drawn" they stand as far off from that as error_arcsec says.
    """

    stereo: StereoSettings
    mount: tuple[MountSettings, ...]
    altimeter: sections.AltimeterSection | msgspec.UnsetType = msgspec.UNSET
    dem: tuple[()] = ()  # no terrain model lies below this ground

    def check(self) -> None:
        super().check()
        check_mounts(self.mount)
        if self.altimeter:
            self.altimeter.check()
        if not (self.altimeter and len(self.mount) == 1):
            select_stereo_pair(self.mount)
        if self.beside:
            raise ConfigError("there are [[beside]] and [[mount]]; mount cameras with [[mount]]")
        low, high = self.stereo.sun_elevation_deg
        if not 0.0 < low <= high < MAX_SUN:
            raise ConfigError(
                f"[stereo] sun_elevation_deg is {low:g}..{high:g}; wanted a rising range within 0 "
                f"and {MAX_SUN:g}"
            )

    def mounts(self) -> tuple[sections.MountedCamera, ...]:
        return tuple(sections.MountedCamera(self.camera.name) for _ in self.mount)

    def camera_names(self) -> list[str]:
        return [mount.camera for mount in self.mount]

    def shortened(self, frames: int) -> Self:
        heights = self.stereo.heights_m[: max(1, frames)]
        return msgspec.structs.replace(
            self, stereo=msgspec.structs.replace(self.stereo, heights_m=heights)
        )

    def relief(self, seed: int, body: Body) -> SyntheticRelief:
        """The ground of a pass."""
        detail = self.detail
        return SyntheticRelief(
            seed,
            0.5 * self.stereo.largest_m,
            body.radius_m,
            min(detail.smallest_m, self.stereo.largest_m),
            detail.rms_slope_deg,
            saturation=detail.saturation,
        )

    def epochs(self, motion: Ephemeris) -> list[Epoch]:
        """The pairs of all passes; the ship flies straight on between those of a pass."""
        settings, body = self.stereo, motion.body
        flight: list[Epoch] = []
        passes = len(settings.heights_m)
        for number, height_m in enumerate(settings.heights_m):
            rng = np.random.default_rng([self.seed, PLACE, number])
            off = rng.uniform(-1.0, 1.0, 2) * (number > 0)
            lon, lat = np.radians(np.array(settings.place_deg) + off)
            seed = self.detail.seeds[number % len(self.detail.seeds)] if self.detail.seeds else 0
            ground_m = float(self.relief(seed, body).heights(lat, lon))
            axes = body_from_local(lat, lon)
            heading = np.radians(settings.heading_deg)
            ahead = axes @ np.array([np.sin(heading), np.cos(heading), 0.0])
            right = axes @ np.array([np.cos(heading), -np.sin(heading), 0.0])
            velocity = np.array(settings.velocity_m_s) @ np.stack([ahead, right, -axes[:, 2]])
            start = xyz_from_latlon(lat, lon, body.radius_m + ground_m + height_m)
            sun_of = SunSettings(elevation_deg=settings.sun_elevation_deg)
            sun = sun_over(sun_of, lat, lon, number, passes, rng)
            for step in range(settings.pairs):
                after = step * settings.spacing_s
                later = number * settings.pass_interval_s + after
                tdb_s = float(compute_tdb_s_after(settings.start_utc, later)[0])
                position = start + velocity * after
                flight.append(Epoch(len(flight), number, tdb_s, position, ahead, sun, True, seed))
        return flight

    def exposures(self, motion: Ephemeris) -> list[Exposure]:
        """The pictures: each camera where it is mounted, with what is stated of it."""
        drawn = self.world.camera == "drawn"
        taken = []
        for exposure in super().exposures(motion):
            mount = self.mount[exposure.camera]
            rng = np.random.default_rng([self.seed, MOUNTING, exposure.camera])
            off = Rotation.from_rotvec(drawn * mount.error_rad * rng.normal(size=3))
            ship, stated = exposure.camera_from_body, exposure.reported_camera_from_body
            prior = exposure.prior_m
            taken.append(
                replace(
                    exposure,
                    position_m=exposure.position_m + ship.inv().apply(mount.place_m),
                    camera_from_body=off * mount.turn.inv() * ship,
                    reported_camera_from_body=mount.turn.inv() * stated,
                    prior_m=None if prior is None else prior + ship.inv().apply(mount.place_m),
                )
            )
        return taken


class StereoTerrain:
    """The ground of the passes, made to the pixel where the pictures look."""

    def __init__(self, scenario: StereoScenario, body: Body, flight: Sequence[Exposure]) -> None:
        self._scenario, self._body, self._flight = scenario, body, flight
        self._scenes: Cache[int, Scene] = Cache(KEPT_SCENES)

    def radiance(self, camera: Camera, exposure: Exposure) -> Float32Array:
        """Mean radiance factor over each pixel (height, width)."""
        scene = self._scenes.get(exposure.pass_index, partial(self._scene, camera, exposure))
        rays = corner_rays(camera) @ exposure.camera_from_body.as_matrix()
        return scene.picture(exposure.position_m, rays)

    def height_m(self, exposure: Exposure, lat: float, lon: float) -> float:
        """The ground's height at a place, rad, over the reference sphere."""
        relief = self._scenario.relief(exposure.ground_seed or 0, self._body)
        return float(relief.heights(lat, lon))

    def _scene(self, camera: Camera, exposure: Exposure) -> Scene:
        pictures = [e for e in self._flight if e.pass_index == exposure.pass_index]
        radius = self._body.radius_m
        relief = self._scenario.relief(pictures[0].ground_seed or 0, self._body)
        heights = np.array([self._over_ground(e.position_m, relief) for e in pictures])
        if heights.min() < MIN_HEIGHT_M:
            raise ConfigError(
                f"[stereo] a camera comes to {heights.min():.3g} m over the ground; wanted "
                f"{MIN_HEIGHT_M:g} and more: see heights_m, velocity_m_s and the mounts' position_m"
            )
        corners = np.concatenate([self._corners(camera, e, h) for e, h in zip(pictures, heights)])
        width = float(np.ptp(corners, axis=0).max())
        margin = (SHADOW_SHARE * width + 2.0) / radius
        lat, lon = np.arcsin(corners[:, 2] / radius), np.arctan2(corners[:, 1], corners[:, 0])
        posting = float(heights.min()) * camera.angular_resolution / NODES_A_PIXEL
        step = posting / radius
        stretch = 1.0 / float(np.cos(lat.mean()))
        north, west = float(lat.max() + margin), float(lon.min() - margin * stretch)
        rows = int((north - lat.min() + margin) / step)
        cols = int((lon.max() + margin * stretch - west) / (step * stretch))
        if rows * cols > MAX_NODES:
            raise ConfigError(
                f"[stereo] a pass sees {rows} x {cols} nodes of {posting:g} m; {MAX_NODES} are "
                "possible: fly slower, or give fewer pairs"
            )
        fine = relief.window(north, west, step, step * stretch, rows, cols)
        ground: Ground = make_ground(fine, north, west, step, step * stretch, radius)
        flat = np.zeros((COARSE_ROWS, 2 * COARSE_ROWS), np.float32)
        wide = make_whole_sphere(flat, radius, float(lon.mean()) + np.pi)
        surface = self._scenario.world.find_surface(self._body)
        return Scene(ground, wide, exposure.sun_body, ground, surface)

    def _over_ground(self, place_m: FloatArray, relief: SyntheticRelief) -> float:
        radius = float(np.linalg.norm(place_m))
        lat, lon = np.arcsin(place_m[2] / radius), np.arctan2(place_m[1], place_m[0])
        return radius - self._body.radius_m - float(relief.heights(lat, lon))

    def _corners(self, camera: Camera, exposure: Exposure, height_m: float) -> FloatArray:
        """Where the corners of a picture meet level ground, on the reference sphere, (n, 3) m."""
        rays = camera.unproject(camera.border(2)) @ exposure.camera_from_body.as_matrix()
        up = exposure.position_m / np.linalg.norm(exposure.position_m)
        along = height_m / np.maximum(-(rays @ up), 0.2)
        places = exposure.position_m + along[:, None] * rays
        points: FloatArray = places / np.linalg.norm(places, axis=1)[:, None] * self._body.radius_m
        return points
