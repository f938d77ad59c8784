"""A powered descent to a low place over the ground, and the terrain model of that ground.

The path is drawn, not flown by forces: the speed falls evenly, the height with the way that is
left, so that the path comes down at one angle. With [inertial] all pictures are of one inertial
track, whose errors are common to its rows.
"""

from collections.abc import Sequence
from functools import lru_cache
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Self

import cv2
import msgspec
import numpy as np
from affine import Affine
from msgspec import Meta
from rasterio.crs import CRS
from rasterio.io import MemoryFile
from scipy.spatial.transform import Rotation

from catalog.arrays import Float32Array, FloatArray
from catalog.bodies.body import Body
from catalog.bodies.ephemeris import Ephemeris
from catalog.bodies.epochs import compute_tdb_s_after
from catalog.config import Seconds, Turn
from catalog.errors import ConfigError
from catalog.geometry.latlon import body_from_local, latlon_from_xyz
from catalog.geometry.rotations import ARCSEC
from catalog.terrain.dem.source import DemSource
from optnav_cli.frames.run_settings import InertialSettings
from optnav_cli.simulation.passes import SunSettings, sun_over
from optnav_cli.simulation.region_ground import Box, truth_terrain
from optnav_cli.simulation.scenario_base import (
    ATTITUDE,
    PLACE,
    PRIOR,
    Epoch,
    Exposure,
    ScenarioBase,
)
from optnav_cli.simulation.sections import AltimeterSection, Distance, Latitude

MODEL = "model.tif"
SMOOTH_POSTINGS = 0.6  # sigma of what smooths a model's error: 1-2 postings wide
BLOCK = 2  # nodes of the truth along a side of a model's posting
MODEL_STREAM = 43  # of random numbers, apart from those of pictures
Speed = Annotated[float, Meta(ge=0.1, le=1e5)]
Tilt = Annotated[float, Meta(ge=-80.0, le=80.0)]
Wobble = Annotated[float, Meta(ge=0.0, le=30.0)]
Duration = Annotated[float, Meta(ge=1.0, le=1e5)]
MAX_FRAMES = 10_000
MIN_HEIGHT_M, CHECKED = 50.0, 16  # over the ground that is flown over, at so many places of it


class ModelSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """A terrain model that is written with the pictures, as MODEL.

    posting_m  of which a whole number fit into that of the first [[dem]], so rounded
    error_m    rms of its heights
    margin_km  how far it goes to all sides of the way
    """

    posting_m: Annotated[float, Meta(ge=0.1, le=1e5)] = 12.0
    error_m: Annotated[float, Meta(ge=0.0, le=1e3)] = 1.0
    margin_km: Annotated[float, Meta(gt=0.0, le=1e3)] = 6.0


def surveyed_model(
    settings: ModelSettings, scenario: ScenarioBase, body: Body, flight: Sequence[Exposure]
) -> bytes:
    """The model under a flight as GeoTIFF, in steps of longitude and latitude.

    Raises ConfigError for a posting that is not below that of the first terrain model, or for
    more ground than a scene may hold.
    """
    terrain = truth_terrain(scenario, body, flight)
    if settings.posting_m > 0.75 * terrain.posting_m:
        raise ConfigError(
            f"[model] posting_m is {settings.posting_m:g}; wanted less than three quarters of the "
            f"{terrain.posting_m:.0f} m of the first [[dem]], below which the truth is richer"
        )
    seed = next(iter(scenario.detail.seeds), None)
    factor = BLOCK * round(terrain.posting_m / settings.posting_m)
    true = terrain.window(seed, factor, _box(flight, 1e3 * settings.margin_km, body.radius_m))
    rows, cols = (n // BLOCK for n in true.heights.shape)
    blocks = true.heights[: BLOCK * rows, : BLOCK * cols].reshape(rows, BLOCK, cols, BLOCK)
    rng = np.random.default_rng([scenario.seed, MODEL_STREAM])
    heights = blocks.mean(axis=(1, 3), dtype=np.float64).astype(np.float32)
    heights += model_error(heights.shape, settings.error_m, rng)
    # the file's origin is the corner of its first pixel
    north, west = true.north + 0.5 * true.step_lat, true.west - 0.5 * true.step_lon
    steps = (BLOCK * true.step_lon, BLOCK * true.step_lat)
    left, top, right, down = (float(np.degrees(v)) for v in (west, north, *steps))
    pixel_to_degrees = Affine(right, 0.0, left, 0.0, -down, top)
    return geotiff(
        heights, CRS.from_proj4(f"+proj=longlat +R={body.radius_m} +no_defs"), pixel_to_degrees
    )


def model_error(shape: tuple[int, ...], rms_m: float, rng: np.random.Generator) -> Float32Array:
    """Errors (rows, cols) of a model's heights, m, that are one to two postings wide."""
    noise = rng.normal(size=shape).astype(np.float32)
    noise = np.asarray(cv2.GaussianBlur(noise, (0, 0), SMOOTH_POSTINGS), np.float32)
    error: Float32Array = noise * np.float32(rms_m / float(noise.std()))
    return error


def geotiff(heights: Float32Array, crs: object, transform: object) -> bytes:
    """Heights (rows, cols) as a GeoTIFF."""
    profile = {"crs": crs, "transform": transform, "dtype": "float32", "count": 1}
    size = {"height": heights.shape[0], "width": heights.shape[1]}
    with MemoryFile() as memory:
        with memory.open(driver="GTiff", compress="deflate", **profile, **size) as made:
            made.write(heights, 1)
        data: bytes = memory.read()
    return data


def write_model(
    settings: ModelSettings,
    scenario: ScenarioBase,
    body: Body,
    flight: Sequence[Exposure],
    folder: Path,
) -> None:
    """Put the model into a folder of pictures."""
    (folder / MODEL).write_bytes(surveyed_model(settings, scenario, body, flight))


def _box(flight: Sequence[Exposure], margin_m: float, radius_m: float) -> Box:
    """The box about the ground below a flight."""
    lat, lon, _ = latlon_from_xyz(np.array([exposure.position_m for exposure in flight]))
    lon = lon[-1] + np.mod(lon - lon[-1] + np.pi, 2.0 * np.pi) - np.pi
    margin = margin_m / radius_m
    wide = margin / float(np.cos(np.abs(lat).max() + margin))
    west, east = float(lon.min() - wide), float(lon.max() + wide)
    return west, float(lat.min() - margin), east, float(lat.max() + margin)


class DescentSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """A descent to a place.

    from_km, to_km  heights of the first and the last picture over the ground at the end
    speed_m_s       over the ground, first and last; it falls evenly
    heading_deg     of the flight at the end, east of north
    end_deg         longitude and latitude of the end
    tilt_deg        of the boresight off nadir, forward positive, first and last
    wobble_deg      1 sigma of the camera's own turns about two axes, fresh in each picture
    spacing_s       between pictures; or pairs of a height above which it holds, km, and a spacing
    """

    from_km: Distance = 20.0
    to_km: Distance = 2.0
    duration_s: Duration = 240.0
    speed_m_s: tuple[Speed, Speed] = (1700.0, 70.0)
    heading_deg: Turn = 270.0
    end_deg: tuple[Turn, Latitude] = (345.0, -43.5)
    tilt_deg: tuple[Tilt, Tilt] = (28.0, 0.0)
    wobble_deg: Wobble = 0.0
    spacing_s: Seconds | tuple[tuple[float, Seconds], ...] = 5.0
    start_utc: str = "2026-01-01T00:00:00Z"


class Descent(ScenarioBase, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """A powered descent, of one inertial track where there is [inertial]."""

    descent: DescentSettings
    sun: SunSettings = SunSettings(elevation_deg=(10.0, 20.0))
    inertial: InertialSettings | msgspec.UnsetType = msgspec.UNSET
    model: ModelSettings | msgspec.UnsetType = msgspec.UNSET
    altimeter: AltimeterSection | msgspec.UnsetType = msgspec.UNSET

    @property
    def track(self) -> InertialSettings | msgspec.UnsetType:
        return self.inertial

    @property
    def is_near_ground(self) -> bool:
        return True

    def check(self) -> None:
        super().check()
        if self.altimeter:
            self.altimeter.check()
        descent = self.descent
        if descent.to_km >= descent.from_km:
            raise ConfigError(
                f"[descent] to_km is {descent.to_km:g}, not below from_km {descent.from_km:g}; "
                "the path comes from above"
            )
        if not self.dem:
            raise ConfigError("[descent] needs ground that is known well; name a [[dem]]")
        if self.beside and self.inertial:
            raise ConfigError("[inertial] is of one camera, and there is [[beside]]; leave it out")
        pairs = descent.spacing_s
        if not isinstance(pairs, float | int) and not _fall_to_zero([high for high, _ in pairs]):
            raise ConfigError(
                "[descent] spacing_s has pairs of heights that do not fall to 0; "
                "wanted the highest first, as [[6.0, 10.0], [0.0, 5.0]]"
            )
        if len(picture_times(self.descent)) > MAX_FRAMES:
            raise ConfigError(
                f"[descent] has more than {MAX_FRAMES} pictures; raise spacing_s or end earlier"
            )

    def shortened(self, frames: int) -> Self:
        """Return the path in larger steps."""
        each = max(1.0, self.descent.duration_s / max(frames - 1, 1))
        if len(picture_times(self.descent)) <= frames:
            return self
        descent = msgspec.structs.replace(self.descent, spacing_s=each)
        return msgspec.structs.replace(self, descent=descent)

    def epochs(self, motion: Ephemeris) -> list[Epoch]:
        """Raises ConfigError for a path that meets the ground, DataError for its model."""
        settings, radius = self.descent, motion.body.radius_m
        source = DemSource.open(self.dem[0], Path.cwd(), motion.body)
        lon, lat = np.radians(settings.end_deg)
        base = _height_at(source, float(lat), float(lon))
        axes = body_from_local(float(lat), float(lon))
        heading = np.radians(settings.heading_deg)
        end, ahead = axes[:, 2], axes @ np.array([np.sin(heading), np.cos(heading), 0.0])
        rng = np.random.default_rng([self.seed, PLACE, 0])
        sun = sun_over(self.sun, float(lat), float(lon), 0, 1, rng)
        seed = next(iter(self.detail.seeds), None)
        flight: list[Epoch] = []
        times = picture_times(settings)
        step = max(1, len(times) // CHECKED)
        for number, time in enumerate(times):
            left = _way_left_m(settings, time) / radius
            up = np.cos(left) * end - np.sin(left) * ahead
            forward = np.cos(left) * ahead + np.sin(left) * end
            height = base + 1e3 * _height_km(settings, time)
            if number % step == 0 or time == times[-1]:
                _check_height(source, up, height)
            tdb_s = float(compute_tdb_s_after(settings.start_utc, time)[0])
            flight.append(Epoch(number, 0, tdb_s, (radius + height) * up, forward, sun, True, seed))
        return flight

    def ship_attitude(self, epoch: Epoch) -> Rotation:
        first, last = self.descent.tilt_deg
        share = picture_times(self.descent)[epoch.number] / self.descent.duration_s
        forward = self.pointing.forward_deg + first + (last - first) * share
        wobble = float(np.hypot(self.pointing.tilt_sigma_deg, self.descent.wobble_deg))
        pointing = msgspec.structs.replace(
            self.pointing, forward_deg=forward, tilt_sigma_deg=wobble
        )
        level = msgspec.structs.replace(self, pointing=pointing)
        return super(Descent, level).ship_attitude(epoch)

    def stated(self, epoch: Epoch, truth: Rotation) -> tuple[Rotation, FloatArray]:
        """Attitude and position as the track has them; with their own errors without [inertial]."""
        if not self.inertial:
            return super().stated(epoch, truth)
        times = picture_times(self.descent)
        places, turns = track_errors(self.inertial, times, self.seed)
        off = Rotation.from_rotvec(turns[epoch.number])
        return off.inv() * truth, epoch.position_m - places[epoch.number]


@lru_cache(maxsize=8)
def picture_times(settings: DescentSettings) -> tuple[float, ...]:
    """When pictures are taken, s from the start, MAX_FRAMES and one at most."""
    times = [0.0]
    while len(times) <= MAX_FRAMES:
        spacing, height = settings.spacing_s, _height_km(settings, times[-1])
        if not isinstance(spacing, float | int):
            spacing = next((s for above, s in spacing if height > above), spacing[-1][1])
        if times[-1] + spacing > settings.duration_s + 1e-6:
            break
        times.append(times[-1] + float(spacing))
    return tuple(times)


@lru_cache(maxsize=8)
def track_errors(
    track: InertialSettings, times: tuple[float, ...], seed: int
) -> tuple[FloatArray, FloatArray]:
    """True less stated positions (n, 3), m, and attitudes (n, 3), rad, an axis of the camera."""
    rng = np.random.default_rng([seed, PRIOR])
    position, velocity = track.position_sigma_m * rng.normal(size=3), rng.normal(size=3)
    velocity = track.velocity_sigma_m_s * velocity
    places = [position]
    for before, time in pairwise(times):
        step = time - before
        # white noise of the acceleration over a step: its share of velocity and of place
        velocity_noise, place_noise = track.acceleration_sigma_m_s2 * rng.normal(size=(2, 3))
        position = (
            position
            + velocity * step
            + step**1.5 * (velocity_noise / 2.0 + place_noise / np.sqrt(12.0))
        )
        velocity = velocity + np.sqrt(step) * velocity_noise
        places.append(position)
    rng = np.random.default_rng([seed, ATTITUDE])
    bias, drift = rng.normal(size=(2, 3))
    turns = track.attitude_sigma_arcsec * bias
    turns = turns + track.attitude_drift_arcsec_s * drift * np.array(times)[:, None]
    turns += track.attitude_noise_arcsec * rng.normal(size=(len(times), 3))
    return np.array(places), ARCSEC * turns


def _way_left_m(settings: DescentSettings, time: float) -> float:
    first, last = settings.speed_m_s
    left = settings.duration_s - time
    return left * (last + 0.5 * (first - last) * left / settings.duration_s)


def _height_km(settings: DescentSettings, time: float) -> float:
    """Over the ground at the end."""
    share = _way_left_m(settings, time) / _way_left_m(settings, 0.0)
    return settings.to_km + (settings.from_km - settings.to_km) * share


def _fall_to_zero(heights: list[float]) -> bool:
    falling = all(a > b for a, b in pairwise(heights))
    return bool(heights) and falling and heights[-1] == 0.0


def _height_at(source: DemSource, lat: float, lon: float) -> float:
    """A model's height, m. Raises ConfigError for a place outside it."""
    col, row = (float(v) for v in source.pixel_from_latlon(np.array(lat), np.array(lon)))
    rows, cols = source.shape
    if source.wraps:
        col = float(np.mod(col, cols))
    inside = 2.0 <= row <= rows - 3.0 and 2.0 <= col <= cols - 3.0
    if inside:
        height = float(source.heights_at(lat, lon))
        if np.isfinite(height):
            return height
    raise ConfigError(
        f"[descent] flies over {np.degrees(lat):.2f} deg N, {np.degrees(lon):.2f} deg E, where "
        "the first [[dem]] has no ground; move end_deg, or shorten the way"
    )


def _check_height(source: DemSource, up: FloatArray, height_m: float) -> None:
    """Raise ConfigError for a place in or near the ground."""
    lat, lon = float(np.arcsin(up[2])), float(np.arctan2(up[1], up[0]))
    ground = _height_at(source, lat, lon)
    if height_m - ground < MIN_HEIGHT_M:
        raise ConfigError(
            f"[descent] comes to {height_m - ground:.0f} m over the ground at "
            f"{np.degrees(lat):.2f} deg N, {np.degrees(lon):.2f} deg E; raise to_km or move end_deg"
        )
