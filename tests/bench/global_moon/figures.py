"""What a catalog of the whole Moon can do: size, speed of reading, what was rejected and why."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from catalog.arrays import FloatArray
from catalog.geometry.latlon import xyz_from_latlon
from catalog.store.reader import Catalog
from tests.bench.timing import best

OPEN_MS, NEAREST_US, CELL_US, LOAD_MS, FILE_GB = 100.0, 20.0, 5.0, 0.3, 1.5
RANDOM_PLACES = 10_000
PLACES_AT_ONCE = 200  # brute force: a matrix of these times all points


def catalog_lines(path: Path, whole: bool) -> Iterator[str]:
    """The figures of a catalog; of a strip no agreement is asked of places far from it."""
    open_ms = 1e3 * best(lambda: Catalog.open(path).close(), 5)
    with Catalog.open(path) as catalog:
        rng = np.random.default_rng(3)
        size_gb = path.stat().st_size / 1e9
        yield (
            f"catalog: {len(catalog)} points, {catalog.meta.levels} levels of {catalog.meta.size} "
            f"nodes, height step {catalog.meta.height_step_m:g} m"
        )
        limit = f"{size_gb / FILE_GB:5.2f} of the limit" if whole else ""
        yield f"  size       {size_gb:9.3f} GB  {limit}"
        yield f"  open       {open_ms:9.2f} ms  {open_ms / OPEN_MS:5.2f} of the limit"
        lat, lon = places(rng, 5000)
        pairs = list(zip(lat.tolist(), lon.tolist()))
        near_us = 1e6 * best(lambda: [catalog.nearest(*pair) for pair in pairs], 3) / len(pairs)
        yield f"  nearest    {near_us:9.2f} us  {near_us / NEAREST_US:5.2f} of the limit"
        ids = [int(i) for i in rng.choice(catalog.ids, min(400, len(catalog)), replace=False)]
        cell_us = 1e6 * best(lambda: [catalog.find_row(i) for i in ids], 3) / len(ids)
        yield f"  row_of     {cell_us:9.2f} us  {cell_us / CELL_US:5.2f} of the limit"
        load_ms = 1e3 * best(lambda: [catalog.patches(i) for i in ids], 5) / len(ids)
        yield f"  a point's patches {load_ms:.3f} ms  {load_ms / LOAD_MS:5.2f} of the limit, warm"
        lat, lon = places(rng, RANDOM_PLACES)
        wrong = disagreements(catalog, lat, lon)
        yield f"  nearest against brute force: {wrong} of {lat.size} places differ"


def places(rng: np.random.Generator, count: int) -> tuple[FloatArray, FloatArray]:
    """Random places (deg), with the poles, both sides of ±180° and their corners among them."""
    lat = np.degrees(np.arcsin(rng.uniform(-1.0, 1.0, count)))
    lon = rng.uniform(-180.0, 180.0, count)
    edge = count // 20
    lat[:edge], lat[edge : 2 * edge] = 90.0, -90.0
    lat[0:edge:2] -= rng.uniform(0.0, 1.0, lat[0:edge:2].size)
    lat[edge : 2 * edge : 2] += rng.uniform(0.0, 1.0, lat[edge : 2 * edge : 2].size)
    lon[2 * edge : 3 * edge] = rng.choice([-180.0, 180.0], edge)
    lon[3 * edge : 4 * edge] = 180.0 + rng.uniform(-0.5, 0.5, edge)
    return lat, lon


def disagreements(catalog: Catalog, lat: FloatArray, lon: FloatArray) -> int:
    """Places (deg) whose nearest point is not at the least angle over all points."""
    asked = xyz_from_latlon(np.radians(lat), np.radians(lon), 1.0)
    wrong = 0
    for first in range(0, lat.size, PLACES_AT_ONCE):
        part = slice(first, first + PLACES_AT_ONCE)
        cosines = asked[part] @ catalog.direction.T
        # a cosine is blind to small angles: chords decide among the nearest few
        few = np.argpartition(-cosines, min(4, len(catalog) - 1), axis=1)[:, :5]
        chords = np.linalg.norm(asked[part][:, None] - catalog.direction[few], axis=2)
        for i, place in enumerate(zip(lat[part], lon[part])):
            row = int(catalog.ids.searchsorted(catalog.nearest(float(place[0]), float(place[1]))))
            found = np.linalg.norm(asked[part][i] - catalog.direction[row])
            wrong += bool(found > chords[i].min() + 1e-12)
    return wrong


def digest_of(path: Path) -> str:
    """The content digest that a catalog states."""
    with Catalog.open(path) as catalog:
        return catalog.digest
