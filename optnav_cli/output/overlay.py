"""overlays/*.png: a frame with what was expected, what was found, and by how much they differ."""

import hashlib
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

import cv2
import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from catalog.arrays import ByteArray, FloatArray
from catalog.geometry.projection import MapProjection
from optnav_cli.camera.camera import Camera
from optnav_cli.fix import MatchRow, OutlineMarks, Solution
from optnav_cli.frames.frames import MAX_NAME_BYTES
from optnav_cli.output.canvas import (
    SUBPIXEL_BITS,
    Canvas,
    compute_shrink_factor,
    encode_picture,
    measure_text,
    resize_picture,
    shade_picture,
)
from optnav_cli.output.recording import describe

# Blue, green, red. Distinct for people with colour-blindness, too, and in shape.
PREDICTED, FOUND, REJECTED, PRIOR = (255, 190, 60), (90, 240, 110), (80, 90, 255), (245, 140, 255)
RESIDUAL, OUTLINE, DISC = (60, 220, 255), (210, 170, 80), (60, 220, 255)
RESIDUALS_ENLARGED = 50.0
AIM_PX = 26.0
FRAME = (150, 150, 150)
INSET_ROOM, MIN_INSET_PX = 1.5, 48.0  # side of what is enlarged over the outline's, and at least
MAX_INSET, INSET_SHARE = 0.25, 0.4  # of the picture's side: enlarged below, and to
Outlines = Mapping[tuple[str, int], Sequence[FloatArray]]
MAX_PX = 1200
FADING = 0.75  # of the patch outlines from level to level, so that the large ones stay behind
MAX_OVERLAP = 1.0  # patches of a level are outlined that are no larger together than their field
ROOMY_PX, MIN_SCALE = 30.0, 0.45  # marks nearer to each other than this are drawn smaller
LABEL_PX = 11.0  # height of a label
MAX_LINES = 3  # of the result in the strip below
EDGE_POINTS = 5  # a patch's side is drawn through so many points, for fisheyes


def draw_outline(canvas: Canvas, marks: OutlineMarks) -> None:
    """Draw limb points, used and left out, the fitted limb, residuals; or a disc's centre."""
    if marks.is_disc:
        canvas.aim(marks.points_px[0], AIM_PX, DISC)
        return
    for chosen, colour in ((marks.used, FOUND), (~marks.used, REJECTED)):
        canvas.dots(marks.points_px[chosen], colour)
    for enlarged, colour in ((0.0, PREDICTED), (RESIDUALS_ENLARGED, RESIDUAL)):
        for curve in marks.curves(enlarged):
            canvas.line(curve, colour, 1)


def draw_inset(canvas: Canvas, gray: ByteArray, marks: OutlineMarks) -> None:
    """Draw a small outline once more, enlarged, in the corner away from it."""
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
    inset = Canvas(shade_picture(np.asarray(crop, np.uint8)), size / side, (x, y))
    draw_outline(inset, marks)
    corners = np.array([(x, y), (x + side, y), (x + side, y + side), (x, y + side)]) - 0.5
    canvas.line(corners, FRAME, 1, closed=True)
    height, width = canvas.image.shape[:2]
    left = 0 if x + side / 2.0 > gray.shape[1] / 2.0 else width - size
    top = 0 if y + side / 2.0 > gray.shape[0] / 2.0 else height - size
    canvas.image[top : top + size, left : left + size] = inset.image
    cv2.rectangle(canvas.image, (left, top), (left + size - 1, top + size - 1), FRAME, 1)


def draw_overlay(
    gray: ByteArray,
    solution: Solution,
    matches: Iterable[MatchRow],
    outlines: Outlines | None = None,
    longest_px: int = MAX_PX,
    *,
    marks: OutlineMarks | None = None,
) -> ByteArray:
    """Draw a frame's control points, and what is known of the body's outline, on its picture.

    gray      (h, w) the picture of `scale_to_eight_bits`
    outlines  closed lines (n, 2), px, by catalog and control point id, see `project_patches`
    marks     limb points with the fitted limb, or a disc's centre
    Returns (h', w', 3) uint8 in OpenCV's order of colours, its longer side at most longest_px,
    with a strip below for the legend and the result.
    """
    matches = list(matches)
    factor = compute_shrink_factor(gray.shape[1], gray.shape[0], longest_px)
    canvas = Canvas(shade_picture(resize_picture(gray, factor)), factor)
    used = [
        (outlines or {}).get((match.catalog, match.cp_id), ()) for match in matches if match.used
    ]
    for level in range(max(map(len, used), default=0)):
        _draw_patches(canvas, [patch[level] for patch in used if len(patch) > level], level)
    if marks is not None:
        draw_outline(canvas, marks)
    _draw_matches(canvas, matches)
    if marks is not None:
        draw_inset(canvas, gray, marks)
    return np.vstack([canvas.image, _draw_legend(canvas.image.shape[1], solution, matches, marks)])


def encode_overlay(gray: ByteArray, solution: Solution, outlines: Outlines | None = None) -> bytes:
    """Encode a frame's overlay, with the evidence of its solution; see `draw_overlay`."""
    tried = solution.evidence
    drawn = draw_overlay(gray, solution, tried.matches, outlines, marks=tried.outline)
    return encode_picture(drawn, ".png")


def overlay_path(folder: Path, file: str) -> Path:
    """Return the path of a frame's overlay, by the full name: a.png and a.tif differ.

    A name too long for a file is cut, and made unique by its hash.
    """
    name = file.replace("/", "_").replace("\\", "_")
    if len(name.encode()) > MAX_NAME_BYTES - len(".png"):
        mark = hashlib.sha256(file.encode()).hexdigest()[:16]
        name = name.encode()[: MAX_NAME_BYTES - len(f"-{mark}.png")].decode(errors="ignore")
        name = f"{name}-{mark}"
    return folder / f"{name}.png"


def project_patches(
    projection: MapProjection,
    height_m: float,
    half_sizes_m: Iterable[float],
    camera: Camera,
    position_m: FloatArray,
    camera_from_body: Rotation,
) -> list[FloatArray]:
    """Project the borders (n, 2), px, of a control point's square patches, finest first.

    height_m      of the point above the sphere or plane of the map: the border is drawn level
    half_sizes_m  half a side of each level's patch, (size - 1) / 2 * posting
    """
    side = np.linspace(-1.0, 1.0, EDGE_POINTS)[:-1]
    ones = np.ones_like(side)
    x = np.concatenate([side, ones, -side, -ones])
    y = np.concatenate([ones, -side, -ones, side])
    matrix, heights = camera_from_body.as_matrix(), np.full(x.shape, height_m)
    borders = (projection.points(half * x, half * y, heights) for half in half_sizes_m)
    return [camera.project_from_body(border, position_m, matrix) for border in borders]


def _draw_patches(canvas: Canvas, patches: Sequence[FloatArray], level: int) -> None:
    """Draw outlines of a level's patches; none where they would cover the picture with a net."""
    shown = [patch for patch in patches if np.isfinite(patch).all()]
    if not shown:
        return
    sides = np.ptp(np.stack(shown), axis=1)
    field = np.ptp(np.concatenate(shown), axis=0)
    if sides.prod(axis=1).sum() > MAX_OVERLAP * field.prod() and len(shown) > 1:
        return
    blue, green, red = (round(v * FADING**level) for v in OUTLINE)
    for patch in shown:
        canvas.line(patch, (blue, green, red), 1, closed=True)


def _draw_matches(canvas: Canvas, matches: Sequence[MatchRow]) -> None:
    """Draw each point's marks, smaller where dense, and its number where there is room."""
    drawn = [match for match in matches if np.isfinite(match.predicted_px).all()]
    if not drawn:
        return
    middles = np.array([m.predicted_px if m.measured_px is None else m.measured_px for m in drawn])
    places = canvas.place(middles) / 2.0**SUBPIXEL_BITS
    scale = 1.0
    if len(drawn) > 1:
        nearest, _ = cKDTree(places).query(places, k=2)
        scale = float(np.clip(np.median(nearest[:, 1]) / ROOMY_PX, MIN_SCALE, 1.0))
    for match in drawn:
        _draw_match(canvas, match, scale)
    half = 7.0 * scale
    taken = np.column_stack([places - half, places + half])
    height, width = canvas.image.shape[:2]
    for number, match in enumerate(drawn):
        if match.measured_px is None:
            continue
        words, (x, y) = match.label, places[number]
        long, offset = measure_text(words), half + 2.0
        for left, foot in (
            *((x + offset, y - offset + 3.0), (x + offset, y + offset + LABEL_PX - 3.0)),
            *(
                (x - offset - long, y - offset + 3.0),
                (x - offset - long, y + offset + LABEL_PX - 3.0),
            ),
        ):
            box = np.array([left, foot - LABEL_PX, left + long, foot])
            inside = box[0] >= 0.0 and box[1] >= 0.0 and box[2] < width and box[3] < height
            apart = (box[:2] >= taken[:, 2:]) | (box[2:] <= taken[:, :2])
            if inside and apart.any(axis=1).all():
                canvas.text(words, left, foot, FOUND if match.used else REJECTED)
                taken = np.vstack([taken, box])
                break


def _draw_match(canvas: Canvas, match: MatchRow, scale: float) -> None:
    prior, width = match.prior_px, 2 if scale > 0.7 else 1
    if prior is not None:
        canvas.line(np.array([prior, match.predicted_px]), PRIOR, 1)
        canvas.diamond(prior, 5.0 * scale, PRIOR)
    canvas.ring(match.predicted_px, 7.0 * scale, PREDICTED, width)
    if match.measured_px is None:
        return
    mark = FOUND if match.used else REJECTED
    canvas.cross(match.measured_px, 5.0 * scale, mark, width)
    if match.used and match.residual_px is not None:
        tip = match.measured_px + RESIDUALS_ENLARGED * match.residual_px
        canvas.line(np.array([match.measured_px, tip]), RESIDUAL, width)
    elif not match.used:
        canvas.line(np.array([match.predicted_px, match.measured_px]), REJECTED, 1)


def _list_entries(
    matches: Sequence[MatchRow], marks: OutlineMarks | None
) -> list[tuple[str, tuple[int, int, int], str]]:
    """List signs, colours and words of the legend, for what is drawn."""
    residual = ("-", RESIDUAL, f"residual x{RESIDUALS_ENLARGED:.0f}")
    items = []
    if matches:
        n_measured = sum(match.measured_px is not None for match in matches)
        used = sum(match.used for match in matches)
        if any(match.prior_px is not None for match in matches):
            items.append(("d", PRIOR, "predicted by the prior"))
        items += [
            ("o", PREDICTED, f"by the solution ({len(matches)})"),
            ("x", FOUND, f"found and used ({used})"),
            ("x", REJECTED, f"found, left out ({n_measured - used})"),
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
    return [*items, residual] if items else []


def _draw_legend(
    width: int, solution: Solution, matches: Sequence[MatchRow], marks: OutlineMarks | None
) -> ByteArray:
    items = _list_entries(matches, marks)
    widths = [measure_text(words) + 44 for *_, words in items]
    rows = _wrap_items(widths, width)
    lines = _wrap_words(describe(solution), width - 20)
    top = 20.0 * len(lines) + 10.0
    height = round(top) + 26 * (len(rows) if items else 0)
    strip = Canvas(np.full((height, width, 3), 24, dtype=np.uint8), 1.0)
    for number, line in enumerate(lines):
        strip.text(line, 10, 20.0 * (number + 1), (235, 235, 235))
    for number, row in enumerate(rows):
        x, y = 18.0, top + 26.0 * number + 14.0
        for index in row:
            kind, colour, words = items[index]
            at = np.array([x, y - 4.0])
            if kind == "o":
                strip.ring(at, 6.0, colour)
            elif kind == ".":
                strip.dots(at[None], colour)
            elif kind == "d":
                strip.diamond(at, 5.0, colour)
            elif kind == "x":
                strip.cross(at, 5.0, colour)
            elif kind == "+":
                strip.aim(at, 8.0, colour)
            else:
                strip.line(np.array([at - (7.0, 0.0), at + (7.0, 0.0)]), colour, 2)
            strip.text(words, x + 13.0, y, (235, 235, 235))
            x += widths[index]
    return strip.image


def _wrap_items(widths: Sequence[int], available: int) -> list[list[int]]:
    """Wrap legend items into rows that fit, by index."""
    rows: list[list[int]] = [[]]
    used = 0
    for index, width in enumerate(widths):
        if rows[-1] and used + width > available:
            rows.append([])
            used = 0
        rows[-1].append(index)
        used += width
    return rows


def _wrap_words(words: str, available: int) -> list[str]:
    """Wrap words into lines that fit; cut what is longer than all of them."""
    words = words.encode("ascii", "replace").decode("ascii")  # the font has nothing else
    lines = [""]
    for word in words.split():
        if lines[-1] and measure_text(f"{lines[-1]} {word}") > available:
            lines.append("")
        lines[-1] = f"{lines[-1]} {word}".lstrip()
    if len(lines) > MAX_LINES:
        lines = [*lines[: MAX_LINES - 1], " ".join(lines[MAX_LINES - 1 :])]
    return [_cut_words(line, available) for line in lines]


def _cut_words(words: str, available: int) -> str:
    if measure_text(words) <= available:
        return words
    while len(words) > 4 and measure_text(f"{words}...") > available:
        words = words[: -max(1, len(words) // 16)]
    return f"{words}..."
