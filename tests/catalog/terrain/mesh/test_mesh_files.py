"""Shape models are read from all formats; small faults are mended and named, others refused."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import trimesh
from scipy.spatial import cKDTree

from catalog.errors import DataError
from catalog.progress import SilentProgress
from catalog.terrain.mesh import file
from catalog.terrain.mesh.file import MeshSettings, count_faces
from catalog.terrain.mesh.shape import Shape, load_shape

Loader = Callable[..., Shape]


@pytest.fixture
def load(tmp_path, phobos) -> Loader:
    """Write a mesh (km) to a file, or text, and read it as Phobos."""

    def load(what, name="body.obj", units="km", longitude="east"):
        path = tmp_path / name
        if isinstance(what, str | bytes):
            path.write_bytes(what.encode() if isinstance(what, str) else what)
        else:
            what.export(str(path))
        return load_shape(MeshSettings(name, units, longitude), tmp_path, phobos)

    return load


def with_faces(mesh, faces) -> trimesh.Trimesh:
    return trimesh.Trimesh(mesh.vertices, faces, process=False)


@pytest.mark.parametrize("name", ["body.obj", "body.ply", "body.stl", "body.glb"])
def test_every_mesh_format_gives_the_same_body(name, load, ellipsoid_km) -> None:
    shape = load(ellipsoid_km, name)
    assert shape.volume_m3 == pytest.approx(ellipsoid_km.volume * 1e9, rel=1e-5)
    assert (len(shape.vertices), len(shape.faces)) == (642, 1280)
    apart, _ = cKDTree(shape.vertices).query(ellipsoid_km.vertices * 1e3)
    assert apart.max() < 2e-3  # binary formats hold 32 bits


@pytest.mark.parametrize("name", ["body.obj", "body.ply", "body.stl", "body.glb"])
def test_faces_are_counted_before_they_are_read(name, tmp_path, ellipsoid_km) -> None:
    path = tmp_path / name
    ellipsoid_km.export(str(path))
    assert count_faces(path, SilentProgress()) == 1280
    if name == "body.stl":
        path.write_text(trimesh.exchange.stl.export_stl_ascii(ellipsoid_km))
        assert count_faces(path, SilentProgress()) == 1280


def test_the_table_with_west_longitude_gives_the_published_obj(
    phobos, phobos_shape, shared_data
) -> None:
    obj = load_shape(MeshSettings("phobos_thomas.obj", "km"), shared_data("phobos"), phobos)
    apart, _ = cKDTree(obj.vertices).query(phobos_shape.vertices)
    assert apart.max() < 1e-4
    east = load_shape(MeshSettings("bundled:phobos_thomas.tab", "km"), Path(), phobos)
    mirrored, _ = cKDTree(obj.vertices).query(east.vertices)
    assert mirrored.max() > 500.0  # the wrong sign is another body
    assert any("merged" in fault for fault in obj.mended)
    assert obj.volume_m3 / 1e9 == pytest.approx(5748.7, abs=0.1)


def test_the_shipped_phobos_is_closed_and_as_large_as_published(phobos_shape) -> None:
    # Thomas (1989): 5748 km^3 within 190; with the model's own seam merged
    assert phobos_shape.volume_m3 / 1e9 == pytest.approx(5749.0, abs=0.5)
    assert phobos_shape.posting_m == pytest.approx(319.0, abs=1.0)
    assert len(phobos_shape.vertices) - 1.5 * len(phobos_shape.faces) + len(
        phobos_shape.faces
    ) == pytest.approx(2.0)  # Euler: a ball


def test_plate_and_quadrilateral_tables_are_read(load, ellipsoid_km) -> None:
    rows = [
        f"{i + 1} {x!r} {y!r} {z!r}" for i, (x, y, z) in enumerate(ellipsoid_km.vertices.tolist())
    ]
    plates = [f"{i + 1} {a + 1} {b + 1} {c + 1}" for i, (a, b, c) in enumerate(ellipsoid_km.faces)]
    text = "\n".join([str(len(rows)), *rows, str(len(plates)), *plates, ""])
    assert load(text, "body.plt").volume_m3 == pytest.approx(ellipsoid_km.volume * 1e9, rel=1e-9)
    q = 8
    grid = np.linspace(-1.0, 1.0, q + 1)
    u, v = np.meshgrid(grid, grid)
    sides = [np.stack([u, v, s + 0.0 * u], axis=-1)[..., order] for s in (1.0, -1.0)
             for order in ([0, 1, 2], [2, 0, 1], [1, 2, 0])]  # fmt: skip
    cube = np.concatenate([side.reshape(-1, 3) for side in sides])
    ball = 11.5 * cube / np.linalg.norm(cube, axis=1)[:, None]
    icq = f"{q}\n" + "\n".join(" ".join(map(repr, row)) for row in ball.tolist())
    shape = load(icq, "body.icq")
    assert shape.volume_m3 / 1e9 == pytest.approx(4.0 / 3.0 * np.pi * 11.5**3, rel=0.03)
    assert any("inward" in fault for fault in shape.mended)


def test_faces_inside_out_are_turned_and_counted(load, ellipsoid_km) -> None:
    faces = ellipsoid_km.faces.copy()
    faces[[3, 500, 501]] = faces[[3, 500, 501], ::-1]
    shape = load(with_faces(ellipsoid_km, faces))
    assert shape.mended == ("3 of 1280 faces looked inward and were turned",)
    assert shape.volume_m3 == pytest.approx(ellipsoid_km.volume * 1e9, rel=1e-6)
    everted = load(with_faces(ellipsoid_km, ellipsoid_km.faces[:, ::-1]))
    assert everted.mended == ("1280 of 1280 faces looked inward and were turned",)
    assert everted.volume_m3 > 0.0


def test_vertices_written_twice_and_flat_triangles_are_mended(load, ellipsoid_km) -> None:
    corners = ellipsoid_km.vertices[ellipsoid_km.faces].reshape(-1, 3)
    soup = np.arange(len(corners)).reshape(-1, 3)
    flat = [[0, 0, 1], [0, 1, 3]]
    line = np.concatenate([corners, [corners[0], corners[1]]])
    shape = load(trimesh.Trimesh(line, np.concatenate([soup, [flat[0]]]), process=False), "b.ply")
    assert len(shape.vertices) == 642
    assert any("merged" in fault for fault in shape.mended)
    assert any("1 triangles without area" in fault for fault in shape.mended)


def two_bodies(mesh) -> trimesh.Trimesh:
    moon = trimesh.Trimesh(mesh.vertices * 0.01 + [13.5, 0.0, 0.0], mesh.faces)
    return trimesh.util.concatenate([mesh, moon])


BAD = {
    "open": (lambda m: with_faces(m, m.faces[5:]), "obj", "the surface is open, at lat"),
    "two": (two_bodies, "ply", r"holds 2 closed surfaces .*1280 faces about \(13.5"),
    "three at an edge": (
        lambda m: with_faces(m, np.vstack([m.faces, [*m.faces[0, :2], m.faces[-1, 0]]])),
        "obj",
        "three faces or more",
    ),
    "metres": (
        lambda m: trimesh.Trimesh(m.vertices * 1e3, m.faces), "obj", 'set units = "m"',
    ),
    "half size": (
        lambda m: trimesh.Trimesh(m.vertices * 0.5, m.faces), "stl", "reaches 6.5 km",
    ),
    "beside": (
        lambda m: trimesh.Trimesh(m.vertices * 0.3 + [9.0, 0.0, 0.0], m.faces),
        "obj", "the origin lies outside",
    ),
    "text": (lambda m: "Dear all,\nthis is no mesh.\n", "obj", "cannot be read as OBJ|no triangle"),
    "text as ply": (lambda m: "hello", "ply", "cannot be read as PLY"),
    "text as stl": (lambda m: "hello " * 40, "stl", "cannot be read as STL|no triangle"),
    "text as glb": (lambda m: "hello " * 40, "glb", "cannot be read as GLB"),
    "empty": (lambda m: "", "obj", "is empty"),
    "no faces": (lambda m: "v 1 2 3\nv 4 5 6\nv 7 8 9\n", "obj", "no triangle"),
    "short table": (lambda m: "-90 0 8.4\n-90 2 8.4\n", "tab", "wanted"),
    "cut table": (lambda m: "-90 0\n", "tab", "wanted latitude|columns"),
    "another name": (lambda m: "x", "doc", "no shape model by its name"),
}  # fmt: skip


@pytest.mark.parametrize("name", BAD)
def test_what_cannot_be_mended_is_refused_by_name_and_place(name, load, ellipsoid_km) -> None:
    make, kind, message = BAD[name]
    with pytest.raises(DataError, match=message) as refused:
        load(make(ellipsoid_km), f"body.{kind}")
    assert f"body.{kind}: " in str(refused.value)


def test_a_moebius_strip_has_no_inside(load) -> None:
    # the projective plane in six vertices: closed, every edge twice, one side
    faces = np.array([[0, 1, 2], [0, 2, 3], [0, 3, 4], [0, 4, 5], [0, 5, 1],
                      [1, 2, 4], [2, 3, 5], [3, 4, 1], [4, 5, 2], [5, 1, 3]])  # fmt: skip
    places = np.random.default_rng(3).uniform(-8.0, 8.0, (6, 3))
    places[0] = (13.0, 0.0, 0.0)
    with pytest.raises(DataError, match="only one side"):
        load(trimesh.Trimesh(places, faces, process=False))


def test_too_many_faces_are_refused_from_the_header_or_one_pass(
    load, ellipsoid_km, monkeypatch
) -> None:
    header = "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nelement face 20000000\n"
    with pytest.raises(DataError, match=r"20,000,000 faces; .* up to 12,000,000"):
        load(header + "end_header\n", "huge.ply")
    monkeypatch.setattr(file, "MAX_FACES", 1000)
    with pytest.raises(DataError, match="has 1,280 faces"):
        load(ellipsoid_km, "huge.obj")


def test_west_longitude_belongs_to_tables(load, ellipsoid_km) -> None:
    with pytest.raises(DataError, match="has vertices, no longitudes"):
        load(ellipsoid_km, longitude="west")
