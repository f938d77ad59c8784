"""What every stage of a build is given: the body, its terrain, the cells, how patches are cut.

    render.render_chunk(context, cells)   -> list[RenderedCell]
    select.select(context, records)       -> list[SelectedCell]    all records, by cell number
    check.check_chunk(context, records)   -> list[ControlPoint]
    check.check_and_prepare_chunk         -> both these and list[PreparedPoint]
    write.prepare_chunk(context, points)  -> list[PreparedPoint]   for `write.write`, where the
                                             check has left none

Chunk functions run in worker processes and must not depend on which cells share a chunk. Records
are msgspec.Structs, because they travel and rest as msgpack; numpy arrays in them are annotated
`np.ndarray` and keep their type and shape. A stage's settings are a section of
`catalog.pipeline.config`.
"""

from dataclasses import dataclass
from pathlib import Path

import msgspec
import numpy as np

from catalog.bodies.body import Body
from catalog.control_point import Patch
from catalog.geometry.cells import CellGrid
from catalog.geometry.projection import MapProjection
from catalog.jobs.usage import StageAccount
from catalog.jobs.workspace import Workspace
from catalog.pipeline.config import BuildConfig
from catalog.progress import Progress
from catalog.terrain.dem.mosaic import Mosaic
from catalog.terrain.terrain import Terrain


class DemRecord(msgspec.Struct, frozen=True):
    """One terrain model as it was found, for the manifest.

    sha256       of its files, in order of name
    folder       of its overviews, in the workspace
    bounds_deg   west, south, east, north
    valid_share  of its pixels that have a height
    """

    name: str
    sha256: str
    priority: int
    feather_km: float
    folder: str
    rows: int
    cols: int
    posting_m: float
    heights: str
    units: str
    lowest_m: float
    highest_m: float
    valid_share: float
    bounds_deg: tuple[float, float, float, float]


@dataclass(frozen=True)
class IngestRun:
    """Settings and services with which the inputs of a build are prepared.

    workspace  where results rest
    workers    threads that read terrain models
    account    of the stage `ingest`
    """

    workspace: Workspace
    config: BuildConfig
    config_path: Path
    body: Body
    workers: int
    progress: Progress
    account: StageAccount

    @property
    def folder(self) -> Path:
        """Which relative paths of the config start from."""
        return self.config_path.parent


@dataclass(frozen=True)
class StageContext:
    """Inputs common to all stages; pickles small (paths and numbers), a worker opens files again.

    mosaic     the terrain
    posting_m  of the finest patches, settled from the config or the DEM
    config     the whole build config; a stage reads its own section
    comparison a second terrain model of the same ground; None without one
    image      brightness of the ground, which templates are; None: they are rendered
    """

    body: Body
    mosaic: Terrain
    grid: CellGrid
    posting_m: float
    config: BuildConfig
    comparison: Mosaic | None = None
    image: Mosaic | None = None

    @property
    def texture(self) -> Terrain:
        """Grids that points are chosen by: brightness where there is an image, else terrain."""
        return self.mosaic if self.image is None else self.image

    @property
    def levels(self) -> int:
        """Patches of a control point."""
        return self.config.pyramid.levels

    @property
    def size(self) -> int:
        """Nodes a side of every patch."""
        return self.config.pyramid.size

    @property
    def postings_m(self) -> tuple[float, ...]:
        """Postings of the levels, finest first."""
        return tuple(self.posting_m * 2.0**level for level in range(self.levels))

    def files(self) -> list[Path]:
        """The terrain files that every stage reads."""
        others = [model for model in (self.comparison, self.image) if model is not None]
        return self.mosaic.files() + [path for model in others for path in model.files()]

    def projection(self, lat_deg: float, lon_deg: float) -> MapProjection:
        """The map projection centred on a place."""
        return self.mosaic.projection(np.radians(lat_deg), np.radians(lon_deg))

    def sun_latitude_deg(self, lat_deg: float, lon_deg: float) -> float:
        """Latitude of a place's vertical over the equator, on which the Suns that occur depend."""
        return self.projection(lat_deg, lon_deg).sun_latitude_deg(lat_deg)

    def make_outer_patches(self, projection: MapProjection) -> tuple[Patch, ...]:
        """Ground beyond the coarsest patch that throws shadows in, finer first."""
        grids = self.mosaic.make_outer_grids(projection, self.postings_m[-1], self.size)
        return tuple(Patch(posting, heights) for heights, posting in grids)

    def patches(self, lat_deg: float, lon_deg: float) -> tuple[Patch, ...]:
        """The patches of a control point at a place, finest first; NaN where there is no ground."""
        projection = self.projection(lat_deg, lon_deg)
        image, size = self.image, self.size
        return tuple(
            Patch(
                posting,
                self.mosaic.local_grid(projection, posting, size),
                None if image is None else image.local_grid(projection, posting, size),
            )
            for posting in self.postings_m
        )
