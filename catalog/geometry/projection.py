"""The map projections of patches.

A patch of a large body is an oblique stereographic map of a sphere, centred on the point. Source:
Snyder, Map Projections - A Working Manual (USGS PP 1395), ch. 21, sphere, k0 = 1. Conformal, so
directions are not distorted; the scale grows as 1 + (rho / 2R)^2.

A patch of a small body is the plane that touches its reference ellipsoid. Heights are along the
plane's one normal, so that nothing is curved: on a body of a few kilometres a sphere that fits
nowhere would tilt the ground by tens of degrees.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike

from catalog.arrays import Float32Array, FloatArray
from catalog.geometry.ellipsoid import compute_normals, find_foot
from catalog.geometry.latlon import body_from_local, latlon_from_xyz, xyz_from_latlon
from catalog.geometry.vectors import unit

Angles = tuple[FloatArray, FloatArray]


class MapProjection(Protocol):
    """The map of a patch: x east and y north, m, about its centre, and heights over a reference."""

    @property
    def lat(self) -> float:
        """Latitude (rad) of the vertical at the centre."""

    @property
    def lon(self) -> float:
        """East longitude (rad) of the vertical at the centre."""

    @property
    def radius_m(self) -> float:
        """Radius of the sphere that heights are measured from; very large for a plane."""

    @property
    def foot_m(self) -> tuple[float, float, float]:
        """The centre on the reference surface, body frame, m."""

    @property
    def body_from_local(self) -> FloatArray:
        """(3, 3): columns east, north, up at the centre, in the body frame."""

    def points(self, x: ArrayLike, y: ArrayLike, height: ArrayLike) -> FloatArray:
        """Body-fixed points (..., 3), m, of map points x, y and heights."""

    def nodes(self, heights: Float32Array, posting_m: float) -> FloatArray:
        """Body-fixed points (n, n, 3), m, of a centred grid of heights (n, n), north up."""

    def latlon(self, x: ArrayLike, y: ArrayLike, height: ArrayLike = 0.0) -> Angles:
        """Planetocentric latitude and east longitude (rad) of map points at heights (m)."""

    def xy_from_xyz(self, xyz: ArrayLike) -> tuple[FloatArray, FloatArray]:
        """Map coordinates (m) of body-fixed points (..., 3) m."""

    def height_of(self, xyz: ArrayLike) -> FloatArray:
        """Heights (...) m of body-fixed points (..., 3) m."""

    def downward(self, points_m: FloatArray) -> FloatArray:
        """Unit vectors (n, 3), body frame, along which heights fall at points (n, 3) m."""

    def sun_latitude_deg(self, lat_deg: float) -> float:
        """Latitude (deg) over the equator of the vertical at a centre of planetocentric lat_deg."""


# The radius of a plane, for what computes with a sphere under the map: over 100 km of it the
# sphere falls off by 5e-6 m.
FLAT_RADIUS_M = 1e15


@dataclass(frozen=True)
class Stereographic:
    """Oblique stereographic projection of a sphere about (lat, lon).

    lat, lon  rad  the centre; radius_m  the sphere that heights are measured from
    """

    lat: float
    lon: float
    radius_m: float

    @cached_property
    def body_from_local(self) -> FloatArray:
        """(3, 3): columns east, north, up at the centre, in the body frame."""
        return body_from_local(self.lat, self.lon)

    def local_directions(self, x: ArrayLike, y: ArrayLike) -> FloatArray:
        """Unit vectors (..., 3) in the centre's east, north, up frame of map points x, y (m)."""
        x, y = np.asarray(x, dtype=np.float64), np.asarray(y, dtype=np.float64)
        # The map point is the tangent of half the angle: all stays rational, no trigonometry.
        u, v = x / (2.0 * self.radius_m), y / (2.0 * self.radius_m)
        squared = u * u + v * v
        scale = 1.0 / (1.0 + squared)
        return np.stack([2.0 * u * scale, 2.0 * v * scale, (1.0 - squared) * scale], axis=-1)

    def points(self, x: ArrayLike, y: ArrayLike, height: ArrayLike) -> FloatArray:
        """Body-fixed points (..., 3), m, of map points x, y and heights above the sphere."""
        # a command that only lists points need not wait for the compiler to load
        from catalog.geometry.grid import compute_map_points

        x, y, height = np.broadcast_arrays(x, y, height)
        east, north, above = (np.ravel(part).astype(np.float64) for part in (x, y, height))
        points = compute_map_points(east, north, above, self.radius_m, self.body_from_local)
        return points.reshape(*x.shape, 3)

    def nodes(self, heights: Float32Array, posting_m: float) -> FloatArray:
        """Body-fixed points (n, n, 3), m, of a centred grid of heights (n, n), north up."""
        from catalog.geometry.grid import compute_node_points

        offsets = make_node_offsets(len(heights), posting_m)
        return compute_node_points(offsets, heights, self.radius_m, self.body_from_local)

    def latlon(self, x: ArrayLike, y: ArrayLike, height: ArrayLike = 0.0) -> Angles:
        """Latitude and east longitude (rad) of map points x, y (m), whatever their height."""
        directions = np.asarray(self.local_directions(x, y) @ self.body_from_local.T)
        lat, lon, _ = latlon_from_xyz(directions)
        return lat, lon

    def xy_from_xyz(self, xyz: ArrayLike) -> tuple[FloatArray, FloatArray]:
        """Map coordinates (m) of body-fixed directions or points (..., 3) of any length.

        The antipode of the centre has no finite place: it gives infinities or NaN.
        """
        local = np.asarray(xyz, dtype=np.float64) @ self.body_from_local
        length = np.linalg.norm(local, axis=-1)
        with np.errstate(divide="ignore", invalid="ignore"):
            factor = 2.0 * self.radius_m / (length + local[..., 2])
            return np.asarray(factor * local[..., 0]), np.asarray(factor * local[..., 1])

    @property
    def foot_m(self) -> tuple[float, float, float]:
        """Where the centre touches the sphere, body frame, m."""
        x, y, z = (self.radius_m * self.body_from_local[:, 2]).tolist()
        return x, y, z

    def height_of(self, xyz: ArrayLike) -> FloatArray:
        """Heights (...) m of body-fixed points (..., 3) m above the sphere."""
        length = np.linalg.norm(np.asarray(xyz, dtype=np.float64), axis=-1)
        return np.asarray(length - self.radius_m)

    def downward(self, points_m: FloatArray) -> FloatArray:
        """Unit vectors (n, 3) towards the sphere's centre at points (n, 3) m."""
        return -unit(points_m)

    def sun_latitude_deg(self, lat_deg: float) -> float:
        """The planetocentric latitude itself: the vertical goes through the body's centre."""
        return lat_deg

    def xy_from_latlon(self, lat: ArrayLike, lon: ArrayLike) -> tuple[FloatArray, FloatArray]:
        """Map coordinates (m) of latitudes and longitudes (rad)."""
        return self.xy_from_xyz(xyz_from_latlon(lat, lon, 1.0))


@dataclass(frozen=True)
class TangentPlane:
    """The plane that touches a reference ellipsoid below a point, or the ground at the point.

    lat, lon  rad  direction of the normal: geodetic, not planetocentric
    foot_m    (3,)  where it touches, body frame
    """

    lat: float
    lon: float
    foot_m: tuple[float, float, float]

    @classmethod
    def make_below(cls, point_m: ArrayLike, radii_m: ArrayLike) -> "TangentPlane":
        """The plane whose normal goes through a point (3,) m; radii_m (3,) of the ellipsoid."""
        foot = find_foot(point_m, radii_m)
        lat, lon, _ = latlon_from_xyz(compute_normals(foot, radii_m))
        x, y, z = foot.tolist()
        return cls(float(lat), float(lon), (x, y, z))

    @classmethod
    def make_through(cls, point_m: FloatArray, lat: float, lon: float) -> "TangentPlane":
        """The plane through a point (3,) m whose normal has a latitude and longitude (rad)."""
        x, y, z = point_m.tolist()
        return cls(lat, lon, (x, y, z))

    @property
    def radius_m(self) -> float:
        """Radius of the sphere that heights are measured from: a plane's."""
        return FLAT_RADIUS_M

    @cached_property
    def body_from_local(self) -> FloatArray:
        """(3, 3): columns east, north, up, in the body frame."""
        return body_from_local(self.lat, self.lon)

    def points(self, x: ArrayLike, y: ArrayLike, height: ArrayLike) -> FloatArray:
        """Body-fixed points (..., 3), m, of map points x, y and heights above the plane."""
        x, y, height = np.broadcast_arrays(x, y, height)
        local = np.stack([x, y, height], axis=-1).astype(np.float64)
        points: FloatArray = local @ self.body_from_local.T + np.array(self.foot_m)
        return points

    def nodes(self, heights: Float32Array, posting_m: float) -> FloatArray:
        """Body-fixed points (n, n, 3), m, of a centred grid of heights (n, n), north up."""
        return self.points(*make_node_grid(len(heights), posting_m), heights)

    def latlon(self, x: ArrayLike, y: ArrayLike, height: ArrayLike = 0.0) -> Angles:
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

    def downward(self, points_m: FloatArray) -> FloatArray:
        """The plane's one downward normal, for each of points (n, 3) m."""
        return np.broadcast_to(-self.body_from_local[:, 2], points_m.shape)

    def sun_latitude_deg(self, lat_deg: float) -> float:
        """Latitude (deg) of the plane's normal."""
        return float(np.degrees(self.lat))

    def _local(self, xyz: ArrayLike) -> FloatArray:
        offset = np.asarray(xyz, dtype=np.float64) - np.array(self.foot_m)
        local: FloatArray = offset @ self.body_from_local
        return local


def make_node_offsets(size: int, posting_m: float) -> FloatArray:
    """Map x of the columns of a centred grid (m); the rows' y are its negative."""
    nodes = np.arange(size, dtype=np.float64)
    return (nodes - (size - 1) / 2.0) * posting_m


def make_node_grid(size: int, posting_m: float) -> tuple[FloatArray, FloatArray]:
    """Map x (east) and y (north) of all nodes, each (size, size); row 0 is the northernmost."""
    offsets = make_node_offsets(size, posting_m)
    x, y = np.meshgrid(offsets, -offsets)
    return x, y
