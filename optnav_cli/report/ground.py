"""Maps for reports: places on a body about their middle, with a graticule of their own."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from catalog.arrays import FloatArray
from catalog.geometry.latlon import (
    angular_distance,
    latlon_from_xyz,
    wrap_longitude_deg,
    xyz_from_latlon,
)
from catalog.geometry.projection import Stereographic
from optnav_cli.report.svg import WIDE, Plot, number_text, span

MAX_RADIUS_DEG = 50.0  # beyond, a plain grid of longitude and latitude takes over
STEPS_DEG = (0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0, 20.0, 30.0)
LABEL_ROOM_PX = 45.0
WHOLE_HEIGHT = 496  # makes a degree as high as it is wide, at a plot's full width
DEGREE = "\N{DEGREE SIGN}"


@dataclass(frozen=True, eq=False)
class GroundMap:
    """A way from latitude and longitude (deg) to map coordinates.

    Stereographic about the middle of the places, in km, so that poles and ±180° are nothing
    special; for places all over a body longitude and latitude themselves.
    """

    centre_deg: tuple[float, float]
    radius_m: float
    regional: bool

    @classmethod
    def about(cls, lat_deg: ArrayLike, lon_deg: ArrayLike, radius_m: float) -> "GroundMap":
        """A map that suits these places (n,), at least one."""
        lat, lon = np.radians(lat_deg), np.radians(lon_deg)
        middle = xyz_from_latlon(lat, lon, 1.0).reshape(-1, 3).mean(axis=0)
        lat0, lon0, _ = latlon_from_xyz(middle)
        reach = np.degrees(np.max(angular_distance(lat0, lon0, lat, lon)))
        regional = bool(reach <= MAX_RADIUS_DEG)
        centre = (float(np.degrees(lat0)), float(np.degrees(lon0))) if regional else (0.0, 0.0)
        return cls(centre, radius_m, regional)

    def places(self, lat_deg: ArrayLike, lon_deg: ArrayLike) -> tuple[FloatArray, FloatArray]:
        """Map coordinates x, y of places (...)."""
        lat, lon = np.asarray(lat_deg, np.float64), np.asarray(lon_deg, np.float64)
        if not self.regional:
            return wrap_longitude_deg(lon), lat
        lat0, lon0 = np.radians(self.centre_deg)
        directions = xyz_from_latlon(np.radians(lat), np.radians(lon), 1.0)
        x, y = Stereographic(lat0, lon0, self.radius_m).xy_from_xyz(directions)
        return x / 1e3, y / 1e3

    def latlon(self, x: ArrayLike, y: ArrayLike) -> tuple[FloatArray, FloatArray]:
        """Latitude and longitude (deg) of map coordinates x, y (...)."""
        x, y = np.asarray(x, np.float64), np.asarray(y, np.float64)
        if not self.regional:
            return y, x
        lat0, lon0 = np.radians(self.centre_deg)
        lat, lon = Stereographic(lat0, lon0, self.radius_m).latlon(1e3 * x, 1e3 * y)
        return np.degrees(lat), np.degrees(lon)

    def plot(self, x: ArrayLike, y: ArrayLike, width: int = WIDE, height: int = 600) -> Plot:
        """An empty map that holds the map coordinates x, y (n,), with its graticule."""
        if not self.regional:
            return Plot(
                (-180.0, 180.0), (-90.0, 90.0), x_label="longitude, deg", y_label="latitude, deg",
                width=width, height=WHOLE_HEIGHT, equal=True,
            )  # fmt: skip
        lat0, lon0 = (number_text(round(v, 2)) + DEGREE for v in self.centre_deg)
        plot = Plot(
            span(x, 0.04), span(y, 0.04), width=width, height=height, equal=True, axes=False,
            x_label=f"stereographic about {lat0}, {lon0}; "
            f"the map is {self._across_km(x, y, width, height):.0f} km wide",
        )  # fmt: skip
        self._graticule(plot)
        return plot

    def _across_km(self, x: ArrayLike, y: ArrayLike, width: int, height: int) -> float:
        plot = Plot(span(x, 0.04), span(y, 0.04), width=width, height=height, equal=True)
        return plot.x[1] - plot.x[0]

    def _graticule(self, plot: Plot) -> None:
        km_per_deg = np.radians(self.radius_m) / 1e3
        reach = max(plot.x[1] - plot.x[0], plot.y[1] - plot.y[0]) / 2.0 / km_per_deg
        step = next((s for s in STEPS_DEG if s >= reach / 2.5), STEPS_DEG[-1])
        lat0, lon0 = self.centre_deg
        lats = np.arange(np.floor((lat0 - 2 * reach) / step), (lat0 + 2 * reach) / step + 1) * step
        lats = lats[np.abs(lats) < 90.0]
        narrowing = max(np.cos(np.radians(min(abs(lat0) + reach, 89.0))), 0.05)
        lon_step = next((s for s in STEPS_DEG if s >= reach / 2.5 / narrowing), 30.0)
        half = min(2 * reach / narrowing, 180.0)
        lons = (
            np.arange(np.floor((lon0 - half) / lon_step), (lon0 + half) / lon_step + 1) * lon_step
        )
        along = np.linspace(-1.0, 1.0, 61)
        taken: list[FloatArray] = []
        for lat in lats:
            x, y = self.places(np.full(61, lat), lon0 + half * along)
            plot.line(x, y, "faint thin")
            self._name(plot, (x, y), float(lat), taken)
        reachable = np.clip(lat0 + 2 * reach * along, -89.9, 89.9)
        for lon in np.unique(wrap_longitude_deg(lons)):
            x, y = self.places(reachable, np.full(61, lon))
            plot.line(x, y, "faint thin")
            self._name(plot, (x, y), float(lon), taken)

    def _name(
        self, plot: Plot, line: tuple[FloatArray, FloatArray], value: float, taken: list[FloatArray]
    ) -> None:
        """Write a graticule line's number where the line enters the map, unless another is near."""
        place = _entry(plot, *line)
        if place is None:
            return
        at = np.array([float(plot.px(place[0])), float(plot.py(place[1]))])
        if all(np.linalg.norm(at - other) > LABEL_ROOM_PX for other in taken):
            taken.append(at)
            plot.text(*place, number_text(round(value, 3)) + DEGREE, "place")


def _entry(plot: Plot, x: FloatArray, y: FloatArray) -> tuple[float, float] | None:
    """Where a line crosses the map's left edge or, if nowhere, its lower one; a little inside."""
    shift = 0.008 * (plot.x[1] - plot.x[0])
    for along, other, edge, limits, left in (
        (x, y, plot.x[0], plot.y, True),
        (y, x, plot.y[0], plot.x, False),
    ):
        for k in np.flatnonzero((along[:-1] - edge) * (along[1:] - edge) < 0.0):
            share = (edge - along[k]) / (along[k + 1] - along[k])
            where = float(other[k] + share * (other[k + 1] - other[k]))
            room = 0.04 * (limits[1] - limits[0])
            if limits[0] + room < where < limits[1] - room:
                return (edge + shift, where) if left else (where + shift, edge + shift)
    return None
