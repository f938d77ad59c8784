"""Pictures of a plane grid of dots, drawn through a known lens."""

import cv2
import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from catalog.arrays import BoolArray, Float32Array, FloatArray
from optnav_cli.camera.camera import Camera

FINE = 4  # rays a pixel, along each side


def _circles(paper: FloatArray, size: tuple[int, int]) -> BoolArray:
    place = paper + (np.array(size) - 1) / 2.0
    nearest = np.clip(np.rint(place), 0, np.array(size) - 1)
    ink: BoolArray = np.linalg.norm(place - nearest, axis=-1) < 0.25
    return ink


def _acircles(paper: FloatArray, size: tuple[int, int]) -> BoolArray:
    """Draw OpenCV's asymmetric grid: dot j of row i at ((2 j + i % 2) d, i d)."""
    i, j = np.mgrid[: size[1], : size[0]]
    dots = np.stack([2 * j + i % 2, i], axis=-1).reshape(-1, 2)
    middle = np.array([2 * size[0] - 1, size[1] - 1]) / 2.0
    ink: BoolArray = cKDTree(dots).query(paper + middle)[0] < 0.4
    return ink


def _chessboard(paper: FloatArray, size: tuple[int, int]) -> BoolArray:
    """Draw squares whose inner corners are `size`, with a margin about them."""
    place = np.floor(paper + (np.array(size) + 1) / 2.0)
    board = ((place >= 0) & (place <= np.array(size))).all(axis=-1)
    ink: BoolArray = board & (place.sum(axis=-1) % 2 == 0)
    return ink


INK = {"circles": _circles, "acircles": _acircles, "chessboard": _chessboard}


def drawn_grid(
    camera: Camera,
    size: tuple[int, int],
    distance_mm: float,
    turn_deg: tuple[float, float, float] = (0.0, 0.0, 0.0),
    *,
    at_mm: tuple[float, float] = (0.0, 0.0),
    spacing_mm: float = 10.0,
    noise: float = 2.0,
    seed: int = 0,
    pattern: str = "circles",
) -> Float32Array:
    """A picture of black dots on white paper, which the camera's axis meets near its middle.

    turn_deg  of the paper about the camera's x, y and z;  at_mm  of its middle from the axis
    """
    rows, columns = camera.shape
    x = (np.arange(columns * FINE) + 0.5) / FINE - 0.5
    y = (np.arange(rows * FINE) + 0.5) / FINE - 0.5
    rays = camera.unproject(np.stack(np.meshgrid(x, y), axis=-1))
    turn = Rotation.from_euler("xyz", turn_deg, degrees=True).as_matrix()
    middle = np.array([*at_mm, distance_mm])
    along = (middle @ turn[:, 2]) / (rays @ turn[:, 2])
    paper: FloatArray = (rays * along[..., None] - middle) @ turn[:, :2] / spacing_mm
    ink = INK[pattern](paper, size)
    light = np.where(ink, 30.0, 200.0).reshape(rows, FINE, columns, FINE).mean(axis=(1, 3))
    blurred = cv2.GaussianBlur(light, (0, 0), 0.8)
    noisy = blurred + np.random.default_rng(seed).normal(0.0, noise, blurred.shape)
    return np.clip(np.rint(noisy), 0, 255).astype(np.float32)
