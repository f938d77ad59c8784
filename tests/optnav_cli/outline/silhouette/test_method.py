"""Poses from the silhouette of a body with two lobes, drawn by its mesh, known by its relief."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from catalog.bodies.body import load_body
from catalog.errors import NoSolutionError
from catalog.rendering.mesh_scene import MeshScene
from catalog.terrain.mesh.rays import MeshRays
from catalog.terrain.mesh.terrain import make_relief_mesh
from catalog.terrain.relief.relief import GlobalRelief
from optnav_cli.camera.camera import Camera
from optnav_cli.fix import Method
from optnav_cli.frames.picture import Picture
from optnav_cli.frames.segmentation import Segmented, measure_levels, remove_smear
from optnav_cli.outline.neighbour import CameraView
from optnav_cli.outline.one_body import solve
from optnav_cli.outline.silhouette import method as silhouette

ROWS, SIDE = 120, 320
CAMERA = Camera("nav", "pinhole", SIDE, SIDE, 3000.0, (159.5, 159.5))
POSITION = np.array([30e3, -62e3, 25e3])
SUN = np.array([0.75, -0.65, 0.1]) / np.linalg.norm([0.75, -0.65, 0.1])
BODY = replace(
    load_body("67p"), radius_m=2e3, radii_m=(3.4e3, 1.9e3, 1.7e3), plausible_heights_m=(-1.9e3, 3e3)
)


@cache
def shape() -> tuple[MeshRays, GlobalRelief]:
    """Two bumpy lobes beside each other, the neck between them near the origin."""
    parts = []
    for seed, radii, x in ((1, (1.9, 1.6, 1.5), -1.2), (2, (1.4, 1.2, 1.1), 1.5)):
        ball = trimesh.creation.icosphere(subdivisions=5)
        waves = np.random.default_rng(seed).normal(size=(40, 3)) * 4.0
        bumps = 1.0 + 0.012 * np.sin(ball.vertices @ waves.T + np.arange(40.0)).sum(axis=1) / 2.0
        vertices = ball.vertices * bumps[:, None] * radii + [x, 0.0, 0.0]
        parts.append(trimesh.Trimesh(vertices, ball.faces))
    both = trimesh.boolean.union(parts, engine="manifold")
    mesh = MeshRays(1e3 * both.vertices[both.faces])
    lat = np.pi / 2.0 - (np.arange(ROWS) + 0.5) * np.pi / ROWS
    lon = -np.pi + (np.arange(2 * ROWS) + 0.5) * np.pi / ROWS
    out = np.stack(
        [
            np.cos(lat)[:, None] * np.cos(lon),
            np.cos(lat)[:, None] * np.sin(lon),
            np.broadcast_to(np.sin(lat)[:, None], (ROWS, 2 * ROWS)),
        ],
        axis=-1,
    ).reshape(-1, 3)
    _, reached = mesh.find_first_hits(1e4 * out, -out)
    heights = (1e4 - reached - 2e3).reshape(ROWS, -1).astype(np.float32)
    return mesh, GlobalRelief(heights, heights, 2e3, "made")


def looking() -> Rotation:
    """An attitude with the body a little aside of the middle."""
    ahead = -POSITION / np.linalg.norm(POSITION)
    right = np.cross(ahead, [0.2, 0.1, 1.0])
    right /= np.linalg.norm(right)
    turn = Rotation.from_matrix(np.stack([right, np.cross(ahead, right), ahead]))
    return Rotation.from_euler("xyz", [0.3, -0.2, 25.0], degrees=True) * turn


@cache
def picture() -> Picture:
    """The body at the known pose, in counts with noise."""
    x, y = np.meshgrid(np.arange(SIDE + 1) - 0.5, np.arange(SIDE + 1) - 0.5)
    corners = CAMERA.unproject(np.stack([x, y], axis=-1)).reshape(-1, 3)
    rays = looking().apply(corners, inverse=True).reshape(*x.shape, 3)
    light = MeshScene(shape()[0], SUN).picture(POSITION, rays, 3)
    light *= 180.0 / np.quantile(light, 0.99)
    light += np.random.default_rng(5).normal(4.0, 1.0, light.shape)
    return Picture(np.clip(np.rint(light), 0.0, 255.0).astype(np.float32), 255.0)


def solved(off_deg: tuple[float, float, float], sigma_deg: float, sun=SUN, shown=None):
    shown = picture() if shown is None else shown
    turn = Rotation.from_rotvec(np.radians(off_deg)) * looking()
    view = CameraView(CAMERA, turn, np.radians(sigma_deg), sun)
    return silhouette.navigate(shown, view, BODY, shape()[1], Segmented(shown.values))


@pytest.mark.parametrize(
    ("off_deg", "sigma_deg"),
    [((0.0, 0.0, 0.0), 0.0), ((0.15, -0.2, 0.1), 0.2), ((3.0, -2.0, 3.5), 3.0)],
)
def test_a_bilobed_body_is_solved_without_a_prior_position(off_deg, sigma_deg) -> None:
    fix = solved(off_deg, sigma_deg)
    assert fix.method is Method.SILHOUETTE
    off = fix.position_m - POSITION
    distance = float(np.linalg.norm(POSITION))
    assert off @ np.linalg.solve(fix.covariance_m2, off) < 16.0
    assert abs(off @ POSITION) / distance**2 < 0.005
    turned = (fix.camera_from_body * looking().inv()).magnitude()
    assert turned < max(3.0 * fix.attitude_sigma_rad, 1e-6)
    # with the attitude known a pixel sees 25 m
    if sigma_deg == 0.0:
        assert np.linalg.norm(off - POSITION * (off @ POSITION) / distance**2) < 25.0


@pytest.mark.parametrize("along", ["columns", "rows"])
def test_stripes_of_a_sensor_without_a_shutter_are_taken_out(along) -> None:
    """Overexposed, and smeared a third as strongly on one side of the body as on the other."""
    values = np.minimum(2.0 * picture().values, 255.0)
    lines = values if along == "columns" else values.T
    brightest = lines.max(axis=0)
    side = np.where(np.arange(SIDE) < SIDE // 2, 0.3, 0.1)
    striped = np.minimum(lines + side[:, None] * brightest, 255.0).astype(np.float32)
    shown = Picture(striped if along == "columns" else striped.T, 255.0)
    fix = solved((0.15, -0.2, 0.1), 0.2, shown=shown)
    off = fix.position_m - POSITION
    assert off @ np.linalg.solve(fix.covariance_m2, off) < 16.0


def test_a_body_that_two_edges_cut_is_no_smear() -> None:
    values = picture().values
    rows = np.flatnonzero((values > 30.0).any(axis=1))
    cut = values[rows[0] + 40 : rows[-1] - 40]
    assert remove_smear(np.ascontiguousarray(cut), measure_levels(cut)) is None
    assert remove_smear(values, measure_levels(values)) is None
    lit_end = values.copy()
    lit_end[-4:] = 200.0
    lit_end[:4, :40] = 200.0
    assert remove_smear(lit_end, measure_levels(lit_end)) is None


@pytest.mark.parametrize("wrong", ["mirrored", "turned", "lit from elsewhere"])
def test_what_is_not_the_body_is_refused(wrong) -> None:
    shown, off, sun = picture(), (0.0, 0.0, 0.0), SUN
    if wrong == "mirrored":
        shown = replace(shown, values=np.ascontiguousarray(shown.values[:, ::-1]))
    elif wrong == "turned":
        off = (20.0, 35.0, 0.0)
    else:
        sun = Rotation.from_euler("z", 70.0, degrees=True).apply(SUN)
    with pytest.raises(NoSolutionError):
        solved(off, 0.2, sun, shown)


def test_a_body_that_the_frame_cuts_is_refused() -> None:
    shown = replace(picture(), values=np.roll(picture().values, 120, axis=1))
    with pytest.raises(NoSolutionError, match="cut the lit shape"):
        solved((0.0, 0.0, 0.0), 0.2, shown=shown)


def test_the_mesh_of_a_relief_has_its_heights() -> None:
    relief = shape()[1]
    mesh = make_relief_mesh(relief)
    out = np.random.default_rng(3).normal(size=(200, 3))
    out /= np.linalg.norm(out, axis=1)[:, None]
    face, reached = mesh.find_first_hits(1e4 * out, -out)
    assert (face >= 0).all()
    lat, lon = np.arcsin(out[:, 2]), np.arctan2(out[:, 1], out[:, 0])
    assert np.median(np.abs(1e4 - reached - 2e3 - relief.heights_at(lat, lon))) < 3.0


def test_the_outline_of_a_concave_shape_falls_back_on_its_silhouette() -> None:
    view = CameraView(CAMERA, looking(), np.radians(0.05), SUN)
    fix = solve(picture(), view, BODY, shape()[1])
    off = fix.position_m - POSITION
    assert fix.method in (Method.SILHOUETTE, Method.HORIZON)
    assert off @ np.linalg.solve(fix.covariance_m2, off) < 16.0
