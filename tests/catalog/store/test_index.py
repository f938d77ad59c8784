"""The nearest point through the grid of cells, against a search tree over all points."""

import numpy as np
import pytest
from scipy.spatial import cKDTree

from catalog.arrays import FloatArray, IntArray
from catalog.geometry.cells import CellGrid
from catalog.geometry.latlon import xyz_from_latlon
from catalog.store.index import CellIndex


def points_in(
    grid: CellGrid, cells: IntArray, rng: np.random.Generator
) -> tuple[FloatArray, FloatArray]:
    """A point anywhere in each cell, corners and edges among them (deg)."""
    box = np.array([grid.bounds_deg(int(cell)) for cell in cells])
    share = rng.choice([0.0, 1.0, 0.5, -1.0], (2, cells.size), p=[0.1, 0.1, 0.1, 0.7])
    share = np.where(share < 0.0, rng.random((2, cells.size)), share)
    lon = box[:, 0] + share[0] * (box[:, 2] - box[:, 0])
    return box[:, 1] + share[1] * (box[:, 3] - box[:, 1]), lon


def queries(rng: np.random.Generator, count: int) -> FloatArray:
    """Places all over the sphere, many at and about the poles and ±180°."""
    lat = np.degrees(np.arcsin(rng.uniform(-1.0, 1.0, count)))
    lon = rng.uniform(-180.0, 180.0, count)
    part = count // 10
    lat[:5], lat[5:10] = 90.0, -90.0
    lat[10:part] = 90.0 - rng.exponential(0.5, part - 10)
    lat[part : 2 * part] = -90.0 + rng.exponential(0.5, part)
    lon[2 * part : 3 * part] = rng.choice([-180.0, 179.9999, -179.9999, 179.5], part)
    lat[3 * part : 4 * part] = np.rint(lat[3 * part : 4 * part])
    return np.column_stack([lat, lon])


def check_against_tree(
    grid: CellGrid, cells: IntArray, places: FloatArray, rng: np.random.Generator
) -> None:
    lat, lon = points_in(grid, cells, rng)
    direction = xyz_from_latlon(np.radians(lat), np.radians(lon), 1.0)
    index = CellIndex(grid, cells, direction)
    wanted = xyz_from_latlon(np.radians(places[:, 0]), np.radians(places[:, 1]), 1.0)
    # points that are equally far to the last bits may change places: the distance must agree
    least, _ = cKDTree(direction).query(wanted)
    for place, vector, chord in zip(places, wanted, least):
        found = index.find_nearest_row(float(place[0]), float(place[1]))
        assert np.linalg.norm(direction[found] - vector) <= chord * (1.0 + 1e-12), place


def test_all_41252_cells_filled_agree_with_a_tree_on_10000_places() -> None:
    grid = CellGrid(1.0)
    rng = np.random.default_rng(11)
    check_against_tree(grid, np.arange(grid.total), queries(rng, 10_000), rng)


@pytest.mark.parametrize("step", [0.7, 3.0, 10.0, 45.0, 90.0])
@pytest.mark.parametrize("share", [1.0, 0.3, 0.02])
def test_grids_of_any_step_and_filling_agree_with_a_tree(step: float, share: float) -> None:
    grid = CellGrid(step)
    rng = np.random.default_rng(int(step * 10 + share * 100))
    count = max(1, int(share * grid.total))
    cells = np.sort(rng.choice(grid.total, count, replace=False))
    check_against_tree(grid, cells, queries(rng, 400), rng)


@pytest.mark.parametrize("where", [(-43.0, -11.0), (89.9, 0.0), (0.0, 179.95), (-89.9, 77.0)])
def test_a_region_is_found_from_everywhere(where: tuple[float, float]) -> None:
    """Cells of 0.1° within 2° of a place: most bands and cells of the sphere are empty."""
    grid = CellGrid(0.1)
    rng = np.random.default_rng(5)
    cells = grid.find_cells_within(*where, 2.0)
    check_against_tree(grid, cells, queries(rng, 300), rng)


def test_the_tree_agrees_with_comparing_every_point() -> None:
    """Beside the tests against the tree, one that needs none."""
    grid = CellGrid(20.0)
    rng = np.random.default_rng(8)
    cells = np.arange(grid.total)
    lat, lon = points_in(grid, cells, rng)
    direction = xyz_from_latlon(np.radians(lat), np.radians(lon), 1.0)
    index = CellIndex(grid, cells, direction)
    for place in queries(rng, 300):
        vector = xyz_from_latlon(*np.radians(place), 1.0)
        chords = np.linalg.norm(direction - vector, axis=1)
        assert chords[index.find_nearest_row(*place.tolist())] <= chords.min() * (1.0 + 1e-12)


def test_an_empty_index_has_no_nearest_point() -> None:
    nothing = np.empty(0, dtype=np.int64)
    assert CellIndex(CellGrid(1.0), nothing, np.empty((0, 3))).find_nearest_row(0.0, 0.0) == -1
