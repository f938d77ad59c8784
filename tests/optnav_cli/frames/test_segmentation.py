"""Lit areas of a picture against OpenCV's own statistics of them."""

import cv2
import numpy as np
import pytest

from optnav_cli.frames import segmentation
from optnav_cli.frames.segmentation import (
    HALO_PX,
    Segmented,
    _find_peak,
    find_lit_blobs,
    remove_blobs,
)


def test_areas_and_boxes_are_those_of_opencv_the_largest_first():
    picture = cv2.GaussianBlur(np.random.default_rng(2).normal(size=(90, 140)), (0, 0), 1.5)
    blobs = find_lit_blobs(picture.astype(np.float32), 0.15)
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
    made = segmentation.find_lit_blobs
    monkeypatch.setattr(segmentation, "find_lit_blobs", lambda *of: calls.append(of) or made(*of))
    lit = Segmented(picture)
    assert lit.blobs is lit.blobs
    assert lit.blobs.area.tolist() == [400]
    assert len(calls) == 1


@pytest.mark.parametrize("shape", [(1, 1), (1, 5), (2, 2), (3, 7), (60, 41)])
def test_the_peak_is_the_highest_of_opencvs_means_of_three_by_three(shape):
    picture = np.random.default_rng(4).integers(0, 4096, shape).astype(np.float32)
    for place in ((0, 0), (-1, -1), (shape[0] // 2, shape[1] // 2)):
        brighter = picture.copy()
        brighter[place] += 9000.0
        assert _find_peak(brighter) == cv2.blur(brighter, (3, 3)).max()


def test_areas_reach_the_border_where_a_pixel_of_theirs_is_on_it():
    picture = np.zeros((40, 50), np.float32)
    picture[10:20, 10:30] = picture[30:40, 20:29] = picture[2:9, 45:50] = 1.0
    blobs = find_lit_blobs(picture, 0.5)
    assert [blobs.is_at_border(number) for number in range(3)] == [False, True, True]


def test_masked_areas_and_their_blur_become_sky_and_nothing_else():
    picture = np.full((60, 60), 3.0, np.float32)
    picture[0:8, 4:9] = picture[30:50, 30:50] = 200.0
    picture[14, 6] = picture[13, 6] = 7.0
    blobs = find_lit_blobs(picture, 100.0)
    masked = remove_blobs(picture, blobs, [int(blobs.label[1])], 2.0)
    inside = np.zeros(picture.shape, bool)
    inside[0 : 8 + HALO_PX, 0 : 9 + HALO_PX] = True
    assert (masked[inside] == 2.0).all()
    assert (masked[~inside] == picture[~inside]).all()
