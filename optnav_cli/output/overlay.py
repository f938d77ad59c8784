"""overlays/*.png: a frame with what was expected, what was found, and by how much they differ."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from catalog.geometry.tangent_plane import MapProjection
from optnav_cli.camera.camera import Camera
from optnav_cli.output.display import Colour, eight_bits, encoded, resized, shrink_factor
from optnav_cli.output.recording import describe
from optnav_cli.solution import MatchRow, Solution

FloatArray = NDArray[np.float64]
Outlines = Mapping[tuple[str, int], Sequence[FloatArray]]
LONGEST_PX = 1200
RESIDUALS_ENLARGED = 50.0
GRAY_STEP = 4  # levels of gray are thinned out: noise takes most of a PNG's bytes, nobody sees it
SHADE = 0.8  # the picture is dimmed a little under the marks
# Blue, green, red. Told apart by people with colour-blindness too, and by shape.
PREDICTED = (255, 190, 60)
FOUND = (90, 240, 110)
REJECTED = (80, 90, 255)
RESIDUAL = (60, 220, 255)
OUTLINE = (210, 170, 80)
LIMB = (60, 200, 255)
FADING = 0.75  # of the patch outlines from level to level, so that the large ones stay behind
FONT = cv2.FONT_HERSHEY_SIMPLEX
EDGE_POINTS = 5  # a patch's side is drawn through so many points, for fisheyes
SUBPIXEL_BITS = 4  # OpenCV draws at sixteenths of a pixel


@dataclass(frozen=True)
class _Canvas:
    """A colour picture and the way from the frame's pixels to its own."""

    image: Colour
    factor: float

    def place(self, pixels: FloatArray) -> NDArray[np.int32]:
        """(..., 2) frame pixels as OpenCV's fixed-point canvas coordinates."""
        scaled = (np.asarray(pixels) + 0.5) * self.factor - 0.5
        return np.asarray(np.rint(scaled * 2**SUBPIXEL_BITS), dtype=np.int32)

    def line(
        self, pixels: FloatArray, colour: tuple[int, int, int], width: int, closed: bool = False
    ) -> None:
        points = self.place(pixels)
        cv2.polylines(self.image, [points], closed, colour, width, cv2.LINE_AA, SUBPIXEL_BITS)

    def ring(self, pixel: FloatArray, radius: float, colour: tuple[int, int, int]) -> None:
        x, y = (int(v) for v in self.place(pixel))
        r = int(radius * 2**SUBPIXEL_BITS)
        cv2.circle(self.image, (x, y), r, colour, 2, cv2.LINE_AA, SUBPIXEL_BITS)

    def cross(self, pixel: FloatArray, arm: float, colour: tuple[int, int, int]) -> None:
        reach = arm / self.factor
        for dx, dy in ((reach, reach), (reach, -reach)):
            self.line(np.array([pixel - (dx, dy), pixel + (dx, dy)]), colour, 2)

    def dot(self, pixel: FloatArray, colour: tuple[int, int, int]) -> None:
        x, y = (int(v) for v in self.place(pixel))
        cv2.circle(self.image, (x, y), 2 << SUBPIXEL_BITS, colour, -1, cv2.LINE_AA, SUBPIXEL_BITS)

    def text(self, words: str, x: float, y: float, colour: tuple[int, int, int]) -> None:
        """Words with a dark rim, their lower left corner at canvas pixel x, y."""
        at = round(x), round(y)
        # A rim by shifting: OpenCV 5 spaces thick letters wider, so a thick copy would not fit.
        for dx, dy in ((-1, 0), (1, 0), (0, -1), (0, 1)):
            shifted = at[0] + dx, at[1] + dy
            cv2.putText(self.image, words, shifted, FONT, 0.45, (0, 0, 0), 1, cv2.LINE_AA)
        cv2.putText(self.image, words, at, FONT, 0.45, colour, 1, cv2.LINE_AA)


def draw_overlay(
    picture: NDArray[np.generic],
    solution: Solution,
    matches: Iterable[MatchRow],
    outlines: Outlines | None = None,
    longest_px: int = LONGEST_PX,
    *,
    limb_px: FloatArray | None = None,
) -> Colour:
    """Draw a frame's control points on its picture.

    picture   (h, w)  as read, any number type
    outlines  closed lines (n, 2), px, by catalog and control point id, see `patch_outlines`
    limb_px   (n, 2) limb points, drawn as dots
    Returns (h', w', 3) uint8 in OpenCV's order of colours, its longer side at most longest_px,
    with a strip below for the legend and the result.
    """
    matches = list(matches)
    factor = shrink_factor(picture.shape[1], picture.shape[0], longest_px)
    gray = resized(eight_bits(picture), factor)
    gray = np.asarray(gray * SHADE, dtype=np.uint8) // GRAY_STEP * GRAY_STEP
    canvas = _Canvas(np.asarray(cv2.cvtColor(gray, cv2.COLOR_GRAY2BGR), np.uint8), factor)
    for match in matches:
        for level, outline in enumerate((outlines or {}).get((match.catalog, match.cp_id), ())):
            if match.used and np.isfinite(outline).all():
                blue, green, red = (round(v * FADING**level) for v in OUTLINE)
                canvas.line(outline, (blue, green, red), 1, closed=True)
    for pixel in () if limb_px is None else limb_px:
        canvas.dot(pixel, LIMB)
    for match in matches:
        _draw_match(canvas, match)
    return np.vstack([canvas.image, _legend(canvas.image.shape[1], solution, matches, limb_px)])


def write_overlay(
    folder: Path,
    picture: NDArray[np.generic],
    solution: Solution,
    matches: Iterable[MatchRow],
    outlines: Outlines | None = None,
    *,
    limb_px: FloatArray | None = None,
) -> Path:
    """Write folder/NAME.png for a frame and return its path; the folder is made when missing."""
    path = overlay_path(folder, solution.file)
    path.parent.mkdir(parents=True, exist_ok=True)
    drawn = draw_overlay(picture, solution, matches, outlines, limb_px=limb_px)
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
    return [
        camera.project_from_body(
            projection.points(half * x, half * y, np.full(x.shape, height_m)),
            position_m,
            camera_from_body.as_matrix(),
        )
        for half in half_sizes_m
    ]


def _draw_match(canvas: _Canvas, match: MatchRow) -> None:
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


def _legend(
    width: int, solution: Solution, matches: Sequence[MatchRow], limb_px: FloatArray | None
) -> Colour:
    found = sum(match.measured_px is not None for match in matches)
    used = sum(match.used for match in matches)
    items = [
        ("o", PREDICTED, f"predicted ({len(matches)})"),
        ("x", FOUND, f"found and used ({used})"),
        ("x", REJECTED, f"found, not used ({found - used})"),
        ("-", RESIDUAL, f"residual x{RESIDUALS_ENLARGED:.0f}"),
    ]
    if limb_px is not None:
        items.append((".", LIMB, f"limb ({len(limb_px)})"))
    widths = [_text_width(words) + 44 for *_, words in items]
    rows = _rows_of(widths, width)
    strip = _Canvas(np.full((26 * (len(rows) + 1) + 6, width, 3), 24, dtype=np.uint8), 1.0)
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
    while len(words) > 4 and _text_width(words) > available:
        words = words[:-4] + "..."
    return words


def _text_width(words: str) -> int:
    (width, _), _ = cv2.getTextSize(words, FONT, 0.45, 1)
    return int(width)
