"""The import tables that ship, on labels as their missions write them, against other figures.

The numbers are those of public labels: MESSENGER EN1072174528M and Galileo 6300R and 2100R.
"""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from catalog.bodies.body import load_body
from catalog.errors import DataError
from optnav_cli.camera.camera_file import load_camera
from optnav_cli.frames.folder import read_folder
from optnav_cli.frames.frames import Frame
from optnav_cli.runs.import_folder import ImportOptions, import_folder

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
    "TLMFMT='HIS'  TWIST=68.3644  RA=251.613  DEC=-16.4157  CUT_OUT_WINDOW=(2,1,399,392)  "
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
        "TARGET_NAME='MOON'  INSTRUMENT_MODE_ID='FULL'  IMAGE_MID_TIME='1999-230T03:28:00.473Z'  "
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
