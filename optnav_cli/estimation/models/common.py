"""Numbers that are common to many frames: of the body, of a camera.

A place of the catalog stands at scale * (turned) + origin in the frame that positions are stated
in; a camera is turned by its boresight, or by its mounting, from what attitudes state, its lens may
be off, and its pictures may be taken later than they say.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import Protocol, Self, TypeVar

import numpy as np
from scipy.spatial.transform import Rotation

from catalog.arrays import FloatArray, IntArray
from optnav_cli.estimation.models.points import ProjectingCamera

C = TypeVar("C", bound="AdjustableCamera")


class AdjustableCamera(ProjectingCamera, Protocol):
    """A camera as an adjustment needs it."""

    @property
    def name(self) -> str:
        """Its name: cameras of one name are one."""

    @property
    def principal_point_px(self) -> tuple[float, float]:
        """(x, y) where its boresight meets the picture."""

    def with_lens(self, factor: float, shift_px: FloatArray, k1: float) -> Self:
        """Return the camera with another focal length, principal point and k1."""


class Common(StrEnum):
    """Parameters that may be common to frames."""

    BODY_ROTATION = "body_rotation"
    ORIGIN = "origin"
    SCALE = "scale"
    BORESIGHT = "boresight"
    FOCAL = "focal"
    CENTRE = "centre"
    DISTORTION = "distortion"
    MOUNTING = "mounting"
    CLOCK = "clock"


# Prior sigmas, wider than any honest error: rad, share of the body's radius, 1, rad, 1, px, 1,
# rad, s.
PRIOR_SIGMAS = {
    Common.BODY_ROTATION: np.radians(5.0),
    Common.ORIGIN: 0.2,
    Common.SCALE: 0.05,
    Common.BORESIGHT: np.radians(5.0),
    Common.FOCAL: 0.05,
    Common.CENTRE: 100.0,
    Common.DISTORTION: 0.1,
    Common.MOUNTING: np.radians(1.0),
    Common.CLOCK: 2.0,
}
# a boresight is a direction: a roll about it looks much like a turn of the body below
AXES = {
    Common.BODY_ROTATION: ("x", "y", "z"),
    Common.ORIGIN: ("x", "y", "z"),
    Common.SCALE: ("",),
    Common.BORESIGHT: ("x", "y"),
    Common.FOCAL: ("",),
    Common.CENTRE: ("x", "y"),
    Common.DISTORTION: ("k1",),
    Common.MOUNTING: ("x", "y", "z"),
    Common.CLOCK: ("",),
}
OF_THE_CATALOG = (Common.BODY_ROTATION, Common.ORIGIN, Common.SCALE)


@dataclass(frozen=True)
class CommonNumber:
    """One number common to frames: an axis of a rotation vector, rad, or of a shift, m, or a share.

    camera  whose it is; empty for one of the body
    """

    kind: Common
    axis: str = ""
    camera: str = ""
    prior_sigma: float = 1.0

    @property
    def label(self) -> str:
        """Name of the parameter that it is a part of."""
        words = {
            Common.BODY_ROTATION: "the rotation of the body frame",
            Common.ORIGIN: "the origin",
            Common.SCALE: "the scale",
            Common.BORESIGHT: f"the boresight of {self.camera}",
            Common.FOCAL: f"the focal length of {self.camera}",
            Common.CENTRE: f"the principal point of {self.camera} along {self.axis}",
            Common.DISTORTION: f"the distortion {self.axis} of {self.camera}",
            Common.MOUNTING: f"the mounting of {self.camera} about {self.axis}",
            Common.CLOCK: f"the clock of {self.camera}",
        }
        return words[self.kind]


def common_numbers(
    kinds: Sequence[Common], cameras: Sequence[str], radius_m: float
) -> tuple[CommonNumber, ...]:
    """The numbers to solve for, in their order in the state."""
    numbers = []
    for kind in Common:
        if kind not in kinds:
            continue
        owners = [""] if kind in OF_THE_CATALOG else list(cameras)
        sigma = PRIOR_SIGMAS[kind] * (radius_m if kind == Common.ORIGIN else 1.0)
        numbers += [
            CommonNumber(kind, axis, owner, sigma) for owner in owners for axis in AXES[kind]
        ]
    return tuple(numbers)


@dataclass(frozen=True, eq=False)
class CommonState:
    """Values (k,) of the common numbers."""

    numbers: tuple[CommonNumber, ...]
    values: FloatArray

    def part(self, kind: Common, camera: str = "") -> FloatArray:
        """The values of one kind; empty where it is not solved for."""
        return self.values[self.places(kind, camera)]

    def places(self, kind: Common, camera: str = "") -> IntArray:
        """Where they stand."""
        owner = "" if kind in OF_THE_CATALOG else camera
        indices = [i for i, n in enumerate(self.numbers) if (n.kind, n.camera) == (kind, owner)]
        return np.array(indices, dtype=np.int64)

    @property
    def turn(self) -> Rotation:
        """Rotation of the catalog to the frame that positions are stated in."""
        return _rotation(self.part(Common.BODY_ROTATION))

    @property
    def origin_m(self) -> FloatArray:
        """(3,) of the catalog, in that frame."""
        origin = self.part(Common.ORIGIN)
        return origin if origin.size else np.zeros(3)

    @property
    def scale(self) -> float:
        """Scale of the catalog."""
        return 1.0 + float(self.part(Common.SCALE).sum())

    def boresight(self, camera: str) -> Rotation:
        """Return the rotation of a camera from the attitude stated."""
        mounting = self.part(Common.MOUNTING, camera)
        return _rotation(mounting if mounting.size else self.part(Common.BORESIGHT, camera))

    def lens(self, camera: C) -> C:
        """A camera with its lens as solved for."""
        centre = self.part(Common.CENTRE, camera.name)
        shift = centre if centre.size else np.zeros(2)
        k1 = float(self.part(Common.DISTORTION, camera.name).sum())
        return camera.with_lens(self.focal_factor(camera.name), shift, k1)

    def clock_s(self, camera: str) -> float:
        """Return the delay of its pictures after their time stamps, s."""
        return float(self.part(Common.CLOCK, camera).sum())

    def focal_factor(self, camera: str) -> float:
        """Return the ratio of a camera's focal length to that of its file."""
        return 1.0 + float(self.part(Common.FOCAL, camera).sum())

    def places_m(self, catalog_m: FloatArray) -> FloatArray:
        """Places (n, 3) of the catalog in the frame that positions are stated in."""
        turned: FloatArray = self.scale * self.turn.apply(catalog_m) + self.origin_m
        return turned


def _rotation(vector: FloatArray) -> Rotation:
    return Rotation.from_rotvec(np.concatenate([vector, np.zeros(3 - vector.size)]))
