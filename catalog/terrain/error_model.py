"""The error of a terrain model, and what it does to the place of a control point.

One number states it: the rms of (model - truth), averaged over boxes of 2 km on ground whose rms
slope is 0.085. Three measured laws, of `configs/models/terrain.toml`, take it to other boxes and
slopes:

    height of a box of side s          sigma_h(s, m) = error h(s / box) g(m)
    place of a template of side s      sigma_t(s, m) = error t(s / box) g(m) (0.085 / m)

with box = 2 km, m the rms slope and h, t, g tables, interpolated in logarithms. The last factor is
ours: a height error e moves the place where a slope m is recognised by e / m, so that the same
error counts more on flat ground. `t` was measured at m = 0.085, where it is 1.
"""

import math
from functools import cache
from typing import Annotated, Any, NamedTuple

import msgspec
import numpy as np
from numpy.typing import ArrayLike, NDArray

from catalog.arrays import FloatArray
from catalog.config import Positive, load_toml, nearest_name, resource
from catalog.errors import ConfigError

FILE = "configs/models/terrain.toml"
BOX_KM = 2.0  # that error_m of a raster is the rms over
REFERENCE_SLOPE = 0.085  # on which it is stated
MESH = "mesh"  # the product whose error goes by the distance of vertices
# A raster whose resolution nobody states holds no wave shorter than two postings.
POSTINGS_RESOLVED = 2.0

Table = Annotated[tuple[Positive, ...], msgspec.Meta(min_length=2)]


class HeightLaw(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """[height]: sides of boxes over BOX_KM, and rms of their means over error_m."""

    box: Table
    of_error: Table


class ShiftLaw(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """[shift]: sides of templates over BOX_KM, and rms an axis of their places over error_m."""

    template: Table
    of_error: Table


class SlopeLaw(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """[slope]: rms slopes of the ground, and the rms of the error there over error_m."""

    slope: Table
    of_error: Table


class TerrainProduct(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """[product.NAME]: the error of a published terrain model, and where the numbers come from."""

    error_m: Positive
    resolution_km: Positive
    source: str


class MeshProduct(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """[mesh]: error over 1.25 resolutions, and resolution, in distances of vertices."""

    error: Positive
    resolution: Positive
    source: str


class ErrorSpectrum(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Rms error of a model against the size of the ground that is averaged, and against slope.

    box_km, rms_m          sides of squares, rising, and the rms of the error's means over them, on
                           ground of the reference slope
    slope, slope_rms_m     rms slopes, rising, and the rms error of the smallest box on such ground;
                           it stays the same below the first and above the last
    reference_slope        of the ground that rms_m is for
    """

    box_km: tuple[float, ...]
    rms_m: tuple[float, ...]
    slope: tuple[float, ...] = (0.085,)
    slope_rms_m: tuple[float, ...] = (1.0,)
    reference_slope: float = 0.085

    def factor(self, slope: ArrayLike) -> FloatArray:
        """Compute the ratio of the error on ground of an rms slope to `rms_m`."""
        at = np.interp(np.asarray(slope, np.float64), self.slope, self.slope_rms_m)
        factors: FloatArray = at / np.interp(self.reference_slope, self.slope, self.slope_rms_m)
        return factors


class TerrainLaws(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The content of `configs/models/terrain.toml`."""

    height: HeightLaw
    shift: ShiftLaw
    slope: SlopeLaw
    product: dict[str, TerrainProduct]
    mesh: MeshProduct
    spectrum: dict[str, ErrorSpectrum]


class StatedError(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The error of a terrain model as a config states it: a product's name, or numbers.

    error_m        rms of means over 2 km on highland slopes
    resolution_km  the shortest wave that the model holds; without it two postings
    """

    product: str | None = None
    error_m: Positive | None = None
    resolution_km: Positive | None = None

    def find_problem(self, of_mesh: bool) -> str:
        """Return the fault of the statement, "" for none."""
        if self.product is not None and (self.error_m, self.resolution_km) != (None, None):
            return "has a product beside error_m or resolution_km; state one of the two"
        if self.error_m is None and self.resolution_km is not None:
            return "has resolution_km without error_m; add error_m"
        known = [*load_terrain_laws().product, *([MESH] if of_mesh else [])]
        if self.product is not None and self.product not in known:
            near = nearest_name(self.product, known)
            hint = f"did you mean {near!r}?" if near else f"it knows {', '.join(sorted(known))}"
            return f"product is {self.product!r}; {hint}"
        return ""


class TemplateSigma(NamedTuple):
    """The error of one template that a terrain model's error causes, 1 sigma, m.

    shift_m   of its place along the ground, an axis
    height_m  of its mean height
    """

    shift_m: float
    height_m: float


class TerrainErrorModel(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The stated error of one terrain model.

    error_m        rms of the means over boxes of box_km, on ground of slope 0.085
    resolution_km  the shortest wave that the model holds
    box_km         2 for rasters; of a mesh 1.25 resolutions
    source         where the numbers come from
    """

    error_m: Positive
    resolution_km: Positive
    box_km: Positive
    source: str

    @classmethod
    def make(cls, stated: StatedError, posting_m: float) -> "TerrainErrorModel | None":
        """The error of a model of a posting; None where nothing is stated.

        posting_m  of the raster, or distance of the mesh's vertices
        """
        laws = load_terrain_laws()
        if stated.product == MESH:
            mesh = laws.mesh
            resolution = mesh.resolution * posting_m / 1e3
            # GLD100's box of 2 km is 1.25 of its resolutions
            box = resolution * BOX_KM / laws.product["gld100"].resolution_km
            return cls(mesh.error * posting_m, resolution, box, mesh.source)
        if stated.product is not None:
            product = laws.product[stated.product]
            return cls(product.error_m, product.resolution_km, BOX_KM, product.source)
        if stated.error_m is None:
            return None
        resolution = stated.resolution_km or POSTINGS_RESOLVED * posting_m / 1e3
        return cls(stated.error_m, resolution, BOX_KM, "stated in the build config")

    @property
    def against_gld100(self) -> float:
        """Expected residuals of frames on this model over those on GLD100.

        Relief that a model lacks counts as relief that it has wrongly: error and resolution are
        taken against those of GLD100 and added in squares.
        """
        known = load_terrain_laws().product["gld100"]
        parts = self.error_m / known.error_m, self.resolution_km / known.resolution_km
        return math.hypot(*parts) / math.sqrt(2.0)

    def point_sigma_m(self, template_size_m: float, slope: float) -> TemplateSigma:
        """The error of the place of one matched template that comes from the model alone.

        template_size_m  side of the template on the ground: the size decides, not the posting
        slope            rms of the ground's slope over 2 km under it (`measure_rms_slope`)

        It covers all of the difference of model and truth within the template that moves the
        correlation peak, and the error of the template's mean height. It holds neither picture
        noise nor albedo. The part of it that makes reference and picture unlike lowers the score,
        too: a peak covariance that is taken from what the match leaves over sees that part again,
        so the shift must not be added to such a one in full. What it cannot see, and only this
        holds, is what the model warps smoothly: the floor of wide templates, and all of height_m.
        """
        laws = load_terrain_laws()
        # beneath its resolution a model holds nothing that a smaller template could go by
        side = max(template_size_m / 1e3, self.resolution_km) / self.box_km
        slopes = laws.slope.slope
        on = min(max(slope, slopes[0]), slopes[-1]) if math.isfinite(slope) else REFERENCE_SLOPE
        error = self.error_m * _interpolate_table(on, slopes, laws.slope.of_error)
        shift = _interpolate_table(side, laws.shift.template, laws.shift.of_error, downward=True)
        height = _interpolate_table(side, laws.height.box, laws.height.of_error)
        return TemplateSigma(error * shift * REFERENCE_SLOPE / on, error * height)


@cache
def load_terrain_laws() -> TerrainLaws:
    """The laws and products that ship with optnav. Raises ConfigError for a wrong file."""
    laws = load_toml(resource(FILE), TerrainLaws)
    for name, places, values in (
        ("height", laws.height.box, laws.height.of_error),
        ("shift", laws.shift.template, laws.shift.of_error),
        ("slope", laws.slope.slope, laws.slope.of_error),
    ):
        if len(places) != len(values) or (np.diff(places) <= 0.0).any():
            raise ConfigError(f"{FILE}: [{name}] wants ascending places and as many values")
    return laws


def _interpolate_table(
    at: float, places: tuple[float, ...], values: tuple[float, ...], downward: bool = False
) -> float:
    """A table in logarithms; constant beyond its ends, or going on straight below the first."""
    x, y = np.log(places), np.log(values)
    value = float(np.interp(math.log(at), x, y))
    if downward and math.log(at) < x[0]:
        value += float((y[1] - y[0]) / (x[1] - x[0]) * (math.log(at) - x[0]))
    return math.exp(value)


def measure_rms_slope(heights_m: NDArray[Any], posting_m: float, size_m: float) -> float:
    """The rms slope of the ground within a square about the middle of a grid, NaN for none.

    heights_m (n, n), NaN for holes, posting_m apart: state an error by a grid of about 2 km
    """
    count = heights_m.shape[0]
    side = int(np.clip(math.ceil(size_m / posting_m) + 1, 3, count))
    first = (count - side) // 2
    part: FloatArray = heights_m[first : first + side, first : first + side].astype(np.float64)
    down, along = (np.gradient(part, posting_m, axis=axis) for axis in (0, 1))
    squares = np.square(down) + np.square(along)
    known = squares[np.isfinite(squares)]
    return float(np.sqrt(known.mean())) if known.size else math.nan
