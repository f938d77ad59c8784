"""A body's shape: one closed surface of triangles about the origin, mended and checked.

Small faults are mended and named: vertices written twice (the seams of models made from grids),
triangles without area, faces inside out. Others are refused with what is wrong and where: none of
them has one remedy that would be right for all.

One is a surface that passes through itself. Two faces that cross have an edge of one that goes
through the other. Edges are traced through the mesh as rays; a face that is met counts when the
edge, in 64 bits, goes through its inside from one side to the other, by a thousandth of either's
size. So faces that only touch, as at a contact binary's neck, do not count. A solid library finds
none of these: it checks how faces are connected.
"""

import logging
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import manifold3d
import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from catalog.arrays import BoolArray, FloatArray, IntArray
from catalog.bodies.body import Body
from catalog.errors import DataError
from catalog.geometry.kernel import kernel
from catalog.geometry.latlon import latlon_from_xyz
from catalog.progress import Progress, SilentProgress
from catalog.terrain.dem.file import resolve_path
from catalog.terrain.dem.source import METRES
from catalog.terrain.mesh.file import MeshSettings, RawMesh, read_mesh
from catalog.terrain.mesh.rays import MeshRays

log = logging.getLogger(__name__)

# Vertices nearer than this share of the body's size are one: seams differ by rounding of their
# longitude (1e-12), neighbours of the largest models are 1e-4 apart.
SAME_VERTEX = 1e-7
# A triangle whose height over its longest edge is less has no normal worth the name.
MIN_ASPECT = 1e-6
MANY_FACES = 1_000_000  # from here on a check takes long enough to log it
NAMED_PLACES = 3
MAX_FACES_CROSSED = 3_000_000  # 20 s of looking for crossings
MAX_CROSSED = 0.01  # edges a face; published models of 67P have 1e-4
EDGES_AT_ONCE = 1 << 18
MAX_MET = 12  # faces on the way along one edge; most are its own neighbours at its ends
INSIDE = 1e-3


class TriangleEdges(NamedTuple):
    """Edges of faces, each side once: side s is edge s % 3 of face s // 3.

    open     (n,) sides without another side
    crowded  (n,) sides of edges that three faces or more share
    other    (3 m,) the side across, -1 for open and crowded ones
    same     (3 m,) whether the side across runs the same way: one of the faces is inside out
    """

    open: IntArray
    crowded: IntArray
    other: IntArray
    same: BoolArray


def find_edges(faces: IntArray) -> TriangleEdges:
    """The edges of faces (m, 3)."""
    start, end = faces.ravel(), np.roll(faces, -1, axis=1).ravel()
    low, high = np.minimum(start, end), np.maximum(start, end)
    key = low * (int(faces.max()) + 1) + high
    order = np.argsort(key, kind="stable")
    first = np.flatnonzero(np.diff(key[order], prepend=-1))
    count = np.diff(np.append(first, key.size))
    pairs = first[count == 2]
    a, b = order[pairs], order[pairs + 1]
    other = np.full(key.size, -1, dtype=np.int64)
    other[a], other[b] = b, a
    same = np.zeros(key.size, dtype=bool)
    same[a] = same[b] = start[a] == start[b]
    many = np.repeat(count, count) > 2
    return TriangleEdges(np.sort(order[first[count == 1]]), np.sort(order[many]), other, same)


@kernel
def _orient_pieces(other: IntArray, same: BoolArray, piece: IntArray, turned: BoolArray) -> int:
    """Number pieces and mark which faces are to turn so that each agrees with its first face.

    Returns how many pieces, or minus one where a piece has only one side (as a Moebius strip has).
    """
    faces = piece.size
    waiting = np.empty(faces, np.int64)
    count = 0
    for seed in range(faces):
        if piece[seed] >= 0:
            continue
        piece[seed] = count
        waiting[0] = seed
        size = 1
        while size > 0:
            size -= 1
            face = waiting[size]
            for k in range(3):
                across = other[3 * face + k]
                if across < 0:
                    continue
                wanted = turned[face] != same[3 * face + k]
                next_ = across // 3
                if piece[next_] < 0:
                    piece[next_] = count
                    turned[next_] = wanted
                    waiting[size] = next_
                    size += 1
                elif turned[next_] != wanted:
                    return -1
        count += 1
    return count


def find_pieces(edges: TriangleEdges) -> tuple[int, IntArray, BoolArray]:
    """Count a surface's pieces (-1: one-sided); also each face's piece and which faces to turn."""
    piece = np.full(edges.other.size // 3, -1, dtype=np.int64)
    turned = np.zeros(piece.size, dtype=bool)
    return _orient_pieces(edges.other, edges.same, piece, turned), piece, turned


def compute_volume(vertices: FloatArray, faces: IntArray) -> float:
    """Volume inside a closed surface; negative where its faces look inward."""
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    return float(np.einsum("ij,ij->", a, np.cross(b, c)) / 6.0)


def count_turns(point: FloatArray, vertices: FloatArray, faces: IntArray) -> float:
    """Count the turns of a closed surface round a point: 1 inside, 0 outside.

    Source: van Oosterom & Strackee, IEEE Trans. Biomed. Eng. 30 (1983) 125: the solid angle of a
    triangle.
    """
    a, b, c = (vertices[faces[:, k]] - point for k in range(3))
    la, lb, lc = (np.linalg.norm(v, axis=1) for v in (a, b, c))
    triple = np.einsum("ij,ij->i", a, np.cross(b, c))
    below = la * lb * lc
    for u, v, w in ((a, b, lc), (b, c, la), (c, a, lb)):
        below += np.einsum("ij,ij->i", u, v) * w
    return float(np.sum(2.0 * np.arctan2(triple, below)) / (4.0 * np.pi))


@dataclass(frozen=True)
class Shape:
    """A closed, oriented surface in one piece, the origin inside.

    vertices   (n, 3) m, body frame
    faces      (m, 3) vertex numbers, counter-clockwise seen from outside
    mended     what was wrong with the file, in words
    """

    vertices: FloatArray
    faces: IntArray
    mended: tuple[str, ...] = ()

    @property
    def volume_m3(self) -> float:
        """Volume inside."""
        return compute_volume(self.vertices, self.faces)

    @property
    def posting_m(self) -> float:
        """Distance of neighbouring vertices: of a square grid with as many faces on as much ground.

        Half a grid's square is a triangle, hence the factor two.
        """
        a, b, c = (self.vertices[self.faces[:, k]] for k in range(3))
        area = 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1).sum()
        return float(np.sqrt(2.0 * area / len(self.faces)))

    @property
    def hidden_share(self) -> float:
        """Share of the surface whose outer side looks towards the origin."""
        a, b, c = (self.vertices[self.faces[:, k]] for k in range(3))
        areas = np.cross(b - a, c - a)
        size = np.linalg.norm(areas, axis=1)
        faces_inward = np.einsum("ij,ij->i", areas, a) < 0.0
        return float(size[faces_inward].sum() / size.sum())


def load_shape(
    settings: MeshSettings, base_dir: Path, body: Body, progress: Progress | None = None
) -> Shape:
    """The shape of a [[mesh]] section.

    Raises DataError for a file that is no mesh or one that is open, in several pieces, beside the
    origin or not as large as the body.
    """
    path = resolve_path(settings.path, base_dir)
    raw = read_mesh(path, settings.longitude, progress or SilentProgress())
    if len(raw.faces) >= MANY_FACES:
        log.info("%s: checking %s faces, some 10 s a million", path, f"{len(raw.faces):,}")
    scaled = RawMesh(raw.vertices * METRES[settings.units], raw.faces)
    _check_size(path, settings, scaled.vertices, body)
    shape = repair_shape(path, scaled)
    if not np.isclose(count_turns(np.zeros(3), shape.vertices, shape.faces), 1.0, atol=1e-3):
        low, high = shape.vertices.min(axis=0) / 1e3, shape.vertices.max(axis=0) / 1e3
        raise DataError(
            f"{path}: the origin lies outside the surface (x {low[0]:.4g} to {high[0]:.4g} km, "
            f"y {low[1]:.4g} to {high[1]:.4g}, z {low[2]:.4g} to {high[2]:.4g}); wanted vertices "
            "in the body frame, from the body's centre: move the mesh"
        )
    for fault in shape.mended:
        log.info("%s: %s", path, fault)
    _check_crossings(path, shape)
    return shape


def repair_shape(path: Path, raw: RawMesh) -> Shape:
    """Mend small faults of a surface and check what is left. Raises DataError naming the place."""
    mended: list[str] = []
    vertices, faces = _merge_vertices(raw, mended)
    faces = _drop_flat_faces(vertices, faces, mended)
    if len(faces) < 4:
        raise DataError(f"{path}: {len(faces)} triangles have an area; wanted a closed surface")
    edges = find_edges(faces)
    _check_edges(path, vertices, faces, edges)
    pieces, piece, turned = find_pieces(edges)
    if pieces < 0:
        raise DataError(f"{path}: the surface has only one side; wanted one that encloses a body")
    if pieces > 1:
        sizes = np.bincount(piece, minlength=pieces)
        largest = np.argsort(-sizes, kind="stable")[:NAMED_PLACES]
        middles = np.array([vertices[faces[piece == k]].mean(axis=(0, 1)) for k in largest]) / 1e3
        listed = "; ".join(
            f"{sizes[k]} faces about ({x:.4g}, {y:.4g}, {z:.4g}) km"
            for k, (x, y, z) in zip(largest, middles, strict=True)
        )
        raise DataError(
            f"{path}: holds {pieces} closed surfaces ({listed}{'; ...' if pieces > 3 else ''}); "
            "wanted one body: leave the others out of the file"
        )
    faces = np.where(turned[:, None], faces[:, ::-1], faces)
    inward = compute_volume(vertices, faces) < 0.0
    if inward:
        faces = np.ascontiguousarray(faces[:, ::-1])
    wrong = int((turned != inward).sum())
    if wrong:
        mended.append(f"{wrong} of {len(faces)} faces looked inward and were turned")
    used, faces = np.unique(faces, return_inverse=True)
    shape = Shape(vertices[used], faces.reshape(-1, 3), tuple(mended))
    # the same once more by a library made for it: what it cannot take is no solid
    solid = manifold3d.Manifold(
        manifold3d.Mesh64(vert_properties=shape.vertices, tri_verts=shape.faces.astype(np.uint64))
    )
    if solid.status() != manifold3d.Error.NoError:
        raise DataError(
            f"{path}: is no solid ({solid.status().name}): faces that touch or cross each other; "
            "mend it in a mesh editor"
        )
    if (count := len(solid.decompose())) != 1:
        raise DataError(f"{path}: is {count} solids that touch; wanted one body")
    return shape


def _check_crossings(path: Path, shape: Shape) -> None:
    """Warn of places where a surface passes through itself; refuse one that does so all over."""
    if len(shape.faces) > MAX_FACES_CROSSED:
        log.info("%s: has too many faces to look for such that cross each other", path)
        return
    crossed = find_crossings(shape.vertices, shape.faces)
    if not len(crossed):
        return
    words = f"{len(crossed)} edges go through faces of other places, at {_format_places(crossed)}"
    if len(crossed) > MAX_CROSSED * len(shape.faces):
        raise DataError(
            f"{path}: {words}: the surface passes through itself; take another model, or mend it "
            "in a mesh editor"
        )
    log.warning("%s: %s; the outermost ground is taken there", path, words)


def _check_size(path: Path, settings: MeshSettings, vertices: FloatArray, body: Body) -> None:
    """Refuse a mesh whose farthest vertex no place of the body is as far out as."""
    lo, hi = (body.radius_m + height for height in body.plausible_heights_m)
    farthest = float(np.linalg.norm(vertices, axis=1).max())
    if max(body.radii_m) * (lo / body.radius_m) <= farthest <= hi:
        return
    remedy = "is it the mesh of another body, or scaled to one?"
    other: str = "m" if settings.units == "km" else "km"
    meant = farthest * METRES[other] / METRES[settings.units]
    if lo <= meant <= hi:
        remedy = f'are these {other}? set units = "{other}" in its [[mesh]] section'
    raise DataError(
        f"{path}: reaches {farthest / 1e3:.6g} km from the origin; {body.name} has semi-axes of "
        f"{', '.join(f'{r / 1e3:g}' for r in body.radii_m)} km and no place beyond "
        f"{hi / 1e3:g} km; {remedy}"
    )


def _merge_vertices(raw: RawMesh, mended: list[str]) -> tuple[FloatArray, IntArray]:
    """One vertex for all at the same place."""
    reach = SAME_VERTEX * float(np.abs(raw.vertices).max())
    pairs = cKDTree(raw.vertices).query_pairs(reach, output_type="ndarray")
    links = coo_array((np.ones(len(pairs)), pairs.T), shape=(len(raw.vertices),) * 2)
    number = connected_components(links, directed=False)[1]
    _, first = np.unique(number, return_index=True)
    vertices, faces = raw.vertices[first], number.astype(np.int64)[raw.faces]
    gone = np.unique(raw.faces).size - np.unique(faces).size
    if gone:
        mended.append(f"{gone} vertices stood where another did and were merged")
    return vertices, faces


def _drop_flat_faces(vertices: FloatArray, faces: IntArray, mended: list[str]) -> IntArray:
    """Faces but those on one line or point, and those written twice."""
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    longest = np.max([np.linalg.norm(v, axis=1) for v in (b - a, c - b, a - c)], axis=0)
    twice = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    flat = twice <= MIN_ASPECT * longest**2
    # three edges of one length 0 and a sliver are both dropped: an edge of a sliver that was in
    # use leaves a hole, which is then found and named
    kept = faces[~flat]
    if flat.any():
        mended.append(f"{int(flat.sum())} triangles without area were dropped")
    _, first = np.unique(np.sort(kept, axis=1), axis=0, return_index=True)
    if first.size < len(kept):
        mended.append(f"{len(kept) - first.size} triangles were there twice")
    unique: IntArray = kept[np.sort(first)]
    return unique


def _check_edges(path: Path, vertices: FloatArray, faces: IntArray, edges: TriangleEdges) -> None:
    for sides, what in (
        (edges.crowded, "sides of faces meet at edges of three faces or more: surfaces touch"),
        (edges.open, "edges belong to one face only: the surface is open"),
    ):
        if sides.size:
            start = vertices[faces.ravel()[sides]]
            end = vertices[np.roll(faces, -1, axis=1).ravel()[sides]]
            raise DataError(
                f"{path}: {sides.size} {what}, at {_format_places((start + end) / 2.0)}; wanted a "
                "closed surface: close it in a mesh editor, or take the model in another format"
            )


def _format_places(points: FloatArray) -> str:
    """Latitudes and longitudes of the first few points."""
    lat, lon, radius = latlon_from_xyz(points[:NAMED_PLACES])
    return "; ".join(
        f"lat {np.degrees(a):.2f}, lon {np.degrees(b):.2f}, {r / 1e3:.4g} km"
        for a, b, r in zip(lat, lon, radius, strict=True)
    ) + ("; ..." if len(points) > NAMED_PLACES else "")


def find_crossings(vertices: FloatArray, faces: IntArray) -> FloatArray:
    """Places (n, 3) where edges of a closed surface go through other faces, one an edge at most."""
    rays = MeshRays(vertices[faces])
    start, end = faces.ravel(), np.roll(faces, -1, axis=1).ravel()
    upward = start < end  # the other side of each edge runs the other way
    edges = np.stack([start[upward], end[upward]], axis=1)
    parts = [
        _find_crossed(rays, vertices, faces, edges[first : first + EDGES_AT_ONCE])
        for first in range(0, len(edges), EDGES_AT_ONCE)
    ]
    return np.concatenate(parts)


def _find_crossed(
    rays: MeshRays, vertices: FloatArray, faces: IntArray, edges: IntArray
) -> FloatArray:
    begin, way = vertices[edges[:, 0]], vertices[edges[:, 1]] - vertices[edges[:, 0]]
    length = np.linalg.norm(way, axis=1)
    along = way / length[:, None]
    travelled = INSIDE * length
    places = []
    waiting = np.arange(len(edges))
    for _ in range(MAX_MET):
        left = length[waiting] - travelled[waiting]
        ahead = left > INSIDE * length[waiting]
        waiting, left = waiting[ahead], left[ahead]
        if not waiting.size:
            break
        origins = begin[waiting] + travelled[waiting, None] * along[waiting]
        face, at = rays.intersect_segments(origins, along[waiting], left)
        met = face >= 0
        waiting, face, at = waiting[met], face[met], np.maximum(at[met], 0.0)
        shared = (faces[face][:, :, None] == edges[waiting][:, None, :]).any(axis=(1, 2))
        through = ~shared & _is_inside(vertices[faces[face]], begin[waiting], way[waiting])
        places.append(begin[waiting[through]] + 0.5 * way[waiting[through]])
        # beyond what was met, by more than a step of a 32-bit number of the body's size
        step = np.maximum(INSIDE * length[waiting], 1e-6 * rays.reach_m)
        travelled[waiting] += np.where(np.isfinite(at), at, 0.0) + step
        waiting = waiting[~through]
    return np.concatenate(places) if places else np.empty((0, 3))


def _is_inside(corners: FloatArray, begin: FloatArray, way: FloatArray) -> BoolArray:
    """Whether ways (n, 3) from their beginnings go through the inside of triangles (n, 3, 3)."""
    a, u, v = corners[:, 0], corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    p = np.cross(way, v)
    determinant = np.einsum("ij,ij->i", u, p)
    known = np.abs(determinant) > 1e-300
    scale = 1.0 / np.where(known, determinant, 1.0)
    t = begin - a
    q = np.cross(t, u)
    first = np.einsum("ij,ij->i", t, p) * scale
    second = np.einsum("ij,ij->i", way, q) * scale
    at = np.einsum("ij,ij->i", v, q) * scale
    least = np.min([first, second, 1.0 - first - second, at, 1.0 - at], axis=0)
    inside: BoolArray = known & (least > INSIDE)
    return inside
