"""The Foxglove messages of a recording, as JSON schemas, and its 3D scene.

Names, fields and required fields are those of the published definitions
(docs.foxglove.dev, "Foxglove schemas", JSON). Pixels of annotations count from the top left
corner of the first pixel, where optnav counts from its centre: half a pixel is added.
"""

import re
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from catalog.arrays import FloatArray
from catalog.bodies.body import Body
from catalog.geometry.latlon import xyz_from_latlon
from catalog.geometry.rotations import quaternion_from_rotation
from catalog.terrain.relief.relief import GlobalRelief
from optnav_cli.camera.camera import Camera
from optnav_cli.fix import MatchRow, Solution

Schema = dict[str, Any]

INFO, WARNING = 2, 3  # of foxglove.LogLevel
POINTS, LINE_STRIP = 1, 3  # of foxglove.PointsAnnotationType
STRIP, SEGMENTS = 0, 2  # of foxglove.LineType
DELETE_ALL = 1  # of foxglove.SceneEntityDeletionType
_COUNT: Schema = {"type": "integer", "minimum": 0}
_NANOSECONDS: Schema = {"type": "integer", "minimum": 0, "maximum": 999_999_999}
_KINDS: dict[str, Schema] = {
    "number": {"type": "number"},
    "text": {"type": "string"},
    "base64": {"type": "string", "contentEncoding": "base64"},
    "count": _COUNT,
    "flag": {"type": "boolean"},
    "time": {
        "type": "object",
        "title": "time",
        "properties": {"sec": _COUNT, "nsec": _NANOSECONDS},
    },
    "duration": {
        "type": "object",
        "title": "duration",
        "properties": {"sec": {"type": "integer"}, "nsec": _NANOSECONDS},
    },
}
Message = dict[str, Any]
Rgb = tuple[float, float, float]
# Of cameras, by their number; all differ from the marks and are distinct for colour-blind people.
CAMERA_COLOURS: tuple[Rgb, ...] = (
    *((0.34, 0.71, 0.91), (0.90, 0.62, 0.0), (0.80, 0.47, 0.65), (0.94, 0.89, 0.26)),
    *((0.60, 0.60, 1.0), (0.75, 0.75, 0.75)),
)
PREDICTED, FOUND, REJECTED = (0.20, 0.75, 1.0), (0.25, 0.95, 0.35), (1.0, 0.35, 0.30)
PRIOR = (1.0, 0.55, 0.95)  # what the pose expected from which the search began
BODY_ROWS = 45  # of the drawn relief: steps of 4 degrees, a mesh of 0.5 MB before compression
BODY_SCALE = 0.995  # the body is drawn a little smaller, so that points stand on it
DARK, BRIGHT = 0.25, 0.85  # gray of the lowest and of the highest ground
# Marks by the height, but of no more than two radii: shares of that.
FRUSTUM, MARK, POINT = 0.3, 0.02, 0.01
BORDER_POINTS = 4  # of a frustum's far edge, along each side of the picture
ELLIPSOID_SIGMAS = 3.0
LINE_PX = 2.0
MAX_TRACK = 400  # places of a track; a longer one is thinned
MAX_GAP_NS = 600_500_000_000  # a track is not drawn across a longer pause, 10 minutes
_NO_TURN = {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0}
_NOWHERE = {"position": {"x": 0.0, "y": 0.0, "z": 0.0}, "orientation": _NO_TURN}
_PRIMITIVES = (
    *("arrows", "cubes", "spheres", "cylinders", "lines", "triangles", "texts"),
    "models",
)


def _define_choice(name: str, *values: str) -> None:
    """Define a kind of field that is one of some numbers, counted from 0."""
    options = [{"title": value, "const": number} for number, value in enumerate(values)]
    _KINDS[name] = {"title": f"foxglove.{name}", "oneOf": options}


_define_choice("LogLevel", "UNKNOWN", "DEBUG", "INFO", "WARNING", "ERROR", "FATAL")
_define_choice("PointsAnnotationType", "UNKNOWN", "POINTS", "LINE_LOOP", "LINE_STRIP", "LINE_LIST")
_define_choice("LineType", "LINE_STRIP", "LINE_LOOP", "LINE_LIST")
_define_choice("SceneEntityDeletionType", "MATCHING_ID", "ALL")
# NAME: description: fields as NAME:KIND; KIND[] and KIND[N] are lists, of N items. Each message is
# a kind of field for those after it.
_MESSAGES = """
Point2: A point in 2D: x:number y:number
Vector3: A vector in 3D: x:number y:number z:number
Quaternion: An orientation: x:number y:number z:number w:number
Color: Red, green, blue, alpha, each 0 to 1: r:number g:number b:number a:number
KeyValuePair: A key with its value: key:text value:text
Pose: A pose in 3D: position:Vector3 orientation:Quaternion
CircleAnnotation: A circle on a 2D image:
  timestamp:time position:Point2 diameter:number thickness:number
  fill_color:Color outline_color:Color metadata:KeyValuePair[]
PointsAnnotation: An array of points on a 2D image:
  timestamp:time type:PointsAnnotationType points:Point2[] outline_color:Color
  outline_colors:Color[] fill_color:Color thickness:number metadata:KeyValuePair[]
TextAnnotation: A text label on a 2D image:
  timestamp:time position:Point2 text:text font_size:number
  text_color:Color background_color:Color metadata:KeyValuePair[]
CompressedImage: A compressed image: timestamp:time frame_id:text data:base64 format:text
CameraCalibration: Camera calibration parameters:
  timestamp:time frame_id:text width:count height:count distortion_model:text
  D:number[] K:number[9] R:number[9] P:number[12]
ImageAnnotations: Array of annotations for a 2D image:
  circles:CircleAnnotation[] points:PointsAnnotation[] texts:TextAnnotation[]
PoseInFrame: A timestamped pose for an object or reference frame in 3D space:
  timestamp:time frame_id:text pose:Pose
FrameTransform: The position and orientation of a child frame within a parent frame:
  timestamp:time parent_frame_id:text child_frame_id:text translation:Vector3 rotation:Quaternion
Log: A log message:
  timestamp:time level:LogLevel message:text name:text file:text line:count
Point3: A point in 3D: x:number y:number z:number
ArrowPrimitive: An arrow: pose:Pose shaft_length:number shaft_diameter:number head_length:number
  head_diameter:number color:Color
CubePrimitive: A cube or a box: pose:Pose size:Vector3 color:Color
SpherePrimitive: A sphere or an ellipsoid: pose:Pose size:Vector3 color:Color
CylinderPrimitive: A cylinder or a truncated cone:
  pose:Pose size:Vector3 bottom_scale:number top_scale:number color:Color
LinePrimitive: A series of points connected by lines:
  type:LineType pose:Pose thickness:number scale_invariant:flag points:Point3[] color:Color
  colors:Color[] indices:count[]
TriangleListPrimitive: A set of triangles:
  pose:Pose points:Point3[] color:Color colors:Color[] indices:count[]
TextPrimitive: A text label: pose:Pose billboard:flag font_size:number scale_invariant:flag
  color:Color text:text
ModelPrimitive: A 3D model: pose:Pose scale:Vector3 color:Color override_color:flag url:text
  media_type:text data:base64
SceneEntity: A visual element in a 3D scene:
  timestamp:time frame_id:text id:text lifetime:duration frame_locked:flag metadata:KeyValuePair[]
  arrows:ArrowPrimitive[] cubes:CubePrimitive[] spheres:SpherePrimitive[]
  cylinders:CylinderPrimitive[] lines:LinePrimitive[] triangles:TriangleListPrimitive[]
  texts:TextPrimitive[] models:ModelPrimitive[]
SceneEntityDeletion: Command to remove entities: timestamp:time type:SceneEntityDeletionType id:text
SceneUpdate: An update to the entities displayed in a 3D scene:
  deletions:SceneEntityDeletion[] entities:SceneEntity[]
"""
for _text in re.split(r"\n(?=\w)", _MESSAGES.strip()):
    _name, _description, _fields = re.split(r":\s+", _text, maxsplit=2)
    _properties: dict[str, Schema] = {}
    for _key, _kind, _many, _size in re.findall(r"(\w+):(\w+)(\[(\d*)\])?", _fields):
        _limits = {"minItems": int(_size), "maxItems": int(_size)} if _size else {}
        _array = {"type": "array", "items": _KINDS[_kind], **_limits}
        _properties[_key] = _array if _many else _KINDS[_kind]
    _KINDS[_name] = {
        "title": f"foxglove.{_name}",
        "description": _description,
        "type": "object",
        "properties": _properties,
        "required": list(_properties),
    }
COMPRESSED_IMAGE = _KINDS["CompressedImage"]
CAMERA_CALIBRATION = _KINDS["CameraCalibration"]
CAMERA_CALIBRATION["required"] = []  # as it is published
IMAGE_ANNOTATIONS = _KINDS["ImageAnnotations"]
POSE_IN_FRAME, FRAME_TRANSFORM = _KINDS["PoseInFrame"], _KINDS["FrameTransform"]
LOG, SCENE_UPDATE = _KINDS["Log"], _KINDS["SceneUpdate"]
# What a frame's solution says, as numbers to plot; what is unknown is missing.
SOLUTION_TEXTS = ("file", "camera", "status", "method", "prior", "reason", "reason_code")
SOLUTION_COUNTS = ("n_predicted", "n_matched", "n_used", "n_limb")
SOLUTION_NUMBERS = (
    *("lat_deg", "lon_deg", "height_m", "sigma_x_m", "sigma_y_m", "sigma_z_m", "sigma_east_m"),
    *("sigma_north_m", "sigma_up_m", "sigma_m", "attitude_sigma_arcsec", "residual_rms_px"),
    *("arc_deg", "moved_from_prior_m"),
)
SOLUTION: Schema = {
    "title": "optnav.Solution",
    "description": "What is known of one frame",
    "type": "object",
    "properties": {
        "timestamp": _KINDS["time"],
        **dict.fromkeys(SOLUTION_TEXTS, _KINDS["text"]),
        **dict.fromkeys(SOLUTION_COUNTS, _COUNT),
        **dict.fromkeys(SOLUTION_NUMBERS, _KINDS["number"]),
    },
    "required": ["timestamp", *SOLUTION_TEXTS],
}


def make_color(rgb: Rgb, alpha: float = 1.0) -> Message:
    """Make a Color."""
    return {**dict(zip("rgb", rgb, strict=True)), "a": alpha}


def make_vector(values: FloatArray, decimals: int = 3) -> Message:
    """Make a Vector3 or Point3 of (3,) numbers."""
    return {axis: round(float(v), decimals) for axis, v in zip("xyz", values, strict=True)}


def make_pose(position_m: FloatArray, camera_from_body: Rotation) -> Message:
    """Make a Pose: the camera's axes seen from the body."""
    qw, qx, qy, qz = (float(v) for v in quaternion_from_rotation(camera_from_body.inv()))
    orientation = {"x": qx, "y": qy, "z": qz, "w": qw}
    return {"position": make_vector(position_m, 9), "orientation": orientation}


class RecordedScene:
    """Builder of SceneUpdate messages, with the track of each camera.

    cameras  names of the run's cameras, which have their colours in this order
    """

    def __init__(self, body: Body, cameras: Sequence[str] = ()) -> None:
        self._body = body
        self._cameras = list(cameras)
        self._tracks: dict[str, list[tuple[int, FloatArray]]] = {}

    def body(self, stamp: Message, relief: GlobalRelief | None) -> Message:
        """Draw the body: its relief, coarsely, or else its ellipsoid; a little smaller."""
        if relief is None:
            size = make_vector(2.0 * BODY_SCALE * np.array(self._body.radii_m))
            gray = (DARK + BRIGHT) / 2.0
            drawn = {
                "spheres": [{"pose": _NOWHERE, "size": size, "color": make_color((gray,) * 3)}]
            }
        else:
            drawn = {"triangles": [_draw_surface(relief)]}
        about = {"drawn": "relief" if relief else "ellipsoid", "scale": str(BODY_SCALE)}
        return _make_update(stamp, [self._make_entity(stamp, "body", about, **drawn)])

    def camera(
        self, stamp: Message, time_ns: int, name: str, solution: Solution, camera: Camera | None
    ) -> Message:
        """Draw a camera's track so far; pose, frustum, error and prior of a solved frame."""
        rgb = self._choose_colour(name)
        track = self._tracks.setdefault(name, [])
        entities = []
        if solution.position_m is not None:
            track.append((time_ns, solution.position_m))
            if len(track) > MAX_TRACK:
                del track[1:-1:2]
            entities.append(self._draw_pose(stamp, rgb, solution, solution.position_m, camera))
        lines = [_make_line(points, rgb, STRIP) for points in _split_track(track)]
        entities.append(self._make_entity(stamp, "track", {}, lines=lines))
        return _make_update(stamp, entities)

    def points(self, stamp: Message, solution: Solution, matches: Iterable[MatchRow]) -> Message:
        """Draw the control points of a frame by their outcome, with lines to those used."""
        spheres, sight = [], []
        position = solution.position_m
        for match in matches:
            rgb = PREDICTED if match.measured_px is None else REJECTED
            rgb = FOUND if match.used else rgb
            sight_m = match.cp_position_m if position is None else match.cp_position_m - position
            size = POINT * self._compute_unit(float(np.linalg.norm(sight_m)))
            spheres.append(_make_ellipsoid(match.cp_position_m, np.full(3, size), rgb))
            if match.used and position is not None:
                sight += [position, match.cp_position_m]
        lines = [_make_line(sight, FOUND, SEGMENTS, 0.35)] if sight else []
        about = {"file": solution.file, "points": str(len(spheres))}
        return _make_update(
            stamp, [self._make_entity(stamp, "points", about, spheres=spheres, lines=lines)]
        )

    def _draw_pose(
        self,
        stamp: Message,
        rgb: Rgb,
        solution: Solution,
        position: FloatArray,
        camera: Camera | None,
    ) -> Message:
        """Draw the solved position with its ellipsoid of 3 sigmas, the frustum, and the prior."""
        covariance = solution.covariance_m2
        unit = self._compute_unit(float(np.linalg.norm(position)) - self._body.radius_m)
        spheres, lines = [_make_ellipsoid(position, np.full(3, MARK * unit), rgb)], []
        if covariance is not None:
            squares, axes = np.linalg.eigh(covariance)
            size = 2.0 * ELLIPSOID_SIGMAS * np.sqrt(np.maximum(squares, 0.0))
            spheres.append(_make_ellipsoid(position, size, rgb, 0.35, axes))
        if camera is not None and solution.camera_from_body is not None:
            border = (
                camera.unproject(camera.border(BORDER_POINTS))
                @ solution.camera_from_body.as_matrix()
            )
            far = position + FRUSTUM * unit * border
            if np.isfinite(far).all():
                lines.append(_make_line([*far, far[0]], rgb, STRIP))
                edges = [end for corner in far[::BORDER_POINTS] for end in (position, corner)]
                lines.append(_make_line(edges, rgb, SEGMENTS))
        if solution.prior_m is not None:
            spheres.append(_make_ellipsoid(solution.prior_m, np.full(3, MARK * unit), PRIOR))
            lines.append(_make_line([solution.prior_m, position], PRIOR, STRIP))
        about = {"file": solution.file, "method": solution.method, "prior": solution.prior}
        return self._make_entity(stamp, "pose", about, spheres=spheres, lines=lines)

    def _compute_unit(self, away_m: float) -> float:
        return float(np.clip(away_m, 1e-3 * self._body.radius_m, 2.0 * self._body.radius_m))

    def _choose_colour(self, name: str) -> Rgb:
        if name not in self._cameras:
            self._cameras.append(name)
        return CAMERA_COLOURS[self._cameras.index(name) % len(CAMERA_COLOURS)]

    def _make_entity(self, stamp: Message, name: str, about: Message, **drawn: Any) -> Message:
        return {
            **stamp,
            "frame_id": self._body.name,
            "id": name,
            "lifetime": {"sec": 0, "nsec": 0},
            "frame_locked": True,
            "metadata": [{"key": key, "value": value} for key, value in about.items()],
            **{kind: drawn.get(kind, []) for kind in _PRIMITIVES},
        }


def _make_update(stamp: Message, entities: list[Message]) -> Message:
    """Make an update that replaces all that its topic showed."""
    return {"deletions": [{**stamp, "type": DELETE_ALL, "id": ""}], "entities": entities}


def _draw_surface(relief: GlobalRelief) -> Message:
    """Draw the relief as triangles on a grid; the ground is the brighter the higher."""
    lat = np.linspace(np.pi / 2.0, -np.pi / 2.0, BODY_ROWS + 1)
    lon = np.linspace(-np.pi, np.pi, 2 * BODY_ROWS, endpoint=False)
    lat, lon = (grid.ravel() for grid in np.meshgrid(lat, lon, indexing="ij"))
    heights = relief.heights_at(lat, lon)
    places = xyz_from_latlon(lat, lon, BODY_SCALE * (relief.radius_m + heights))
    low, high = float(heights.min()), float(heights.max())
    grays = DARK + (BRIGHT - DARK) * (heights - low) / max(high - low, 1e-9)
    row, column = (g.ravel() for g in np.mgrid[:BODY_ROWS, : 2 * BODY_ROWS])
    a, b = (row * 2 * BODY_ROWS + c for c in (column, (column + 1) % (2 * BODY_ROWS)))
    c, d = a + 2 * BODY_ROWS, b + 2 * BODY_ROWS
    return {
        "pose": _NOWHERE,
        "points": [make_vector(point, 0) for point in places],
        "color": make_color((BRIGHT,) * 3),
        "colors": [make_color((round(float(gray), 2),) * 3) for gray in grays],
        "indices": np.column_stack([a, c, b, b, c, d]).ravel().tolist(),
    }


def _split_track(track: Sequence[tuple[int, FloatArray]]) -> list[list[FloatArray]]:
    """Split the places of a track where it pauses; single places are left out."""
    stretches: list[list[FloatArray]] = [[]]
    last = 0
    for time_ns, position in track:
        if stretches[-1] and time_ns - last > MAX_GAP_NS:
            stretches.append([])
        stretches[-1].append(position)
        last = time_ns
    return [places for places in stretches if len(places) > 1]


def _make_ellipsoid(
    place: FloatArray,
    size_m: FloatArray,
    rgb: Rgb,
    alpha: float = 1.0,
    axes: FloatArray | None = None,
) -> Message:
    pose = {"position": make_vector(place), "orientation": _NO_TURN}
    if axes is not None:
        turn = Rotation.from_matrix(axes * np.sign(np.linalg.det(axes)))
        pose = make_pose(place, turn.inv())
    return {"pose": pose, "size": make_vector(size_m), "color": make_color(rgb, alpha)}


def _make_line(places: Sequence[FloatArray], rgb: Rgb, kind: int, alpha: float = 1.0) -> Message:
    return {
        "type": kind,
        "pose": _NOWHERE,
        "thickness": LINE_PX,
        "scale_invariant": True,
        "points": [make_vector(position) for position in places],
        "color": make_color(rgb, alpha),
        "colors": [],
        "indices": [],
    }
