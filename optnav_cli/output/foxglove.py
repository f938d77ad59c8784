"""The well-known Foxglove messages that a recording holds, as JSON schemas.

Names, fields and required fields are those of the published definitions
(docs.foxglove.dev, "Foxglove schemas", JSON). Pixels of annotations count from the top left
corner of the first pixel, where optnav counts from its centre: half a pixel is added.
"""

import re
from typing import Any

Schema = dict[str, Any]

INFO, WARNING = 2, 3  # of foxglove.LogLevel
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


def _choice(name: str, *values: str) -> None:
    """A kind of field that is one of some numbers, counted from 0."""
    options = [{"title": value, "const": number} for number, value in enumerate(values)]
    _KINDS[name] = {"title": f"foxglove.{name}", "oneOf": options}


_choice("LogLevel", "UNKNOWN", "DEBUG", "INFO", "WARNING", "ERROR", "FATAL")
_choice("PointsAnnotationType", "UNKNOWN", "POINTS", "LINE_LOOP", "LINE_STRIP", "LINE_LIST")
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
LOG = _KINDS["Log"]
