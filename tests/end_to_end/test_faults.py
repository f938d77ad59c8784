"""A camera file or a clock that is wrong, on pictures of a rough Moon: a reason, never a place."""

import csv
import json
import re
import shutil
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import pytest
from scipy.spatial.transform import Rotation

from catalog.bodies.epochs import utc_from_tdb_s, utc_to_tdb_s
from catalog.errors import NothingToDoError
from catalog.progress import SilentProgress
from catalog.store.manifest import CatalogMeta
from optnav_cli.evaluation.files import evaluate_run
from optnav_cli.frames.folder import read_folder, write_folder
from optnav_cli.frames.truth import read_truth
from optnav_cli.navigate.job import navigate_folder
from optnav_cli.navigate.worker import RunInputs
from optnav_cli.pages import write_report
from optnav_cli.simulation.job import simulate_folder
from tests.catalog.store.written import write_points
from tests.optnav_cli.conftest import RoughWorld

LATE_S = 4.0 * 3600.0
CAMERA = """
name = "wide"
model = "equidistant"
width_px = 1000
height_px = 1000
focal_length_px = 320.0
principal_point_px = [499.5, 499.5]
"""
# Over the far side's highlands; relief is added to what the navigator knows.
SCENARIO = """
seed = 11
dem = []
globe = { path = "moon_gld100_4ppd.tif" }
detail = { seeds = [7], smallest_m = 3000.0, rms_slope_deg = 3.0 }
camera = { name = "wide.toml" }
prior = { given = false }
attitude = { sigma_arcsec = 10.0, relative_to = "inertial" }
[orbit]
altitude_km = 100.0
box_deg = [150.0, -30.0, -160.0, 30.0]
passes = 2
[sun]
elevation_deg = [30.0, 60.0]
"""


RELIEF = Path("bundled:moon_gld100_4ppd.tif")


@pytest.fixture(scope="module")
def pictures(tmp_path_factory: pytest.TempPathFactory) -> Path:
    place = tmp_path_factory.mktemp("faults")
    (place / "wide.toml").write_text(CAMERA)
    (place / "flight.toml").write_text(SCENARIO)
    simulate_folder(place / "flight.toml", place / "pictures", SilentProgress())
    return place / "pictures"


@pytest.fixture(scope="module")
def catalog(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A catalog whose points lie elsewhere."""
    world = RoughWorld(seed=1, levels=5)
    catalog = tmp_path_factory.mktemp("catalog") / "rough.gpkg"
    meta = CatalogMeta("moon", 1737400.0, world.cell_deg, 5, world.nodes, 120.0, 0.5)
    write_points(catalog, meta, world.control_points[:9])
    return catalog


def navigated(pictures: Path, catalog: Path, run: Path) -> list[dict[str, str]]:
    """Rows of solution.csv by the limb alone."""
    with suppress(NothingToDoError):  # the run is written, with the reasons
        navigate_folder(RunInputs(pictures, [catalog], relief=RELIEF), run, SilentProgress())
    with (run / "solution.csv").open(encoding="utf-8", newline="") as lines:
        return list(csv.DictReader(lines))


def test_without_a_fault_all_are_solved_inside_five_sigmas(
    pictures: Path, catalog: Path, tmp_path: Path
) -> None:
    rows = navigated(pictures, catalog, tmp_path / "run")
    assert [row["method"] for row in rows] == ["horizon", "horizon"]
    errors = evaluate_run(tmp_path / "run", pictures / "truth.csv").frames
    assert all(frame.nees is not None and frame.nees < 25.0 for frame in errors)


@pytest.mark.parametrize("relief", [RELIEF, None])
def test_the_limb_alone_serves_without_a_catalog(
    relief: Path | None, pictures: Path, tmp_path: Path
) -> None:
    """Of the body's relief or of its ellipsoid, with sigmas that hold what that does not know."""
    run = tmp_path / "run"
    (first, *_) = navigate_folder(RunInputs(pictures, relief=relief), run, SilentProgress())
    assert (first.method, first.reason) == ("horizon" if relief else "horizon_sphere", "")
    errors = evaluate_run(run, pictures / "truth.csv").frames
    assert all(frame.nees is not None and frame.nees < 25.0 for frame in errors)
    write_report(run, tmp_path / "report.html")
    assert json.loads((run / "manifest.json").read_text())["inputs"]["catalogs"] == []


def test_a_prior_and_a_limb_that_exclude_each_other_are_no_position(
    pictures: Path, tmp_path: Path
) -> None:
    faulty = Path(shutil.copytree(pictures, tmp_path / "pictures"))
    folder = read_folder(faulty)
    truths = read_truth(faulty / "truth.csv", folder.attitude)
    places = 1.1 * truths[0].position_m, 1.0003 * truths[1].position_m
    frames = [
        replace(frame, position_m=place, position_sigma_m=1e3)
        for frame, place in zip(folder.frames, places, strict=True)
    ]
    write_folder(faulty, folder.settings, folder.cameras.values(), frames)
    given = RunInputs(faulty, relief=RELIEF)
    one, two = navigate_folder(given, tmp_path / "run", SilentProgress())
    assert (one.status, one.reason_code) == ("unsolved", "far_from_prior")
    assert (two.status, two.method, two.prior) == ("solved", "horizon", "")


def test_a_focal_length_off_by_a_tenth_is_no_position(
    pictures: Path, catalog: Path, tmp_path: Path
) -> None:
    faulty = Path(shutil.copytree(pictures, tmp_path / "pictures"))
    camera = faulty / "cameras" / "wide.toml"
    camera.write_text(re.sub(r"focal_length_px = .*", "focal_length_px = 352.0", CAMERA))
    rows = navigated(faulty, catalog, tmp_path / "run")
    assert [row["status"] for row in rows] == ["unsolved", "unsolved"]
    assert all("it scatters by" in row["reason"] for row in rows)


def test_a_clock_off_by_four_hours_is_no_position(
    pictures: Path, catalog: Path, tmp_path: Path
) -> None:
    faulty = Path(shutil.copytree(pictures, tmp_path / "pictures"))
    folder = read_folder(faulty)
    frames = []
    for frame in folder.frames:
        assert frame.tdb_s is not None
        assert frame.camera_from_body is not None
        # stars tell the same attitude at any time; what turns on is the body
        before, after = (
            Rotation.from_matrix(folder.motion.body_from_inertial(frame.tdb_s + late))
            for late in (0.0, LATE_S)
        )
        turn = frame.camera_from_body * before * after.inv()
        utc = utc_from_tdb_s(frame.tdb_s + LATE_S)
        frames.append(
            replace(frame, utc=utc, tdb_s=utc_to_tdb_s(utc), camera_from_body=turn)
        )  # fmt: skip
    write_folder(faulty, folder.settings, folder.cameras.values(), frames)
    rows = navigated(faulty, catalog, tmp_path / "run")
    assert [row["status"] for row in rows] == ["unsolved", "unsolved"]
    assert all("check attitude, time" in row["reason"] for row in rows)
