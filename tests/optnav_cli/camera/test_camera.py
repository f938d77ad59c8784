"""Camera models."""

import pickle
from pathlib import Path

import cv2
import numpy as np
import pytest

from optnav_cli.camera.camera import Camera
from optnav_cli.camera.camera_file import preset_camera

PRESETS = Path(__file__).parents[3] / "configs/cameras"
BROWN = (-0.12, 0.03, 0.0011, -0.0007, -0.002)
FISHEYE = (0.02, -0.006, 0.0015, 0.00002)
RATIONAL = (0.21, -0.05, 0.0011, -0.0007, 0.004, 0.33, -0.02, 0.006)
PRISM = (*RATIONAL, 0.002, -0.0006, -0.0015, 0.0004)
TILTED = (*PRISM, 0.05, -0.03)


def camera(model: str, coefficients: tuple[float, ...] = (), **changes: object) -> Camera:
    fields: dict[str, object] = {
        "name": "test",
        "model": model,
        "width_px": 1200,
        "height_px": 900,
        "focal_length_px": 700.0,
        "principal_point_px": (590.3, 455.8),
        "distortion": "none",
        "coefficients": coefficients,
    }
    if model == "pinhole" and coefficients:
        fields["distortion"] = "brown" if len(coefficients) == 5 else "opencv"
    return Camera(**{**fields, **changes})  # type: ignore[arg-type]


CAMERAS = {
    "pinhole": camera("pinhole"),
    "brown": camera("pinhole", BROWN),
    "narrow": camera("pinhole", focal_length_px=68755.0),
    "equidistant": camera("equidistant", focal_length_px=250.0),
    "kannala_brandt": camera("kannala_brandt", FISHEYE, focal_length_px=250.0),
    "four terms": camera("pinhole", BROWN[:4]),
    "rational": camera("pinhole", RATIONAL),
    "prism": camera("pinhole", PRISM),
    "tilted": camera("pinhole", TILTED),
    "oblong": camera("pinhole", BROWN, focal_length_y_px=415.0),
    "oblong tilted": camera("pinhole", TILTED, focal_length_y_px=1100.0),
    "oblong fisheye": camera(
        "kannala_brandt", FISHEYE, focal_length_px=250.0, focal_length_y_px=148.0
    ),
}
FISHEYES = [name for name, cam in CAMERAS.items() if cam.model != "pinhole"]
PINHOLES = [name for name in CAMERAS if name not in (*FISHEYES, "narrow")]


def scattered_pixels(cam: Camera, count: int = 4000) -> np.ndarray:
    corner = (cam.width_px - 0.5, cam.height_px - 0.5)
    return np.random.default_rng(7).uniform(-0.5, corner, size=(count, 2))


def scattered_points(count: int = 500) -> np.ndarray:
    """Points up to 50 degrees from the axis, at very different distances."""
    rng = np.random.default_rng(8)
    angle, azimuth = rng.uniform(0.0, 0.87, count), rng.uniform(0.0, 2.0 * np.pi, count)
    directions = np.stack(
        [np.sin(angle) * np.cos(azimuth), np.sin(angle) * np.sin(azimuth), np.cos(angle)], axis=1
    )
    return directions * 10.0 ** rng.uniform(0.0, 6.0, (count, 1))


@pytest.mark.parametrize("name", CAMERAS)
def test_every_pixel_returns_from_its_ray(name: str) -> None:
    cam = CAMERAS[name]
    pixels = scattered_pixels(cam)
    rays = cam.unproject(pixels)
    np.testing.assert_allclose(np.linalg.norm(rays, axis=1), 1.0, atol=1e-14)
    np.testing.assert_allclose(cam.project(rays * 1234.5), pixels, rtol=0.0, atol=1e-9)


@pytest.mark.parametrize("name", CAMERAS)
def test_every_ray_returns_from_its_pixel(name: str) -> None:
    cam = CAMERAS[name]
    rays = scattered_points()
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    np.testing.assert_allclose(cam.unproject(cam.project(rays)), rays, rtol=0.0, atol=1e-12)


@pytest.mark.parametrize("name", PINHOLES)
def test_pinholes_agree_with_opencv(name: str) -> None:
    cam, points = CAMERAS[name], scattered_points()
    expected, _ = cv2.projectPoints(
        points, np.zeros(3), np.zeros(3), matrix(cam), np.array(cam.coefficients or [0.0] * 5)
    )
    np.testing.assert_allclose(cam.project(points), expected[:, 0], rtol=0.0, atol=1e-8)


@pytest.mark.parametrize("name", FISHEYES)
def test_fisheyes_agree_with_opencv(name: str) -> None:
    cam, points = CAMERAS[name], scattered_points()
    expected, _ = cv2.fisheye.projectPoints(
        points[:, None],
        np.zeros(3),
        np.zeros(3),
        matrix(cam),
        np.array(cam.coefficients or [0.0] * 4),
    )
    np.testing.assert_allclose(cam.project(points), expected[:, 0], rtol=0.0, atol=1e-8)


def matrix(cam: Camera) -> np.ndarray:
    f, (cx, cy) = cam.focal_length_px, cam.principal_point_px
    return np.array([[f, 0.0, cx], [0.0, cam.focal_length_y_px or f, cy], [0.0, 0.0, 1.0]])


@pytest.mark.parametrize("name", CAMERAS)
def test_the_jacobian_is_the_finite_difference(name: str) -> None:
    """Central differences of 1e-5 of the range are good to about 1e-8 of a derivative's size."""
    cam = CAMERAS[name]
    points = scattered_points(200)
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    pixels, jacobian = cam.project_with_jacobian(points)
    np.testing.assert_array_equal(pixels, cam.project(points))
    for axis in range(3):
        step = np.zeros(3)
        step[axis] = 1e-5
        difference = (cam.project(points + step) - cam.project(points - step)) / 2e-5
        tolerance = 1e-7 * cam.focal_length_px
        np.testing.assert_allclose(jacobian[:, :, axis], difference, rtol=0.0, atol=tolerance)


@pytest.mark.parametrize("name", CAMERAS)
def test_the_jacobian_is_defined_on_the_axis(name: str) -> None:
    cam = CAMERAS[name]
    _, jacobian = cam.project_with_jacobian([[0.0, 0.0, 4.0]])
    expected = np.diag(matrix(cam))[:2] / 4.0
    if "tilted" in name:  # which stretches the middle as well
        tilt = cv2.projectPoints(np.array([[1e-7, 0, 1], [0, 1e-7, 1.0]]), np.zeros(3), np.zeros(3),
                                 matrix(cam), np.array(cam.coefficients))[0][:, 0]  # fmt: skip
        expected_rows = ((tilt - cam.principal_point_px) / 4e-7).T
        np.testing.assert_allclose(jacobian[0, :, :2], expected_rows, rtol=1e-5, atol=1e-3)
        return
    np.testing.assert_allclose(jacobian[0, :, :2], np.diag(expected), atol=1e-9)
    np.testing.assert_allclose(jacobian[0, :, 2], 0.0, atol=1e-9)


@pytest.mark.parametrize("name", ["equidistant", "kannala_brandt"])
def test_fisheyes_see_behind_themselves(name: str) -> None:
    cam = CAMERAS[name]
    angles = np.radians([89.0, 90.0, 91.0, 120.0, 170.0])
    rays = np.stack([np.sin(angles), np.zeros(5), np.cos(angles)], axis=1)
    pixels = cam.project(rays)
    assert np.all(np.diff(pixels[:, 0]) > 0.0)
    np.testing.assert_allclose(cam.unproject(pixels), rays, atol=1e-12)


def test_an_equidistant_pixel_is_an_angle() -> None:
    cam = camera("equidistant", focal_length_px=180.0 / np.pi)  # one pixel a degree
    ray = [np.sin(np.radians(137.0)), 0.0, np.cos(np.radians(137.0))]
    np.testing.assert_allclose(cam.project(ray), [590.3 + 137.0, 455.8], atol=1e-10)


def test_straight_behind_no_camera_has_a_pixel() -> None:
    for cam in CAMERAS.values():
        assert np.isnan(cam.project([0.0, 0.0, -1.0])).all()
        assert np.isnan(cam.project([0.0, 0.0, 0.0])).all()
        assert np.isnan(cam.project([np.nan, 0.0, 1.0])).all()


def test_a_pinhole_does_not_see_behind_itself() -> None:
    for name in ("pinhole", "brown"):
        pixels, jacobian = CAMERAS[name].project_with_jacobian([[0.1, 0.2, -1.0], [1.0, 0.0, 0.0]])
        assert np.isnan(pixels).all()
        assert np.isnan(jacobian).all()


def test_a_barrel_distortion_ends_where_it_folds() -> None:
    """r (1 - 0.3 r^2) rises up to r = 1 / sqrt(0.9) = 1.054, where it is 0.703."""
    cam = camera("pinhole", (-0.3, 0.0, 0.0, 0.0, 0.0))
    fold = 1.0 / np.sqrt(0.9)
    assert np.isfinite(cam.project([fold - 1e-6, 0.0, 1.0])).all()
    assert np.isnan(cam.project([fold + 1e-6, 0.0, 1.0])).all()
    edge = 590.3 + 700.0 * fold * (1.0 - 0.3 * fold**2)
    assert np.isfinite(cam.unproject([edge - 0.01, 455.8])).all()
    assert np.isnan(cam.unproject([edge + 0.01, 455.8])).all()


def test_no_two_rays_share_a_pixel_in_a_strongly_distorted_lens() -> None:
    """Whatever projects at all must come back to its own ray, up to the edge of validity."""
    cam = camera("pinhole", (-0.4, 0.25, 0.01, -0.02, -0.07))
    x, y = np.meshgrid(np.linspace(-3.0, 3.0, 301), np.linspace(-3.0, 3.0, 301))
    rays = np.stack([x, y, np.ones_like(x)], axis=-1)
    pixels = cam.project(rays)
    valid = np.isfinite(pixels[..., 0])
    assert 0.05 < valid.mean() < 0.9
    back = cam.unproject(pixels[valid])
    back /= back[:, 2:]
    # near the fold the inverse is as ill-posed as a square root near zero
    np.testing.assert_allclose(back, rays[valid], atol=1e-6)


def test_a_fisheye_ends_where_its_radius_stops_growing() -> None:
    cam = camera("kannala_brandt", (-0.1, 0.0, 0.0, 0.0))
    angle = np.sqrt(1.0 / 0.3)
    for offset, valid in ((-1e-6, True), (1e-6, False)):
        ray = [np.sin(angle + offset), 0.0, np.cos(angle + offset)]
        assert np.isfinite(cam.project(ray)).all() == valid
    radius = 700.0 * angle * (1.0 - 0.1 * angle**2)
    assert np.isnan(cam.unproject([590.3 + radius + 0.01, 455.8])).all()


def test_nothing_is_seen_beyond_the_image_circle() -> None:
    cam = camera("equidistant", focal_length_px=100.0, image_circle_radius_px=157.0)
    assert np.isfinite(cam.project([1.0, 0.0, 0.01])).all()
    assert np.isnan(cam.project([1.0, 0.0, -0.01])).all()
    assert np.isnan(cam.unproject([590.3 + 158.0, 455.8])).all()


def test_body_points_project_as_camera_points_do() -> None:
    rng = np.random.default_rng(9)
    rotation, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    position = np.array([1.2e6, -0.9e6, 1.1e6])
    points = scattered_points(60).reshape(5, 12, 3) * 100.0
    body = points @ rotation + position  # rows: camera_from_body.T @ point
    for cam in CAMERAS.values():
        np.testing.assert_allclose(
            cam.project_from_body(body, position, rotation), cam.project(points), atol=1e-3
        )


def test_shapes_are_kept_and_wrong_ones_refused() -> None:
    cam = CAMERAS["brown"]
    assert cam.project(np.ones((2, 3, 3))).shape == (2, 3, 2)
    assert cam.unproject(np.ones(2)).shape == (3,)
    assert cam.project(np.empty((0, 3))).shape == (0, 2)
    with pytest.raises(ValueError, match=r"\(\.\.\., 3\)"):
        cam.project(np.ones((4, 2)))


def test_the_picture_ends_half_a_pixel_beyond_the_last_centre() -> None:
    cam = CAMERAS["pinhole"]
    pixels = [[-0.5, 0.0], [-0.6, 0.0], [1199.5, 899.5], [1199.6, 0.0], [np.nan, 0.0], [3.0, 3.0]]
    assert cam.contains(pixels).tolist() == [True, False, True, False, False, True]
    assert cam.contains(pixels, margin_px=4.0).tolist() == [False] * 6


def test_a_used_camera_travels_to_a_worker() -> None:
    cam = CAMERAS["brown"]
    expected = cam.project([0.1, 0.2, 1.0])
    copy = pickle.loads(pickle.dumps(cam))
    assert copy == cam
    np.testing.assert_array_equal(copy.project([0.1, 0.2, 1.0]), expected)


def whole_picture(cam: Camera) -> np.ndarray:
    """Every third pixel centre of the picture, and its outermost edges, half a pixel out."""
    x = np.unique(np.append(np.arange(0.0, cam.width_px, 3.0), [-0.5, cam.width_px - 0.5]))
    y = np.unique(np.append(np.arange(0.0, cam.height_px, 3.0), [-0.5, cam.height_px - 0.5]))
    return np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)


WHOLE = {path.stem: preset_camera(path.stem) for path in sorted(PRESETS.glob("*.toml"))} | {
    "kannala_brandt": camera("kannala_brandt", FISHEYE, focal_length_px=330.0)
}


@pytest.mark.parametrize("name", WHOLE)
def test_the_whole_picture_returns_from_its_rays_and_agrees_with_opencv(name: str) -> None:
    """OpenCV has the fisheye up to 90 degrees from the axis only."""
    cam = WHOLE[name]
    pixels = whole_picture(cam)
    rays = cam.unproject(pixels)
    np.testing.assert_allclose(cam.project(rays * 5e7), pixels, rtol=0.0, atol=1e-9)
    fisheye = cam.model != "pinhole"
    seen = rays[:, 2] > (0.017 if fisheye else 0.0)
    points, still = np.ascontiguousarray(rays[seen]), np.zeros(3)
    if fisheye:
        terms = np.array(cam.coefficients or [0.0] * 4)
        theirs, _ = cv2.fisheye.projectPoints(points[:, None], still, still, matrix(cam), terms)
    else:
        terms = np.array(cam.coefficients or [0.0] * 5)
        theirs, _ = cv2.projectPoints(points, still, still, matrix(cam), terms)
    np.testing.assert_allclose(theirs[:, 0], pixels[seen], rtol=0.0, atol=1e-9)


@pytest.mark.parametrize(("name", "widest_deg"), [("shnk", 127.12), ("kannala_brandt", 119.63)])
def test_without_an_image_circle_all_pixels_beyond_90_degrees_are_used(
    name: str, widest_deg: float
) -> None:
    """Their radius is Kannala and Brandt's polynomial of the angle from the axis, which grows.

    The widest: 1024 sqrt(2) / 652.7 rad, and where the polynomial is 761.1 / 330.
    """
    cam = WHOLE[name]
    pixels = whole_picture(cam)
    rays = cam.unproject(pixels)
    angle = np.arctan2(np.hypot(rays[:, 0], rays[:, 1]), rays[:, 2])
    assert np.degrees(angle.max()) == pytest.approx(widest_deg, abs=0.01)
    assert np.mean(angle > np.pi / 2.0) > 0.1
    powers = angle[:, None] ** [3, 5, 7, 9]
    expected = angle + powers @ np.array(cam.coefficients or [0.0] * 4)
    radius = np.linalg.norm(pixels - cam.principal_point_px, axis=1) / cam.focal_length_px
    np.testing.assert_allclose(radius, expected, rtol=0.0, atol=1e-12)


def test_an_equidistant_lens_keeps_every_angle_to_the_last_digits() -> None:
    """Against the library's atan2, from the axis to behind the camera, in grids and alone."""
    cam = camera("equidistant", focal_length_px=1.0, principal_point_px=(0.0, 0.0))
    angles = np.concatenate([np.geomspace(1e-12, 0.1, 500), np.linspace(0.1, np.pi, 5001)[:-1]])
    rays = np.stack([np.sin(angles), np.zeros_like(angles), np.cos(angles)], axis=1)
    wanted = np.arctan2(rays[:, 0], rays[:, 2])
    for found in (cam.project(rays), cam.project_from_body(rays, np.zeros(3), np.eye(3))):
        np.testing.assert_allclose(found[:, 0], wanted, rtol=1e-15)


def test_a_fisheye_with_oblong_pixels_sees_grids_as_it_sees_single_points() -> None:
    cam = camera("kannala_brandt", FISHEYE, focal_length_px=250.0, focal_length_y_px=275.0)
    points = scattered_points()
    grid = cam.project_from_body(points, np.zeros(3), np.eye(3))
    np.testing.assert_array_equal(grid, cam.project(points))
