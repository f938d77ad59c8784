"""A patch of a control point as a closed solid, for any program that shows meshes.

Its top is the ground, its sides go down the map's verticals, its bottom lies a fifth of its width
below the lowest ground. Lengths are metres from the control point: OBJ has east, north, up as
x, y, z, GLB as x, -z, y, as its standard wants.
"""

from pathlib import Path
from typing import Any

import manifold3d
import numpy as np
import trimesh

from catalog.arrays import FloatArray, IntArray
from catalog.errors import DataError, OutputError
from catalog.geometry.projection import node_grid
from catalog.store.partial import replacing
from catalog.store.reader import Catalog

NAME = "optnav patch"  # what stands near the beginning of a file that we wrote
ENDINGS = (".obj", ".glb")
HEAD_BYTES = 4096
BASE_SHARE = 0.2
Y_UP = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])


def export_patch(catalog: Catalog, point_id: int, level: int, path: Path) -> int:
    """Write a point's patch as a solid to a .obj or .glb file; returns its number of triangles.

    Raises DataError for a point or level that is not there or a patch with holes, OutputError for
    a place that cannot be written or an existing file that is no such export.
    """
    vertices, faces = patch_solid(catalog, point_id, level)
    name = f"{NAME} {point_id} level {level}"
    data: bytes
    if path.suffix.lower() == ".glb":
        scene: Any = trimesh.Scene()
        scene.add_geometry(trimesh.Trimesh(vertices @ Y_UP.T, faces, process=False), geom_name=name)
        data = scene.export(file_type="glb")
    else:
        solid: Any = trimesh.Trimesh(vertices, faces, process=False)
        data = solid.export(file_type="obj", header=name, digits=4).encode()
    with replacing(path, _is_ours) as partial:
        try:
            partial.write_bytes(data)
        except OSError as error:
            raise OutputError(
                f"{path}: cannot be written ({error.strerror}); free some space or name another "
                "place"
            ) from error
    return len(faces)


def patch_solid(catalog: Catalog, point_id: int, level: int) -> tuple[FloatArray, IntArray]:
    """Vertices (n, 3), m, east, north, up from the point, and outward triangles (m, 3)."""
    point, patches = catalog.point(point_id), catalog.patches(point_id)
    if not 0 <= level < len(patches):
        raise DataError(
            f"{catalog.path}: control point {point_id} has {len(patches)} levels, from 0 on; "
            f"there is no level {level}"
        )
    patch = patches[level]
    holes = int(np.isnan(patch.heights_m).sum())
    if holes:
        raise DataError(
            f"{catalog.path}: level {level} of control point {point_id} has {holes} nodes without "
            "ground; a solid wants whole ground: choose another level or point"
        )
    size = patch.size
    x, y = node_grid(size, patch.posting_m)
    heights = patch.heights_m.astype(np.float64)
    base = np.full_like(heights, heights.min() - BASE_SHARE * size * patch.posting_m)
    projection = catalog.meta.projection(point)
    placed = np.stack([projection.points(x, y, h) for h in (heights, base)])
    vertices = (placed.reshape(-1, 3) - point.xyz_m) @ projection.body_from_local
    faces = _faces(size)
    solid = manifold3d.Manifold(
        manifold3d.Mesh64(vert_properties=vertices, tri_verts=faces.astype(np.uint64))
    )
    if solid.status() != manifold3d.Error.NoError or not solid.volume() > 0.0:
        raise DataError(
            f"{catalog.path}: level {level} of control point {point_id} makes no solid "
            f"({solid.status().name}); run `optnav catalog verify`"
        )
    return vertices, faces


def _faces(size: int) -> IntArray:
    """Triangles of two square grids of nodes, the ground's first, and of the sides between."""
    top = np.arange(size * size).reshape(size, size)  # row 0 north
    a, b = top[1:, :-1].ravel(), top[1:, 1:].ravel()  # south-west, south-east
    c, d = top[:-1, 1:].ravel(), top[:-1, :-1].ravel()
    ground = np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)])
    bottom = ground[:, ::-1] + size * size
    # once round the ground, eastward along the south
    rim = np.concatenate([top[-1, :-1], top[:0:-1, -1], top[0, :0:-1], top[:-1, 0]])
    after, below = np.roll(rim, -1), rim + size * size
    sides = [
        np.stack([below, np.roll(below, -1), after], axis=1),
        np.stack([below, after, rim], axis=1),
    ]
    return np.concatenate([ground, bottom, *sides])


def _is_ours(path: Path) -> bool:
    with path.open("rb") as file:
        return NAME.encode() in file.read(HEAD_BYTES)
