"""overlays/*.png: a frame with what was expected, what was found, and by how much they differ."""

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from catalog.arrays import ByteArray, FloatArray
from catalog.geometry.projection import MapProjection
from optnav_cli.camera.camera import Camera
from optnav_cli.fix import MatchRow, OutlineMarks, Solution
from optnav_cli.output.canvas import (
    SUBPIXEL_BITS,
    Canvas,
    dimmed,
    eight_bits,
    encoded,
    resized,
    shrink_factor,
    text_width,
)
from optnav_cli.output.recording import describe

# Blue, green, red. Distinct for people with colour-blindness, too, and in shape.
PREDICTED, FOUND, REJECTED = (255, 190, 60), (90, 240, 110), (80, 90, 255)
RESIDUAL, OUTLINE, DISC = (60, 220, 255), (210, 170, 80), (60, 220, 255)
RESIDUALS_ENLARGED = 50.0
AIM_PX = 26.0
FRAME = (150, 150, 150)
INSET_ROOM, MIN_INSET_PX = 1.5, 48.0  # side of what is enlarged over the outline's, and at least
MAX_INSET, INSET_SHARE = 0.25, 0.4  # of the picture's side: enlarged below, and to
Outlines = Mapping[tuple[str, int], Sequence[FloatArray]]
MAX_PX = 1200
FADING = 0.75  # of the patch outlines from level to level, so that the large ones stay behind
EDGE_POINTS = 5  # a patch's side is drawn through so many points, for fisheyes


def draw_outline(canvas: Canvas, marks: OutlineMarks) -> None:
    """Limb points, used and left out, the fitted limb, enlarged residuals; or a disc's centre."""
    if marks.is_disc:
        canvas.aim(marks.points_px[0], AIM_PX, DISC)
        return
    for chosen, colour in ((marks.used, FOUND), (~marks.used, REJECTED)):
        for pixel in marks.points_px[chosen]:
            canvas.dot(pixel, colour)
    for enlarged, colour in ((0.0, PREDICTED), (RESIDUALS_ENLARGED, RESIDUAL)):
        for curve in marks.curves(enlarged):
            canvas.line(curve, colour, 1)


def put_inset(canvas: Canvas, gray: ByteArray, marks: OutlineMarks) -> None:
    """A small outline once more, enlarged, in the corner away from it."""
    low, high = marks.points_px.min(axis=0), marks.points_px.max(axis=0)
    side = round(max(INSET_ROOM * float((high - low).max()), MIN_INSET_PX))
    if side > MAX_INSET * min(gray.shape):
        return
    x, y = (
        int(np.clip(round(middle - side / 2.0), 0, most - side))
        for middle, most in zip((low + high) / 2.0, gray.shape[::-1], strict=True)
    )
    size = round(INSET_SHARE * min(canvas.image.shape[:2]))
    part = gray[y : y + side, x : x + side]
    crop = cv2.resize(part, (size, size), interpolation=cv2.INTER_NEAREST)
    inset = Canvas(dimmed(np.asarray(crop, np.uint8)), size / side, (x, y))
    draw_outline(inset, marks)
    corners = np.array([(x, y), (x + side, y), (x + side, y + side), (x, y + side)]) - 0.5
    canvas.line(corners, FRAME, 1, closed=True)
    height, width = canvas.image.shape[:2]
    left = 0 if x + side / 2.0 > gray.shape[1] / 2.0 else width - size
    top = 0 if y + side / 2.0 > gray.shape[0] / 2.0 else height - size
    canvas.image[top : top + size, left : left + size] = inset.image
    cv2.rectangle(canvas.image, (left, top), (left + size - 1, top + size - 1), FRAME, 1)


def draw_overlay(
    picture: NDArray[np.generic],
    solution: Solution,
    matches: Iterable[MatchRow],
    outlines: Outlines | None = None,
    longest_px: int = MAX_PX,
    *,
    marks: OutlineMarks | None = None,
) -> ByteArray:
    """Draw a frame's control points, and what is known of the body's outline, on its picture.

    picture   (h, w)  as read, any number type
    outlines  closed lines (n, 2), px, by catalog and control point id, see `patch_outlines`
    marks     limb points with the fitted limb, or a disc's centre
    Returns (h', w', 3) uint8 in OpenCV's order of colours, its longer side at most longest_px,
    with a strip below for the legend and the result.
    """
    matches = list(matches)
    factor = shrink_factor(picture.shape[1], picture.shape[0], longest_px)
    gray = eight_bits(picture)
    canvas = Canvas(dimmed(resized(gray, factor)), factor)
    for match in matches:
        for level, outline in enumerate((outlines or {}).get((match.catalog, match.cp_id), ())):
            if match.used and np.isfinite(outline).all():
                blue, green, red = (round(v * FADING**level) for v in OUTLINE)
                canvas.line(outline, (blue, green, red), 1, closed=True)
    if marks is not None:
        draw_outline(canvas, marks)
    for match in matches:
        _draw_match(canvas, match)
    if marks is not None:
        put_inset(canvas, gray, marks)
    return np.vstack([canvas.image, _legend(canvas.image.shape[1], solution, matches, marks)])


def write_overlay(
    folder: Path,
    picture: NDArray[np.generic],
    solution: Solution,
    matches: Iterable[MatchRow],
    outlines: Outlines | None = None,
    *,
    marks: OutlineMarks | None = None,
) -> Path:
    """Write folder/NAME.png for a frame and return its path; the folder is made when missing."""
    path = overlay_path(folder, solution.file)
    path.parent.mkdir(parents=True, exist_ok=True)
    drawn = draw_overlay(picture, solution, matches, outlines, marks=marks)
    path.write_bytes(encoded(drawn, ".png"))
    return path


def overlay_path(folder: Path, file: str) -> Path:
    """Where a frame's overlay is: the picture's whole name, so that a.png and a.tif differ."""
    return folder / (file.replace("/", "_").replace("\\", "_") + ".png")


def patch_outlines(
    projection: MapProjection,
    height_m: float,
    half_sizes_m: Iterable[float],
    camera: Camera,
    position_m: FloatArray,
    camera_from_body: Rotation,
) -> list[FloatArray]:
    """The borders (n, 2), px, of a control point's square patches seen from a pose, finest first.

    height_m      of the point above the sphere or plane of the map: the border is drawn level
    half_sizes_m  half a side of each level's patch, (size - 1) / 2 * posting
    """
    side = np.linspace(-1.0, 1.0, EDGE_POINTS)[:-1]
    one = np.ones_like(side)
    x = np.concatenate([side, one, -side, -one])
    y = np.concatenate([one, -side, -one, side])
    matrix, heights = camera_from_body.as_matrix(), np.full(x.shape, height_m)
    borders = (projection.points(half * x, half * y, heights) for half in half_sizes_m)
    return [camera.project_from_body(border, position_m, matrix) for border in borders]


def _draw_match(canvas: Canvas, match: MatchRow) -> None:
    if not np.isfinite(match.predicted_px).all():
        return
    canvas.ring(match.predicted_px, 7.0, PREDICTED)
    if match.measured_px is None:
        return
    mark = FOUND if match.used else REJECTED
    canvas.cross(match.measured_px, 5.0, mark)
    if match.used and match.residual_px is not None:
        tip = match.measured_px + RESIDUALS_ENLARGED * match.residual_px
        canvas.line(np.array([match.measured_px, tip]), RESIDUAL, 2)
    elif not match.used:
        canvas.line(np.array([match.predicted_px, match.measured_px]), REJECTED, 1)
    x, y = canvas.place(match.measured_px) / 2.0**SUBPIXEL_BITS
    canvas.text(str(match.cp_id), x + 10.0, y - 8.0, mark)


def _entries(
    matches: Sequence[MatchRow], marks: OutlineMarks | None
) -> list[tuple[str, tuple[int, int, int], str]]:
    """Signs, colours and words of the legend; those of control points unless only a limb is."""
    residual = ("-", RESIDUAL, f"residual x{RESIDUALS_ENLARGED:.0f}")
    items = []
    if marks is None or matches:
        found = sum(match.measured_px is not None for match in matches)
        used = sum(match.used for match in matches)
        items += [
            ("o", PREDICTED, f"predicted ({len(matches)})"),
            ("x", FOUND, f"found and used ({used})"),
            ("x", REJECTED, f"found, not used ({found - used})"),
        ]
    if marks is not None and marks.is_disc:
        return [*items, ("+", DISC, "centre of the disc")]
    if marks is not None:
        kept = int(marks.used.sum())
        items += [
            (".", FOUND, f"limb points used ({kept})"),
            (".", REJECTED, f"limb points left out ({len(marks.used) - kept})"),
            ("-", PREDICTED, "fitted limb"),
        ]
    return [*items, residual]


def _legend(
    width: int, solution: Solution, matches: Sequence[MatchRow], marks: OutlineMarks | None
) -> ByteArray:
    items = _entries(matches, marks)
    widths = [text_width(words) + 44 for *_, words in items]
    rows = _rows_of(widths, width)
    strip = Canvas(np.full((26 * (len(rows) + 1) + 6, width, 3), 24, dtype=np.uint8), 1.0)
    strip.text(_shortened(describe(solution), width - 20), 10, 20, (235, 235, 235))
    for number, row in enumerate(rows):
        x, y = 18.0, 26.0 * (number + 1) + 16.0
        for index in row:
            kind, colour, words = items[index]
            at = np.array([x, y - 4.0])
            if kind == "o":
                strip.ring(at, 6.0, colour)
            elif kind == ".":
                strip.dot(at, colour)
            elif kind == "x":
                strip.cross(at, 5.0, colour)
            elif kind == "+":
                strip.aim(at, 8.0, colour)
            else:
                strip.line(np.array([at - (7.0, 0.0), at + (7.0, 0.0)]), colour, 2)
            strip.text(words, x + 13.0, y, (235, 235, 235))
            x += widths[index]
    return strip.image


def _rows_of(widths: Sequence[int], available: int) -> list[list[int]]:
    """Indices of legend items broken into rows that fit."""
    rows: list[list[int]] = [[]]
    used = 0
    for index, width in enumerate(widths):
        if rows[-1] and used + width > available:
            rows.append([])
            used = 0
        rows[-1].append(index)
        used += width
    return rows


def _shortened(words: str, available: int) -> str:
    words = words.encode("ascii", "replace").decode("ascii")  # the font has nothing else
    while len(words) > 4 and text_width(words) > available:
        words = words[:-4] + "..."
    return words
