"""Imports whose picture contradicts the stated geometry, and right ones beside them."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from catalog.bodies.body import load_body
from optnav_cli.archives.geometry_check import StatedGeometry, find_contradictions
from optnav_cli.camera.camera import Camera

MOON = load_body("moon")
CAMERA = Camera("made", "pinhole", 256, 256, 500.0, (127.5, 127.5))
INERTIAL = Rotation.from_euler("xyz", [20.0, 40.0, 70.0], degrees=True)


def geometry(
    distance_km: float = 12000.0, phase_deg: float = 60.0, off_deg: float = 2.0
) -> StatedGeometry:
    """A camera that looks beside the Moon's centre, the Sun at a phase angle to its right."""
    position = np.array([0.3, -0.5, 0.8]) * (distance_km * 1e3 / np.sqrt(0.98))
    down = -position / np.linalg.norm(position)
    across = np.cross(down, [0.0, 0.0, 1.0])
    across /= np.linalg.norm(across)
    ahead = Rotation.from_matrix([across, np.cross(down, across), down])
    attitude = Rotation.from_euler("y", off_deg, degrees=True) * ahead
    phase = np.radians(phase_deg)
    sun = -np.cos(phase) * down + np.sin(phase) * across
    return StatedGeometry(CAMERA, position, attitude, sun, np.radians(0.1), 1000.0, INERTIAL)


def picture(stated: StatedGeometry, noise: float = 2.0) -> np.ndarray:
    """Lambert's sphere by rays, with noise and a dark level."""
    camera = stated.camera
    x, y = np.meshgrid(np.arange(camera.width_px), np.arange(camera.height_px))
    rays = camera.unproject(np.stack([x, y], axis=-1)).reshape(-1, 3)
    rays = stated.camera_from_body.inv().apply(rays)
    start = stated.position_m / MOON.radius_m
    along = rays @ start
    inside = along**2 - (start @ start - 1.0)
    hit = start + (-along - np.sqrt(np.maximum(inside, 0.0)))[:, None] * rays
    cosine = np.where(inside > 0.0, np.maximum(hit @ stated.sun_body, 0.0), 0.0)
    rng = np.random.default_rng(4)
    values = 10.0 + 200.0 * cosine + rng.normal(0.0, noise, cosine.shape)
    return values.reshape(camera.shape).astype(np.float32)


@pytest.mark.parametrize("phase_deg", [0.0, 40.0, 90.0, 130.0, 155.0])
@pytest.mark.parametrize("distance_km", [2500.0, 6000.0, 12000.0, 40000.0])
@pytest.mark.parametrize("off_deg", [0.0, 4.0, 12.0])
def test_a_right_geometry_is_not_accused(
    phase_deg: float, distance_km: float, off_deg: float
) -> None:
    stated = geometry(distance_km, phase_deg, off_deg)
    assert find_contradictions(stated, MOON, picture(stated)) == []


def test_a_position_of_the_wrong_sign_is_named() -> None:
    right = geometry()
    wrong = replace(right, position_m=-right.position_m)
    (line,) = find_contradictions(wrong, MOON, picture(right))
    assert "looks away from moon" in line
    assert "the sign of the position vector" in line
    assert "178 deg off the boresight" in line


def test_a_rotation_of_the_wrong_direction_is_named() -> None:
    right = geometry()
    inertial = right.camera_from_body * INERTIAL
    wrong = replace(right, camera_from_body=inertial.inv() * INERTIAL.inv())
    (line,) = find_contradictions(wrong, MOON, picture(right))
    assert "mend the direction of the rotation" in line
    free = replace(wrong, attitude_sigma_rad=None)
    assert find_contradictions(free, MOON, picture(right)) == []


def test_a_sun_of_the_wrong_sign_is_named() -> None:
    right = geometry(phase_deg=20.0)
    wrong = replace(right, sun_body=-right.sun_body)
    (line,) = find_contradictions(wrong, MOON, picture(right))
    assert "the stated Sun is behind moon (phase angle 160 deg)" in line
    assert "the sign of the Sun's vector" in line


@pytest.mark.parametrize("factor", [0.3, 3.0, 1000.0])
def test_a_range_that_the_disc_contradicts_is_named(factor: float) -> None:
    right = geometry(20000.0)
    wrong = replace(right, position_m=right.position_m * factor)
    (line,) = find_contradictions(wrong, MOON, picture(right))
    assert "mend the unit of the position" in line
    implied = float(line.rpartition("about ")[2].split(" km")[0])
    assert implied == pytest.approx(20000.0, rel=0.1)
    # a sigma as large as the error excuses it
    vague = replace(wrong, position_sigma_m=np.linalg.norm(wrong.position_m) * max(factor, 5.0))
    assert find_contradictions(vague, MOON, picture(right)) == []


def test_metres_taken_for_kilometres_are_inside_the_body() -> None:
    right = geometry()
    wrong = replace(right, position_m=right.position_m / 1000.0)
    (line,) = find_contradictions(wrong, MOON, picture(right))
    assert "12 km from the centre, inside the body" in line


def test_a_near_range_of_a_small_disc_is_named() -> None:
    """The stated disc is larger than the picture, a small one with a dark rim is seen."""
    right = geometry(20000.0, phase_deg=20.0, off_deg=0.0)
    narrow = replace(CAMERA, focal_length_px=4000.0)
    small = picture(replace(right, position_m=right.position_m * 10.0, camera=narrow))
    wrong = replace(right, position_m=right.position_m / 10.0, camera=narrow)
    (line,) = find_contradictions(wrong, MOON, small)
    assert "the lit disc is" in line


def test_a_picture_without_a_disc_proves_nothing() -> None:
    stated = geometry()
    rng = np.random.default_rng(1)
    for values in (rng.normal(100.0, 5.0, CAMERA.shape), np.full(CAMERA.shape, np.nan),
                   np.linspace(0.0, 50.0, 256)[None] * np.ones((256, 1))):  # fmt: skip
        assert find_contradictions(stated, MOON, values.astype(np.float32)) == []


def test_smear_beside_a_bright_body_is_not_its_disc() -> None:
    """Readout smear, as of Rosetta's camera: a band over all rows at a fifth of the body."""
    stated = geometry(40000.0, phase_deg=30.0)
    values = picture(stated)
    columns = values.max(axis=0) > 100.0
    values[:, columns] = np.maximum(values[:, columns], 50.0)
    assert find_contradictions(stated, MOON, values) == []
