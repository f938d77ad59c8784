"""Picked points of irregular bodies: right pictures are solved, mirrored ones called so."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from catalog.bodies.body import load_body
from catalog.geometry.ellipsoid import project_to_surface
from catalog.geometry.latlon import latlon_from_xyz
from optnav_cli.camera.camera import Camera
from optnav_cli.estimation.models.points import Pose, predict
from optnav_cli.frames.frames import Frame
from optnav_cli.frames.points import PickedPoint
from optnav_cli.frames.run_settings import FileAttitude, PointsSettings
from optnav_cli.points.method import PickedFrames
from optnav_cli.points.model import is_hidden
from optnav_cli.reasons import ReasonCode

FRAMING = Camera("fc", "pinhole", 1024, 1024, 150.0 / 0.014, (511.5, 511.5))
VESTA = replace(load_body("vesta"), radii_m=(285e3, 277e3, 227e3))
EROS = load_body("eros")
PICK_PX, PLACE_M = 1.0, 100.0


class Shape:
    """An ellipsoid with waves of relief, and pictures of it from random sides."""

    def __init__(self, body, relief_m, seed):
        self.body, self.radii = body, np.array(body.radii_m)
        self.rng = np.random.default_rng(seed)
        self.waves, self.phases = self.rng.normal(0.0, 4.0, (40, 3)), self.rng.uniform(0, 6, 40)
        self.heights = self.rng.normal(size=40)
        self.heights *= relief_m / np.sqrt((self.heights**2).sum() / 2.0)

    def radius(self, directions):
        relief = self.heights * np.cos(directions @ self.waves.T + self.phases)
        return np.linalg.norm(project_to_surface(directions, self.radii), axis=1) + relief.sum(
            axis=1
        )

    def is_seen(self, eye, places):
        """Whether the ground leaves the line of sight free, by marching along it."""
        sights = eye - places
        sights /= np.linalg.norm(sights, axis=1, keepdims=True)
        steps = np.linspace(0.004, 1.5, 250) * self.radii.max()
        on_the_way = (places[:, None] + sights[:, None] * steps[:, None]).reshape(-1, 3)
        distance = np.linalg.norm(on_the_way, axis=1)
        free = distance > self.radius(on_the_way / distance[:, None])
        return free.reshape(len(places), -1).all(axis=1)

    def picture(self, distance_m, count):
        """A pose, places and pixels of so many points in view."""
        rng = self.rng
        while True:
            eye = rng.normal(size=3)
            eye *= distance_m / np.linalg.norm(eye)
            axis = 0.3 * self.radii.min() * rng.normal(size=3) - eye
            axis /= np.linalg.norm(axis)
            right = np.cross(axis, rng.normal(size=3))
            right /= np.linalg.norm(right)
            turn = Rotation.from_matrix(np.array([right, np.cross(axis, right), axis]))
            directions = rng.normal(size=(1500, 3))
            directions /= np.linalg.norm(directions, axis=1, keepdims=True)
            places = directions * self.radius(directions)[:, None]
            pixels, _ = predict(FRAMING, Pose(eye, turn), places)
            inside = FRAMING.contains(pixels)
            inside[inside] = self.is_seen(eye, places[inside])
            if inside.sum() >= count:
                return Pose(eye, turn), places[inside][:count], pixels[inside][:count]

    def solve(self, places, pixels, mirrored):
        rng = self.rng
        places = places + rng.normal(0.0, PLACE_M, places.shape)
        pixels = pixels + rng.normal(0.0, PICK_PX, pixels.shape)
        if mirrored:
            pixels[:, 0] = FRAMING.width_px - 1.0 - pixels[:, 0]
        lat, lon, radius = latlon_from_xyz(places)
        latlon, heights = np.degrees([lat, lon]).T, radius - self.body.radius_m
        rows = zip(pixels, latlon, heights, strict=True)
        points = [PickedPoint("a", str(n), *row, PICK_PX, PLACE_M) for n, row in enumerate(rows, 1)]
        how = PickedFrames(FileAttitude("camera_from_body", self.body), PointsSettings())
        return how.solve(Frame("a", "2011-08-01T00:00:00Z", "fc"), FRAMING, points)


CASES = [(VESTA, 10e3, 5000e3), (VESTA, 20e3, 4000e3), (EROS, 700.0, 150e3)]


@pytest.mark.parametrize(("body", "relief_m", "distance_m"), CASES)
def test_right_pictures_of_irregular_bodies_are_solved_inside_their_sigmas(
    body, relief_m, distance_m
):
    shape = Shape(body, relief_m, seed=3)
    beyond, squares = 0, []
    for _ in range(6):
        pose, places, pixels = shape.picture(distance_m, 40)
        beyond += int((((pose.position_m - places) * places).sum(axis=1) < 0.0).sum())
        row = shape.solve(places, pixels, mirrored=False)
        assert row.solved, row.reason
        off = row.position_m - pose.position_m
        squares.append(off @ np.linalg.solve(row.covariance_m2, off) / 3.0)
    assert beyond >= 4  # of the sphere's horizon: what such pictures were refused for
    assert 0.3 < np.mean(squares) < 2.0  # of 18 numbers, 3 sigmas


@pytest.mark.parametrize(("body", "relief_m", "distance_m"), CASES)
def test_mirrored_pictures_of_irregular_bodies_are_called_so(body, relief_m, distance_m):
    shape = Shape(body, relief_m, seed=4)
    for _ in range(4):
        _, places, pixels = shape.picture(distance_m, 30)
        row = shape.solve(places, pixels, mirrored=True)
        assert not row.solved
        assert row.reason_code == ReasonCode.MIRRORED


def test_a_crest_is_seen_over_the_horizon_and_ground_behind_the_body_is_not():
    eye = np.array([1e10, 0.0, 0.0])
    radii = (1e6, 1e6, 8e5)
    behind = np.radians(94.0)
    ring = np.array([(np.cos(a), np.sin(a), 0.0) for a in (0.0, 0.5, behind, behind, np.pi)])
    places = ring * np.array([1e6, 1e6, 1.004e6, 1.0e6, 1e6])[:, None]
    assert is_hidden(eye, places, radii).tolist() == [False, False, False, True, True]
    level = ring[[0, 1, 3]] * 1e6
    assert is_hidden(eye, level, radii).tolist() == [False, False, True]


def test_a_camera_below_the_ground_sees_all_through_it():
    places = np.array([(1.7e6, y, z) for y in (-1e5, 1e5) for z in (-1e5, 1e5)])
    assert is_hidden((1.5e6, 0.0, 0.0), places, (1.7e6, 1.7e6, 1.7e6)).all()
    assert not is_hidden((1.9e6, 0.0, 0.0), places, (1.7e6, 1.7e6, 1.7e6)).any()
