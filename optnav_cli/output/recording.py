"""run.mcap: a run as time-stamped Foxglove messages in JSON, to be looked at in a robotics viewer.

For each frame: the picture with its calibration, the predicted and the found control points, what
is known of the body's outline, the camera's pose in the body frame, the transform body to camera,
and one log line. Message times are the frames' UTC, so the same run gives the same bytes.
"""

import base64
import json
import re
from collections.abc import Iterable
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
from mcap.well_known import MessageEncoding, SchemaEncoding
from mcap.writer import Writer
from numpy.typing import NDArray

from catalog.arrays import FloatArray
from catalog.geometry.rotations import quaternion_from_rotation
from optnav_cli.camera.camera import Camera
from optnav_cli.fix import MatchRow, OutlineMarks, Solution
from optnav_cli.output import foxglove
from optnav_cli.output.canvas import eight_bits, encoded, resized, shrink_factor

Message = dict[str, Any]
MAX_PX = 2048  # a larger picture is recorded smaller, its calibration and marks with it
JPEG_QUALITY = 80
_TIME = re.compile(r"(\d{4}-\d\d-\d\d)[T ](\d\d):(\d\d)(?::(\d\d)(?:\.(\d*))?)?", re.ASCII)
Rgb = tuple[float, float, float]
MARK_PX, TEXT_PX = 14.0, 12.0  # for a picture of MAX_PX
DISC_PX, POINT_PX, LINE_PX = 60.0, 3.0, 2.0
PREDICTED, FOUND, REJECTED = (0.20, 0.75, 1.0), (0.25, 0.95, 0.35), (1.0, 0.35, 0.30)  # RGB
DISC = (1.0, 0.85, 0.2)
_CLEAR = {"r": 0.0, "g": 0.0, "b": 0.0, "a": 0.0}


class Recording:
    """Writes run.mcap frame by frame; a context manager that completes the file at its end."""

    def __init__(self, path: Path, body: str) -> None:
        """Begin a recording; `body` names the frame that positions refer to ("moon")."""
        self._path, self._body = path, body
        self._channels: dict[str, int] = {}
        self._schemas: dict[str, int] = {}
        self._sequence = 0
        self._last_ns = 0

    def __enter__(self) -> "Recording":
        self._file = self._path.open("wb")
        self._writer = Writer(self._file)
        self._writer.start(library="optnav")
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        try:
            if kind is None:
                self._writer.finish()  # type: ignore[no-untyped-call]
        finally:
            self._file.close()

    def add_frame(
        self,
        solution: Solution,
        matches: Iterable[MatchRow] = (),
        camera: Camera | None = None,
        picture: NDArray[np.generic] | None = None,
        marks: OutlineMarks | None = None,
    ) -> None:
        """Add what is known of one frame.

        picture  (h, w) as read; camera may be None only where the picture is
        marks    of the body's outline in it
        A frame whose time cannot be understood keeps the time of the frame before.
        """
        self._last_ns = nanoseconds(solution.utc, self._last_ns)
        if camera is not None:
            factor = shrink_factor(camera.width_px, camera.height_px, MAX_PX)
            place = f"/camera/{camera.name}"
            if picture is not None:
                small = resized(eight_bits(picture), factor)
                data = base64.b64encode(encoded(small, ".jpg", JPEG_QUALITY)).decode("ascii")
                content: Message = {"frame_id": camera.name, "data": data, "format": "jpeg"}
                self._write(f"{place}/image", foxglove.COMPRESSED_IMAGE, self._stamped(content))
            content = self._stamped(self._calibration(camera, factor))
            self._write(f"{place}/calibration", foxglove.CAMERA_CALIBRATION, content)
            size = factor * max(camera.width_px, camera.height_px) / MAX_PX
            drawn = Annotations(self._stamped({}), factor, size)
            drawn.add_matches(matches)
            if marks is not None:
                drawn.add_outline(marks)
            self._write(f"{place}/annotations", foxglove.IMAGE_ANNOTATIONS, drawn.message)
        if solution.position_m is not None and solution.camera_from_body is not None:
            position = dict(zip("xyz", map(float, solution.position_m), strict=True))
            # the camera's axes seen from the body
            quaternion = quaternion_from_rotation(solution.camera_from_body.inv())
            qw, qx, qy, qz = (float(v) for v in quaternion)
            orientation = {"x": qx, "y": qy, "z": qz, "w": qw}
            pose = {"position": position, "orientation": orientation}
            content = self._stamped({"frame_id": self._body, "pose": pose})
            self._write("/pose", foxglove.POSE_IN_FRAME, content)
            child = "camera" if camera is None else camera.name
            content = {"parent_frame_id": self._body, "child_frame_id": child}
            content |= {"translation": position, "rotation": orientation}
            self._write("/tf", foxglove.FRAME_TRANSFORM, self._stamped(content))
        level = foxglove.INFO if solution.solved else foxglove.WARNING
        content = {"level": level, "message": describe(solution), "name": "optnav"}
        content |= {"file": solution.file, "line": 0}
        self._write("/log", foxglove.LOG, self._stamped(content))

    def _write(self, topic: str, schema: foxglove.Schema, content: Message) -> None:
        title = schema["title"]
        if title not in self._schemas:
            self._schemas[title] = self._writer.register_schema(
                title, SchemaEncoding.JSONSchema, json.dumps(schema).encode()
            )
        if topic not in self._channels:
            self._channels[topic] = self._writer.register_channel(
                topic, MessageEncoding.JSON, self._schemas[title]
            )
        self._writer.add_message(
            self._channels[topic],
            log_time=self._last_ns,
            publish_time=self._last_ns,
            sequence=self._sequence,
            data=json.dumps(content, allow_nan=False).encode(),
        )
        self._sequence += 1

    def _stamped(self, content: Message) -> Message:
        seconds, nanoseconds = divmod(self._last_ns, 10**9)
        return {"timestamp": {"sec": seconds, "nsec": nanoseconds}, **content}

    def _calibration(self, camera: Camera, factor: float) -> Message:
        # A scaled picture keeps its corners, and pixel centres stand half a pixel inside them.
        cx, cy = ((c + 0.5) * factor - 0.5 for c in camera.principal_point_px)
        focal = camera.focal_length_px * factor
        fisheye = camera.model != "pinhole"
        terms = camera.coefficients or (0.0,) * (4 if fisheye else 5)
        return {
            "frame_id": camera.name,
            "width": max(1, round(camera.width_px * factor)),
            "height": max(1, round(camera.height_px * factor)),
            "distortion_model": "kannala_brandt" if fisheye else "plumb_bob",
            "D": list(terms),
            "K": [focal, 0.0, cx, 0.0, focal, cy, 0.0, 0.0, 1.0],
            "R": [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0],
            "P": [focal, 0.0, cx, 0.0, 0.0, focal, cy, 0.0, 0.0, 0.0, 1.0, 0.0],
        }


def describe(solution: Solution) -> str:
    """A frame's result in one line."""
    if not solution.solved or solution.covariance_m2 is None:
        return f"{solution.file}: unsolved: {solution.reason}"
    sigma = float(np.sqrt(np.trace(solution.covariance_m2) / 3.0))
    rms = "" if solution.residual_rms_px is None else f", rms {solution.residual_rms_px:.2f} px"
    remark = f" ({solution.reason})" if solution.reason else ""
    found = f"{solution.method.replace('_', ' ')}"
    if solution.n_used is not None:
        found = f"{solution.n_used} of {solution.n_predicted} control points"
    elif solution.n_limb is not None:
        found = f"{found}, {solution.n_limb} limb points"
    return f"{solution.file}: solved: {found}{rms}, sigma {sigma:.0f} m an axis{remark}"


def nanoseconds(utc: str, otherwise: int = 0) -> int:
    """Nanoseconds since 1970 of an ISO-8601 UTC time; `otherwise` for what is no such time."""
    match = _TIME.match(utc.strip())
    if match is None:
        return otherwise
    day, hour, minute, second, fraction = match.groups()
    try:
        start = datetime.fromisoformat(day).replace(tzinfo=UTC)
    except ValueError:
        return otherwise
    seconds = int(start.timestamp()) + 3600 * int(hour) + 60 * int(minute) + int(second or 0)
    return max(0, seconds * 10**9 + int(((fraction or "") + "0" * 9)[:9]))


class Annotations:
    """Collects the marks of one picture as a foxglove.ImageAnnotations message.

    stamp   the message's time, as a field of it
    factor  recorded pixels a pixel of the frame
    size    of the picture, share of one on which marks have the sizes above
    """

    def __init__(self, stamp: Message, factor: float, size: float) -> None:
        self._stamp, self._factor, self._size = stamp, factor, size
        self._circles: list[Message] = []
        self._points: list[Message] = []
        self._texts: list[Message] = []

    @property
    def message(self) -> Message:
        """What was added so far."""
        return {"circles": self._circles, "points": self._points, "texts": self._texts}

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
                text = {
                    **self._stamp,
                    "position": self._place(last + MARK_PX * self._size / self._factor),
                    "text": str(match.cp_id),
                    "font_size": TEXT_PX * self._size,
                    "text_color": _color(rgb),
                    "background_color": _CLEAR,
                    "metadata": [],
                }
                self._texts.append(text)

    def add_outline(self, outline: OutlineMarks) -> None:
        """Limb points, used and left out, with the fitted limb; or a disc's centre."""
        if outline.is_disc:
            self._circle(outline.points_px[0], DISC, DISC_PX, [])
            return
        for chosen, rgb in ((outline.used, FOUND), (~outline.used, REJECTED)):
            if chosen.any():
                self._line(foxglove.POINTS, outline.points_px[chosen], rgb, POINT_PX)
        for curve in outline.curves(0.0):
            self._line(foxglove.LINE_STRIP, curve, PREDICTED, LINE_PX)

    def _circle(self, pixel: FloatArray, rgb: Rgb, diameter: float, about: list[Message]) -> None:
        circle = {
            **self._stamp,
            "position": self._place(pixel),
            "diameter": diameter * self._size,
            "thickness": LINE_PX * self._size,
            "fill_color": _CLEAR,
            "outline_color": _color(rgb),
            "metadata": about,
        }
        self._circles.append(circle)

    def _line(self, kind: int, pixels: FloatArray, rgb: Rgb, thickness: float) -> None:
        line = {
            **self._stamp,
            "type": kind,
            "points": [self._place(pixel) for pixel in pixels],
            "outline_color": _color(rgb),
            "outline_colors": [],
            "fill_color": _CLEAR,
            "thickness": thickness * self._size,
            "metadata": [],
        }
        self._points.append(line)

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
