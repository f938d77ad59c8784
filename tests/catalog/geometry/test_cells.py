"""The grid of cells against brute force over the sphere."""

import numpy as np
import pytest

from catalog.geometry.cells import CellGrid
from catalog.geometry.latlon import angular_distance, latlon_from_xyz

STEPS = [0.1, 0.25, 0.7, 1.0, 7.0, 13.0, 45.0, 90.0]


def anywhere(rng, count):
    lat, lon, _ = latlon_from_xyz(rng.normal(size=(count, 3)))
    lat, lon = np.degrees(lat), np.degrees(lon)
    edges_lat = [90.0, -90.0, 90.0, -90.0, 0.0, 0.0, 0.0, 89.99, -89.99, 45.0]
    edges_lon = [0.0, 0.0, 180.0, -180.0, -180.0, 180.0, 179.9999999, 180.0, -180.0, 0.0]
    return np.concatenate([lat, edges_lat]), np.concatenate([lon, edges_lon])


def test_one_degree_gives_the_41252_control_points_of_the_seed():
    assert CellGrid(1.0).total == 41252
    assert CellGrid(1.0).bands == 180


@pytest.mark.parametrize("step", STEPS)
def test_a_point_lies_within_the_bounds_of_its_cell(step):
    grid = CellGrid(step)
    lat, lon = anywhere(np.random.default_rng(6), 500)
    cells = grid.find_cells(lat, lon)
    assert cells.min() >= 0
    assert cells.max() < grid.total
    for la, lo, cell in zip(lat, lon, cells, strict=True):
        west, south, east, north = grid.bounds_deg(int(cell))
        assert south - 1e-9 <= la <= north + 1e-9
        # bounds of a band's last cell end at +180, the same meridian as -180
        assert (lo - west) % 360.0 <= east - west + 1e-9 or (west - lo) % 360.0 < 1e-9


@pytest.mark.parametrize("step", STEPS)
def test_bounds_of_many_cells_are_those_of_each(step):
    grid = CellGrid(step)
    cells = np.unique(np.linspace(0, grid.total - 1, 500).astype(np.int64))
    np.testing.assert_array_equal(
        grid.compute_bounds_deg(cells).T, [grid.bounds_deg(int(cell)) for cell in cells]
    )
    assert grid.find_bands(cells).tolist() == [grid.find_band(int(cell)) for cell in cells]


@pytest.mark.parametrize("step", STEPS)
def test_the_middle_of_every_cell_lies_in_that_cell(step):
    grid = CellGrid(step)
    rng = np.random.default_rng(7)
    cells = np.unique(
        np.concatenate(
            [[0, grid.total - 1], rng.integers(0, grid.total, 300), grid.first_cell[:-1]]
        )
    )
    for cell in cells:
        assert grid.find_cells(*grid.centre_deg(int(cell))) == cell


def test_cells_tile_the_sphere_with_areas_of_about_the_same_size():
    grid = CellGrid(1.0)
    total = 0.0
    areas = []
    for cell in range(0, grid.total):
        west, south, east, north = grid.bounds_deg(cell)
        strip = np.sin(np.radians(north)) - np.sin(np.radians(south))
        areas.append(np.radians(east - west) * strip)
        total += areas[-1]
    assert total == pytest.approx(4.0 * np.pi, rel=1e-9)
    # the three cells about a pole are the odd ones
    middle = np.array(areas[3:-3])
    assert middle.max() / middle.min() < 1.25


@pytest.mark.parametrize("turns", [-720.0, -360.0, 360.0, 1080.0])
def test_longitudes_of_any_turn_name_the_same_cell(turns):
    grid = CellGrid(1.0)
    lat, lon = np.array([-43.3, 12.2, 80.4]), np.array([-11.37, 179.63, -0.41])
    assert (grid.find_cells(lat, lon + turns) == grid.find_cells(lat, lon)).all()


@pytest.mark.parametrize("step", [0.7, 1.0, 7.0, 45.0, 90.0])
def test_within_finds_every_cell_that_holds_a_point_near_enough(step):
    grid = CellGrid(step)
    rng = np.random.default_rng(8)
    lat, lon = anywhere(rng, 2000)
    cells = grid.find_cells(lat, lon)
    places = [
        (90.0, 0.0),
        (-90.0, 10.0),
        (0.0, 180.0),
        (0.0, -180.0),
        (89.5, -180.0),
        (-89.2, 77.0),
    ]
    places += [
        (float(np.degrees(np.arcsin(s))), float(o))
        for s, o in zip(rng.uniform(-1, 1, 25), rng.uniform(-180, 180, 25), strict=True)
    ]
    for centre_lat, centre_lon in places:
        for radius in (0.0, 0.3, 2.0, 20.0, 89.0, 91.0, 180.0):
            found = grid.find_cells_within(centre_lat, centre_lon, radius)
            assert (np.diff(found) > 0).all()
            away = np.degrees(
                angular_distance(
                    *np.radians([centre_lat, centre_lon]), np.radians(lat), np.radians(lon)
                )
            )
            assert np.isin(cells[away <= radius], found).all()


def test_within_is_not_the_whole_sphere():
    grid = CellGrid(1.0)
    assert len(grid.find_cells_within(0.0, 180.0, 2.0)) < 50
    assert len(grid.find_cells_within(60.0, 0.0, 2.0)) < 70
    assert len(grid.find_cells_within(90.0, 0.0, 2.0)) < 40


def test_a_circle_of_no_size_is_one_cell_or_its_direct_neighbours():
    grid = CellGrid(1.0)
    assert int(grid.find_cells(12.3, 45.6)) in grid.find_cells_within(12.3, 45.6, 0.0)


@pytest.mark.parametrize("turn", [-360.0, 0.0, 360.0])
def test_within_takes_longitudes_of_any_turn(turn):
    grid = CellGrid(1.0)
    assert (
        grid.find_cells_within(30.0, 179.5 + turn, 3.0) == grid.find_cells_within(30.0, 179.5, 3.0)
    ).all()


def test_a_box_across_the_antimeridian_is_the_two_boxes_at_its_sides():
    grid = CellGrid(1.0)
    across = grid.find_cells_in_bbox(170.0, -20.0, -165.0, 10.0)
    east = grid.find_cells_in_bbox(170.0, -20.0, 180.0, 10.0)
    west = grid.find_cells_in_bbox(-180.0, -20.0, -165.0, 10.0)
    assert sorted([*east, *west]) == across.tolist()
    for cell in across:
        lat, lon = grid.centre_deg(int(cell))
        assert -20.0 <= lat <= 10.0
        assert lon >= 170.0 or lon <= -165.0


@pytest.mark.parametrize(
    "box", [(-180.0, -90.0, 180.0, 90.0), (0.0, -90.0, 360.0, 90.0), (-10.0, -90.0, 350.0, 90.0)]
)
@pytest.mark.parametrize("step", [1.0, 7.0, 90.0])
def test_a_box_of_all_longitudes_holds_every_cell(box, step):
    grid = CellGrid(step)
    assert grid.find_cells_in_bbox(*box).tolist() == list(range(grid.total))


def test_a_box_agrees_with_a_look_at_every_cell():
    grid = CellGrid(7.0)
    for west, south, east, north in [(-60, -50, 40, 33), (100, -90, -100, 90), (350, 60, 20, 90)]:
        wanted = []
        for cell in range(grid.total):
            w, s, e, n = grid.bounds_deg(cell)
            lat, lon = (s + n) / 2.0, (w + e) / 2.0
            if south <= lat <= north and (lon - west) % 360.0 <= (east - west) % 360.0:
                wanted.append(cell)
        assert grid.find_cells_in_bbox(west, south, east, north).tolist() == wanted


@pytest.mark.parametrize("step", [0.0, -1.0, 90.1, np.inf, np.nan])
def test_a_step_that_is_none_is_refused(step):
    with pytest.raises(ValueError, match="cell step"):
        CellGrid(step)


def test_a_step_of_a_thousandth_degree_is_still_exact():
    grid = CellGrid(0.001)
    rng = np.random.default_rng(9)
    lat, lon = anywhere(rng, 50)
    for cell in grid.find_cells(lat, lon):
        assert grid.find_cells(*grid.centre_deg(int(cell))) == cell
