"""What a user can do wrong, through the command line: a word about it, an exit code, no litter."""

import logging
import shutil
import sqlite3
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
import pytest
import rasterio
from rasterio.transform import Affine

from optnav_cli.main import run

CONFIG = '[body]\nname = "moon"\n[[dem]]\npath = "{dem}"\n[pyramid]\nlevels = 2\nsize = 48\n'
BOX = ("--bbox", "10,20,12,21")  # two cells
SIZE, PER_DEG = 256, 64.0
MOON_DEG = "+proj=longlat +R=1737400 +no_defs"
FRAMES = (
    "file,utc,camera,qw,qx,qy,qz,attitude_sigma_arcsec,x_m,y_m,z_m,position_sigma_m,"
    "sun_x,sun_y,sun_z\n"
)
CAMERA = (
    'name = "small"\nmodel = "pinhole"\nwidth_px = 64\nheight_px = 64\nfocal_length_px = 130.0\n'
    "principal_point_px = [31.5, 31.5]\n"
)
GOOD = "2026-01-01T00:00:00Z,small,0.5,0.5,0.5,0.5,0,1800000,360000,680000,3000,1,0,0"


class Said(NamedTuple):
    """What a command came to."""

    code: int
    out: str
    err: str


Optnav = Callable[..., Said]


@pytest.fixture
def optnav(capfd: pytest.CaptureFixture[str]) -> Iterator[Optnav]:
    """Run a command line in this process."""
    before = logging.getLogger().handlers[:]

    def call(*args: object) -> Said:
        capfd.readouterr()
        code = run([str(arg) for arg in args])
        return Said(code, *capfd.readouterr())

    yield call
    logging.captureWarnings(False)
    for handler in set(logging.getLogger().handlers) - set(before):
        logging.getLogger().removeHandler(handler)


def write_dem(path: Path, **changes: object) -> Path:
    """A rough square of 4 degrees at 64 px/deg, 9-13 E and 18-22 N."""
    rng = np.random.default_rng(5)
    heights = np.zeros((SIZE, SIZE), np.float32)
    for step in (4, 8, 16, 32):
        coarse = rng.normal(0.0, 12.0 * step, (SIZE // step + 1,) * 2).astype(np.float32)
        heights += cv2.resize(coarse, (SIZE, SIZE), interpolation=cv2.INTER_CUBIC)
    profile = {
        "driver": "GTiff", "dtype": "float32", "count": 1, "width": SIZE, "height": SIZE,
        "crs": MOON_DEG, "transform": Affine(1 / PER_DEG, 0, 9.0, 0, -1 / PER_DEG, 22.0),
    } | changes  # fmt: skip
    with rasterio.open(path, "w", **profile) as file:
        for band in range(1, file.count + 1):
            file.write(heights.astype(file.dtypes[0]), band)
    return path


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with dem.tif, moon.toml, and the catalog moon.gpkg that was built from them."""
    folder = tmp_path_factory.mktemp("made")
    write_dem(folder / "dem.tif")
    (folder / "moon.toml").write_text(CONFIG.format(dem="dem.tif"))
    code = run(["-q", "build", str(folder / "moon.toml"), "-o", str(folder / "moon.gpkg"),
                "--workers", "1", *BOX])  # fmt: skip
    assert code == 0
    return folder


@pytest.fixture
def world(made: Path, tmp_path: Path) -> Path:
    """A copy of `made` to do damage in."""
    for name in ("dem.tif", "moon.toml", "moon.gpkg"):
        shutil.copy(made / name, tmp_path / name)
    return tmp_path


@pytest.fixture
def pictures(world: Path) -> Path:
    """A picture folder of one frame, too small to be solved."""
    folder = world / "pictures"
    (folder / "cameras").mkdir(parents=True)
    (folder / "cameras" / "small.toml").write_text(CAMERA)
    (folder / "run.toml").write_text('body = "moon"\nattitude = "camera_from_body"\n')
    noise = np.random.default_rng(1).integers(0, 255, (64, 64)).astype(np.uint8)
    cv2.imwrite(str(folder / "good.png"), noise)
    (folder / "frames.csv").write_text(f"{FRAMES}good.png,{GOOD}\n")
    return folder


def entries(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def digest(said: Said) -> str:
    (line,) = [line for line in said.out.splitlines() if line.startswith("digest: ")]
    return line


def one_line(said: Said, code: int, *words: str) -> None:
    """The command ended with this code and one line that has these words, and no traceback."""
    assert said.code == code, said.err
    (line,) = said.err.splitlines()
    assert line.startswith("optnav: ")
    for word in words:
        assert word in line


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda path: path.unlink(), ("there is no such file", "[[dem]]")),
        (lambda path: path.write_bytes(b""), ("is empty",)),
        (lambda path: path.write_bytes(path.read_bytes()[:90_000]), ("damaged or cut short",)),
        (lambda path: write_dem(path, crs=None), ("no coordinate system", "crs =")),
        (lambda path: write_dem(path, crs="EPSG:4326"), ("6378.1 km", "1737.4 km")),
        (lambda path: write_dem(path, dtype="uint8", count=3, photometric="RGB"), ("colour",)),
    ],
)
def test_a_bad_terrain_model_is_told_and_leaves_nothing(
    change: Callable[[Path], object], words: tuple[str, ...], world: Path, optnav: Optnav
) -> None:
    change(world / "dem.tif")
    before = entries(world)
    said = optnav("build", world / "moon.toml", "-o", world / "new.gpkg", "--workers", 1)
    one_line(said, 3, str(world / "dem.tif"), *words)
    assert entries(world) == before


@pytest.mark.parametrize(
    ("config", "words"),
    [
        (CONFIG.replace("moon", "mon"), ("[body] name", "did you mean 'moon'?")),
        (CONFIG + "[select]\nspacng_cell = 0.5\n", ("[select]", "did you mean 'spacing_cell'?")),
        (CONFIG + '[grid]\ncell_deg = "one"\n', ("[grid] cell_deg", "must be a number")),
        (CONFIG.replace("[[dem]]", "[dem]"), ("write [[dem]]",)),
        ('[body]\nname = "moon"\n', ("no [[dem]], [[mesh]] or [[image]] section",)),
        ("hello", ("not valid TOML",)),
    ],
)
def test_a_bad_config_is_told_and_leaves_nothing(
    config: str, words: tuple[str, ...], world: Path, optnav: Optnav
) -> None:
    (world / "moon.toml").write_text(config.replace("{dem}", "dem.tif"))
    before = entries(world)
    said = optnav("-q", "build", world / "moon.toml", "-o", world / "new.gpkg", "--workers", 1)
    one_line(said, 3, str(world / "moon.toml"), *words)
    assert entries(world) == before


def test_a_posting_that_would_fill_the_memory_is_refused(world: Path, optnav: Optnav) -> None:
    config = f"{CONFIG.format(dem='dem.tif')}posting_m = 1.0\n"
    (world / "moon.toml").write_text(config)
    said = optnav("-q", "build", world / "moon.toml", "-o", world / "new.gpkg", "--workers", 1)
    one_line(said, 3, "moon.toml", "[pyramid] posting_m is 1", "wanted at least 118")


def test_a_box_outside_the_terrain_is_told_with_both_places(world: Path, optnav: Optnav) -> None:
    said = optnav("-q", "build", world / "moon.toml", "-o", world / "new.gpkg", "--workers", 1,
                  "--bbox", "170,-5,-170,5")  # fmt: skip
    one_line(said, 3, "--bbox 170,-5,-170,5", "dem.tif covers 9,18,13,22")


def test_windows_line_ends_a_mark_and_names_with_blanks_are_read(
    world: Path, optnav: Optnav
) -> None:
    folder = world / "mönd 1 #%?"
    folder.mkdir()
    shutil.copy(world / "dem.tif", folder / "dem.tif")
    text = CONFIG.format(dem="dem.tif").replace("\n", "\r\n")
    (folder / "m.toml").write_bytes(b"\xef\xbb\xbf" + text.encode())
    built = optnav("-q", "build", folder / "m.toml", "-o", folder / "aus gabe#?%.gpkg",
                   "--workers", 1, *BOX)  # fmt: skip
    assert (built.code, built.err) == (0, "")  # quiet is quiet
    info = optnav("catalog", "info", folder / "aus gabe#?%.gpkg")
    assert digest(info) == digest(built) == digest(optnav("catalog", "info", world / "moon.gpkg"))


def test_a_build_without_a_usable_point_is_written_with_its_reasons(
    world: Path, optnav: Optnav
) -> None:
    config = f"{CONFIG.format(dem='dem.tif')}[check]\nmax_localisation_nodes = 0.001\n"
    (world / "moon.toml").write_text(config)
    said = optnav("-q", "build", world / "moon.toml", "-o", world / "new.gpkg",
                  "--workers", 1, *BOX)  # fmt: skip
    one_line(said, 4, "none of its 2 control points is usable", "2 flat")
    assert optnav("catalog", "verify", world / "new.gpkg").code == 0


@pytest.mark.parametrize("place", ["letters", "letters/mine.gpkg", "mine.gpkg", "", "/", "."])
def test_build_refuses_foreign_places_before_it_works(
    place: str, world: Path, optnav: Optnav, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(world)
    Path("letters").mkdir()
    for name in ("letters/mine.gpkg", "mine.gpkg"):
        Path(name).write_text("mine")
    before = entries(world)
    one_line(optnav("build", "moon.toml", "-o", place, "--workers", 1), 3)
    assert entries(world) == before
    assert Path("letters/mine.gpkg").read_text() == Path("mine.gpkg").read_text() == "mine"


@pytest.mark.parametrize(
    ("args", "kind"),
    [
        (("catalog", "export", "moon.gpkg", "-o", "{}.csv"), "file"),
        (("catalog", "export", "moon.gpkg", "-o", "{}.geojson"), "file"),
        (("catalog", "show", "moon.gpkg", "{id}", "-o", "{}.png"), "file"),
        (("report", "moon.gpkg", "-o", "{}.html"), "file"),
        (("navigate", "pictures", "--catalog", "moon.gpkg", "-o", "{}"), "folder"),
        (("simulate", "flight.toml", "-o", "{}"), "folder"),
        (("demo", "-o", "{}"), "folder"),
        (("build", "moon.toml", "-o", "new.gpkg", "--work", "{}"), "folder"),
    ],
)
def test_no_command_writes_over_what_is_not_its_own(
    args: tuple[str, ...], kind: str, world: Path, pictures: Path, optnav: Optnav,
    monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    monkeypatch.chdir(world)
    with sqlite3.connect("moon.gpkg") as db:
        (number,) = db.execute("SELECT min(id) FROM control_points").fetchone()
    db.close()
    told = [arg.format("mine", id=number) for arg in args]
    mine = world / next(arg for arg in told if arg.startswith("mine"))
    precious = mine
    if kind == "folder":
        mine.mkdir()
        precious = mine / "diary.txt"
    # also a picture is not ours for being a picture
    data = (pictures / "good.png").read_bytes() if mine.suffix == ".png" else b"precious"
    precious.write_bytes(data)
    before = entries(world)
    said = optnav("-q", *told)
    one_line(said, 3, mine.name)
    assert said.out == ""
    assert precious.read_bytes() == data
    assert entries(world) == before


def damage_none(path: Path) -> None:
    path.unlink()


def damage_text(path: Path) -> None:
    path.write_text("not a catalog\n" * 100)


def damage_cut(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:400_000])


def damage_version(path: Path) -> None:
    with sqlite3.connect(path) as db:
        db.execute("UPDATE optnav_meta SET value = '99' WHERE key = 'format_version'")
    db.close()


@pytest.mark.parametrize(
    ("damage", "words"),
    [
        (damage_none, "no such"),
        (damage_text, "is not an optnav catalog"),
        (damage_cut, "is cut short"),
        (damage_version, "install a newer optnav"),
    ],
)
def test_a_bad_catalog_is_told_by_every_command(
    damage: Callable[[Path], None], words: str, world: Path, pictures: Path, optnav: Optnav
) -> None:
    catalog = world / "moon.gpkg"
    damage(catalog)
    before = entries(world)
    for args in (
        ("catalog", "info", catalog),
        ("catalog", "verify", catalog),
        ("catalog", "nearest", catalog, 20, 11),
        ("catalog", "show", catalog, 1, "-o", world / "new.png"),
        ("catalog", "export", catalog, "-o", world / "new.csv"),
        ("report", catalog, "-o", world / "new.html"),
        ("navigate", pictures, "--catalog", catalog, "-o", world / "run"),
    ):
        one_line(optnav("-q", *args), 3, str(catalog), words)
    assert entries(world) == before


def test_a_flipped_bit_anywhere_fails_verification(world: Path, optnav: Optnav) -> None:
    whole = bytearray((world / "moon.gpkg").read_bytes())
    for place in np.random.default_rng(8).integers(0, len(whole), 12):
        whole[place] ^= 16
        (world / "flipped.gpkg").write_bytes(whole)
        whole[place] ^= 16
        said = optnav("-q", "catalog", "verify", world / "flipped.gpkg")
        one_line(said, 3, "flipped.gpkg")


def test_a_run_without_a_solved_frame_is_written_and_ends_with_4(
    world: Path, pictures: Path, optnav: Optnav
) -> None:
    run_folder = world / "run"
    for _ in range(2):  # the second takes the place of the first
        said = optnav("-q", "navigate", pictures, "--catalog", world / "moon.gpkg",
                      "-o", run_folder)  # fmt: skip
        assert said.code == 4
        assert "none of 1 frames was solved" in said.err
        assert {"solution.csv", "manifest.json"} < set(entries(run_folder))
    (world / "truth.csv").write_text(
        "file,utc,x_m,y_m,z_m,qw,qx,qy,qz\n"
        "good.png,2026-01-01T00:00:00Z,1800000,360000,680000,0.5,0.5,0.5,0.5\n"
    )
    one_line(optnav("-q", "evaluate", run_folder, "--truth", world / "truth.csv"), 4, "solved")
    said = optnav("-q", "evaluate", run_folder, "--truth", pictures / "frames.csv")
    one_line(said, 3, "is a frames.csv", "truth.csv")
    one_line(optnav("-q", "evaluate", run_folder, "--truth", world / "no.csv"), 3, "no.csv")


def test_places_may_be_negative_and_numbers_of_points_not(world: Path, optnav: Optnav) -> None:
    catalog = world / "moon.gpkg"
    one_line(optnav("catalog", "show", catalog, -5), 2, "-5 is not in the range")
    one_line(optnav("catalog", "show", catalog, 5), 3, "has no control point 5")
    for lat, lon in ((-90, 0), (90, -180), (0, 180), (0, -180), (-43.3, 348.8)):
        said = optnav("catalog", "nearest", catalog, lat, lon)
        assert said.code == 0
        assert "distance_km: " in said.out
    assert optnav("catalog", "nearest", catalog, -91, 0).code == 2


def test_one_worker_at_least(world: Path, optnav: Optnav) -> None:
    said = optnav("build", world / "moon.toml", "-o", world / "new.gpkg", "--workers", 0)
    assert said.code == 2
    assert "--workers" in said.err
