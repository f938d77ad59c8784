"""A hazard map of a whole frame against one box filter of it."""

import time

import cv2
import numpy as np
import pytest

from optnav_cli.camera.camera_file import preset_camera
from optnav_cli.frames.picture import Picture
from optnav_cli.hazard.ground_view import look_down
from optnav_cli.hazard.hazard_map import map_hazard
from optnav_cli.hazard.settings import HazardSettings
from tests.bench.timing import in_turn, result, spread, within
from tests.studies.hazard_fields import make_field, perspective_picture

pytestmark = pytest.mark.bench

HEIGHT_M, ELEVATION_DEG, DRAWN_M = 500.0, 20.0, 0.5
BOX_PX = 91  # a pad at that height
ROUNDS = 15
LIMIT_MS, LIMIT_RATIO = 60.0, 4.0


def test_a_hazard_map_against_a_box_filter_of_the_frame():
    """From the picture in memory to the pads; a box of 91 px of the float picture beside it."""
    camera = preset_camera("tsnn2_narrow")
    field = make_field("rough", 1, 1000, DRAWN_M)
    picture = perspective_picture(field, camera, HEIGHT_M, ELEVATION_DEG, DRAWN_M)
    values = np.ascontiguousarray(picture.values, np.float32)
    picture = Picture(values, picture.saturation)
    calls = {"box": lambda: cv2.boxFilter(values, -1, (BOX_PX, BOX_PX))}
    for method in ("shading", "variance"):
        settings = HazardSettings(method=method)

        def mapped(settings: HazardSettings = settings) -> None:
            view = look_down(picture, camera, HEIGHT_M, ELEVATION_DEG, field.azimuth_deg())
            assert map_hazard(view, settings).found > 0

        calls[method] = mapped
        mapped()
    cv2.setNumThreads(1)
    times = in_turn(calls, ROUNDS, time.process_time)
    box = times.pop("box")
    for method, seconds in times.items():
        ratio = spread(np.divide(seconds, box))
        result(
            f"hazard map and pads of a picture of 2048² from 500 m, by {method}",
            f"{1e3 * np.median(seconds):.1f} ms",
            f"{ratio} × `cv2.boxFilter` of the picture, {BOX_PX} px; "
            f"limits {LIMIT_MS:.0f} ms, {LIMIT_RATIO:.0f} ×",
        )
        assert within(1e3 * float(np.median(seconds)), LIMIT_MS)
        assert within(ratio.median, LIMIT_RATIO)
