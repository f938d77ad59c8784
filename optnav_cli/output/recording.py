"""run.mcap: a run as time-stamped Foxglove messages in JSON, to be looked at in a robotics viewer.

The body once. For each frame, under /camera/NAME: the picture with its calibration, where control
points were predicted and found, what is known of the body's outline, the pose by the solution and
by the prior, the 3D scene, the solution in numbers; the transform body to camera and one log line.
Message times are the frames' UTC, so the same run gives the same bytes.
"""

import base64
import json
import re
from collections.abc import Iterable, Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Self

import msgspec
import numpy as np
from mcap.well_known import MessageEncoding, SchemaEncoding
from mcap.writer import Writer
from scipy.spatial.transform import Rotation

from catalog.arrays import ByteArray, FloatArray
from catalog.bodies.body import Body
from catalog.bodies.epochs import utc_from_tdb_s, utc_to_tdb_s
from catalog.errors import DataError
from catalog.geometry.ellipsoid import geodetic_from_xyz
from catalog.geometry.latlon import latlon_from_xyz
from catalog.geometry.rotations import ARCSEC, rnb_axes
from catalog.terrain.relief.relief import GlobalRelief
from optnav_cli.camera.camera import Camera
from optnav_cli.fix import MatchRow, OutlineMarks, Solution
from optnav_cli.output import foxglove
from optnav_cli.output.canvas import compute_shrink_factor, encode_picture, resize_picture
from optnav_cli.output.foxglove import (
    FOUND,
    PREDICTED,
    PRIOR,
    REJECTED,
    Message,
    RecordedScene,
    Rgb,
    make_color,
    make_pose,
)
from optnav_cli.output.wording import format_length

NO_CAMERA = "camera"  # the name of a camera that has no file
MAX_PX = 2048  # a larger picture is recorded smaller, its calibration and marks with it
JPEG_QUALITY = 80
_TIME = re.compile(r"(\d{4}-\d\d-\d\d)[T ](\d\d):(\d\d)(?::(\d\d)(?:\.(\d*))?)?", re.ASCII)
MARK_PX, TEXT_PX = 14.0, 12.0  # for a picture of MAX_PX
DISC_PX, POINT_PX, LINE_PX = 60.0, 3.0, 2.0
DISC = (1.0, 0.85, 0.2)
_CLEAR = {"r": 0.0, "g": 0.0, "b": 0.0, "a": 0.0}


class MessageLog:
    """An MCAP file of Foxglove messages; a context manager that completes it at its end."""

    def __init__(self, path: Path, about: Mapping[str, str] | None = None) -> None:
        """about: what it was made by and from, the file's metadata record."""
        self._path, self._about = path, dict(about or {})
        self._channels: dict[str, int] = {}
        self._schemas: dict[str, int] = {}
        self._sequence = 0
        self._last_ns = 0

    def __enter__(self) -> Self:
        self._file = self._path.open("wb")
        self._writer = Writer(self._file)
        self._writer.start(library="optnav")
        if self._about:
            self._writer.add_metadata("optnav", self._about)
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        try:
            if kind is None:
                self._writer.finish()  # type: ignore[no-untyped-call]
        finally:
            self._file.close()

    def set_time(self, utc: str) -> None:
        """Set the time of the messages that follow; a wrong or earlier time changes nothing.

        A leap second's readings come twice: time stands still rather than going back.
        """
        self._last_ns = max(parse_nanoseconds(utc, self._last_ns), self._last_ns)

    def add(self, topic: str, schema: foxglove.Schema, content: Message) -> None:
        """Add one message, stamped with the time that was set."""
        self._append(topic, schema, _encode(self._add_stamp(content)))

    def _append(self, topic: str, schema: foxglove.Schema, data: bytes) -> None:
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
            data=data,
        )
        self._sequence += 1

    @property
    def _stamp(self) -> Message:
        seconds, nanoseconds = divmod(self._last_ns, 10**9)
        return {"timestamp": {"sec": seconds, "nsec": nanoseconds}}

    def _add_stamp(self, content: Message) -> Message:
        return {**self._stamp, **content}


class Recording(MessageLog):
    """Recording of a run, run.mcap, frame by frame."""

    def __init__(
        self,
        path: Path,
        body: Body,
        relief: GlobalRelief | None = None,
        cameras: Sequence[str] = (),
        about: Mapping[str, str] | None = None,
    ) -> None:
        """Begin a recording.

        body     whose frame positions refer to; its name is that frame's
        relief   of the whole body, to be shown, where there is one
        cameras  names of the run's cameras, in the order of their colours
        about    what the run was made by and from: the file's metadata record
        """
        super().__init__(path, about)
        self._body, self._relief = body, relief
        self._scene = RecordedScene(body, cameras)
        self._made: list[tuple[str, foxglove.Schema, bytes]] = []

    def add_frame(
        self,
        solution: Solution,
        matches: Iterable[MatchRow] = (),
        camera: Camera | None = None,
        image: bytes = b"",
        marks: OutlineMarks | None = None,
    ) -> None:
        """Add what is known of one frame.

        image    of `encode_recorded_image`, empty for none; camera may be None only where it is
        marks    of the body's outline in it
        A frame whose time cannot be understood keeps the time of the frame before.
        """
        self.set_time(solution.utc)
        self._made = []
        name, matches = camera.name if camera else NO_CAMERA, list(matches)
        topic = format_topic(name, "")
        if not self._sequence:
            self._write("/body", foxglove.SCENE_UPDATE, self._scene.body(self._stamp, self._relief))
        if camera is not None:
            factor = compute_shrink_factor(camera.width_px, camera.height_px, MAX_PX)
            if image:
                data = base64.b64encode(image).decode("ascii")
                content: Message = {"data": data, "format": "jpeg"}
                content |= {"frame_id": self._get_frame_name(name)}
                self._write(f"{topic}image", foxglove.COMPRESSED_IMAGE, self._add_stamp(content))
            content = self._add_stamp(self._describe_calibration(camera, factor))
            self._write(f"{topic}calibration", foxglove.CAMERA_CALIBRATION, content)
            size = factor * max(camera.width_px, camera.height_px) / MAX_PX
            drawn = Annotations(self._stamp, factor, size)
            drawn.add_matches(matches)
            if marks is not None:
                drawn.add_outline(marks)
            self._write(f"{topic}annotations", foxglove.IMAGE_ANNOTATIONS, drawn.message)
        if solution.position_m is not None and solution.camera_from_body is not None:
            self._add_pose(name, solution.position_m, solution.camera_from_body)
            if solution.prior_m is not None:
                pose = make_pose(solution.prior_m, solution.camera_from_body)
                content = self._add_stamp({"frame_id": self._body.name, "pose": pose})
                self._write(f"{topic}predicted", foxglove.POSE_IN_FRAME, content)
        scene = self._scene.camera(self._stamp, self._last_ns, name, solution, camera)
        self._write(f"{topic}scene", foxglove.SCENE_UPDATE, scene)
        points = self._scene.points(self._stamp, solution, matches)
        self._write(f"{topic}control_points", foxglove.SCENE_UPDATE, points)
        content = self._add_stamp(_list_numbers(solution, name, self._body))
        self._write(f"{topic}solution", foxglove.SOLUTION, content)
        level = foxglove.INFO if solution.solved else foxglove.WARNING
        content = {"level": level, "message": describe(solution), "name": "optnav"}
        content |= {"file": solution.file, "line": 0}
        self._write("/log", foxglove.LOG, self._add_stamp(content))
        for message in self._made:  # all or none: a frame that cannot be drawn leaves no half of it
            self._append(*message)

    def _add_pose(self, name: str, position_m: FloatArray, camera_from_body: Rotation) -> None:
        body, pose = self._body.name, make_pose(position_m, camera_from_body)
        content = self._add_stamp({"frame_id": body, "pose": pose})
        self._write(format_topic(name, "pose"), foxglove.POSE_IN_FRAME, content)
        content = {"parent_frame_id": body, "child_frame_id": self._get_frame_name(name)}
        content |= {"translation": pose["position"], "rotation": pose["orientation"]}
        self._write("/tf", foxglove.FRAME_TRANSFORM, self._add_stamp(content))

    def _get_frame_name(self, name: str) -> str:
        """Get the frame of a camera; never that of the body."""
        return name if name != self._body.name else f"{name} camera"

    def _write(self, topic: str, schema: foxglove.Schema, content: Message) -> None:
        self._made.append((topic, schema, _encode(content)))

    def _describe_calibration(self, camera: Camera, factor: float) -> Message:
        # A scaled picture keeps its corners, and pixel centres stand half a pixel inside them.
        cx, cy = ((c + 0.5) * factor - 0.5 for c in camera.principal_point_px)
        focal = camera.focal_length_px * factor
        focal_y = focal * camera.aspect
        fisheye = camera.model != "pinhole"
        terms = camera.coefficients or (0.0,) * (4 if fisheye else 5)
        if len(terms) == 4 and not fisheye:
            terms = (*terms, 0.0)
        pinhole = "plumb_bob" if len(terms) == 5 else "rational_polynomial"  # of 8 terms
        return {
            "frame_id": self._get_frame_name(camera.name),
            "width": max(1, round(camera.width_px * factor)),
            "height": max(1, round(camera.height_px * factor)),
            "distortion_model": "kannala_brandt" if fisheye else pinhole,
            "D": list(terms[:8]),
            "K": [focal, 0.0, cx, 0.0, focal_y, cy, 0.0, 0.0, 1.0],
            "R": [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0],
            "P": [focal, 0.0, cx, 0.0, 0.0, focal_y, cy, 0.0, 0.0, 0.0, 1.0, 0.0],
        }


def _encode(content: Message) -> bytes:
    """Encode a message as JSON. Raises ValueError for a number that is not finite."""
    try:
        data = msgspec.json.encode(content, enc_hook=float)
        # null stands for None, or for a number that is not finite: json tells them apart
        exact = b"null" not in data
    except UnicodeEncodeError:  # the name of a file that is no UTF-8
        exact = False
    return data if exact else json.dumps(content, allow_nan=False).encode()


def encode_recorded_image(gray: ByteArray, camera: Camera) -> bytes:
    """Encode a camera's picture (h, w), from `scale_to_eight_bits`, as a JPEG of MAX_PX."""
    factor = compute_shrink_factor(camera.width_px, camera.height_px, MAX_PX)
    return encode_picture(resize_picture(gray, factor), ".jpg", JPEG_QUALITY)


def format_topic(camera: str, what: str) -> str:
    """Format the topic of something of a camera."""
    return f"/camera/{camera}/{what}"


def _list_numbers(solution: Solution, camera: str, body: Body) -> Message:
    """List the fields of an optnav.Solution: what is unknown is left out."""
    texts = {name: str(getattr(solution, name, "")) for name in foxglove.SOLUTION_TEXTS}
    numbers: dict[str, float | None] = {
        name: getattr(solution, name) for name in (*foxglove.SOLUTION_COUNTS, "residual_rms_px")
    }
    numbers["arc_deg"] = solution.arc_deg
    if solution.attitude_sigma_rad is not None:
        numbers["attitude_sigma_arcsec"] = solution.attitude_sigma_rad / ARCSEC
    position, covariance = solution.position_m, solution.covariance_m2
    if position is not None:
        lat, lon, radius = (float(v) for v in latlon_from_xyz(position))
        numbers |= {"lat_deg": float(np.degrees(lat)), "lon_deg": float(np.degrees(lon))}
        numbers["height_m"] = radius - body.radius_m
        if body.flattening:
            geodetic, _, height = geodetic_from_xyz(position, body.radii_m)
            numbers["lat_geodetic_deg"] = float(np.degrees(geodetic))
            numbers["height_ellipsoid_m"] = float(height)
        if solution.prior_m is not None:
            numbers["moved_from_prior_m"] = float(np.linalg.norm(position - solution.prior_m))
        if covariance is not None:
            polar = np.hypot(position[0], position[1]) < 1e-9 * radius  # any direction is north
            axes = rnb_axes(position, (1.0, 0.0, 0.0) if polar else (0.0, 0.0, 1.0))
            for names, turn in (("xyz", np.eye(3)), (("up", "north", "east"), axes)):
                sigmas = np.sqrt(np.maximum(np.diag(turn @ covariance @ turn.T), 0.0))
                numbers |= {f"sigma_{n}_m": float(s) for n, s in zip(names, sigmas, strict=True)}
            numbers["sigma_m"] = float(np.sqrt(np.trace(covariance) / 3.0))
    known = {name: value for name, value in numbers.items() if value is not None}
    return {**texts, "camera": camera, **{k: v for k, v in known.items() if np.isfinite(v)}}


def describe(solution: Solution) -> str:
    """Describe a frame's result in one line."""
    if not solution.solved or solution.covariance_m2 is None:
        return f"{solution.file}: unsolved: {solution.reason}"
    sigma = float(np.sqrt(np.trace(solution.covariance_m2) / 3.0))
    rms = "" if solution.residual_rms_px is None else f", rms {solution.residual_rms_px:.2f} px"
    remark = f" ({solution.reason})" if solution.reason else ""
    basis = f"{solution.method.replace('_', ' ')}"
    if solution.n_used is not None:
        basis = f"{solution.n_used} of {solution.n_predicted} control points"
    elif solution.n_limb is not None:
        basis = f"{basis}, {solution.n_limb} limb points"
    return f"{solution.file}: solved: {basis}{rms}, sigma {format_length(sigma)} an axis{remark}"


def parse_nanoseconds(utc: str, otherwise: int = 0) -> int:
    """Parse an ISO-8601 UTC time to nanoseconds since 1970; `otherwise` for what is none."""
    match = _TIME.match(utc.strip())
    if match is None:  # a day of year, or no separators
        try:
            match = _TIME.match(utc_from_tdb_s(utc_to_tdb_s(utc)))
        except DataError:
            match = None
    if match is None:
        return otherwise
    day, hour, minute, second, fraction = match.groups()
    try:
        start = datetime.fromisoformat(day).replace(tzinfo=UTC)
    except ValueError:
        return otherwise
    seconds = int(start.timestamp()) + 3600 * int(hour) + 60 * int(minute) + int(second or 0)
    # the file's times have 64 bits, which end in 2554
    return min(max(0, seconds * 10**9 + int(((fraction or "") + "0" * 9)[:9])), 2**64 - 1)


class Annotations:
    """Marks of one picture, collected to a foxglove.ImageAnnotations message.

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
        """Message of the marks added so far."""
        return {"circles": self._circles, "points": self._points, "texts": self._texts}

    def add_matches(self, matches: Iterable[MatchRow]) -> None:
        """Add where points were expected, by the prior and at last, and measured."""
        for match in matches:
            marks = [(match.predicted_px, PREDICTED, 1.6 * MARK_PX)]
            if match.prior_px is not None:
                marks.insert(0, (match.prior_px, PRIOR, 0.7 * MARK_PX))
            if match.measured_px is not None:
                marks.append((match.measured_px, FOUND if match.used else REJECTED, MARK_PX))
            for pixel, rgb, diameter in marks:
                if np.isfinite(pixel).all():
                    self._add_circle(pixel, rgb, diameter, _describe_match(match))
            last, rgb, _ = marks[-1]
            if np.isfinite(last).all():
                text = {
                    **self._stamp,
                    "position": self._place(last + MARK_PX * self._size / self._factor),
                    "text": match.label,
                    "font_size": TEXT_PX * self._size,
                    "text_color": make_color(rgb),
                    "background_color": _CLEAR,
                    "metadata": [],
                }
                self._texts.append(text)

    def add_outline(self, outline: OutlineMarks) -> None:
        """Add limb points, used and left out, with the fitted limb; or a disc's centre."""
        if outline.is_disc:
            self._add_circle(outline.points_px[0], DISC, DISC_PX, [])
            return
        for chosen, rgb in ((outline.used, FOUND), (~outline.used, REJECTED)):
            if chosen.any():
                self._add_line(foxglove.POINTS, outline.points_px[chosen], rgb, POINT_PX)
        for curve in outline.curves(0.0):
            self._add_line(foxglove.LINE_STRIP, curve, PREDICTED, LINE_PX)

    def _add_circle(
        self, pixel: FloatArray, rgb: Rgb, diameter: float, about: list[Message]
    ) -> None:
        circle = {
            **self._stamp,
            "position": self._place(pixel),
            "diameter": diameter * self._size,
            "thickness": LINE_PX * self._size,
            "fill_color": _CLEAR,
            "outline_color": make_color(rgb),
            "metadata": about,
        }
        self._circles.append(circle)

    def _add_line(self, kind: int, pixels: FloatArray, rgb: Rgb, thickness: float) -> None:
        columns = ((pixels + 0.5) * self._factor).T.tolist()
        line = {
            **self._stamp,
            "type": kind,
            "points": [{"x": x, "y": y} for x, y in zip(*columns, strict=True)],
            "outline_color": make_color(rgb),
            "outline_colors": [],
            "fill_color": _CLEAR,
            "thickness": thickness * self._size,
            "metadata": [],
        }
        self._points.append(line)

    def _place(self, pixel: FloatArray) -> Message:
        x, y = ((float(v) + 0.5) * self._factor for v in pixel)
        return {"x": x, "y": y}


def _describe_match(match: MatchRow) -> list[Message]:
    about = {"id": match.label, "level": str(match.level)}
    if match.score is not None:
        about["score"] = f"{match.score:.3f}"
    if match.reason:
        about["why not used"] = match.reason
    return [{"key": key, "value": value} for key, value in about.items()]
