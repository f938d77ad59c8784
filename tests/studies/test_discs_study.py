"""The table of small discs."""

import numpy as np
import pytest

from tests.studies.discs import KNOWN, DiscResult, DiscScene, report, solve


def result(**values):
    return DiscResult("moon", KNOWN, 5.0, 40.0, **values)


def test_the_table_keeps_direction_and_range_apart_and_counts_refusals():
    one = result(method="horizon", direction_px=0.03, range_share=0.04, direction_nees=0.5,
                 range_nees=2.0)  # fmt: skip
    two = result(method="brightness_centre", direction_px=0.04, range_share=-0.03,
                 direction_nees=4.5, range_nees=1.0)  # fmt: skip
    found = report([one, two, result(reason="no limb; a star looks the same")])
    table = found.tables[0]
    row = dict(zip(table.columns, table.rows[table.column("disc").index("moon, 4-6 px")]))
    shown = {column.name: column.shown(cell) for column, cell in row.items()}
    assert (shown["solved"], shown["discs"]) == ("2", "3")
    assert (shown["direction_px"], shown["direction_nees"]) == ("0.035", "2.50")
    assert (shown["range_share"], shown["range_nees"]) == ("3.54", "1.50")
    assert shown["worst"] == "3.0"
    assert shown["methods"] == "1 brightness centre, 1 horizon"
    assert "1 not solved: a star looks the same" in found.notes


def test_a_drawn_disc_has_the_place_and_size_that_its_truth_says():
    scene = DiscScene("moon")
    disc = scene.draw(12.0, 7301, np.random.default_rng(2))
    centre = disc.camera.project(disc.camera_from_body.apply(-disc.position_m))
    values = disc.picture.values - np.median(disc.picture.values)
    rows, cols = np.nonzero(values > 0.3 * values.max())
    assert np.hypot(cols - centre[0], rows - centre[1]).max() == pytest.approx(6.0, abs=1.2)
    found = solve(scene, disc, KNOWN)
    assert found.direction_px < 0.2
    assert abs(found.range_share) < 0.05


def test_discs_behind_a_defocused_lens_that_nobody_states_are_as_far_off_as_they_say():
    """9.5 px across, fitted whole: as if behind a gaussian, the ranges were 10 sigmas off."""
    scene = DiscScene("moon")
    for seed in (5, 21):
        disc = scene.draw(9.5, 7302, np.random.default_rng(seed))
        found = solve(scene, disc.blurred_anew("defocus", np.random.default_rng(seed)), "defocus")
        assert found.method == "horizon_sphere"
        assert found.range_nees < 9.0
        assert 2.0 * found.direction_nees < 11.8  # 99.7 % of two


def test_discs_behind_a_sharp_lens_that_nobody_states_are_as_far_off_as_they_say():
    """Too small a blur is taken for a smaller disc: expected at 0.85 +- 0.17 px, NEES is 2.2."""
    scene, squares = DiscScene("moon"), []
    for seed, diameter in enumerate((6.5, 8.0, 9.0, 9.5)):
        disc = scene.draw(diameter, 7302, np.random.default_rng(seed))
        found = solve(scene, disc.blurred_anew("sharp", np.random.default_rng(seed)), "sharp")
        squares.append(found.range_nees)
    assert np.mean(squares) < 1.5
