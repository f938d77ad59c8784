"""Reading a shape model's file: vertices and triangles as written, nothing mended.

What a file holds is counted before it is read, so that one too large for the memory is refused in
seconds; that needs one pass over text files, which have no header.
"""

import json
import logging
import re
import struct
import warnings
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import chain, islice
from pathlib import Path
from typing import IO, Annotated, Any, BinaryIO, Literal, NamedTuple

import msgspec
import numpy as np
import trimesh
from numpy.typing import NDArray

from catalog.arrays import FloatArray, IntArray
from catalog.errors import DataError
from catalog.geometry.latlon import xyz_from_latlon
from catalog.inputs import check_input
from catalog.progress import Progress

ANGLE_TOLERANCE_DEG = 1e-4  # of what tables print
# 275 bytes a face while an OBJ is read, 500 while a mesh is checked (measured: 5 GB and 2 minutes
# for 10 million); Phobos' finest published model has 3.1 million.
MAX_FACES = 12_000_000
MAX_VERTICES = 3 * MAX_FACES  # where each face has its own
MAX_BYTES = 2 << 30  # of the largest model as text, with normals and places on textures
MAX_COORDINATE = 1e12
MAX_NODES = 10_000  # of a scene
MESHES = (".obj", ".ply", ".stl", ".glb")
TABLES = (".tab", ".txt", ".plt", ".icq")
MEGABYTE = 1_000_000
_FACE_LINE = re.compile(rb"^[ \t]*f[ \t]", re.MULTILINE)
_VERTEX_LINE = re.compile(rb"^[ \t]*v[ \t]", re.MULTILINE)
# a number of a vertex that is 0 or negative; libraries take it for one from the end
_BAD_NUMBER = re.compile(
    rb"^[ \t]*f(?:[ \t]+[1-9][^ \t\r\n]*)*[ \t]+([-+]?0*[^1-9 \t\r\n][^ \t\r\n]*)", re.M
)
_FACET_LINE = re.compile(rb"^[ \t]*facet[ \t]", re.MULTILINE)


class RadiiGrid(NamedTuple):
    """Radii (rows, cols) at latitudes (rows), pole to pole, and longitudes (cols), a whole turn.

    Angles are deg, ascending; the last column stands where the first does.
    """

    lats: FloatArray
    lons: FloatArray
    radii: FloatArray


def read_table(path: Path, longitude: str) -> tuple[FloatArray, IntArray]:
    """Vertices (n, 3) and triangles (m, 3) of a table; longitude "west" counts westward.

    Vertices on the poles and the seam occur several times. Raises ValueError for what is no table.
    """
    first, second = _read_beginning(path)
    if len(first) <= 2 and longitude == "west":
        raise ValueError('a table of vertices has no longitudes; take longitude = "west" out')
    if len(first) > 2 or len(second) not in (3, 4):
        if len(first) != 3:
            raise ValueError(f"{len(first)} columns; wanted latitude, longitude, radius")
        return make_surface(read_grid(path), longitude)
    counts = [_count(word, path) for word in first]
    with _open_lines(path) as lines:
        next(lines)
        rows = _read_numbers(islice(lines, counts[0]))
        after = next(lines, "").split()
        if len(counts) == 1 and len(after) == rows.shape[1] == 3:
            more_rows = _read_numbers(chain([" ".join(after)], lines))
            return _make_icq(np.concatenate([rows, more_rows]), counts[0])
        if len(counts) == 2:
            plates = _read_numbers(chain([" ".join(after)], lines), np.int64)
        else:
            counts.append(_count(" ".join(after), path))
            plates = _read_numbers(lines, np.int64)
    if [len(rows), len(plates)] != counts or plates.shape[1] not in (3, 4):
        raise ValueError(f"{len(rows)} vertices and {len(plates)} plates; it states {counts}")
    return rows[:, -3:], _find_vertices(plates[:, -3:], rows)


def is_grid(path: Path) -> bool:
    """Whether a table that can be read is a grid of radii."""
    return len(_read_beginning(path)[0]) == 3


def is_vertex_face_table(path: Path) -> bool:
    """Whether a table is lines "v x y z" and "f i j k"."""
    return _read_beginning(path)[0][:1] == ["v"]


def read_grid(path: Path) -> RadiiGrid:
    """The radii of a table. Raises ValueError where they do not cover the body once."""
    with _open_lines(path) as lines:
        rows = _read_numbers(lines)
    lats, lons = np.unique(rows[:, 0]), np.unique(rows[:, 1])
    shape = lats.size, lons.size
    if len(rows) != lats.size * lons.size or min(shape) < 3:
        raise ValueError(
            f"{len(rows)} lines of {lats.size} latitudes and {lons.size} longitudes; wanted one "
            "line for each pair"
        )
    ends = abs(lats[0] + 90.0), abs(lats[-1] - 90.0)
    if max(ends) > ANGLE_TOLERANCE_DEG:
        raise ValueError(f"latitudes from {lats[0]:g} to {lats[-1]:g}; wanted both poles")
    turn, step = lons[-1] - lons[0], (lons[-1] - lons[0]) / (lons.size - 1)
    closed = abs(turn - 360.0) < ANGLE_TOLERANCE_DEG
    if not closed and abs(turn + step - 360.0) > ANGLE_TOLERANCE_DEG * lons.size:
        raise ValueError(f"longitudes from {lons[0]:g} to {lons[-1]:g}; wanted a whole turn")
    radii = np.full(shape, np.nan)
    radii[np.searchsorted(lats, rows[:, 0]), np.searchsorted(lons, rows[:, 1])] = rows[:, 2]
    if not closed:
        lons, radii = np.append(lons, lons[0] + 360.0), np.column_stack([radii, radii[:, 0]])
    if not radii.min() > 0.0:
        raise ValueError(f"a radius of {radii.min():g}; wanted all above 0, each place once")
    return RadiiGrid(lats, lons, radii)


def make_surface(grid: RadiiGrid, longitude: str) -> tuple[FloatArray, IntArray]:
    """Vertices (n, 3) and triangles (m, 3), counter-clockwise from outside, of a grid of radii."""
    lats, lons, radii = grid
    sign = -1.0 if longitude == "west" else 1.0
    lat, lon = np.radians(lats)[:, None], np.radians(sign * lons)[None, :]
    vertices = xyz_from_latlon(lat, lon, radii).reshape(-1, 3)
    vertices[np.repeat(np.abs(lats) > 90.0 - ANGLE_TOLERANCE_DEG, lons.size), :2] = 0.0
    numbers = np.arange(len(vertices)).reshape(radii.shape)
    # where the two ends of a parallel differ, the step between them is part of the surface
    faces = np.concatenate([_split_quads(numbers), _split_quads(numbers[:, [-1, 0]])])
    at = np.stack([lats[:, None] + 0.0 * lons, np.mod(lons, 360.0) + 0.0 * radii, radii], axis=-1)
    at[np.abs(lats) > 90.0 - ANGLE_TOLERANCE_DEG, :, 1] = 0.0
    corners = at.reshape(-1, 3)[faces]
    faces = faces[~(corners == np.roll(corners, -1, axis=1)).all(axis=2).any(axis=1)]
    return vertices, faces if sign > 0.0 else faces[:, ::-1]


@contextmanager
def _open_lines(path: Path) -> Iterator[Iterator[str]]:
    """Lines of a table that are not blank, without commas and comments."""
    with path.open(encoding="ascii", errors="strict") as file:
        yield filter(None, (line.partition("#")[0].replace(",", " ").strip() for line in file))


def _read_beginning(path: Path) -> tuple[list[str], list[str]]:
    """The words of the first two lines."""
    with _open_lines(path) as lines:
        return next(lines, "").split(), next(lines, "").split()


def _read_numbers(lines: Iterator[str], kind: type[np.generic] = np.float64) -> NDArray[Any]:
    """The numbers (n, columns) of lines. Raises ValueError for none."""
    first = next(lines, None)
    if first is None:
        raise ValueError("it ends where numbers are wanted")
    rows = np.loadtxt(chain([first], lines), dtype=kind, ndmin=2)
    if not np.isfinite(rows).all():
        raise ValueError("a number that is not finite")
    return rows


def _count(word: str, path: Path) -> int:
    """A count of lines, of which each takes six bytes at least."""
    if not (word.isdecimal() and len(word) < 12 and 0 < 6 * int(word) <= path.stat().st_size):
        raise ValueError(f"it states {word[:20]!r} lines, which it has not")
    return int(word)


def _make_icq(vertices: FloatArray, q: int) -> tuple[FloatArray, IntArray]:
    wanted = 6 * (q + 1) ** 2
    if len(vertices) != wanted:
        raise ValueError(f"{len(vertices)} vertices; six faces of {q} x {q} have {wanted}")
    numbers = np.arange(wanted).reshape(6, q + 1, q + 1)
    return vertices, np.concatenate([_split_quads(face) for face in numbers])


def _find_vertices(plates: IntArray, rows: FloatArray) -> IntArray:
    """Places of the vertices that plates name: by the numbers before them, else from 1."""
    names = rows[:, 0] if rows.shape[1] == 4 else np.arange(1.0, len(rows) + 1.0)
    order = np.argsort(names, kind="stable")
    at = np.searchsorted(names[order], plates).clip(max=len(rows) - 1)
    missing = names[order][at] != plates
    if missing.any():
        raise ValueError(f"a plate names vertex {plates[missing][0]}, which there is none of")
    places: IntArray = order[at]
    return places


def _split_quads(numbers: IntArray) -> IntArray:
    """Two triangles for each quadrilateral of a grid of vertex numbers; rows go north."""
    a, b = numbers[:-1, :-1].ravel(), numbers[:-1, 1:].ravel()
    c, d = numbers[1:, 1:].ravel(), numbers[1:, :-1].ravel()
    return np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)])


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
    size = check_input(path, "file", "check `path` in its [[mesh]] section")
    if size == 0:
        raise DataError(f"{path}: is empty; get the file again")
    if size > MAX_BYTES:
        raise DataError(f"{path}: has {size / 1e9:.3g} GB; wanted up to {MAX_BYTES / 1e9:.3g}")
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
    with _report_errors(path):
        if kind in TABLES and is_vertex_face_table(path):
            kind = ".obj"  # "v x y z" and "f i j k", as many tables of plates are written
        faces = count_faces(path, progress, kind)
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
    far = ~(np.abs(raw.vertices) < MAX_COORDINATE)  # NaN, too
    if far.any():
        bad = int(np.flatnonzero(far.any(axis=1))[0])
        raise DataError(
            f"{path}: vertex {bad + 1} is not a number, or beyond any body; correct the file"
        )
    if raw.faces.min() < 0 or raw.faces.max() >= len(raw.vertices):
        raise DataError(
            f"{path}: a face names vertex {raw.faces.max() + 1} of {len(raw.vertices)}; the file "
            "is cut short or damaged, get it again"
        )
    return raw


@contextmanager
def _report_errors(path: Path) -> Iterator[None]:
    """Turn what readers of damaged files raise into an error that names the file."""
    try:
        yield
    except OSError as error:
        raise DataError(
            f"{path}: cannot be read ({error.strerror or error}); check its permissions"
        ) from None
    except LIBRARY_ERRORS as error:
        reason = str(error).splitlines()[0][:200] if str(error) else type(error).__name__
        raise DataError(
            f"{path}: cannot be read as {path.suffix[1:].upper()} ({reason}); it is damaged, or "
            "another kind of file under this name"
        ) from None


# Readers of trimesh check little: what stands in a damaged file comes out as any of these.
LIBRARY_ERRORS = (
    *(ArithmeticError, AssertionError, AttributeError, EOFError, ImportError, LookupError),
    *(MemoryError, NameError, RuntimeError, TypeError, ValueError, struct.error),
)


class _NoOtherFiles(trimesh.resolvers.Resolver):
    """A resolver that refuses trimesh all files beside the mesh: materials, textures, buffers."""

    def __init__(self) -> None:
        pass

    def get(self, name: str) -> bytes:
        raise ValueError(f"it wants another file, {name!r}")

    def write(self, name: str, data: Any) -> None:
        raise ValueError(f"nothing is written, not {name!r}")

    def namespaced(self, namespace: str) -> "_NoOtherFiles":
        return self

    def keys(self) -> tuple[str, ...]:
        return ()


def _load(path: Path, kind: str) -> RawMesh:
    # names of materials in an OBJ are in any encoding; its numbers are ASCII
    file: IO[Any]
    with (
        _keep_quiet(),
        path.open(encoding="latin-1") if kind == ".obj" else path.open("rb") as file,
    ):
        # unprocessed: what is mended is mended by us, and named
        loaded: Any = trimesh.load(
            file,
            file_type=kind[1:],
            resolver=_NoOtherFiles(),
            process=False,
            maintain_order=True,
            skip_materials=True,
        )
        if isinstance(loaded, trimesh.Scene):
            loaded = loaded.to_mesh() if loaded.geometry else None
        if not isinstance(loaded, trimesh.Trimesh) or np.shape(loaded.vertices)[1:] != (3,):
            raise ValueError("no triangles")
        vertices = np.array(loaded.vertices, dtype=np.float64)
        return RawMesh(vertices, np.array(loaded.faces, dtype=np.int64))


@contextmanager
def _keep_quiet() -> Iterator[None]:
    """Keep back what libraries print of a damaged file, before they raise it."""
    talk = logging.getLogger("trimesh")
    level = talk.level
    talk.setLevel(logging.CRITICAL + 1)
    try:
        with np.errstate(all="ignore"), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    finally:
        talk.setLevel(level)


def count_faces(path: Path, progress: Progress, kind: str = "") -> int | None:
    """Faces of a file from its header or one pass over its text; None where neither states them.

    kind  the ending of such files, where the path's own is not it
    Raises ValueError for sizes that the file is too short for, and for a vertex number below 1.
    """
    kind, size = kind or path.suffix.lower(), path.stat().st_size
    with path.open("rb") as file:
        if kind == ".ply":
            return _count_ply_faces(file.read(65536), size)
        if kind == ".glb":
            return _count_glb_faces(file, size)
        if kind == ".stl":
            head = file.read(84)
            count = struct.unpack_from("<I", head, 80)[0] if len(head) == 84 else 0
            if size == 84 + 50 * count:  # only a binary file is so long
                return int(count)
        file.seek(0)
        counts, tail = Counter[str](), b""
        with progress.stage("count faces", total=-(-size // MEGABYTE), unit="MB") as shown:
            while block := file.read(MEGABYTE):
                full_lines, _, tail = (tail + block).rpartition(b"\n")
                counts += _count_elements(full_lines, kind)
                shown.advance()
        counts += _count_elements(tail, kind)
    if counts["vertices"] > MAX_VERTICES:
        raise ValueError(f"{counts['vertices']:,} vertices; wanted up to {MAX_VERTICES:,}")
    return counts["faces"]


def _count_elements(lines: bytes, kind: str) -> Counter[str]:
    """Faces and vertices of a part of a text file."""
    if kind == ".stl":
        return Counter(faces=len(_FACET_LINE.findall(lines)))
    bad = _BAD_NUMBER.search(lines)
    if bad is not None and kind == ".obj":
        raise ValueError(
            f"a face names vertex {bad[1][:20].decode('latin-1')}; vertices are counted from 1"
        )
    faces, vertices = (len(line.findall(lines)) for line in (_FACE_LINE, _VERTEX_LINE))
    return Counter(faces=faces, vertices=vertices)


def _count_ply_faces(head: bytes, size: int) -> int | None:
    """Faces that a PLY's header states; each element takes a byte at least."""
    stated = {name: int(count) for name, count in re.findall(rb"element (\w+) (\d{1,20})", head)}
    if stated.get(b"face", 0) <= MAX_FACES and sum(stated.values()) > size:
        raise ValueError(f"its header states {sum(stated.values()):,} elements in {size:,} bytes")
    return stated.get(b"face")


def _count_glb_faces(file: BinaryIO, size: int) -> int | None:
    """Faces of a GLB's scene, each as often as it is placed there."""
    magic, _, _, length, kind = struct.unpack("<4sIII4s", file.read(20))
    if magic != b"glTF" or kind != b"JSON" or length > size:
        return None
    scene = json.loads(file.read(length))
    accessors, nodes = scene["accessors"], scene.get("nodes", [])
    for accessor in accessors:
        # without a view it would be filled with zeros, as many as it states
        if "bufferView" not in accessor or not 0 <= int(accessor["count"]) <= size:
            raise ValueError("an accessor that is larger than the file, or empty")
    parents = Counter(int(child) for node in nodes for child in node.get("children", []))
    if len(nodes) > MAX_NODES or max(parents.values(), default=0) > 1:
        raise ValueError(f"its scene is no tree of up to {MAX_NODES} nodes")
    faces = [
        sum(
            int(accessors[p.get("indices", p["attributes"]["POSITION"])]["count"])
            for p in mesh["primitives"]
        )
        for mesh in scene["meshes"]
    ]
    placed = [faces[int(node["mesh"])] for node in nodes if "mesh" in node] or faces
    return sum(placed) // 3
