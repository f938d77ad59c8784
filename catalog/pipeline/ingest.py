"""Ingest: read every terrain model whole, average it, and find the cells that have ground.

A mesh is checked once and then ready for rays in the work folder. A kill costs the reading of the
terrain model in work, minutes for gigabytes; those before it stay.
"""

import hashlib
import io
import logging
import math
from collections.abc import Sequence

import msgspec
import numpy as np

from catalog.arrays import FloatArray, IntArray
from catalog.errors import ConfigError, DataError, UsageError
from catalog.files import decode_stored_json, hash_file
from catalog.geometry.cells import CellGrid
from catalog.jobs.workspace import compute_stage_key, hash_contents, hash_package
from catalog.pipeline.config import DemSection, PyramidSettings
from catalog.pipeline.context import DemRecord, IngestRun
from catalog.pipeline.relief import ReliefRecord, make_or_keep
from catalog.store.relief import prepare_relief
from catalog.terrain.dem.file import resolve_path
from catalog.terrain.dem.image import NO_HEIGHT, ImageSource, encode_ellipsoid
from catalog.terrain.dem.mosaic import Mosaic
from catalog.terrain.dem.source import METRES, DemSettings, DemSource
from catalog.terrain.mesh.file import MeshSettings
from catalog.terrain.mesh.refine import FINEST_FACES, smooth_corners
from catalog.terrain.mesh.shape import Shape, load_shape
from catalog.terrain.mesh.terrain import MeshTerrain, make_mesh_relief
from catalog.terrain.pyramid.overviews import FORMAT
from catalog.terrain.pyramid.pyramid import HeightPyramid
from catalog.terrain.terrain import Terrain

log = logging.getLogger(__name__)

IMAGE_SECTION = "its [[image]] section"
LATTICE = 5  # points a side at which a cell is asked for ground
BLOCK_CELLS = 16  # cells a side of a block whose terrain is read together: less of it twice
MAX_CHUNK = 256  # cells in work at once: what a kill can lose
CHUNKS = 32  # a small build is cut at least so finely, to keep several workers busy
UNIMPORTANT = ("path", "priority", "feather_km")  # to the overviews of a terrain model
CORNERS, RECORD = "corners.npy", "mesh.json"
# Surface that looks towards the centre: Phobos has none, Eros little, 67P 0.09 of its own.
MAX_HIDDEN = 0.01
NORMALS_SHARE = 0.25  # of the finest patch's side: ground whose normal is that of its plane
CELLS_ACROSS = 2.0  # that the finest patch spans: a point may lie anywhere in its cell
MAX_ARC_DEG = 30.0  # of the body that a patch may span: beyond, much of it is seen edge-on
FACE_NODES = 2.0  # of the finest patches that a face of the smooth surface may span

Bbox = tuple[float, float, float, float]  # west, south, east, north, deg


class MeshRecord(msgspec.Struct, frozen=True):
    """A mesh as it was found, for the manifest.

    sha256     of its file
    folder     of its corners, in the workspace
    posting_m  distance of neighbouring vertices
    halvings   of its edges, so that its surface is smooth in patches finer than it is
    corners_sha256  of the file of corners
    mended     small faults that were mended, in words
    hidden     share of its surface that looks away from the centre: none of a body whose ground
               has one radius at every place
    """

    name: str
    sha256: str
    folder: str
    vertices: int
    faces: int
    posting_m: float
    volume_km3: float
    halvings: int
    mended: tuple[str, ...]
    corners_sha256: str
    hidden: float


def ingest_image(run: IngestRun) -> tuple[Mosaic, DemRecord] | None:
    """The image of a config's [[image]] with its overviews, made or kept; None without one.

    Raises DataError for a file that cannot be used.
    """
    if not run.config.image:
        return None
    settings = run.config.image[0].settings
    source = ImageSource.open(settings, run.folder, run.body, IMAGE_SECTION)
    pyramid, record = _make_or_load(run, source, "image")
    run.workspace.keep_only("image", {record.folder.removeprefix("image-")})
    return Mosaic([pyramid]), record


def list_ground_sections(run: IngestRun) -> list[DemSection]:
    """The terrain models of the ground: those that are named, else the ellipsoid below an image."""
    sections = run.config.select_dems("ground")
    if sections or not run.config.image:
        return sections
    image = ImageSource.open(run.config.image[0].settings, run.folder, run.body, IMAGE_SECTION)
    key = compute_stage_key(hash_package(), run.body.radii_m, image.latlon_bounds())
    name = f"ellipsoid-{key}/ellipsoid.tif"
    path = run.workspace.path(*name.split("/"))
    if not path.is_file():
        run.workspace.put(name, encode_ellipsoid(image))
    image.close()
    run.workspace.keep_only("ellipsoid", {key})
    return [DemSection(str(path), heights="height", nodata=NO_HEIGHT, units="m")]


def ingest(run: IngestRun) -> tuple[Mosaic, list[DemRecord], Mosaic | None, list[DemRecord]]:
    """The mosaics of a config's [[dem]] sections; what the workspace holds already is kept.

    Returns that of the ground, its models, and both of the comparison, None and none without one.
    Raises DataError for a file that cannot be used, OutputError for a workspace that cannot.
    """
    ground, comparison = (
        _read_models(run, sections)
        for sections in (list_ground_sections(run), run.config.select_dems("comparison"))
    )
    records = [[record for _, record in by_role] for by_role in (ground, comparison)]
    kept = {record.folder.removeprefix("dem-") for by_role in records for record in by_role}
    run.workspace.keep_only("dem", kept)
    mosaics = [
        Mosaic([p for p, _ in by_role]) if by_role else None for by_role in (ground, comparison)
    ]
    if mosaics[0] is None:
        raise ValueError("a build needs a terrain model")
    return mosaics[0], records[0], mosaics[1], records[1]


def _read_models(
    run: IngestRun, sections: Sequence[DemSection]
) -> list[tuple[HeightPyramid, DemRecord]]:
    """Terrain models with their overviews, made or kept."""
    pyramids: list[tuple[HeightPyramid, DemRecord]] = []
    for section in sections:
        # what a model is for, and how far it is wrong, does not change how it is read
        settings = DemSettings(*(getattr(section, name) for name in DemSettings.__struct_fields__))
        pyramids.append(_make_or_load(run, DemSource.open(settings, run.folder, run.body), "dem"))
    return pyramids


def _make_or_load(run: IngestRun, source: DemSource, kind: str) -> tuple[HeightPyramid, DemRecord]:
    """A source with its overviews in the workspace, in a folder named by `kind`."""
    body, settings = run.body, source.settings
    digest = hash_contents(source.files, run.workspace, run.progress)
    # where the file lies, how it ranks and how it ends do not change its overviews
    plain = {k: v for k, v in msgspec.structs.asdict(settings).items() if k not in UNIMPORTANT}
    folder = f"{kind}-{compute_stage_key(FORMAT, body.name, body.radius_m, plain, digest)}"
    path = run.workspace.path(folder)
    pyramid = HeightPyramid.load(source, path)
    if pyramid is None:
        pyramid = HeightPyramid.build(source, path, run.workers, run.progress)
        run.account.done += 1
    else:
        run.account.kept += 1
    return pyramid, _record(pyramid, digest, folder)


def _record(pyramid: HeightPyramid, digest: str, folder: str) -> DemRecord:
    source, overviews = pyramid.source, pyramid.record
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
        lowest_m=overviews.lowest_m,
        highest_m=overviews.highest_m,
        valid_share=overviews.valid_share,
        bounds_deg=(west, south, east, north),
    )


def find_covered_cells(mosaic: Terrain, grid: CellGrid, bbox: Bbox | None) -> IntArray:
    """Numbers of the cells that have any ground, sorted; only those with their middle in a bbox.

    A cell at the edge of a DEM counts: whether whole patches fit in it shows when it is rendered.
    Raises UsageError for a bbox that is none, DataError when no cell has ground.
    """
    if bbox is None:
        # a body has tens of millions of small cells, and a terrain model may show few of them
        south, north = np.degrees(mosaic.latitudes)
        cells = grid.find_cells_in_bbox(-180.0, south - grid.step_deg, 180.0, north + grid.step_deg)
    else:
        west, south, east, north = bbox
        wide = np.isfinite([west, east]).all() and west != east
        if not (-90.0 <= south < north <= 90.0 and wide):
            raise UsageError(
                f"--bbox {_format_bounds(bbox)}: wanted W,S,E,N in degrees with S < N, both within "
                "-90..90"
            )
        cells = grid.find_cells_in_bbox(west, south, east, north)
    covered = np.zeros(cells.size, dtype=bool)
    # any point of the lattice: asked of overviews about as coarse as the lattice
    step_m = np.radians(grid.step_deg) * mosaic.body.radius_m / LATTICE
    posting = max(mosaic.posting_m, step_m / 2.0)
    for first in range(0, cells.size, 4096):
        part = cells[first : first + 4096]
        lat, lon = _sample_cells(grid, part)
        covered[first : first + 4096] = mosaic.covers(lat, lon, posting).any(axis=1)
    if not covered.any():
        where = f"--bbox {_format_bounds(bbox)} holds" if bbox is not None else "the body has"
        raise DataError(
            f"{where} no cell with ground, of {cells.size} of {grid.step_deg:g} deg "
            f"({mosaic.extent}, W,S,E,N); give a box or terrain models that meet"
        )
    return cells[covered]


def _sample_cells(grid: CellGrid, cells: IntArray) -> tuple[FloatArray, FloatArray]:
    """Latitudes and longitudes (rad), (n, LATTICE²) each, of points spread over cells."""
    bounds = np.array([grid.bounds_deg(int(cell)) for cell in cells])
    west, south, east, north = bounds.T[:, :, None]
    share = (np.arange(LATTICE) + 0.5) / LATTICE
    down, along = (a.ravel() for a in np.meshgrid(share, share, indexing="ij"))
    return np.radians(south + (north - south) * down), np.radians(west + (east - west) * along)


def _format_bounds(bounds: Sequence[float] | FloatArray) -> str:
    return ",".join(f"{value:.6g}" for value in bounds)


def cut_chunks(grid: CellGrid, cells: IntArray) -> list[list[int]]:
    """Cells in chunks of neighbours, so that a worker's chunk reads little terrain.

    The cut depends on the cells alone, never on the workers.
    """
    size = int(np.clip(-(-cells.size // CHUNKS), 1, MAX_CHUNK))

    def place(cell: int) -> tuple[int, int, int]:
        _, lon = grid.centre_deg(cell)
        band = grid.find_band(cell) // BLOCK_CELLS
        # equal turns of longitude for a row of blocks: narrower toward the poles, still neighbours
        return band, int((lon + 180.0) // (BLOCK_CELLS * grid.step_deg)), cell

    ordered = sorted(cells.tolist(), key=place)
    return [ordered[i : i + size] for i in range(0, len(ordered), size)]


def ingest_mesh(run: IngestRun, finest_m: float) -> tuple[MeshTerrain, MeshRecord]:
    """The terrain of a config's [[mesh]]; a mesh that the workspace holds already is kept.

    finest_m  posting of the finest patches: in a coarser mesh faces are smoothed over
    Raises DataError for a file that cannot be used, OutputError for a workspace that cannot.
    """
    (settings,) = run.config.mesh
    body, workspace = run.body, run.workspace
    path = resolve_path(settings.path, run.folder)
    # the loader's own words for a file that is missing come before those of the checksum
    digest = hash_contents([path], workspace, run.progress) if path.is_file() else ""
    plain = MeshSettings(path.suffix, settings.units, settings.longitude)
    key = compute_stage_key(hash_package(), body.name, body.radii_m, plain, digest, finest_m)
    folder = f"mesh-{key}"
    stored = workspace.get(f"{folder}/{RECORD}")
    record = None if stored is None else decode_stored_json(stored, MeshRecord)
    corners_path = workspace.path(folder, CORNERS)
    if (
        record is not None
        and corners_path.is_file()
        and hash_file(corners_path) == record.corners_sha256
    ):
        run.account.kept += 1
    else:
        shape = load_shape(settings, run.folder, body, run.progress)
        halvings = _count_halvings(shape, finest_m)
        corners = io.BytesIO()
        if halvings:  # of a smooth surface through the vertices
            smooth = settings.longitude, METRES[settings.units], shape.vertices, shape.faces
            np.save(corners, smooth_corners(path, *smooth, halvings))
        else:
            np.save(corners, shape.vertices[shape.faces])
        record = MeshRecord(
            name=path.name,
            sha256=digest,
            folder=folder,
            vertices=len(shape.vertices),
            faces=len(shape.faces),
            posting_m=shape.posting_m,
            volume_km3=shape.volume_m3 / 1e9,
            halvings=halvings,
            mended=shape.mended,
            corners_sha256=hashlib.sha256(corners.getbuffer()).hexdigest(),
            hidden=shape.hidden_share,
        )
        workspace.put(f"{folder}/{CORNERS}", corners.getvalue())
        workspace.put(f"{folder}/{RECORD}", msgspec.json.encode(record))
        run.account.done += 1
    workspace.keep_only("mesh", {key})
    if finest_m < record.posting_m:
        log.info(
            "%s: oversampled: patches have %.3g m between nodes, the mesh %.3g m between vertices;"
            " they are cut from a smooth surface through these",
            *(path.name, finest_m, record.posting_m),
        )
    # no ellipsoid follows such ground: patches lie in planes of their own
    own_planes = record.hidden > MAX_HIDDEN
    normals_m = NORMALS_SHARE * run.config.pyramid.size * finest_m if own_planes else 0.0
    return MeshTerrain(body, corners_path, record.name, record.posting_m, normals_m), record


def _count_halvings(shape: Shape, finest_m: float) -> int:
    """Count the halvings of edges until faces span few nodes, as far as memory allows."""
    wanted = math.ceil(math.log2(shape.posting_m / (FACE_NODES * finest_m)) - 1e-9)
    if shape.posting_m <= finest_m or wanted <= 0:
        return 0
    return max(0, min(wanted, int(math.log(FINEST_FACES / len(shape.faces), 4.0))))


def settle_pyramid(run: IngestRun) -> tuple[PyramidSettings, float]:
    """Posting and number of levels: the finest spans two cells, the coarsest at most 30 deg.

    Returns them as settings, and the finest posting, m.
    Raises ConfigError when even the finest patch spans more.
    """
    settings, radius = run.config.pyramid, run.body.radius_m
    cell_m = math.radians(run.config.grid.cell_deg) * radius
    posting = settings.posting_m or CELLS_ACROSS * cell_m / settings.size
    spans_deg = math.degrees(posting * settings.size / radius)
    if spans_deg > MAX_ARC_DEG + 1e-9:
        raise ConfigError(
            f"{run.config_path}: the finest patch would span {spans_deg:.3g} deg of "
            f"{run.body.name}; wanted at most {MAX_ARC_DEG:g}: set a smaller [grid] "
            "cell_deg, or [pyramid] posting_m or size"
        )
    levels = min(settings.levels, 1 + int(math.log2(MAX_ARC_DEG / spans_deg) + 1e-9))
    return msgspec.structs.replace(settings, levels=levels, posting_m=posting), posting


def settle_mesh_relief(run: IngestRun, terrain: MeshTerrain, mesh: MeshRecord) -> ReliefRecord:
    """Make the relief of the whole body, or keep that of an earlier run."""
    record = ReliefRecord(compute_stage_key(hash_package(), mesh.folder), {})
    make_or_keep(run, record.key, lambda: prepare_relief(make_mesh_relief(terrain)))
    return record
