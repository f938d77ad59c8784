"""`optnav slopes` and `optnav hazard`: what they write, and what they refuse."""

import json
from pathlib import Path

import numpy as np
import pyproj
import pytest
import rasterio
from scipy.spatial.transform import Rotation

from catalog.geometry.latlon import body_from_local, latlon_from_xyz, xyz_from_latlon
from catalog.rasters import OWN, encode_geotiff, open_raster
from catalog.store.reader import Catalog
from optnav_cli.camera.camera import Camera
from optnav_cli.camera.camera_file import camera_toml
from optnav_cli.frames.folder import write_folder
from optnav_cli.frames.frames import Frame
from optnav_cli.frames.run_settings import RunSettings
from optnav_cli.frames.tables import PADS, ROCKS
from optnav_cli.hazard.job import _sample_catalog
from optnav_cli.hazard.pads import REFUSED
from optnav_cli.hazard.slopes import SITE_PADS
from optnav_cli.main import run
from tests.catalog.made_catalogs import make_world
from tests.optnav_cli.hazard.views import bumps, drawn

RADIUS = 1737400.0
LAT, LON = np.radians(-70.0), np.radians(20.0)
SIZE, HEIGHT = 180, 2000.0
CAMERA = Camera("cam", "pinhole", SIZE, SIZE, HEIGHT, (0.5 * (SIZE - 1), 0.5 * (SIZE - 1)))
ELEVATION, AZIMUTH = 20.0, 60.0
ALONE = (
    *("--camera", "cam.toml", "--height-m", str(HEIGHT)),
    *("--sun-elevation-deg", str(ELEVATION), "--sun-azimuth-deg", str(AZIMUTH)),
)
ANYWHERE = rasterio.Affine(2.0, 0.0, 5.0, 0.0, -2.0, 7.0)  # rasterio warns of a raster without any
FILES = {"risk.tif", "slopes.tif", "risk.png", "pads.csv", "hazard.png", "manifest.json"}


def write_picture(path: Path, values: np.ndarray) -> None:
    with rasterio.open(path, "w", "GTiff", SIZE, SIZE, 1, None, ANYWHERE, "uint16") as file:
        file.write(np.clip(values, 0, 65535).astype(np.uint16), 1)


def picture_values() -> np.ndarray:
    bright = drawn(bumps(SIZE, height_m=1.0), ELEVATION, AZIMUTH).brightness
    return 20000.0 * bright / bright.mean()


def frame(name: str, roll_deg: float = 0.0, **more: object) -> Frame:
    """A frame that looks straight down at (LAT, LON)."""
    local = body_from_local(LAT, LON)
    e, a = np.radians([ELEVATION, AZIMUTH])
    sun = local @ (np.cos(e) * np.sin(a), np.cos(e) * np.cos(a), np.sin(e))
    turn = Rotation.from_euler("z", roll_deg, degrees=True)
    down = turn * Rotation.from_matrix(np.diag([1.0, -1.0, -1.0]) @ local.T)
    given = {
        "utc": "2026-01-01T00:00:00Z",
        "camera": "cam",
        "tdb_s": 8.2e8,
        "camera_from_body": down,
        "attitude_sigma_rad": 0.0,
        "position_m": xyz_from_latlon(LAT, LON, RADIUS + HEIGHT),
        "position_sigma_m": 10.0,
        "sun_body": sun,
    }
    return Frame(file=name, **{**given, **more})  # type: ignore[arg-type]


@pytest.fixture
def place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "cam.toml").write_text(camera_toml(CAMERA))
    write_picture(tmp_path / "site.tif", picture_values())
    return tmp_path


def folder(place: Path, *frames: Frame) -> Path:
    write_folder(place / "pictures", RunSettings("moon", "camera_from_body"), [CAMERA], frames)
    for one in frames:
        write_picture(place / "pictures" / one.file, picture_values())
    return place / "pictures"


def test_a_single_picture_gets_its_maps_and_pads(place: Path) -> None:
    assert run(["hazard", "site.tif", *ALONE, "--square-m", "80", "-o", "out"]) == 0
    assert {path.name for path in (place / "out").iterdir()} >= FILES | {"hazard.mcap"}
    rows = PADS.rows(place / "out" / "pads.csv")
    assert [(row["square_row"], row["square_col"]) for row in rows] == [
        (a, b) for a in "01" for b in "01"
    ]
    for row in rows:
        assert not row["lat_deg"]
        assert 0.0 <= row.number("expected_dangerous_share") < 0.5
        ray = [row.number(f"dir_camera_{axis}") for axis in "xyz"]
        pixel = CAMERA.project(ray)
        assert pixel == pytest.approx([row.number("x_px"), row.number("y_px")], abs=1e-2)
    with open_raster(place / "out" / "risk.tif", OWN) as risk:
        codes = risk.read(1)
        assert risk.crs is None
    chosen = rows[0]
    at = codes[round(chosen.number("y_px")), round(chosen.number("x_px"))]
    assert at == pytest.approx(254 * chosen.number("expected_dangerous_share"), abs=3)
    assert json.loads((place / "out" / "manifest.json").read_text())["results"]["pads"] == 4


def test_a_folder_with_a_pose_has_its_pads_on_the_body(place: Path) -> None:
    pictures = folder(place, frame("a.tif"))
    assert run(["hazard", str(pictures), "--square-m", "80", "-o", "out"]) == 0
    rows = PADS.rows(place / "out" / "pads.csv")
    assert len(rows) == 4
    camera = xyz_from_latlon(LAT, LON, RADIUS + HEIGHT)
    for row in rows:
        direction = np.array([row.number(f"dir_body_{axis}") for axis in "xyz"])
        along = -camera @ direction - np.sqrt(
            RADIUS**2 - camera @ camera + (camera @ direction) ** 2
        )
        lat, lon, _ = latlon_from_xyz(camera + along * direction)
        metres = RADIUS * np.radians(
            [row.number("lat_deg") - np.degrees(lat), row.number("lon_deg") - np.degrees(lon)]
        )
        assert np.abs(metres).max() < 0.2
    with open_raster(place / "out" / "slopes.tif", OWN) as slopes:
        assert slopes.count == 3
        assert slopes.crs.to_dict()["lat_0"] == pytest.approx(-70.0, abs=1e-3)


def test_a_turned_camera_finds_the_same_pads(place: Path) -> None:
    """The map is north up whatever the camera's roll."""
    pictures = folder(place, frame("a.tif"), frame("b.tif", roll_deg=90.0))
    # a camera that is turned clockwise sees the ground turned the other way
    values = np.rot90(picture_values(), 3)
    write_picture(pictures / "b.tif", values)
    write_picture(pictures / "a.tif", picture_values())
    assert run(["hazard", str(pictures), "--square-m", "80", "-o", "out"]) == 0
    rows = PADS.rows(place / "out" / "pads.csv")
    assert (place / "out" / "a" / "risk.tif").is_file()
    first, second = rows[:4], rows[4:]
    for one, other in zip(first, second, strict=True):
        for name in ("lat_deg", "lon_deg"):
            gap = np.radians(one.number(name) - other.number(name)) * RADIUS
            assert abs(gap) < 4.0


def test_the_same_input_gives_the_same_bytes(place: Path) -> None:
    for out in ("one", "two"):
        assert run(["hazard", "site.tif", *ALONE, "-o", out]) == 0
    for name in (FILES | {"hazard.mcap"}) - {"manifest.json"}:
        assert (place / "one" / name).read_bytes() == (place / "two" / name).read_bytes()


def test_variance_maps_the_same_picture(place: Path) -> None:
    assert run(["hazard", "site.tif", *ALONE, "--method", "variance", "-o", "out"]) == 0
    assert not (place / "out" / "slopes.tif").exists()
    (row,) = PADS.rows(place / "out" / "pads.csv")
    assert row["x_px"]
    assert not row["expected_dangerous_share"]


def test_a_prior_slope_map_is_fused_and_refuses(place: Path) -> None:
    pictures = folder(place, frame("a.tif"))
    crs = rasterio.CRS.from_proj4(f"+proj=stere +lat_0=-70 +lon_0=20 +R={RADIUS} +units=m")
    slopes = np.full((40, 40), 2.0, np.float32)
    slopes[:, 20:] = 9.0
    with rasterio.open(
        "prior.tif",
        "w",
        "GTiff",
        40,
        40,
        1,
        crs,
        rasterio.Affine(10, 0, -200, 0, -10, 200),
        "float32",
    ) as file:
        file.write(slopes, 1)
    words = ["hazard", str(pictures), "--slopes", "prior.tif", "--square-m", "80", "-o", "out"]
    assert run(words) == 0
    west, east, *_ = PADS.rows(place / "out" / "pads.csv")
    assert west.number("prior_slope_deg") == pytest.approx(2.0, abs=0.1)
    assert "too steep by --slopes" in east["reason"]


@pytest.mark.parametrize(
    ("changes", "code", "words"),
    [
        ({"--pad-m": "2"}, 4, "under 3 cells"),
        ({"--pad-m": "190", "--square-m": "400"}, 4, "wider than the picture"),
        ({"--square-m": "10"}, 3, "is under the pad"),
        ({"--height-m": "0"}, 2, "--height-m"),
        ({"--sun-elevation-deg": "-3"}, 2, "--sun-elevation-deg"),
        ({"--sun-elevation-deg": "0.1"}, 4, "night"),
        ({"--sun-elevation-deg": "75"}, 4, "tells no slopes"),
        ({"--camera": None}, 2, "needs --camera"),
        ({"--slopes": "prior.tif"}, 2, "needs a place on the body"),
    ],
)
def test_what_cannot_be_mapped_says_why(
    place: Path,
    changes: dict[str, str | None],
    code: int,
    words: str,
    capsys: pytest.CaptureFixture[str],
) -> None:
    options = dict(zip(ALONE[::2], ALONE[1::2], strict=True)) | changes
    given = [word for pair in options.items() if pair[1] is not None for word in pair]
    assert run(["hazard", "site.tif", *map(str, given), "-o", "out"]) == code
    assert words in capsys.readouterr().err


def picture_of(kind: str) -> np.ndarray:
    values = picture_values()
    if kind == "saturated":
        values[:30] = 65535
    if kind == "night":
        values[:] = 0
        values[3, 3] = 1
    return values


@pytest.mark.parametrize(("kind", "words"), [("saturated", "is saturated"), ("night", "")])
def test_pictures_that_show_too_little_are_refused(
    place: Path, kind: str, words: str, capsys: pytest.CaptureFixture[str]
) -> None:
    write_picture(place / "site.tif", picture_of(kind))
    assert run(["hazard", "site.tif", *ALONE, "-o", "out"]) == 4
    assert words in capsys.readouterr().err
    assert words in ROCKS.rows(place / "out" / "rocks.csv")[0]["reason"]


def write_floats(path: Path, values: np.ndarray) -> None:
    with rasterio.open(path, "w", "GTiff", SIZE, SIZE, 1, None, ANYWHERE, "float32") as file:
        file.write(values.astype(np.float32), 1)


def test_no_pad_lies_on_a_hole_of_a_picture(place: Path) -> None:
    values, refused = picture_values().astype(np.float32), []
    for out in ("whole", "hole"):
        write_floats(place / "site.tif", values)
        assert run(["hazard", "site.tif", *ALONE, "-o", out]) == 0
        with open_raster(place / out / "risk.tif", OWN) as risk:
            refused.append(risk.read(1) == REFUSED)
        values[SIZE // 2, SIZE // 2] = np.nan
    assert (refused[1] >= refused[0]).all()
    middle = refused[1].shape[0] // 2
    assert refused[1][middle, middle]
    assert not refused[0][middle, middle]


def test_a_picture_of_another_size_is_refused(
    place: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with rasterio.open("site.tif", "w", "GTiff", 1, 1, 1, None, ANYWHERE, "uint8") as file:
        file.write(np.ones((1, 1), np.uint8), 1)
    assert run(["hazard", "site.tif", *ALONE, "-o", "out"]) == 3
    assert "takes 180 x 180" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("more", "words"),
    [
        ({"position_m": None, "position_sigma_m": None}, "no position or attitude"),
        ({"position_m": xyz_from_latlon(LAT, LON, RADIUS - 500.0)}, "not above the ground"),
        ({"position_m": xyz_from_latlon(LAT, LON, RADIUS + 1e6)}, "from less height"),
        ({"sun_body": -xyz_from_latlon(LAT, LON, 1.0)}, "night"),
        (
            {"camera_from_body": Rotation.from_matrix(body_from_local(LAT, LON)[:, [2, 0, 1]].T)},
            "off the vertical",
        ),
    ],
)
def test_a_frame_that_cannot_be_mapped_is_a_row_with_its_reason(
    place: Path, more: dict[str, object], words: str, capsys: pytest.CaptureFixture[str]
) -> None:
    pictures = folder(place, frame("a.tif", **more))
    assert run(["hazard", str(pictures), "-o", "out"]) == 4
    assert words in capsys.readouterr().err
    (row,) = PADS.rows(place / "out" / "pads.csv")
    assert words in row["reason"]


def test_a_height_against_the_pose_is_refused(
    place: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    pictures = folder(place, frame("a.tif"))
    dem(place / "dem.tif", np.zeros((64, 64), np.float32))
    words = ["hazard", str(pictures), "--dem", "dem.tif", "--height-m", "700", "-o", "out"]
    assert run(words) == 4
    assert "by its pose" in capsys.readouterr().err
    assert run(["hazard", str(pictures), "--dem", "dem.tif", "-o", "out"]) == 0


def test_no_data_of_the_terrain_model_may_be_stated(
    place: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    pictures = folder(place, frame("a.tif"))
    heights = np.zeros((64, 64), np.float32) + np.linspace(0, 1, 64, dtype=np.float32)
    heights[30:33, 28:33] = -9999.0
    dem(place / "dem.tif", heights)
    words = ["hazard", str(pictures), "--dem", "dem.tif", "-o", "out"]
    assert run(words) == 4  # the reason of its one row
    assert "-9999" in capsys.readouterr().err
    assert run([*words, "--nodata", "-9999"]) == 4
    assert "there are no heights of the ground that the picture shows" in capsys.readouterr().err
    assert run(["hazard", str(pictures), "--nodata", "-9999", "-o", "out"]) == 2
    assert "name one with --dem" in capsys.readouterr().err


def dem(path: Path, heights: np.ndarray, step: float = 20.0) -> None:
    crs = rasterio.CRS.from_proj4(f"+proj=stere +lat_0=-70 +lon_0=20 +R={RADIUS} +units=m")
    rows, cols = heights.shape
    transform = rasterio.Affine(step, 0, -0.5 * cols * step, 0, -step, 0.5 * rows * step)
    with rasterio.open(path, "w", "GTiff", cols, rows, 1, crs, transform, "float32") as file:
        file.write(heights, 1)


@pytest.mark.parametrize(
    ("values", "crs", "words"),
    [
        (300.0, True, "not in percent"),
        (5.0, False, "no coordinate system"),
        (np.nan, True, "holds no slope"),
    ],
)
def test_a_slope_map_that_is_none_is_refused(
    place: Path, values: float, crs: bool, words: str, capsys: pytest.CaptureFixture[str]
) -> None:
    pictures = folder(place, frame("a.tif"))
    grid = np.full((64, 64), values, np.float32)
    if crs:
        dem(place / "prior.tif", grid)
    else:
        with rasterio.open("prior.tif", "w", "GTiff", 64, 64, 1, None, ANYWHERE, "float32") as file:
            file.write(grid, 1)
    assert run(["hazard", str(pictures), "--slopes", "prior.tif", "-o", "out"]) == 3
    assert words in capsys.readouterr().err


def test_a_slope_map_of_other_ground_is_refused(
    place: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    pictures = folder(place, frame("a.tif"))
    crs = rasterio.CRS.from_proj4(f"+proj=stere +lat_0=-10 +lon_0=20 +R={RADIUS} +units=m")
    transform = rasterio.Affine(10, 0, 0, 0, -10, 0)
    with rasterio.open("p.tif", "w", "GTiff", 40, 40, 1, crs, transform, "float32") as file:
        file.write(np.full((40, 40), 3.0, np.float32), 1)
    assert run(["hazard", str(pictures), "--slopes", "p.tif", "-o", "out"]) == 4
    assert "overlaps" in capsys.readouterr().err


def test_slopes_prints_and_writes_what_a_model_has(
    place: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    x = np.arange(64, dtype=np.float32)
    dem(place / "dem.tif", np.broadcast_to(x * 2.0, (64, 64)).copy(), 10.0)
    assert run(["slopes", "dem.tif", "-o", "s.tif", "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["rms_deg"] == pytest.approx(np.degrees(np.arctan(0.2)), rel=1e-3)
    assert (found["share_above_7_deg"], found["share_above_15_deg"]) == (1.0, 0.0)
    assert run(["slopes", "dem.tif", "-o", "s.png"]) == 0
    assert "above 7 deg" in capsys.readouterr().out
    with open_raster(place / "s.tif", OWN) as file:
        assert np.nanmax(file.read(1)) == pytest.approx(11.31, abs=0.01)
    assert (place / "s.png").read_bytes().startswith(b"\x89PNG")
    assert run(["slopes", "dem.tif", "-o", "dem.tif"]) == 3


def test_slopes_finds_the_flattest_pad_of_each_square(
    place: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """On a plane of 9 deg with a level place in each of six squares, and holes in the last."""
    rng = np.random.default_rng(4)
    steep = np.broadcast_to(np.arange(150, dtype=np.float32) * 2.0 * 0.16, (100, 150)).copy()
    wanted = {}
    for row in range(2):
        for col in range(3):
            i, j = 50 * row + rng.integers(2, 34), 50 * col + rng.integers(2, 34)
            steep[i : i + 14, j : j + 14] = steep[i, j]
            wanted[row, col] = (i + 6.5, j + 6.5)
    steep[50:, 100:][::3, ::3] = np.nan
    dem(place / "dem.tif", steep, 2.0)
    words = ["slopes", "dem.tif", "--pads", "pads.csv", "--square-m", "100"]
    assert run([*words, "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert (found["squares"], found["pads"]) == (6, 5)
    rows = SITE_PADS.rows(place / "pads.csv")
    project = pyproj.Proj(f"+proj=stere +lat_0=-70 +lon_0=20 +R={RADIUS}")
    for row in rows[:-1]:
        assert (row["dangerous_share"], row["reason"]) == ("0.00000", "")
        x, y = project(row.number("lon_deg"), row.number("lat_deg"))
        at = 50.0 - 0.5 * y - 0.5, 75.0 + 0.5 * x - 0.5
        off = np.subtract(at, wanted[row.count("square_row"), row.count("square_col")])
        assert np.abs(off).max() <= 2.0
    assert rows[-1]["reason"] == "no pad without holes"
    assert run(words) == 0
    assert "squares with a pad" in capsys.readouterr().out
    for more, said in (
        (["--pad-m", "5"], "a pad of 5 m is under 3 of them"),
        (["--pad-m", "150"], "wanted more than a pad of 150 m"),
        (["--square-m", "1000"], "a square of 1000 m does not fit in"),
    ):
        assert run([*words, *more]) == 3
        assert said in capsys.readouterr().err
    (place / "letter.csv").write_text("dear")
    assert run(["slopes", "dem.tif", "--pads", "letter.csv"]) == 3
    assert (place / "letter.csv").read_text() == "dear"


def test_what_is_wrong_with_a_model_is_to_be_mended_in_its_file_not_in_a_section(
    place: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    rise = np.broadcast_to(np.arange(64, dtype=np.float32), (64, 64))
    bare = encode_geotiff({"height, m": rise}, {"transform": ANYWHERE})
    (place / "bare.tif").write_bytes(bare)
    for words in (
        ["slopes", "bare.tif"],
        ["hazard", str(folder(place, frame("a.tif"))), "--dem", "bare.tif", "-o", "out"],
    ):
        assert run(words) == 3
        said = capsys.readouterr().err
        assert "bare.tif: has no coordinate system; set `crs` in the file itself" in said
        assert "[[dem]]" not in said
    assert run(["slopes", "gone.tif"]) == 3
    assert capsys.readouterr().err.endswith("there is no such file; check the path\n")


def folder_with_ground(place: Path) -> Path:
    """A hazard folder over ground that rises by 10 deg in the east and is level in the west."""
    pictures = folder(place, frame("a.tif"))
    assert run(["hazard", str(pictures), "--square-m", "80", "-o", "out"]) == 0
    x = np.arange(-200, 200) + 0.5
    ground = np.maximum(x, 0.0) * np.tan(np.radians(10.0))
    dem(place / "truth.tif", np.broadcast_to(ground, (400, 400)).astype(np.float32), 1.0)
    return place / "out"


def test_pads_are_judged_by_a_terrain_model(
    place: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = folder_with_ground(place)
    capsys.readouterr()
    assert run(["evaluate", str(out), "--truth", "truth.tif", "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert (found["squares"], found["judged"]) == (4, 4)
    assert found["dangerous_share"] == pytest.approx(0.5, abs=0.05)
    assert found["critical_share"] == 0.0
    assert found["worst_pad_share"] > 0.9
    assert found["max_dangerous_share"] is None
    assert found["rms_slope_deg"] == pytest.approx(10.0 * np.sqrt(0.5), abs=0.5)
    assert len((out / "evaluation.csv").read_text().splitlines()) == 5
    limit = ["--max-dangerous-share", "0.3"]
    assert run(["evaluate", str(out), "--truth", "truth.tif", *limit]) == 5
    assert "the limit is 30.00%" in capsys.readouterr().err
    assert run(["evaluate", str(out), "--truth", "truth.tif", "--max-dangerous-share", "0.9"]) == 0
    assert run(["evaluate", str(out), "--truth", "truth.tif", "--max-wrong", "0"]) == 2


def test_a_truth_of_other_ground_judges_no_pad(
    place: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = folder_with_ground(place)
    crs = rasterio.CRS.from_proj4(f"+proj=stere +lat_0=-10 +lon_0=20 +R={RADIUS} +units=m")
    transform = rasterio.Affine(10, 0, 0, 0, -10, 0)
    with rasterio.open("t.tif", "w", "GTiff", 40, 40, 1, crs, transform, "float32") as file:
        file.write(np.ones((40, 40), np.float32), 1)
    assert run(["evaluate", str(out), "--truth", "t.tif"]) == 4
    assert "covers none of the 4 pads" in capsys.readouterr().err


def test_pads_of_a_single_picture_have_no_truth(
    place: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(["hazard", "site.tif", *ALONE, "-o", "out"]) == 0
    dem(place / "truth.tif", np.zeros((64, 64), np.float32))
    assert run(["evaluate", "out", "--truth", "truth.tif"]) == 3
    assert "no places on" in capsys.readouterr().err


def test_a_hazard_folder_has_a_page(place: Path) -> None:
    assert run(["hazard", "site.tif", *ALONE, "--square-m", "80", "-o", "out"]) == 0
    assert run(["report", "out", "-o", "page.html"]) == 0
    text = (place / "page.html").read_text(encoding="utf-8")
    assert "data:image/png;base64," in text
    assert "4 of 4" in text
    assert "://" not in text.replace("http://www.w3.org", "")


def test_an_oblong_picture_has_squares_along_it(place: Path) -> None:
    camera = Camera("cam", "pinhole", SIZE, 90, HEIGHT, (0.5 * (SIZE - 1), 44.5))
    (place / "cam.toml").write_text(camera_toml(camera))
    with rasterio.open("site.tif", "w", "GTiff", SIZE, 90, 1, None, ANYWHERE, "uint16") as file:
        file.write(picture_values()[:90].astype(np.uint16), 1)
    assert run(["hazard", "site.tif", *ALONE, "--square-m", "80", "-o", "out"]) == 0
    rows = PADS.rows(place / "out" / "pads.csv")
    assert [(row["square_row"], row["square_col"]) for row in rows] == [("0", "0"), ("0", "1")]


def test_bands_without_colours_are_refused(place: Path, capsys: pytest.CaptureFixture[str]) -> None:
    values = picture_values().astype(np.uint16)
    with rasterio.open("site.tif", "w", "GTiff", SIZE, SIZE, 3, None, ANYWHERE, "uint16") as file:
        file.write(np.stack([values, values, values // 2]))
    assert run(["hazard", "site.tif", *ALONE, "-o", "out"]) == 3
    assert "has 3 bands (gray, undefined, undefined)" in capsys.readouterr().err


def test_ground_of_a_model_moves_what_an_oblique_camera_sees(place: Path) -> None:
    """Level ground 300 m above the sphere, seen 20 deg off the vertical from the same place."""
    local = body_from_local(LAT, LON)
    tilt = Rotation.from_euler("x", 20.0, degrees=True)
    tilted = tilt * Rotation.from_matrix(np.diag([1.0, -1.0, -1.0]) @ local.T)
    pictures = folder(place, frame("a.tif", camera_from_body=tilted))
    dem(place / "dem.tif", np.full((200, 200), 300.0, np.float32))
    places = []
    for more in ([], ["--dem", "dem.tif"]):
        assert run(["hazard", str(pictures), *more, "--square-m", "400", "-o", "out"]) == 0
        row, *_ = PADS.rows(place / "out" / "pads.csv")
        direction = np.array([row.number(f"dir_body_{axis}") for axis in "xyz"])
        away = local.T @ direction
        reach = (HEIGHT - 300.0 * bool(more)) / -away[2]
        places.append(np.hypot(*(reach * away[:2])))
        gap = RADIUS * np.hypot(
            np.radians(row.number("lat_deg")) - LAT,
            np.cos(LAT) * (np.radians(row.number("lon_deg")) - LON),
        )
        assert gap == pytest.approx(places[-1], rel=0.01)


def test_heights_of_the_ground_come_from_the_nearest_point_of_a_catalog(tmp_path: Path) -> None:
    world = make_world()
    catalog_file = tmp_path / "c.gpkg"
    world.write(catalog_file)
    point, patches = next(pair for pair in world.points if pair[0].id % 3)
    middle = patches[0].heights_m[15:17, 15:17].mean()
    lat, lon = np.radians([point.lat_deg, point.lon_deg])
    with Catalog.open(catalog_file) as catalog:
        found = _sample_catalog(catalog, np.array([lat]), np.array([lon]))
        far = _sample_catalog(catalog, np.array([lat]), np.array([lon]) + 0.05)
    assert found[0] == pytest.approx(middle, abs=25.0)
    assert np.isnan(far[0])


def test_ground_steeper_than_the_graph_is_drawn(tmp_path: Path) -> None:
    heights = np.tile(np.float32(200.0) * np.arange(40, dtype=np.float32), (40, 1))
    place = rasterio.Affine(1e-3, 0.0, 10.0, 0.0, -1e-3, 20.0)  # 30 m
    profile = {"crs": "+proj=longlat +R=1737400 +no_defs", "transform": place}
    (tmp_path / "dem.tif").write_bytes(encode_geotiff({"height, m": heights}, profile))
    words = ["slopes", str(tmp_path / "dem.tif"), "--base-m", "31", "-o", str(tmp_path / "s.png")]
    assert run(words) == 0
    assert (tmp_path / "s.png").stat().st_size > 1000
