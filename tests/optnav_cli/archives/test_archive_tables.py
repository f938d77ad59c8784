"""The import tables that ship, on labels as their missions write them, against other figures.

The numbers are those of public labels: MESSENGER EN1072174528M and Galileo 6300R and 2100R.
"""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import rasterio
from scipy.spatial.transform import Rotation

from catalog.bodies.body import load_body
from catalog.bodies.ephemeris import AnalyticEphemeris
from catalog.errors import DataError
from optnav_cli.archives.job import ImportOptions, import_folder
from optnav_cli.archives.label import read_label
from optnav_cli.archives.label_geometry import AttitudeKeys, read_attitude
from optnav_cli.camera.camera_file import load_camera
from optnav_cli.frames.folder import read_folder
from optnav_cli.frames.frames import Frame
from optnav_cli.frames.picture import load_picture

MDIS = """PDS_VERSION_ID               = PDS3
RECORD_TYPE                  = FIXED_LENGTH
RECORD_BYTES                 = {side}
^IMAGE                       = ("PICTURE.IMG", 1)
INSTRUMENT_ID                = MDIS-NAC
MISSION_PHASE_NAME           =
TARGET_NAME                  = MERCURY
START_TIME                   = 2015-04-24T04:42:19.666463
EXPOSURE_DURATION            = 1 <MS>
RIGHT_ASCENSION              = 166.36588 <DEG>
DECLINATION                  = -43.07155 <DEG>
TWIST_ANGLE                  = 139.85881 <DEG>
SC_TARGET_POSITION_VECTOR    = (1844.15964, -966.49167, 1322.58870) <KM>
SC_SUN_POSITION_VECTOR       = (-11803272.08016, 39512922.09768,
                                22332909.43056) <KM>
Object = IMAGE
  LINES                 = {side}
  LINE_SAMPLES          = {side}
  SAMPLE_TYPE           = UNSIGNED_INTEGER
  SAMPLE_BITS           = 8
End_Object
End
"""
SSI = """CCSD3ZF0000100000001NJPL3IF0PDS200000001 = SFDU_LABEL
RECORD_TYPE = FIXED_LENGTH
RECORD_BYTES = 1000
^IMAGE = ("PICTURE.IMG",2)
SPACECRAFT_NAME = "GALILEO ORBITER"
INSTRUMENT_NAME = "SOLID STATE IMAGING SYSTEM"
IMAGE_TIME = 1999-11-26T04:53:00.173Z
TARGET_NAME = "IO"
POSITIVE_LONGITUDE_DIRECTION = WEST
TARGET_CENTER_DISTANCE = 2.180447e+04
SUB_SPACECRAFT_LATITUDE =   -1.332
SUB_SPACECRAFT_LONGITUDE =  133.256
TWIST_ANGLE =  290.918
RIGHT_ASCENSION =   59.082
DECLINATION =   22.128
SUB_SOLAR_LATITUDE =    3.049
SUB_SOLAR_LONGITUDE =  159.874
OBJECT = IMAGE
LINES = 800
LINE_SAMPLES = 800
SAMPLE_BITS = 8
SAMPLE_TYPE = UNSIGNED_INTEGER
LINE_PREFIX_BYTES = 200
END_OBJECT
END
"""
VICAR = (
    "LBLSIZE=2000            FORMAT='BYTE'  TYPE='IMAGE'  DIM=3  EOL=0  RECSIZE=1000  ORG='BSQ'  "
    "NL=800  NS=800  NB=1  N1=800  N2=800  N3=1  N4=0  NBB=200  NLB=0  INTFMT='LOW'  "
    "REALFMT='VAX'  TASK='SSIMERGE'  MISSION='GALILEO'  SENSOR='SSI'  TARGET='GANYMEDE'  "
    "SCETYEAR=1996  SCETDAY=178  SCETHOUR=8  SCETMIN=46  SCETSEC=4  SCETMSEC=890  "
    "TLMFMT='HIS'  ENCODING_TYPE='INTEGER COSINE TRANSFORM '  "
    "TWIST=68.3644  RA=251.613  DEC=-16.4157  CUT_OUT_WINDOW=(2,1,399,392)  "
    "SUB_SOLAR_LATITUDE=-1.87338  SUB_SOLAR_LONGITUDE=125.636  SUB_SPACECRAFT_LATITUDE=-8.0665  "
    "SUB_SPACECRAFT_LONGITUDE=155.526  TARGET_CENTER_DISTANCE=665796.0  "
    "PARTITION=1  READOUTMODE='NOT APPLICABLE'  TASK='CATLABEL'  USER='DLC''040'  "
)


def imported(folder: Path, name: str, label: str, pixels: bytes) -> Frame:
    (folder / name).write_text(label)
    if not name.endswith(".img"):
        (folder / "picture.img").write_bytes(pixels)
    import_folder([folder / name], folder / "out")
    (frame,) = read_folder(folder / "out").frames
    assert frame.problem is None
    assert frame.position_m is not None
    assert frame.camera_from_body is not None
    assert frame.sun_body is not None
    return frame


@pytest.mark.parametrize(
    ("side", "camera"), [(512, "messenger_mdis_nac_binned"), (1024, "messenger_mdis_nac")]
)
def test_mdis_labels_agree_with_the_sensor_model_of_usgs(
    tmp_path: Path, side: int, camera: str
) -> None:
    """Position (-629 496, -1 582 946, 1 783 953) m, quaternion scalar first, by usgscsm."""
    pixels = bytes(side * side)
    frame = imported(tmp_path, "a.lbl", MDIS.format(side=side), pixels)
    assert (frame.camera, frame.utc) == (camera, "2015-04-24T04:42:19.667Z")
    assert np.linalg.norm(frame.position_m - [-629496.0, -1582946.0, 1783953.0]) < 300.0
    usgs = Rotation.from_quat([0.356761, 0.934184, 0.001448, -0.004494], scalar_first=True)
    assert frame.camera_from_body is not None
    assert np.degrees((frame.camera_from_body * usgs.inv()).magnitude()) < 0.06
    # the label has the Sun over 0.0343 deg north, 180.754 deg east
    x, y, z = frame.sun_body
    assert np.degrees(np.arcsin(z)) == pytest.approx(0.0343, abs=0.01)
    assert np.degrees(np.arctan2(y, x)) % 360.0 == pytest.approx(180.754, abs=0.15)


def test_a_label_of_galileo_looks_where_its_own_intercept_is(tmp_path: Path) -> None:
    """Pixel (400, 400), counted from 1: 22.153 S, 157.972 W of Io, 20,273.5 km away."""
    lines = np.zeros((800, 1000), np.uint8)
    frame = imported(tmp_path, "a.lbl", SSI, bytes(1000) + lines.tobytes())
    camera = load_camera(Path(__file__).parents[3] / "configs/cameras/galileo_ssi.toml")
    radii = np.array([1830.0e3, 1818.7e3, 1815.3e3])  # of the label
    assert frame.camera_from_body is not None
    assert frame.position_m is not None
    ray = frame.camera_from_body.inv().apply(camera.unproject(np.array([399.0, 399.0])))
    along, start = ray / radii, frame.position_m / radii
    a, b, c = along @ along, 2.0 * along @ start, start @ start - 1.0
    distance = (-b - np.sqrt(b * b - 4.0 * a * c)) / (2.0 * a)
    x, y, z = frame.position_m + distance * ray
    assert distance == pytest.approx(20_273.5e3, abs=5e3)
    assert np.degrees(np.arcsin(z / np.linalg.norm([x, y, z]))) == pytest.approx(-22.153, abs=0.02)
    assert np.degrees(np.arctan2(-y, x)) % 360.0 == pytest.approx(157.972, abs=0.02)


def test_a_vicar_label_of_galileo_shows_the_body_where_it_says(tmp_path: Path) -> None:
    """Centre of Ganymede at line 200.612, sample 237.814; 665,796 km; turned by 0.024 deg."""
    text = VICAR.ljust(2000) + "\0" * 800_000
    frame = imported(tmp_path, "a.img", text, b"")
    assert (frame.camera, frame.utc) == ("galileo_ssi_summed", "1996-06-26T08:46:04.890Z")
    position = np.asarray(frame.position_m)
    assert np.linalg.norm(position) == pytest.approx(665_796e3)
    assert np.degrees(np.arctan2(-position[1], position[0])) % 360.0 == pytest.approx(155.526)
    assert frame.camera_from_body is not None
    camera = load_camera(Path(__file__).parents[3] / "configs/cameras/galileo_ssi_summed.toml")
    centre = camera.project(frame.camera_from_body.apply(-position)[None])[0]
    off_deg = np.degrees(np.linalg.norm(centre - [236.814, 199.612]) / camera.focal_length_px)
    assert off_deg == pytest.approx(0.0254, abs=0.001)


def test_the_square_pictures_of_near_get_their_camera(
    shared_data: Callable[[str], Path], tmp_path: Path
) -> None:
    raw = bytearray(shared_data("near/m0126865998f4_2p_iof.fit").read_bytes()[:11520])
    at = raw.index(b"NAXIS2  =")
    raw[at : at + 80] = b"NAXIS2  =                  412".ljust(80)
    (tmp_path / "a.fit").write_bytes(bytes(raw) + bytes(537 * 412 * 4))
    import_folder([tmp_path / "a.fit"], tmp_path / "out")
    assert read_folder(tmp_path / "out").frames[0].camera == "near_msi_square"


def test_a_label_of_cassini_wants_kernels(tmp_path: Path) -> None:
    label = (
        "LBLSIZE=1024            FORMAT='BYTE'  TYPE='IMAGE'  DIM=3  EOL=0  RECSIZE=1024  "
        "ORG='BSQ'  NL=1024  NS=1024  NB=1  N1=1024  N2=1024  N3=1  N4=0  NBB=0  NLB=0  "
        "INTFMT='LOW'  REALFMT='RIEEE'  PROPERTY='IDENTIFICATION'  INSTRUMENT_ID='ISSNA'  "
        "DATA_CONVERSION_TYPE='TABLE'  TARGET_NAME='MOON'  INSTRUMENT_MODE_ID='FULL'  "
        "IMAGE_MID_TIME='1999-230T03:28:00.473Z'  "
    )
    path = tmp_path / "a.img"
    path.write_text(label.ljust(1024) + "\0" * 1024**2)
    with pytest.raises(DataError, match="states no attitude; name SPICE kernels"):
        import_folder([path], tmp_path / "out")


def test_a_target_is_matched_by_words(tmp_path: Path) -> None:
    """A label of Dione names no Io, though its letters are there."""
    label = SSI.replace('"IO"', '"DIONE"')
    (tmp_path / "a.lbl").write_text(label)
    (tmp_path / "picture.img").write_bytes(bytes(1000) + bytes(800 * 1000))
    with pytest.raises(DataError) as refused:
        import_folder([tmp_path / "a.lbl"], tmp_path / "out", ImportOptions(body="io"))
    assert "shows DIONE by its label, not io" in str(refused.value)
    assert load_body("io").name == "io"


DAWN = """PDS_VERSION_ID                = PDS3
RECORD_TYPE                   = FIXED_LENGTH
RECORD_BYTES                  = 2048
FILE_RECORDS                  = 1024
^IMAGE                        = ("PICTURE.IMG", 1)
INSTRUMENT_HOST_ID            = "DAWN"
INSTRUMENT_ID                 = "FC2"
START_TIME                    = 2015-170T16:15:46.345
EXPOSURE_DURATION             = 1800.000 <millisecond>
RIGHT_ASCENSION               = 289.753 <degree>
DECLINATION                   = 64.400 <degree>
TWIST_ANGLE                   = 95.606 <degree>
CELESTIAL_NORTH_CLOCK_ANGLE   = 275.606 <degree>
QUATERNION                    = (
    0.5213655224
    , -0.1747575947
    , 0.1361764644
    , -0.8240714445
)
COORDINATE_SYSTEM_NAME        = "CERES_FIXED"
SC_TARGET_POSITION_VECTOR     = ("N/A" , "N/A" , "N/A")
TARGET_NAME                   = "1 CERES"
LINE_DISPLAY_DIRECTION        = "UP"
RETICLE_POINT_RA              = (
)
OBJECT                        = IMAGE
    LINE_SAMPLES              = 1024
    LINES                     = 1024
    SAMPLE_BITS               = 16
    SAMPLE_TYPE               = "LSB_UNSIGNED_INTEGER"
END_OBJECT                    = IMAGE
END
"""


def camera_from_inertial(frame: Frame, body: str) -> Rotation:
    motion = AnalyticEphemeris(load_body(body))
    assert frame.camera_from_body is not None
    assert frame.tdb_s is not None
    return frame.camera_from_body * Rotation.from_matrix(motion.body_from_inertial(frame.tdb_s))


def test_a_label_of_dawn_gives_attitude_and_turned_rows_without_a_position(tmp_path: Path) -> None:
    """Its right ascension, declination and twist say what its quaternion does: to 1e-3 deg."""
    pixels = np.arange(1024, dtype="<u2")[:, None] + np.zeros((1, 1024), "<u2")
    (tmp_path / "a.lbl").write_text(DAWN)
    (tmp_path / "picture.img").write_bytes(pixels.tobytes())
    import_folder([tmp_path / "a.lbl"], tmp_path / "out")
    (frame,) = read_folder(tmp_path / "out").frames
    assert (frame.problem, frame.position_m) == (None, None)
    assert frame.utc == "2015-06-19T16:15:47.245Z"
    boresight = AttitudeKeys(boresight=("RIGHT_ASCENSION", "DECLINATION", "-TWIST_ANGLE"))
    angles = read_attitude(read_label(tmp_path / "a.lbl", "pds3"), boresight)
    half_turn = Rotation.from_euler("z", 180.0, degrees=True)
    apart = camera_from_inertial(frame, "ceres") * (half_turn * angles).inv()
    assert np.degrees(apart.magnitude()) < 1e-3
    camera = load_camera(Path(__file__).parents[3] / "configs/cameras/dawn_fc2.toml")
    values = load_picture(tmp_path / "out/a.tif", camera).values
    assert values[0, 0] > values[-1, 0]  # the last line of the file is uppermost


def test_a_header_of_hayabusa2_gives_the_attitude_of_its_corners(tmp_path: Path) -> None:
    """The half-lit Earth's middle is at pixel (567.5, 774.5), 0.2 deg from where its orbit has it.

    USGS ALE has the state at 08:44:58; two-body motion back to 00:00:06 gives the header's distance
    of 202,859 km and the Earth at right ascension 74.563, declination -33.810 deg.
    """
    corners = {"1": (145.817, -31.0681), "2": (106.558, 11.5177), "3": (68.0724, -68.6221),
               "4": (54.6155, -12.443)}  # fmt: skip
    cards = ["XTENSION= 'IMAGE   '", "BITPIX  = 16", "NAXIS   = 2", "NAXIS1  = 1024",
             "NAXIS2  = 1024", "PCOUNT  = 0", "GCOUNT  = 1", "NAIFNAME= 'HAYABUSA2_ONC-W2'",
             "OBJECT  = 'EARTH   '", "DATE-OBS= '2015-12-03T00:00:06.639'"]  # fmt: skip
    for number, (ascension, declination) in corners.items():
        cards += [f"S_RA{number}   = {ascension} / RA of corner [deg]",
                  f"S_DEC{number}  = {declination} / DEC of corner [deg]"]  # fmt: skip
    first = ["SIMPLE  =                    T", "BITPIX  = 8", "NAXIS   = 0", "EXTEND  = T"]
    headers = [
        "".join(card.ljust(80) for card in [*unit, "END"]).encode() for unit in (first, cards)
    ]
    blocks = b"".join(header.ljust(-(-len(header) // 2880) * 2880) for header in headers)
    (tmp_path / "a.fit").write_bytes(blocks + bytes(2 * 1024**2))
    import_folder([tmp_path / "a.fit"], tmp_path / "out")
    (frame,) = read_folder(tmp_path / "out").frames
    assert (frame.problem, frame.position_m) == (None, None)
    camera = load_camera(Path(__file__).parents[3] / "configs/cameras/hayabusa2_onc_w2.toml")
    ray = camera.unproject(np.array([567.5, 774.5]))
    seen = camera_from_inertial(frame, "earth").inv().apply(ray)
    ascension, declination = np.radians([74.563, -33.810])
    earth = [np.cos(declination) * np.cos(ascension), np.cos(declination) * np.sin(ascension),
             np.sin(declination)]  # fmt: skip
    seen /= np.linalg.norm(seen)
    assert np.degrees(np.arccos(seen @ earth)) < 0.2


OSIRIS_REX = """<?xml version="1.0" encoding="UTF-8"?>
<Product_Observational xmlns="http://pds.nasa.gov/pds4/pds/v1"
 xmlns:geom="http://pds.nasa.gov/pds4/geom/v1" xmlns:orex="http://pds.nasa.gov/pds4/mission/orex/v1">
<Observation_Area>
<Time_Coordinates><start_date_time>2018-12-01T10:07:11.900Z</start_date_time></Time_Coordinates>
<Target_Identification><name>(101955) BENNU</name></Target_Identification>
<Mission_Area><orex:ocm_instrument_attributes><orex:camera_id>0</orex:camera_id>
</orex:ocm_instrument_attributes></Mission_Area>
<Discipline_Area><geom:Image_Display_Geometry><geom:Display_Direction>
<geom:vertical_display_direction>Bottom to Top</geom:vertical_display_direction>
</geom:Display_Direction><geom:Object_Orientation_RA_Dec>
<geom:right_ascension_angle unit="deg">341.305276490202</geom:right_ascension_angle>
<geom:declination_angle unit="deg">1.23413410647874</geom:declination_angle>
<geom:celestial_north_clock_angle unit="deg">256.494372326072</geom:celestial_north_clock_angle>
<geom:Reference_Frame_Identification><geom:name>J2000</geom:name>
</geom:Reference_Frame_Identification></geom:Object_Orientation_RA_Dec>
</geom:Image_Display_Geometry></Discipline_Area></Observation_Area></Product_Observational>
"""


def test_a_label_of_osiris_rex_has_the_attitude_of_its_cd_matrix(tmp_path: Path) -> None:
    """The matrix, of pixels that count upwards, turns by columns to right ascension and north."""
    (tmp_path / "a.xml").write_text(OSIRIS_REX)
    picture = np.arange(1024, dtype=np.uint8)[:, None] + np.zeros((1, 1024), np.uint8)
    with rasterio.open(tmp_path / "a.tif", "w", "GTiff", 1024, 1024, 1, dtype="uint8",
                       transform=[1, 0, 5, 0, -1, 5]) as file:  # fmt: skip
        file.write(picture, 1)
    options = ImportOptions(pictures=(tmp_path / "a.tif",))
    import_folder([tmp_path / "a.xml"], tmp_path / "out", options)
    (frame,) = read_folder(tmp_path / "out").frames
    assert (frame.problem, frame.camera) == (None, "osirisrex_mapcam")
    inertial = camera_from_inertial(frame, "bennu").inv()
    ascension, declination = np.radians([341.305276490202, 1.23413410647874])
    east = np.array([-np.sin(ascension), np.cos(ascension), 0.0])
    north = [-np.sin(declination) * np.cos(ascension), -np.sin(declination) * np.sin(ascension),
             np.cos(declination)]  # fmt: skip
    right, down = (inertial.apply(axis) for axis in np.eye(3)[:2])
    matrix = np.array([[0.000905552827907964, -0.00377026754277099],
                       [-0.00377026754277099, -0.000905552827907964]])  # fmt: skip
    matrix /= np.sqrt(abs(np.linalg.det(matrix)))
    found = np.array([[right @ east, -down @ east], [right @ north, -down @ north]])
    np.testing.assert_allclose(found, matrix, atol=1e-6)
