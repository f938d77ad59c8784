"""Drawing for the README's pictures: gray pictures with marks and words that stay readable."""

from pathlib import Path

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from catalog.arrays import ByteArray, Int32Array

FONT = cv2.FONT_HERSHEY_SIMPLEX
BITS = 4  # OpenCV draws at sixteenths of a pixel
WHITE, DARK = (240, 240, 240), (24, 24, 24)
GRAY_STEP = 4  # levels of gray are thinned out: noise takes most of a PNG's bytes, nobody sees it


def gray_picture(values: NDArray[np.generic], width: int, gamma: float = 0.8) -> ByteArray:
    """A picture (h, w) of any number type, stretched to 8 bits and brought to a width."""
    shown = np.nan_to_num(np.asarray(values, np.float32))
    height = round(width * shown.shape[0] / shown.shape[1])
    how = cv2.INTER_AREA if width <= shown.shape[1] else cv2.INTER_CUBIC
    shown = cv2.resize(shown, (width, height), interpolation=how)
    bright = shown[shown > 0.05 * shown.max()]
    top = np.percentile(bright, 99.5)
    gray = np.rint(255.0 * np.clip(shown / top, 0.0, 1.0) ** gamma).astype(np.uint8)
    gray = gray // GRAY_STEP * GRAY_STEP
    return np.asarray(cv2.cvtColor(gray, cv2.COLOR_GRAY2BGR), np.uint8)


def _fixed(points: ArrayLike) -> Int32Array:
    return np.asarray(np.rint(np.asarray(points, np.float64) * 2**BITS), np.int32)


def line(image: ByteArray, points: ArrayLike, colour: tuple[int, int, int], width: int = 1) -> None:
    """An open line through points (n, 2), px."""
    cv2.polylines(image, [_fixed(points)], False, colour, width, cv2.LINE_AA, BITS)


def dot(image: ByteArray, at: ArrayLike, radius: float, colour: tuple[int, int, int]) -> None:
    """A filled disc with a dark rim."""
    x, y = (int(v) for v in _fixed(at))
    rim, disc = (round(r * 2**BITS) for r in (radius + 1.5, radius))
    cv2.circle(image, (x, y), rim, (0, 0, 0), cv2.FILLED, cv2.LINE_AA, BITS)
    cv2.circle(image, (x, y), disc, colour, cv2.FILLED, cv2.LINE_AA, BITS)


def cross(image: ByteArray, at: ArrayLike, arm: float, colour: tuple[int, int, int]) -> None:
    """A slanted cross with a dark rim."""
    place = np.asarray(at, np.float64)
    for rim, shade in ((3, (0, 0, 0)), (1, colour)):
        for step in (np.array([arm, arm]), np.array([arm, -arm])):
            line(image, [place - step, place + step], shade, rim)


def words(
    image: ByteArray, text: str, x: int, y: int, size: float = 0.45,
    colour: tuple[int, int, int] = WHITE,
) -> None:  # fmt: skip
    """Text with a dark rim, its lower left corner at x, y."""
    for dx, dy in ((-1, 0), (1, 0), (0, -1), (0, 1)):
        cv2.putText(image, text, (x + dx, y + dy), FONT, size, (0, 0, 0), 1, cv2.LINE_AA)
    cv2.putText(image, text, (x, y), FONT, size, colour, 1, cv2.LINE_AA)


def text_width(text: str, size: float = 0.45) -> int:
    """How wide `words` writes, px."""
    return int(cv2.getTextSize(text, FONT, size, 1)[0][0])


def strip(width: int, height: int) -> ByteArray:
    """A dark band for a legend."""
    return np.full((height, width, 3), DARK, np.uint8)


def write(picture: ByteArray, path: Path) -> None:
    """A PNG as small as it gets, or a JPEG, by the name's ending."""
    png = path.suffix == ".png"
    how = [cv2.IMWRITE_PNG_COMPRESSION, 9] if png else [cv2.IMWRITE_JPEG_QUALITY, 82]
    done, data = cv2.imencode(path.suffix, picture, how)
    if not done:
        raise ValueError(f"{path}: a picture of {picture.shape} cannot be coded")
    path.write_bytes(data.tobytes())
