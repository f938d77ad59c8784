"""What the simple laws cost against Hapke's, on the real Tycho ground."""

import numpy as np
import pytest

from catalog.progress import SilentProgress
from tests.studies.photometry import compare, report, run, tycho_ground


@pytest.fixture(scope="module")
def rows():
    return run(SilentProgress())


def of(rows, law, highest):
    return [row for row in rows if row.law == law and row.emission_deg <= highest]


def test_lommel_seeliger_is_hapke_enough_below_thirty_degrees_of_emission(rows):
    """The seed's 60 deg holds on average only; single Suns and views are worse from 45 deg on."""
    near = of(rows, "lommel_seeliger", 30.0)
    assert min(row.correlation[1] for row in near) > 0.97
    assert max(row.shift[1] for row in near) < 0.1
    below_sixty = of(rows, "lommel_seeliger", 60.0)
    assert np.mean([row.correlation[0] for row in below_sixty]) > 0.975
    assert max(row.shift[0] for row in below_sixty) < 0.2


def test_lunar_lambert_is_hapke_enough_below_sixty_degrees_everywhere(rows):
    near = of(rows, "lunar_lambert", 60.0)
    assert min(row.correlation[1] for row in near) > 0.98
    assert max(row.shift[1] for row in near) < 0.1


def test_the_laws_part_with_emission(rows):
    means = [row.correlation[0] for row in of(rows, "lommel_seeliger", 60.0)]
    assert means[0] > means[2] > means[3] > means[4]


def test_the_table_names_every_law_and_angle(rows):
    found = report(rows)
    assert any("lunar_lambert below 60°" in note for note in found.notes)
    assert [len(table.rows) for table in found.tables] == [7, 7, 7]


def test_the_ground_is_the_tile_at_its_true_scale():
    """Tycho lies in it: its floor is 4 km below its rim."""
    ground, radius = tycho_ground(200)
    assert radius == 1_737_400.0
    assert np.isfinite(ground).all()
    sun = np.array([0.5, 0.0, 0.866])
    same = compare(ground, radius, sun, np.array([0.0, 0.0, 1.0]))
    assert set(same) == {"lommel_seeliger", "lunar_lambert", "lambert"}
