"""The attitude that run.toml names for the quaternions of a run's files."""

from dataclasses import dataclass

from scipy.spatial.transform import Rotation

from catalog.bodies.body import Body
from catalog.bodies.epochs import utc_to_tdb_s
from catalog.bodies.motion import AnalyticMotion, BodyMotion
from optnav_cli.imagery.run_settings import Attitude, camera_from_body, rotation_for_file


@dataclass(frozen=True)
class FileAttitude:
    """How the files of one run write attitudes; `name` is the `attitude` of run.toml.

    motion  how the body turns; by theory if None. Truth and solutions are compared by theory, which
            takes nothing from the comparison: one small turn stands before both.
    """

    name: Attitude
    body: Body
    motion: BodyMotion | None = None

    def written(self, rotation: Rotation, utc: str) -> Rotation:
        """The rotation to write for a camera_from_body at a time."""
        return rotation_for_file(self.name, self._motion, self._time(utc), rotation)

    def read(self, written: Rotation, utc: str) -> Rotation:
        """camera_from_body of a written rotation at a time."""
        return camera_from_body(written, self.name, self._motion, self._time(utc))

    @property
    def _motion(self) -> BodyMotion:
        return self.motion or AnalyticMotion(self.body)

    def _time(self, utc: str) -> float:
        # relative to the body no time is needed, and an unsolved row's may not be understood
        return 0.0 if self.name == "camera_from_body" else utc_to_tdb_s(utc)
