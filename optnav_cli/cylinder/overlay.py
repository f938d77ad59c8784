"""A picture of a lit cylinder with what was fitted to it: outline, terminator and limbs."""

import math

import numpy as np
from numpy.typing import NDArray

from catalog.arrays import FloatArray
from optnav_cli.cylinder.fit import CylinderFit, IdealLens
from optnav_cli.cylinder.geometry import (
    CylinderSize,
    compute_bearing,
    compute_half_width,
    compute_surface_distance,
)
from optnav_cli.output.canvas import (
    Canvas,
    compute_shrink_factor,
    encode_picture,
    resize_picture,
    scale_to_eight_bits,
    shade_picture,
)

OUTLINE, TERMINATOR, LIMB = (255, 190, 60), (90, 240, 110), (60, 220, 255)
POINTS, MAX_PX = 64, 1200


def draw_cylinder_overlay(
    picture: NDArray[np.generic],
    fit: CylinderFit | None,
    lens: IdealLens,
    size: CylinderSize,
    words: str,
) -> bytes:
    """Draw a PNG: the ends of the strip, its limbs, the terminator, and words below.

    picture  (rows, columns), with the lens' distortion taken out
    """
    factor = compute_shrink_factor(picture.shape[1], picture.shape[0], MAX_PX)
    canvas = Canvas(shade_picture(resize_picture(scale_to_eight_bits(picture), factor)), factor)
    if fit is not None:
        radius, distance = size.radius_m, fit.distance_m
        widest = 0.5 * math.pi - compute_half_width(radius, distance)
        psi = np.linspace(-widest, widest, POINTS)
        for end in (-0.5, 0.5):
            canvas.line(_project_line(psi, np.full(POINTS, end), fit, lens, size), OUTLINE, 1)
        ends = np.array([-0.5, 0.5])
        for side in (-widest, widest):
            canvas.line(_project_line(np.full(2, side), ends, fit, lens, size), LIMB, 1)
        edge = (abs(fit.theta) - 0.5 * math.pi) * math.copysign(1.0, fit.theta)
        if abs(edge) < widest:
            canvas.line(_project_line(np.full(2, edge), ends, fit, lens, size), TERMINATOR, 2)
    canvas.text("blue: strip, yellow: limbs, green: terminator", 8.0, 18.0, (230, 230, 230))
    canvas.text(words, 8.0, canvas.image.shape[0] - 8.0, (230, 230, 230))
    return encode_picture(canvas.image, ".png")


def _project_line(
    psi: FloatArray, heights: FloatArray, fit: CylinderFit, lens: IdealLens, size: CylinderSize
) -> FloatArray:
    """Project points at angles psi and shares of the strip's height, downwards: (n, 2)."""
    bearing = fit.bearing + compute_bearing(psi, size.radius_m, fit.distance_m)
    depth = compute_surface_distance(psi, size.radius_m, fit.distance_m) * np.cos(bearing)
    x = lens.centre_x_px + lens.focal_x_px * np.tan(bearing)
    y = fit.middle_row_px + lens.focal_y_px * size.height_m * heights / depth
    return np.stack([x, y], axis=1)
