"""The study of rocks and craters: the law that rocks are drawn by, a row, the stored figures."""

from dataclasses import replace

import msgspec
import numpy as np
import pytest

from optnav_cli.hazard.rocks import ShadowEdges, measure_heights
from optnav_cli.hazard.settings import load_hazard_model
from tests.optnav_cli.hazard.views import view_of
from tests.studies import hazard_craters as craters
from tests.studies import hazard_rocks as study
from tests.studies.hazard_rocks_ground import (
    HEIGHT_RATIO,
    Rocks,
    RockyGround,
    count_rocks,
    draw_rocks,
    make_rocky_ground,
)
from tests.studies.stored import read_stored

MODEL = load_hazard_model()


@pytest.mark.parametrize("k", [0.02, 0.1])
def test_drawn_rocks_cover_the_published_share_of_the_ground(k: float) -> None:
    """F(> D) = k exp(-q D), by the areas of the rocks themselves."""
    side = 60.0
    rocks = draw_rocks(3, k, side)
    area = 0.25 * np.pi * rocks.length * rocks.width
    mean = np.sqrt(rocks.length * rocks.width)
    q = 1.79 + 0.152 / k
    wanted = k * (np.exp(-q * 0.2) - np.exp(-q * 3.0))
    assert area[mean > 0.2].sum() / side**2 == pytest.approx(wanted, rel=0.15)
    assert (mean > 0.2).sum() / side**2 == pytest.approx(float(count_rocks(k, 0.2)), rel=0.15)
    assert np.mean(rocks.height / rocks.length) == pytest.approx(HEIGHT_RATIO, abs=0.03)


def test_a_small_picture_shows_its_rocks() -> None:
    ground = make_rocky_ground("even", 7, 0.1, 20.0)
    case = study.RockCase("even", 20.0, 0.1)
    score = study.RockScore()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(study, "SIDE_M", 18.0)
        study.judge(case, ground, MODEL, score)
    rocks, found = score.sizes.sum(axis=0)
    assert rocks >= 4
    assert found >= 0.8 * rocks
    assert score.false <= 0.1 * score.listed


def test_a_picture_from_too_high_is_refused_with_the_reason() -> None:
    empty, none = np.zeros((4, 4), np.float32), Rocks(*np.zeros((6, 0)))
    ground = RockyGround(7, empty, empty, none)
    score = study.RockScore()
    study.judge(study.RockCase("even", 20.0, 0.02, 400.0), ground, MODEL, score)
    assert "too coarse for rocks of 0.3 m" in score.reason


def test_stored_figures_reach_what_is_asked() -> None:
    """Found and false of both grounds together; rough ground alone is short of it."""
    table = read_stored("hazard_rocks").tables[0]
    names = [column.name for column in table.columns]
    rows = [dict(zip(names, row, strict=True)) for row in table.rows]
    asked = [row for row in rows if (row["sun"], row["camera"], row["share"]) == (20.0, 100.0, 5.0)]
    assert {row["ground"] for row in asked} == {"rough", "even"}
    assert np.average([r["found"] for r in asked], weights=[r["rocks"] for r in asked]) >= 90.0
    assert np.average([r["false"] for r in asked], weights=[r["listed"] for r in asked]) <= 5.0
    assert all(row["false"] <= 5.0 for row in asked)


def edges_of(count: int = 4000) -> tuple[study.FitData, ...]:
    """Shadows of rocks whose heights err as the shipped numbers say."""
    rng = np.random.default_rng(2)
    view = view_of(np.ones((64, 64), np.float32))
    parts = []
    for cell in (0.02, 0.2):
        scaled = replace(view, cell_m=cell)
        zero = np.zeros(count)
        length = rng.uniform(3.0, 30.0, count)
        slope = rng.normal(0.0, 0.05, count)
        edges = ShadowEdges(zero, zero, zero + 1e3, length, slope, zero, np.zeros((count, 5)))
        height, sigma = measure_heights(edges, scaled, MODEL.rocks)
        parts.append(study.FitData(edges, scaled, height + sigma * rng.standard_normal(count)))
    return tuple(parts)


def test_half_or_twice_a_fitted_number_of_heights_fits_worse() -> None:
    data = {20.0: list(edges_of())}
    right = study.misfit_heights(data, MODEL.rocks)
    for key in ("longer_px", "slope_weight", "sigma_px", "sigma_share", "sigma_slope"):
        for factor in (0.5, 2.0):
            value = factor * getattr(MODEL.rocks, key)
            other = msgspec.structs.replace(MODEL.rocks, **{key: value})
            assert study.misfit_heights(data, other) > right, (key, factor)


def test_the_rule_is_found_from_what_was_drawn_by_it() -> None:
    rng = np.random.default_rng(5)
    weights = np.array(MODEL.rocks.weights[2])
    features = rng.normal(0.0, 1.0, (20000, weights.size - 1))
    chance = 1.0 / (1.0 + np.exp(-(weights[0] + features @ weights[1:])))
    found = study.fit_weights(features, rng.uniform(size=len(features)) < chance)
    np.testing.assert_allclose(found, weights, atol=0.15 * np.abs(weights).max())


def test_a_crater_is_as_steep_as_its_profile() -> None:
    """On a base that is short against it, the bowl is 4 x depth over diameter steep at its rim."""
    steep = craters.steepest_deg(200.0, 1.0, 0.1)
    bowl = 0.1 * 200.0 * (1.0 / 100.0) * 2.0
    assert np.tan(np.radians(steep)) == pytest.approx(bowl, rel=0.05)
    assert craters.dangerous_diameter_m(1.0) < craters.dangerous_diameter_m(0.3)
    depth = craters.needed_depth(4.0, 0.5)
    assert craters.steepest_deg(4.0, 0.5, depth) == pytest.approx(7.0, abs=0.05)


def test_small_craters_vanish_at_a_coarse_resolution() -> None:
    fine, coarse = (
        float(craters.pad_variance(craters.one_crater(1.0), 20.0, r).max()) for r in (0.2, 1.0)
    )
    assert coarse < 0.1 * fine
