"""The usable control points of a catalog: arrays for choosing, patches loaded on demand."""

from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from catalog.control_point import ControlPoint, Patch
from catalog.errors import DataError
from optnav_cli.matching.reference import Reference

FloatArray = NDArray[np.float64]


class PointStore(Protocol):
    """What navigation needs of a catalog."""

    def patches(self, cp_id: int) -> tuple[Patch, ...]:
        """The levels of a point, finest first; DataError when they are damaged."""
        ...


@dataclass
class ControlPointField:
    """The usable points of a catalog, as arrays, and their patches, loaded when first needed.

    points      (n,) the usable control points
    xyz_m       (n, 3) body-fixed
    skyline_deg (n, 36) terrain skyline by azimuth
    damaged     ids whose patches could not be read; they are never used
    """

    store: PointStore
    points: list[ControlPoint]
    postings_m: FloatArray
    radius_m: float
    xyz_m: FloatArray = field(init=False)
    skyline_deg: FloatArray = field(init=False)
    damaged: dict[int, str] = field(default_factory=dict)
    _references: dict[int, Reference] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.xyz_m = np.array([p.xyz_m for p in self.points]).reshape(-1, 3)
        self.skyline_deg = np.array([p.shadow_limit_deg for p in self.points])

    def reference(self, index: int) -> Reference | None:
        """The point at a place in `points`, ready to render; None when its patches are damaged."""
        point = self.points[index]
        if point.id in self.damaged:
            return None
        if point.id not in self._references:
            try:
                patches = self.store.patches(point.id)
            except DataError as error:
                self.damaged[point.id] = str(error)
                return None
            self._references[point.id] = Reference(point, patches, self.radius_m)
        return self._references[point.id]

    def half_sizes_m(self, level: int) -> list[float]:
        """Half a side of the patches from a level up, m."""
        size = next(iter(self._references.values())).patches[0].size if self._references else 0
        return [(size - 1) / 2.0 * float(p) for p in self.postings_m[level:]]
