"""Shape models are read from all formats; small faults are mended and named, others refused."""

import json
import os
import re
import struct
from collections.abc import Callable
from contextlib import suppress
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
    "ply without corners": (
        lambda m: (
            "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\n"
            "property float z\nelement face 1\nproperty list uchar int corners\n"
            "property float area\nend_header\n0 0 1\n1 0 0\n0 1 0\n3 0 1 2 0.5\n"
        ),
        "ply", "cannot be read as PLY",
    ),
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


def obj_text(mesh: trimesh.Trimesh, base: int = 1) -> str:
    lines = [f"v {x!r} {y!r} {z!r}" for x, y, z in mesh.vertices.tolist()]
    lines += [f"f {a} {b} {c}" for a, b, c in (mesh.faces + base).tolist()]
    return "\n".join(lines) + "\n"


def glb_of(mesh: trimesh.Trimesh, change: Callable[[dict], object]) -> bytes:
    """A GLB whose description is changed."""
    data = mesh.export(file_type="glb")
    length = struct.unpack_from("<I", data, 12)[0]
    scene = json.loads(data[20 : 20 + length])
    text = change(scene)
    head = text if isinstance(text, bytes) else json.dumps(scene).encode()
    head += b" " * (-len(head) % 4)
    rest = data[20 + length :]
    whole = struct.pack("<4sII", b"glTF", 2, 20 + len(head) + len(rest))
    return whole + struct.pack("<I4s", len(head), b"JSON") + head + rest


@pytest.mark.parametrize("base", [0, -5000])
@pytest.mark.parametrize("name", ["body.obj", "body.tab"])
def test_vertices_of_an_obj_are_counted_from_one(name, base, load, ellipsoid_km) -> None:
    """Counted from 0 the last vertex stands in for the first: a closed surface of another shape."""
    with pytest.raises(DataError, match=r"a face names vertex (0|-\d+); vertices are counted from"):
        load(obj_text(ellipsoid_km, base), name)


def test_plate_tables_are_read_in_the_ways_they_are_written(load, ellipsoid_km) -> None:
    volume = pytest.approx(ellipsoid_km.volume * 1e9, rel=1e-9)
    assert load("# plates\n" + obj_text(ellipsoid_km), "body.tab").volume_m3 == volume
    vertices, faces = ellipsoid_km.vertices.tolist(), ellipsoid_km.faces.tolist()
    rows = [f" {x!r}, {y!r}, {z!r}" for x, y, z in vertices]
    plates = [f" {a + 1}, {b + 1}, {c + 1}" for a, b, c in faces]
    counts = str(len(rows)), str(len(plates))
    bare = [counts[0], *rows, counts[1], *plates]
    numbered = [f"{counts[0]} {counts[1]}", *(f"{i}{row}" for i, row in enumerate(rows))]
    from_zero = [f"{i} {a} {b} {c}" for i, (a, b, c) in enumerate(faces)]
    assert load("\r\n".join(bare), "body.tab").volume_m3 == volume
    assert load("\n".join(numbered + from_zero), "body.tab").volume_m3 == volume
    with pytest.raises(DataError, match="names vertex 0, which there is none of"):
        load("\n".join([*bare[: len(rows) + 2], "0 1 2", *plates[1:]]), "body.tab")
    with pytest.raises(DataError, match=r"states '9{11}' lines"):
        load("\n".join(["9" * 11, *bare[1:]]), "body.tab")


def test_names_in_any_encoding_do_no_harm(load, ellipsoid_km) -> None:
    text = b"# mod\xe8le\nmtllib caf\xe9.mtl\no b\xff\n" + obj_text(ellipsoid_km).encode()
    assert load(text).volume_m3 == pytest.approx(ellipsoid_km.volume * 1e9, rel=1e-9)


def test_no_file_beside_the_mesh_is_opened(load, ellipsoid_km, tmp_path) -> None:
    os.mkfifo(tmp_path / "pipe.mtl")  # opening it would wait for ever
    text = "mtllib pipe.mtl\nusemtl a\n" + obj_text(ellipsoid_km)
    assert load(text).volume_m3 > 0.0

    def outside(scene: dict) -> None:
        scene["buffers"] = [{"uri": "pipe.mtl", "byteLength": 10}, *scene["buffers"]]
        for view in scene["bufferViews"]:
            view["buffer"] = 0

    with pytest.raises(DataError, match=r"wants another file, 'pipe\.mtl'"):
        load(glb_of(ellipsoid_km, outside), "body.glb")


@pytest.mark.parametrize(
    "change",
    [
        lambda s: b'{"asset":' * 50_000,
        lambda s: s["accessors"][0].update(count=1e18),
        lambda s: json.dumps(s).replace(f'"count": {s["accessors"][0]["count"]}', '"count": 1e999')
        .encode(),
        lambda s: s["accessors"][0].pop("bufferView"),
        lambda s: s["nodes"].extend({"mesh": 0, "children": [0, 0]} for _ in range(60)),
        lambda s: s["nodes"].extend({"mesh": 0} for _ in range(20_000)),
        lambda s: s.update(meshes=[]),
    ],
)  # fmt: skip
def test_a_description_beyond_its_file_is_refused(change, load, ellipsoid_km) -> None:
    with pytest.raises(DataError, match=r"body\.glb: "):
        load(glb_of(ellipsoid_km, change), "body.glb")


def test_a_header_that_states_more_than_the_file_holds_is_refused(load) -> None:
    text = "ply\nformat ascii 1.0\nelement vertex 3000000000\nproperty float x\nend_header\n"
    with pytest.raises(DataError, match=r"3,000,000,000 elements in 7. bytes"):
        load(text, "huge.ply")


def test_a_surface_through_itself_is_told_or_refused(load, ellipsoid_km, caplog) -> None:
    assert load(ellipsoid_km).mended == ()
    assert "go through" not in caplog.text
    vertices = ellipsoid_km.vertices.copy()
    vertices[7] = -1.05 * vertices[7] + 5.0  # through the body, and out at the other side
    load(trimesh.Trimesh(vertices, ellipsoid_km.faces, process=False))
    assert re.search(r"\d edges go through faces of other places, at lat", caplog.text)
    turned = np.random.default_rng(5).uniform(-0.4, 0.4, len(vertices))
    x, y, z = ellipsoid_km.vertices.T
    c, s = np.cos(turned), np.sin(turned)
    twisted = np.stack([c * x - s * y, s * x + c * y, z], axis=1)
    with pytest.raises(DataError, match="the surface passes through itself"):
        load(trimesh.Trimesh(twisted, ellipsoid_km.faces, process=False))


@pytest.mark.parametrize("kind", ["obj", "ply", "stl", "glb", "plt", "tab"])
def test_damaged_files_are_refused_or_read_but_never_crash(
    kind, load, ellipsoid_km, phobos
) -> None:
    ball = trimesh.creation.icosphere(1)
    mesh = trimesh.Trimesh(ball.vertices * np.array(phobos.radii_m) / 1e3, ball.faces)
    if kind == "tab":
        whole = "".join(f"{a} {b} 11\n" for a in range(-90, 91, 15) for b in range(0, 361, 15))
    elif kind == "plt":
        rows = [f"{i} {x!r} {y!r} {z!r}" for i, (x, y, z) in enumerate(mesh.vertices.tolist())]
        plates = [f"{i} {a} {b} {c}" for i, (a, b, c) in enumerate(mesh.faces)]
        whole = "\n".join([str(len(rows)), *rows, str(len(plates)), *plates])
    else:
        whole = mesh.export(file_type=kind)
    data = whole.encode() if isinstance(whole, str) else whole
    rng = np.random.default_rng(11)
    words = [b"nan", b"-1", b"0", b"1e308", b"1e999", b"9" * 20, b"", b"\xff", b"4294967295", b"{"]
    for _ in range(60):
        wrong = bytearray(data)
        match int(rng.integers(3)):
            case 0:
                for at in rng.integers(min(len(wrong), 900), size=3).tolist():
                    wrong[at] = int(rng.integers(256))
            case 1:
                del wrong[int(rng.integers(len(wrong))) :]
            case _:
                numbers = [*re.finditer(rb"[-+\d.eE]+", data)]
                found = numbers[int(rng.integers(len(numbers)))]
                wrong[found.start() : found.end()] = words[int(rng.integers(len(words)))]
        with suppress(DataError):
            load(bytes(wrong), f"body.{kind}")
