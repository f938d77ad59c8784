"""What is drawn over a recorded picture: control points, the body's outline."""

from collections.abc import Iterable
from typing import Any

import numpy as np

from catalog.arrays import FloatArray
from optnav_cli.output import foxglove
from optnav_cli.solution import MatchRow, OutlineMarks

Message = dict[str, Any]
Rgb = tuple[float, float, float]

MARK_PX, TEXT_PX = 14.0, 12.0  # for a picture of LONGEST_PX
DISC_PX, POINT_PX, LINE_PX = 60.0, 3.0, 2.0
PREDICTED, FOUND, REJECTED = (0.20, 0.75, 1.0), (0.25, 0.95, 0.35), (1.0, 0.35, 0.30)  # RGB
DISC = (1.0, 0.85, 0.2)
_CLEAR = {"r": 0.0, "g": 0.0, "b": 0.0, "a": 0.0}


class Annotations:
    """Collects the marks of one picture as a foxglove.ImageAnnotations message.

    stamp   the message's time
    factor  recorded pixels a pixel of the frame
    size    of the picture, share of one on which marks have the sizes above
    """

    def __init__(self, stamp: Message, factor: float, size: float) -> None:
        self._stamp, self._factor, self._size = stamp, factor, size
        self._circles: list[Message] = []
        self._points: list[Message] = []
        self._texts: list[Message] = []

    @property
    def message(self) -> tuple[foxglove.Schema, Message]:
        """What was added so far."""
        return foxglove.IMAGE_ANNOTATIONS, {
            "circles": self._circles,
            "points": self._points,
            "texts": self._texts,
        }

    def add_matches(self, matches: Iterable[MatchRow]) -> None:
        """Where control points were predicted and found; what has no place is skipped."""
        for match in matches:
            marks = [(match.predicted_px, PREDICTED, 1.6 * MARK_PX)]
            if match.measured_px is not None:
                marks.append((match.measured_px, FOUND if match.used else REJECTED, MARK_PX))
            for pixel, rgb, diameter in marks:
                if np.isfinite(pixel).all():
                    self._circle(pixel, rgb, diameter, _about(match))
            last, rgb, _ = marks[-1]
            if np.isfinite(last).all():
                self._text(last, rgb, str(match.cp_id))

    def add_outline(self, outline: OutlineMarks) -> None:
        """Limb points, used and left out, with the fitted limb; or a disc's centre."""
        if outline.is_disc:
            self._circle(outline.points_px[0], DISC, DISC_PX, [])
            return
        used = outline.used
        for chosen, rgb in ((used, FOUND), (~used, REJECTED)):
            if chosen.any():
                self._line(foxglove.POINTS, outline.points_px[chosen], rgb, POINT_PX)
        for curve in outline.curves(0.0):
            self._line(foxglove.LINE_STRIP, curve, PREDICTED, LINE_PX)

    def _circle(self, pixel: FloatArray, rgb: Rgb, diameter: float, about: list[Message]) -> None:
        self._circles.append(
            {
                "timestamp": self._stamp,
                "position": self._place(pixel),
                "diameter": diameter * self._size,
                "thickness": LINE_PX * self._size,
                "fill_color": _CLEAR,
                "outline_color": _color(rgb),
                "metadata": about,
            }
        )

    def _text(self, pixel: FloatArray, rgb: Rgb, words: str) -> None:
        self._texts.append(
            {
                "timestamp": self._stamp,
                "position": self._place(pixel + MARK_PX * self._size / self._factor),
                "text": words,
                "font_size": TEXT_PX * self._size,
                "text_color": _color(rgb),
                "background_color": _CLEAR,
                "metadata": [],
            }
        )

    def _line(self, kind: int, pixels: FloatArray, rgb: Rgb, thickness: float) -> None:
        self._points.append(
            {
                "timestamp": self._stamp,
                "type": kind,
                "points": [self._place(pixel) for pixel in pixels],
                "outline_color": _color(rgb),
                "outline_colors": [],
                "fill_color": _CLEAR,
                "thickness": thickness * self._size,
                "metadata": [],
            }
        )

    def _place(self, pixel: FloatArray) -> Message:
        x, y = ((float(v) + 0.5) * self._factor for v in pixel)
        return {"x": x, "y": y}


def _color(rgb: Rgb) -> Message:
    return {**dict(zip("rgb", rgb, strict=True)), "a": 1.0}


def _about(match: MatchRow) -> list[Message]:
    about = {"id": str(match.cp_id), "level": str(match.level)}
    if match.score is not None:
        about["score"] = f"{match.score:.3f}"
    if match.reason:
        about["why not used"] = match.reason
    return [{"key": key, "value": value} for key, value in about.items()]
