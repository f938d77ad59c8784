"""Folders of star pictures, by `optnav stars` and by `optnav navigate` without attitudes."""

import contextlib
import csv

import numpy as np
import pytest

from catalog.errors import DataError, NothingToDoError
from catalog.geometry.rotations import ARCSEC, rotation_from_quaternion
from catalog.progress import SilentProgress
from optnav_cli.navigate.job import navigate_folder
from optnav_cli.navigate.worker import RunInputs
from optnav_cli.output.run_folder import read_run
from optnav_cli.pages import write_report
from optnav_cli.reasons import ReasonCode
from optnav_cli.stars.job import solve_star_folder
from tests.optnav_cli.made_skies import CAMERA, UTC, drawn_sky, sky_folder, turned

ORION = turned(84.0, -1.0, 20.0)


def test_a_folder_of_stars_gets_attitudes_and_overlays(tmp_path):
    dark = np.random.default_rng(1).normal(100.0, 4.0, CAMERA.shape)
    folder = sky_folder(tmp_path / "sky", {"a.png": drawn_sky(ORION), "b.png": dark})
    rows = solve_star_folder(folder, tmp_path / "run", SilentProgress())
    assert [row.solved for row in rows] == [True, False]
    with (tmp_path / "run/attitudes.csv").open() as file:
        first, second = csv.DictReader(file)
    found = rotation_from_quaternion(*(float(first[f"q{i}"]) for i in "wxyz"))
    off = (found * ORION.inv()).as_rotvec() / ARCSEC
    sigmas = [float(first[f"sigma_{i}_arcsec"]) for i in "xyz"]
    assert (np.abs(off) < 3.5 * np.array(sigmas)).all()
    assert int(first["n_used"]) >= 8
    assert float(first["chance"]) < 1e-5
    assert second["status"] == "unsolved"
    assert "fewer than the 4 stars" in second["reason"]
    assert len(list((tmp_path / "run/overlays").iterdir())) == 2
    write_report(tmp_path / "run", tmp_path / "run.html")
    page = (tmp_path / "run.html").read_text(encoding="utf-8")
    assert page.count("data:image/jpeg") >= 2  # the frames, with their stars named
    assert "fewer than the 4 stars" in page


def test_a_time_is_not_needed_but_then_the_sigmas_hold_aberration(tmp_path):
    folder = sky_folder(tmp_path / "sky", {"a.png": drawn_sky(ORION)}, ["a.png,,sky"])
    (row,) = solve_star_folder(folder, tmp_path / "run", SilentProgress())
    assert row.sigmas_arcsec[0] > 10.0
    assert "no time" in row.reason


def test_a_place_far_out_says_that_the_craft_is_slower_and_narrows_the_sigmas(tmp_path):
    """A low orbit of the Earth turns a sight by 5.3", one at 30 radii by 0.97"."""
    folder = sky_folder(tmp_path / "sky", {"a.png": drawn_sky(ORION)})
    (low,) = solve_star_folder(folder, tmp_path / "low", SilentProgress())
    row = f"a.png,{UTC},sky,0,0,190000000"
    (folder / "frames.csv").write_text(f"file,utc,camera,x_m,y_m,z_m\n{row}\n")
    (far,) = solve_star_folder(folder, tmp_path / "far", SilentProgress())
    fades = np.square(low.sigmas_arcsec[0]) - np.square(far.sigmas_arcsec[0])
    assert fades == pytest.approx((5.44**2 - 0.997**2) / 3.0, rel=0.02)
    (folder / "frames.csv").write_text(f"file,utc,camera,x_m,y_m,z_m\na.png,{UTC},sky,0,0,\n")
    with pytest.raises(NothingToDoError, match="z_m"):
        solve_star_folder(folder, tmp_path / "part", SilentProgress())
    (folder / "frames.csv").write_text(f"file,utc,camera,x_m,y_m,z_m\na.png,{UTC},sky,1e300,0,0\n")
    with pytest.raises(NothingToDoError, match="farther off than 1e"):
        solve_star_folder(folder, tmp_path / "beyond", SilentProgress())


def test_a_folder_without_any_attitude_ends_so_and_a_name_twice_is_refused(tmp_path):
    folder = sky_folder(tmp_path / "sky", {"a.png": np.full(CAMERA.shape, 7.0)})
    with pytest.raises(NothingToDoError, match="none of 1 pictures"):
        solve_star_folder(folder, tmp_path / "run", SilentProgress())
    with (tmp_path / "run/attitudes.csv").open() as file:
        (row,) = csv.DictReader(file)
    assert row["reason"] == "a.png: all pixels of the picture have the same value, 7"
    (folder / "frames.csv").write_text(f"file,utc,camera\na.png,{UTC},sky\na.png,{UTC},sky\n")
    with pytest.raises(DataError, match="stands twice"):
        solve_star_folder(folder, tmp_path / "run", SilentProgress())


def test_navigate_takes_an_empty_attitude_from_the_stars(tmp_path):
    """Of the sky alone there is no position: but the reason is not the attitude any more."""
    dark = np.random.default_rng(1).normal(100.0, 4.0, CAMERA.shape)
    folder = sky_folder(tmp_path / "sky", {"a.png": drawn_sky(ORION), "b.png": dark})
    (folder / "run.toml").write_text('body = "earth"\nattitude = "camera_from_inertial"\n')
    with contextlib.suppress(NothingToDoError):
        navigate_folder(RunInputs(folder), tmp_path / "run", SilentProgress())
    first, second = read_run(tmp_path / "run").solutions
    assert first.reason_code not in (ReasonCode.NO_ATTITUDE, ReasonCode.NUMERICAL_FAILURE)
    assert second.reason_code == ReasonCode.NO_ATTITUDE
    assert "the stars give none" in second.reason
