"""`optnav catalog ...` as a user calls it, on a catalog of the bundled Tycho terrain's middle."""

import json
import re
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import rasterio

from catalog.config import resource
from catalog.control_point import SHADOW_AZIMUTHS, ControlPoint, Flag, Patch
from catalog.geometry.cells import CellGrid
from catalog.geometry.latlon import angular_distance
from catalog.store.manifest import CatalogMeta
from catalog.store.reader import Catalog
from catalog.store.writer import Written
from optnav_cli.main import run
from tests.catalog.made_catalogs import make_world
from tests.catalog.store.written import write_points

CHECKOUT = Path(__file__).resolve().parents[3]
TYCHO = (-43.3, -11.2)


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> Written:
    with rasterio.open(resource("data/tycho_gld100_256ppd.tif")) as source:
        ground = source.read(1).astype(np.float32)
    grid = CellGrid(1.0)
    points = []
    for number, cell in enumerate(grid.find_cells_within(*TYCHO, 2.0).tolist()):
        lat, lon = grid.centre_deg(cell)
        row = 700 + 60 * number % 1100
        heights = ground[row : row + 64, 900:964]
        flags = Flag.FLAT | Flag.NOT_RECOGNISED if number == 1 else Flag.NONE
        point = ControlPoint(
            cell, lat, lon, 1737400.0 + float(heights[32, 32]), 0.1, 0.5, 0.8, 5, (0.5,),
            (10.0,) * SHADOW_AZIMUTHS, not flags, flags, "tycho",
        )  # fmt: skip
        points.append((point, [Patch(118.45, heights)]))
    meta = CatalogMeta("moon", 1737400.0, 1.0, 1, 64, 118.45, 0.5, {"tycho": "sha256 0"})
    return write_points(tmp_path_factory.mktemp("tycho") / "tycho.gpkg", meta, points)


def lines(text: str) -> dict[str, str]:
    return dict(line.split(": ", 1) for line in text.splitlines())


def test_info_prints_keys_and_values(written: Written, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["catalog", "info", str(written.path)]) == 0
    told = lines(capsys.readouterr().out)
    assert told["digest"] == written.digest
    assert told["body"] == "moon"
    assert told["points"] == str(written.count)
    assert told["usable"] == str(written.count - 1)
    assert (told["rejected_flat"], told["rejected_not_recognised"]) == ("1", "1")


def test_info_loads_no_compiler(written: Written) -> None:
    """It would take half of the time; what is compiled is needed for patches and neighbours."""
    script = (
        "import sys; from optnav_cli.main import run; run(sys.argv[1:]); "
        "print([m for m in ('numba', 'scipy', 'cv2', 'rasterio', 'numpy.ma') if m in sys.modules])"
    )
    words = [sys.executable, "-c", script, "catalog", "info", str(written.path)]
    result = subprocess.run(words, cwd=CHECKOUT, capture_output=True, text=True, check=True)
    assert result.stdout.splitlines()[-1] == "[]"


def test_nearest_takes_negative_numbers(
    written: Written, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(["catalog", "nearest", str(written.path), "-43.3", "-11.2"]) == 0
    told = lines(capsys.readouterr().out)
    place = (float(told["lat_deg"]), float(told["lon_deg"]))
    angle = angular_distance(*np.radians(TYCHO), *np.radians(place))
    assert float(told["distance_km"]) == pytest.approx(1737.4 * angle, abs=0.001)
    assert float(told["distance_km"]) < 25.0


def test_nearest_tells_direction_and_what_the_catalog_does_not_cover(
    written: Written, capsys: pytest.CaptureFixture[str]
) -> None:
    def asked(lat: float, lon: float, *more: str) -> dict[str, str]:
        assert run(["catalog", "nearest", str(written.path), str(lat), str(lon), *more]) == 0
        return lines(capsys.readouterr().out)

    grid = CellGrid(1.0)
    lat, lon = grid.centre_deg(int(grid.find_cells(*TYCHO)))
    for off, azimuth in (((0.1, 0.0), 180.0), ((0.0, 0.1), 270.0), ((-0.1, 0.0), 0.0)):
        told = asked(lat + off[0], lon + off[1])
        assert abs((float(told["azimuth_deg"]) - azimuth + 180.0) % 360.0 - 180.0) < 0.1
        assert "note" not in told
    far = asked(60.0, 100.0)
    assert re.search(r"does not cover this place: .* 40\d\d\.\d km away", far["note"])


def test_nearest_lists_points_by_distance_and_leaves_unusable_ones_out(
    written: Written, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["catalog", "nearest", str(written.path), *map(str, TYCHO)]
    with Catalog.open(written.path) as catalog:
        usable = dict(zip(catalog.ids.tolist(), catalog.usable.tolist()))
        distances = angular_distance(
            *np.radians(TYCHO), np.radians(catalog.lat_deg), np.radians(catalog.lon_deg)
        )
        order = catalog.ids[np.argsort(distances)].tolist()
    assert run([*words, "--count", "99", "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert [point["id"] for point in document["points"]] == order
    assert document["covered"] is True
    found = [point["distance_m"] for point in document["points"]]
    np.testing.assert_allclose(found, 1737400.0 * np.sort(distances), rtol=1e-9)
    assert run([*words, "--count", "99", "--usable"]) == 0
    header, *rows = capsys.readouterr().out.splitlines()
    assert header.split()[0] == "id"
    assert [int(row.split()[0]) for row in rows] == [n for n in order if usable[n]]
    assert len(rows) == written.usable < written.count
    assert run([*words, "--count", "0"]) == 2


def test_nearest_without_a_usable_point_ends_with_4(
    written: Written, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    world = make_world()
    points = [(replace(point, usable=False), patches) for point, patches in world.points]
    path = replace(world, points=points).write(tmp_path / "none.gpkg").path
    assert run(["catalog", "nearest", str(path), "0", "0", "--usable"]) == 4
    assert "is usable" in capsys.readouterr().err
    assert run(["catalog", "nearest", str(path), "0", "0"]) == 0


@pytest.mark.parametrize("words", [["-91", "0"], ["0", "400"], ["north", "0"], ["0"]])
def test_nearest_refuses_what_is_no_place(
    written: Written, words: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(["catalog", "nearest", str(written.path), *words]) == 2
    assert capsys.readouterr().out == ""


def test_show_prints_and_draws(
    written: Written, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    cell = int(CellGrid(1.0).find_cells(*TYCHO))
    place = tmp_path / "point.png"
    assert run(["catalog", "show", str(written.path), str(cell), "-o", str(place)]) == 0
    told = lines(capsys.readouterr().out)
    assert told["id"] == str(cell)
    assert told["picture"] == str(place)
    assert cv2.imread(str(place)).shape[2] == 3


def test_show_names_its_picture_itself(
    written: Written, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    cell = int(CellGrid(1.0).find_cells(*TYCHO))
    assert run(["catalog", "show", str(written.path), str(cell)]) == 0
    assert [p.name for p in tmp_path.iterdir()] == [f"tycho-{cell}.png"]


def test_show_tells_of_an_id_that_is_not_there(
    written: Written, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(["catalog", "show", str(written.path), "3"]) == 3
    assert "no control point 3" in capsys.readouterr().err


def test_verify_passes_a_whole_catalog(
    written: Written, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(["catalog", "verify", str(written.path)]) == 0
    assert lines(capsys.readouterr().out)["digest"] == written.digest


def test_verify_names_damage_and_exits_3(
    written: Written, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    data = bytearray(written.path.read_bytes())
    # the first page of patches, whose rows fill it from its end
    data[2 * 65536 - 1000 :: 65536] = bytes(b ^ 1 for b in data[2 * 65536 - 1000 :: 65536])
    damaged = tmp_path / "damaged.gpkg"
    damaged.write_bytes(data)
    assert run(["catalog", "verify", str(damaged)]) == 3
    told = capsys.readouterr()
    assert "damaged: " in told.out
    assert f"{damaged}: is damaged" in told.err


def test_export_writes_a_layer(
    written: Written, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    place = tmp_path / "points.csv"
    assert run(["catalog", "export", str(written.path), "-o", str(place)]) == 0
    assert len(place.read_text().splitlines()) == written.count + 1
    assert capsys.readouterr().out == f"{place}: {written.count} points\n"


def test_export_writes_a_patch_and_refuses_one_as_a_layer(
    written: Written, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    cell = str(CellGrid(1.0).find_cells(*TYCHO))
    words = ["catalog", "export", str(written.path), "--point", cell, "-o"]
    assert run([*words, str(tmp_path / "patch.tif")]) == 0
    assert capsys.readouterr().out == f"{tmp_path / 'patch.tif'}: 64 x 64 nodes\n"
    assert run([*words, str(tmp_path / "patch.csv")]) == 2
    assert "leave --point out" in capsys.readouterr().err


@pytest.mark.parametrize("command", [["info"], ["verify"], ["nearest", "1", "2"], ["show", "1"]])
def test_what_is_no_catalog_is_told_by_each_command(
    command: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    notes = tmp_path / "notes.gpkg"
    notes.write_text("not a catalog " * 30)
    assert run(["catalog", command[0], str(notes), *command[1:]]) == 3
    assert f"{notes}: is not an optnav catalog" in capsys.readouterr().err
