"""The catalog file at full size: 41 252 points of five levels of 80 nodes of real terrain.

All times are of the processor, so that other work on the machine does not count.
"""

import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
import rasterio
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from catalog.bodies.body import load_body
from catalog.config import resource
from catalog.control_point import SHADOW_AZIMUTHS, ControlPoint, Patch
from catalog.geometry.cells import CellGrid
from catalog.geometry.latlon import xyz_from_latlon
from catalog.inspect.compare import compare
from catalog.inspect.export import export
from catalog.pipeline.config import WriteSettings
from catalog.store.codec import encode
from catalog.store.manifest import CatalogMeta
from catalog.store.patches import prepare_point
from catalog.store.reader import Catalog
from catalog.store.relief import prepare_relief
from catalog.store.verify import verify
from catalog.store.writer import write_catalog
from catalog.terrain.relief.sums import load_relief
from tests.bench.global_moon.clock import run
from tests.bench.timing import best, result, sized, within

pytestmark = pytest.mark.bench

LEVELS, SIZE, POSTING_M = 5, 80, 118.45
STEPS_M = WriteSettings().steps_m([POSTING_M * 2**level for level in range(LEVELS)])
LARGER = 96  # nodes a side, of which the file's size is told as well
EVERY, NEAREST, LOADED = sized((1, 5000, 400), (300, 50, 20))  # cell; queries; patches read
SITES = sized(60, 3)  # different places that the points' patches are taken from
GIGABYTE = 1e9
# what the figures ask for
OPEN_MS, NEAREST_US, CELL_US, LOAD_MS, FILE_GB = 100.0, 20.0, 5.0, 0.3, 1.5
RELIEF_MB, RELIEF_S, INFO_S = 40.0, 0.5, 0.3


def ground_of_sites(size: int = SIZE) -> list[list[NDArray[np.float32]]]:
    """Heights of all levels at places about Tycho: area means of the bundled 118 m DEM.

    size  nodes a side
    The coarsest levels reach over its border; there its mirror image goes on.
    """
    with rasterio.open(resource("data/tycho_gld100_256ppd.tif")) as source:
        ground = source.read(1).astype(np.float32)
    reach = size * 2 ** (LEVELS - 1) // 2
    ground = np.pad(ground, reach, mode="reflect")
    rng = np.random.default_rng(1)
    sites = []
    for _ in range(SITES):
        row, col = (int(rng.integers(reach, n - reach)) for n in ground.shape)
        levels = []
        for level in range(LEVELS):
            half = size * 2**level // 2
            part = ground[row - half : row + half, col - half : col + half]
            blocks = part.reshape(size, 2**level, size, 2**level)
            levels.append(blocks.mean(axis=(1, 3), dtype=np.float64).astype(np.float32))
        sites.append(levels)
    return sites


def points() -> Iterator[tuple[ControlPoint, list[Patch]]]:
    grid = CellGrid(1.0)
    rng = np.random.default_rng(2)
    sites = ground_of_sites()
    for cell in range(0, grid.total, EVERY):
        west, south, east, north = grid.bounds_deg(cell)
        # turned and mirrored, so that no two neighbours are alike
        turn, mirror = int(rng.integers(4)), int(rng.integers(2))
        grids = [np.rot90(h, turn)[:, :: 1 - 2 * mirror] for h in sites[cell // EVERY % SITES]]
        patches = [Patch(POSTING_M * 2**i, np.ascontiguousarray(h)) for i, h in enumerate(grids)]
        point = ControlPoint(
            cell, rng.uniform(south, north), rng.uniform(west, east),
            1737400.0 + float(grids[0][40, 40]), rng.uniform(0.02, 0.3), rng.uniform(0.1, 3.0), 1.0,
            5, tuple(rng.uniform(0.1, 0.9, LEVELS)), tuple(rng.uniform(0, 30, SHADOW_AZIMUTHS)),
            True, source="gld100",
        )  # fmt: skip
        yield point, patches


def packed_bytes(size: int) -> float:
    """Mean bytes of a point's compressed heights: real terrain, so of real entropy."""
    sites = ground_of_sites(size)
    packed = (
        len(encode(grid, step)[0].data)
        for site in sites
        for grid, step in zip(site, STEPS_M, strict=True)
    )
    return sum(packed) / len(sites)


def seconds(call: Callable[[], object]) -> float:
    """Processor time of a call."""
    started = time.process_time()
    call()
    return time.process_time() - started


def command_seconds(*words: str) -> float:
    """Processor time of a command of Python with its start, the median of some runs."""
    command = [sys.executable, *words]
    return float(
        np.median([run(command, stdout=subprocess.DEVNULL).cpu_s for _ in range(sized(9, 1))])
    )


def test_speed_and_size_of_a_global_catalog(tmp_path: Path) -> None:
    path = tmp_path / "moon.gpkg"
    meta = CatalogMeta("moon", 1737400.0, 1.0, LEVELS, SIZE, POSTING_M, STEPS_M[0])
    started = time.process_time()
    prepared = (prepare_point(point, patches, STEPS_M) for point, patches in points())
    written = write_catalog(path, meta, prepared)
    write_s = time.process_time() - started
    open_ms = 1e3 * best(lambda: Catalog.open(path).close(), 5)
    with Catalog.open(path) as catalog:
        rng = np.random.default_rng(3)
        lat = np.degrees(np.arcsin(rng.uniform(-1, 1, NEAREST))).tolist()
        lon = rng.uniform(-180, 180, NEAREST).tolist()
        catalog.nearest(0.0, 0.0)  # compiles
        near = best(lambda: [catalog.nearest(a, b) for a, b in zip(lat, lon)], 3) / NEAREST * 1e6
        tree = cKDTree(catalog.direction)
        places = [xyz_from_latlon(*np.radians((a, b)), 1.0) for a, b in zip(lat, lon)]
        by_tree = best(lambda: [tree.query(place) for place in places], 3) / NEAREST * 1e6
        ids = [int(i) for i in rng.choice(catalog.ids, LOADED, replace=False)]
        cell = best(lambda: [catalog.find_row(i) for i in ids], 3) / LOADED * 1e6
        load = best(lambda: [catalog.patches(i) for i in ids], 5) / LOADED * 1e3
        data = b"".join(catalog.patches(i)[0].heights_m.tobytes() for i in ids)
        layers = {
            ending: seconds(lambda place=tmp_path / f"layer.{ending}": export(catalog, place))
            for ending in ("gpkg", "geojson", "csv")
        }
    info_s = command_seconds("-m", "optnav_cli.main", "catalog", "info", str(path))
    numpy_s = command_seconds("-c", "import numpy")
    verify_s = seconds(lambda: verify(path))
    compare_s = seconds(lambda: compare(path, path))
    packed, larger = packed_bytes(SIZE), packed_bytes(LARGER)
    raw = 4.0 * LEVELS * SIZE * SIZE * written.count
    copy_ms = 1e3 * best(lambda: bytearray(data), 5) / LOADED * LEVELS
    size = written.size_bytes / GIGABYTE
    catalog_of = f"catalog of {written.count} points"
    result(
        f"{catalog_of}, {LEVELS} levels, steps of {STEPS_M[0]:.2f} to {STEPS_M[-1]:.2f} m: "
        f"{SIZE} nodes, {LARGER} nodes",
        f"{size:.2f} GB, {size * larger / packed:.2f} GB",
        f"{written.size_bytes / raw:.3f} of its float32 heights; {packed:.0f} and {larger:.0f} "
        f"bytes a point, the mean of {SITES} real places about Tycho; limit {FILE_GB:g} GB",
    )
    result(
        f"{catalog_of}: written, opened",
        f"{write_s:.1f} s, {open_ms:.2f} ms",
        f"{raw / GIGABYTE / write_s:.2f} GB of heights a second; limit {OPEN_MS:g} ms to open",
    )
    result(
        f"{catalog_of}: nearest, row of a point, patches of a point",
        f"{near:.2f} μs, {cell:.2f} μs, {load:.3f} ms",
        f"{near / by_tree:.2f} × scipy's cKDTree, {load / copy_ms:.0f} × a copy of the heights; "
        f"limits {NEAREST_US:g} μs, {CELL_US:g} μs, {LOAD_MS:g} ms",
    )
    result(
        "`optnav catalog info` of it, the whole command",
        f"{info_s:.2f} s",
        f"limit {INFO_S:g} s; `python -c 'import numpy'` beside it {numpy_s:.2f} s",
    )
    result(
        f"{catalog_of}: verified, compared, exported to " + ", ".join(layers),
        f"{verify_s:.1f} s, {compare_s:.1f} s, "
        + ", ".join(f"{took:.1f} s" for took in layers.values()),
    )
    assert within(size, FILE_GB)
    assert within(open_ms, OPEN_MS)
    assert within(near, NEAREST_US)
    assert within(cell, CELL_US)
    assert within(load, LOAD_MS)
    assert within(info_s, INFO_S)


def test_speed_and_size_of_a_relief(tmp_path: Path, shared_data: Callable[[str], Path]) -> None:
    """The real Moon at 16 cells a degree in a catalog without points; small: at 2."""
    bundled = "bundled:moon_gld100_4ppd.tif"
    dem = sized(lambda: shared_data("moon/moon_gld100_32ppd.tif"), lambda: bundled)()
    load_relief(bundled, load_body("moon"))  # compiles
    start = time.process_time()
    relief = load_relief(str(dem), load_body("moon"))
    made = time.process_time() - start
    meta = CatalogMeta("moon", relief.radius_m, 1.0, LEVELS, SIZE, POSTING_M, STEPS_M[0])
    plain = write_catalog(tmp_path / "plain.gpkg", meta, [])
    written = write_catalog(tmp_path / "c.gpkg", meta, [], relief=prepare_relief(relief))
    with Catalog.open(written.path) as catalog:
        start = time.process_time()
        catalog.relief()
        read = time.process_time() - start
    size = (written.size_bytes - plain.size_bytes) / 1e6
    result(
        f"relief of the Moon at {relief.posting_m:.0f} m: in the file, read, averaged from 948 m",
        f"{size:.1f} MB, {read:.2f} s, {made:.2f} s",
        f"limits {RELIEF_MB:g} MB, {RELIEF_S:g} s to read",
    )
    assert size <= RELIEF_MB
    assert within(read, RELIEF_S)
