"""Camera files."""

from pathlib import Path

import numpy as np
import pytest

from catalog.errors import ConfigError
from optnav_cli.camera.camera import Coding
from optnav_cli.camera.camera_file import camera_toml, load_camera, preset_camera

PRESETS = Path(__file__).parents[3] / "configs/cameras"
GOOD = """
name = "wide"
model = "pinhole"
width_px = 640
height_px = 480
focal_length_px = 500.0
principal_point_px = [319.5, 239.5]
"""


def written(tmp_path: Path, text: str) -> Path:
    path = tmp_path / "camera.toml"
    path.write_text(text)
    return path


def test_the_shortest_camera_file_works(tmp_path: Path) -> None:
    camera = load_camera(written(tmp_path, GOOD))
    assert (camera.name, camera.shape, camera.focal_length_px) == ("wide", (480, 640), 500.0)
    np.testing.assert_allclose(camera.project([0.1, 0.2, 1.0]), [369.5, 339.5])


def test_a_focal_length_in_millimetres_needs_the_pitch(tmp_path: Path) -> None:
    text = GOOD.replace("focal_length_px = 500.0", "focal_length_mm = 2.75\npixel_pitch_um = 5.5")
    assert load_camera(written(tmp_path, text)).focal_length_px == pytest.approx(500.0)
    with pytest.raises(ConfigError, match="add pixel_pitch_um"):
        load_camera(written(tmp_path, text.replace("pixel_pitch_um = 5.5", "")))


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("focal_length_px = 500.0", "", "no focal length"),
        (
            "focal_length_px = 500.0",
            "focal_length_px = -500.0",
            "px = -500.0: must be",
        ),
        ("focal_length_px = 500.0", "focal_length_px = nan", "finite"),
        ("focal_length_px = 500.0", "focal_length_px = 1e-2", "longer side, 640 px"),
        ("focal_length_px = 500.0", "focal_length_px = 9e8", "longer side, 640 px"),
        ("focal_length_px", "focal_lenght_px", "focal_length_px"),
        ("width_px = 640", "width_px = 640\nsaturation_counts = 0", "saturation_counts = 0"),
        ("width_px = 640", 'width_px = 640\nchannel = "grey"', "channel"),
        ("239.5]", '239.5]\n[coding]\ncurve = "gamma"', r"\[coding\]: gamma belongs to"),
        ("239.5]", '239.5]\n[coding]\ncurve = "square"\ngamma = 2.0', "gamma belongs to"),
        ("239.5]", '239.5]\n[coding]\ncurve = "table"\ncounts = [1, 2]', "2 counts and 0 linear"),
        (
            "239.5]",
            '239.5]\n[coding]\ncurve = "table"\ncounts = [1, 1]\nlinear = [1, 2]',
            "must rise",
        ),
        (
            "width_px = 640",
            "width_px = 640\nvalid_area_px = [9, 9, 640, 99]",
            r"\[9, 9, 640, 99\]; wanted",
        ),
        ("width_px = 640", "width_px = 0", "width_px = 0: must be"),
        ("width_px = 640", "width_px = 640.5", "width_px"),
        ('"pinhole"', '"pinehole"', "pinhole"),
        ("[319.5, 239.5]", "[319.5]", "principal_point_px"),
        ("[319.5, 239.5]", '[319.5, 239.5]\ndistortion = "brown"', "0 coefficients.*k1, k2, p1"),
        ("[319.5, 239.5]", "[319.5, 239.5]\ncoefficients = [0.1]", "nothing uses them"),
        ('"pinhole"', '"kannala_brandt"', "wants 4"),
        (
            "[319.5, 239.5]",
            '[319.5, 239.5]\ndistortion = "opencv"\ncoefficients = [0.1, 0.0, 0.0]',
            r"3 coefficients; distortion \"opencv\" wants 4, 5, 8, 12 or 14 of \[k1, k2",
        ),
        (
            "[319.5, 239.5]",
            f'[319.5, 239.5]\ndistortion = "opencv"\ncoefficients = {[0.0] * 13 + [30.0]}',
            "tau_x, tau_y are .* wanted radians",
        ),
        ("width_px = 640", "width_px = 640\npixel_pitch_y_um = 27.0", "add that"),
        ("width_px = 640", "width_px = 640\nfocal_length_y_px = 1e6", "sides differ at most"),
        (
            "focal_length_px = 500.0",
            "focal_length_mm = 2.75\npixel_pitch_um = 5.5\npixel_pitch_y_um = 11.0\n"
            "focal_length_y_px = 500.0",
            "the pitches give 250.00",
        ),
        ('"pinhole"', '"equidistant"\ndistortion = "brown"', "kannala_brandt"),
        (
            "focal_length_px = 500.0",
            "focal_length_px = 500.0\nfocal_length_mm = 2.8\npixel_pitch_um = 5.5",
            "gives 509.09",
        ),
        ('name = "wide"', 'name = "../wide"', "plain word"),
        ("width_px = 640", "width_px = 640\nimage_circle_radius_px = -1.0", "image_circle"),
        ("width_px = 640", "width_px = 640\npsf_sigma_px = 0.7", "add psf_error_px"),
        ("width_px = 640", "width_px = 640\npsf_error_px = 0.7", "add psf_sigma_px"),
        (
            "width_px = 640",
            "width_px = 640\npsf_sigma_px = -0.7\npsf_error_px = 0.1",
            "psf_sigma_px is -0.7",
        ),
        (
            "width_px = 640",
            "width_px = 640\npsf_sigma_px = 0.7\npsf_error_px = 0.0",
            "psf_error_px is 0.0",
        ),
    ],
)
def test_a_wrong_camera_file_is_refused(tmp_path: Path, old: str, new: str, message: str) -> None:
    assert old in GOOD
    with pytest.raises(ConfigError, match=message) as caught:
        load_camera(written(tmp_path, GOOD.replace(old, new)))
    assert "camera.toml" in str(caught.value)


def test_pixels_that_are_not_square_are_written_and_read(tmp_path: Path) -> None:
    """NEAR MSI: 16 x 27 um, 167.35 mm."""
    text = GOOD.replace(
        "focal_length_px = 500.0",
        "focal_length_mm = 167.35\npixel_pitch_um = 16.0\npixel_pitch_y_um = 27.0",
    )
    camera = load_camera(written(tmp_path, text))
    assert camera.focal_length_px == pytest.approx(167350.0 / 16.0)
    assert camera.focal_length_y_px == pytest.approx(167350.0 / 27.0)
    assert camera.angular_resolution == pytest.approx(27.0 / 167350.0)
    assert load_camera(written(tmp_path, camera_toml(camera))) == camera


def test_every_length_of_opencvs_list_is_written_and_read(tmp_path: Path) -> None:
    for count in (4, 5, 8, 12, 14):
        terms = [0.001 * (i + 1) for i in range(count)]
        text = f'{GOOD}distortion = "opencv"\ncoefficients = {terms}\n'
        camera = load_camera(written(tmp_path, text))
        assert camera.coefficients == tuple(terms)
        assert load_camera(written(tmp_path, camera_toml(camera))) == camera


def test_a_missing_camera_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"nothing\.toml"):
        load_camera(tmp_path / "nothing.toml")


@pytest.mark.parametrize("path", sorted(PRESETS.glob("*.toml")), ids=lambda path: path.stem)
def test_every_shipped_camera_loads_and_returns_from_its_own_text(
    path: Path, tmp_path: Path
) -> None:
    camera = load_camera(path)
    assert camera == preset_camera(path.stem)
    assert camera.name == path.stem
    assert load_camera(written(tmp_path, camera_toml(camera))) == camera
    # every pixel of the picture has a ray and comes back
    corners = np.array([[0, 0], [1, 0], [0, 1], [1, 1], [0.5, 0]])
    pixels = corners * [camera.width_px - 1, camera.height_px - 1]
    np.testing.assert_allclose(camera.project(camera.unproject(pixels)), pixels, atol=1e-9)


@pytest.mark.parametrize(
    ("name", "field_deg", "tolerance_deg"),
    [
        ("shnk", 180.0, 0.5),
        ("unk", 27.5, 0.1),
        ("kam_s", 49.0, 1.5),
        ("tsnn2_wide", 76.0, 3.0),
        ("tsnn2_narrow", 49.0, 1.0),
        ("tsnn_utk", 0.85, 0.02),
        ("tsnn_shtk", 23.3, 0.2),
    ],
)
def test_presets_have_their_published_field(
    name: str, field_deg: float, tolerance_deg: float
) -> None:
    """Published fields are rounded; two of the lenses carry a distortion of ours."""
    camera = preset_camera(name)
    middle = camera.principal_point_px[1]
    left, right = camera.unproject([[-0.5, middle], [camera.width_px - 0.5, middle]])
    field = np.degrees(np.arctan2(np.linalg.norm(np.cross(left, right)), left @ right))
    assert field == pytest.approx(field_deg, abs=tolerance_deg)


def test_the_apollo_lens_has_the_published_distortion() -> None:
    """USGS ISIS gives the undistorted place of a measured one, in mm; radial terms."""
    camera = preset_camera("apollo15_metric")
    measured_mm = np.linspace(1.0, 80.0, 60)
    s = measured_mm**2
    true_mm = measured_mm * (1.0 + s * (-0.13361854e-5 + s * (0.52261757e-9 - s * 0.50728336e-13)))
    pixels = camera.project(np.stack([true_mm, 0.0 * s, 0.0 * s + 76.054], axis=1))
    expected = 505.5 + measured_mm * 673.3 / 76.054
    np.testing.assert_allclose(pixels[:, 0], expected, atol=0.005)


def test_an_unknown_preset_is_answered_with_the_nearest() -> None:
    with pytest.raises(ConfigError, match="did you mean 'shnk'"):
        preset_camera("shnkk")


def test_how_pictures_are_to_be_read_is_read_and_written(tmp_path: Path) -> None:
    text = GOOD + "saturation_counts = 4095\nvalid_area_px = [8, 0, 631, 470]\n"
    text += 'valid_mask = "mask.png"\nchannel = "green"\nexif_orientation = "ignore"\n'
    text += 'line_order = "bottom_first"\nextension = 1\n[coding]\ncurve = "table"\n'
    text += "counts = [0, 255]\nlinear = [0, 4095.5]\n"
    camera = load_camera(written(tmp_path, text))
    assert camera.saturation_counts == 4095.0
    assert camera.valid_area_px == (8, 0, 631, 470)
    assert camera.valid_mask == str(tmp_path / "mask.png")
    assert (camera.channel, camera.exif_orientation) == ("green", "ignore")
    assert (camera.line_order, camera.extension) == ("bottom_first", "1")
    assert camera.coding == Coding("table", None, (0.0, 255.0), (0.0, 4095.5))
    assert load_camera(written(tmp_path, camera_toml(camera))) == camera
