"""Ingest of a body given as a mesh: checked once, then ready for rays in the work folder."""

import io
import logging
import math
from pathlib import Path

import msgspec
import numpy as np

from catalog.arrays import FloatArray
from catalog.bodies.body import Body
from catalog.errors import ConfigError
from catalog.progress import Progress
from catalog.stages.account import StageAccount
from catalog.stages.code_key import code_key
from catalog.stages.context import PyramidSettings
from catalog.stages.ingest import content_hash
from catalog.stages.relief import ReliefRecord, make_or_keep
from catalog.stages.workspace import Workspace, stage_key
from catalog.store.relief import prepare_relief
from catalog.terrain.dem_file import path_of
from catalog.terrain.mesh.file import MeshSettings
from catalog.terrain.mesh.refine import FINEST_FACES
from catalog.terrain.mesh.relief import relief_of_mesh
from catalog.terrain.mesh.shape import METRES, Shape, load_shape
from catalog.terrain.mesh.smooth import smooth_corners
from catalog.terrain.mesh.terrain import MeshTerrain

log = logging.getLogger(__name__)

CORNERS, RECORD = "corners.npy", "mesh.json"
CELLS_ACROSS = 2.0  # that the finest patch spans: a point may lie anywhere in its cell
LARGEST_ARC_DEG = 30.0  # of the body that a patch may span: beyond, much of it is seen edge-on
FACE_NODES = 2.0  # of the finest patches that a face of the smooth surface may span


class MeshRecord(msgspec.Struct, frozen=True):
    """A mesh as it was found, for the manifest.

    sha256     of its file
    folder     of its corners, in the workspace
    posting_m  distance of neighbouring vertices
    halvings   of its edges, so that its surface is smooth in patches finer than it is
    mended     small faults that were mended, in words
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


def ingest_mesh(
    workspace: Workspace,
    settings: MeshSettings,
    base_dir: Path,
    body: Body,
    finest_m: float,
    progress: Progress,
    account: StageAccount,
) -> tuple[MeshTerrain, MeshRecord]:
    """The terrain of a config's [[mesh]]; a mesh that the workspace holds already is kept.

    finest_m  posting of the finest patches: in a coarser mesh faces are smoothed over
    Raises DataError for a file that cannot be used, OutputError for a workspace that cannot.
    """
    path = path_of(settings.path, base_dir)
    # the loader's own words for a file that is missing come before those of the checksum
    digest = content_hash([path], workspace, progress) if path.is_file() else ""
    plain = msgspec.structs.replace(settings, path=path.suffix)
    key = stage_key(code_key(), body.name, body.radii_m, plain, digest, finest_m)
    folder = f"mesh-{key}"
    found = workspace.get(f"{folder}/{RECORD}")
    if found is not None and workspace.path(folder, CORNERS).is_file():
        record = msgspec.json.decode(found, type=MeshRecord)
        account.kept += 1
    else:
        shape = load_shape(settings, base_dir, body, progress)
        halvings = _halvings(shape, finest_m)
        record = MeshRecord(
            path.name, digest, folder, len(shape.vertices), len(shape.faces), shape.posting_m,
            shape.volume_m3 / 1e9, halvings, shape.mended,
        )  # fmt: skip
        corners = io.BytesIO()
        np.save(corners, _corners(shape, settings, path, halvings))
        workspace.put(f"{folder}/{CORNERS}", corners.getvalue())
        workspace.put(f"{folder}/{RECORD}", msgspec.json.encode(record))
        account.done += 1
    workspace.keep_only("mesh", {key})
    if finest_m < record.posting_m:
        log.info(
            "%s: oversampled: patches have %.3g m between nodes, the mesh %.3g m between vertices;"
            " they are cut from a smooth surface through these",
            path.name, finest_m, record.posting_m,
        )  # fmt: skip
    place = workspace.path(folder, CORNERS)
    return MeshTerrain(body, place, record.name, record.posting_m), record


def _halvings(shape: Shape, finest_m: float) -> int:
    """How often edges are halved until faces span few nodes, as far as memory allows."""
    wanted = math.ceil(math.log2(shape.posting_m / (FACE_NODES * finest_m)) - 1e-9)
    if shape.posting_m <= finest_m or wanted <= 0:
        return 0
    return max(0, min(wanted, int(math.log(FINEST_FACES / len(shape.faces), 4.0))))


def _corners(shape: Shape, settings: MeshSettings, path: Path, halvings: int) -> FloatArray:
    """Corners (m, 3, 3) m of the faces, or of those of a smooth surface through the vertices."""
    if not halvings:
        return shape.vertices[shape.faces]
    metres = METRES[settings.units]
    return smooth_corners(path, settings.longitude, metres, shape.vertices, shape.faces, halvings)


def settle_pyramid(
    settings: PyramidSettings, config_path: Path, cell_deg: float, body: Body
) -> tuple[PyramidSettings, float]:
    """Posting and number of levels: the finest spans two cells, the coarsest at most 30 deg.

    Returns them as settings, and the finest posting, m.
    Raises ConfigError when even the finest patch spans more.
    """
    radius = body.radius_m
    posting = settings.posting_m
    if posting is None:
        posting = CELLS_ACROSS * math.radians(cell_deg) * radius / settings.size
    spans_deg = math.degrees(posting * settings.size / radius)
    if spans_deg > LARGEST_ARC_DEG + 1e-9:
        raise ConfigError(
            f"{config_path}: the finest patch would span {spans_deg:.3g} deg of "
            f"{body.name}; wanted at most {LARGEST_ARC_DEG:g}: set a smaller [grid] "
            "cell_deg, or [pyramid] posting_m or size"
        )
    levels = min(settings.levels, 1 + int(math.log2(LARGEST_ARC_DEG / spans_deg) + 1e-9))
    return msgspec.structs.replace(settings, levels=levels, posting_m=posting), posting


def settle_mesh_relief(
    workspace: Workspace, terrain: MeshTerrain, mesh: MeshRecord, account: StageAccount
) -> ReliefRecord:
    """Make the relief of the whole body, or keep that of an earlier run."""
    key = stage_key(code_key(), mesh.folder)
    make_or_keep(workspace, key, lambda: prepare_relief(relief_of_mesh(terrain)), account)
    return ReliefRecord(key, {})
