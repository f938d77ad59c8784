"""Which points a camera should see, on a sphere where the answer is known."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from catalog.geometry.latlon import body_from_local, xyz_from_latlon
from optnav_cli.camera.camera import Camera
from optnav_cli.control_points.expectation import CandidatePoints, find_in_view
from optnav_cli.control_points.settings import ViewSettings
from optnav_cli.estimation.models.points import Pose

RADIUS_M = 1737400.0
SIZE = (1000, 1000)
CAMERA = Camera("c", "pinhole", *SIZE, 1000.0, (499.5, 499.5))
FISHEYE = Camera("f", "equidistant", 2048, 2048, 652.0, (1023.5, 1023.5))
ANY_LIGHT = ViewSettings(-90.0, 90.0, 70.0)


def nadir(lat, lon, height_m=200e3):
    turn = np.diag([1.0, -1.0, -1.0]) @ body_from_local(lat, lon).T
    return Pose(xyz_from_latlon(lat, lon, RADIUS_M + height_m), Rotation.from_matrix(turn))


def seen(points, pose, limits=ANY_LIGHT, half=0.0, sun=None, skyline=None, camera=CAMERA):
    sun = pose.position_m / np.linalg.norm(pose.position_m) if sun is None else sun
    candidates = CandidatePoints(points, np.full(len(points), half), skyline)
    return find_in_view(candidates, camera, pose, sun, limits)


@pytest.mark.parametrize("lat_deg", [90.0, -90.0, 0.0, -43.0])
@pytest.mark.parametrize("lon_deg", [-180.0, 0.0, 77.0])
def test_the_point_below_is_seen_in_the_middle_everywhere(lat_deg, lon_deg):
    lat, lon = np.radians([lat_deg, lon_deg])
    view = seen(xyz_from_latlon([lat], [lon], RADIUS_M), nadir(lat, lon))
    assert len(view) == 1
    assert np.abs(view.pixels - 499.5).max() < 1e-6
    assert view.metres_per_pixel[0] == pytest.approx(200.0, rel=1e-6)
    assert view.emission_deg[0] == pytest.approx(0.0, abs=1e-5)
    assert view.sun_elevation_deg[0] == pytest.approx(90.0, abs=1e-5)


def test_a_point_is_seen_only_when_its_whole_square_is_in_the_frame():
    pose = nadir(0.0, 0.0)
    east = np.arange(0.0, 120e3, 500.0) / RADIUS_M
    points = xyz_from_latlon(np.zeros_like(east), east, RADIUS_M)
    last_centre = seen(points, pose).index.max() * 500.0
    last_whole = seen(points, pose, half=10e3).index.max() * 500.0
    # 500 px x 200 m, less what the curvature takes
    assert last_centre == pytest.approx(100e3, rel=0.02)
    assert last_centre - last_whole == pytest.approx(10e3, rel=0.15)


def test_light_and_view_are_reckoned_from_the_points_own_normals():
    """A slope of 8 deg to the east, as the normals of an ellipsoid lean."""
    pose, lean = nadir(0.0, 0.0), np.radians(8.0)
    point = np.array([[RADIUS_M, 0.0, 0.0]])
    normal = np.array([[np.cos(lean), np.sin(lean), 0.0]])
    sun = np.array([np.cos(1.0), np.sin(1.0), 0.0])
    candidates = CandidatePoints(point, np.zeros(1), verticals=normal)
    view = find_in_view(candidates, CAMERA, pose, sun, ANY_LIGHT)
    assert view.emission_deg[0] == pytest.approx(8.0, abs=1e-6)
    assert view.sun_elevation_deg[0] == pytest.approx(98.0 - np.degrees(1.0), abs=1e-6)


def test_beyond_the_limb_nothing_is_seen_even_by_a_fisheye():
    pose = nadir(0.0, 0.0)
    angle = np.radians(np.linspace(0.0, 180.0, 721))
    points = xyz_from_latlon(np.zeros_like(angle), angle, RADIUS_M)
    limb = np.arccos(RADIUS_M / (RADIUS_M + 200e3))
    view = seen(points, pose, ViewSettings(-90.0, 90.0, 89.99), camera=FISHEYE)
    assert angle[view.index].max() == pytest.approx(limb, abs=np.radians(0.3))
    steep = seen(points, pose, ANY_LIGHT, camera=FISHEYE)
    assert steep.emission_deg.max() < 70.0
    assert len(steep) < len(view)


def test_points_by_night_in_the_dusk_and_under_a_high_sun_are_left_out():
    pose = nadir(0.0, 0.0, 400e3)
    points = xyz_from_latlon([0.0, 0.0, 0.0], np.radians([-4.0, 0.0, 4.0]), RADIUS_M)
    for elevation, wanted in [(-3.0, []), (3.0, [2]), (30.0, [0, 1, 2]), (62.0, [0]), (70.0, [])]:
        sun = xyz_from_latlon(0.0, np.radians(90.0 - elevation), 1.0)
        view = seen(points, pose, ViewSettings(5.0, 60.0, 70.0), sun=sun)
        assert view.index.tolist() == wanted
        got = elevation + np.array([-4.0, 0.0, 4.0])[view.index]
        assert np.allclose(view.sun_elevation_deg, got, atol=1e-9)


@pytest.mark.parametrize("lat_deg", [0.0, 60.0, 89.5])
def test_a_camera_below_the_skyline_of_its_azimuth_sees_nothing_of_the_point(lat_deg):
    lat = np.radians(lat_deg)
    pose = nadir(lat, 0.0)
    # a point 60 km south of the camera: the camera stands north of it, about 71 degrees high
    point = xyz_from_latlon([lat - 60e3 / RADIUS_M], [0.0], RADIUS_M)
    open_sky = np.zeros((1, 36))
    for azimuth_bin, hidden in [(0, True), (1, False), (18, False), (35, False)]:
        skyline = open_sky.copy()
        skyline[0, azimuth_bin] = 85.0
        assert (len(seen(point, pose, skyline=skyline)) == 0) is hidden


def test_of_no_points_none_is_seen():
    assert len(seen(np.empty((0, 3)), nadir(0.0, 0.0))) == 0
    assert len(seen(np.empty((0, 3)), nadir(0.0, 0.0), skyline=np.empty((0, 36)))) == 0


def test_points_right_below_the_camera_are_above_every_skyline():
    """Rounding makes some sines of 90 degrees larger than 1."""
    rng = np.random.default_rng(1)
    for lat, lon in rng.uniform(-1.5, 1.5, (40, 2)):
        point = xyz_from_latlon([lat], [lon], RADIUS_M)
        assert len(seen(point, nadir(lat, lon), skyline=np.zeros((1, 36)))) == 1
