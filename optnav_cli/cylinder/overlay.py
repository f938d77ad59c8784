"""A picture of a lit cylinder with what was fitted to it: outline, terminator and limbs."""

import math

import numpy as np
from numpy.typing import NDArray

from catalog.arrays import FloatArray
from optnav_cli.cylinder.fit import CylinderFit, IdealLens
from optnav_cli.cylinder.geometry import CylinderSize, bearing_of, half_width, surface_distance
from optnav_cli.output.canvas import Canvas, dimmed, eight_bits, encoded, resized, shrink_factor

OUTLINE, TERMINATOR, LIMB = (255, 190, 60), (90, 240, 110), (60, 220, 255)
POINTS, MAX_PX = 64, 1200


def cylinder_overlay(
    picture: NDArray[np.generic],
    fit: CylinderFit | None,
    lens: IdealLens,
    size: CylinderSize,
    words: str,
) -> bytes:
    """The bytes of a PNG: the ends of the strip, its limbs, the terminator, and words below.

    picture  (rows, columns), with the lens' distortion taken out
    """
    factor = shrink_factor(picture.shape[1], picture.shape[0], MAX_PX)
    canvas = Canvas(dimmed(resized(eight_bits(picture), factor)), factor)
    if fit is not None:
        radius, distance = size.radius_m, fit.distance_m
        widest = 0.5 * math.pi - half_width(radius, distance)
        psi = np.linspace(-widest, widest, POINTS)
        for end in (-0.5, 0.5):
            canvas.line(_line(psi, np.full(POINTS, end), fit, lens, size), OUTLINE, 1)
        ends = np.array([-0.5, 0.5])
        for side in (-widest, widest):
            canvas.line(_line(np.full(2, side), ends, fit, lens, size), LIMB, 1)
        edge = (abs(fit.theta) - 0.5 * math.pi) * math.copysign(1.0, fit.theta)
        if abs(edge) < widest:
            canvas.line(_line(np.full(2, edge), ends, fit, lens, size), TERMINATOR, 2)
    canvas.text("blue: strip, yellow: limbs, green: terminator", 8.0, 18.0, (230, 230, 230))
    canvas.text(words, 8.0, canvas.image.shape[0] - 8.0, (230, 230, 230))
    return encoded(canvas.image, ".png")


def _line(
    psi: FloatArray, heights: FloatArray, fit: CylinderFit, lens: IdealLens, size: CylinderSize
) -> FloatArray:
    """Pixels (n, 2) of points at angles psi and at shares of the strip's height, downwards."""
    bearing = fit.bearing + bearing_of(psi, size.radius_m, fit.distance_m)
    depth = surface_distance(psi, size.radius_m, fit.distance_m) * np.cos(bearing)
    x = lens.centre_x_px + lens.focal_x_px * np.tan(bearing)
    y = fit.middle_row_px + lens.focal_y_px * size.height_m * heights / depth
    return np.stack([x, y], axis=1)
