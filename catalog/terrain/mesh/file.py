"""Reading a shape model's file: vertices and triangles as they are written, nothing mended.

What a file holds is counted before it is read, so that one too large for the memory is refused in
seconds; that needs one pass over text files, which have no header.
"""

import json
import re
import struct
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any, BinaryIO, Literal, NamedTuple

import msgspec
import numpy as np
import trimesh

from catalog.arrays import FloatArray, IntArray
from catalog.errors import DataError
from catalog.progress import Progress
from catalog.terrain.mesh.table import read_table

# 275 bytes a face while an OBJ is read, 500 while a mesh is checked (measured: 5 GB and 2 minutes
# for 10 million); Phobos' finest published model has 3.1 million.
MAX_FACES = 12_000_000
MESHES = (".obj", ".ply", ".stl", ".glb")
TABLES = (".tab", ".txt", ".plt", ".icq")
MEGABYTE = 1_000_000
_FACE_LINE = re.compile(rb"^[ \t]*f[ \t]", re.MULTILINE)
_FACET_LINE = re.compile(rb"^[ \t]*facet[ \t]", re.MULTILINE)


class MeshSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The [[mesh]] section of a build config.

    path       relative to the config file; "bundled:NAME" is a file that travels with optnav
    units      of the vertices or radii
    longitude  "west" for a table whose longitudes count westward
    """

    path: Annotated[str, msgspec.Meta(min_length=1)]
    units: Literal["m", "km"]
    longitude: Literal["east", "west"] = "east"


class RawMesh(NamedTuple):
    """vertices (n, 3) in the file's units, faces (m, 3) indices into them."""

    vertices: FloatArray
    faces: IntArray


def read_mesh(path: Path, longitude: str, progress: Progress) -> RawMesh:
    """The vertices and triangles of a file. Raises DataError for what is no mesh, or too large."""
    kind = path.suffix.lower()
    if not path.exists():
        raise DataError(f"{path}: there is no such file; check `path` in its [[mesh]] section")
    if path.is_dir():
        raise DataError(f"{path}: is a folder; name a mesh file")
    if path.stat().st_size == 0:
        raise DataError(f"{path}: is empty; get the file again")
    if kind not in MESHES + TABLES:
        raise DataError(
            f"{path}: is no shape model by its name; wanted a mesh ({', '.join(MESHES)}) or a "
            f"vertex table ({', '.join(TABLES)})"
        )
    if longitude == "west" and kind in MESHES:
        raise DataError(
            f'{path}: has vertices, no longitudes; take longitude = "west" out of its [[mesh]] '
            "section"
        )
    with _reported(path):
        faces = count_faces(path, progress)
        if faces is not None and faces > MAX_FACES:
            raise DataError(
                f"{path}: has {faces:,} faces; this optnav takes up to {MAX_FACES:,}: make a "
                "coarser one, whose edges are as long as the picture's pixels are on the ground"
            )
        raw = RawMesh(*read_table(path, longitude)) if kind in TABLES else _load(path, kind)
    if not len(raw.faces):
        raise DataError(f"{path}: holds no triangle; is it a {kind[1:].upper()} file of a surface?")
    if len(raw.faces) > MAX_FACES:  # polygons of many sides
        raise DataError(f"{path}: has {len(raw.faces):,} triangles; wanted up to {MAX_FACES:,}")
    if not np.isfinite(raw.vertices).all():
        bad = int(np.flatnonzero(~np.isfinite(raw.vertices).all(axis=1))[0])
        raise DataError(f"{path}: vertex {bad + 1} is not a number; correct the file")
    if raw.faces.min() < 0 or raw.faces.max() >= len(raw.vertices):
        raise DataError(
            f"{path}: a face names vertex {raw.faces.max() + 1} of {len(raw.vertices)}; the file "
            "is cut short or damaged, get it again"
        )
    return raw


@contextmanager
def _reported(path: Path) -> Iterator[None]:
    """Turn what readers of damaged files raise into an error that names the file."""
    try:
        yield
    except OSError as error:
        raise DataError(
            f"{path}: cannot be read ({error.strerror or error}); check its permissions"
        ) from None
    except (ValueError, KeyError, IndexError, TypeError, AttributeError, struct.error) as error:
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise DataError(
            f"{path}: cannot be read as {path.suffix[1:].upper()} ({reason}); it is damaged, or "
            "another kind of file under this name"
        ) from None


def _load(path: Path, kind: str) -> RawMesh:
    # unprocessed: what is mended is mended by us, and named
    loaded: Any = trimesh.load(str(path), process=False, maintain_order=True)
    if isinstance(loaded, trimesh.Scene):
        loaded = loaded.to_mesh() if loaded.geometry else None
    if not isinstance(loaded, trimesh.Trimesh):
        raise ValueError("no triangles")
    return RawMesh(
        np.array(loaded.vertices, dtype=np.float64), np.array(loaded.faces, dtype=np.int64)
    )


def count_faces(path: Path, progress: Progress) -> int | None:
    """Faces of a file from its header or one pass over its text; None where neither states them."""
    kind = path.suffix.lower()
    with path.open("rb") as file:
        if kind == ".ply":
            found = re.search(rb"element face (\d+)", file.read(65536))
            return int(found[1]) if found else None
        if kind == ".glb":
            return _glb_faces(file)
        if kind == ".stl":
            head = file.read(84)
            count = struct.unpack_from("<I", head, 80)[0] if len(head) == 84 else 0
            if path.stat().st_size == 84 + 50 * count:  # only a binary file is so long
                return int(count)
        pattern = _FACET_LINE if kind == ".stl" else _FACE_LINE
        file.seek(0)
        count, rest = 0, b""
        blocks = -(-path.stat().st_size // MEGABYTE)
        with progress.stage("count faces", total=blocks, unit="MB") as shown:
            while block := file.read(MEGABYTE):
                whole, _, rest = (rest + block).rpartition(b"\n")
                count += len(pattern.findall(whole))
                shown.advance()
        return count + len(pattern.findall(rest))


def _glb_faces(file: BinaryIO) -> int | None:
    magic, _, _, length, kind = struct.unpack("<4sIII4s", file.read(20))
    if magic != b"glTF" or kind != b"JSON":
        return None
    scene = json.loads(file.read(length))
    indices = [p["indices"] for m in scene["meshes"] for p in m["primitives"] if "indices" in p]
    return sum(int(scene["accessors"][i]["count"]) for i in indices) // 3
