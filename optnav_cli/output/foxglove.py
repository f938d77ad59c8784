"""The well-known Foxglove messages that a recording holds, as JSON schemas.

Names, fields and required fields are those of the published definitions
(docs.foxglove.dev, "Foxglove schemas", JSON). Pixels of annotations count from the top left
corner of the first pixel, where optnav counts from its centre: half a pixel is added.
"""

import re
from typing import Any

Schema = dict[str, Any]

DEBUG, INFO, WARNING, ERROR = 1, 2, 3, 4  # of foxglove.LogLevel
POINTS, LINE_STRIP = 1, 3  # of foxglove.PointsAnnotationType
_COUNT: Schema = {"type": "integer", "minimum": 0}
_NANOSECONDS: Schema = {"type": "integer", "minimum": 0, "maximum": 999_999_999}
_KINDS: dict[str, Schema] = {
    "number": {"type": "number"},
    "text": {"type": "string"},
    "base64": {"type": "string", "contentEncoding": "base64"},
    "count": _COUNT,
    "time": {
        "type": "object",
        "title": "time",
        "properties": {"sec": _COUNT, "nsec": _NANOSECONDS},
    },
}


def _message(name: str, description: str, fields: str) -> Schema:
    """A message, from then on a kind of field itself.

    fields  "NAME:KIND ..."; KIND[] and KIND[N] are lists, of N items
    """
    properties: dict[str, Schema] = {}
    for field in fields.split():
        key, kind, many, size = re.findall(r"(\w+):(\w+)(\[(\d*)\])?", field)[0]
        limits = {"minItems": int(size), "maxItems": int(size)} if size else {}
        items = _KINDS[kind]
        properties[key] = {"type": "array", "items": items, **limits} if many else items
    _KINDS[name] = {
        "title": f"foxglove.{name}",
        "description": description,
        "type": "object",
        "properties": properties,
        "required": list(properties),
    }
    return _KINDS[name]


def _choice(name: str, *values: str) -> None:
    """A kind of field that is one of some numbers, counted from 0."""
    options = [{"title": value, "const": number} for number, value in enumerate(values)]
    _KINDS[name] = {"title": f"foxglove.{name}", "oneOf": options}


_choice("LogLevel", "UNKNOWN", "DEBUG", "INFO", "WARNING", "ERROR", "FATAL")
_choice("PointsAnnotationType", "UNKNOWN", "POINTS", "LINE_LOOP", "LINE_STRIP", "LINE_LIST")
_PARTS = """
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
"""
for _part in re.split(r"\n(?=\w)", _PARTS.strip()):
    _message(*re.split(r":\s+", _part, maxsplit=2))
COMPRESSED_IMAGE = _message(
    "CompressedImage", "A compressed image", "timestamp:time frame_id:text data:base64 format:text"
)
CAMERA_CALIBRATION = _message(
    "CameraCalibration",
    "Camera calibration parameters",
    "timestamp:time frame_id:text width:count height:count distortion_model:text "
    "D:number[] K:number[9] R:number[9] P:number[12]",
)
CAMERA_CALIBRATION["required"] = []  # as it is published
IMAGE_ANNOTATIONS = _message(
    "ImageAnnotations",
    "Array of annotations for a 2D image",
    "circles:CircleAnnotation[] points:PointsAnnotation[] texts:TextAnnotation[]",
)
POSE_IN_FRAME = _message(
    "PoseInFrame",
    "A timestamped pose for an object or reference frame in 3D space",
    "timestamp:time frame_id:text pose:Pose",
)
FRAME_TRANSFORM = _message(
    "FrameTransform",
    "The position and orientation of a child frame within a parent frame",
    "timestamp:time parent_frame_id:text child_frame_id:text "
    "translation:Vector3 rotation:Quaternion",
)
LOG = _message(
    "Log",
    "A log message",
    "timestamp:time level:LogLevel message:text name:text file:text line:count",
)
