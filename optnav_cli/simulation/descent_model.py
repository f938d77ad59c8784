"""The terrain model of a descent's own ground, as a survey from orbit would have made it.

Its heights are means of the true ground over blocks of its posting, and wrong by a little, over one
to two postings. So the truth is richer than the model in all that is below its posting.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import cv2
import msgspec
import numpy as np
from affine import Affine
from msgspec import Meta
from rasterio.crs import CRS
from rasterio.io import MemoryFile

from catalog.arrays import Float32Array
from catalog.bodies.body import Body
from catalog.errors import ConfigError
from catalog.geometry.latlon import latlon_from_xyz
from optnav_cli.simulation.exposure import Exposure
from optnav_cli.simulation.region_ground import Box, truth_terrain
from optnav_cli.simulation.scenario_base import ScenarioBase

MODEL = "model.tif"
SMOOTH_POSTINGS = 0.6  # sigma of what smooths a model's error: 1-2 postings wide
BLOCK = 2  # nodes of the truth along a side of a model's posting
MODEL_STREAM = 43  # of random numbers, apart from those of pictures


class ModelSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """A terrain model that is written with the pictures, as MODEL.

    posting_m  of which a whole number fit into that of the first [[dem]], so rounded
    error_m    rms of its heights
    margin_km  how far it goes to all sides of the way
    """

    posting_m: Annotated[float, Meta(ge=0.1, le=1e5)] = 12.0
    error_m: Annotated[float, Meta(ge=0.0, le=1e3)] = 1.0
    margin_km: Annotated[float, Meta(gt=0.0, le=1e3)] = 6.0


def surveyed_model(
    settings: ModelSettings, scenario: ScenarioBase, body: Body, flight: Sequence[Exposure]
) -> bytes:
    """The model under a flight as GeoTIFF, in steps of longitude and latitude.

    Raises ConfigError for a posting that is not below that of the first terrain model, or for
    more ground than a scene may hold.
    """
    terrain = truth_terrain(scenario, body, flight)
    if settings.posting_m > 0.75 * terrain.posting_m:
        raise ConfigError(
            f"[model] posting_m is {settings.posting_m:g}; wanted less than three quarters of the "
            f"{terrain.posting_m:.0f} m of the first [[dem]], below which the truth is richer"
        )
    seed = next(iter(scenario.detail.seeds), None)
    factor = BLOCK * round(terrain.posting_m / settings.posting_m)
    true = terrain.window(seed, factor, _box(flight, 1e3 * settings.margin_km, body.radius_m))
    rows, cols = (n // BLOCK for n in true.heights.shape)
    blocks = true.heights[: BLOCK * rows, : BLOCK * cols].reshape(rows, BLOCK, cols, BLOCK)
    rng = np.random.default_rng([scenario.seed, MODEL_STREAM])
    heights = blocks.mean(axis=(1, 3), dtype=np.float64).astype(np.float32)
    heights += model_error(heights.shape, settings.error_m, rng)
    # the file's origin is the corner of its first pixel
    north, west = true.north + 0.5 * true.step_lat, true.west - 0.5 * true.step_lon
    steps = (BLOCK * true.step_lon, BLOCK * true.step_lat)
    left, top, right, down = (float(np.degrees(v)) for v in (west, north, *steps))
    pixel_to_degrees = Affine(right, 0.0, left, 0.0, -down, top)
    return geotiff(
        heights, CRS.from_proj4(f"+proj=longlat +R={body.radius_m} +no_defs"), pixel_to_degrees
    )


def model_error(shape: tuple[int, ...], rms_m: float, rng: np.random.Generator) -> Float32Array:
    """Errors (rows, cols) of a model's heights, m, that are one to two postings wide."""
    noise = rng.normal(size=shape).astype(np.float32)
    noise = np.asarray(cv2.GaussianBlur(noise, (0, 0), SMOOTH_POSTINGS), np.float32)
    error: Float32Array = noise * np.float32(rms_m / float(noise.std()))
    return error


def geotiff(heights: Float32Array, crs: object, transform: object) -> bytes:
    """Heights (rows, cols) as a GeoTIFF."""
    profile = {"crs": crs, "transform": transform, "dtype": "float32", "count": 1}
    size = {"height": heights.shape[0], "width": heights.shape[1]}
    with MemoryFile() as memory:
        with memory.open(driver="GTiff", compress="deflate", **profile, **size) as made:
            made.write(heights, 1)
        data: bytes = memory.read()
    return data


def write_model(
    settings: ModelSettings,
    scenario: ScenarioBase,
    body: Body,
    flight: Sequence[Exposure],
    folder: Path,
) -> None:
    """Put the model into a folder of pictures."""
    (folder / MODEL).write_bytes(surveyed_model(settings, scenario, body, flight))


def _box(flight: Sequence[Exposure], margin_m: float, radius_m: float) -> Box:
    """The box about the ground below a flight."""
    lat, lon, _ = latlon_from_xyz(np.array([exposure.position_m for exposure in flight]))
    lon = lon[-1] + np.mod(lon - lon[-1] + np.pi, 2.0 * np.pi) - np.pi
    margin = margin_m / radius_m
    wide = margin / float(np.cos(np.abs(lat).max() + margin))
    west, east = float(lon.min() - wide), float(lon.max() + wide)
    return west, float(lat.min() - margin), east, float(lat.max() + margin)
