"""points.csv of a picture folder: places that a person found in its pictures."""

from collections.abc import Collection
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from catalog.arrays import FloatArray
from catalog.bodies.body import Body
from catalog.config import nearest_name
from catalog.errors import DataError
from catalog.geometry.ellipsoid import project_to_surface
from catalog.geometry.latlon import xyz_from_latlon
from catalog.tables import CsvRow
from optnav_cli.frames.run_settings import PointsSettings
from optnav_cli.frames.tables import PICKED_POINTS

POINTS_CSV = "points.csv"
MAX_SIGMA_PX, MAX_SIGMA_M = 1e4, 1e7


@dataclass(frozen=True)
class PickedPoint:
    """A row of points.csv.

    pixel      (2,) x, y;  sigma_px  1 sigma a coordinate
    latlon_deg (2,) and height_m as `[points]` of run.toml says
    sigma_m    1 sigma of the place, a coordinate
    name       once in a picture
    """

    file: str
    name: str
    pixel: FloatArray
    latlon_deg: FloatArray
    height_m: float
    sigma_px: float
    sigma_m: float


def read_picked_points(
    path: Path, files: Collection[str], body: Body, settings: PointsSettings
) -> dict[str, list[PickedPoint]]:
    """The points of each picture, in the order of the file.

    files  the pictures of frames.csv

    Raises DataError, with line and column, for a file that cannot be read, a picture that
    frames.csv lacks, a name twice in a picture, a number that is missing or cannot be.
    """
    by_picture: dict[str, list[PickedPoint]] = {}
    for point, row in PICKED_POINTS.read(path, lambda row: (_read_point(row), row)):
        near = nearest_name(point.file, sorted(files))
        if point.file not in files:
            hint = f"did you mean '{near}'?" if near else "add a row for it there"
            raise DataError(
                f"{row.where}: file is '{point.file}', which frames.csv does not have; {hint}"
            )
        others = by_picture.setdefault(point.file, [])
        name = point.name or str(len(others) + 1)
        if any(other.name == name for other in others):
            raise DataError(
                f"{row.where}: name '{name}' stands twice for '{point.file}'; give each point of "
                "a picture its own"
            )
        named = PickedPoint(
            point.file,
            name,
            point.pixel,
            point.latlon_deg,
            point.height_m,
            point.sigma_px,
            point.sigma_m,
        )
        _check_height(named, row.where, body, settings)
        others.append(named)
    return by_picture


def locate_points(
    latlon_deg: FloatArray, heights_m: FloatArray, body: Body, settings: PointsSettings
) -> FloatArray:
    """Body-fixed places (n, 3), m, of latitudes and longitudes (n, 2) and heights (n,).

    A planetocentric latitude with a height above the ellipsoid takes the height along the radius:
    at the Earth 5 cm off for 8 km.
    """
    lat, lon = np.radians(latlon_deg).T
    if settings.latitude == "planetocentric":
        directions = xyz_from_latlon(lat, lon, np.ones(len(lat)))
        base = np.full(len(lat), body.radius_m)
        if settings.height == "ellipsoid":
            base = np.linalg.norm(project_to_surface(directions, body.radii_m), axis=1)
        on_radius: FloatArray = directions * (base + heights_m)[:, None]
        return on_radius
    a, _, c = body.radii_m
    up = xyz_from_latlon(lat, lon, np.ones(len(lat)))
    squared = 1.0 - (c / a) ** 2
    across = a / np.sqrt(1.0 - squared * np.sin(lat) ** 2)
    foot = up * np.stack([across, across, across * (1.0 - squared)], axis=1)
    if settings.height == "ellipsoid":
        placed: FloatArray = foot + up * heights_m[:, None]
        return placed
    # along the normal to the distance that the sphere and the height ask for
    along = (foot * up).sum(axis=1)
    wanted = (body.radius_m + heights_m) ** 2 - (foot * foot).sum(axis=1)
    raised: FloatArray = foot + up * (np.sqrt(along**2 + wanted) - along)[:, None]
    return raised


def _read_point(row: CsvRow) -> PickedPoint:
    numbers = {
        name: row.number(name)
        for name in ("x_px", "y_px", "lat_deg", "lon_deg", "height_m", "sigma_px", "sigma_m")
    }
    known = {name: value for name, value in numbers.items() if value is not None}
    if not row["file"]:
        raise DataError("file is empty; wanted the picture's name in frames.csv")
    for name, least, most, wanted in (
        ("x_px", -1e6, 1e6, "pixels"),
        ("y_px", -1e6, 1e6, "pixels"),
        ("lat_deg", -90.0, 90.0, "-90 to 90 degrees"),
        ("lon_deg", -360.0, 360.0, "-360 to 360 degrees, east positive"),
        ("height_m", -1e9, 1e9, "metres"),
        ("sigma_px", 1e-6, MAX_SIGMA_PX, f"over 0 and up to {MAX_SIGMA_PX:g} px"),
        ("sigma_m", 0.0, MAX_SIGMA_M, f"0 to {MAX_SIGMA_M:g} m"),
    ):
        if not least <= known[name] <= most:
            hint = "; are latitude and longitude exchanged?" if name == "lat_deg" else ""
            raise DataError(f"{name} is {row[name]}; wanted {wanted}{hint}")
    return PickedPoint(
        row["file"],
        row["name"],
        np.array([known["x_px"], known["y_px"]]),
        np.array([known["lat_deg"], known["lon_deg"]]),
        known["height_m"],
        known["sigma_px"],
        known["sigma_m"],
    )


def _check_height(point: PickedPoint, where: str, body: Body, settings: PointsSettings) -> None:
    xyz_m = locate_points(point.latlon_deg[None], np.array([point.height_m]), body, settings)[0]
    height = float(np.linalg.norm(xyz_m)) - body.radius_m
    lowest, highest = body.plausible_heights_m
    if not lowest <= height <= highest:
        raise DataError(
            f"{where}: height_m is {point.height_m:g}, which puts '{point.name}' {height:.0f} m "
            f"above the sphere of the {body.name}; wanted {lowest:g} to {highest:g} m: heights are "
            "metres above what [points] of run.toml names"
        )
