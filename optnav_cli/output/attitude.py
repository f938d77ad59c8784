"""The attitude that run.toml names for the quaternions of a run's files."""

from dataclasses import dataclass

from scipy.spatial.transform import Rotation

from catalog.bodies.body import Body
from catalog.bodies.epochs import utc_to_tdb_s
from optnav_cli.imagery.run_settings import Attitude, camera_from_body, rotation_for_file


@dataclass(frozen=True)
class FileAttitude:
    """How the files of one run write attitudes; `name` is the `attitude` of run.toml."""

    name: Attitude
    body: Body

    def written(self, rotation: Rotation, utc: str) -> Rotation:
        """The rotation to write for a camera_from_body at a time."""
        return rotation_for_file(self.name, self.body, self._time(utc), rotation)

    def read(self, written: Rotation, utc: str) -> Rotation:
        """camera_from_body of a written rotation at a time."""
        return camera_from_body(written, self.name, self.body, self._time(utc))

    def _time(self, utc: str) -> float:
        # relative to the body no time is needed, and an unsolved row's may not be understood
        return 0.0 if self.name == "camera_from_body" else utc_to_tdb_s(utc)
