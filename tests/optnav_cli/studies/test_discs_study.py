"""The table of small discs."""

import numpy as np
import pytest

from optnav_cli.studies.discs import DiscResult, DiscScene, report, solve


def result(**values):
    return DiscResult("moon", True, 5.0, 40.0, **values)


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
    found = solve(scene, disc, blur_known=True)
    assert found.direction_px < 0.2
    assert abs(found.range_share) < 0.05
