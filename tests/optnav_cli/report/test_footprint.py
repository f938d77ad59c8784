"""Footprints: what they hold is what the camera sees, tried place by place."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from catalog.geometry.latlon import body_from_local, latlon_from_xyz, xyz_from_latlon
from catalog.geometry.map_pieces import split_area
from optnav_cli.camera.camera import Camera
from optnav_cli.camera.camera_file import preset_camera
from optnav_cli.navigate.gis_layers import compute_footprint
from tests.catalog.geometry.test_map_pieces import inside

MOON = np.array([1737400.0] * 3)
PHOBOS = np.array([13000.0, 11400.0, 9100.0])
NARROW = Camera("narrow", "pinhole", 512, 512, 1046.0, (255.5, 255.5))
WIDE = Camera("wide", "pinhole", 800, 500, 300.0, (380.0, 260.0))
BAR = Camera("bar", "pinhole", 2000, 100, 500.0, (999.5, 49.5))
FISHEYE = Camera(
    "fisheye", "equidistant", 600, 600, 180.0, (299.5, 299.5), image_circle_radius_px=280.0
)


def looking(lat_deg, lon_deg, distance_m, forward_deg=0.0, right_deg=0.0, roll_deg=0.0):
    """Position and camera_from_body (3, 3) of a camera that is turned away from the nadir."""
    lat, lon = np.radians([lat_deg, lon_deg])
    nadir = np.diag([1.0, -1.0, -1.0]) @ body_from_local(lat, lon).T
    turn = Rotation.from_euler("zyx", [roll_deg, right_deg, forward_deg], degrees=True)
    return xyz_from_latlon(lat, lon, distance_m), turn.as_matrix() @ nadir


def seen(camera, position, camera_from_body, radii, surface):
    """Which places (n, 3) of an ellipsoid a camera images."""
    normals = surface / radii**2
    facing = ((position - surface) * normals).sum(axis=1) > 0.0
    pixels = camera.project_from_body(surface, position, camera_from_body)
    return facing & camera.contains(np.nan_to_num(pixels, nan=-1e9))


CASES = {
    "straight down": (NARROW, (-43.0, -11.0, 1937400.0), MOON),
    "tilted to the limb": (WIDE, (10.0, 179.0, 1937400.0, 50.0, 0.0, 20.0), MOON),
    "over the pole": (WIDE, (88.0, 40.0, 2237400.0, 5.0, -8.0, 70.0), MOON),
    "across 180 degrees": (NARROW, (0.0, 179.9, 1837400.0), MOON),
    "the whole disc": (NARROW, (20.0, -170.0, 12e6), MOON),
    "a disc that the frame cuts": (NARROW, (20.0, 170.0, 9e6, 9.0, 10.0, 30.0), MOON),
    "a bar across the disc": (BAR, (-70.0, 20.0, 3.5e6, 3.0, 0.0, 33.0), MOON),
    "a fisheye's circle": (FISHEYE, (-5.0, 60.0, 1837400.0, 30.0, 10.0), MOON),
    "all of the horizon": (FISHEYE, (85.0, -120.0, 2237400.0, 3.0, -4.0), MOON),
    "a small body": (NARROW, (-60.0, 100.0, 40e3, 2.0, 1.0), PHOBOS),
    "close to a small body": (WIDE, (30.0, 200.0, 16e3, 25.0, 0.0), PHOBOS),
}


@pytest.mark.parametrize("name", CASES)
def test_the_ground_in_a_footprint_is_the_ground_in_the_picture(name):
    camera, place, radii = CASES[name]
    position, camera_from_body = looking(*place)
    rings = compute_footprint(camera, position, camera_from_body, radii)
    pieces = [piece for ring in rings for piece in split_area(ring)]
    rng = np.random.default_rng(3)
    # half of the places near the ground in view, however little of the body that is
    spread = np.concatenate([rng.normal(size=(3000, 3)), _near(rings, rng)])
    surface = spread / np.linalg.norm(spread / radii, axis=1, keepdims=True)
    lat, lon, _ = latlon_from_xyz(surface)
    held = inside(pieces, np.degrees(np.column_stack([lon, lat])))
    shown = seen(camera, position, camera_from_body, radii, surface)
    assert 300 < shown.sum() < len(shown) - 300
    # the border is a chain of 48 chords a side, the limb of steps of 2 degrees
    assert (held != shown).mean() < 0.002


def _near(rings, rng):
    ring = np.concatenate(rings)
    middle = ring.mean(axis=0)
    reach = np.linalg.norm(ring - middle, axis=1).max()
    return middle + rng.normal(size=(3000, 3)) * 0.6 * reach


def test_the_whole_disc_has_the_area_of_its_cap():
    position, camera_from_body = looking(20.0, -170.0, 12e6)
    (ring,) = compute_footprint(NARROW, position, camera_from_body, MOON)
    np.testing.assert_allclose(np.linalg.norm(ring, axis=1), MOON[0])
    towards = ring @ position / MOON[0] / np.linalg.norm(position)
    np.testing.assert_allclose(towards, MOON[0] / 12e6, atol=1e-9)  # where sight touches it


@pytest.mark.parametrize(
    ("place", "radii"),
    [
        ((0.0, 0.0, 12e6, 90.0), MOON),  # looks past the body
        ((0.0, 0.0, 12e6, 180.0), MOON),  # away from it
        ((0.0, 0.0, 9000.0), PHOBOS),  # stands in it
    ],
)
def test_a_picture_without_ground_has_no_footprint(place, radii):
    position, camera_from_body = looking(*place)
    assert compute_footprint(NARROW, position, camera_from_body, radii) == []


def test_a_camera_that_ships_has_a_footprint_from_afar():
    position, camera_from_body = looking(0.0, 0.0, 2.6e9)
    (ring,) = compute_footprint(preset_camera("unk"), position, camera_from_body, MOON)
    assert np.isfinite(ring).all()
