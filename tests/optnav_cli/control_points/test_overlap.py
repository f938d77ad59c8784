"""Shares and correlation of templates that show the same ground of a frame."""

import numpy as np
import pytest

from optnav_cli.control_points.acceptance import compute_evidence_shares, draw_footprints
from optnav_cli.control_points.error_model import correlate_ground, correlate_overlaps
from optnav_cli.control_points.point_match import SeenPart

SIZE = (1000, 1000)


def part(x, y, side=400.0):
    corners = np.array([(x, y), (x + side, y), (x + side, y + side), (x, y + side)])
    return SeenPart(np.zeros(3), corners.mean(axis=0), corners, 100.0)


def test_templates_apart_share_nothing():
    masks = draw_footprints([part(0, 0), part(500, 500)], SIZE)
    assert compute_evidence_shares(masks) == pytest.approx([1.0, 1.0])
    assert correlate_overlaps(masks) == pytest.approx(np.eye(2))


def test_the_same_ground_counts_once():
    masks = draw_footprints([part(100, 100)] * 3, SIZE)
    assert compute_evidence_shares(masks) == pytest.approx([1.0 / 3.0] * 3)
    assert correlate_overlaps(masks) == pytest.approx(np.ones((3, 3)))


def test_half_the_ground_is_half_the_correlation():
    masks = draw_footprints([part(100, 100), part(300, 100)], SIZE)
    assert correlate_overlaps(masks)[0, 1] == pytest.approx(0.5, abs=0.03)
    assert compute_evidence_shares(masks) == pytest.approx([0.75, 0.75], abs=0.02)


def test_ground_outside_the_frame_is_not_shared():
    """Two templates that meet outside only."""
    masks = draw_footprints([part(-200, 100), part(900, 100), part(-300, 100)], SIZE)
    error_correlation = correlate_overlaps(masks)
    assert error_correlation[0, 1] == 0.0
    assert 0.5 < error_correlation[0, 2] < 1.0


def test_the_correlation_is_a_covariance_whatever_the_places():
    rng = np.random.default_rng(4)
    masks = draw_footprints([part(*rng.uniform(-300, 900, 2)) for _ in range(20)], SIZE)
    assert np.linalg.eigvalsh(correlate_overlaps(masks)).min() > -1e-9


def test_a_template_whose_corners_are_not_seen_covers_nothing():
    nowhere = part(np.nan, 0.0)
    masks = draw_footprints([nowhere, part(100, 100)], SIZE)
    assert compute_evidence_shares(masks) == pytest.approx([0.0, 1.0])
    assert np.isfinite(correlate_overlaps(masks)).all()


def test_templates_on_common_ground_err_together():
    """Against the common area of squares drawn cell by cell; discs stand for them to an eighth."""
    places = np.array([[0.0, 0.0], [30e3, 0.0], [0.0, 55e3], [40e3, 40e3], [500e3, 0.0]])
    widths = np.array([76e3, 76e3, 76e3, 38e3, 76e3])
    found = correlate_ground(np.column_stack([places, np.full(5, 1737e3)]), widths)
    assert np.allclose(np.diag(found), 1.0)
    assert np.allclose(found, found.T)
    assert (np.linalg.eigvalsh(found) > 0.0).all()
    grid = np.arange(-100e3, 600e3, 1e3)
    x, y = np.meshgrid(grid, grid)
    squares = [
        (np.abs(x - a) < 0.5 * w) & (np.abs(y - b) < 0.5 * w)
        for (a, b), w in zip(places, widths, strict=True)
    ]
    for i, one in enumerate(squares):
        for j, other in enumerate(squares):
            wanted = (one & other).sum() / np.sqrt(one.sum() * other.sum())
            assert found[i, j] == pytest.approx(wanted, abs=0.125)
