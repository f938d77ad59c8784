"""Render, select and check on real terrain: candidates, order, certificates, holes."""

from dataclasses import replace
from pathlib import Path

import msgspec
import numpy as np
import pytest

from catalog.bodies.body import load_body
from catalog.config import resource
from catalog.control_point import ControlPoint, Flag
from catalog.geometry.cells import CellGrid
from catalog.geometry.latlon import angular_distance
from catalog.jobs.workspace import decode_records, encode_records
from catalog.pipeline import cell_map, check, render
from catalog.pipeline.config import (
    BodySettings,
    BuildConfig,
    CheckSettings,
    PyramidSettings,
    RenderSettings,
    SelectSettings,
)
from catalog.pipeline.context import StageContext
from catalog.pipeline.render import RenderedCell, SelectedCell
from catalog.rendering.map_view import render_map, render_map_quickly
from catalog.selection.localisation import predict_match
from catalog.terrain.dem.mosaic import Mosaic
from catalog.terrain.dem.source import DemSettings

BBOX = (-13.0, -44.0, -9.0, -41.0)


@pytest.fixture(scope="module")
def mosaic(tmp_path_factory):
    dem = DemSettings(path=str(resource("data/tycho_gld100_256ppd.tif")))
    folder = tmp_path_factory.mktemp("overviews")
    return Mosaic.from_files([dem], Path(folder), load_body("moon"), folder)


def context_of(mosaic, posting_m=237.0, **sections):
    config = BuildConfig(
        body=BodySettings("moon"),
        dem=(DemSettings(path="tycho"),),
        pyramid=PyramidSettings(levels=3, size=80),
        **{"render": RenderSettings(candidates=4, levels=2, sun_elevations=3), **sections},
    )
    return StageContext(mosaic.body, mosaic, CellGrid(1.0), posting_m, config)


@pytest.fixture(scope="module")
def context(mosaic):
    return context_of(mosaic)


@pytest.fixture(scope="module")
def cells(context):
    return [int(cell) for cell in context.grid.find_cells_in_bbox(*BBOX)]


@pytest.fixture(scope="module")
def rendered(context, cells):
    return render.render_chunk(context, cells)


@pytest.fixture(scope="module")
def selected(context, rendered):
    return render.select(context, rendered)


@pytest.fixture(scope="module")
def checked(context, selected):
    return check.check_chunk(context, selected)


def test_candidates_lie_in_their_cells_and_apart(context, rendered, cells):
    assert [record.cell for record in rendered] == cells
    least = 0.99 * context.config.render.separation_cell
    for record in rendered:
        assert 1 <= len(record.candidates) <= 4
        for k, one in enumerate(record.candidates):
            assert context.grid.find_cells(one.lat_deg, one.lon_deg) == record.cell
            assert one.error_px.shape == (2, 6)
            assert one.hessian_eigenvalue > 0.0
            for other in record.candidates[:k]:
                place = np.radians([one.lat_deg, one.lon_deg, other.lat_deg, other.lon_deg])
                assert np.degrees(angular_distance(*place)) >= least


def test_a_lower_sun_promises_a_better_match_on_open_ground(rendered):
    # no shadows cover whole templates here; contrast goes with the cotangent of the elevation
    errors = np.stack([c.error_px[0] for record in rendered for c in record.candidates])
    middle, high = np.median(errors[:, 2:4]), np.median(errors[:, 4:6])
    assert middle < high


def test_errors_predicted_from_one_ground_are_those_of_each_place(context, rendered):
    """The window of a place, cut anew about the place itself, at both levels.

    10 %: windows of the second level stand up to half a node off, and the new cut samples between
    the nodes of the ground. Under the lowest Sun the cut lacks its neighbours' shadows.
    """
    settings = context.config.render
    ratios = []
    for record in rendered[:6]:
        suns = cell_map.sample_suns(settings, context.grid.centre_deg(record.cell)[0])
        for candidate in record.candidates:
            projection = context.projection(candidate.lat_deg, candidate.lon_deg)
            for level, posting in enumerate(context.postings_m[: settings.levels]):
                window = context.mosaic.local_grid(projection, posting, settings.window_nodes)
                for k, sun in enumerate(suns):
                    if sun[2] < np.sin(np.radians(20.0)):
                        continue
                    picture = render_map(window, posting, sun, radius_m=context.body.radius_m)
                    picture = cell_map.blur_grid(picture)
                    alone = predict_match(picture, settings.snr).score
                    ratios.append(candidate.error_px[level, k] / alone)
    off = np.abs(np.log(ratios))
    assert np.median(off) < 0.02
    assert np.percentile(off, 95) < 0.1


def test_places_too_far_apart_for_one_ground_are_rendered_alone(
    context, cells, rendered, monkeypatch
):
    """Errors to 5 %: windows stand up to half a node off, and shadows from afar are missing."""
    monkeypatch.setattr(render, "WIDE_GROUND", 0.0)
    sides = set()
    monkeypatch.setattr(
        render,
        "render_map_quickly",
        lambda grid, *a, **k: sides.add(len(grid)) or render_map_quickly(grid, *a, **k),
    )
    alone = render.render_chunk(context, cells[:4])
    assert sides == {context.config.render.window_nodes + 2 * render.SHADOW_NODES}
    ratios = []
    for one, other in zip(alone, rendered, strict=False):
        for a, b in zip(one.candidates, other.candidates, strict=True):
            assert (a.lat_deg, a.lon_deg, a.missing) == (b.lat_deg, b.lon_deg, b.missing)
            ratios.append(a.error_px / b.error_px)
    assert np.median(np.abs(np.log(ratios))) < 0.02
    assert np.percentile(np.abs(np.log(ratios)), 90) < 0.05


def test_chunks_do_not_matter_and_records_travel(context, cells, rendered, selected, checked):
    alone = [record for cell in reversed(cells) for record in render.render_chunk(context, [cell])]
    again = render.select(context, alone)
    assert encode_records(again) == encode_records(selected)
    whole = decode_records(encode_records(rendered), RenderedCell)
    assert encode_records(render.select(context, whole)) == encode_records(selected)
    back = decode_records(encode_records(checked), ControlPoint)
    assert back == checked
    assert check.check_chunk(context, again[3:4]) == checked[3:4]


@pytest.mark.parametrize("percentile", [0.0, 50.0, 90.0, 99.0, 100.0])
def test_the_predicted_error_is_a_percentile_that_numpy_finds_too(context, percentile):
    rng = np.random.default_rng(3)
    records = []
    for cell, suns in ((100, 1), (101, 4), (102, 11)):  # few Suns come up near a pole
        errors = rng.uniform(0.1, 3.0, (2, 2, suns)).astype(np.float32)
        errors[1, 1, 0] = np.inf
        lat, lon = context.grid.centre_deg(cell)
        candidates = [
            render.Candidate(lat + 0.1 * k, lon, 1.0, errors[k], (0.0,)) for k in range(2)
        ]
        records.append(RenderedCell(cell, tuple(candidates)))
    config = msgspec.structs.replace(
        context.config, select=SelectSettings(percentile=percentile, spacing_cell=0.0)
    )
    chosen = render.select(replace(context, config=config), records)
    for record, found in zip(records, chosen, strict=True):
        wanted = [
            np.percentile(c.error_px, percentile, axis=1, method="higher").max()
            for c in record.candidates
        ]
        assert [place.localisation_nodes for place in found.places] == sorted(wanted)


def test_places_of_other_cells_keep_their_distance(context, selected):
    for record in selected:
        for other in selected:
            if record.cell >= other.cell or min(record.spacing, other.spacing) < 1.0:
                continue
            for a in record.places:
                for b in other.places:
                    place = np.radians([a.lat_deg, a.lon_deg, b.lat_deg, b.lon_deg])
                    assert np.degrees(angular_distance(*place)) >= 0.6 - 1e-6


def test_every_usable_point_carries_its_certificate(context, checked, cells):
    assert [point.id for point in checked] == cells
    usable = [point for point in checked if point.usable]
    # highland ground at twice the DEM's posting: nearly all cells have a good point
    assert len(usable) >= 0.8 * len(checked)
    for point in usable:
        # 3 of 5 are a pass: trials end when that is decided
        assert (point.trials, round(point.recognition_rate * point.trials)) in {
            (3, 3), (4, 3), (5, 3)
        }  # fmt: skip
        assert point.hessian_eigenvalue > 0.0
        assert len(point.uniqueness) == context.levels
        assert min(point.uniqueness) >= context.config.check.min_margin
        assert len(point.shadow_limit_deg) == 36
        assert 0.0 <= min(point.shadow_limit_deg) <= max(point.shadow_limit_deg) < 60.0
        assert not point.flags & check.FATAL
        assert point.source == "tycho_gld100_256ppd.tif"
        at = np.radians([point.lat_deg, point.lon_deg])
        height = float(context.mosaic.heights(at[0], at[1], context.posting_m))
        assert point.radius_m == pytest.approx(context.body.radius_m + height, abs=0.01)


def test_trials_that_are_not_run_would_not_have_changed_the_choice(mosaic, selected, monkeypatch):
    """Against all trials at all places; a small error is asked for, so that many trials fail."""
    strict = CheckSettings(places=4, trials=8, good_recognition=0.75, max_error_nodes=0.25)
    hard = context_of(mosaic, check=strict)
    least, enough = 5, 6  # 0.6 and 0.75 of 8
    run = []
    of_trials = check.run_trials
    monkeypatch.setattr(
        check, "run_trials", lambda *a, **k: (run.append(1) or o for o in of_trials(*a, **k))
    )
    found = check.check_chunk(hard, selected)
    early, run[:] = len(run), []
    kinds = set()
    for record, kept in zip(selected, found, strict=True):
        best, best_of_all = None, -1
        for number, place in enumerate(record.places[:4]):
            whole = check.Certificate(hard, record, place, number)
            # without the stops: every trial of the place, counted here
            outcomes = list(whole._outcomes)
            wins = sum(o.accepted and o.distance <= strict.max_error_nodes for o in outcomes)
            whole._outcomes = iter(outcomes)
            whole.finish()
            out = whole.flags & check.FATAL & ~Flag.NOT_RECOGNISED
            passed = wins >= least and record.spacing > 0.0 and not out
            if passed and min(wins, enough) > best_of_all:  # the first of equals
                best, best_of_all = place, min(wins, enough)
        assert kept.usable == (best is not None)
        tried = not Flag(kept.flags) & check.NOT_TRIED
        wins = round(kept.recognition_rate * kept.trials)
        assert kept.recognition_rate == (wins / kept.trials if tried else 0.0)
        if kept.usable:
            assert (kept.lat_deg, kept.lon_deg) == (best.lat_deg, best.lon_deg)
            assert wins == best_of_all
            assert kept.trials == 8 or wins == enough
        elif Flag(kept.flags) & Flag.NOT_RECOGNISED:
            assert kept.trials - wins == 4  # with which five of eight are out of reach
        kinds.add((kept.usable, wins == enough))
    assert len(kinds) == 3  # passed well, passed, failed
    assert early < 0.7 * len(run)


def test_a_place_in_foreign_shadow_meets_trials_only_when_it_is_kept(mosaic, selected):
    dark = context_of(mosaic, check=CheckSettings(max_shadowed=0.0, trials=2))
    record = next(
        record
        for record in selected
        if check.Certificate(dark, record, record.places[0], 0).flags & Flag.SHADOWED
    )
    place = check.Certificate(dark, record, record.places[0], 0)
    place.try_for(0)
    assert (place.trials, place.usable) == (0, False)
    alone = check.check_cell(dark, msgspec.structs.replace(record, places=record.places[:1]))
    assert alone.trials > 0
    assert not alone.usable


def test_a_check_that_none_can_pass_leaves_points_with_their_flags_up(mosaic, selected):
    for settings, flag in (
        (CheckSettings(max_localisation_nodes=1e-6), Flag.FLAT),
        (CheckSettings(min_margin=1.0, places=1), Flag.NOT_UNIQUE),
        (CheckSettings(min_score=1.0, places=1, trials=5), Flag.NOT_RECOGNISED),
    ):
        found = check.check_chunk(context_of(mosaic, check=settings), selected[:2])
        assert [record.usable for record in found] == [False, False]
        assert all(record.flags & flag for record in found)


def test_a_flat_place_of_a_whole_model_is_refused_without_patches(tmp_path, selected, monkeypatch):
    dem = DemSettings(path=str(resource("data/moon_gld100_4ppd.tif")))
    whole = Mosaic.from_files([dem], tmp_path, load_body("moon"), tmp_path)
    strict = CheckSettings(max_localisation_nodes=1e-6)
    context = context_of(whole, posting_m=whole.posting_m, check=strict)
    monkeypatch.setattr(StageContext, "patches", lambda *_: pytest.fail("patches were cut"))
    place = check.Certificate(context, selected[0], selected[0].places[0], 0)
    place.try_for(0)
    assert place.flags & Flag.FLAT
    assert (place.trials, place.usable) == (0, False)


def test_a_place_beside_the_terrain_s_edge_says_that_it_lacks_data(context, selected):
    place = msgspec.structs.replace(selected[0].places[0], lat_deg=-38.02, lon_deg=-11.0)
    record = SelectedCell(selected[0].cell, (place,), 1.0)
    found = check.check_cell(context, record)
    assert not found.usable
    assert found.flags & Flag.NO_DATA
    assert found.trials == 0


def test_a_cell_at_the_edge_takes_places_whose_fine_patches_are_whole(context):
    # a patch of the third level reaches 38 km, 1.25 deg, from its point
    cell = int(context.grid.find_cells(-46.5, -11.0))
    for candidate in render.render_chunk(context, [cell])[0].candidates:
        assert max(candidate.missing) <= cell_map.MAX_MISSING
        assert candidate.lat_deg > -46.9


def test_a_cell_without_ground_is_left_out(context):
    far = int(context.grid.find_cells(20.0, 100.0))
    assert render.render_chunk(context, [far]) == []


def test_near_a_pole_suns_come_from_all_around():
    settings = RenderSettings()
    assert len(cell_map.sample_suns(settings, 45.0)) == 4
    polar = cell_map.sample_suns(settings, 89.0)
    assert len(polar) == 16
    azimuth = np.degrees(np.arctan2(polar[:, 0], polar[:, 1]))
    assert np.ptp(azimuth) > 250.0
