"""Pictures of ground that is known, laid on it: for the tests of hazard maps."""

import numpy as np
from scipy.ndimage import gaussian_filter

from catalog.arrays import BoolArray, Float32Array
from catalog.rendering.map_view import render_map
from optnav_cli.hazard.ground_view import PictureOnGround

RADIUS = 1e9  # as good as a plane


def view_of(
    brightness: Float32Array,
    elevation_deg: float = 20.0,
    azimuth_deg: float = 90.0,
    valid: BoolArray | None = None,
    camera: tuple[float, float, float] = (0.0, 0.0, 1e6),
) -> PictureOnGround:
    """A view of one-metre cells from far above."""
    e, a = np.radians([elevation_deg, azimuth_deg])
    sun = np.array([np.cos(e) * np.sin(a), np.cos(e) * np.cos(a), np.sin(e)])
    rows, cols = brightness.shape
    every = [16.0 * np.arange((size - 1) // 16 + 2) for size in (rows, cols)]
    y, x = np.meshgrid(*every, indexing="ij")
    shown = np.ones((rows, cols), bool) if valid is None else valid
    return PictureOnGround(brightness, shown, 1.0, sun, np.array(camera), None, np.stack([x, y]))


def drawn(heights: Float32Array, elevation_deg: float, azimuth_deg: float) -> PictureOnGround:
    """A view of heights on a square grid of one metre, seen from above with its shadows."""
    e, a = np.radians([elevation_deg, azimuth_deg])
    sun = np.array([np.cos(e) * np.sin(a), np.cos(e) * np.cos(a), np.sin(e)])
    bright = render_map(heights, 1.0, sun, radius_m=RADIUS)
    return view_of(bright, elevation_deg, azimuth_deg)


def bumps(size: int = 160, seed: int = 1, height_m: float = 1.5) -> Float32Array:
    """Smooth ground of hills and hollows without a tilt, its largest slopes about 15 deg."""
    noise = np.random.default_rng(seed).standard_normal((size, size)).astype(np.float32)
    ground = gaussian_filter(noise, 6.0, mode="wrap")
    return np.asarray(height_m * ground / ground.std(), np.float32)
