"""A control point: a place on a body that a camera can recognise, and what is known about it."""

from dataclasses import dataclass, field
from enum import IntFlag

import numpy as np

from catalog.arrays import Float32Array, FloatArray
from catalog.geometry.latlon import xyz_from_latlon
from catalog.geometry.projection import Stereographic, TangentPlane

SHADOW_AZIMUTHS = 36  # skyline bins, centred on 0, 10, ... degrees east of north


class Flag(IntFlag):
    """Why a control point is not usable, or what to know about it."""

    NONE = 0
    NO_DATA = 1
    FLAT = 2
    NOT_UNIQUE = 4
    NOT_RECOGNISED = 8
    CROWDED = 16
    SHADOWED = 32
    OVERHANG = 64
    DISPLACED = 128

    @property
    def label(self) -> str:
        """The flags in words, comma-separated, everywhere the same: "flat, not unique"."""
        members = Flag.__members__.items()
        return ", ".join(name.lower().replace("_", " ") for name, bit in members if self & bit)


# In the order in which the checks run.
FLAG_MEANINGS = {
    Flag.NO_DATA: "a patch has holes",
    Flag.FLAT: "the predicted match error is above the limit",
    Flag.NOT_UNIQUE: "a rival nearby looks too similar",
    Flag.SHADOWED: "foreign shadows reach the patch at most Suns",
    Flag.NOT_RECOGNISED: "recognition trials failed",
    Flag.CROWDED: "nearer to a neighbour's point than the spacing allows",
    Flag.OVERHANG: "vertical lines through the patch meet the ground several times",
    Flag.DISPLACED: "the comparison model has it farther away than the limit",
}


@dataclass(frozen=True)
class ComparisonShift:
    """Where a second terrain model has the ground of a control point, seen from the catalog's.

    east_m, north_m  NaN where nothing within the search looks like it
    level            that was compared, 0 is the finest
    score            correlation, mean over the Suns
    """

    east_m: float
    north_m: float
    level: int
    score: float

    @property
    def distance_m(self) -> float:
        """Length of the shift, m; NaN where it is unknown."""
        return float(np.hypot(self.east_m, self.north_m))


@dataclass(frozen=True)
class Patch:
    """Heights, and perhaps brightness, around a control point at one pyramid level.

    heights_m (n, n) float32, NaN for no data; row 0 is north, column 0 west, in the point's
    projection: above the body's reference sphere in the oblique stereographic one, above the plane
    in a tangent plane. brightness (n, n) float32 of an orthoimage, any unit, NaN for none.
    """

    posting_m: float
    heights_m: Float32Array
    brightness: Float32Array | None = None

    @property
    def size(self) -> int:
        """Nodes a side."""
        return int(self.heights_m.shape[0])


@dataclass(frozen=True)
class ControlPoint:
    """One control point with its certificate; patches are loaded apart.

    localisation_nodes   predicted 1-sigma match error, nodes of the finest level, worst direction
    hessian_eigenvalue   smallest eigenvalue, worst Sun azimuth, of the summed products of second
                         differences of height/posting over the finest template (dimensionless)
    recognition_rate     share of passed recognition trials, of the `trials` that were run
    uniqueness           (levels,) margin between the true place and its best rival
    shadow_limit_deg     (36,) Sun elevation by azimuth above which no foreign shadow reaches
                         the patch
    source               which DEMs its finest patch comes from, joined by " + ": the one that
                         counts most at the point first
    comparison           its place in a second model; None without one, or where that has no ground
    vertical_deg         latitude and longitude of the normal of the plane that its patches lie in,
                         where that is the plane of the ground itself; None: of the body's figure
    """

    id: int
    lat_deg: float
    lon_deg: float
    radius_m: float
    localisation_nodes: float
    hessian_eigenvalue: float
    recognition_rate: float
    trials: int
    uniqueness: tuple[float, ...]
    shadow_limit_deg: tuple[float, ...]
    usable: bool
    flags: Flag = Flag.NONE
    source: str = ""
    comparison: ComparisonShift | None = None
    vertical_deg: tuple[float, float] | None = None

    @property
    def xyz_m(self) -> FloatArray:
        """(3,) body-fixed position, m."""
        return xyz_from_latlon(np.radians(self.lat_deg), np.radians(self.lon_deg), self.radius_m)

    def projection(self, body_radius_m: float) -> Stereographic:
        """The map projection of this point's patches on a body whose catalog is on a sphere."""
        return Stereographic(np.radians(self.lat_deg), np.radians(self.lon_deg), body_radius_m)

    def tangent_plane(self, radii_m: tuple[float, float, float]) -> TangentPlane:
        """Return the plane of the patches: of the ground, or tangent to an ellipsoid."""
        if self.vertical_deg is None:
            return TangentPlane.make_below(self.xyz_m, radii_m)
        return TangentPlane.make_through(self.xyz_m, *np.radians(self.vertical_deg).tolist())


@dataclass(frozen=True)
class Pyramid:
    """A control point together with its patches, finest first."""

    point: ControlPoint
    levels: tuple[Patch, ...] = field(default_factory=tuple)
