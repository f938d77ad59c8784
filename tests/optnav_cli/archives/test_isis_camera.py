"""Cameras of ISIS cubes: each pixel looks after an import where ISIS's equations have it look."""

import re
from pathlib import Path

import cv2
import numpy as np
import pytest

from catalog.bodies.epochs import utc_to_tdb_s
from catalog.errors import DataError
from optnav_cli.archives.isis_lens import KEYWORDS
from optnav_cli.archives.job import ImportOptions, import_folder
from optnav_cli.camera.camera import Camera
from optnav_cli.camera.camera_file import load_camera
from optnav_cli.frames.frames import Frame
from tests.optnav_cli.archives.made_cubes import (
    CAMERA_BODY_KM,
    CODE,
    COLUMNS,
    FOCAL_MM,
    PITCH_MM,
    ROWS,
    UTC,
    Cube,
    isis_from_body,
    pixel_rays_isis,
    standard_tables,
    write_cube,
)

TURNS = [((a, 0.0), (0.0, b)) for a in (1.0, -1.0) for b in (1.0, -1.0)]
TURNS += [((0.0, a), (b, 0.0)) for a in (1.0, -1.0) for b in (1.0, -1.0)]
SLANTED = ((0.8, -0.6), (0.6, 0.8))


def imported(
    folder: Path, cube: Cube = Cube(), size: tuple[int, int] = (COLUMNS, ROWS)
) -> tuple[Frame, Camera, np.ndarray, list[str]]:
    """The frame, camera, picture and remarks of an import."""
    path = write_cube(folder / "a.cub", cube, *size)
    result = import_folder([path], folder / "out")
    frame = result.frames[0]
    values = cv2.imread(str(folder / "out" / frame.file), cv2.IMREAD_UNCHANGED)
    assert values is not None
    camera = load_camera(folder / "out" / "cameras" / f"{frame.camera}.toml")
    return frame, camera, values, result.remarks


def rays_body(frame: Frame, camera: Camera, values: np.ndarray) -> np.ndarray:
    """Directions (n, 3), body frame, of the pixels by their numbers."""
    row, column = np.nonzero(values >= 0)
    order = np.argsort(values[row, column])
    pixels = np.column_stack([column, row])[order]
    assert frame.camera_from_body is not None
    return frame.camera_from_body.inv().apply(camera.unproject(pixels))


def wanted_rays(cube: Cube, *, distorted: float = 0.0) -> np.ndarray:
    rays = pixel_rays_isis(cube).reshape(-1, 3)
    radius2 = np.sum(rays[:, :2] ** 2, axis=1, keepdims=True)
    rays = np.hstack([rays[:, :2] * (1.0 - distorted * radius2), rays[:, 2:]])
    rays = isis_from_body(cube.backwards).inv().apply(rays)
    return np.asarray(rays / np.linalg.norm(rays, axis=1, keepdims=True))


@pytest.mark.parametrize("by_pixel", [*TURNS, SLANTED])
def test_pixels_look_where_isis_has_them_look(
    by_pixel: tuple[tuple[float, float], tuple[float, float]], tmp_path: Path
) -> None:
    """Mirrored ones too, whose rows are turned over: a rotation alone would mirror the ground."""
    cube = Cube(by_pixel)
    frame, camera, values, _ = imported(tmp_path, cube)
    np.testing.assert_allclose(rays_body(frame, camera, values), wanted_rays(cube), atol=1e-9)
    np.testing.assert_allclose(frame.position_m, CAMERA_BODY_KM * 1e3, rtol=1e-12)
    assert np.linalg.det(np.array(by_pixel)) * (int(values[-1, 0]) - int(values[0, 0])) > 0.0


def test_a_camera_that_looks_backwards_is_known_by_where_the_body_is(tmp_path: Path) -> None:
    cube = Cube(((-1.0, 0.0), (0.0, 1.0)), backwards=True)
    frame, camera, values, _ = imported(tmp_path, cube)
    np.testing.assert_allclose(rays_body(frame, camera, values), wanted_rays(cube), atol=1e-9)
    assert values[0, 0] == 3


def test_the_constant_rotation_follows_the_varying_one(tmp_path: Path) -> None:
    cube = Cube(constant=True)
    frame, camera, values, _ = imported(tmp_path, cube)
    np.testing.assert_allclose(rays_body(frame, camera, values), wanted_rays(cube), atol=1e-9)


@pytest.mark.parametrize("by_pixel", [TURNS[0], TURNS[1], TURNS[4]])
def test_a_crop_and_a_reduction_look_where_the_picture_looked(
    by_pixel: tuple[tuple[float, float], tuple[float, float]], tmp_path: Path
) -> None:
    """Samples 3 to 6 and lines 1 to 4, then two of them to one."""
    alpha = {"AlphaSamples": COLUMNS, "AlphaLines": ROWS, "AlphaStartingSample": 2.5,
             "AlphaStartingLine": 0.5, "AlphaEndingSample": 6.5, "AlphaEndingLine": 4.5,
             "BetaSamples": 2, "BetaLines": 2}  # fmt: skip
    cube = Cube(by_pixel, alpha=alpha)
    frame, camera, values, _ = imported(tmp_path, cube, (2, 2))
    rays = pixel_rays_isis(cube)
    # the middle of each block of two by two pixels
    middle = np.array([[rays[r : r + 2, c : c + 2].mean((0, 1)) for c in (2, 4)] for r in (0, 2)])
    wanted = isis_from_body().inv().apply(middle.reshape(-1, 3))
    wanted /= np.linalg.norm(wanted, axis=1, keepdims=True)
    np.testing.assert_allclose(rays_body(frame, camera, values), wanted, atol=1e-9)


@pytest.mark.parametrize("key", ["Summing", "SummingMode", "Binning", "PixelBinningMode"])
def test_summed_pixels_are_as_large_as_the_label_says(key: str, tmp_path: Path) -> None:
    naif = {f"INS{CODE}_BORESIGHT_SAMPLE": str(COLUMNS + 0.5),
            f"INS{CODE}_BORESIGHT_LINE": str(ROWS + 0.5)}  # fmt: skip
    _, camera, _, _ = imported(tmp_path, Cube(naif=naif, instrument={key: "2"}))
    assert camera.focal_length_px == pytest.approx(FOCAL_MM / PITCH_MM / 2.0)
    assert camera.principal_point_px == pytest.approx(((COLUMNS - 1) / 2, (ROWS - 1) / 2))
    with pytest.raises(DataError, match="summing that the label does not state"):
        imported(tmp_path, Cube(naif=naif))
    with pytest.raises(DataError, match="summed 2 x 2"):
        imported(tmp_path, Cube(instrument={key: "2"}))


@pytest.mark.parametrize(
    ("naif", "focal_px", "centre"),
    [
        ({"FOCAL_LENGTH": "60.0"}, 120.0, (3.5, 2.5)),
        ({"FOCAL_LENGTH": "", "FOCAL_LENGTH_COVER": "60.0"}, 120.0, (3.5, 2.5)),
        ({"FOCAL_LENGTH": "0.06"}, 120.0, (3.5, 2.5)),  # m
        ({"BORESIGHT_SAMPLE": "4.4", "BORESIGHT_LINE": "3.6"}, 100.0, (3.4, 2.6)),
        ({"BORESIGHT_SAMPLE": "", "CCD_CENTER": "(3.4, 2.6)"}, 100.0, (3.4, 2.6)),
        ({"BORESIGHT_SAMPLE": "", "CCD_CENTER": "(4.5, 3.5)"}, 100.0, (3.5, 2.5)),  # from 1
        ({"BORESIGHT_SAMPLE": ""}, 100.0, (3.5, 2.5)),
        ({"TRANSX": "(0.05, 0.5, 0.0)"}, 100.0, (3.4, 2.5)),
        ({"TRANSX": "", "ITRANSS": "(0, 2, 0)", "ITRANSL": "(0, 0, 2)"}, 100.0, (3.5, 2.5)),
    ],
)
def test_keywords_of_the_camera_are_used(
    naif: dict[str, str], focal_px: float, centre: tuple[float, float], tmp_path: Path
) -> None:
    stated = {f"INS{CODE}_{key}": value for key, value in naif.items()}
    _, camera, _, _ = imported(tmp_path, Cube(naif=stated))
    assert camera.focal_length_px == pytest.approx(focal_px)
    assert camera.principal_point_px == pytest.approx(centre)


def test_the_focal_length_by_temperature_and_by_filter_are_used(tmp_path: Path) -> None:
    filter_ = "  Group = BandBin\n    Number = 7\n  End_Group\n"
    naif = {f"INS{CODE - 7}_FOCAL_LENGTH": "55.0"}
    _, camera, _, _ = imported(tmp_path, Cube(naif=naif, groups=filter_))
    assert camera.focal_length_px == pytest.approx(110.0)
    naif["TempDependentFocalLength"] = "56.0"
    _, camera, _, _ = imported(tmp_path, Cube(naif=naif, groups=filter_))
    assert camera.focal_length_px == pytest.approx(112.0)


@pytest.mark.parametrize("by_pixel", [TURNS[0], TURNS[1], TURNS[5]])
@pytest.mark.parametrize("stated", [{"K1": "-0.002"}, {"OD_K": "(0.0, 0.002, 0.0)"}])
def test_radial_lenses_bend_as_isis_bends(
    stated: dict[str, str],
    by_pixel: tuple[tuple[float, float], tuple[float, float]],
    tmp_path: Path,
) -> None:
    """By 1.2 % at the corner; of K1 ISIS adds the square, of OD_K it takes it away."""
    naif = {f"INS{CODE}_{key}": value for key, value in stated.items()}
    cube = Cube(by_pixel, naif=naif)
    frame, camera, values, _ = imported(tmp_path, cube)
    wanted = wanted_rays(cube, distorted=0.002)
    assert np.abs(wanted - wanted_rays(cube)).max() > 2e-4
    np.testing.assert_allclose(rays_body(frame, camera, values), wanted, atol=3e-5)


def test_a_lens_by_polynomials_is_inverted(tmp_path: Path) -> None:
    """TaylorCameraDistortionMap: distorted points from plain ones."""
    x_terms = [0.01, 1.001, -0.002, 0.001, 0.0, 0.0005, 2e-4, 0.0, 2e-4, 0.0]
    y_terms = [-0.02, 0.002, 1.001, 0.0, 0.001, 0.0, 0.0, 2e-4, 0.0, 2e-4]
    naif = {f"INS{CODE}_OD_T_{axis}": f"({', '.join(map(repr, terms))})"
            for axis, terms in (("X", x_terms), ("Y", y_terms))}  # fmt: skip
    cube = Cube(naif=naif)
    frame, camera, values, _ = imported(tmp_path, cube)
    rays = isis_from_body().apply(rays_body(frame, camera, values))
    x, y = (FOCAL_MM * rays[:, :2] / rays[:, 2:]).T
    powers = np.array([x * 0 + 1, x, y, x * x, x * y, y * y, x**3, x * x * y, x * y * y, y**3])
    back = np.column_stack([powers.T @ x_terms, powers.T @ y_terms])
    pixels = pixel_rays_isis(cube).reshape(-1, 3)[:, :2]
    # a rotation of 2 mrad of the lens is not Brown's: 0.02 px here
    assert np.abs(back - pixels).max() / PITCH_MM < 0.03


@pytest.mark.parametrize("by_pixel", [TURNS[0], TURNS[1]])
def test_a_lens_of_opencv_is_in_samples_and_lines(
    by_pixel: tuple[tuple[float, float], tuple[float, float]], tmp_path: Path
) -> None:
    terms = {"K": "(-0.5, 0.3, -0.2, 0.0, 0.0, 0.0)", "P": "(0.02, -0.01)", "F": "(101.0, 99.0)",
             "C": "(4.6, 3.3)", "A": "0.001"}  # fmt: skip
    naif = {f"INS{CODE}_OPENCV_OD_{key}": value for key, value in terms.items()}
    cube = Cube(by_pixel, naif=naif, instrument={"CameraHeadTemperature": "10.0 <celsius>"})
    frame, camera, values, _ = imported(tmp_path, cube)
    matrix = np.array([[101.0 * 1.01, 0.0, 3.6], [0.0, 99.0 * 1.01, 2.3], [0.0, 0.0, 1.0]])
    column, row = np.meshgrid(np.arange(COLUMNS), np.arange(ROWS))
    pixels = np.column_stack([column.ravel(), row.ravel()]).astype(float)
    lens = np.array([-0.5, 0.3, 0.02, -0.01, -0.2])
    rays = isis_from_body().apply(rays_body(frame, camera, values))
    plain = rays[:, :2] / rays[:, 2:] @ np.linalg.inv(by_pixel).T
    points = np.column_stack([plain, np.ones(len(plain))])
    again, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), matrix, lens)
    np.testing.assert_allclose(again[:, 0], pixels, atol=1e-6)


@pytest.mark.parametrize("name", [n for n, k in KEYWORDS.items() if k.fate == "refused"])
def test_cubes_that_are_no_framing_picture_are_refused_by_name(name: str, tmp_path: Path) -> None:
    cube = Cube(instrument={name: "4"})
    if name == "Mapping":
        cube = Cube(groups="  Group = Mapping\n    ProjectionName = Sinusoidal\n  End_Group\n")
    with pytest.raises(DataError, match=rf"states {name} = .*; {re.escape(KEYWORDS[name].why)}"):
        imported(tmp_path, cube)


@pytest.mark.parametrize("name", [n for n, k in KEYWORDS.items() if k.fate == "reported"])
def test_a_lens_that_is_not_read_is_reported(name: str, tmp_path: Path) -> None:
    _, _, _, remarks = imported(tmp_path, Cube(naif={f"INS{CODE}_{name}": "(1.0, 2.0)"}))
    assert any(f"INS{CODE}_{name}" in line and "is left out" in line for line in remarks)


@pytest.mark.parametrize(
    ("naif", "words"),
    [
        ({"FOCAL_LENGTH": ""}, "no NaifKeywords with a focal length"),
        ({"FOCAL_LENGTH": "'x'"}, "FOCAL_LENGTH is x; wanted 1 numbers"),
        ({"FOCAL_LENGTH": "1.0e-6"}, "no lens has both"),
        ({"TRANSX": "(0, 0, 0)"}, "rows and columns at right angles"),
        ({"TRANSX": "(0, 0.5, 0.4)"}, "rows and columns at right angles"),
        ({"TRANSX": "(0, 0.5)"}, "wanted 3 numbers"),
        ({"TRANSX": ""}, "have no TRANSX and TRANSY"),
        ({"K1": "-1.0"}, "moves points by more than"),
    ],
)
def test_impossible_cameras_are_refused(naif: dict[str, str], words: str, tmp_path: Path) -> None:
    stated = {f"INS{CODE}_{key}": value for key, value in naif.items()}
    with pytest.raises(DataError, match=words):
        imported(tmp_path, Cube(naif=stated))


def test_several_records_are_interpolated_to_the_middle_of_the_exposure(tmp_path: Path) -> None:
    """Five records over an exposure of 4 s, the craft and the camera moving."""
    exposure = {"ExposureDuration": "4000 <milliseconds>"}
    base, tdb_s = standard_tables(Cube()), utc_to_tdb_s(UTC)
    times = tdb_s + np.arange(5.0)
    position, pointing = base["InstrumentPosition"][0], base["InstrumentPointing"][0]
    tables = {
        "InstrumentPosition": [
            position | {"J2000X": position["J2000X"] + (t - tdb_s - 2.0) ** 3, "ET": t,
                        "J2000XV": 3.0 * (t - tdb_s - 2.0) ** 2} for t in times
        ],
        "InstrumentPointing": [pointing | {"ET": t} for t in times],
    }  # fmt: skip
    for kind in ("Linear", "HermiteSpline"):
        words = {"InstrumentPosition": f"  CacheType = {kind}\n"}
        cube = Cube(instrument=exposure, tables=tables, table_words=words)
        frame, _, _, _ = imported(tmp_path, cube)
        np.testing.assert_allclose(frame.position_m, CAMERA_BODY_KM * 1e3, rtol=1e-6)
        assert frame.utc == "2009-01-20T12:00:02.000Z"
    words = {"InstrumentPosition": "  CacheType = Spiral\n"}
    with pytest.raises(DataError, match="CacheType = spiral"):
        imported(tmp_path, Cube(instrument=exposure, tables=tables, table_words=words))
    for change in ({}, {"ExposureDuration": "1 <ms>"}, {"ExposureDuration": "4000"}):
        with pytest.raises(DataError, match="line scanner or push frame"):
            imported(tmp_path, Cube(tables=tables, instrument=change))


def test_polynomials_of_jigsaw_are_evaluated(tmp_path: Path) -> None:
    base, tdb_s = standard_tables(Cube()), utc_to_tdb_s(UTC)
    position, pointing = base["InstrumentPosition"][0], base["InstrumentPointing"][0]
    quaternion = [pointing[f"J2000Q{n}"] for n in range(4)]
    from scipy.spatial.transform import Rotation

    angles = -Rotation.from_quat(quaternion, scalar_first=True).as_euler("zxz")
    origin, scale = tdb_s - 3.0, 2.0
    rate = np.array([0.01, -0.02, 0.03])
    constant = [position[f"J2000{a}"] for a in "XYZ"] - 1.5 * rate
    tables = {
        "InstrumentPosition": [
            {f"J2000SV{a}": float(v) for a, v in zip("XYZ", row, strict=True)}
            for row in (constant, rate, (origin, scale, 1.0))
        ],
        "InstrumentPointing": [
            {f"J2000Ang{n + 1}": float(v) for n, v in enumerate(row)}
            for row in (angles, (origin, scale, 0.0))
        ],
    }
    cube = Cube(instrument={"ExposureDuration": "0.0 <seconds>"}, tables=tables)
    frame, camera, values, _ = imported(tmp_path, cube)
    np.testing.assert_allclose(frame.position_m, CAMERA_BODY_KM * 1e3, rtol=1e-9)
    np.testing.assert_allclose(rays_body(frame, camera, values), wanted_rays(cube), atol=1e-9)
    tables["InstrumentPosition"][-1]["J2000SVZ"] = 4.0
    with pytest.raises(DataError, match="2 terms of polynomials of degree 4"):
        imported(tmp_path, Cube(instrument={"ExposureDuration": "0 <s>"}, tables=tables))


def test_a_camera_that_looks_away_is_told(tmp_path: Path) -> None:
    position = standard_tables(Cube())["InstrumentPosition"][0]
    wrong = position | {f"J2000{axis}": -position[f"J2000{axis}"] for axis in "XYZ"}
    _, _, _, remarks = imported(tmp_path, Cube(tables={"InstrumentPosition": [wrong]}))
    (line,) = (line for line in remarks if line.startswith("contradiction: "))
    assert "a.tif: the camera looks away from moon" in line
    assert "mend the sign of the position vector" in line


def test_a_sun_of_zeros_is_refused(tmp_path: Path) -> None:
    sun = dict.fromkeys(standard_tables(Cube())["SunPosition"][0], 0.0)
    with pytest.raises(DataError, match="has the Sun inside the body"):
        imported(tmp_path, Cube(tables={"SunPosition": [sun]}))


def test_tables_of_another_picture_are_refused(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="after its StartTime"):
        imported(tmp_path, Cube(instrument={"StartTime": "2009-01-20T13:00:00"}))


def test_a_cube_before_naif_keywords_takes_a_named_camera(tmp_path: Path) -> None:
    path = write_cube(tmp_path / "a.cub")
    path.write_bytes(path.read_bytes().replace(b"Object = NaifKeywords", b"Object = NaifNeywords"))
    with pytest.raises(DataError, match=r"no NaifKeywords.*--camera"):
        import_folder([path], tmp_path / "out")
    (tmp_path / "made.toml").write_text(
        'name = "made"\nmodel = "pinhole"\nwidth_px = 8\nheight_px = 6\nfocal_length_px = 100.0\n'
        "principal_point_px = [3.5, 2.5]\n"
    )
    options = ImportOptions(camera=str(tmp_path / "made.toml"))
    result = import_folder([path], tmp_path / "out", options)
    assert any("how the picture lies" in line for line in result.remarks)
    frame = result.frames[0]
    assert frame.camera_from_body is not None
    assert (frame.camera_from_body * isis_from_body().inv()).magnitude() < 1e-9
