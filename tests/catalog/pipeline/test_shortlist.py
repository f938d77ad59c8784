"""Shortlists from sweeps: the same in whatever company, as good as from a cell's own ground."""

from pathlib import Path

import numpy as np
import pytest
from rasterio.transform import Affine

from catalog.bodies.body import load_body
from catalog.config import resource
from catalog.geometry.cells import CellGrid
from catalog.geometry.latlon import angular_distance
from catalog.pipeline import shortlist
from catalog.pipeline.cell_map import blur_grid, cut_cell_ground, sample_suns
from catalog.pipeline.config import BodySettings, BuildConfig, PyramidSettings, RenderSettings
from catalog.pipeline.context import StageContext
from catalog.selection.localisation import compute_hessian_eigenvalue, compute_sun_products
from catalog.terrain.dem.mosaic import Mosaic
from catalog.terrain.dem.source import DemSettings


def context_of(folder, *paths, cell_deg=1.0, posting_m=None, **settings) -> StageContext:
    named = tuple(DemSettings(path=str(path), priority=i + 1) for i, path in enumerate(paths))
    mosaic = Mosaic.from_files(list(named), folder, load_body("moon"), folder / "overviews")
    config = BuildConfig(
        body=BodySettings("moon"),
        dem=named,
        pyramid=PyramidSettings(levels=3, size=40),
        render=RenderSettings(**settings),
    )
    return StageContext(
        mosaic.body, mosaic, CellGrid(cell_deg), posting_m or mosaic.posting_m, config
    )


@pytest.fixture(scope="module")
def tycho(tmp_path_factory):
    return context_of(
        tmp_path_factory.mktemp("tycho"), resource("data/tycho_gld100_256ppd.tif"), posting_m=237.0
    )


@pytest.fixture
def globe(tmp_path, dems) -> StageContext:
    """All of a rough Moon in pixels of half a degree, in cells of 5 degrees."""
    rough = np.random.default_rng(4).normal(0.0, 800.0, (360, 720)).astype(np.float32)
    path = dems.write(tmp_path / "globe.tif", rough)
    return context_of(Path(tmp_path), path, cell_deg=5.0, window_nodes=16, candidates=3)


@pytest.fixture
def alone(monkeypatch):
    """Cells whose shortlist came from their own ground."""
    cells = []
    of_ground = shortlist.cut_cell_ground
    monkeypatch.setattr(
        shortlist,
        "cut_cell_ground",
        lambda context, cell: cells.append(cell) or of_ground(context, cell),
    )
    return cells


def same(one, other):
    return one.places.tobytes() == other.places.tobytes() and one.complete == other.complete


def test_company_does_not_matter(globe, alone):
    grid = globe.grid
    whole = shortlist.make_shortlists(globe, range(grid.total))
    assert list(whole) == list(range(grid.total))
    # about the poles and where parallels shrink within a window's reach
    far = [abs(grid.centre_deg(cell)[0]) for cell in alone]
    assert 60.0 < min(far) < 85.0
    assert 0 < len(alone) < 0.25 * grid.total
    rng = np.random.default_rng(1)
    groups = [
        rng.permutation(grid.total)[:40],
        grid.find_cells_in_bbox(170.0, -30.0, -170.0, 30.0),
        grid.find_cells_in_bbox(-180.0, 10.0, -160.0, 60.0)[::-1],
        np.array([int(grid.find_cells(12.0, 179.9))]),
        np.array([int(grid.find_cells(12.0, -179.9))]),
    ]
    for cells in groups:
        found = shortlist.make_shortlists(globe, cells)
        assert list(found) == cells.tolist()
        assert all(same(whole[cell], one) for cell, one in found.items())


def test_memory_bounds_the_sweep_and_not_the_result(globe, monkeypatch):
    cells = globe.grid.find_cells_in_bbox(-180.0, -20.0, 180.0, 20.0)
    whole = shortlist.make_shortlists(globe, cells)
    sizes = []
    of_graticule = Mosaic.graticule_heights

    def counted(mosaic, graticule, part, *rest):
        sizes.append(part.height * part.width)
        return of_graticule(mosaic, graticule, part, *rest)

    monkeypatch.setattr(Mosaic, "graticule_heights", counted)
    monkeypatch.setattr(shortlist, "MAX_PART", 12_000)
    found = shortlist.make_shortlists(globe, cells)
    assert all(same(whole[cell], one) for cell, one in found.items())
    assert max(sizes) < 18_000  # margins come on top; all at once would be 60 000
    assert len(sizes) > 4


def test_places_lie_in_their_cells_and_apart(globe):
    settings = globe.config.render
    for cell, found in shortlist.make_shortlists(globe, range(globe.grid.total)).items():
        west, south, east, north = globe.grid.bounds_deg(cell)
        assert 1 <= len(found.places) <= 3
        for k, (lat, lon) in enumerate(found.places):
            assert globe.grid.find_cells(lat, lon) == cell
            if abs(lat) < 60.0:
                inset = settings.inset_cell
                assert min(lat - south, north - lat) >= (inset - 1e-9) * (north - south)
                assert (lon - west) % 360.0 >= (inset - 1e-9) * (east - west)
            for other in found.places[:k]:
                place = np.radians([lat, lon, *other])
                distance = np.degrees(angular_distance(*place))
                assert distance >= 0.97 * settings.separation_cell * globe.grid.step_deg


def test_chosen_places_respond_as_the_best_of_a_cell_s_own_ground_do(tycho, alone):
    """Both ways' places, each on a map grid about itself. Windows stand on other nodes: 10 %."""
    cells = tycho.grid.find_cells_in_bbox(-15.0, -46.0, -7.0, -40.0)
    swept = shortlist.make_shortlists(tycho, cells)
    assert not alone
    window = tycho.config.render.window_nodes
    best, agree = [], []
    for cell in cells.tolist():
        suns = compute_sun_products(
            sample_suns(tycho.config.render, tycho.grid.centre_deg(cell)[0])
        )

        def response(lat, lon, suns=suns):
            heights = tycho.mosaic.local_grid(
                tycho.projection(lat, lon), tycho.posting_m, window + 10
            )
            return compute_hessian_eigenvalue(blur_grid(heights)[5:-5, 5:-5], tycho.posting_m, suns)

        own = shortlist._search_cell(tycho, cell).places
        values = [response(*place) for place in swept[cell].places]
        best.append(values[0] / response(*own[0]))
        agree.append(np.mean(values) / np.mean([response(*place) for place in own]))
    assert min(best) > 0.9
    assert abs(np.median(best) - 1.0) < 0.02
    assert abs(np.mean(agree) - 1.0) < 0.03


def test_cells_beside_holes_have_their_own_ground(tmp_path, dems, alone):
    heights, affine = dems.rough_region(400)
    heights[150:155, 150:155] = -9999.0
    path = dems.write(tmp_path / "holed.tif", heights, affine=affine, nodata=-9999.0)
    context = context_of(Path(tmp_path), path, window_nodes=16)
    cells = context.grid.find_cells_in_bbox(14.0, 4.0, 26.0, 16.0)
    found = shortlist.make_shortlists(context, cells)
    hole = int(context.grid.find_cells(affine.f - 0.02 * 152.5, affine.c + 0.02 * 152.5))
    corner = int(context.grid.find_cells(affine.f - 0.3, affine.c + 0.3))
    inner = int(context.grid.find_cells(10.3, 22.0))
    assert {hole, corner} <= set(alone)
    assert inner not in alone
    assert found[inner].complete
    assert not found[corner].complete
    outside = [cell for cell in cells.tolist() if cell not in found]
    assert outside
    assert all(cut_cell_ground(context, cell) is None for cell in outside)
    for cell in (hole, corner, inner):
        assert same(shortlist.make_shortlists(context, [cell])[cell], found[cell])


def test_two_terrain_models_give_the_same_in_any_company(tmp_path, dems):
    rough = np.random.default_rng(6).normal(0.0, 800.0, (360, 720)).astype(np.float32)
    below = dems.write(tmp_path / "globe.tif", rough)
    above, _ = dems.rough_region(80)
    affine = Affine(0.5, 0.0, 160.0, 0.0, -0.5, 30.0)
    top = dems.write(tmp_path / "top.tif", above, affine=affine)
    context = context_of(
        Path(tmp_path), top, below, cell_deg=5.0, window_nodes=16, posting_m=15_000.0
    )
    cells = context.grid.find_cells_in_bbox(150.0, -20.0, -170.0, 40.0)
    whole = shortlist.make_shortlists(context, cells)
    for cell in cells[::7].tolist():
        assert same(shortlist.make_shortlists(context, [cell])[cell], whole[cell])


@pytest.mark.parametrize("cell_deg", [2.0, 10.0, 20.0, 45.0, 90.0])
def test_wide_cells_have_shortlists_too(tmp_path, dems, cell_deg):
    rough = np.random.default_rng(7).normal(0.0, 800.0, (180, 360)).astype(np.float32)
    path = dems.write(tmp_path / "globe.tif", rough)
    context = context_of(Path(tmp_path), path, cell_deg=cell_deg, window_nodes=16, candidates=2)
    found = shortlist.make_shortlists(context, range(context.grid.total))
    assert len(found) == context.grid.total
    for cell, one in list(found.items())[:: max(1, len(found) // 200)]:
        assert np.all(context.grid.find_cells(*one.places.T) == cell)
