"""The ground as a build reads it, whether it is a mosaic of terrain models or a mesh."""

from collections.abc import Sequence
from pathlib import Path
from typing import Protocol

from numpy.typing import ArrayLike

from catalog.arrays import BoolArray, Float32Array, FloatArray
from catalog.bodies.body import Body
from catalog.geometry.cells import Graticule, Part
from catalog.geometry.projection import MapProjection


class Terrain(Protocol):
    """The ground of a body. Angles are rad, heights m, float32, NaN where there are none."""

    body: Body
    posting_m: float  # the finest posting; a finer patch is interpolated
    in_planes: bool  # whether patches lie in tangent planes: on a small body
    own_planes: bool  # whether each lies in the plane of its own ground
    covers_body: bool  # whether every place of the body has a height
    has_graticules: bool  # whether heights on a graticule cost much less than those of points

    @property
    def names(self) -> tuple[str, ...]:
        """The files it is made of."""

    @property
    def extent(self) -> str:
        """The ground that it covers, for messages."""

    @property
    def latitudes(self) -> tuple[float, float]:
        """The southernmost and northernmost ground, rad."""

    def files(self) -> list[Path]:
        """All files that are read while patches are cut."""

    def projection(self, lat: float, lon: float) -> MapProjection:
        """The map projection of patches about a place, planetocentric."""

    def points(self, lat: ArrayLike, lon: ArrayLike) -> FloatArray:
        """Body-fixed points (..., 3) of places as far as `xy_from_xyz` of a projection needs.

        Of the ground (m) where a projection's x and y depend on heights, else directions.
        """

    def heights(self, lat: ArrayLike, lon: ArrayLike, posting_m: float) -> Float32Array:
        """Heights (...) of places above the sphere of the body's radius."""

    def covers(self, lat: ArrayLike, lon: ArrayLike, posting_m: float | None = None) -> BoolArray:
        """Whether places have a height."""

    def local_grid(self, projection: MapProjection, posting_m: float, size: int) -> Float32Array:
        """Heights (size, size) of a centred map grid; row 0 north, column 0 west."""

    def graticule_heights(
        self, graticule: Graticule, part: Part, posting_m: float, latitudes: tuple[float, float]
    ) -> Float32Array:
        """Heights (height, width) m of a part of a graticule; row 0 south, column 0 west.

        posting_m  the spacing of the nodes: what is finer is averaged
        latitudes  south and north (rad) of the zone that this graticule serves: how nodes are read
                   depends on it, never on the part
        """

    def overhangs(self, projection: MapProjection, posting_m: float, size: int) -> bool:
        """Whether a vertical line through a node of a map grid meets the ground several times."""

    def make_outer_grids(
        self, projection: MapProjection, posting_m: float, size: int
    ) -> Sequence[tuple[Float32Array, float]]:
        """Coarser grids (size, size) and postings, finer first, for the rest of a small body.

        They go on from a grid of posting_m and throw the shadows that come from beyond all patches;
        none where bodies are so large that those levels reach as far as shadows do.
        """

    def provenance(self, projection: MapProjection, posting_m: float, size: int) -> str:
        """Which files a centred map grid is read from, joined by " + "."""

    def close(self) -> None:
        """Close files; they open again when read."""
