"""Sightings that err alike: the stated covariance is that of the solutions."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from optnav_cli.camera.camera import Camera
from optnav_cli.estimation.models.points import Pose, Sightings, predict
from optnav_cli.estimation.resection import resect_robustly

CAMERA = Camera("cam", "pinhole", 1000, 1000, 2400.0, (499.5, 499.5))
POSE = Pose(np.array([0.0, 0.0, -20e3]), Rotation.identity())
SIGMA_PX = 4.0


@pytest.mark.parametrize(("reach", "too_sure"), [(0.5, 1.15), (3.0, 2.0)])
def test_the_covariance_of_errors_that_neighbours_share_is_that_of_the_solutions(reach, too_sure):
    rng = np.random.default_rng(8)
    points = np.column_stack([rng.uniform(-3e3, 3e3, (24, 2)), rng.uniform(-300.0, 300.0, 24)])
    apart = np.linalg.norm(points[:, None] - points[None], axis=2)
    error_correlation = np.exp(-((apart / (reach * 1e3)) ** 2))
    root = np.linalg.cholesky(error_correlation + 1e-9 * np.eye(24))
    pixels, _ = predict(CAMERA, POSE, points)
    covariances = np.tile(np.eye(2) * SIGMA_PX**2, (24, 1, 1))
    nees = {True: [], False: []}
    for _ in range(60):
        seen = Sightings(points, pixels + SIGMA_PX * (root @ rng.normal(size=(24, 2))), covariances)
        for known, values in nees.items():
            found = resect_robustly(
                CAMERA, seen, POSE, 0.0, error_correlation=error_correlation if known else None
            )
            error = found.pose.position_m - POSE.position_m
            covariance = found.position_covariance_m2
            values.append(float(error @ np.linalg.solve(covariance, error)) / 3.0)
    # residuals of neighbours that move together are small: the scatter that scales is too
    assert 0.6 < np.mean(nees[True]) < 2.0
    assert np.mean(nees[False]) > too_sure * np.mean(nees[True])
