"""The study of orbits: each group gives figures, and the quick ones keep what is wanted."""

import logging
import os

import pytest

from catalog.progress import SilentProgress
from tests.studies import orbit, orbit_sizes


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


def test_sizes_of_noise_are_scored_by_what_they_state(monkeypatch):
    """The nearest to what is stated come last; flights need the shared field."""
    if not os.environ.get(orbit.SHARED):
        pytest.skip(f"needs {orbit.SHARED}")
    monkeypatch.setattr(orbit_sizes, "ACROSS", (1.5,))
    monkeypatch.setattr(orbit_sizes, "ALONG", (0.001,))
    monkeypatch.setattr(orbit_sizes, "LOCAL", (0.0, 2.0))
    figures = orbit.run(SilentProgress(), 3, 5, "sizes")
    assert [f.found for f in figures] == sorted([f.found for f in figures], reverse=True)
    assert len(figures) == 2
    assert "across 1.5, along 0.001, local" in figures[0].what
    assert all(1.0 < f.found < 3.0 for f in figures)
