"""A new body is a TOML file and nothing else: built, simulated, navigated and evaluated by it."""

import shutil
from pathlib import Path

import pytest

from catalog.config import resource
from catalog.pipeline import build
from catalog.progress import SilentProgress
from optnav_cli import api
from optnav_cli.evaluation.files import evaluate_run
from optnav_cli.frames.folder import read_folder
from optnav_cli.navigate.job import navigate_folder
from optnav_cli.navigate.worker import RunInputs
from optnav_cli.simulation.job import simulate_folder
from tests.catalog.pipeline.coarse_tycho import BBOX, CONFIG

CAMERA = """
name = "small"
model = "pinhole"
width_px = 384
height_px = 384
focal_length_px = 400.0
principal_point_px = [191.5, 191.5]
psf_sigma_px = 0.7
psf_error_px = 0.05
"""
SCENARIO = """
body = "bodies/selene.toml"
dem = [{ path = "tycho_gld100_256ppd.tif" }]
detail = { seeds = [] }
camera = { name = "small.toml" }
prior = { position_sigma_m = 500.0 }
[orbit]
altitude_km = 200.0
box_deg = [-11.6, -43.6, -11.4, -43.4]
[sun]
elevation_deg = [30.0, 30.0]
"""


@pytest.fixture
def place(tmp_path: Path) -> Path:
    """A folder with the Moon under another name, its catalog's config, a camera and a scenario."""
    text = resource("configs/bodies/moon.toml").read_text(encoding="utf-8")
    (tmp_path / "bodies").mkdir()
    body = tmp_path / "bodies/selene.toml"
    body.write_text(text.replace('name = "moon"', 'name = "selene"', 1), encoding="utf-8")
    config = CONFIG.replace('name = "moon"', 'name = "bodies/selene.toml"')
    (tmp_path / "build.toml").write_text(config, encoding="utf-8")
    (tmp_path / "small.toml").write_text(CAMERA, encoding="utf-8")
    (tmp_path / "scenario.toml").write_text(SCENARIO, encoding="utf-8")
    return tmp_path


def test_a_body_of_a_file_is_built_flown_and_navigated(place: Path) -> None:
    catalog, pictures, run = place / "c.gpkg", place / "pictures", place / "run"
    progress = SilentProgress()
    build.run(place / "build.toml", output=catalog, bbox=BBOX, workers=1, progress=progress)
    simulate_folder(place / "scenario.toml", pictures, progress, workers=1)
    assert 'body = "selene.toml"' in (pictures / "run.toml").read_text(encoding="utf-8")
    frame = read_folder(pictures).frames[0]
    assert frame.camera_from_body is not None
    assert frame.position_m is not None
    solution = api.navigate_picture(
        pictures / frame.file,
        read_folder(pictures).cameras[frame.camera],
        [catalog],
        utc=frame.utc,
        camera_from_body=frame.camera_from_body.as_quat(scalar_first=True).tolist(),
        position_m=frame.position_m.tolist(),
        position_sigma_m=frame.position_sigma_m,
        body=place / "bodies/selene.toml",
    )
    assert solution.status == "solved"
    shutil.rmtree(place / "bodies")  # the folder of pictures has its own copy
    assert read_folder(pictures).body.name == "selene"
    navigate_folder(RunInputs(pictures, [catalog]), run, progress)
    moved = place / "elsewhere"
    shutil.move(run, moved)  # and so has the run
    (frame,) = evaluate_run(moved, pictures / "truth.csv").frames
    assert frame.solution.method == "control_points"
    assert frame.error_rnb_m is not None
    assert abs(frame.error_rnb_m).max() < 500.0
