"""Small bodies: silhouettes against rays on the mesh, positions over a rough and a double body."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from catalog.bodies.body import load_body
from catalog.errors import NoSolutionError
from catalog.geometry.latlon import xyz_from_latlon
from catalog.rendering.mesh_scene import MeshScene
from catalog.terrain.mesh.rays import MeshRays
from catalog.terrain.relief.relief import GlobalRelief
from catalog.terrain.skyline.limb import LimbRelief, make_nadir_axes
from optnav_cli.camera.camera_file import preset_camera
from optnav_cli.outline.limb.detection import LimbPoints, find_limb
from optnav_cli.outline.limb.ground_skyline import (
    ShapeSkyline,
    estimate_relief_fraction,
    is_shape,
)
from optnav_cli.outline.limb.limb_rays import LimbRays
from optnav_cli.outline.limb.method import navigate
from tests.optnav_cli.outline.limb.limbs import grounds, limb_points, place

PHOBOS = load_body("phobos")
CAMERA = preset_camera("tsnn_shtk")
DISTANCE_M = 1e5
PIXEL = 1.0 / CAMERA.focal_length_px
ROWS = 180


def directions(rows):
    lat = np.pi * (0.5 - (np.arange(rows) + 0.5) / rows)[:, None]
    lon = np.pi * ((np.arange(2 * rows) + 0.5) / rows - 1.0)[None, :]
    return xyz_from_latlon(*np.broadcast_arrays(lat, lon), 1.0)


def waves(rows, lengths_m, size, seed):
    """Random waves on a sphere, heights (rows, 2 rows) m; `size` of their length high."""
    points = PHOBOS.radius_m * directions(rows)
    rng = np.random.default_rng(seed)
    heights = np.zeros(points.shape[:2])
    for length in lengths_m:
        for _ in range(6):
            wave = rng.normal(size=3)
            wave *= 2.0 * np.pi / length / np.linalg.norm(wave)
            heights += size * length * np.sin(points @ wave + rng.uniform(0.0, 6.0))
    return heights


@cache
def shapes():
    """A lumpy body as its navigator knows it, and the same with relief of 20 m rms below that."""
    known = np.linalg.norm(
        directions(ROWS) / np.linalg.norm(directions(ROWS) / PHOBOS.radii_m, axis=2)[..., None],
        axis=2,
    )
    known = known - PHOBOS.radius_m + waves(ROWS, (20e3, 9e3, 4e3, 2e3), 0.011, 1)
    fine = known.repeat(2, axis=0).repeat(2, axis=1)
    model = GlobalRelief(fine.astype(np.float32), fine.astype(np.float32), PHOBOS.radius_m, "")
    lat = np.pi * (0.5 - (np.arange(2 * ROWS) + 0.5) / (2 * ROWS))[:, None]
    lon = np.pi * ((np.arange(4 * ROWS) + 0.5) / (2 * ROWS) - 1.0)[None, :]
    flat = known.astype(np.float32)
    relief = GlobalRelief(flat, flat, PHOBOS.radius_m, "made")
    rough = waves(2 * ROWS, (800.0, 500.0), 1.0, 2)
    rough *= 20.0 / rough.std()
    truth = (relief.heights_at(lat, lon) + rough).astype(np.float32)
    return relief, replace(model, heights=truth, max_heights=truth)


def view(seed, phase_deg):
    """A place, the Sun and camera_from_body of a camera that looks at the body, nearly."""
    rng = np.random.default_rng(seed)
    axes = make_nadir_axes(rng.normal(size=3))
    phase, turn = np.radians(phase_deg), rng.uniform(0.0, 2.0 * np.pi)
    aside = np.cos(turn) * axes[0] + np.sin(turn) * axes[1]
    sun = np.cos(phase) * axes[2] + np.sin(phase) * aside
    down = Rotation.from_matrix(np.stack([axes[0], -axes[1], -axes[2]]))
    return DISTANCE_M * axes[2], sun, Rotation.from_euler("zx", [rng.uniform(0, 6), 0.01]) * down


def lit_points(relief, position, sun, camera_from_body, noise_px=0.05):
    """What a perfect finder would see of the silhouette of a shape, with noise."""
    axes = make_nadir_axes(position)
    azimuths = np.linspace(-np.pi, np.pi, 1200, endpoint=False)
    across = np.cos(azimuths)[:, None] * axes[0] + np.sin(azimuths)[:, None] * axes[1]
    across = across[across @ sun > 0.1]
    azimuths = np.arctan2(across @ axes[1], across @ axes[0])
    line = LimbRelief(relief, 0.0).skyline(position, axes, azimuths)

    def pixels(off_nadir):
        rays = np.sin(off_nadir)[:, None] * across - np.cos(off_nadir)[:, None] * axes[2]
        return CAMERA.project(camera_from_body.apply(rays))

    edge, inner = pixels(line.off_nadir), pixels(line.off_nadir - 1e-4)
    inward = (inner - edge) / np.linalg.norm(inner - edge, axis=1)[:, None]
    noise = np.random.default_rng(5).normal(0.0, noise_px, (len(edge), 1))
    return LimbPoints(
        pixels=edge + noise * inward,
        sigma_px=np.full(len(edge), noise_px),
        inward=inward,
        common_sigma_px=0.02,
        blur_px=0.1,
        cone_axis_camera=camera_from_body.apply(-axes[2]),
        cone_angle=float(line.off_nadir.mean()),
        arc_deg=180.0,
        lit_pixels=10**5,
        cut_by_frame=False,
    )


def split(error, position):
    """Error along the line of sight and across it, m."""
    up = position / np.linalg.norm(position)
    along = float(error @ up)
    return along, float(np.linalg.norm(error - along * up))


def nees(fix, position):
    error = fix.position_m - position
    return float(error @ np.linalg.solve(fix.covariance_m2, error)) / 3.0


def test_a_small_body_s_relief_is_its_shape_and_the_moon_s_is_not():
    assert is_shape(shapes()[0])
    assert not is_shape(grounds()[1])
    assert 0.05 < estimate_relief_fraction(PHOBOS) < 0.15
    assert (
        estimate_relief_fraction(load_body("moon"))
        == estimate_relief_fraction(load_body("mars"))
        == 0.002
    )


@cache
def double():
    """A contact binary, the origin in its larger half: some of its ground is hidden from there.

    Returns its mesh, the relief of it, the body, and the same mesh with 20 m rms below its posting.
    """
    parts = []
    for radii, x in (((9.0, 7.0, 6.2), 0.0), ((5.0, 4.6, 4.2), 11.5)):
        ball = trimesh.creation.icosphere(subdivisions=4)
        parts.append(trimesh.Trimesh(ball.vertices * radii + [x, 0.0, 0.0], ball.faces))
    both = trimesh.boolean.union(parts, engine="manifold")
    mesh = MeshRays(1e3 * both.vertices[both.faces])
    out = directions(ROWS).reshape(-1, 3)
    _, reached = mesh.find_first_hits(5e4 * out, -out)
    heights = (5e4 - reached - PHOBOS.radius_m).reshape(ROWS, -1).astype(np.float32)
    body = replace(PHOBOS, radii_m=(12.75e3, 7e3, 6.2e3), plausible_heights_m=(-6.5e3, 6e3))
    fine = both.subdivide()
    rough = 1.0 + np.random.default_rng(4).normal(0.0, 0.02, len(fine.vertices)) / np.linalg.norm(
        fine.vertices, axis=1
    )
    truth = MeshRays(1e3 * (fine.vertices * rough[:, None])[fine.faces])
    return mesh, GlobalRelief(heights, heights, PHOBOS.radius_m, "made"), body, truth


def test_silhouettes_are_where_rays_begin_to_miss_the_mesh():
    """Of the larger half, seen along the long axis; cells of 193 m cut a few metres off facets."""
    mesh, relief, _, _ = double()
    position = np.array([-8e4, 3e4, 2e4])
    axes = make_nadir_axes(position)
    azimuths = np.linspace(0.0, 2.0 * np.pi, 90, endpoint=False)
    across = np.cos(azimuths)[:, None] * axes[0] + np.sin(azimuths)[:, None] * axes[1]
    low, high = np.zeros(90), np.full(90, 0.5)
    for _ in range(30):
        middle = 0.5 * (low + high)
        rays = np.sin(middle)[:, None] * across - np.cos(middle)[:, None] * axes[2]
        met = mesh.find_first_hits(position, rays)[0] >= 0
        low, high = np.where(met, middle, low), np.where(met, high, middle)
    rays = np.sin(low)[:, None] * across - np.cos(low)[:, None] * axes[2]
    sight = LimbRays(rays, np.full(90, PIXEL), np.full(90, 0.1), 1e-9, 0.0, np.arange(90))
    limb = ShapeSkyline(LimbRelief(relief, 0.0), 0.0).predict_silhouette(position, sight, None)
    beside_m = limb.offsets * limb.ranges
    assert np.abs(np.median(beside_m)) < 4.0
    assert np.quantile(np.abs(beside_m), 0.9) < 15.0


def test_offsets_change_as_their_rates_say():
    """The second order of a step of 30 m at 100 km is below a tenth of its effect."""
    relief = shapes()[0]
    position, sun, camera_from_body = view(3, 40.0)
    points = lit_points(relief, position, sun, camera_from_body, 0.0)
    rays = camera_from_body.apply(CAMERA.unproject(points.pixels), inverse=True)
    sight = LimbRays(
        rays, np.full(len(rays), PIXEL), points.sigma_px, 1e-6, 0.0, np.arange(len(rays))
    )
    skyline = ShapeSkyline(LimbRelief(relief, 0.0), 0.0)
    limb = skyline.predict_silhouette(position, sight, None)
    for step in 30.0 * make_nadir_axes(position)[:2]:
        after = skyline.predict_silhouette(position + step, sight, None).offsets
        before = skyline.predict_silhouette(position - step, sight, None).offsets
        expected = 2.0 * limb.rates @ step
        wrong = (after - before - expected)[limb.usable]
        assert np.sqrt(np.mean(wrong**2)) < 0.1 * np.sqrt(np.mean(expected**2))


def test_rough_shapes_are_fixed_to_metres_and_say_so():
    relief, truth = shapes()
    across, along, honest, bare_across = [], [], [], []
    for seed in range(6):
        position, sun, camera_from_body = view(seed, 20.0 + 9.0 * seed)
        points = lit_points(truth, position, sun, camera_from_body)
        fix = navigate(points, CAMERA, camera_from_body, 0.0, sun, PHOBOS, relief)
        bare = navigate(points, CAMERA, camera_from_body, 0.0, sun, PHOBOS)
        assert (fix.method, bare.method) == ("horizon", "horizon_sphere")
        both = split(fix.position_m - position, position)
        along.append(both[0])
        across.append(both[1])
        bare_across.append(split(bare.position_m - position, position)[1])
        honest.append(nees(fix, position))
    # the figures asked for
    assert np.sqrt(np.mean(np.square(across))) < 15.0
    assert np.sqrt(np.mean(np.square(along))) < 0.001 * DISTANCE_M
    assert np.mean(across) < 0.1 * np.mean(bare_across)
    assert 0.1 < np.mean(honest) < 1.8


def test_another_attitude_is_refused():
    relief, truth = shapes()
    position, sun, camera_from_body = view(1, 40.0)
    points = lit_points(truth, position, sun, camera_from_body)
    turned = camera_from_body * Rotation.from_euler("z", 25.0, degrees=True)
    with pytest.raises(NoSolutionError, match="silhouette of the shape"):
        navigate(points, CAMERA, turned, 0.0, None, PHOBOS, relief)


def test_contact_binaries_are_solved_or_refused():
    """Concave, lobed, its neck unknown to the relief: pictures through the whole chain."""
    _, relief, body, mesh = double()
    x, y = np.meshgrid(np.arange(CAMERA.width_px + 1) - 0.5, np.arange(CAMERA.height_px + 1) - 0.5)
    corners = CAMERA.unproject(np.stack([x, y], axis=-1)).reshape(-1, 3)
    solved = 0
    for seed, phase in ((901, 21.0), (903, 25.0), (925, 61.0), (914, 43.0)):
        position, sun, camera_from_body = view(seed, phase)
        rays = camera_from_body.apply(corners, inverse=True).reshape(*x.shape, 3)
        light = MeshScene(mesh, sun).picture(position, rays, 3)
        light *= 200.0 / np.quantile(light, 0.99)
        light += np.random.default_rng(seed).normal(3.0, 1.0, light.shape)
        stretch = camera_from_body.as_matrix().T / np.array(body.radii_m)[:, None]
        try:
            limb = find_limb(
                np.clip(np.rint(light), 0.0, 255.0).astype(np.float32), CAMERA,
                camera_from_body.apply(sun),
                saturation=255.0, stretch=stretch, relief=estimate_relief_fraction(body),
            )  # fmt: skip
            fix = navigate(limb, CAMERA, camera_from_body, 0.0, sun, body, relief)
        except NoSolutionError:
            continue
        solved += 1
        assert nees(fix, position) < 4.0
        along, across = split(fix.position_m - position, position)
        assert across < 40.0
        assert abs(along) < 0.004 * DISTANCE_M
    assert solved >= 2


def test_the_moon_keeps_its_own_way():
    """A relief that is no shape goes through its skyline, and a shape's solution refuses none."""
    position = place(2e5, 3)
    axes = make_nadir_axes(position)
    turned = Rotation.from_matrix(np.stack([axes[0], -axes[1], -axes[2]]))
    fix = navigate(limb_points(position, turned), preset_camera("shnk"), turned, 0.0, None,
                   load_body("moon"), grounds()[1])  # fmt: skip
    assert fix.method == "horizon"
    assert np.linalg.norm(fix.position_m - position) < 500.0
