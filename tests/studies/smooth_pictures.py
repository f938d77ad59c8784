"""Pictures without any ground: gradients, vignettes, stray light, haze, and defocus by 20 px."""

import cv2
import numpy as np

from catalog.arrays import Float32Array, FloatArray

KINDS = ("gradient", "slow gradient", "vignette", "stray light", "haze", "defocus")
DEFOCUS_PX = 20.0
HAZE_NODES = 128  # a side that haze is drawn on
BITS = (8, 16)


def draw_smooth_picture(
    size: int, bits: int, kind: str, sharp: Float32Array, rng: np.random.Generator
) -> Float32Array:
    """Draw a smooth picture in whole counts, with or without noise of some counts.

    size, bits  of the picture: side, px, and depth
    kind        one of KINDS; "slow gradient" is up to two counts per pixel along a side
    sharp       (h, w) what a defocused picture shows

    Returns (size, size).
    """
    top = 2.0**bits - 1.0
    if kind == "slow gradient":
        ramp = np.rint(np.arange(size) * min(float(rng.integers(1, 3)), top / (size - 1.0)))
        counts = np.broadcast_to(ramp, (size, size))
        return np.asarray(counts if rng.random() < 0.5 else counts.T, np.float32)
    values = top * _drawn(size, kind, sharp, rng)
    if rng.random() < 0.5:
        values = values + rng.uniform(0.2, 3.0) * rng.normal(size=values.shape)
    return np.clip(np.rint(values), 0.0, top).astype(np.float32)


def _drawn(size: int, kind: str, sharp: Float32Array, rng: np.random.Generator) -> FloatArray:
    """A field (size, size) between 0 and 1."""
    across, down = np.meshgrid(*2 * [np.linspace(0.0, 1.0, size)])
    if kind == "defocus":
        large = cv2.resize(sharp, (size, size), interpolation=cv2.INTER_CUBIC)
        soft = cv2.GaussianBlur(large, (0, 0), DEFOCUS_PX).astype(np.float64)
        return soft / max(float(soft.max()), 1.0)
    field: FloatArray
    if kind == "haze":
        small = rng.normal(size=(HAZE_NODES, HAZE_NODES))
        waves = cv2.GaussianBlur(small, (0, 0), HAZE_NODES / rng.uniform(5, 12))
        drawn = cv2.resize(waves, (size, size), interpolation=cv2.INTER_CUBIC)
        field = np.asarray(0.5 + rng.uniform(0.02, 0.4) * drawn / np.abs(drawn).max(), np.float64)
    elif kind == "gradient":
        angle = rng.uniform(0.0, 2.0 * np.pi)
        along = np.cos(angle) * (across - 0.5) + np.sin(angle) * (down - 0.5)
        field = 0.5 + rng.uniform(0.02, 0.7) * along
    else:
        reach = (0.3, 0.7) if kind == "vignette" else (-0.2, 1.2)
        x, y = rng.uniform(*reach, 2)
        square = (across - x) ** 2 + (down - y) ** 2
        field = 0.1 + 0.8 * np.exp(-square / rng.uniform(0.05, 0.5))
        if kind == "vignette":
            field = rng.uniform(0.3, 0.95) / (1.0 + rng.uniform(0.5, 6.0) * square) ** 2
    return field
