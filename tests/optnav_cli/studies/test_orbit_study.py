"""The study of orbits: each group gives figures, and the quick ones keep what is wanted."""

import logging

import pytest

from catalog.progress import SilentProgress
from optnav_cli.studies import orbit


@pytest.fixture(autouse=True)
def quiet():
    logging.getLogger("optnav_cli.dynamics").setLevel(logging.ERROR)


def test_the_smoother_agrees_with_other_methods():
    found = {figure.what: figure.found for figure in orbit.run(SilentProgress(), 3, 1, "methods")}
    smoother, single, weights, constants = found.values()
    assert smoother < 5e-8
    assert single < 0.005
    assert weights < 1e-6
    assert constants < 1e-6


def test_clocks_nodes_and_disturbances_are_found():
    for rows in ("clocks", "station", "disturbance"):
        figures = orbit.run(SilentProgress(), 6, 2, rows)
        assert all(figure.found is not None for figure in figures)
    (report,) = orbit.report(figures).tables
    assert len(report.rows) == 2
