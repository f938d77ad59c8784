"""The study of attitudes from stars, with few pictures."""

import numpy as np
import pytest

from catalog.progress import SilentProgress
from tests.optnav_cli.made_skies import UTC, add_body, drawn_sky, sky_folder, turned
from tests.studies import stars


def test_few_pointings_are_all_found_and_no_empty_picture_is(monkeypatch, tmp_path):
    monkeypatch.setattr(stars, "CAMERAS", {"kam_s": 4.5})
    figures = stars.run(tmp_path, SilentProgress(), trials=5, pictures=0)
    (row,), (empty,) = figures.found, figures.empty
    assert row[2:5] == (5, 5, 0)
    assert empty[2] == 0
    assert figures.beside == []
    assert "Random pointings" in stars.report(figures).to_text()


def test_pictures_of_a_lit_body_are_scored_against_their_truth(tmp_path):
    orion = turned(84.0, -1.0, 20.0)
    night = np.random.default_rng(1).normal(100.0, 4.0, (512, 512))
    pictures = {"a.png": add_body(drawn_sky(orion)), "b.png": night}
    folder = sky_folder(tmp_path / "sky", pictures)
    (folder / "run.toml").write_text('body = "earth"\nattitude = "camera_from_inertial"\n')
    turn = ",".join(f"{v:.15g}" for v in orion.as_quat(scalar_first=True))
    rows = [f"{name},{UTC},0,0,42000000,{turn}" for name in pictures]
    (folder / "truth.csv").write_text("\n".join(["file,utc,x_m,y_m,z_m,qw,qx,qy,qz", *rows]))
    _, count, solved, share, wrong, across, _, nees, _, fewest = stars._beside(folder, 1)
    assert (count, solved, wrong) == (2, 1, 0)
    assert share == pytest.approx(50.0)
    assert 0.0 < across < 8.0
    assert 0.0 < nees < 5.0
    assert fewest >= 8
