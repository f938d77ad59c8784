"""Write: put the checked points and their patches into one file.

A check that a write follows compresses the patches that it cut: they rest in the work folder until
the catalog is in its place. Those that are not there are cut here; a kill loses no more of them
than of other stages. The file itself is put together anew: a database that is continued after a
kill needs a journal, which would cost every build more than the copying costs the few that are
killed.

The work folder remembers what a catalog was made from and the seal of its file, a hash of all its
bytes. A file that is as it was then stays; one that is damaged, or that a GIS wrote to, does not.
"""

from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing
from datetime import UTC, datetime
from pathlib import Path
from types import MappingProxyType
from typing import NamedTuple

import msgspec

import catalog
from catalog.control_point import ControlPoint
from catalog.errors import DataError
from catalog.files import decode_stored_json
from catalog.jobs.usage import StageAccount
from catalog.jobs.workers import Workers
from catalog.jobs.workspace import ChunkResults, Workspace
from catalog.pipeline.context import StageContext
from catalog.progress import Progress
from catalog.rasters import keep_gdal_settings
from catalog.store.connection import SealState, check_seal, connect, find_live_log, read_meta
from catalog.store.manifest import CatalogMeta, ComparisonMeta, ImageMeta, PlanesMeta
from catalog.store.patches import PreparedPoint, prepare_point
from catalog.store.records import round_point, round_vertical
from catalog.store.relief import PreparedRelief
from catalog.store.writer import Written, write_catalog
from catalog.terrain.error_model import TerrainErrorModel

FILE = "written.json"


class CatalogExtras(NamedTuple):
    """Contents of a catalog besides its points.

    sources      terrain models: name -> hash
    config_text  the build config
    relief       of the whole body, if it is known
    errors       of the terrain models that state one: name -> error
    comparison   with a second terrain model
    image        that templates are cut from
    """

    sources: Mapping[str, str]
    config_text: str
    relief: PreparedRelief | None
    errors: Mapping[str, TerrainErrorModel] = MappingProxyType({})
    comparison: ComparisonMeta | None = None
    image: ImageMeta | None = None


def record_published(workspace: Workspace, key: str, path: Path) -> None:
    """Note that the catalog at a path was made from what the key stands for."""
    meta = _read_published_meta(path)
    if meta is not None:
        workspace.put(FILE, msgspec.json.encode({"key": key, "seal": meta.seal}))


def find_published(workspace: Workspace, key: str, path: Path) -> Written | None:
    """The catalog at a path, if it is the remembered one of this key and whole to the last byte."""
    memory = decode_stored_json(workspace.get(FILE) or b"", dict[str, str]) or {}
    meta = _read_published_meta(path) if memory.get("key") == key else None
    if meta is None or meta.seal != memory.get("seal") or find_live_log(path):
        return None
    if check_seal(path, meta.seal) is not SealState.WHOLE:
        return None
    return Written(path, meta.count, meta.usable, meta.digest, path.stat().st_size)


def _read_published_meta(path: Path) -> CatalogMeta | None:
    try:
        with closing(connect(path)) as db:
            return read_meta(db, path)
    except DataError:
        return None


def write(
    context: StageContext,
    chunks: Sequence[Sequence[ControlPoint]],
    output: Path,
    *,
    extras: CatalogExtras,
    results: ChunkResults,
    workers: Workers,
    progress: Progress,
    account: StageAccount,
) -> Written:
    """Write the catalog file of points in the order of their ids, with their patches.

    chunks   of the chosen points of all cells, usable or not, see `group_points`
    output   the catalog; an older one stays whole until the new one is complete
    extras   what it holds beside them
    results  where prepared points rest until the file is whole
    Raises OutputError for a place that cannot be written.
    """
    terrain = context.mosaic
    planes = None
    if terrain.in_planes:
        points = [point for chunk in chunks for point in chunk]
        verticals = {point.id: round_vertical(point.vertical_deg) for point in points}
        known = {number: vertical for number, vertical in verticals.items() if vertical is not None}
        planes = PlanesMeta(context.body.radii_m, terrain.posting_m, known)
    meta = CatalogMeta(
        body=context.body.name,
        radius_m=context.body.radius_m,
        cell_deg=context.grid.step_deg,
        levels=context.levels,
        size=context.size,
        posting_m=context.posting_m,
        height_step_m=context.config.write.steps_m(context.postings_m)[0],
        planes=planes,
        terrain_errors=dict(extras.errors),
        comparison=extras.comparison,
        photometry=context.body.photometry,
        image=extras.image,
        sources=dict(extras.sources),
        config=extras.config_text,
        software=f"optnav {catalog.__version__}",
        created_utc=datetime.now(UTC).strftime("%Y-%m-%dT%H:%M:%SZ"),
    )
    with progress.stage("write", sum(map(len, chunks)), "point") as shown:
        ready = results.make(prepare_chunk, context, chunks, workers, account, shown)
        prepared = _order_points(results, chunks, ready)
        return write_catalog(output, meta, prepared, relief=extras.relief)


def group_points(
    cells: Sequence[Sequence[int]], points: Sequence[ControlPoint]
) -> list[list[ControlPoint]]:
    """Points in the pieces of neighbours that their cells were cut into, by id in each."""
    by_id = {point.id: point for point in points}
    return [[by_id[cell] for cell in sorted(chunk) if cell in by_id] for chunk in cells]


def prepare_chunk(context: StageContext, points: Sequence[ControlPoint]) -> list[PreparedPoint]:
    """Cut and compress the patches of some points; runs in a worker."""
    steps = context.config.write.steps_m(context.postings_m)
    # the patches are centred on the place that the catalog will state
    with keep_gdal_settings():
        return [
            prepare_point(point, context.patches(point.lat_deg, point.lon_deg), steps)
            for point in map(round_point, points)
        ]


def _order_points(
    results: ChunkResults, chunks: Sequence[Sequence[ControlPoint]], ready: Iterator[int]
) -> Iterator[PreparedPoint]:
    """Prepared points by id; what is ready early waits in its file for what is late.

    A piece is held from its first point to its last: those of a row of blocks, 60 MB of the Moon.
    """
    early: set[int] = set()
    held: dict[int, deque[PreparedPoint]] = {}
    for _, wanted in sorted((point.id, at) for at, chunk in enumerate(chunks) for point in chunk):
        while wanted not in early:
            early.add(next(ready))
        if wanted not in held:
            prepared = results.read(wanted)
            if prepared is None:
                raise DataError(
                    f"{results.workspace.path(results.name(wanted))}: changed after it was "
                    "written; its medium may be failing: give the same command again"
                )
            held[wanted] = deque(prepared)
        yield held[wanted].popleft()
    early.update(ready)  # to its end, where its workers are let go
