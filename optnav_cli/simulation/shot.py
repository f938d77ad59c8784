"""One picture to take: where the camera is, how it is turned, and what the navigator is told."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from catalog.arrays import FloatArray
from catalog.bodies.epochs import utc_from_tdb_s
from optnav_cli.simulation.scenario import AnyScenario
from optnav_cli.simulation.sections import MountedCamera

# streams of random numbers, so that a setting more or less does not move the others
PLACE, POINTING, PRIOR, ATTITUDE, ROUGHNESS = range(5)


@dataclass(frozen=True, eq=False)
class Exposure:
    """The truth about one picture, and what the navigator is told.

    index                number of the picture; camera: number of the camera in the scenario
    position_m, prior_m  (3,) body frame, m; no prior is told where it is None
    sun_body             (3,) unit vector; told_sun says whether the navigator is told it
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
    prior_m: FloatArray | None
    reported_camera_from_body: Rotation
    ground_seed: int | None
    camera: int = 0
    reported_sun: bool = True


@dataclass(frozen=True, eq=False)
class Epoch:
    """The ship at a time when its cameras take their pictures.

    number               of the moment in the scenario
    position_m, forward  (3,) body frame; forward is a unit vector level with the ground
    """

    number: int
    pass_index: int
    tdb_s: float
    position_m: FloatArray
    forward: FloatArray
    sun_body: FloatArray
    reported_sun: bool
    ground_seed: int | None


def shots_of(scenario: AnyScenario, moments: list[Epoch]) -> list[Exposure]:
    """The pictures of all cameras at all moments, in order of time.

    Cameras of one moment share its prior and the error of the ship's attitude.
    """
    mounts = scenario.mounts()
    turns = [None, *(_mount_turn(mount) for mount in scenario.beside)]
    names = [mount.name.rpartition("/")[2].removesuffix(".toml") for mount in mounts]
    digits = max(4, len(str(len(moments))))
    found: list[Exposure] = []
    for moment in moments:
        ship = _ship_attitude(scenario, moment)
        error = _attitude_error(scenario, moment.number)
        noise = np.random.default_rng([scenario.seed, PRIOR, moment.number]).normal(size=3)
        prior = moment.position_m + scenario.prior.position_sigma_m * noise
        for number, turn in enumerate(turns):
            which = f"_{names[number]}" if len(turns) > 1 else ""
            found.append(
                Exposure(
                    index=len(found),
                    pass_index=moment.pass_index,
                    file=f"frame_{moment.number:0{digits}d}{which}.png",
                    utc=utc_from_tdb_s(moment.tdb_s),
                    tdb_s=moment.tdb_s,
                    position_m=moment.position_m,
                    camera_from_body=ship if turn is None else turn * ship,
                    sun_body=moment.sun_body,
                    prior_m=prior if scenario.prior.given else None,
                    reported_camera_from_body=(
                        error * ship if turn is None else turn * (error * ship)
                    ),
                    ground_seed=moment.ground_seed,
                    camera=number,
                    reported_sun=moment.reported_sun,
                )
            )
    return found


def _ship_attitude(scenario: AnyScenario, moment: Epoch) -> Rotation:
    """First camera from body: looking down, the picture's top forward, then turned as set."""
    pointing = scenario.pointing
    position, forward = moment.position_m, moment.forward
    down = -position / np.linalg.norm(position)
    # y points down in the picture: backward; x completes the right-handed camera frame
    level = Rotation.from_matrix(np.stack([np.cross(-forward, down), -forward, down]))
    noise = np.random.default_rng([scenario.seed, POINTING, moment.number]).normal(size=3)
    ahead = pointing.forward_deg + pointing.tilt_sigma_deg * noise[0]
    right = pointing.right_deg + pointing.tilt_sigma_deg * noise[1]
    roll = pointing.roll_deg + pointing.roll_sigma_deg * noise[2]
    return _turned(ahead, right, roll) * level


def _mount_turn(mount: MountedCamera) -> Rotation:
    """A further camera from the first one."""
    return _turned(mount.forward_deg, mount.right_deg, mount.roll_deg)


def _turned(ahead_deg: float, right_deg: float, roll_deg: float) -> Rotation:
    # the boresight turned forward about x, to the right about y, then the camera about it
    return Rotation.from_euler("xyz", [ahead_deg, right_deg, roll_deg], degrees=True).inv()


def _attitude_error(scenario: AnyScenario, number: int) -> Rotation:
    sigma = np.radians(scenario.attitude.sigma_arcsec / 3600.0)
    noise = np.random.default_rng([scenario.seed, ATTITUDE, number]).normal(size=3)
    return Rotation.from_rotvec(sigma * noise)
