"""Control points of a small body: a patch is rendered as a picture shows the mesh."""

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from catalog.arrays import FloatArray
from catalog.bodies.body import Body, load_body
from catalog.control_point import ControlPoint, Patch
from catalog.correlation.filters import blur_nodes
from catalog.correlation.ncc import match_ncc
from catalog.geometry.ellipsoid import find_foot
from catalog.rendering.mesh_scene import MeshScene
from catalog.terrain.dem.file import resolve_path
from catalog.terrain.mesh.file import MeshSettings
from catalog.terrain.mesh.rays import MeshRays
from catalog.terrain.mesh.refine import add_detail, refine_shape, smooth_corners
from catalog.terrain.mesh.shape import Shape, load_shape
from catalog.terrain.mesh.terrain import MeshTerrain
from catalog.terrain.synthetic.relief import SyntheticRelief
from optnav_cli.camera.camera_file import preset_camera
from optnav_cli.control_points.picture_pyramid import PicturePyramid
from optnav_cli.control_points.point_match import MatchGates, match_point
from optnav_cli.control_points.reference import Reference
from optnav_cli.control_points.search_plan import SearchPlan
from optnav_cli.estimation.models.points import Pose

POSTING_M = 48.0
PLACES_DEG = [(5.0, -8.0), (-20.0, 12.0), (15.0, 18.0), (-5.0, 22.0), (12.0, -14.0)]


@pytest.fixture(scope="module")
def body() -> Body:
    return load_body("phobos")


@pytest.fixture(scope="module")
def shape(body: Body) -> Shape:
    return load_shape(MeshSettings("bundled:phobos_thomas.tab", "km", "west"), Path(), body)


def scene_of(body: Body, known: MeshTerrain, seen: FloatArray):
    """Phobos from 50 km, phase 40 deg: references, camera, pose, Sun, picture.

    known  what the references are cut from;  seen (n, 3, 3) corners of the mesh in the picture
    """
    camera = preset_camera("tsnn_shtk")
    place = np.array([5.0e4, 2.0e3, -1.0e3])
    ahead = -place / np.linalg.norm(place)
    right = np.cross([0.0, 0.0, -1.0], ahead)
    right /= np.linalg.norm(right)
    camera_from_body = np.stack([right, np.cross(ahead, right), ahead])
    sun = np.array([0.77, -0.6, 0.2])
    sun /= np.linalg.norm(sun)
    x, y = np.meshgrid(np.arange(camera.width_px + 1), np.arange(camera.height_px + 1))
    rays = camera.unproject(np.stack([x, y], axis=-1) - 0.5) @ camera_from_body
    picture = MeshScene(MeshRays(seen), sun).picture(place, rays, samples=2)
    references = []
    for number, (lat, lon) in enumerate(np.radians(PLACES_DEG)):
        radius = float(np.linalg.norm(known.points(lat, lon)))
        lat_deg, lon_deg = PLACES_DEG[number]
        point = ControlPoint(number, lat_deg, lon_deg, radius, 1.0, 1.0, 1.0, 5, (1.0,), (), True)
        patch = Patch(POSTING_M, known.local_grid(known.projection(lat, lon), POSTING_M, 96))
        references.append(Reference(point, (patch,), body.radius_m, body.radii_m))
    pose = Pose(place, Rotation.from_matrix(camera_from_body))
    return references, camera, pose, sun, PicturePyramid(picture)


def terrain_of(body: Body, shape: Shape, corners: FloatArray, folder: Path) -> MeshTerrain:
    np.save(folder / "corners.npy", corners)
    return MeshTerrain(body, folder / "corners.npy", "phobos", shape.posting_m)


@pytest.fixture(scope="module")
def scene(body, shape, tmp_path_factory):
    """The picture shows the model itself."""
    corners = shape.vertices[shape.faces]
    terrain = terrain_of(body, shape, corners, tmp_path_factory.mktemp("mesh"))
    return scene_of(body, terrain, corners)


def test_a_reference_in_a_plane_looks_as_the_mesh_does(scene) -> None:
    references, camera, pose, sun, picture = scene
    for reference in references:
        template = reference.render(0, reference.heights(0, 64), sun, pose.position_m)
        pixels = camera.project_from_body(
            reference.surface(0, reference.heights(0, 64)),
            pose.position_m,
            pose.camera_from_body.as_matrix(),
        )
        window = picture.sample(pixels, 2.0)
        # lunar-Lambert against Hapke, flat faces a few pixels wide
        assert np.corrcoef(template.ravel(), window.ravel())[0, 1] > 0.95


def test_a_point_is_found_where_a_wrong_pose_does_not_expect_it(scene) -> None:
    references, camera, pose, sun, picture = scene
    turn = pose.camera_from_body.as_matrix()
    off_m = np.array([90.0, -60.0, 0.0]) @ turn
    wrong = Pose(pose.position_m + off_m, pose.camera_from_body)
    errors = []
    for reference in references:
        range_m = float(np.linalg.norm(reference.point.xyz_m - pose.position_m))
        gsd = range_m / camera.focal_length_px
        match = match_point(
            reference,
            SearchPlan(0, 64, 5, gsd),
            picture,
            camera,
            wrong,
            sun,
            match_ncc,
            MatchGates(),
        )
        assert not match.reason
        truth = camera.project_from_body(reference.point.xyz_m, pose.position_m, turn)
        errors.append((match.pixel - truth) * gsd)
    # the points are known to a hundredth of a metre: what is left is the match's, in metres
    assert np.abs(errors).max() < 0.4 * POSTING_M
    assert np.sqrt(np.square(errors).mean()) < 0.2 * POSTING_M


def test_behind_a_blur_points_are_found_in_relief_that_the_model_hides(
    body, shape, tmp_path_factory
) -> None:
    path = resolve_path("bundled:phobos_thomas.tab", Path())
    smooth = smooth_corners(path, "west", 1e3, shape.vertices, shape.faces, 2)
    terrain = terrain_of(body, shape, smooth, tmp_path_factory.mktemp("smooth"))
    detail = SyntheticRelief(
        7, shape.posting_m, body.radius_m, smallest_m=160.0, rms_slope_deg=15.0, saturation=0.1
    )
    fine = refine_shape(shape, 2)
    rough = add_detail(fine, detail)
    hidden = np.linalg.norm(rough.vertices - fine.vertices, axis=1)
    assert np.sqrt(np.square(hidden).mean()) == pytest.approx(20.0, abs=2.0)
    references, camera, pose, sun, picture = scene_of(body, terrain, rough.vertices[rough.faces])
    turn = pose.camera_from_body.as_matrix()
    blur = blur_nodes(POSTING_M, shape.posting_m)
    scores: dict[float, list[float]] = {0.0: [], blur: []}
    squares = []  # errors squared over stated variances
    for reference in references:
        gsd = float(np.linalg.norm(reference.point.xyz_m - pose.position_m))
        gsd /= camera.focal_length_px
        truth = camera.project_from_body(reference.point.xyz_m, pose.position_m, turn)
        for sigma, found in scores.items():
            match = match_point(
                reference,
                SearchPlan(0, 80, 20, gsd, blur_nodes=sigma),
                picture,
                camera,
                pose,
                sun,
                match_ncc,
                MatchGates(),
            )
            found.append(match.score)
        # the last one, behind the blur
        error = match.pixel - truth
        assert np.linalg.norm(error) * gsd < 0.5 * shape.posting_m
        squares.append(error @ np.linalg.solve(match.covariance_px2, error) / 2.0)
    assert (np.array(scores[blur]) > 1.5 * np.array(scores[0.0])).all()
    assert np.mean(squares) < 2.0  # 2.5 by the remainder


def test_ground_goes_on_beyond_the_only_patch(body, scene) -> None:
    """To where a wide search looks; known there are the ellipsoid and the patch's border."""
    reference = scene[0][0]
    surface = reference.surface(0, reference.heights(0, 176))
    assert np.isfinite(surface).all()
    assert (surface[40:-40, 40:-40] == reference.surface(0, reference.heights(0, 96))).all()
    steps = np.linalg.norm(np.diff(surface, axis=0), axis=2)
    assert steps.max() < 3.0 * POSTING_M
    over = np.linalg.norm(surface - find_foot(surface.reshape(-1, 3), body.radii_m).reshape(
        surface.shape), axis=2)  # fmt: skip
    assert over.max() < 2e3
