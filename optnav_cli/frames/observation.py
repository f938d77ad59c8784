"""A picture with all that navigation must know of it beforehand."""

from dataclasses import dataclass

from scipy.spatial.transform import Rotation

from catalog.arrays import FloatArray
from catalog.errors import NoSolutionError
from optnav_cli.camera.camera import Camera
from optnav_cli.fix import PositionPrior
from optnav_cli.frames.frames import Frame
from optnav_cli.frames.picture import Picture
from optnav_cli.reasons import ReasonCode

FROM_FILE = "frames.csv"  # the source of a prior that the frame's row gives


@dataclass(frozen=True, eq=False)
class Observation:
    """A picture and what is stated about it.

    file, utc           what its row in solution.csv begins with
    camera_from_body    the stated attitude; of a free one the first guess
    attitude_sigma_rad  1 sigma an axis; 0: exact; None: free
    sun_body            (3,) unit vector to the Sun, body frame
    prior               the stated position, else where a known orbit leads, if there is one
    """

    file: str
    utc: str
    tdb_s: float
    camera: Camera
    picture: Picture
    camera_from_body: Rotation
    attitude_sigma_rad: float | None
    sun_body: FloatArray
    prior: PositionPrior | None = None

    @property
    def source(self) -> str:
        """Source name of a prior that another frame takes from this one."""
        return f"{self.camera.name} camera, {self.file}"


def make_observation(frame: Frame, camera: Camera, picture: Picture) -> Observation:
    """A frame with its picture. Raises NoSolutionError where its attitude or the Sun is missing."""
    if frame.camera_from_body is None:
        raise NoSolutionError("no attitude: the quaternion is empty", ReasonCode.NO_ATTITUDE)
    if frame.sun_body is None or frame.tdb_s is None:
        raise NoSolutionError("no direction to the Sun", ReasonCode.NO_SUN)
    prior = frame.predicted
    if frame.position_m is not None and frame.position_sigma_m is not None:
        prior = PositionPrior.isotropic(frame.position_m, frame.position_sigma_m, FROM_FILE)
    turn, sigma, sun = frame.camera_from_body, frame.attitude_sigma_rad, frame.sun_body
    return Observation(frame.file, frame.utc, frame.tdb_s, camera, picture, turn, sigma, sun, prior)
