"""The body's outline on a frame's picture: limb points, the fitted limb, a disc's centre."""

import cv2
import numpy as np

from catalog.arrays import ByteArray
from optnav_cli.output.canvas import (
    DISC,
    FOUND,
    PREDICTED,
    REJECTED,
    RESIDUAL,
    RESIDUALS_ENLARGED,
    Canvas,
    dimmed,
)
from optnav_cli.solution import OutlineMarks

AIM_PX = 26.0
FRAME = (150, 150, 150)
INSET_ROOM, LEAST_INSET_PX = 1.5, 48.0  # side of what is enlarged over the outline's, and at least
LARGEST_INSET, INSET_SHARE = 0.25, 0.4  # of the picture's side: enlarged below, and to


def draw_outline(canvas: Canvas, marks: OutlineMarks) -> None:
    """Limb points, used and left out, the fitted limb, enlarged residuals; or a disc's centre."""
    if marks.is_disc:
        canvas.aim(marks.points_px[0], AIM_PX, DISC)
        return
    used = marks.used
    for pixel in marks.points_px[used]:
        canvas.dot(pixel, FOUND)
    for pixel in marks.points_px[~used]:
        canvas.dot(pixel, REJECTED)
    for enlarged, colour in ((0.0, PREDICTED), (RESIDUALS_ENLARGED, RESIDUAL)):
        for curve in marks.curves(enlarged):
            canvas.line(curve, colour, 1)


def put_inset(canvas: Canvas, gray: ByteArray, marks: OutlineMarks) -> None:
    """A small outline once more, enlarged, in the corner away from it."""
    low, high = marks.points_px.min(axis=0), marks.points_px.max(axis=0)
    side = round(max(INSET_ROOM * float((high - low).max()), LEAST_INSET_PX))
    if side > LARGEST_INSET * min(gray.shape):
        return
    x, y = (
        int(np.clip(round(middle - side / 2.0), 0, most - side))
        for middle, most in zip((low + high) / 2.0, gray.shape[::-1], strict=True)
    )
    size = round(INSET_SHARE * min(canvas.image.shape[:2]))
    crop = cv2.resize(
        gray[y : y + side, x : x + side], (size, size), interpolation=cv2.INTER_NEAREST
    )
    inset = Canvas(dimmed(np.asarray(crop, np.uint8)), size / side, (x, y))
    draw_outline(inset, marks)
    corners = np.array([(x, y), (x + side, y), (x + side, y + side), (x, y + side)]) - 0.5
    canvas.line(corners, FRAME, 1, closed=True)
    height, width = canvas.image.shape[:2]
    left = 0 if x + side / 2.0 > gray.shape[1] / 2.0 else width - size
    top = 0 if y + side / 2.0 > gray.shape[0] / 2.0 else height - size
    canvas.image[top : top + size, left : left + size] = inset.image
    cv2.rectangle(canvas.image, (left, top), (left + size - 1, top + size - 1), FRAME, 1)
