"""Write: cut the patches of the checked points from the terrain and put all into one file.

Cutting and compressing is nearly all of the work: its results rest in the work folder until the
catalog is in its place, so that a kill loses no more of them than of other stages. The file itself
is put together anew: a database that is continued after a kill needs a journal, which would cost
every build more than the copying costs the few that are killed.
"""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path

import msgspec

import catalog
from catalog.control_point import ControlPoint
from catalog.errors import DataError
from catalog.progress import Progress
from catalog.stages.account import StageAccount
from catalog.stages.chunked import ChunkResults
from catalog.stages.context import StageContext
from catalog.stages.workers import Workers
from catalog.store.manifest import PLAIN_VERSION, PLANES_VERSION, CatalogMeta, PlanesMeta
from catalog.store.patches import PreparedPoint, prepare_point
from catalog.store.records import rounded_point
from catalog.store.relief import PreparedRelief
from catalog.store.writer import Written, write_catalog
from catalog.terrain.mesh.terrain import MeshTerrain

CHUNK_POINTS = 32  # about 1 MB between a worker and the writer
STEPS_PER_POSTING = 237.0
COARSEST_STEP_M = 4.0


class Settings(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """[write].

    height_step_m  what heights are rounded to, at all levels. Without it a share of each level's
                   posting, so that rounding turns slopes by 0.05 deg rms at most, whatever the
                   level: 0.5 m at 118 m; and no more than 4 m, which is 1.2 m rms, a tenth of what
                   lunar stereo models err by. A point of 5 levels of 80 nodes at 118 m takes 21 kB
                   so, and 29 kB with half a metre at all levels.
    """

    height_step_m: float | None = None

    def __post_init__(self) -> None:
        if self.height_step_m is not None and not self.height_step_m > 0.0:
            raise ValueError(f"height_step_m is {self.height_step_m:g}; wanted more than 0")

    def steps_m(self, postings_m: Sequence[float]) -> tuple[float, ...]:
        """The step of each level, finest first."""
        if self.height_step_m is not None:
            return (self.height_step_m,) * len(postings_m)
        return tuple(min(posting / STEPS_PER_POSTING, COARSEST_STEP_M) for posting in postings_m)


def write(
    context: StageContext,
    points: Sequence[ControlPoint],
    output: Path,
    *,
    sources: Mapping[str, str],
    config_text: str,
    relief: PreparedRelief | None,
    results: ChunkResults,
    workers: Workers,
    progress: Progress,
    account: StageAccount,
) -> Written:
    """Write the catalog file of points in the order of their ids, with their patches.

    points       the chosen point of each cell, usable or with its flags down
    output       the catalog; an older one stays whole until the new one is complete
    sources      terrain models: name -> hash, for the manifest
    config_text  the build config, for the manifest
    relief       of the whole body, if it is known
    results      where prepared points rest until the file is whole
    Raises OutputError for a place that cannot be written.
    """
    terrain, planes = context.mosaic, None
    if isinstance(terrain, MeshTerrain) and terrain.in_planes:
        planes = PlanesMeta(context.body.radii_m, terrain.posting_m)
    meta = CatalogMeta(
        body=context.body.name,
        radius_m=context.body.radius_m,
        cell_deg=context.grid.step_deg,
        levels=context.levels,
        size=context.size,
        posting_m=context.posting_m,
        height_step_m=context.config.write.steps_m(context.postings_m)[0],
        planes=planes,
        format_version=PLAIN_VERSION if planes is None else PLANES_VERSION,
        sources=dict(sources),
        config=config_text,
        software=f"optnav {catalog.__version__}",
        created_utc=datetime.now(UTC).strftime("%Y-%m-%dT%H:%M:%SZ"),
    )
    ordered = sorted(points, key=lambda point: point.id)
    chunks = [ordered[i : i + CHUNK_POINTS] for i in range(0, len(ordered), CHUNK_POINTS)]
    with progress.stage("write", len(ordered), "point") as shown:
        ready = results.make(prepare_chunk, context, chunks, workers, account, shown)
        return write_catalog(output, meta, _in_order(results, ready), relief=relief)


def prepare_chunk(context: StageContext, points: Sequence[ControlPoint]) -> list[PreparedPoint]:
    """Cut and compress the patches of some points; runs in a worker."""
    steps = context.config.write.steps_m(context.postings_m)
    prepared = []
    for point in points:
        # the patches are centred on the place that the catalog will state
        place = rounded_point(point)
        patches = context.patches(place.lat_deg, place.lon_deg)
        prepared.append(prepare_point(place, patches, steps))
    return prepared


def _in_order(results: ChunkResults, ready: Iterable[int]) -> Iterator[PreparedPoint]:
    """Prepared points in order; what is ready early waits in its file for what is late."""
    early: set[int] = set()
    wanted = 0
    for position in ready:
        early.add(position)
        while wanted in early:
            prepared = results.records(wanted)
            if prepared is None:
                raise DataError(
                    f"{results.workspace.path(results.name(wanted))}: changed after it was "
                    "written; its medium may be failing: give the same command again"
                )
            yield from prepared
            early.remove(wanted)
            wanted += 1
