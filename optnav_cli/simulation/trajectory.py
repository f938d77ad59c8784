"""Where the camera is, how it is turned and where the Sun stands, frame by frame."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from catalog.bodies.body import Body
from catalog.bodies.epochs import utc_from_tdb_s, utc_to_tdb_s
from catalog.geometry.latlon import body_from_local, latlon_from_xyz, xyz_from_latlon
from optnav_cli.simulation.scenario import Scenario, SunSettings

FloatArray = NDArray[np.float64]
# streams of random numbers, so that a setting more or less does not move the others
PLACE, POINTING, PRIOR, ATTITUDE = range(4)


@dataclass(frozen=True, eq=False)
class Shot:
    """The truth about one picture, and what the navigator is told.

    position_m, prior_m  (3,) body frame, m;  sun_body (3,) unit vector
    camera_from_body     the truth;  told_camera_from_body with its error
    ground_seed          which added relief, None for none
    """

    index: int
    pass_index: int
    file: str
    utc: str
    tdb_s: float
    position_m: FloatArray
    camera_from_body: Rotation
    sun_body: FloatArray
    prior_m: FloatArray
    told_camera_from_body: Rotation
    ground_seed: int | None


def shots(scenario: Scenario, body: Body) -> list[Shot]:
    """All pictures of a scenario, pass by pass in order of time.

    Passes are circular orbits in the body-fixed frame: the body's own turn, 4 m/s at the Moon's
    equator, is left out, since each picture is taken from a position, not from a velocity.
    """
    orbit = scenario.orbit
    radius = body.radius_m + orbit.altitude_km * 1e3
    rate = float(np.sqrt(body.gm_m3_s2 / radius**3))
    start = utc_to_tdb_s(orbit.start_utc)
    digits = max(4, len(str(orbit.passes * orbit.frames)))
    found: list[Shot] = []
    for number in range(orbit.passes):
        rng = np.random.default_rng([scenario.seed, PLACE, number])
        lat, lon = _place(orbit.box_deg, rng)
        heading = np.radians(rng.uniform(*orbit.heading_deg))
        sun = sun_over(scenario.sun, lat, lon, number, orbit.passes, rng)
        axes = body_from_local(lat, lon)
        up = axes[:, 2]
        ahead = axes @ np.array([np.sin(heading), np.cos(heading), 0.0])
        seeds = scenario.detail.seeds
        ground = seeds[number * len(seeds) // orbit.passes] if seeds else None
        for step in range(orbit.frames):
            index = len(found)
            after = (step - (orbit.frames - 1) / 2.0) * orbit.spacing_s
            angle = rate * after
            position = radius * (np.cos(angle) * up + np.sin(angle) * ahead)
            forward = np.cos(angle) * ahead - np.sin(angle) * up
            attitude = _attitude(scenario, index, position, forward)
            tdb_s = start + number * orbit.pass_interval_s + step * orbit.spacing_s
            noise = np.random.default_rng([scenario.seed, PRIOR, index]).normal(size=3)
            found.append(
                Shot(
                    index=index,
                    pass_index=number,
                    file=f"frame_{index:0{digits}d}.png",
                    utc=utc_from_tdb_s(tdb_s),
                    tdb_s=tdb_s,
                    position_m=position,
                    camera_from_body=attitude,
                    sun_body=sun,
                    prior_m=position + scenario.prior.position_sigma_m * noise,
                    told_camera_from_body=_told(scenario, index, attitude),
                    ground_seed=ground,
                )
            )
    return found


def _place(box_deg: tuple[float, float, float, float], rng: np.random.Generator) -> FloatArray:
    """Latitude and longitude (rad) evenly over a box's area."""
    west, south, east, north = np.radians(box_deg)
    lat = np.arcsin(rng.uniform(np.sin(south), np.sin(north)))
    return np.array([lat, west + rng.uniform() * np.mod(east - west, 2.0 * np.pi)])


def sun_over(
    settings: SunSettings, lat: float, lon: float, number: int, count: int,
    rng: np.random.Generator,
) -> FloatArray:  # fmt: skip
    """A unit vector (3,) to the Sun, body frame, that stands over a place as wanted.

    Elevations fill the range in `count` even steps, in an order that mixes them over the passes;
    one that the latitude does not allow becomes the highest that it does.
    """
    low, high = settings.elevation_deg
    # steps by the golden section spread any run of passes over the whole range
    share = np.mod(0.5 / count + number * 0.6180339887498949, 1.0)
    elevation = np.radians(low + (high - low) * share)
    declination = np.radians(settings.subsolar_latitude_deg) * rng.uniform(-1.0, 1.0)
    sine = np.sin(elevation) - np.sin(lat) * np.sin(declination)
    # at a pole every hour is as good
    reach = max(float(np.cos(lat) * np.cos(declination)), 1e-9)
    cosine = np.clip(sine / reach, -1.0, 1.0)
    hour = np.arccos(cosine) * (1.0 if rng.uniform() < 0.5 else -1.0)
    return xyz_from_latlon(declination, lon + hour, 1.0)


def sun_elevation(sun_body: FloatArray, position_m: FloatArray) -> float:
    """Height of the Sun (rad) over the sphere's horizon below a position."""
    lat, lon, _ = latlon_from_xyz(position_m)
    return float(np.arcsin(np.clip(xyz_from_latlon(lat, lon, 1.0) @ sun_body, -1.0, 1.0)))


def _attitude(
    scenario: Scenario, index: int, position: FloatArray, forward: FloatArray
) -> Rotation:
    """Camera from body: looking down, the top of the picture forward, then turned as set."""
    pointing = scenario.pointing
    down = -position / np.linalg.norm(position)
    # y points down in the picture: backward; x completes the right-handed camera frame
    level = Rotation.from_matrix(np.stack([np.cross(-forward, down), -forward, down]))
    noise = np.random.default_rng([scenario.seed, POINTING, index]).normal(size=3)
    ahead = pointing.forward_deg + pointing.tilt_sigma_deg * noise[0]
    right = pointing.right_deg + pointing.tilt_sigma_deg * noise[1]
    roll = pointing.roll_deg + pointing.roll_sigma_deg * noise[2]
    # the boresight turned forward about x, to the right about y, then the camera about it
    turned = Rotation.from_euler("xyz", [ahead, right, roll], degrees=True)
    return turned.inv() * level


def _told(scenario: Scenario, index: int, truth: Rotation) -> Rotation:
    sigma = np.radians(scenario.attitude.sigma_arcsec / 3600.0)
    noise = np.random.default_rng([scenario.seed, ATTITUDE, index]).normal(size=3)
    return Rotation.from_rotvec(sigma * noise) * truth
