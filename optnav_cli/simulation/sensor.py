"""What a detector makes of radiance: blur, shot and read noise, counts."""

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from optnav_cli.simulation.scenario import SensorSettings

Counts = NDArray[np.uint8] | NDArray[np.uint16]

BRIGHT_SHARE = (
    0.99  # of the lit pixels stay below the exposure's level; a point of opposition may saturate
)
LIT_SHARE = 0.1  # a pixel is lit above this share of the bright level
BIAS_SHARE = 0.01  # counts of a dark pixel over full scale: noise must be able to go below the mean


def expose(
    radiance: NDArray[np.float32], settings: SensorSettings, rng: np.random.Generator
) -> Counts:
    """A picture in counts from mean radiance over the pixels (rows, cols), any unit.

    The exposure brings the bright parts to the set share of full scale. The number of electrons is
    the one that gives the set signal to noise at the mean of the lit pixels.
    Returns uint8 up to 8 bits, else uint16.
    """
    signal: NDArray[np.floating[Any]] = radiance
    if settings.psf_sigma_px > 0.0:
        signal = np.asarray(cv2.GaussianBlur(radiance, (0, 0), settings.psf_sigma_px), np.float32)
    positive = signal[signal > 0.0]
    full = 2**settings.bits - 1
    kind = np.uint8 if settings.bits <= 8 else np.uint16
    if positive.size == 0:
        return np.full(signal.shape, round(BIAS_SHARE * full), kind)
    bright = float(np.quantile(positive, BRIGHT_SHARE))
    mean = float(positive[positive > LIT_SHARE * bright].mean())
    # electrons n of the mean signal with n / sqrt(n + read^2) = snr
    square = settings.snr**2
    wanted = 0.5 * square * (1.0 + np.sqrt(1.0 + 4.0 * settings.read_noise_e**2 / square))
    electrons = rng.poisson(signal.astype(np.float64) * (wanted / mean)).astype(np.float32)
    electrons += settings.read_noise_e * rng.standard_normal(signal.shape, dtype=np.float32)
    counts = electrons * (settings.exposure * full * mean / (bright * wanted))
    whole: Counts = np.clip(np.rint(counts + BIAS_SHARE * full), 0, full).astype(kind)
    return whole
