"""The table of small discs."""

import numpy as np
import pytest

from optnav_cli.studies.disc_scene import DiscScene
from optnav_cli.studies.discs import DiscResult, format_table, solve


def result(**values):
    return DiscResult("moon", True, 5.0, 40.0, **values)


def test_the_table_keeps_direction_and_range_apart_and_counts_refusals():
    one = result(method="horizon", direction_px=0.03, range_share=0.04, direction_nees=0.5,
                 range_nees=2.0)  # fmt: skip
    two = result(method="brightness_centre", direction_px=0.04, range_share=-0.03,
                 direction_nees=4.5, range_nees=1.0)  # fmt: skip
    text = format_table([one, two, result(reason="no limb; a star looks the same")])
    line = next(line for line in text.splitlines() if line.startswith("moon, 4-6 px "))
    assert "2/3" in line
    assert "0.035 px   2.50" in line
    assert "3.54 %   1.50" in line
    assert "3.0 σ  1 brightness centre, 1 horizon" in line
    assert "1 not solved: a star looks the same" in text


def test_a_drawn_disc_has_the_place_and_size_that_its_truth_says():
    scene = DiscScene("moon")
    disc = scene.draw(12.0, 7301, np.random.default_rng(2))
    centre = disc.camera.project(disc.camera_from_body.apply(-disc.position_m))
    values = disc.picture.values - np.median(disc.picture.values)
    rows, cols = np.nonzero(values > 0.3 * values.max())
    assert np.hypot(cols - centre[0], rows - centre[1]).max() == pytest.approx(6.0, abs=1.2)
    found = solve(scene, disc, blur_known=True)
    assert found.direction_px < 0.2
    assert abs(found.range_share) < 0.05
