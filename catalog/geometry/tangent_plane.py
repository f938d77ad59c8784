"""The map projection of a small body's patch: the plane that touches its reference ellipsoid.

Heights are along the plane's one normal, so that nothing is curved: on a body of a few kilometres
a sphere that fits nowhere would tilt the ground by tens of degrees.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from catalog.arrays import FloatArray
from catalog.geometry.ellipsoid import foot_of, normal_at
from catalog.geometry.latlon import body_from_local, latlon_from_xyz
from catalog.geometry.projection import Stereographic

# What reckons with a sphere under the map takes this radius for a plane: over 100 km of it the
# sphere falls off by 5e-6 m.
FLAT_RADIUS_M = 1e15


@dataclass(frozen=True)
class TangentPlane:
    """The plane that touches a reference ellipsoid below a point.

    lat, lon  rad  direction of the normal: geodetic, not planetocentric
    foot_m    (3,)  where it touches, body frame
    """

    lat: float
    lon: float
    foot_m: tuple[float, float, float]

    @classmethod
    def below(cls, point_m: ArrayLike, radii_m: ArrayLike) -> "TangentPlane":
        """The plane whose normal goes through a point (3,) m; radii_m (3,) of the ellipsoid."""
        foot = foot_of(point_m, radii_m)
        lat, lon, _ = latlon_from_xyz(normal_at(foot, radii_m))
        x, y, z = foot.tolist()
        return cls(float(lat), float(lon), (x, y, z))

    @property
    def radius_m(self) -> float:
        """Of the sphere that heights stand on, for what reckons with one: a plane's."""
        return FLAT_RADIUS_M

    @cached_property
    def body_from_local(self) -> FloatArray:
        """(3, 3): columns east, north, up, in the body frame."""
        return body_from_local(self.lat, self.lon)

    def points(self, x: ArrayLike, y: ArrayLike, height: ArrayLike) -> FloatArray:
        """Body-fixed points (..., 3), m, of map points x, y and heights above the plane."""
        x, y, height = np.broadcast_arrays(x, y, height)
        local = np.stack([x, y, height], axis=-1).astype(np.float64)
        return np.asarray(local @ self.body_from_local.T + np.array(self.foot_m))

    def latlon(
        self, x: ArrayLike, y: ArrayLike, height: ArrayLike = 0.0
    ) -> tuple[FloatArray, FloatArray]:
        """Planetocentric latitude and east longitude (rad) of map points at heights (m)."""
        lat, lon, _ = latlon_from_xyz(self.points(x, y, height))
        return lat, lon

    def xy_from_xyz(self, xyz: ArrayLike) -> tuple[FloatArray, FloatArray]:
        """Map coordinates (m) of body-fixed points (..., 3) m."""
        local = self._local(xyz)
        return local[..., 0], local[..., 1]

    def height_of(self, xyz: ArrayLike) -> FloatArray:
        """Heights (...) m of body-fixed points (..., 3) m above the plane."""
        return self._local(xyz)[..., 2]

    def _local(self, xyz: ArrayLike) -> FloatArray:
        offset = np.asarray(xyz, dtype=np.float64) - np.array(self.foot_m)
        return np.asarray(offset @ self.body_from_local)


MapProjection = Stereographic | TangentPlane
