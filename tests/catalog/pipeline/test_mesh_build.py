"""A catalog from a shape model: the whole way, on a few cells of Phobos."""

import shutil
import sqlite3
from contextlib import closing, suppress
from dataclasses import replace
from pathlib import Path

import manifold3d
import msgspec
import numpy as np
import pytest
import trimesh

from catalog.bodies.body import Body, load_body
from catalog.control_point import Flag
from catalog.errors import ConfigError, DataError, NothingToDoError
from catalog.geometry.projection import FLAT_RADIUS_M, TangentPlane
from catalog.pipeline.build import run
from catalog.store.manifest import rows_from_meta
from catalog.store.reader import Catalog
from catalog.store.verify import verify
from catalog.terrain.mesh.rays import intersect_all
from catalog.terrain.mesh.terrain import MeshTerrain

BBOX = (-15.0, -11.0, 16.0, 21.0)
SPARING = (
    "\n[check]\ntrials = 3\nplaces = 1\n[render]\nsun_declination_deg = 26.8\ncandidates = 3\n"
)
MODEL = '[[mesh]]\npath = "bundled:phobos_thomas.tab"\nunits = "km"\nlongitude = "west"\n'
CONFIG = '[body]\nname = "phobos"\n' + MODEL + "[grid]\ncell_deg = {cell}\n"


def config_in(folder: Path, cell: float = 10.0, more: str = SPARING) -> Path:
    path = folder / "phobos.toml"
    path.write_text(CONFIG.format(cell=cell) + more)
    return path


@pytest.fixture(scope="module")
def phobos() -> Body:
    return load_body("phobos")


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("phobos")
    run(config_in(folder), output=folder / "phobos.gpkg", workers=1, bbox=BBOX)
    return folder


@pytest.fixture(scope="module")
def terrain(folder, phobos) -> MeshTerrain:
    (corners,) = (folder / "phobos.gpkg.work").glob("mesh-*/corners.npy")
    return MeshTerrain(phobos, corners, "phobos_thomas.tab", 319.0)


def test_the_catalog_is_sound_and_has_usable_points(folder) -> None:
    found = verify(folder / "phobos.gpkg")
    assert found.sound
    assert found.points >= 6
    with Catalog.open(folder / "phobos.gpkg") as catalog:
        assert catalog.meta.usable >= 3


def test_the_manifest_names_the_planes_and_what_is_oversampled(folder) -> None:
    with Catalog.open(folder / "phobos.gpkg") as catalog:
        meta = catalog.meta
        assert meta.planes is not None
        assert meta.planes.radii_m == (13000.0, 11400.0, 9100.0)
        # two cells of 10 deg in 80 nodes; a second level would span 40 deg
        assert meta.posting_m == pytest.approx(np.radians(20.0) * 11080.0 / 80)
        assert meta.levels == 1
        assert meta.posting_m < meta.planes.model_posting_m == pytest.approx(319.2, abs=0.1)
        assert meta.map_radius_m == FLAT_RADIUS_M
    record = msgspec.json.decode((folder / "phobos.gpkg.work" / "manifest.json").read_bytes())
    assert record["dems"][0]["faces"] == 32070


def test_patches_lie_where_exact_rays_meet_the_shape(folder, terrain) -> None:
    """Quantisation is half a step of 0.2 m; the rest is the place's rounding on steep faces."""
    with Catalog.open(folder / "phobos.gpkg") as catalog:
        for number in catalog.ids[::4].tolist():
            point = catalog.point(number)
            plane = catalog.meta.projection(point)
            assert isinstance(plane, TangentPlane)
            (patch,) = catalog.patches(number)
            middle = patch.heights_m[39:41, 39:41].mean()
            assert middle == pytest.approx(float(plane.height_of(point.xyz_m)), abs=15.0)
            for row, col in ((5, 70), (40, 40), (66, 12)):
                x, y = (col - 39.5) * patch.posting_m, (39.5 - row) * patch.posting_m
                start = plane.points(x, y, 3e4)
                down = -plane.body_from_local[:, 2]
                _, at = intersect_all(terrain.rays.corners, start, down, 0.0)
                assert patch.heights_m[row, col] == pytest.approx(3e4 - at, abs=0.2)


def test_points_stand_on_the_shape_and_in_their_cells(folder, terrain) -> None:
    with Catalog.open(folder / "phobos.gpkg") as catalog:
        ground = terrain.points(np.radians(catalog.lat_deg), np.radians(catalog.lon_deg))
        assert np.linalg.norm(ground, axis=1) == pytest.approx(catalog.radius_m, abs=0.01)
        assert (catalog.grid.find_cells(catalog.lat_deg, catalog.lon_deg) == catalog.ids).all()
        assert not (catalog.records["flags"] & int(Flag.NO_DATA)).any()


def test_the_catalog_carries_the_relief_of_the_whole_body(folder, terrain) -> None:
    with Catalog.open(folder / "phobos.gpkg") as catalog:
        relief = catalog.relief()
    assert relief is not None
    lat, lon = np.radians([[-70.0], [-10.0], [45.0]]), np.radians([-170.0, -20.0, 5.0, 120.0])
    means = relief.heights_at(lat, lon)
    exact = terrain.heights(lat, lon, 50.0)
    # cells of 160 m on slopes of up to 40 deg
    assert np.abs(means - exact).max() < 60.0
    radii = np.linalg.norm(terrain.rays.corners.reshape(-1, 3), axis=1)
    assert relief.max_heights.max() == pytest.approx(radii.max() - 11080.0, abs=4.0)


@pytest.mark.parametrize(
    "damage", [lambda data: data[:-9], lambda data: data[:900] + b"\xff" * 9 + data[909:]]
)
@pytest.mark.parametrize("name", ["corners.npy", "mesh.json"])
def test_a_damaged_mesh_of_the_work_folder_is_made_again(folder, tmp_path, name, damage) -> None:
    work = tmp_path / "work"
    shutil.copytree(folder / "phobos.gpkg.work", work)
    (path,) = work.glob(f"mesh-*/{name}")
    whole = path.read_bytes()
    path.write_bytes(damage(whole))
    run(config_in(tmp_path), stages=("ingest",), work=work, workers=1, bbox=BBOX)
    assert path.read_bytes() == whole


def test_a_shape_of_few_faces_is_tried_with_relief_too(tmp_path) -> None:
    coarse = trimesh.creation.icosphere(subdivisions=1, radius=11.0)
    coarse.export(tmp_path / "coarse.obj")
    path = config_in(tmp_path, 15.0)
    path.write_text(
        path.read_text().replace(MODEL, '[[mesh]]\npath = "coarse.obj"\nunits = "km"\n')
    )
    with suppress(NothingToDoError):  # it need not be of use
        run(path, output=tmp_path / "coarse.gpkg", workers=1, bbox=(0.0, 0.0, 15.0, 14.0))
    assert verify(tmp_path / "coarse.gpkg").sound


def test_more_workers_and_another_run_give_the_same_content(folder, tmp_path) -> None:
    report = run(config_in(tmp_path), output=tmp_path / "b.gpkg", workers=2, bbox=BBOX)
    with Catalog.open(folder / "phobos.gpkg") as catalog:
        assert report.digest == catalog.digest
    again = run(config_in(tmp_path), output=tmp_path / "b.gpkg", workers=1, bbox=BBOX)
    assert [stage.done for stage in again.account.stages] == [0] * 5


def test_finer_cells_have_as_many_levels_as_span_30_deg(folder, tmp_path) -> None:
    shutil.copytree(folder / "phobos.gpkg.work", tmp_path / "work")  # the mesh, read already
    config = config_in(tmp_path, cell=4.0)
    run(config, work=tmp_path / "work", stages=("ingest",), workers=1, bbox=BBOX)
    record = msgspec.json.decode((tmp_path / "work" / "manifest.json").read_bytes())
    assert record["config"]["pyramid"]["levels"] == 2  # 8 and 16 deg


def test_a_contact_binary_is_built_and_its_overhangs_are_told(tmp_path) -> None:
    """Two balls that touch, at their neck: lines along the vertical meet the ground four times."""
    ball = manifold3d.Manifold.sphere(6.0, 96)
    both = ball.translate([5.4, 0.0, 0.0]) + ball.scale([0.6] * 3).translate([-3.6, 0.0, 0.0])
    mesh = both.to_mesh64()
    trimesh.Trimesh(mesh.vert_properties, mesh.tri_verts).export(str(tmp_path / "binary.obj"))
    path = config_in(tmp_path, cell=15.0)
    path.write_text(
        path.read_text().replace(MODEL, '[[mesh]]\npath = "binary.obj"\nunits = "km"\n')
    )
    output = tmp_path / "binary.gpkg"
    # smooth balls have nothing to recognise; what counts is the record
    with suppress(NothingToDoError):
        run(path, output=output, workers=1, bbox=(100.0, -8.0, 170.0, 8.0))
    assert verify(output).sound
    with Catalog.open(output) as catalog:
        flags = catalog.records["flags"]
        assert len(catalog) >= 3
        assert (flags & int(Flag.OVERHANG) != 0).any()
        # where the ground has no one height, no point is usable
        assert not catalog.usable[flags & int(Flag.NO_DATA) != 0].any()


BILOBED = """name = "bilobed"
radius_km = 1.7
radii_km = [2.6, 1.9, 1.6]
gm_km3_s2 = 7.0e-7
plausible_heights_km = [-1.6, 4.0]
sun = "mars"
[rotation]
pole_ra_deg_by_century = [317.7, -0.1, 0.0]
pole_dec_deg_by_century = [52.9, -0.1, 0.0]
meridian_deg_by_day = [35.2, 1128.8, 0.0]
"""


def test_the_points_of_a_bilobed_body_have_planes_of_their_own(tmp_path) -> None:
    """Cells under a cliff keep their middle, and say why they are not usable."""
    ball = manifold3d.Manifold.sphere(1.0, 24)
    both = ball.scale([1.577, 1.44, 1.458]).translate([1.174, 0.487, 0.133])
    both += ball.scale([1.337, 1.165, 1.34]).translate([-1.452, -0.538, 0.42])
    both += manifold3d.Manifold.sphere(0.4, 32)
    mesh = both.to_mesh64()
    trimesh.Trimesh(mesh.vert_properties, mesh.tri_verts).export(str(tmp_path / "two.obj"))
    (tmp_path / "bilobed.toml").write_text(BILOBED)
    path = config_in(tmp_path, cell=15.0)
    ours = path.read_text().replace(MODEL, '[[mesh]]\npath = "two.obj"\nunits = "km"\n')
    path.write_text(ours.replace('"phobos"', '"bilobed.toml"'))
    with suppress(NothingToDoError):
        run(path, output=tmp_path / "two.gpkg", workers=1, bbox=(120.0, 1.0, 150.0, 14.0))
    assert verify(tmp_path / "two.gpkg").sound
    with Catalog.open(tmp_path / "two.gpkg") as catalog:
        assert len(catalog) == 2
        assert (catalog.records["flags"] & int(Flag.OVERHANG | Flag.NO_DATA) != 0).all()
        assert not catalog.usable.any()
        planes = catalog.meta.planes
        assert planes is not None
        assert catalog.meta.format_version == 5
        assert sorted(planes.verticals_deg) == catalog.ids.tolist()
        for point in catalog.points():
            plane = catalog.meta.projection(point)
            assert float(plane.height_of(point.xyz_m)) == pytest.approx(0.0, abs=1e-6)
        kept = {point.id: planes.verticals_deg[point.id]}
        rows = rows_from_meta(replace(catalog.meta, planes=replace(planes, verticals_deg=kept)))
    with closing(sqlite3.connect(tmp_path / "two.gpkg")) as db, db:
        values = [(value, key) for key, value in rows.items()]
        db.executemany("UPDATE optnav_meta SET value = ? WHERE key = ?", values)
    words = " ".join(str(problem) for problem in verify(tmp_path / "two.gpkg").problems)
    assert "the manifest has no vertical of it" in words


@pytest.mark.parametrize(
    ("text", "cell", "error", "words"),
    [
        (MODEL, 20.0, ConfigError, "would span 40 deg of phobos"),
        (MODEL.replace("km", "m"), 10.0, DataError, 'are these km? set units = "km"'),
        (MODEL.replace("bundled:", "no-"), 10.0, DataError, "there is no such file"),
    ],
)
def test_what_cannot_be_built_says_why(tmp_path, text, cell, error, words) -> None:
    path = tmp_path / "phobos.toml"
    path.write_text(CONFIG.format(cell=cell).replace(MODEL, text))
    with pytest.raises(error) as refused:
        run(path, work=tmp_path / "work", stages=("ingest",), workers=1)
    assert words in str(refused.value)
