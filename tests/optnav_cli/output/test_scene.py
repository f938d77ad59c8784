"""The 3D scene of a recording: shapes, places and what a viewer still shows after a jump."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from catalog.bodies.body import load_body
from catalog.terrain.relief.relief import GlobalRelief
from optnav_cli.camera.camera import Camera
from optnav_cli.fix import MatchRow
from optnav_cli.output.foxglove import BODY_SCALE, CAMERA_COLOURS, MAX_TRACK, RecordedScene
from tests.optnav_cli.rows import solved, unsolved

MOON = load_body("moon")
STAMP = {"timestamp": {"sec": 5, "nsec": 0}}
MINUTE = 60 * 10**9
CAMERA = Camera("unk", "pinhole", 640, 480, 900.0, (319.5, 239.5))
PLACE = np.array([0.0, 0.0, MOON.radius_m + 200e3])
DOWN = Rotation.from_matrix(np.diag([1.0, -1.0, -1.0]))


def a_solution(place=PLACE, covariance=None):
    covariance = np.diag([100.0, 400.0, 900.0]) if covariance is None else covariance
    return solved("a.png", "2026-01-01T00:00:00Z", "control_points", place, covariance, DOWN, 0.0)


def entity(update, name):
    return next(e for e in update["entities"] if e["id"] == name)


def places(primitive):
    return np.array([[p[axis] for axis in "xyz"] for p in primitive["points"]])


def test_a_body_without_relief_is_its_ellipsoid():
    phobos = load_body("phobos")
    (sphere,) = entity(RecordedScene(phobos).body(STAMP, None), "body")["spheres"]
    size = np.array(list(sphere["size"].values()))
    np.testing.assert_allclose(size, 2.0 * BODY_SCALE * np.array(phobos.radii_m), atol=1e-3)


def test_the_relief_of_a_body_is_a_closed_surface_that_faces_outward():
    lat = np.linspace(1.0, -1.0, 40)[:, None] * np.ones((1, 80))
    heights = (3000.0 * lat).astype(np.float32)  # the north is higher
    relief = GlobalRelief(heights, heights, MOON.radius_m, "made up")
    (mesh,) = entity(RecordedScene(MOON).body(STAMP, relief), "body")["triangles"]
    points, triangles = places(mesh), np.array(mesh["indices"]).reshape(-1, 3)
    assert len(mesh["colors"]) == len(points)
    a, b, c = points[triangles].transpose(1, 0, 2)
    volumes = np.einsum("ij,ij->i", a, np.cross(b, c)) / 6.0
    assert volumes.min() > -1.0  # m^3; those at the poles are empty
    sphere = 4.0 / 3.0 * np.pi * (BODY_SCALE * MOON.radius_m) ** 3
    assert volumes.sum() == pytest.approx(sphere, rel=5e-3)
    grays = np.array([colour["r"] for colour in mesh["colors"]])
    assert grays[points[:, 2] > 1e6].min() > grays[points[:, 2] < -1e6].max()


def test_a_pose_has_its_frustum_its_ellipsoid_and_its_prior():
    scene = RecordedScene(MOON)
    solution = replace(a_solution(), prior_m=PLACE + [4000.0, 0.0, 0.0])
    update = scene.camera(STAMP, 0, "unk", solution, CAMERA)
    pose = entity(update, "pose")
    mark, ellipsoid, prior = pose["spheres"]
    assert mark["pose"]["position"]["z"] == PLACE[2]
    # 3 sigmas to either side
    assert sorted(ellipsoid["size"].values()) == pytest.approx([60.0, 120.0, 180.0])
    assert prior["pose"]["position"]["x"] == 4000.0
    border, edges, _ = pose["lines"]
    rays = places(border) - PLACE
    assert len(places(edges)) == 8
    shown = CAMERA.project((rays / 1e3) @ DOWN.as_matrix().T)
    assert shown.min(axis=0) == pytest.approx([-0.5, -0.5], abs=1e-3)
    assert shown.max(axis=0) == pytest.approx([639.5, 479.5], abs=1e-3)


def test_the_axes_of_the_ellipsoid_are_those_of_the_covariance():
    turn = Rotation.random(rng=np.random.default_rng(4))
    matrix = turn.as_matrix()
    covariance = matrix @ np.diag([1.0, 100.0, 1e4]) @ matrix.T
    pose = entity(
        RecordedScene(MOON).camera(STAMP, 0, "unk", a_solution(covariance=covariance), None), "pose"
    )
    ellipsoid = pose["spheres"][1]
    q = ellipsoid["pose"]["orientation"]
    axes = Rotation.from_quat([q["x"], q["y"], q["z"], q["w"]]).as_matrix()
    size = np.array(list(ellipsoid["size"].values())) / 6.0
    np.testing.assert_allclose(axes @ np.diag(size**2) @ axes.T, covariance, rtol=1e-3, atol=0.1)


def test_an_unsolved_frame_shows_no_pose_and_every_update_replaces_the_one_before():
    scene = RecordedScene(MOON)
    scene.camera(STAMP, 0, "unk", a_solution(), CAMERA)
    update = scene.camera(STAMP, MINUTE, "unk", unsolved("b.png", "", "dark"), CAMERA)
    assert [e["id"] for e in update["entities"]] == ["track"]
    assert update["deletions"] == [{**STAMP, "type": 1, "id": ""}]


def test_a_track_is_cut_at_pauses_and_thinned_when_it_is_long():
    scene = RecordedScene(MOON)
    for number in range(6):
        time = number * MINUTE + (30 * MINUTE if number > 2 else 0)
        update = scene.camera(STAMP, time, "unk", a_solution(PLACE + number), CAMERA)
    lines = entity(update, "track")["lines"]
    assert [len(line["points"]) for line in lines] == [3, 3]
    for number in range(3 * MAX_TRACK):
        update = scene.camera(STAMP, (40 + number) * MINUTE, "unk", a_solution(), CAMERA)
    assert sum(len(line["points"]) for line in entity(update, "track")["lines"]) <= MAX_TRACK


def test_each_camera_has_its_colour_by_its_place_in_the_run():
    scene = RecordedScene(MOON, ["wide", "unk"])
    for name, number in (("unk", 1), ("wide", 0)):
        pose = entity(scene.camera(STAMP, 0, name, a_solution(), CAMERA), "pose")
        colour = pose["spheres"][0]["color"]
        assert (colour["r"], colour["g"], colour["b"]) == CAMERA_COLOURS[number]


def test_points_are_coloured_by_what_became_of_them():
    point, pixel = MOON.radius_m * np.eye(3), np.array([3.0, 4.0])
    matches = [
        MatchRow("a.png", 1, 0, point[0], pixel, pixel, used=True),
        MatchRow("a.png", 2, 0, point[1], pixel, pixel),
        MatchRow("a.png", 3, 0, point[2], pixel),
    ]
    update = RecordedScene(MOON).points(STAMP, a_solution(), matches)
    spheres = entity(update, "points")["spheres"]
    assert len({tuple(sphere["color"].values()) for sphere in spheres}) == 3
    (line,) = entity(update, "points")["lines"]  # from the camera to the one that is used
    np.testing.assert_allclose(places(line), [PLACE, point[0]], atol=1e-3)
