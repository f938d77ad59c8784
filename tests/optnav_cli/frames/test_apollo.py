"""The Apollo frame: which way round its camera frame and its picture are."""

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
import rasterio

from catalog.geometry.ellipsoid import distance_to_sphere
from catalog.geometry.latlon import latlon_from_xyz
from catalog.geometry.projection import Stereographic, make_node_grid
from optnav_cli.archives.job import ImportOptions, import_folder
from optnav_cli.camera.camera_file import preset_camera
from optnav_cli.frames.folder import read_folder
from optnav_cli.frames.frames import Frame
from optnav_cli.frames.picture import load_picture

CAMERA = "apollo15_metric"
RADIUS = 1737400.0
POSTING = 474.0
NODES, TEMPLATE, MARGIN = 300, 200, 20


@pytest.fixture
def cube(shared_data: Callable[[str], Path]) -> Path:
    return shared_data("apollo15/AS15-M-0297_crop.cub")


@pytest.fixture
def photo(shared_data: Callable[[str], Path]) -> Path:
    return shared_data("apollo15/AS15-M-0297_SML.png")


@pytest.fixture
def dem(shared_data: Callable[[str], Path]) -> Path:
    return shared_data("moon/farside_gld100_64ppd.tif")


def terrain(path: Path, projection: Stereographic) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Body-fixed points, heights and the map x, y of a grid about the sub-spacecraft point."""
    with rasterio.open(path) as dataset:
        heights, transform = dataset.read(1).astype(np.float32), dataset.transform
    x, y = make_node_grid(NODES, POSTING)
    lat, lon = projection.latlon(x, y)
    column = (RADIUS * np.mod(lon, 2.0 * np.pi) - transform.c) / transform.a - 0.5
    row = (RADIUS * lat - transform.f) / transform.e - 0.5
    grid = cv2.remap(heights, column.astype(np.float32), row.astype(np.float32), cv2.INTER_CUBIC)
    return projection.points(x, y, grid.astype(np.float64)), grid, np.stack([x, y])


def high_pass(image: np.ndarray) -> np.ndarray:
    image = image.astype(np.float32)
    return image - cv2.GaussianBlur(image, (0, 0), 12.0)


def shaded(grid: np.ndarray, xy: np.ndarray, sun_local: np.ndarray) -> np.ndarray:
    """Lommel-Seeliger brightness seen from above, on the curved body."""
    south, east = np.gradient(grid, POSTING)
    normal = np.stack([-(east - xy[0] / RADIUS), south + xy[1] / RADIUS, np.ones_like(east)], -1)
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    mu0 = np.clip(normal @ sun_local, 0.0, None)
    return mu0 / (mu0 + normal[..., 2])


def best_correlation(
    frame: Frame, orientation: np.ndarray, photo: np.ndarray, dem: Path
) -> tuple[float, float]:
    """Highest correlation of picture and shaded terrain, and the shift (m) where it is reached."""
    assert frame.position_m is not None
    assert frame.camera_from_body is not None
    assert frame.sun_body is not None
    lat, lon, _ = latlon_from_xyz(frame.position_m)
    projection = Stereographic(float(lat), float(lon), RADIUS)
    points, grid, xy = terrain(dem, projection)
    camera_from_body = orientation @ frame.camera_from_body.as_matrix()
    pixels = preset_camera(CAMERA).project_from_body(points, frame.position_m, camera_from_body)
    px = pixels.astype(np.float32)
    seen = high_pass(cv2.remap(photo, px[..., 0], px[..., 1], cv2.INTER_LINEAR))
    made = high_pass(shaded(grid, xy, projection.body_from_local.T @ frame.sun_body))
    low, high = (NODES - TEMPLATE) // 2, (NODES + TEMPLATE) // 2
    scores = cv2.matchTemplate(
        seen[low - MARGIN : high + MARGIN, low - MARGIN : high + MARGIN],
        made[low:high, low:high],
        cv2.TM_CCOEFF_NORMED,
    )
    peak = np.array(np.unravel_index(scores.argmax(), scores.shape))
    return float(scores.max()), float(np.linalg.norm(peak - MARGIN)) * POSTING


def test_only_this_orientation_of_the_eight_fits_the_terrain(
    cube: Path, photo: Path, dem: Path, tmp_path: Path
) -> None:
    """Measured: 0.87 at 1.7 km from the label's place, and 0.10 for the next best."""
    options = ImportOptions(pictures=(photo,))
    (frame,) = import_folder([cube], tmp_path / "pictures", options).frames
    image = cv2.GaussianBlur(load_picture(photo, preset_camera(CAMERA)).values, (0, 0), 1.2)
    scores = []
    for swap in (np.eye(3), np.eye(3)[[1, 0, 2]]):
        for x in (1.0, -1.0):
            for y in (1.0, -1.0):
                scores.append(best_correlation(frame, np.diag([x, y, 1.0]) @ swap, image, dem))
    (chosen, shift_m), others = scores[0], scores[1:]
    assert chosen > 0.8
    assert shift_m < 3000.0
    assert max(score for score, _ in others) < 0.3


def test_the_cube_runs_as_the_picture_does(cube: Path, photo: Path) -> None:
    """500 cube samples are 15.976 scan pixels each, of 22 900 for the whole frame of the PNG."""
    with pytest.warns(rasterio.errors.NotGeoreferencedWarning), rasterio.open(cube) as dataset:
        crop = dataset.read(1) / 100.0
    side = round(500 * 15.976 / 22900 * 1013)
    small = cv2.resize(crop.astype(np.float32), (side, side), interpolation=cv2.INTER_AREA)
    image = load_picture(photo, preset_camera(CAMERA)).values
    scores = cv2.matchTemplate(image, small, cv2.TM_CCOEFF_NORMED)
    row, column = np.unravel_index(scores.argmax(), scores.shape)
    assert scores.max() > 0.97
    # AlphaStartingSample 7996.5 and AlphaStartingLine 3996.5
    assert column == pytest.approx(7996.5 / 22900 * 1013, abs=2.0)
    assert row == pytest.approx(3996.5 / 22900 * 1013, abs=2.0)


def test_the_folder_reads_back_with_its_footprint_in_the_crop(
    cube: Path, photo: Path, tmp_path: Path
) -> None:
    import_folder([cube], tmp_path / "pictures", ImportOptions(pictures=(photo,)))
    folder = read_folder(tmp_path / "pictures")
    (frame,) = folder.frames
    assert frame.problem is None
    assert frame.attitude_sigma_rad is None
    camera = folder.cameras[frame.camera]
    assert load_picture(folder.picture_path(frame), camera).values.shape == (1012, 1012)
    assert frame.position_m is not None
    assert frame.camera_from_body is not None
    corners = camera.unproject([[0, 0], [1011, 0], [1011, 1011], [0, 1011]])
    rays = frame.camera_from_body.inv().apply(corners)
    distance = distance_to_sphere(frame.position_m, rays, RADIUS)
    lat, lon, _ = latlon_from_xyz(frame.position_m + rays * distance[:, None])
    assert np.degrees(lat).min() > -30.0
    assert np.degrees(lat).max() < -8.0
    assert np.degrees(lon).min() > 130.0
    assert np.degrees(lon).max() < 156.0
    # north is up and east is right in the picture
    assert lat[0] > lat[3]
    assert lon[1] > lon[0]


def test_a_cropped_cube_gets_the_camera_of_its_part(
    cube: Path, photo: Path, tmp_path: Path
) -> None:
    """The same ground is seen at the same place of both pictures, to a pixel of the smaller one."""
    import_folder([cube], tmp_path / "part")
    import_folder([cube], tmp_path / "whole", ImportOptions(pictures=(photo,)))
    part, whole = (read_folder(tmp_path / name) for name in ("part", "whole"))
    (crop,), (camera,) = part.cameras.values(), whole.cameras.values()
    assert crop.shape == (500, 500)
    pixels = np.array([[20.0, 30.0], [470.0, 40.0], [250.0, 480.0]])
    in_whole = camera.project(crop.unproject(pixels))
    small = load_picture(part.picture_path(part.frames[0]), crop).values
    large = load_picture(whole.picture_path(whole.frames[0]), camera).values
    factor = camera.focal_length_px / crop.focal_length_px
    back = cv2.resize(small, None, fx=factor, fy=factor, interpolation=cv2.INTER_AREA)
    scores = cv2.matchTemplate(large, back, cv2.TM_CCOEFF_NORMED)
    row, column = np.unravel_index(scores.argmax(), scores.shape)
    expected = (pixels + 0.5) * factor - 0.5 + (column, row)
    np.testing.assert_allclose(in_whole, expected, atol=1.5)
