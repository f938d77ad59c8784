"""Latitude, longitude, radius and body-fixed vectors; all angles in radians."""

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from catalog.arrays import FloatArray


class Lattice(NamedTuple):
    """A grid of equal steps of latitude and longitude, of the body or of a turned frame.

    north, west  the first node; rows run south, columns east
    """

    north: float
    west: float
    step: float
    rows: int
    cols: int

    @property
    def lat(self) -> FloatArray:
        """Latitudes (rows,)."""
        return self.north - self.step * np.arange(self.rows, dtype=np.float64)

    @property
    def lon(self) -> FloatArray:
        """Longitudes (cols,)."""
        return self.west + self.step * np.arange(self.cols, dtype=np.float64)


def xyz_from_latlon(lat: ArrayLike, lon: ArrayLike, radius: ArrayLike) -> FloatArray:
    """Body-fixed vectors of planetocentric coordinates.

    lat, lon, radius  (...)  rad, rad east, any length unit
    Returns (..., 3) in the unit of `radius`.
    """
    lat, lon, radius = np.broadcast_arrays(lat, lon, radius)
    across = radius * np.cos(lat)
    xyz = across * np.cos(lon), across * np.sin(lon), radius * np.sin(lat)
    return np.stack(xyz, axis=-1).astype(np.float64)


def latlon_from_xyz(xyz: ArrayLike) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Planetocentric latitude, east longitude in [-pi, pi) and radius of (..., 3) vectors."""
    xyz = np.asarray(xyz, dtype=np.float64)
    x, y, z = xyz[..., 0], xyz[..., 1], xyz[..., 2]
    equatorial = np.hypot(x, y)
    return np.arctan2(z, equatorial), wrap_longitude(np.arctan2(y, x)), np.hypot(equatorial, z)


def wrap_longitude(lon: ArrayLike) -> FloatArray:
    """Longitudes brought into [-pi, pi)."""
    wrapped = np.mod(np.asarray(lon, dtype=np.float64) + np.pi, 2.0 * np.pi) - np.pi
    # mod of a tiny negative number rounds up to the period itself
    return np.where(wrapped >= np.pi, -np.pi, wrapped)


def wrap_longitude_deg(lon_deg: ArrayLike) -> FloatArray:
    """Longitudes in degrees brought into [-180, 180)."""
    wrapped = np.mod(np.asarray(lon_deg, dtype=np.float64) + 180.0, 360.0) - 180.0
    return np.where(wrapped >= 180.0, -180.0, wrapped)


def body_from_local(lat: float, lon: float) -> FloatArray:
    """Rotation (3, 3) whose columns are east, north and up at a point, in the body frame.

    At a pole the longitude still defines east, so the axes stay defined.
    """
    sin_lat, cos_lat = np.sin(lat), np.cos(lat)
    sin_lon, cos_lon = np.sin(lon), np.cos(lon)
    return np.array(
        [
            [-sin_lon, -sin_lat * cos_lon, cos_lat * cos_lon],
            [cos_lon, -sin_lat * sin_lon, cos_lat * sin_lon],
            [0.0, cos_lat, sin_lat],
        ]
    )


def angular_distance(
    lat1: ArrayLike, lon1: ArrayLike, lat2: ArrayLike, lon2: ArrayLike
) -> FloatArray:
    """Great-circle angle between points, accurate from 0 to pi (Vincenty's arctangent form)."""
    lat1, lon1, lat2, lon2 = (np.asarray(v, dtype=np.float64) for v in (lat1, lon1, lat2, lon2))
    dlon = lon2 - lon1
    across = np.cos(lat2) * np.sin(dlon)
    along = np.cos(lat1) * np.sin(lat2) - np.sin(lat1) * np.cos(lat2) * np.cos(dlon)
    cosine = np.sin(lat1) * np.sin(lat2) + np.cos(lat1) * np.cos(lat2) * np.cos(dlon)
    return np.asarray(np.arctan2(np.hypot(across, along), cosine))
