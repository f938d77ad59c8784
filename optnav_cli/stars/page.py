"""Overlays of star pictures, and a run of `optnav stars` as a page."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from markupsafe import Markup

from catalog.arrays import ByteArray, Float32Array
from catalog.bodies.stars import BrightStars, load_bright_stars
from catalog.tables import CsvRow
from optnav_cli.frames.tables import ATTITUDES
from optnav_cli.output.canvas import (
    Canvas,
    compute_shrink_factor,
    measure_text,
    resize_picture,
    scale_to_eight_bits,
    shade_picture,
)
from optnav_cli.output.manifest import read_manifest
from optnav_cli.output.run_folder import OVERLAYS
from optnav_cli.report import page as html
from optnav_cli.report.page import list_overlays
from optnav_cli.stars.identify import StarFix
from optnav_cli.stars.spots import StarSpots

STARS_KIND, ATTITUDES_CSV = "stars", "attitudes.csv"
HEADER = ("file", "UTC", "stars", "of spots", "rms, px", "σ across, ″", "σ about, ″", "chance")
FOUND, SPOT, LEFT_OUT, RESIDUAL = (90, 240, 110), (255, 190, 60), (80, 90, 255), (60, 220, 255)
MAX_PX, ENLARGED = 1200, 100.0
MAX_NAMED = 40  # the brightest


def build_stars_page(folder: Path) -> str:
    """Build the page of a run. Raises DataError for a folder that lacks its table."""
    manifest = read_manifest(folder)
    rows = ATTITUDES.rows(folder / ATTITUDES_CSV)
    solved = [row for row in rows if row["status"] == "solved"]
    tiles = [(f"{len(solved)} of {len(rows)}", "pictures have an attitude")]
    if solved:
        stars = sum(row.number("n_used") or 0 for row in solved) / len(solved)
        tiles.append((f"{stars:.0f}", "stars a picture"))
        worst = max(row.number("sigma_x_arcsec") or 0.0 for row in solved)
        tiles.append((f"{worst:.1f}″", "sigma across the line of sight, at most"))
    lost = [(row["file"], row["utc"], row["reason"]) for row in rows if row["status"] != "solved"]
    shown, damaged = list_overlays(folder / OVERLAYS, [row["file"] for row in rows])
    words = "Green: stars, with names; blue: other spots; yellow: residuals. A click enlarges."
    notes = [html.paragraph(damaged, "note")] if damaged else []
    sections = [
        html.section("Result", html.tiles(tiles)),
        html.section("Pictures", html.anchor("pictures"), html.paragraph(words), *notes, shown),
        html.section("Attitudes", html.table(HEADER, [_format_cells(row) for row in solved], 2)),
        _list_unsolved(lost),
        html.section("Made from", html.folded("manifest.json", html.format_listing(manifest))),
    ]
    subtitle = f"{len(rows)} pictures, {len(solved)} solved. Attitudes are camera_from_inertial."
    return html.build_page(f"Stars: run {folder.resolve().name}", subtitle, filter(None, sections))


def _list_unsolved(rows: Sequence[tuple[str, str, str]]) -> Markup:
    if not rows:
        return Markup()
    return html.section("Without an attitude", html.table(("file", "UTC", "reason"), rows, 3))


def _format_cells(row: CsvRow) -> tuple[str, ...]:
    def format_value(name: str, form: str) -> str:
        value = row.number(name)
        return "" if value is None else format(value, form)

    return (
        *(row["file"], row["utc"], format_value("n_used", ".0f"), format_value("n_spots", ".0f")),
        *(format_value("residual_rms_px", ".3f"), format_value("sigma_x_arcsec", ".2f")),
        *(format_value("sigma_z_arcsec", ".2f"), format_value("chance", ".0e")),
    )


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
