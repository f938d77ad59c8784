"""Discs of a sphere blurred and integrated over pixels, for the tests of edges and centres."""

import cv2
import numpy as np

from catalog.arrays import Float32Array, FloatArray
from catalog.photometry.laws import find_law
from optnav_cli.camera.camera import Camera

RADIUS_M = 1_737_400.0
FINE = 4  # sub-pixels a side


def far_camera(size_px: int, focal_length_px: float = 4183.87) -> Camera:
    """A pinhole with a square picture."""
    middle = (size_px - 1) / 2.0
    return Camera("far", "pinhole", size_px, size_px, focal_length_px, (middle, middle))


def disc_distance(camera: Camera, radius_px: float) -> float:
    """Distance of the sphere's centre at which its limb is radius_px from the middle, m."""
    return RADIUS_M / float(np.sin(np.arctan(radius_px / camera.focal_length_px)))


def sun_at_phase(centre: FloatArray, phase_deg: float, roll_deg: float) -> FloatArray:
    """Unit vector to the Sun, camera frame, that makes a phase angle at the body's centre."""
    back = -centre / np.linalg.norm(centre)
    side = np.cross(back, [0.3, 1.0, 0.1])
    side /= np.linalg.norm(side)
    up = np.cross(back, side)
    roll, phase = np.radians(roll_deg), np.radians(phase_deg)
    across = side * np.cos(roll) + up * np.sin(roll)
    return np.asarray(back * np.cos(phase) + across * np.sin(phase))


def placed(
    camera: Camera, radius_px: float, phase_deg: float, rng: np.random.Generator
) -> tuple[FloatArray, FloatArray]:
    """A disc's centre (3,), m, about the picture's middle, and the Sun's unit vector (3,)."""
    axis = np.append(rng.uniform(-3.0, 3.0, 2) / camera.focal_length_px, 1.0)
    centre = disc_distance(camera, radius_px) * axis / np.linalg.norm(axis)
    return centre, sun_at_phase(centre, phase_deg, rng.uniform(0.0, 360.0))


def blurred_disc(
    camera: Camera, centre: FloatArray, sun: FloatArray, law: str, psf_sigma_px: float
) -> FloatArray:
    """Mean radiance (h, w) over each pixel behind a Gaussian blur.

    Drawn FINE times finer, where the limb cuts a sub-pixel by the share it covers, blurred there
    and averaged over the pixels: a blur of whole pixels' means is another, broader one.
    """
    height, width = camera.shape
    x = (np.arange(FINE * width) + 0.5) / FINE - 0.5
    y = (np.arange(FINE * height) + 0.5) / FINE - 0.5
    rays = camera.unproject(np.stack(np.meshgrid(x, y), axis=-1))
    distance = float(np.linalg.norm(centre))
    axis, angle = centre / distance, float(np.arcsin(RADIUS_M / distance))
    off = np.arctan2(np.linalg.norm(np.cross(rays, axis), axis=-1), rays @ axis)
    inside_px = (angle - off) * camera.focal_length_px
    # just inside the limb stands for what of a cut sub-pixel is covered
    sine = np.clip(np.sin(np.minimum(off, angle - 0.1 / FINE / camera.focal_length_px)), 0.0, None)
    sine_emission = sine / np.sin(angle)
    mu = np.sqrt(1.0 - sine_emission**2)
    outward = rays - (rays @ axis)[..., None] * axis
    outward /= np.maximum(np.linalg.norm(outward, axis=-1, keepdims=True), 1e-12)
    side = np.cross(np.cross(rays, outward), rays)
    side /= np.maximum(np.linalg.norm(side, axis=-1, keepdims=True), 1e-12)
    mu0 = mu * -(rays @ sun) + sine_emission * (side @ sun)
    value = find_law(law)(mu0, mu, -rays @ sun) * np.clip(0.5 + FINE * inside_px, 0.0, 1.0)
    blurred = cv2.GaussianBlur(value, (0, 0), psf_sigma_px * FINE)
    return np.asarray(cv2.resize(blurred, (width, height), interpolation=cv2.INTER_AREA))


def expose(image: FloatArray, snr: float, rng: np.random.Generator, bits: int = 8) -> Float32Array:
    """Shot noise for a signal-to-noise ratio at the lit mean, read noise, and counts."""
    full = 2**bits - 1
    bright = float(np.quantile(image[image > 0.05 * image.max()], 0.99))
    lit = float(image[image > 0.1 * bright].mean())
    electrons = rng.poisson(np.maximum(image, 0.0) * (snr**2 / lit))
    counts = electrons + rng.normal(0.0, 0.004 * snr**2, image.shape)
    counts *= 0.8 * full * lit / (bright * snr**2)
    return np.clip(np.rint(counts + 0.01 * full), 0, full).astype(np.float32)
