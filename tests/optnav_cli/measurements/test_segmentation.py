"""Lit areas of a picture against OpenCV's own statistics of them."""

import cv2
import numpy as np

from optnav_cli.measurements import segmentation
from optnav_cli.measurements.segmentation import Segmented, lit_blobs


def test_areas_and_boxes_are_those_of_opencv_the_largest_first():
    picture = cv2.GaussianBlur(np.random.default_rng(2).normal(size=(90, 140)), (0, 0), 1.5)
    blobs = lit_blobs(picture.astype(np.float32), 0.15)
    mask = (picture.astype(np.float32) > 0.15).view(np.uint8)
    _, labels, stats, _ = cv2.connectedComponentsWithStats(mask, connectivity=8)
    assert (blobs.labels == labels).all()
    assert len(blobs) > 20
    assert (blobs.area == np.sort(stats[1:, cv2.CC_STAT_AREA])[::-1]).all()
    assert (np.column_stack([blobs.box, blobs.area]) == stats[blobs.label]).all()


def test_a_picture_is_segmented_once(monkeypatch):
    picture = np.full((64, 64), 3.0, np.float32)
    picture[20:40, 20:40] = 200.0
    calls = []
    made = segmentation.lit_blobs
    monkeypatch.setattr(segmentation, "lit_blobs", lambda *of: calls.append(of) or made(*of))
    lit = Segmented(picture)
    assert lit.blobs is lit.blobs
    assert lit.blobs.area.tolist() == [400]
    assert len(calls) == 1
