"""Patches written as solids open elsewhere, closed, in metres, where the ground is."""

import numpy as np
import pytest
import trimesh

from catalog.errors import DataError, OutputError
from catalog.inspect.export import export_patch, make_patch_solid
from catalog.store.reader import Catalog


@pytest.fixture
def opened(catalog_copy):
    with Catalog.open(catalog_copy) as catalog:
        yield catalog


@pytest.fixture
def whole(opened):
    """A point whose finest patch has no holes, and its patch."""
    for number in opened.ids.tolist():
        patches = opened.patches(number)
        if patches and np.isfinite(patches[0].heights_m).all():
            return number, patches[0]
    raise AssertionError("the test's catalog has no whole patch")


@pytest.mark.parametrize("ending", [".obj", ".glb"])
def test_a_patch_is_read_back_closed_and_in_place(opened, whole, ending, tmp_path) -> None:
    number, patch = whole
    path = tmp_path / f"patch{ending}"
    triangles = export_patch(opened, number, 0, path)
    read = trimesh.load(str(path), force="mesh")
    assert len(read.faces) == triangles == 4 * (patch.size - 1) * (patch.size + 1)
    assert read.is_watertight
    assert read.is_winding_consistent
    assert read.volume > 0.0
    up = 2 if ending == ".obj" else 1
    side = (patch.size - 1) * patch.posting_m
    extents = np.delete(read.extents, up)
    assert extents == pytest.approx([side, side], rel=0.01)


def test_the_top_of_a_solid_is_the_ground(opened, whole) -> None:
    number, patch = whole
    vertices, _ = make_patch_solid(opened, number, 0)
    point = opened.point(number)
    projection = opened.meta.projection(point)
    ground = vertices[: patch.size**2] @ projection.body_from_local.T + point.xyz_m
    assert projection.height_of(ground) == pytest.approx(patch.heights_m.ravel(), abs=1e-3)
    x, y = projection.xy_from_xyz(ground)
    assert (x.min(), y[0]) == pytest.approx((-(patch.size - 1) / 2.0 * patch.posting_m, y.max()))


def test_what_cannot_be_a_solid_says_why(opened, whole, tmp_path) -> None:
    number, _ = whole
    with pytest.raises(DataError, match="there is no level 9"):
        export_patch(opened, number, 9, tmp_path / "a.obj")
    with pytest.raises(DataError, match="has no control point"):
        export_patch(opened, 10**9, 0, tmp_path / "a.obj")


def test_a_solid_replaces_only_a_solid(opened, whole, tmp_path) -> None:
    path = tmp_path / "patch.obj"
    export_patch(opened, whole[0], 0, path)
    export_patch(opened, whole[0], 0, path)
    path.write_text("v 1 2 3\n")
    with pytest.raises(OutputError, match="was not made by optnav"):
        export_patch(opened, whole[0], 0, path)
