"""The layout in which a run's recording is looked at in Foxglove, as its import reads it.

Panels: the 3D scene, a picture with its annotations for each camera, plots of what solutions state,
the log. Their names and settings are those that Foxglove exports ("configById", "layout").
"""

import json
import math
import os
import re
import struct
from pathlib import Path
from typing import Any

import numpy as np
from mcap.exceptions import McapError
from mcap.reader import SeekingReader

from catalog.errors import DataError, UsageError
from catalog.files import make_prefix_test, replace_file
from optnav_cli.output.foxglove import CAMERA_COLOURS
from optnav_cli.output.recording import format_topic
from optnav_cli.output.run_folder import RECORDING, RunFolder, read_run

Panel = dict[str, Any]
BEGINNING = b'{\n  "configById"'
PLAIN_TOPIC = re.compile(r"[\w/-]+", re.ASCII)  # others stand in quotes in a message path
AWAY = 4.0  # of the viewer from the body's centre, farthest camera's distances
AXES_SHARE = 0.1  # length of a camera's axes, of the median height
PLOTS = {
    "sigmas": ("sigma, m", ("sigma_up_m", "sigma_north_m", "sigma_east_m")),
    "points": ("control points", ("n_predicted", "n_matched", "n_used")),
    "residuals": ("residual, px", ("residual_rms_px",)),
}
THREE, LOG = "3D!scene", "RosOut!log"


def write_layout(source: Path, output: Path) -> None:
    """Write the layout of a run folder; an older one there is replaced.

    Raises UsageError for another ending than .json, DataError for a folder that is no run or one
    without a camera, OutputError for a place that cannot be used.
    """
    if output.suffix.lower() != ".json":
        raise UsageError(f"{output}: a layout for Foxglove is JSON; let its name end in .json")
    run = read_run(source)
    if not run.cameras:
        raise DataError(f"{source}: holds no camera files, so there is nothing to lay out")
    laid_out = build_layout(run, read_recorded_topics(source / RECORDING))
    text = json.dumps(laid_out, indent=2, ensure_ascii=False, allow_nan=False) + "\n"
    with replace_file(output, make_prefix_test(BEGINNING)) as path:
        path.write_text(text, encoding="utf-8")


def read_recorded_topics(recording: Path) -> frozenset[str] | None:
    """Read the topics of a recording; None where it is not there or cannot be read."""
    if not recording.is_file():  # nor a pipe, which would never end
        return None
    try:
        with recording.open("rb") as file:
            # a record claims a length, which a damaged one may not mean
            limit = os.fstat(file.fileno()).st_size
            summary = SeekingReader(file, record_size_limit=limit).get_summary()
    except (OSError, McapError, ValueError, struct.error, MemoryError):
        return None
    return frozenset(channel.topic for channel in summary.channels.values()) if summary else None


def build_layout(run: RunFolder, recorded: frozenset[str] | None = None) -> Panel:
    """Build the layout of a run with a camera, of recorded topics; None: of all topics."""
    cameras = sorted({camera.name for camera in run.cameras.values()})

    def list_recorded(what: str) -> list[str]:
        return [
            name for name in cameras if recorded is None or format_topic(name, what) in recorded
        ]

    pictures = {
        f"Image!{number}": _build_picture(name)
        for number, name in enumerate(list_recorded("image"))
    }
    solved = list_recorded("solution")
    plots = {f"Plot!{name}": _build_plot(solved, *PLOTS[name]) for name in PLOTS if solved}
    scene = _build_scene(run, cameras)
    if recorded is not None:
        scene["topics"] = {
            name: shown for name, shown in scene["topics"].items() if name in recorded
        }
    panels = {THREE: scene, **pictures, **plots}
    panels[LOG] = {"searchTerms": [], "minLogLevel": 1, "topicToRender": "/log"}
    above = _build_split(THREE, _stack_panels(list(pictures)), "row", 55) if pictures else THREE
    below = _build_split(_stack_panels(list(plots), "row"), LOG, "row", 75) if plots else LOG
    return {
        "configById": panels,
        "globalVariables": {},
        "userNodes": {},
        "playbackConfig": {"speed": 1.0},
        "layout": _build_split(above, below, "column", 62),
    }


def _build_scene(run: RunFolder, cameras: list[str]) -> Panel:
    body, radius = run.attitude.body.name, run.attitude.body.radius_m
    known = [s.position_m for s in run.solutions if s.position_m is not None]
    distances = [math.hypot(*position) for position in known]
    farthest = max(float(max(distances, default=0.0)), radius)
    height = max(float(np.median(distances)) - radius, 1e-3 * radius) if distances else radius
    size = AXES_SHARE * min(height, 2.0 * radius)
    topics: dict[str, Panel] = {"/body": {"visible": True}}
    for number, name in enumerate(cameras):
        rgb = CAMERA_COLOURS[number % len(CAMERA_COLOURS)]
        colour = "#" + "".join(f"{round(255 * part):02x}" for part in rgb) + "ff"
        pose = {"visible": True, "type": "axis", "axisScale": size, "color": colour}
        topics[format_topic(name, "pose")] = pose
        topics[format_topic(name, "predicted")] = {**pose, "axisScale": 0.6 * size}
        topics |= {
            format_topic(name, what): {"visible": True} for what in ("scene", "control_points")
        }
        # its own frustum is 1 m long; that of the scene shows fisheyes, too
        topics[format_topic(name, "calibration")] = {"visible": False}
        topics[format_topic(name, "image")] = {"visible": False}
    view = {
        "perspective": True,
        "distance": AWAY * farthest,
        "phi": 60.0,
        "thetaOffset": 45.0,
        "targetOffset": [0.0, 0.0, 0.0],
        "target": [0.0, 0.0, 0.0],
        "targetOrientation": [0.0, 0.0, 0.0, 1.0],
        "fovy": 45.0,
        "near": 1e-3 * radius,
        "far": 10.0 * AWAY * farthest,
        "logDepth": True,
    }
    return {
        "cameraState": view,
        "followMode": "follow-none",
        "followTf": body,
        "scene": {"backgroundColor": "#101418", "transforms": {"showLabel": False}},
        # the poses' topics have axes of a fitting length
        "transforms": {f"frame:{name}": {"visible": False} for name in (*cameras, body)},
        "topics": topics,
        "layers": {},
        "imageMode": {},
    }


def _build_picture(camera: str) -> Panel:
    return {
        "foxglovePanelTitle": camera,
        "imageMode": {
            "imageTopic": format_topic(camera, "image"),
            "calibrationTopic": format_topic(camera, "calibration"),
            "annotations": {format_topic(camera, "annotations"): {"visible": True}},
            "synchronize": True,
        },
    }


def _build_plot(cameras: list[str], label: str, fields: tuple[str, ...]) -> Panel:
    paths = []
    for camera in cameras:
        topic = format_topic(camera, "solution")
        topic = topic if PLAIN_TOPIC.fullmatch(topic) else json.dumps(topic, ensure_ascii=False)
        paths += [
            {
                "value": f"{topic}.{field}",
                "label": f"{field}, {camera}",
                "enabled": True,
                "timestampMethod": "headerStamp",
                "showLine": True,
                "lineSize": 1,
            }
            for field in fields
        ]
    return {
        "foxglovePanelTitle": label,
        "paths": paths,
        "xAxisVal": "timestamp",
        "yAxisLabel": label,
        "showXAxisLabels": True,
        "showYAxisLabels": True,
        "showLegend": True,
        "legendDisplay": "floating",
        "showPlotValuesInLegend": True,
        "isSynced": True,
    }


def _build_split(first: Any, second: Any, direction: str, percentage: float) -> Panel:
    return {"first": first, "second": second, "direction": direction, "splitPercentage": percentage}


def _stack_panels(panels: list[str], direction: str = "column") -> Any:
    """Stack panels beside one another, each as large as the others."""
    if len(panels) == 1:
        return panels[0]
    remaining = _stack_panels(panels[1:], direction)
    return _build_split(panels[0], remaining, direction, 100.0 / len(panels))
