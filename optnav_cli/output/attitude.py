"""Between the attitude used inside and the one that run.toml names for the quaternions of files."""

from dataclasses import dataclass
from typing import Literal

from scipy.spatial.transform import Rotation

from catalog.bodies.body import Body
from catalog.bodies.epochs import utc_to_tdb_s
from catalog.bodies.rotation import body_from_inertial

AttitudeName = Literal["camera_from_body", "camera_from_inertial"]


@dataclass(frozen=True)
class FileAttitude:
    """How the files of one run write attitudes; `name` is the `attitude` of run.toml."""

    name: AttitudeName
    body: Body

    def written(self, camera_from_body: Rotation, utc: str) -> Rotation:
        """The rotation to write for a camera_from_body at a time."""
        if self.name == "camera_from_body":
            return camera_from_body
        return camera_from_body * self._body_from_inertial(utc)

    def read(self, written: Rotation, utc: str) -> Rotation:
        """camera_from_body of a written rotation at a time."""
        if self.name == "camera_from_body":
            return written
        return written * self._body_from_inertial(utc).inv()

    def _body_from_inertial(self, utc: str) -> Rotation:
        return Rotation.from_matrix(body_from_inertial(self.body, utc_to_tdb_s(utc)))
