"""What a detector makes of radiance: blur, shot and read noise, counts."""

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from catalog.arrays import ByteArray, Float32Array, UInt16Array
from optnav_cli.simulation.sections import SensorSettings

Counts = ByteArray | UInt16Array

# Of the lit pixels stay below the exposure's level; a point of opposition may saturate.
BRIGHT_SHARE = 0.99
LIT_SHARE = 0.1  # a pixel is lit above this share of the bright level
BIAS_SHARE = 0.01  # counts of a dark pixel over full scale: noise must be able to go below the mean


@dataclass(frozen=True, eq=False)
class Besides:
    """Light on the detector besides the body's, (rows, cols) each; None for nothing.

    cover, brightness  share of each pixel that the ship covers, and how bright it is there
    veil               stray light; as `brightness` a share of the bright ground
    stars              electrons, already blurred; hidden by what shines or covers
    """

    cover: Float32Array | None = None
    brightness: Float32Array | None = None
    veil: Float32Array | None = None
    stars: Float32Array | None = None


def expose(
    radiance: Float32Array,
    settings: SensorSettings,
    rng: np.random.Generator,
    besides: Besides | None = None,
) -> Counts:
    """A picture in counts from mean radiance over the pixels (rows, cols), any unit.

    The exposure brings the bright parts of the body to the set share of full scale. The number of
    electrons is the one that gives the set signal to noise at the mean of the lit pixels.
    Returns uint8 up to 8 bits, else uint16.
    """
    besides = besides or Besides()
    full = 2**settings.bits - 1
    kind = np.uint8 if settings.bits <= 8 else np.uint16
    sharp = radiance if besides.cover is None else radiance * (1.0 - besides.cover)
    signal = _blurred(sharp, settings)
    positive = signal[signal > 0.0]
    if positive.size:
        bright = float(np.quantile(positive, BRIGHT_SHARE))
        mean = float(positive[positive > LIT_SHARE * bright].mean())
    elif besides.stars is besides.cover is besides.veil is None:
        return np.full(signal.shape, round(BIAS_SHARE * full), kind)
    else:
        bright = mean = 1.0  # nothing of the body in view: the exposure stays as it was for it
    # electrons n of the mean signal with n / sqrt(n + read^2) = snr
    square = settings.snr**2
    wanted = 0.5 * square * (1.0 + np.sqrt(1.0 + 4.0 * settings.read_noise_e**2 / square))
    if besides.cover is not None and besides.brightness is not None:
        signal = signal + bright * _blurred(besides.cover * besides.brightness, settings)
    if besides.veil is not None:
        free = 1.0 if besides.cover is None else 1.0 - besides.cover
        signal = signal + bright * besides.veil * free
    light = signal.astype(np.float64) * (wanted / mean)
    if besides.stars is not None:
        dark = radiance == 0.0
        if besides.cover is not None:
            dark &= besides.cover < 0.5
        light = light + np.where(dark, besides.stars, 0.0)
    electrons = rng.poisson(light).astype(np.float32)
    electrons += settings.read_noise_e * rng.standard_normal(signal.shape, dtype=np.float32)
    counts = electrons * (settings.exposure * full * mean / (bright * wanted))
    digital: Counts = np.clip(np.rint(counts + BIAS_SHARE * full), 0, full).astype(kind)
    return digital


def add_hot_pixels(counts: Counts, number: int, bits: int, rng: np.random.Generator) -> None:
    """Let pixels shine by themselves, in place; the same generator gives the same ones."""
    rows, cols = counts.shape
    places = rng.choice(rows * cols, size=min(number, rows * cols), replace=False)
    glow = rng.uniform(0.1, 1.0, size=places.size) * (2**bits - 1)
    flat = counts.reshape(-1)
    flat[places] = np.maximum(flat[places], np.rint(glow).astype(counts.dtype))


def _blurred(light: Float32Array, settings: SensorSettings) -> NDArray[np.floating[Any]]:
    if settings.psf_sigma_px > 0.0:
        blurred = cv2.GaussianBlur(light, (0, 0), settings.psf_sigma_px)
        return blurred.astype(np.float32, copy=False)
    return light
