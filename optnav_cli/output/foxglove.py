"""The Foxglove messages that a recording holds, as JSON schemas, and one message of our own.

Names, fields and required fields are those of the published definitions
(docs.foxglove.dev, "Foxglove schemas", JSON). Pixels of annotations count from the top left
corner of the first pixel, where optnav counts from its centre: half a pixel is added.
"""

import re
from typing import Any

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
