"""The economy study: its policies, a small run of it, and its table."""

from pathlib import Path

import pytest

from catalog.bodies.body import load_body
from catalog.config import resource
from catalog.geometry.cells import CellGrid
from catalog.pipeline.config import BodySettings, BuildConfig, CheckSettings, RenderSettings
from catalog.pipeline.context import StageContext
from catalog.progress import SilentProgress
from catalog.terrain.dem.mosaic import Mosaic
from catalog.terrain.dem.source import DemSettings
from tests.studies import economy
from tests.studies.selection import DEM


@pytest.fixture
def context(tmp_path):
    body = load_body("moon")
    dem = DemSettings(path=str(resource(DEM)))
    mosaic = Mosaic.from_files([dem], Path(tmp_path), body, tmp_path)
    config = BuildConfig(body=BodySettings("moon"), dem=(dem,))
    return StageContext(body, mosaic, CellGrid(1.0), 2.0 * mosaic.posting_m, config)


def test_the_first_policy_is_what_a_build_does():
    own, *others = economy.policies()
    assert own.render == RenderSettings()
    assert own.check == CheckSettings()
    assert {policy.name for policy in others} == {"all Suns", "all tried", "four of five", "fewer"}
    assert all((policy.render, policy.check) != (own.render, own.check) for policy in others)


def test_policies_meet_the_same_trials(context, monkeypatch):
    cells = [int(context.grid.find_cells(lat, -11.0)) for lat in (-42.5, -43.5)]
    own = economy.policies()[0]
    same = economy.Policy("same", own.render, own.check)
    monkeypatch.setattr(economy, "policies", lambda: (own, same))
    monkeypatch.setattr(economy, "free_grounds", lambda context: dict.fromkeys(cells))
    (table,) = economy.report(economy.one_size(context, SilentProgress(), 8, 1)).tables
    rate, again = table.column("recognised")
    assert rate == again
    assert 50.0 < rate <= 100.0  # highlands at twice the posting are recognised
    assert table.column("same") == [100.0, 100.0]
    assert [row[:3] for row in table.rows] == [(1.0, 2, 8)] * 2
    assert (table.column("against"), table.column("against_half")) == ([None, 0.0], [None, 0.0])
