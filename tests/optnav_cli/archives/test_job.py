"""Pictures of archives with the geometry of their labels."""

import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import rasterio
from scipy.spatial.transform import Rotation

from catalog.bodies.body import load_body
from catalog.bodies.ephemeris import AnalyticEphemeris
from catalog.bodies.epochs import utc_to_tdb_s
from catalog.config import resource
from catalog.errors import ConfigError, DataError, OutputError, UsageError
from catalog.geometry.rotations import ARCSEC
from optnav_cli.archives.frame import load_table
from optnav_cli.archives.job import ImportOptions, import_folder
from optnav_cli.archives.pixels import CODING_KEYWORDS, KEYWORDS
from optnav_cli.camera.camera_file import load_camera, preset_camera
from optnav_cli.frames.folder import read_folder
from optnav_cli.frames.frames import Frame
from optnav_cli.frames.picture import Picture, load_picture
from optnav_cli.main import run

UTC = "2004-05-01T12:00:00.000Z"
CAMERA = """name = "made"
model = "pinhole"
width_px = 6
height_px = 4
focal_length_px = 100.0
principal_point_px = [2.5, 1.5]
"""


@pytest.fixture
def eros(shared_data: Callable[[str], Path]) -> Path:
    return shared_data("near/m0126865998f4_2p_iof.fit")


def made_pds3(folder: Path, name: str = "a", **changes: str) -> Path:
    """A PDS3 label of a craft over the Moon that looks along right ascension 30 deg, 40 north."""
    moon = AnalyticEphemeris(load_body("moon"))
    sun_km = moon.position_m("sun", utc_to_tdb_s(UTC)) / 1e3
    to_moon = np.array([1000.0, 2000.0, 1500.0])
    vectors = [", ".join(f"{x!r}" for x in v.tolist()) for v in (to_moon, sun_km + to_moon)]
    values = {
        "PDS_VERSION_ID": "PDS3",
        "RECORD_BYTES": "6",
        "RECORD_TYPE": "FIXED_LENGTH",
        "FILE_RECORDS": "4",
        "^IMAGE": f'"{name}.img"',
        "START_TIME": UTC.removesuffix("Z"),
        "TARGET_NAME": '"MOON"',
        "RIGHT_ASCENSION": "30.0 <DEGREE>",
        "DECLINATION": "40.0",
        "CELESTIAL_NORTH_CLOCK_ANGLE": "0.0",
        "SC_TARGET_POSITION_VECTOR": f"({vectors[0]})",
        "SC_SUN_POSITION_VECTOR": f"({vectors[1]})",
    }
    text = "\n".join(f"{key} = {value}" for key, value in (values | changes).items())
    image = "OBJECT = IMAGE\nLINES = 4\nLINE_SAMPLES = 6\nSAMPLE_BITS = 8\n"
    image += "SAMPLE_TYPE = MSB_UNSIGNED_INTEGER\nEND_OBJECT = IMAGE\n"
    path = folder / f"{name}.lbl"
    path.write_text(f"{text}\n{image}END\n")
    (folder / f"{name}.img").write_bytes(bytes(range(10, 34)))
    (folder / "made.toml").write_text(CAMERA)
    return path


def options_of(path: Path) -> ImportOptions:
    return ImportOptions(camera=str(path.parent / "made.toml"))


def test_the_picture_of_near_becomes_a_frame_that_lies_over_the_asteroid(
    eros: Path, tmp_path: Path
) -> None:
    """Of the ellipsoid of Eros the limb is lit where the picture is; the Sun is the body file's."""
    imported = import_folder([eros], tmp_path / "out")
    folder = read_folder(tmp_path / "out")
    (frame,) = folder.frames
    assert frame.problem is None
    assert (folder.body.name, frame.utc) == ("eros", "2000-02-25T05:16:02.236Z")
    assert frame.position_m is not None
    assert frame.camera_from_body is not None
    assert frame.sun_body is not None
    assert np.linalg.norm(frame.position_m) == pytest.approx(362.9e3, abs=100.0)
    theory = folder.motion.sun_body(frame.tdb_s or 0.0)
    assert np.degrees(np.arccos(theory @ frame.sun_body)) < 0.02
    camera = folder.cameras["near_msi"]
    picture = load_picture(folder.picture_path(frame), camera).values
    whole = whole_picture(eros)
    scale = 60_000.0 / (whole.max() - whole.min())  # 16 bits, linear, for counts are wanted
    np.testing.assert_allclose(picture, (whole - whole.min()) * scale, atol=0.51)
    # lit limb of the ellipsoid: rays of the picture, in the body's axes stretched to a sphere
    radii = np.array(folder.body.radii_m)
    rows, columns = np.indices(camera.shape)
    rays = camera.unproject(np.stack([columns, rows], axis=-1)[::4, ::4])
    rays = frame.camera_from_body.inv().apply(rays.reshape(-1, 3)) / radii
    origin = frame.position_m / radii
    along, square = rays @ origin, (rays**2).sum(axis=1)
    root = along**2 - square * (origin @ origin - 1.0)
    hit = root > 0.0
    place = origin + rays * ((-along - np.sqrt(np.where(hit, root, 0.0))) / square)[:, None]
    lit = hit & ((place / radii) @ frame.sun_body > 0.0)
    bright = whole[::4, ::4].ravel() > 0.01
    # half of what is bright or lit is both, though Eros is no ellipsoid; turned about, a fifth
    share = (lit & bright).sum() / (lit | bright).sum()
    mirrored = lit.reshape(rows[::4, ::4].shape)[::-1].ravel()
    assert share > 0.5
    assert (mirrored & bright).sum() / (mirrored | bright).sum() < 0.25
    assert any("clock" in remark for remark in imported.remarks)
    assert any("psf_sigma_px" in remark for remark in imported.remarks)


def whole_picture(path: Path) -> np.ndarray:
    pixels = np.frombuffer(path.read_bytes()[11520:], ">f4", 537 * 244)
    return pixels.reshape(244, 537).astype(np.float32)


def test_the_clock_angle_of_north_gives_the_rotation_of_the_quaternion(
    eros: Path, tmp_path: Path
) -> None:
    """NEAR's headers have both, but count the clock angle in a picture shown from its last row up.

    There north stands at 180 deg less the angle.
    """
    table = resource("configs/imports/near_msi.toml").read_text()
    start = table.index("[attitude]")
    angles = '[attitude]\nboresight = ["NEAR-084", "NEAR-085", "NEAR-086"]\n\n'
    other = re.sub(r"camera_from_frame = .*\n", "", table[:start])
    other += angles + table[table.index("[position]") :]
    (tmp_path / "angles.toml").write_text(other)
    first = import_folder([eros], tmp_path / "one").frames[0].camera_from_body
    options = ImportOptions(table=str(tmp_path / "angles.toml"))
    second = import_folder([eros], tmp_path / "two", options).frames[0].camera_from_body
    assert first is not None
    assert second is not None
    turn = (first * second.inv()).as_rotvec(degrees=True)
    np.testing.assert_allclose(turn, [0.0, 0.0, 180.0 - 2.0 * 95.89591], atol=1e-3)


def test_every_label_of_the_comet_is_read_and_lies_over_its_picture(
    shared_data: Callable[[str], Path], tmp_path: Path
) -> None:
    """Without any correction the middle of the shape lies within 12 px of that of the light."""
    folder = shared_data("rosetta/pictures/ROS_CAM1_20140805T210719.lbl").parent
    labels = sorted(folder.glob("*.lbl"))[::25]
    import_folder(labels, tmp_path / "out")
    read = read_folder(tmp_path / "out")
    shape = shared_data("rosetta/67p-16k.obj").read_text().splitlines()
    corners = np.array([line.split()[1:4] for line in shape if line.startswith("v ")], float) * 1e3
    assert [frame.problem for frame in read.frames] == [None] * len(labels)
    for frame in read.frames:
        assert frame.position_m is not None
        assert frame.camera_from_body is not None
        assert frame.attitude_sigma_rad == pytest.approx(np.radians(0.4))
        # the axes' error moves the position in the body's frame as far as it turns the attitude
        height_m = np.linalg.norm(frame.position_m)
        assert 0.5 < (frame.position_sigma_m or 0.0) / (np.radians(0.4) * height_m) < 1.6
        camera = read.cameras[frame.camera]
        pixels = camera.project_from_body(
            corners, frame.position_m, frame.camera_from_body.as_matrix()
        )
        values = load_picture(read.picture_path(frame), camera).values
        rows, columns = np.nonzero(values > 0.2 * values.max())
        low, high = pixels.min(axis=0), pixels.max(axis=0)
        # the silhouette is the outermost light on the side of the Sun
        towards = frame.camera_from_body.apply(frame.sun_body)[:2]
        x, y = (
            (np.quantile(seen, 0.999), top) if side > 0 else (np.quantile(seen, 0.001), bottom)
            for seen, side, bottom, top in zip((columns, rows), towards, low, high, strict=True)
        )
        for (seen, predicted), side in zip((x, y), towards, strict=True):
            if abs(side) > 0.3:
                assert abs(seen - predicted) < 12.0


def test_a_pds3_label_gives_position_attitude_sun_and_defaults(tmp_path: Path) -> None:
    path = made_pds3(tmp_path)
    imported = import_folder([path], tmp_path / "out", options_of(path))
    frame: Frame = read_folder(tmp_path / "out").frames[0]
    moon = AnalyticEphemeris(load_body("moon"))
    tdb_s = utc_to_tdb_s(UTC)
    turn = Rotation.from_matrix(moon.body_from_inertial(tdb_s))
    assert frame.position_m is not None
    assert frame.camera_from_body is not None
    np.testing.assert_allclose(frame.position_m, turn.apply([-1e6, -2e6, -1.5e6]), atol=1e-3)
    inertial_from_camera = (frame.camera_from_body * turn).inv()
    ra, dec = np.radians([30.0, 40.0])
    boresight = [np.cos(dec) * np.cos(ra), np.cos(dec) * np.sin(ra), np.sin(dec)]
    np.testing.assert_allclose(inertial_from_camera.apply([0.0, 0.0, 1.0]), boresight, atol=1e-9)
    # north up: the picture's downward axis has no part along east
    east = [-np.sin(ra), np.cos(ra), 0.0]
    down = inertial_from_camera.apply([0.0, 1.0, 0.0])
    assert down @ east == pytest.approx(0.0, abs=1e-9)
    assert down[2] < 0.0
    assert frame.sun_body is not None
    assert frame.sun_body @ moon.sun_body(tdb_s) == pytest.approx(1.0, abs=1e-8)
    assert frame.attitude_sigma_rad == pytest.approx(1800.0 * ARCSEC)
    assert frame.position_m is not None
    height_m = float(np.linalg.norm(frame.position_m)) - load_body("moon").radius_m
    assert frame.position_sigma_m == pytest.approx(0.01 * height_m)
    made = load_camera(tmp_path / "made.toml")
    values = load_picture(tmp_path / "out/a.tif", made).values
    np.testing.assert_array_equal(values.ravel(), range(10, 34))
    assert any("defaults: attitude 0.5 deg, position 1 % of the" in r for r in imported.remarks)


def test_a_body_may_be_the_path_of_a_file_which_the_folder_then_carries(tmp_path: Path) -> None:
    path = made_pds3(tmp_path, TARGET_NAME='"SELENE"')
    text = resource("configs/bodies/moon.toml").read_text()
    (tmp_path / "mine.toml").write_text(text.replace('name = "moon"', 'name = "selene"'))
    options = replace(options_of(path), body=str(tmp_path / "mine.toml"))
    import_folder([path], tmp_path / "out", options)
    folder = read_folder(tmp_path / "out")
    assert folder.body.name == "selene"
    assert (tmp_path / "out/mine.toml").read_text() == (tmp_path / "mine.toml").read_text()
    # a table's body lies beside the table
    table = resource("configs/imports/pds3.toml").read_text()
    (tmp_path / "t.toml").write_text(table.replace("[time]", 'body = "mine.toml"\n[time]', 1))
    options = replace(options_of(path), table=str(tmp_path / "t.toml"))
    import_folder([path], tmp_path / "again", options)
    assert read_folder(tmp_path / "again").body == folder.body


def test_a_pds4_label_gives_the_same_frame(tmp_path: Path) -> None:
    path = made_pds3(tmp_path)
    reference = import_folder([path], tmp_path / "pds3", options_of(path)).frames[0]
    text = path.read_text()
    found = {
        key: re.search(rf"{key} = \((.*)\)", text)[1].split(", ")  # type: ignore[index]
        for key in ("SC_TARGET_POSITION_VECTOR", "SC_SUN_POSITION_VECTOR")
    }
    target = np.array(found["SC_TARGET_POSITION_VECTOR"], float)
    sun_to_target = target - np.array(found["SC_SUN_POSITION_VECTOR"], float)

    def vector(name: str, values: np.ndarray) -> str:
        parts = "".join(
            f'<geom:{axis}_position unit="km">{value!r}</geom:{axis}_position>'
            for axis, value in zip("xyz", values.tolist(), strict=True)
        )
        return f"<geom:{name}>{parts}</geom:{name}>"

    label = tmp_path / "b.xml"
    label.write_text(
        '<?xml version="1.0"?>\n<Product_Observational xmlns="http://pds.nasa.gov/pds4/pds/v1" '
        'xmlns:geom="http://pds.nasa.gov/pds4/geom/v1"><Observation_Area><Time_Coordinates>'
        f"<start_date_time>{UTC}</start_date_time></Time_Coordinates><Target_Identification>"
        "<name>Moon</name></Target_Identification><geom:Object_Orientation_RA_Dec>"
        '<geom:right_ascension_angle unit="deg">30</geom:right_ascension_angle>'
        '<geom:declination_angle unit="deg">40</geom:declination_angle>'
        "<geom:celestial_north_clock_angle>0</geom:celestial_north_clock_angle>"
        "</geom:Object_Orientation_RA_Dec>"
        + vector("Vector_Cartesian_Position_Spacecraft_To_Target", target)
        + vector("Vector_Cartesian_Position_Sun_To_Target", sun_to_target)
        + "</Observation_Area></Product_Observational>"
    )
    options = ImportOptions(camera=str(tmp_path / "made.toml"), pictures=(tmp_path / "pds3/a.tif",))
    frame = import_folder([label], tmp_path / "pds4", options).frames[0]
    assert reference.position_m is not None
    assert reference.camera_from_body is not None
    assert frame.camera_from_body is not None
    np.testing.assert_allclose(frame.position_m, reference.position_m)
    np.testing.assert_allclose(frame.sun_body, reference.sun_body)
    assert (frame.camera_from_body * reference.camera_from_body.inv()).magnitude() < 1e-9


def test_kernels_give_the_geometry_of_a_list_of_times(
    kernels: list[Path], shared_data: Callable[[str], Path], tmp_path: Path
) -> None:
    """The Earth for a craft whose camera's axes are those of the stars, looking at the Moon."""
    spk = shared_data("spice/de405s_littleendian.bsp")
    names = tuple(dict.fromkeys((*kernels, spk)))
    made_pds3(tmp_path)
    (tmp_path / "times.csv").write_text(f"file,utc\na.img,{UTC}\n")
    (tmp_path / "earth.toml").write_text(
        'format = "times"\nbody = "moon"\n[spice]\ncraft = 399\nframe = "J2000"\n'
    )
    pixels = np.arange(24, dtype=np.uint8).reshape(4, 6)
    with rasterio.open(
        tmp_path / "one.tif", "w", "GTiff", 6, 4, 1, dtype="uint8", transform=[1, 0, 5, 0, -1, 5]
    ) as picture:
        picture.write(pixels, 1)
    (tmp_path / "times.csv").write_text(f"file,utc\none.tif,{UTC}\n")
    options = ImportOptions(
        table=str(tmp_path / "earth.toml"), camera=str(tmp_path / "made.toml"), kernels=names
    )
    frame = import_folder([tmp_path / "times.csv"], tmp_path / "out", options).frames[0]
    moon, tdb_s = AnalyticEphemeris(load_body("moon")), utc_to_tdb_s(UTC)
    turn = moon.body_from_inertial(tdb_s)
    assert frame.position_m is not None
    assert frame.camera_from_body is not None
    # the analytic Moon is good to some kilometres
    np.testing.assert_allclose(frame.position_m, turn @ moon.position_m("earth", tdb_s), atol=20e3)
    assert (frame.camera_from_body * Rotation.from_matrix(turn)).magnitude() < 1e-4
    options = ImportOptions(table=str(tmp_path / "earth.toml"), camera=options.camera)
    with pytest.raises(DataError, match="a list of times needs SPICE kernels"):
        import_folder([tmp_path / "times.csv"], tmp_path / "none", options)


def test_a_file_that_cannot_be_used_is_left_out_with_the_reason(tmp_path: Path) -> None:
    good = made_pds3(tmp_path)
    bad = [
        made_pds3(tmp_path, "b", TARGET_NAME="MARS"),
        made_pds3(tmp_path, "c", SC_SUN_POSITION_VECTOR="(1.0, 2.0, 3.0)"),
        made_pds3(tmp_path, "d", RIGHT_ASCENSION='"N/A"'),
        made_pds3(tmp_path, "e", SC_TARGET_POSITION_VECTOR="(1.0, 2.0)"),
        made_pds3(tmp_path, "f", START_TIME="yesterday"),
        made_pds3(tmp_path, "g", **{"^IMAGE": '"none.img"'}),
    ]
    plain = tmp_path / "plain.txt"
    plain.write_text("no label")
    files = [good, *bad, plain, tmp_path / "none.lbl", good]
    imported = import_folder(files, tmp_path / "out", options_of(good))
    assert [frame.file for frame in imported.frames] == ["a.tif"]
    reasons = [r for r in imported.remarks if r.startswith("left out: ")]
    for reason, words in zip(
        reasons,
        (
            "b.lbl: shows MARS by its label, not moon",
            "c.lbl: the Sun of its label is .* deg from that of the body moon",
            "d.lbl: its label does not state RIGHT_ASCENSION",
            "SC_TARGET_POSITION_VECTOR are 2 numbers; wanted 3",
            "time 'yesterday' is not understood",
            "g.lbl",
            "plain.txt: no label with a geometry in it",
            "none.lbl: there is no such file",
            "a.lbl: a picture of this name is there already",
        ),
        strict=True,
    ):
        assert re.search(words, reason), reason


def test_where_nothing_can_be_used_the_reason_is_the_error(
    shared_data: Callable[[str], Path], tmp_path: Path
) -> None:
    cube = shared_data("moon/gld100_lola_reduced.cub")
    with pytest.raises(DataError, match="no import table that ships is for its instrument"):
        import_folder([cube], tmp_path / "out")
    with pytest.raises(DataError, match="no table BodyRotation; run spiceinit"):
        import_folder([cube], tmp_path / "out", ImportOptions(table="apollo15_metric", body="moon"))
    assert not (tmp_path / "out").exists()
    header = "".join(c.ljust(80) for c in ("SIMPLE  = T", "NEAR-005= 'MSI'", "END")).encode()
    (tmp_path / "a.fit").write_bytes(header.replace(b"SIMPLE  = T ", b"SIMPLE  = T ").ljust(2880))
    with pytest.raises(DataError, match=r"no body is named|does not state"):
        import_folder([tmp_path / "a.fit"], tmp_path / "out")
    with pytest.raises(DataError, match="does not state NEAR-018"):
        import_folder([tmp_path / "a.fit"], tmp_path / "out", ImportOptions(body="eros"))


def test_a_cube_of_another_body_is_refused(
    shared_data: Callable[[str], Path], tmp_path: Path
) -> None:
    table = resource("configs/imports/apollo15_metric.toml").read_text()
    (tmp_path / "t.toml").write_text(table.replace('target = "TargetName"\n', ""))
    cube = shared_data("apollo15/AS15-M-0297_crop.cub")
    options = ImportOptions(table=str(tmp_path / "t.toml"), body="mars")
    with pytest.raises(DataError, match=r"body rotation is .* deg from that of the body mars"):
        import_folder([cube], tmp_path / "out", options)
    with pytest.raises(DataError, match="shows MOON by its label, not mars"):
        import_folder([cube], tmp_path / "out", ImportOptions(body="mars"))


def test_a_picture_of_another_size_is_refused(tmp_path: Path) -> None:
    path = made_pds3(tmp_path)
    with pytest.raises(DataError, match=r"is 6 x 4; camera 'unk' takes 2048 x 2048"):
        import_folder([path], tmp_path / "out", ImportOptions(camera="unk"))


def test_wrong_tables_are_refused(tmp_path: Path) -> None:
    good = resource("configs/imports/near_msi.toml").read_text()
    for old, new, message in (
        ('clock = "NEAR-018"', "", "wants one of utc, unix, clock"),
        ("-0.9999998829493447", "0.9999998829493447", "is no rotation"),
        ('quaternion = ["NEAR-019", "NEAR-020",', 'quaternion = ["NEAR-020",', "4 keys"),
        ('format = "fits"', 'format = "times"', r"needs \[spice\]"),
        ('format = "fits"', 'format = "gif"', "format"),
        ("position_sigma_m = 1000.0", "position_sigma_m = -1.0", "position_sigma_m"),
    ):
        assert old in good
        path = tmp_path / "t.toml"
        path.write_text(good.replace(old, new))
        with pytest.raises(ConfigError, match=message):
            load_table(path)
    with pytest.raises(ConfigError, match="did you mean 'near_msi'"):
        import_folder([made_pds3(tmp_path)], tmp_path / "out", ImportOptions(table="near_ms"))


def test_the_command_says_what_is_not_known_and_guards_its_output(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    path = made_pds3(tmp_path)
    words = ["import", str(path), "--camera", str(tmp_path / "made.toml"), "-o"]
    assert run([*words, str(tmp_path / "out")]) == 0
    said = capfd.readouterr()
    assert said.out == f"{tmp_path / 'out'}\n"
    assert "1 picture of moon" in said.err
    assert "not known: no blur of camera made (psf_sigma_px)" in said.err
    first = {p.name: p.read_bytes() for p in (tmp_path / "out").iterdir() if p.is_file()}
    assert run([*words, str(tmp_path / "out")]) == 0  # an import replaces an import
    again = {p.name: p.read_bytes() for p in (tmp_path / "out").iterdir() if p.is_file()}
    del first["manifest.json"], again["manifest.json"]  # which has the times
    assert first == again
    assert run([*words, str(tmp_path)]) == 3  # it holds the label
    assert run(["import", str(path), "--picture", "a", "--picture", "b", "-o", "x"]) == 2
    assert run(["import", str(tmp_path / "none"), "-o", str(tmp_path / "y")]) == 3
    (tmp_path / "taken").mkdir()
    (tmp_path / "taken/file").write_text("mine")
    assert run([*words, str(tmp_path / "taken")]) == 3
    assert not (tmp_path / "y").exists()


def test_pictures_and_files_must_be_as_many(tmp_path: Path) -> None:
    path = made_pds3(tmp_path)
    with pytest.raises(UsageError, match="2 pictures for 1 files"):
        import_folder([path], tmp_path / "out", ImportOptions(pictures=(path, path)))
    with pytest.raises(OutputError, match="holds"):
        import_folder([path], tmp_path, options_of(path))


def test_the_shipped_cameras_see_what_their_sources_say() -> None:
    near, rosetta = preset_camera("near_msi"), preset_camera("rosetta_navcam_half")
    edges = near.unproject([[-0.5, 121.5], [536.5, 121.5], [268.0, -0.5], [268.0, 243.5]])
    assert np.degrees(np.arccos(edges[0] @ edges[1])) == pytest.approx(2.93, abs=0.02)
    assert np.degrees(np.arccos(edges[2] @ edges[3])) == pytest.approx(2.25, abs=0.02)
    assert np.degrees(512.0 / rosetta.focal_length_px) == pytest.approx(5.0, abs=0.02)


def test_the_unit_of_a_label_changes_its_numbers_alone(tmp_path: Path) -> None:
    path = made_pds3(tmp_path)
    frame = import_folder([path], tmp_path / "km", options_of(path)).frames[0]
    text = re.sub(
        r"(SC_\w+ = \()(.*)\)",
        lambda m: m[1] + ", ".join(f"{1e3 * float(x)!r} <m>" for x in m[2].split(",")) + ")",
        path.read_text(),
    )
    text = text.replace("DECLINATION = 40.0", f"DECLINATION = {float(np.radians(40.0))!r} <rad>")
    path.write_text(text.replace("T12:00:00.000", "T12:00:00").replace("2004-05-01", "2004-122"))
    again = import_folder([path], tmp_path / "m", options_of(path)).frames[0]
    assert again.utc == frame.utc
    np.testing.assert_allclose(again.position_m, frame.position_m, rtol=1e-12)  # type: ignore[arg-type]
    np.testing.assert_allclose(again.sun_body, frame.sun_body, rtol=1e-12)  # type: ignore[arg-type]
    assert frame.camera_from_body is not None
    assert again.camera_from_body is not None
    assert (again.camera_from_body * frame.camera_from_body.inv()).magnitude() < 1e-12


def test_a_label_without_a_position_gives_a_row_without_a_prior(tmp_path: Path) -> None:
    path = made_pds3(tmp_path, SC_TARGET_POSITION_VECTOR='("N/A", "N/A", "N/A")')
    imported = import_folder([path], tmp_path / "out", options_of(path))
    frame = read_folder(tmp_path / "out").frames[0]
    assert (frame.problem, frame.position_m) == (None, None)
    # the Sun's vector is that of the craft less the target's: neither is known
    assert frame.sun_body is not None
    moon = AnalyticEphemeris(load_body("moon"))
    np.testing.assert_allclose(frame.sun_body, moon.sun_body(utc_to_tdb_s(UTC)), atol=1e-9)
    assert sum("SC_TARGET_POSITION_VECTOR is not stated" in r for r in imported.remarks) == 2


def test_a_label_that_gdal_does_not_open_is_read_by_its_image_object(tmp_path: Path) -> None:
    """With an empty keyword, a pointer by bytes in other letters, prefixes, a missing constant."""
    path = made_pds3(tmp_path, MISSION_PHASE_NAME="", **{"^IMAGE": '("A.IMG", 5 <BYTES>)'})
    text = path.read_text().replace("END_OBJECT", "LINE_PREFIX_BYTES = 2\nMISSING = 13\nEND_OBJECT")
    path.write_text(text)
    rows = np.hstack([np.full((4, 2), 99), np.arange(10, 34).reshape(4, 6)]).astype(np.uint8)
    (tmp_path / "a.img").write_bytes(b"head" + rows.tobytes())
    import_folder([path], tmp_path / "out", options_of(path))
    values = load_picture(tmp_path / "out/a.tif", load_camera(tmp_path / "made.toml")).values
    line = np.polyfit(np.r_[14:34], values.ravel()[4:], 1)  # real numbers become 16 bits linearly
    np.testing.assert_allclose(values.ravel()[4:], np.polyval(line, np.r_[14:34]), atol=0.6)
    assert np.isnan(values.ravel()[3])
    (tmp_path / "a.img").write_bytes(rows.tobytes()[:-5])
    with pytest.raises(DataError, match=r"a\.img: is cut short"):
        import_folder([path], tmp_path / "short", options_of(path))


def test_a_row_of_a_list_of_times_is_named_by_its_line(kernels: list[Path], tmp_path: Path) -> None:
    (tmp_path / "times.csv").write_text("file,utc\na.png,2004-05-01\n")
    (tmp_path / "t.toml").write_text(
        'format = "times"\nbody = "moon"\ncamera = "unk"\n[spice]\ncraft = 399\nframe = "J2000"\n'
    )
    options = ImportOptions(table=str(tmp_path / "t.toml"), kernels=tuple(kernels))
    with pytest.raises(DataError, match=r"times\.csv, line 2: utc: time '2004-05-01' is not"):
        import_folder([tmp_path / "times.csv"], tmp_path / "out", options)


def test_an_instrument_kernel_is_reported_as_not_used(kernels: list[Path], tmp_path: Path) -> None:
    path = made_pds3(tmp_path)
    text = "KPL/IK\n\\begindata\nINS-82360_FOCAL_LENGTH = 2003.44\n\\begintext\n"
    (tmp_path / "nac.ti").write_text(text)
    options = replace(options_of(path), kernels=(*kernels, tmp_path / "nac.ti"))
    imported = import_folder([path], tmp_path / "out", options)
    line = "not used: nac.ti: INS-82360_FOCAL_LENGTH = 2003.44; cameras/ has the camera's file"
    assert imported.remarks.count(line) == 1


def imported_picture(folder: Path, camera: str = "made.toml") -> Picture:
    return load_picture(folder / "out/a.tif", load_camera(folder / camera))


def with_pixels(folder: Path, values: np.ndarray, **changes: str) -> Path:
    """The label of `made_pds3` over 16-bit pixels (4, 6)."""
    path = made_pds3(folder, **changes)
    text = path.read_text().replace("SAMPLE_BITS = 8", "SAMPLE_BITS = 16")
    kind = "MSB_UNSIGNED_INTEGER" if values.dtype.kind == "u" else "MSB_INTEGER"
    text = text.replace("MSB_UNSIGNED_INTEGER", kind)
    path.write_text(text.replace("RECORD_BYTES = 6", "RECORD_BYTES = 12"))
    (folder / "a.img").write_bytes(values.astype(values.dtype.newbyteorder(">")).tobytes())
    return path


def test_special_values_of_a_label_become_a_mask_and_the_full_scale(tmp_path: Path) -> None:
    values = np.arange(100, 124, dtype=np.uint16).reshape(4, 6)
    values[0, :2], values[3, 4:] = 7, 4095
    path = with_pixels(tmp_path, values, MISSING_CONSTANT="7", SATURATED_CONSTANT="4095")
    imported = import_folder([path], tmp_path / "out", options_of(path))
    picture = imported_picture(tmp_path)
    np.testing.assert_array_equal(picture.valid, values != 7)
    np.testing.assert_array_equal(picture.values >= (picture.saturation or 0.0), values >= 121)
    assert "a.tif: 2 pixels have no value" in imported.remarks


@pytest.mark.parametrize("by_gdal", [True, False])
@pytest.mark.parametrize(
    ("sample", "layout", "constant", "stored"),
    [
        ("IEEE_REAL", ">f4", "16#7F7FFFFB#", np.uint32(0x7F7FFFFB).view(np.float32)),
        ("PC_REAL", "<f4", "16#7F7FFFFB#", np.uint32(0x7F7FFFFB).view(np.float32)),
        ("PC_REAL", "<f4", "16#FF7FFFFB#", np.uint32(0xFF7FFFFB).view(np.float32)),
        ("MSB_INTEGER", ">i2", "16#8001#", -32767),
        ("LSB_INTEGER", "<i2", "-32767", -32767),
        ("LSB_UNSIGNED_INTEGER", "<u2", "16#8001#", 32769),
        ("MSB_UNSIGNED_INTEGER", ">u1", "16#FF#", 255),
        ("LSB_INTEGER", "<i4", "16#FF7FFFFB#", -8388613),
    ],
)
def test_constants_of_all_sample_types_are_no_values(
    tmp_path: Path, sample: str, layout: str, constant: str, stored: float, by_gdal: bool
) -> None:
    """Read by GDAL, and by the IMAGE object where a keyword is empty: GDAL does not open it."""
    empty = {} if by_gdal else {"MISSION_PHASE_NAME": ""}
    path = made_pds3(tmp_path, NULL_CONSTANT=constant, **empty)
    values = np.arange(100, 124).reshape(4, 6).astype(layout)
    values[1, 2:4] = stored
    size = values.dtype.itemsize
    text = path.read_text().replace("MSB_UNSIGNED_INTEGER", sample)
    text = text.replace("SAMPLE_BITS = 8", f"SAMPLE_BITS = {8 * size}")
    path.write_text(text.replace("RECORD_BYTES = 6", f"RECORD_BYTES = {6 * size}"))
    (tmp_path / "a.img").write_bytes(values.tobytes())
    import_folder([path], tmp_path / "out", options_of(path))
    np.testing.assert_array_equal(imported_picture(tmp_path).valid, values != stored)


def test_a_constant_that_is_no_number_is_refused_by_its_name(tmp_path: Path) -> None:
    path = with_pixels(tmp_path, np.full((4, 6), 7, np.uint16), MISSING_CONSTANT='"2#12#"')
    with pytest.raises(DataError, match=r"a\.lbl: MISSING_CONSTANT = 2#12#; wanted a number"):
        import_folder([path], tmp_path / "out", options_of(path))


def test_full_scale_follows_the_counts_into_16_bits(tmp_path: Path) -> None:
    """Signed counts of 12 bits, clipped at 2047, are stretched over 16 bits."""
    values = np.random.default_rng(3).integers(-20, 1500, (40, 60)).astype(np.int16)
    values[:, 40:] = 2047
    text = CAMERA.replace("width_px = 6", "width_px = 60").replace(
        "height_px = 4", "height_px = 40"
    )
    path = with_pixels(tmp_path, values)
    label = (
        path.read_text().replace("LINES = 4", "LINES = 40").replace("SAMPLES = 6", "SAMPLES = 60")
    )
    path.write_text(label.replace("RECORD_BYTES = 12", "RECORD_BYTES = 120"))
    (tmp_path / "made.toml").write_text(text)
    import_folder([path], tmp_path / "out", options_of(path))
    picture = imported_picture(tmp_path)
    np.testing.assert_array_equal(picture.values >= (picture.saturation or 0.0), values == 2047)
    assert picture.saturation == pytest.approx(60_000.0)
    # stated in the camera file it is that of the counts before
    (tmp_path / "made.toml").write_text(text + "saturation_counts = 1000\n")
    import_folder([path], tmp_path / "again", options_of(path))
    stated = load_picture(tmp_path / "again/a.tif", load_camera(tmp_path / "made.toml"))
    full = values >= 1000
    np.testing.assert_array_equal(stated.values >= (stated.saturation or 0.0) - 0.5, full)
    (tmp_path / "made.toml").write_text(text + '[coding]\ncurve = "square"\n')
    with pytest.raises(DataError, match=r"pixels are int16, .*\[coding\] of camera 'made'"):
        import_folder([path], tmp_path / "coded", options_of(path))


@pytest.mark.parametrize("keyword", [n for n, e in KEYWORDS.items() if e.fate == "refused"])
def test_coded_pixels_of_a_label_are_refused_until_the_camera_says_how(
    keyword: str, tmp_path: Path
) -> None:
    path = made_pds3(tmp_path, **{keyword.upper(): "TABLE"})
    if keyword != keyword.upper():
        return  # a keyword of cubes
    with pytest.raises(DataError, match=rf"states {keyword} = TABLE; "):
        import_folder([path], tmp_path / "out", options_of(path))
    if keyword in CODING_KEYWORDS:
        camera = CAMERA + '[coding]\ncurve = "square"\n'
        (tmp_path / "made.toml").write_text(camera)
        import_folder([path], tmp_path / "out", options_of(path))
        coded = np.arange(10.0, 34.0).reshape(4, 6)
        expected = load_picture(tmp_path / "out/a.tif", load_camera(tmp_path / "made.toml")).values
        np.testing.assert_allclose(expected / expected[0, 0], coded**2 / 100.0, rtol=1e-6)


def test_lines_from_below_are_turned_where_the_table_says_so(tmp_path: Path) -> None:
    """The label's own direction is heeded by line_order = "label"; else it makes a remark."""
    path = made_pds3(tmp_path, LINE_DISPLAY_DIRECTION="UP")
    stored = np.arange(10, 34).reshape(4, 6)
    table = resource("configs/imports/pds3.toml").read_text().replace('line_order = "label"', "")
    for number, (order, flipped) in enumerate(
        [("", False), ("top_first", False), ("bottom_first", True), ("label", True)]
    ):
        line = f'line_order = "{order}"\n[time]' if order else "[time]"
        (tmp_path / "t.toml").write_text(table.replace("[time]", line, 1))
        options = replace(options_of(path), table=str(tmp_path / "t.toml"))
        out = tmp_path / f"out{number}"
        imported = import_folder([path], out, options)
        values = load_picture(out / "a.tif", load_camera(tmp_path / "made.toml")).values
        np.testing.assert_array_equal(values, stored[::-1] if flipped else stored)
        said = any("is shown lowest" in remark for remark in imported.remarks)
        assert said == (order == "")


@pytest.mark.parametrize(("suffix", "flipped"), [("png", False), ("jpg", False), ("tif", True)])
def test_a_picture_to_look_at_has_its_first_line_uppermost(
    tmp_path: Path, suffix: str, flipped: bool
) -> None:
    """A PNG or JPEG of --picture is not turned over with the archive's own pictures."""
    path = made_pds3(tmp_path, LINE_DISPLAY_DIRECTION="UP")
    stored = np.repeat(np.arange(40, 80, 10, dtype=np.uint8), 6).reshape(4, 6)
    viewed = tmp_path / f"view.{suffix}"
    cv2.imwrite(str(viewed), stored, [cv2.IMWRITE_JPEG_QUALITY, 100])
    options = replace(options_of(path), pictures=(viewed,))
    imported = import_folder([path], tmp_path / "out", options)
    values = load_picture(
        tmp_path / "out" / viewed.name, load_camera(tmp_path / "made.toml")
    ).values
    np.testing.assert_allclose(values, stored[::-1] if flipped else stored, atol=3)
    said = any("its first line is taken for the uppermost" in r for r in imported.remarks)
    assert said != flipped


def test_a_mask_beside_a_picture_is_copied_with_it(tmp_path: Path) -> None:
    path = made_pds3(tmp_path)
    stored = np.arange(10, 34, dtype=np.uint8).reshape(4, 6)
    viewed = tmp_path / "view.png"
    cv2.imwrite(str(viewed), stored)
    outside = np.where(stored < 13, 0, 255).astype(np.uint8)
    cv2.imwrite(str(tmp_path / "mask.tif"), outside)
    (tmp_path / "mask.tif").rename(tmp_path / "view.png.msk")
    import_folder([path], tmp_path / "out", replace(options_of(path), pictures=(viewed,)))
    picture = load_picture(tmp_path / "out/view.png", load_camera(tmp_path / "made.toml"))
    np.testing.assert_array_equal(picture.valid, outside == 255)


def test_an_imported_folder_with_a_mask_can_be_moved(tmp_path: Path) -> None:
    path = made_pds3(tmp_path)
    (tmp_path / "made.toml").write_text(CAMERA + 'valid_mask = "mask.png"\n')
    outside = np.where(np.arange(24).reshape(4, 6) < 5, 0, 255).astype(np.uint8)
    cv2.imwrite(str(tmp_path / "mask.png"), outside)
    import_folder([path], tmp_path / "out", options_of(path))
    assert str(tmp_path) not in (tmp_path / "out/cameras/made.toml").read_text()
    (tmp_path / "out").rename(tmp_path / "moved")
    (tmp_path / "mask.png").unlink()
    camera = read_folder(tmp_path / "moved").cameras["made"]
    picture = load_picture(tmp_path / "moved/a.tif", camera)
    np.testing.assert_array_equal(picture.valid, outside == 255)
    with pytest.raises(DataError, match=r"mask\.png: .*correct valid_mask"):
        import_folder([path], tmp_path / "again", options_of(path))
