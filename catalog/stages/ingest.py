"""Ingest: read every terrain model whole, average it, and find the cells that have ground.

A kill costs the reading of the terrain model in work, minutes for gigabytes; those before it stay.
"""

import hashlib
from collections.abc import Iterable, Sequence
from pathlib import Path

import msgspec
import numpy as np

from catalog.arrays import FloatArray, IntArray
from catalog.bodies.body import Body
from catalog.errors import DataError, UsageError
from catalog.geometry.cells import CellGrid
from catalog.progress import Progress
from catalog.stages.account import StageAccount
from catalog.stages.workspace import Workspace, stage_key
from catalog.terrain.mosaic import Mosaic
from catalog.terrain.overviews import FORMAT
from catalog.terrain.pyramid import HeightPyramid
from catalog.terrain.source import DemSettings, DemSource
from catalog.terrain.terrain import Terrain

Bbox = tuple[float, float, float, float]

HASHES = "dem-hashes.json"
MEGABYTE = 1_000_000
LATTICE = 5  # points a side at which a cell is asked for ground
BLOCK_CELLS = 8  # cells a side of a block whose terrain is read together
LARGEST_CHUNK = 64  # cells in work at once: what a kill can lose
CHUNKS = 32  # a small build is cut at least so finely, to keep several workers busy


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


def ingest(
    workspace: Workspace,
    settings: Sequence[DemSettings],
    base_dir: Path,
    body: Body,
    workers: int,
    progress: Progress,
    account: StageAccount,
) -> tuple[Mosaic, list[DemRecord]]:
    """The mosaic of a config's [[dem]] sections; what the workspace holds already is kept.

    Raises DataError for a file that cannot be used, OutputError for a workspace that cannot.
    """
    pyramids: list[HeightPyramid] = []
    records: list[DemRecord] = []
    for one in sorted(settings, key=lambda s: s.priority):
        source = DemSource.open(one, base_dir, body)
        digest = content_hash(source.files, workspace, progress)
        # where the file lies, how it ranks and how it ends do not change its overviews
        plain = {k: v for k, v in msgspec.structs.asdict(one).items() if k not in _UNIMPORTANT}
        folder = f"dem-{stage_key(FORMAT, body.name, body.radius_m, plain, digest)}"
        place = workspace.path(folder)
        pyramid = HeightPyramid.load(source, place)
        if pyramid is None:
            pyramid = HeightPyramid.build(source, place, workers, progress)
            account.done += 1
        else:
            account.kept += 1
        pyramids.append(pyramid)
        records.append(_record(pyramid, digest, folder))
    workspace.keep_only("dem", {record.folder.removeprefix("dem-") for record in records})
    return Mosaic(pyramids), records


_UNIMPORTANT = ("path", "priority", "feather_km")


def _record(pyramid: HeightPyramid, digest: str, folder: str) -> DemRecord:
    source, found = pyramid.source, pyramid.record
    west, south, east, north = (float(np.degrees(angle)) for angle in source.latlon_bounds())
    return DemRecord(
        name=source.path.name,
        sha256=digest,
        priority=source.settings.priority,
        feather_km=source.settings.feather_km,
        folder=folder,
        rows=source.shape[0],
        cols=source.shape[1],
        posting_m=source.posting_m,
        heights=source.heights,
        units=source.units,
        lowest_m=found.lowest_m,
        highest_m=found.highest_m,
        valid_share=found.valid_share,
        bounds_deg=(west, south, east, north),
    )


def _known_hashes(workspace: Workspace) -> dict[str, str]:
    data = workspace.get(HASHES)
    try:
        return msgspec.json.decode(data, type=dict[str, str]) if data else {}
    except msgspec.MsgspecError:
        return {}


def content_hash(files: Iterable[Path], workspace: Workspace, progress: Progress) -> str:
    """SHA-256 over files, one after the other; one of the same size and date is not read again.

    Raises DataError for a file that cannot be read.
    """
    known = _known_hashes(workspace)
    whole = hashlib.sha256()
    for path in files:
        try:
            state = path.stat()
            name = f"{path.resolve()} {state.st_size} {state.st_mtime_ns}"
            if name not in known:
                known[name] = _file_hash(path, state.st_size, progress)
        except OSError as error:
            raise DataError(
                f"{path}: cannot be read ({error.strerror or error}); check its permissions"
            ) from None
        whole.update(bytes.fromhex(known[name]))
    workspace.put(HASHES, msgspec.json.encode(known))
    return whole.hexdigest()


def _file_hash(path: Path, size: int, progress: Progress) -> str:
    whole = hashlib.sha256()
    with (
        path.open("rb") as file,
        progress.stage("checksum", total=-(-size // MEGABYTE), unit="MB") as shown,
    ):
        while data := file.read(MEGABYTE):
            whole.update(data)
            shown.advance()
    return whole.hexdigest()


def covered_cells(mosaic: Terrain, grid: CellGrid, bbox: Bbox | None) -> IntArray:
    """Numbers of the cells that have any ground, sorted; only those with their middle in a bbox.

    A cell at the edge of a DEM counts: whether whole patches fit in it shows when it is rendered.
    Raises UsageError for a bbox that is none, DataError when no cell has ground.
    """
    cells = np.arange(grid.total, dtype=np.int64)
    if bbox is not None:
        west, south, east, north = bbox
        if not (
            -90.0 <= south < north <= 90.0 and np.isfinite([west, east]).all() and west != east
        ):
            raise UsageError(
                f"--bbox {_text(bbox)}: wanted W,S,E,N in degrees with S < N, both within -90..90"
            )
        cells = grid.in_bbox(west, south, east, north)
    covered = np.zeros(cells.size, dtype=bool)
    # any point of the lattice: asked of overviews about as coarse as the lattice
    step_m = np.radians(grid.step_deg) * mosaic.body.radius_m / LATTICE
    posting = max(mosaic.posting_m, step_m / 2.0)
    for first in range(0, cells.size, 4096):
        part = cells[first : first + 4096]
        lat, lon = _lattice(grid, part)
        covered[first : first + 4096] = mosaic.covers(lat, lon, posting).any(axis=1)
    if not covered.any():
        where = f"--bbox {_text(bbox)} holds" if bbox is not None else "the body has"
        raise DataError(
            f"{where} no cell with ground, of {cells.size} of {grid.step_deg:g} deg "
            f"({mosaic.extent}, W,S,E,N); give a box or terrain models that meet"
        )
    return cells[covered]


def _lattice(grid: CellGrid, cells: IntArray) -> tuple[FloatArray, FloatArray]:
    """Latitudes and longitudes (rad), (n, LATTICE²) each, of points spread over cells."""
    bounds = np.array([grid.bounds_deg(int(cell)) for cell in cells])
    west, south, east, north = bounds.T[:, :, None]
    share = (np.arange(LATTICE) + 0.5) / LATTICE
    down, along = (a.ravel() for a in np.meshgrid(share, share, indexing="ij"))
    return np.radians(south + (north - south) * down), np.radians(west + (east - west) * along)


def _text(bounds: Sequence[float] | FloatArray) -> str:
    return ",".join(f"{value:.6g}" for value in bounds)


def chunks_of(grid: CellGrid, cells: IntArray) -> list[list[int]]:
    """Cells in chunks of neighbours, so that a worker's chunk reads little terrain.

    The cut depends on the cells alone, never on the workers.
    """
    size = int(np.clip(-(-cells.size // CHUNKS), 1, LARGEST_CHUNK))

    def place(cell: int) -> tuple[int, int, int]:
        _, lon = grid.centre_deg(cell)
        band = grid.band_of(cell) // BLOCK_CELLS
        # equal turns of longitude for a row of blocks: narrower toward the poles, still neighbours
        return band, int((lon + 180.0) // (BLOCK_CELLS * grid.step_deg)), cell

    ordered = sorted((int(cell) for cell in cells), key=place)
    return [ordered[i : i + size] for i in range(0, len(ordered), size)]
