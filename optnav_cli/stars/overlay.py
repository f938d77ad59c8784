"""Overlays of star pictures: spots, the stars that they are, their names."""

import numpy as np

from catalog.arrays import ByteArray, Float32Array
from catalog.bodies.stars import BrightStars, load_bright_stars
from optnav_cli.output.canvas import (
    Canvas,
    compute_shrink_factor,
    measure_text,
    resize_picture,
    scale_to_eight_bits,
    shade_picture,
)
from optnav_cli.stars.identify import StarFix
from optnav_cli.stars.spots import StarSpots

FOUND, SPOT, LEFT_OUT, RESIDUAL = (90, 240, 110), (255, 190, 60), (80, 90, 255), (60, 220, 255)
MAX_PX, ENLARGED = 1200, 100.0
MAX_NAMED = 40  # the brightest


def draw_stars(
    picture: Float32Array,
    spots: StarSpots | None,
    fix: StarFix | None,
    words: str,
    catalog: BrightStars | None = None,
) -> ByteArray:
    """Draw the picture (h', w', 3) with spots and stars over a strip with the result."""
    factor = compute_shrink_factor(picture.shape[1], picture.shape[0], MAX_PX)
    canvas = Canvas(shade_picture(resize_picture(_stretch(picture), factor)), factor)
    matched = set() if fix is None else set(fix.spots.tolist())
    for number, pixel in enumerate([] if spots is None else spots.pixels):
        if number not in matched:
            canvas.ring(pixel, 7.0, SPOT, 1)
    if fix is not None and spots is not None:
        stars = load_bright_stars() if catalog is None else catalog
        for row, (spot, star) in enumerate(zip(fix.spots, fix.stars, strict=True)):
            colour = FOUND if fix.used[row] else LEFT_OUT
            pixel = spots.pixels[spot]
            canvas.ring(pixel, 7.0, colour, 1)
            canvas.line(np.array([pixel, pixel + ENLARGED * fix.residuals_px[row]]), RESIDUAL, 1)
            if row < MAX_NAMED:
                x, y = (pixel + 0.5) * factor
                label = stars.label(int(star))
                right = x + 10.0 + measure_text(label) < canvas.image.shape[1]
                canvas.text(label, x + 10.0 if right else x - 10.0 - measure_text(label), y, colour)
    strip = Canvas(np.full((54, canvas.image.shape[1], 3), 24, dtype=np.uint8), 1.0)
    room = max(int(canvas.image.shape[1] / 7.5), 10)
    strip.text(words.encode("ascii", "replace").decode("ascii")[:room], 10, 20, (235, 235, 235))
    if fix is not None:
        strip.text(f"green: stars; blue: other spots; yellow: residual x{ENLARGED:g}", 10, 42, SPOT)
    return np.vstack([canvas.image, strip.image])


def _stretch(picture: Float32Array) -> ByteArray:
    """Map to eight bits, in which stars of the threshold are seen beside the bright ones."""
    sky = float(np.median(picture[::4, ::4]))
    noise = max(1.4826 * float(np.median(np.abs(picture[::4, ::4] - sky))), 1e-6)
    scaled = np.arcsinh(np.maximum(picture - sky, 0.0) / (4.0 * noise))
    return scale_to_eight_bits(scaled)
