"""Fields of synthetic ground for the study of hazard maps: drawn to 0.5 m, judged on a 2 m model.

Two grounds, both of craters from 400 m down to 1.5 m on random relief: "rough", of which 38 % lie
above 7 deg and 4-6 % above 15 deg, as where Luna-25 was to land, and "even", 16 %.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np

from catalog.arrays import BoolArray, Float32Array, FloatArray
from catalog.geometry.projection import Stereographic
from catalog.geometry.vectors import unit
from catalog.rendering.map_view import render_map
from catalog.terrain.slopes import (
    BASE_M,
    CRITICAL_DEG,
    DANGEROUS_DEG,
    compute_slope_components,
    convert_to_degrees,
)
from catalog.terrain.synthetic.relief import SyntheticRelief
from optnav_cli.camera.camera import Camera
from optnav_cli.frames.picture import Picture
from optnav_cli.hazard.ground_view import PictureOnGround, average_boxes, resize_grid
from optnav_cli.simulation.sections import SensorSettings
from optnav_cli.simulation.sensor import expose

RADIUS_M = 1737400.0
SITE = Stereographic(math.radians(-70.0), math.radians(44.0), RADIUS_M)  # near Luna-25's
DRAWN_M, CELL_M, JUDGED_M = 0.5, 1.0, 2.0
NODES = 3280  # 1.64 km
LARGEST_M, SMALLEST_M, HURST = 400.0, 1.5, 0.9
ALBEDO_M, ALBEDO_OCTAVES = 2.0, 8  # shortest wave, and how many octaves have an equal share
SNR, READ_SHARE, BLUR_CELLS = 100.0, 0.003, 0.4
FAR_M = 1e7  # of a camera that sees all of a field under one angle
GOLDEN_DEG = 137.508  # between the Sun's azimuths of fields: any direction
SENSOR = SensorSettings(bits=12)


class GroundKind(NamedTuple):
    """Of synthetic ground: its random relief and its craters."""

    rms_slope_deg: float
    saturation: float


KINDS = {"rough": GroundKind(8.2, 0.02), "even": GroundKind(6.4, 0.008)}


@dataclass(frozen=True, eq=False)
class GroundField:
    """A field, square, and what is true of it.

    heights      (n, n) m, posting DRAWN_M
    degrees      (m, m) slopes on the judged model, posting JUDGED_M
    """

    kind: str
    seed: int
    heights: Float32Array
    degrees: Float32Array

    def azimuth_deg(self) -> float:
        """Where its Sun stands."""
        return self.seed * GOLDEN_DEG % 360.0

    def share_above(self, limit_deg: float) -> float:
        return float((self.degrees[2:-2, 2:-2] > limit_deg).mean())


def make_field(kind: str, seed: int, nodes: int = NODES, posting_m: float = DRAWN_M) -> GroundField:
    """The field of a seed."""
    rough = KINDS[kind]
    relief = SyntheticRelief(
        seed,
        0.5 * LARGEST_M,
        RADIUS_M,
        SMALLEST_M,
        rough.rms_slope_deg,
        HURST,
        rough.saturation,
    )
    heights = relief.sample_local(SITE, posting_m, nodes)
    many = round(JUDGED_M / posting_m)
    judged = resize_grid(heights, (nodes // many, nodes // many))
    degrees = convert_to_degrees(compute_slope_components(judged, JUDGED_M, JUDGED_M, BASE_M))
    return GroundField(kind, seed, heights, degrees)


def sun_vector(elevation_deg: float, azimuth_deg: float) -> FloatArray:
    e, a = math.radians(elevation_deg), math.radians(azimuth_deg)
    return np.array([math.cos(e) * math.sin(a), math.cos(e) * math.cos(a), math.sin(e)])


def albedo(seed: int, size: int, posting_m: float, rms: float) -> Float32Array:
    """Brightness (size, size) over its mean: octaves of equal shares from 2 to 512 m."""
    rng = np.random.default_rng([seed, 77])
    total = np.zeros((size, size), np.float32)
    for octave in range(ALBEDO_OCTAVES):
        spacing = 0.5 * ALBEDO_M * 2.0**octave / posting_m  # nodes
        many = math.ceil(size / spacing) + 3
        noise = rng.standard_normal((many, many)).astype(np.float32)
        wide = math.ceil(many * spacing)
        grown = cv2.resize(noise, (wide, wide), interpolation=cv2.INTER_CUBIC)[:size, :size]
        total += (grown / grown.std()).astype(np.float32)
    shares: Float32Array = np.exp(rms * total / total.std()).astype(np.float32)
    return shares


def field_view(
    field: GroundField, elevation_deg: float, albedo_rms: float = 0.03, off_nadir_deg: float = 0.0
) -> PictureOnGround:
    """The field as a camera far above sees it, in cells of CELL_M, with noise.

    off_nadir_deg  of the camera, across the Sun; relief then shifts what is seen where
    """
    azimuth = field.azimuth_deg()
    sun = sun_vector(elevation_deg, azimuth)
    camera = sun_vector(90.0 - off_nadir_deg, azimuth + 90.0)
    bright = render_map(field.heights, DRAWN_M, sun, radius_m=RADIUS_M, view_local=camera)
    if albedo_rms:
        bright *= albedo(field.seed, len(bright), DRAWN_M, albedo_rms)
    if off_nadir_deg:
        bright = _seen_from(bright, field.heights, camera[:2] / camera[2])
    size = len(bright) * DRAWN_M / CELL_M
    cells = resize_grid(bright, (round(size), round(size)))
    cells = cv2.GaussianBlur(cells, (0, 0), BLUR_CELLS).astype(np.float32)
    rng = np.random.default_rng([field.seed, 99])
    mean = float(cells[cells > 0.1 * np.quantile(cells, 0.99)].mean())
    noise = np.sqrt(np.maximum(cells, 0.0) * mean) / SNR
    cells += noise * rng.standard_normal(cells.shape, dtype=np.float32)
    cells += READ_SHARE * mean * rng.standard_normal(cells.shape, dtype=np.float32)
    lattice = np.zeros((2, 2, 2))
    shown: BoolArray = np.ones(cells.shape, bool)
    return PictureOnGround(cells, shown, CELL_M, sun, FAR_M * unit(camera), None, lattice)


def _seen_from(bright: Float32Array, heights: Float32Array, slant: FloatArray) -> Float32Array:
    """Brightness where rays of a slanted view meet the level of zero, not the ground."""
    rows, cols = np.indices(bright.shape, dtype=np.float32)
    per_m = (slant / DRAWN_M).astype(np.float32)
    return _moved(
        bright,
        heights,
        lambda h: (cols + h * per_m[0], rows - h * per_m[1]),
    )


def _moved(
    bright: Float32Array,
    heights: Float32Array,
    place: Callable[[Float32Array], tuple[Float32Array, Float32Array]],
) -> Float32Array:
    """What is seen at places that hang on the heights there; they settle in a few rounds."""
    across, down = place(np.zeros((1, 1), np.float32))
    for _ in range(6):
        h = cv2.remap(heights, across, down, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        across, down = place(h.astype(np.float32, copy=False))
    found = cv2.remap(bright, across, down, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return found.astype(np.float32, copy=False)


def perspective_picture(
    field: GroundField, camera: Camera, height_m: float, elevation_deg: float, posting_m: float
) -> Picture:
    """What a camera that looks straight down sees of the middle of a field, in counts."""
    sun = sun_vector(elevation_deg, field.azimuth_deg())
    level = float(field.heights.mean())
    heights = field.heights - np.float32(level)
    place = (0.0, 0.0, height_m)
    bright = render_map(heights, posting_m, sun, radius_m=RADIUS_M, camera_local=place)
    bright *= albedo(field.seed, len(bright), posting_m, 0.03)
    pixels = np.stack(np.meshgrid(np.arange(camera.width_px), np.arange(camera.height_px)), axis=-1)
    rays = camera.unproject(pixels.astype(np.float64))
    x = (height_m * rays[..., 0] / rays[..., 2]).astype(np.float32)
    y = (-height_m * rays[..., 1] / rays[..., 2]).astype(np.float32)
    middle = 0.5 * (len(heights) - 1)

    def at(h: Float32Array) -> tuple[Float32Array, Float32Array]:
        share = 1.0 - h / np.float32(height_m)  # where the ray passes ground of this height
        col, row = x * share / posting_m + middle, middle - y * share / posting_m
        return col.astype(np.float32), row.astype(np.float32)

    seen = _moved(bright, heights, at)
    rng = np.random.default_rng([field.seed, 55])
    counts = expose(seen, SENSOR, rng)
    return Picture(counts.astype(np.float32), None)


def true_shares(field: GroundField, pad_cells: int) -> dict[str, Float32Array]:
    """Of pads about each cell of CELL_M, an odd number of cells wide: what is on them."""
    many = round(JUDGED_M / CELL_M)
    known = np.nan_to_num(field.degrees).repeat(many, axis=0).repeat(many, axis=1)
    return {
        "dangerous": average_boxes((known > DANGEROUS_DEG).astype(np.float32), pad_cells),
        "critical": average_boxes((known > CRITICAL_DEG).astype(np.float32), pad_cells),
        "squares": average_boxes(known**2, pad_cells),
    }
