"""Small catalogs made of invented ground: seeded noise at several scales, holes where wanted."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import pytest

from catalog.arrays import Float32Array
from catalog.control_point import SHADOW_AZIMUTHS, ControlPoint, Flag, Patch
from catalog.geometry.cells import CellGrid
from catalog.store.manifest import CatalogMeta
from catalog.store.writer import Written
from tests.catalog.store.written import write_points

RADIUS_M = 1737400.0
POSTING_M = 118.45
STEP_M = 0.5
SIZE = 32
LEVELS = 3
CREATED = "2026-01-02T03:04:05Z"


def rough_ground(rng: np.random.Generator, size: int, relief_m: float) -> Float32Array:
    """Heights (size, size): white noise smoothed at three scales."""
    total = np.zeros((size, size))
    for sigma, share in ((1.5, 0.1), (4.0, 0.3), (12.0, 1.0)):
        noise = cv2.GaussianBlur(rng.normal(size=(size, size)), (0, 0), sigma)
        total += share * noise / noise.std()
    return (relief_m * total).astype(np.float32)


def make_point(rng: np.random.Generator, cell: int, grid: CellGrid, levels: int) -> ControlPoint:
    """A point somewhere in its cell with an invented certificate."""
    west, south, east, north = grid.bounds_deg(cell)
    usable = bool(rng.random() < 0.7)
    return ControlPoint(
        id=cell,
        lat_deg=rng.uniform(south, north),
        lon_deg=rng.uniform(west, east),
        radius_m=RADIUS_M + rng.normal(0.0, 2000.0),
        localisation_nodes=rng.uniform(0.02, 0.5),
        hessian_eigenvalue=float(10.0 ** rng.uniform(-3.0, 2.0)),
        recognition_rate=int(rng.integers(6)) / 5.0,
        trials=5,
        uniqueness=tuple(rng.uniform(0.0, 1.0, levels)),
        shadow_limit_deg=tuple(rng.uniform(0.0, 40.0, SHADOW_AZIMUTHS)),
        usable=usable,
        flags=Flag.NONE if usable else Flag(int(rng.integers(1, 64))),
        source="first.tif" if rng.random() < 0.8 else "zweite Höhe.tif",
    )


@dataclass(frozen=True)
class World:
    """What a test catalog was made from."""

    meta: CatalogMeta
    points: list[tuple[ControlPoint, tuple[Patch, ...]]]

    def write(self, path: Path) -> Written:
        """The catalog file of this world."""
        return write_points(path, self.meta, self.points)


def make_world(
    seed: int = 7, count: int = 12, cell_deg: float = 10.0, size: int = SIZE, levels: int = LEVELS
) -> World:
    """Some random cells with a point each."""
    rng = np.random.default_rng(seed)
    grid = CellGrid(cell_deg)
    points = []
    for cell in sorted(rng.choice(grid.total, count, replace=False).tolist()):
        patches = []
        for level in range(levels):
            heights = rough_ground(rng, size, 200.0 * 2**level)
            if cell % 3 == 0:
                heights[: size // 4, : size // 3] = np.nan
            patches.append(Patch(POSTING_M * 2**level, heights))
        points.append((make_point(rng, cell, grid, levels), tuple(patches)))
    meta = CatalogMeta(
        body="moon",
        radius_m=RADIUS_M,
        cell_deg=cell_deg,
        levels=levels,
        size=size,
        posting_m=POSTING_M,
        height_step_m=STEP_M,
        sources={"first.tif": "sha256 00", "zweite Höhe.tif": "sha256 11"},
        config='[body]\nname = "moon"\n',
        software="optnav test",
        created_utc=CREATED,
    )
    return World(meta, points)


@pytest.fixture(scope="session")
def make() -> Callable[..., World]:
    return make_world


@pytest.fixture(scope="session")
def world() -> World:
    return make_world()


@pytest.fixture(scope="session")
def written(world: World, tmp_path_factory: pytest.TempPathFactory) -> Written:
    """A catalog that tests only read."""
    return world.write(tmp_path_factory.mktemp("catalog") / "whole.gpkg")


@pytest.fixture
def catalog_copy(written: Written, tmp_path: Path) -> Path:
    """A catalog that a test may damage."""
    copy = tmp_path / "copy.gpkg"
    copy.write_bytes(written.path.read_bytes())
    return copy
