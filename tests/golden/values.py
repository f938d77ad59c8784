"""Golden values: renders of a small window of Tycho, and SURF descriptors of one of them."""

from pathlib import Path

import numpy as np
import rasterio

from catalog.arrays import Float32Array
from catalog.bodies.body import load_body
from catalog.config import resource
from catalog.correlation.surf64 import compute_descriptors
from catalog.photometry.laws import find_law
from catalog.rendering.map_view import render_map

PLACE = Path(__file__).with_name("values.npz")
LAWS = ("hapke", "lunar_lambert")
# east, north, up: a low Sun in the north-west and a higher one in the west
SUNS = {"low": (-0.69, 0.63, 0.31), "high": (-0.75, 0.05, 0.66)}
FIRST_ROW, FIRST_COL, NODES = 1360, 1440, 64  # the central peak
POSTING_M = 118.45
CELL_PX, CORNERS = 8, (16, 24, 32, 40, 47)  # squares of 32 nodes about these rows and columns


def window() -> Float32Array:
    """The heights that are rendered (64, 64), m; the map's own pixels, taken as square."""
    with rasterio.open(resource("data/tycho_gld100_256ppd.tif")) as source:
        place = rasterio.windows.Window(FIRST_COL, FIRST_ROW, NODES, NODES)
        return np.asarray(source.read(1, window=place), np.float32)


def golden_values() -> dict[str, Float32Array]:
    """Everything that is frozen, by name: "hapke_low", ..., "surf"."""
    radius = load_body("moon").radius_m
    heights = window()
    values = {
        f"{law}_{name}": render_map(heights, POSTING_M, sun, radius_m=radius, law=find_law(law))
        for law in LAWS
        for name, sun in SUNS.items()
    }
    rows, cols = (grid.ravel() for grid in np.meshgrid(CORNERS, CORNERS, indexing="ij"))
    values["surf"] = compute_descriptors(values["hapke_high"], rows, cols, CELL_PX)
    return values


def freeze(path: Path = PLACE) -> None:
    """Write the values of today."""
    np.savez_compressed(path, **golden_values())


def frozen(path: Path = PLACE) -> dict[str, Float32Array]:
    """The values as they were frozen."""
    with np.load(path) as held:
        return {name: held[name] for name in held.files}
