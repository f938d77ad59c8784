"""The well-known Foxglove messages that a recording holds, as JSON schemas.

Names, fields and required fields are those of the published definitions
(docs.foxglove.dev, "Foxglove schemas", JSON). Pixels of annotations count from the top left
corner of the first pixel, where optnav counts from its centre: half a pixel is added.
"""

from typing import Any

Schema = dict[str, Any]

NUMBER: Schema = {"type": "number"}
TEXT: Schema = {"type": "string"}
COUNT: Schema = {"type": "integer", "minimum": 0}
DEBUG, INFO, WARNING, ERROR = 1, 2, 3, 4  # of foxglove.LogLevel
POINTS, LINE_STRIP = 1, 3  # of foxglove.PointsAnnotationType


def _message(title: str, description: str, **fields: Schema) -> Schema:
    return {
        "title": title,
        "description": description,
        "type": "object",
        "properties": fields,
        "required": list(fields),
    }


def _list(items: Schema, size: int | None = None) -> Schema:
    limits = {} if size is None else {"minItems": size, "maxItems": size}
    return {"type": "array", "items": items, **limits}


def _choice(title: str, **values: int) -> Schema:
    return {"title": title, "oneOf": [{"title": k, "const": v} for k, v in values.items()]}


_TIME: Schema = {
    "type": "object",
    "title": "time",
    "properties": {
        "sec": COUNT,
        "nsec": {"type": "integer", "minimum": 0, "maximum": 999_999_999},
    },
}
_POINT2 = _message("foxglove.Point2", "A point in 2D", x=NUMBER, y=NUMBER)
_VECTOR3 = _message("foxglove.Vector3", "A vector in 3D", x=NUMBER, y=NUMBER, z=NUMBER)
_QUATERNION = _message(
    "foxglove.Quaternion", "An orientation", x=NUMBER, y=NUMBER, z=NUMBER, w=NUMBER
)
_COLOR = _message(
    "foxglove.Color", "Red, green, blue, alpha, each 0 to 1", r=NUMBER, g=NUMBER, b=NUMBER, a=NUMBER
)
_PAIR = _message("foxglove.KeyValuePair", "A key with its value", key=TEXT, value=TEXT)

COMPRESSED_IMAGE = _message(
    "foxglove.CompressedImage",
    "A compressed image",
    timestamp=_TIME,
    frame_id=TEXT,
    data={"type": "string", "contentEncoding": "base64"},
    format=TEXT,
)
CAMERA_CALIBRATION = _message(
    "foxglove.CameraCalibration",
    "Camera calibration parameters",
    timestamp=_TIME,
    frame_id=TEXT,
    width=COUNT,
    height=COUNT,
    distortion_model=TEXT,
    D=_list(NUMBER),
    K=_list(NUMBER, 9),
    R=_list(NUMBER, 9),
    P=_list(NUMBER, 12),
)
IMAGE_ANNOTATIONS = _message(
    "foxglove.ImageAnnotations",
    "Array of annotations for a 2D image",
    circles=_list(
        _message(
            "foxglove.CircleAnnotation",
            "A circle on a 2D image",
            timestamp=_TIME,
            position=_POINT2,
            diameter=NUMBER,
            thickness=NUMBER,
            fill_color=_COLOR,
            outline_color=_COLOR,
            metadata=_list(_PAIR),
        )
    ),
    points=_list(
        _message(
            "foxglove.PointsAnnotation",
            "An array of points on a 2D image",
            timestamp=_TIME,
            type=_choice(
                "foxglove.PointsAnnotationType",
                UNKNOWN=0, POINTS=POINTS, LINE_LOOP=2, LINE_STRIP=LINE_STRIP, LINE_LIST=4,
            ),
            points=_list(_POINT2),
            outline_color=_COLOR,
            outline_colors=_list(_COLOR),
            fill_color=_COLOR,
            thickness=NUMBER,
            metadata=_list(_PAIR),
        )
    ),
    texts=_list(
        _message(
            "foxglove.TextAnnotation",
            "A text label on a 2D image",
            timestamp=_TIME,
            position=_POINT2,
            text=TEXT,
            font_size=NUMBER,
            text_color=_COLOR,
            background_color=_COLOR,
            metadata=_list(_PAIR),
        )
    ),
)  # fmt: skip
POSE_IN_FRAME = _message(
    "foxglove.PoseInFrame",
    "A timestamped pose for an object or reference frame in 3D space",
    timestamp=_TIME,
    frame_id=TEXT,
    pose=_message("foxglove.Pose", "A pose in 3D", position=_VECTOR3, orientation=_QUATERNION),
)
FRAME_TRANSFORM = _message(
    "foxglove.FrameTransform",
    "The position and orientation of a child frame within a parent frame",
    timestamp=_TIME,
    parent_frame_id=TEXT,
    child_frame_id=TEXT,
    translation=_VECTOR3,
    rotation=_QUATERNION,
)
LOG = _message(
    "foxglove.Log",
    "A log message",
    timestamp=_TIME,
    level=_choice("foxglove.LogLevel", UNKNOWN=0, DEBUG=1, INFO=2, WARNING=3, ERROR=4, FATAL=5),
    message=TEXT,
    name=TEXT,
    file=TEXT,
    line=COUNT,
)
# A published calibration requires none of its fields.
CAMERA_CALIBRATION["required"] = []
