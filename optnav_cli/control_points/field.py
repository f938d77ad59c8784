"""The usable control points of one or more catalogs: arrays for choosing, points on demand."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import compress
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from catalog.arrays import BoolArray, FloatArray, IndexArray, IntArray
from catalog.bodies.body import Body
from catalog.cache import Cache
from catalog.control_point import ControlPoint, Patch
from catalog.errors import DataError
from catalog.geometry.cells import CellGrid
from catalog.geometry.latlon import latlon_from_xyz
from catalog.geometry.vectors import unit
from catalog.photometry.laws import SurfaceLaw, find_law
from catalog.photometry.sets import PhotometricSet, load_sets
from catalog.store.index import CELL_SLACK_DEG
from catalog.store.manifest import PlanesMeta
from catalog.terrain.error_model import TerrainErrorModel, measure_rms_slope
from optnav_cli.control_points.reference import Reference
from optnav_cli.estimation.models.points import correct_refraction


class PointStore(Protocol):
    """Access that navigation needs to a catalog."""

    def point(self, point_id: int) -> ControlPoint:
        """A point with its certificate."""

    def patches(self, point_id: int) -> tuple[Patch, ...]:
        """The levels of a point, finest first; DataError when they are damaged."""


# Sides of squares, m, that divide a stated error into bands, each of waves longer than the last's.
BAND_SIDES_M: FloatArray = np.array([19e3 / 2**k for k in range(6, -1, -1)])


class StatedBands(NamedTuple):
    """Errors of a template by the stated error of its terrain model, by width of the ground.

    sides_m   (k,) rising: an error of a band is alike over about such a side
    sigmas_m  (k, 2) 1 sigma of the place per axis and of the mean height; their squares add up
    """

    sides_m: FloatArray
    sigmas_m: FloatArray

    def measure_shift_m(self) -> float:
        """Measure 1 sigma of the place per axis by all bands, m."""
        return float(np.linalg.norm(self.sigmas_m[:, 0]))


NOT_STATED = StatedBands(BAND_SIDES_M, np.zeros((len(BAND_SIDES_M), 2)))


@dataclass(frozen=True)
class PointLayer:
    """The usable points of one catalog.

    name         of the catalog in matches.csv and messages
    grid         the cells of the catalog: a point's id is its cell
    ids          (n,) ascending
    xyz_m        (n, 3) body-fixed
    skyline_deg  (n, azimuths) terrain skyline by azimuth
    postings_m   (levels,) of the patches, finest first
    radius_m     the body's reference sphere
    planes       the tangent planes in which patches lie; None: on the sphere
    errors       (n,) stated errors of the terrain models that the points are of, None for one
                 without; empty where none is stated
    body         whose air bends lines of sight; None: without air
    photometry   the set that the catalog was built with
    image_error_m  1 sigma per axis of the image that templates are cut from; None: of relief
    """

    name: str
    store: PointStore
    grid: CellGrid
    ids: IntArray
    xyz_m: FloatArray
    skyline_deg: NDArray[np.floating]
    postings_m: FloatArray
    radius_m: float
    planes: PlanesMeta | None = None
    errors: tuple[TerrainErrorModel | None, ...] = ()
    body: Body | None = None
    photometry: PhotometricSet = load_sets("moon")[0]
    image_error_m: float | None = None

    @property
    def law(self) -> SurfaceLaw:
        """The law that its points are drawn by."""
        return find_law("hapke", self.photometry.surface)

    @property
    def verticals(self) -> FloatArray:
        """(n, 3) outward normals at the points: of their planes where patches lie in such."""
        if self.planes is None:
            return unit(self.xyz_m)
        return self.planes.compute_verticals(self.ids, self.xyz_m)

    @property
    def known_m(self) -> float:
        """Finest posting that holds relief: a patch knows no more than its terrain model."""
        posting = float(self.postings_m[0])
        return posting if self.planes is None else max(posting, self.planes.model_posting_m)

    def subset(self, keep: BoolArray) -> "PointLayer":
        """The layer with some of its points."""
        return replace(
            self,
            ids=self.ids[keep],
            xyz_m=self.xyz_m[keep],
            skyline_deg=self.skyline_deg[keep],
            errors=tuple(compress(self.errors, keep)),
        )


class ControlPointField:
    """Control points as arrays, one entry each, layer by layer; patches loaded when first needed.

    layers       one a catalog; an earlier one has priority: a point of a later one that lies
                 within a cell's size of an earlier one's point is left out
    xyz_m        (n, 3) body-fixed
    verticals    (n, 3) outward normals at the points
    skyline_deg  (n, 36) terrain skyline by azimuth
    layer_of     (n,) which layer a point is of
    damaged      why the patches of a point could not be read, by catalog and id; it is never used
    """

    def __init__(self, layers: Sequence[PointLayer]) -> None:
        kept: list[PointLayer] = []
        for layer in layers:
            kept.append(layer.subset(~_is_covered(layer, kept)))
        self.layers = tuple(kept)
        counts = [len(layer.ids) for layer in kept]
        self._first = np.concatenate([[0], np.cumsum(counts)]).astype(np.intp)
        self.layer_of: IndexArray = np.repeat(np.arange(len(kept)), counts)
        self.xyz_m: FloatArray = np.concatenate([layer.xyz_m for layer in kept])
        self.verticals: FloatArray = np.concatenate([layer.verticals for layer in kept])
        self.skyline_deg = np.concatenate([layer.skyline_deg for layer in kept])
        self.radius_m = kept[0].radius_m
        self.damaged: dict[tuple[str, int], str] = {}
        # A reference of 80 nodes and 5 levels takes 130 kB.
        self._references: Cache[int, Reference] = Cache(2000)
        ranges = (np.linalg.norm(layer.xyz_m, axis=1) for layer in kept)
        self._lowest_m = [float(each.min(initial=np.inf)) for each in ranges]
        across = np.linalg.norm(unit(self.xyz_m) - self.verticals, axis=1)
        # how far normals lean from the radius, a superset's margin for what is seen
        self._lean_deg = float(np.degrees(2.0 * np.arcsin(across.max(initial=0.0) / 2.0)))

    def __len__(self) -> int:
        return len(self.xyz_m)

    @property
    def image_error_m(self) -> float | None:
        """1 sigma per axis of the images that templates are cut from; None: of relief."""
        return self.layers[0].image_error_m

    def postings_m(self, index: int) -> FloatArray:
        """(levels,) postings of a point's patches, finest first."""
        return self._layer(index).postings_m

    def finest_postings_m(self, index: IndexArray) -> FloatArray:
        """(n,) finest posting of each of some points: that of its catalog's terrain."""
        return np.array([layer.known_m for layer in self.layers])[self.layer_of[index]]

    def terrain_errors(self, index: IndexArray) -> FloatArray:
        """(n,) stated errors of terrain models over those of GLD100; 1 where none is stated."""
        stated = (self.find_stated_error(point) for point in index.tolist())
        return np.array([1.0 if error is None else error.against_gld100 for error in stated])

    def compute_terrain_sigmas_m(self, index: IndexArray, sizes_m: FloatArray) -> FloatArray:
        """Compute templates' sigmas (n, 2) by stated terrain errors: shift per axis, height; m.

        sizes_m (n,) sides of the templates on the ground. 0 where no error is stated.
        """
        sigmas = np.zeros((len(index), 2))
        for k, (point, size) in enumerate(zip(index.tolist(), sizes_m.tolist(), strict=True)):
            stated = self._measure_stated_ground(point, size)
            if stated is not None:
                error, slope = stated
                sigmas[k] = error.point_sigma_m(size, slope)
        return sigmas

    def _measure_stated_ground(
        self, index: int, size_m: float
    ) -> tuple[TerrainErrorModel, float] | None:
        """Return a point's stated error and the rms slope of its ground; None where it has none."""
        error = self.find_stated_error(index)
        reference = self.reference(index) if error is not None else None
        if error is None or reference is None:
            return None
        box_m = 1e3 * error.box_km
        patch = min(reference.patches, key=lambda patch: abs(np.log(patch.posting_m / box_m)))
        return error, measure_rms_slope(patch.heights_m, patch.posting_m, size_m)

    def correct_refraction(self, places_m: FloatArray, position_m: FloatArray) -> FloatArray:
        """Move places (n, 3) to where straight lines of sight to a camera (3,) would end."""
        body = self.layers[0].body
        return places_m if body is None else correct_refraction(places_m, position_m, body)

    def name(self, index: int) -> tuple[str, int]:
        """Return the catalog of a point, and its id there."""
        layer = self._layer(index)
        return layer.name, int(layer.ids[index - self._first[self.layer_of[index]]])

    def index_of(self, catalog: str, point_id: int) -> int:
        """Return the index of a point in the arrays. Raises KeyError for an unknown point."""
        for number, layer in enumerate(self.layers):
            if layer.name == catalog:
                row = int(layer.ids.searchsorted(point_id))
                if row < len(layer.ids) and layer.ids[row] == point_id:
                    return int(self._first[number]) + row
        raise KeyError((catalog, point_id))

    def point(self, index: int) -> ControlPoint:
        """Return the point at an index of the arrays."""
        return self._layer(index).store.point(self.name(index)[1])

    def near(self, position_m: FloatArray, emission_max_deg: float) -> IndexArray:
        """Find all points that a camera may see at less than an emission angle (a superset).

        position_m  (3,) body frame. Points are taken by the cells below the camera, so that the
        time goes with what is in view, not with the catalog.
        """
        lat, lon, distance = (float(v) for v in latlon_from_xyz(position_m))
        rows_in_view = []
        for number, layer in enumerate(self.layers):
            if len(layer.ids) == 0:
                continue
            if layer.planes is not None and layer.planes.verticals_deg:
                # ground that leans anywhere may be seen from anywhere
                rows_in_view.append(np.arange(self._first[number], self._first[number + 1]))
                continue
            # the lower a point lies, the farther from the camera's foot it is still seen
            lowest = self._lowest_m[number]
            emission = np.radians(min(emission_max_deg + self._lean_deg, 90.0))
            sine = min(lowest * float(np.sin(emission)) / distance, 1.0)
            reach_deg = max(float(np.degrees(emission - np.arcsin(sine))), 0.0)
            cells = layer.grid.find_cells_within(
                np.degrees(lat), np.degrees(lon), reach_deg + CELL_SLACK_DEG
            )
            rows = layer.ids.searchsorted(cells)
            rows = rows[rows < len(layer.ids)]
            rows = rows[layer.ids[rows] == cells[: len(rows)]]
            # whole bands of cells are given near a pole
            positions = layer.xyz_m[rows]
            cosine = positions @ position_m / (np.linalg.norm(positions, axis=1) * distance)
            rows = rows[cosine >= np.cos(np.radians(reach_deg)) - 1e-9]
            rows_in_view.append(rows + self._first[number])
        return (
            np.concatenate(rows_in_view).astype(np.intp)
            if rows_in_view
            else np.empty(0, dtype=np.intp)
        )

    def reference(self, index: int) -> Reference | None:
        """Return a point ready to render; None when its patches are damaged."""
        name = self.name(index)
        if name in self.damaged:
            return None
        layer = self._layer(index)
        planes_on_m = None if layer.planes is None else layer.planes.radii_m

        def make_reference() -> Reference:
            point, patches = layer.store.point(name[1]), layer.store.patches(name[1])
            return Reference(point, patches, layer.radius_m, planes_on_m, layer.law)

        try:
            return self._references.get(index, make_reference)
        except DataError as error:
            self.damaged[name] = str(error)
            return None

    def distances_m(self, places_m: FloatArray) -> FloatArray:
        """Compute distances of positions (..., 3) to the nearest point along the sphere, m."""
        distances: FloatArray = self._tree.query(self.radius_m * unit(places_m))[0]
        return distances

    @cached_property
    def _tree(self) -> cKDTree:
        return cKDTree(self.radius_m * unit(self.xyz_m))

    def nearest(self, place_m: FloatArray, count: int, reach_m: float) -> list[int]:
        """Find the nearest points to a position (3,), m, within a reach, nearest first.

        Along the reference sphere: the ground may lie farther below or above it than a reach.
        """
        place_m = self.radius_m * unit(place_m)
        distances, numbers = self._tree.query(place_m, k=count, distance_upper_bound=reach_m)
        near = np.atleast_1d(numbers)[np.isfinite(np.atleast_1d(distances))]
        return [int(k) for k in near]

    def list_half_sizes_m(self, index: int, level: int) -> list[float]:
        """List half sides of a point's patches from a level up, m."""
        reference = self.reference(index)
        patches = reference.patches[level:] if reference else ()
        return [(patch.size - 1) / 2.0 * patch.posting_m for patch in patches]

    def _layer(self, index: int) -> PointLayer:
        return self.layers[int(self.layer_of[index])]

    def compute_stated_errors(self, place_m: FloatArray, size_m: float) -> StatedBands:
        """Compute what the stated error of the terrain model does to a template at a place (3,).

        size_m  side of the template on the ground; 0: of the smallest box that the model's law has
        """
        nearest = self.nearest(place_m, 1, np.inf)
        stated = self._measure_stated_ground(nearest[0], size_m) if nearest else None
        if stated is None:
            return NOT_STATED
        error, slope = stated
        # what squares of a side still hold of the error, for those no smaller than the template
        held = [error.point_sigma_m(max(size_m, side), slope) for side in BAND_SIDES_M]
        squares = np.minimum.accumulate(np.square(held))
        longer = np.concatenate([squares[1:], np.zeros((1, 2))])
        return StatedBands(BAND_SIDES_M, np.sqrt(squares - longer))

    def resolution_m(self, place_m: FloatArray) -> float | None:
        """Return the shortest wave that the model at a place holds; None where none is stated."""
        nearest = self.nearest(place_m, 1, np.inf)
        error = self.find_stated_error(nearest[0]) if nearest else None
        return None if error is None else 1e3 * error.resolution_km

    def find_stated_error(self, index: int) -> TerrainErrorModel | None:
        """Find the stated error of a point's terrain model; None where none is stated."""
        layer = self._layer(index)
        row = index - int(self._first[self.layer_of[index]])
        return layer.errors[row] if layer.errors else None


def _is_covered(layer: PointLayer, earlier: Sequence[PointLayer]) -> BoolArray:
    """Whether (n,) an earlier layer has a point within its cell's size of a point."""
    covered = np.zeros(len(layer.ids), dtype=bool)
    for other in earlier:
        if len(other.ids) and len(layer.ids):
            reach = np.radians(other.grid.step_deg) * other.radius_m
            near, _ = cKDTree(other.xyz_m).query(layer.xyz_m, distance_upper_bound=reach)
            covered |= np.isfinite(near)
    return covered
