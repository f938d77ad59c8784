"""Read time, attitude and vectors of a label by the keywords that an import table names.

`KEYWORDS` says what becomes of each geometry keyword: used, refused or harmless.
"""

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Literal

import msgspec
import numpy as np
from scipy.spatial.transform import Rotation

from catalog.arrays import FloatArray
from catalog.bodies.body import Body
from catalog.bodies.epochs import compute_tdb_s_after, utc_from_tdb_s
from catalog.errors import ConfigError, DataError
from catalog.keywords import Keyword, check_keywords
from optnav_cli.archives.label import ArchiveLabel

Scale = Annotated[float, msgspec.Meta(gt=0.0, le=1e12)]
Keys = tuple[str, ...]
Axes = Literal["inertial", "body", "camera"]
DEGREE = float(np.pi / 180.0)
LONGITUDE_WORDS = {"POSITIVE_LONGITUDE_DIRECTION": {"WEST": "west", "EAST": "east"}}
LATITUDE_WORDS = {
    key: {word: word.lower() for word in ("PLANETOCENTRIC", "PLANETOGRAPHIC")}
    for key in ("COORDINATE_SYSTEM_NAME", "LATITUDE_TYPE")
}
MAX_SKEW = 0.05  # rad between a picture's sides: corners of archives agree to 1e-5
INERTIAL = re.compile(r"J\W?2000|EME\W?2000|ICR[FS]|GCRF")
BODY_FIXED = re.compile(r"FIXED|^IAU[_ ]|BODY")
MAX_ANGLE_RAD = 2.0 * np.pi + 1e-6  # of right ascensions, longitudes and rolls
_BY_TABLE = Keyword("used", "a table reads it, in its unit")
_UTC = Keyword("refused", "convert the times to UTC", ("", "UTC", "UTC(NTP)", "UTC(GPS)"))
_J2000 = Keyword(
    "refused",
    "turn the angles to J2000",
    ("", "ICRS", "FK5", "GCRS", "J2000", "2000", "2000.0", "J2000.0"),
)
_ROWS = Keyword("used", "line_order of the table says how the rows are stored")
_DERIVED = Keyword("harmless", "follows from position, attitude and body")
_SIZE = Keyword("harmless", "the picture's size, which must be the camera's, shows it")
KEYWORDS = {
    **dict.fromkeys(
        (
            *("START_TIME", "IMAGE_TIME", "IMAGE_MID_TIME", "start_date_time"),
            *("EXPOSURE_DURATION", "RIGHT_ASCENSION", "DECLINATION", "TWIST_ANGLE"),
            *("CELESTIAL_NORTH_CLOCK_ANGLE", "QUATERNION", "EMECL_SC_QUATERNION"),
            *("SC_TARGET_POSITION_VECTOR", "SC_SUN_POSITION_VECTOR", "TARGET_CENTER_DISTANCE"),
            *("SUB_SPACECRAFT_LATITUDE", "SUB_SPACECRAFT_LONGITUDE", "TARGET_NAME"),
            *("SUB_SOLAR_LATITUDE", "SUB_SOLAR_LONGITUDE"),
            *("SCETYEAR", "SCETDAY", "SCETHOUR", "SCETMIN", "SCETSEC", "SCETMSEC"),
            *("RA", "DEC", "TWIST", "TARGET"),
            *("right_ascension_angle", "declination_angle", "celestial_north_clock_angle"),
            *("x_position", "y_position", "z_position"),
        ),
        _BY_TABLE,
    ),
    "POSITIVE_LONGITUDE_DIRECTION": Keyword("used", "direction of the longitudes of sub-points"),
    "LATITUDE_TYPE": Keyword("used", "kind of the latitudes of sub-points"),
    "COORDINATE_SYSTEM_NAME": Keyword("used", "frame of vectors, kind of latitudes"),
    "Reference_Frame_Identification/name": Keyword("used", "frame of vectors and attitudes"),
    "coordinate_system_name": Keyword("used", "as Reference_Frame_Identification"),
    **dict.fromkeys(("TIMESYS", "TIME_SYSTEM", "TIME_SCALE", "TIMESCALE"), _UTC),
    **dict.fromkeys(("RADESYS", "RADECSYS", "EQUINOX"), _J2000),
    **dict.fromkeys(
        (
            *("LINE_DISPLAY_DIRECTION", "SAMPLE_DISPLAY_DIRECTION"),
            *("vertical_display_direction", "horizontal_display_direction"),
        ),
        _ROWS,
    ),
    "CUT_OUT_WINDOW": Keyword(
        "reported", "pixels outside of it have no value", ("1,1,800,800", "1,1,1024,1024")
    ),
    "TWIST_ANGLE_TYPE": Keyword("harmless", "the table of a mission says how its twist counts"),
    "COORDINATE_SYSTEM_CENTER_NAME": Keyword(
        "harmless", "the table of a mission says from where a vector points"
    ),
    "RA_DEC_REF_PIXEL": Keyword("harmless", "the middle of the picture, within a pixel"),
    **dict.fromkeys(
        (
            *("SLANT_DISTANCE", "CENTER_LATITUDE", "CENTER_LONGITUDE", "SPACECRAFT_ALTITUDE"),
            *("INTERCEPT_POINT_LATITUDE", "INTERCEPT_POINT_LONGITUDE", "INTERCEPT_POINT_LINE"),
            *("INTERCEPT_POINT_LINE_SAMPLE", "SUB_SPACECRAFT_LINE", "SUB_SPACECRAFT_SAMPLE"),
            *("SUB_SPACECRAFT_LINE_SAMPLE", "SUB_SPACECRAFT_AZIMUTH", "SUB_SOLAR_AZIMUTH"),
            *("RETICLE_POINT_RA", "RETICLE_POINT_DECLINATION", "RETICLE_POINT_LATITUDE"),
            *("RETICLE_POINT_LONGITUDE", "NORTH_AZIMUTH", "PHASE_ANGLE", "INCIDENCE_ANGLE"),
            *("EMISSION_ANGLE", "LOCAL_HOUR_ANGLE", "HORIZONTAL_PIXEL_SCALE", "CONE_ANGLE"),
            *("VERTICAL_PIXEL_SCALE", "SOLAR_DISTANCE", "SPACECRAFT_SOLAR_DISTANCE"),
            *("CENTRAL_BODY_DISTANCE", "MINIMUM_LATITUDE", "MAXIMUM_LATITUDE"),
            *("WESTERNMOST_LONGITUDE", "EASTERNMOST_LONGITUDE", "SUN_SC_POSITION_VECTOR"),
            *("SOLAR_LONGITUDE", "SOLAR_ELONGATION", "A_AXIS_RADIUS", "B_AXIS_RADIUS"),
            *("C_AXIS_RADIUS", "geometry_reference_time_utc", "geometry_reference_time_tdb"),
        ),
        _DERIVED,
    ),
    **dict.fromkeys(
        ("SC_TARGET_VELOCITY_VECTOR", "SC_SUN_VELOCITY_VECTOR"),
        Keyword("harmless", "no velocity is imported"),
    ),
    **dict.fromkeys(("SMEAR_MAGNITUDE", "SMEAR_AZIMUTH"), Keyword("harmless", "blur, no geometry")),
    **dict.fromkeys(
        (
            *("PIXEL_AVERAGING_WIDTH", "PIXEL_AVERAGING_HEIGHT", "FIRST_LINE"),
            *("FIRST_LINE_SAMPLE", "MESS:FPU_BIN", "MESS:PIXELBIN", "MESS:SUBFRAME"),
        ),
        _SIZE,
    ),
}


class TimeKeys(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Keyword of the time: UTC as text, unix seconds, or seconds of a clock that began at a UTC.

    fields    keywords of year, day of year, hour, minute, second and millisecond, UTC
    exposure  keyword of the exposure time, half of which is added; exposure_s  seconds a unit where
              the label states none
    """

    utc: str = ""
    unix: str = ""
    clock: str = ""
    clock_began_utc: str = ""
    fields: Keys = ()
    exposure: str = ""
    exposure_s: Scale = 1.0


class VectorKeys(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Keywords of a vector: that of `keys` less that of `minus`, "-KEY" being negated.

    unit_m     metres a unit, where the label states none
    axes       along which the vector lies: those of the stars (J2000), of the body or of the
               camera; by default of the frame that the label names, else of the stars
    sub_point  instead of `keys`: latitude and longitude, deg, of the point of the body below it
    range      keyword of its distance from the body's centre; of a position
    longitude  in which direction longitudes grow, where the label states none
    latitude   of which kind latitudes are, where the label states none
    """

    keys: Keys = ()
    minus: Keys = ()
    unit_m: Scale = 1000.0
    axes: Axes | None = None
    sub_point: Keys = ()
    range: str = ""
    longitude: Literal["east", "west"] = "east"
    latitude: Literal["planetocentric", "planetographic"] = "planetocentric"


class AttitudeKeys(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Keywords of the attitude, one of three; none: SPICE kernels have it.

    quaternion  scalar first, of the rotation taking vectors of the stars' axes to the label's frame
    boresight   its right ascension, its declination and the clock angle of celestial north, from
                the picture's top clockwise, deg
    corners     right ascension and declination, deg, of the picture's corners: upper left, upper
                right, lower right, lower left
    """

    quaternion: Keys = ()
    boresight: Keys = ()
    corners: Keys = ()


def check_keys(
    path: Path,
    time: TimeKeys,
    attitude: AttitudeKeys,
    position: VectorKeys | None,
    sun: VectorKeys | None,
    *,
    has_spice: bool,
) -> None:
    """Check that a table names each quantity once. Raises ConfigError."""
    counts = len(attitude.quaternion), len(attitude.boresight), len(attitude.corners)
    allowed = ((4, 0, 0), (1, 0, 0), (0, 3, 0), (0, 1, 0), (0, 0, 8))
    if counts not in allowed and not (has_spice and counts == (0, 0, 0)):
        raise ConfigError(
            f"{path}: [attitude] wants 4 keys of a quaternion, 3 of a boresight or 8 of corners"
        )
    if sum(map(bool, (time.utc, time.unix, time.clock, time.fields))) != 1:
        raise ConfigError(f"{path}: [time] wants one of utc, unix, clock, fields")
    if len(time.fields) not in (0, 6):
        raise ConfigError(
            f"{path}: [time] fields has {len(time.fields)} keys; wanted 6: year, day of year, "
            "hour, minute, second, millisecond"
        )
    for name, keys in (("position", position), ("sun", sun)):
        if keys is None:
            continue
        if bool(keys.keys) == bool(keys.sub_point) or len(keys.sub_point) not in (0, 2):
            raise ConfigError(
                f"{path}: [{name}] wants keys of a vector, or sub_point of a latitude and longitude"
            )
        if bool(keys.range) != (name == "position" and bool(keys.sub_point)):
            raise ConfigError(f"{path}: [{name}] range goes with sub_point of a position, both")


def read_time(label: ArchiveLabel, keys: TimeKeys) -> tuple[str, float]:
    """UTC and TDB s of the middle of the exposure. Raises DataError, which names the keyword."""
    half = 0.0
    if keys.exposure:
        half = 0.5 * float(label.numbers((keys.exposure,), "time", keys.exposure_s)[0])
    key = keys.utc or keys.unix or keys.clock or keys.fields[0]
    if keys.utc:
        began, seconds = label.text(keys.utc), half
    elif keys.unix:
        # which counts no leap seconds: whole days and what is left of the last one
        since = float(label.numbers((keys.unix,), "time")[0]) + half
        began, seconds = _format_utc_day(1970, 1 + int(since // 86400.0)), since % 86400.0
    elif keys.clock:
        began, seconds = keys.clock_began_utc, float(label.numbers((keys.clock,), "time")[0]) + half
    else:
        year, day, hour, minute, second, millisecond = label.numbers(keys.fields).tolist()
        began = _format_utc_day(int(year), int(day))
        seconds = 3600.0 * hour + 60.0 * minute + second + 1e-3 * millisecond + half
    try:
        tdb_s = float(compute_tdb_s_after(began, [seconds])[0])
    except DataError as error:
        raise DataError(f"{label.path}: {key}: {error}") from None
    return utc_from_tdb_s(tdb_s, 3), tdb_s


def _format_utc_day(year: int, day: int) -> str:
    """The beginning of a day that is counted from the first of a year, which is day 1."""
    date = np.datetime64(f"{year:04d}-01-01") + np.timedelta64(day - 1, "D")
    return f"{date}T00:00:00Z"


def is_vector_stated(label: ArchiveLabel, keys: VectorKeys) -> bool:
    """Whether a label states all that a vector is made of."""
    return not list_unstated_keys(label, keys)


def list_unstated_keys(label: ArchiveLabel, keys: VectorKeys) -> list[str]:
    """The keywords of a vector that a label does not state."""
    names = (*keys.keys, *keys.minus, *keys.sub_point, *([keys.range] if keys.range else []))
    return [name.removeprefix("-") for name in names if not label.is_stated(name)]


def find_axes(label: ArchiveLabel, keys: VectorKeys) -> Axes:
    """Along which axes a vector lies. Raises DataError for a frame that is not known."""
    if keys.sub_point:
        return "body"
    return keys.axes or _find_frame_axes(label, keys.keys[0].removeprefix("-")) or "inertial"


def check_frame(label: ArchiveLabel, keys: Keys) -> None:
    """Refuse an attitude against other axes than those of the stars. Raises DataError."""
    axes = _find_frame_axes(label, keys[0].removeprefix("-")) if "/" in keys[0] else "inertial"
    if axes == "body":
        raise DataError(
            f"{label.path}: states {keys[0]} in the frame of the body; wanted one in J2000 or ICRF"
        )


def _find_frame_axes(label: ArchiveLabel, key: str) -> Axes | None:
    """The axes of the frame that a label names for a keyword; None where it names none."""
    for name in label.list_frame_keys(key):
        text = label.values[name][0].upper() if label.values[name] else ""
        if not label.is_stated(name) or text in ("PLANETOCENTRIC", "PLANETOGRAPHIC"):
            continue
        if INERTIAL.search(text):
            return "inertial"
        if BODY_FIXED.search(text):
            return "body"
        raise DataError(
            f"{label.path}: states {name} = {text[:40]} for {key}, a frame that is not known; "
            'state axes = "inertial", "body" or "camera" in the table'
        )
    return None


def read_vector(label: ArchiveLabel, keys: VectorKeys, body: Body) -> FloatArray:
    """A vector (3,), m, in the axes that its keys say; of a Sun below a point its direction.

    Raises DataError for numbers that are none or of another quantity.
    """
    if keys.sub_point:
        return _compute_above_point(label, keys, body)
    vector = label.numbers(keys.keys, "length", keys.unit_m)
    if keys.minus:
        vector = vector - label.numbers(keys.minus, "length", keys.unit_m)
    if vector.shape != (3,):
        raise DataError(f"{label.path}: {', '.join(keys.keys)} are {vector.size} numbers; wanted 3")
    return vector


def _compute_above_point(label: ArchiveLabel, keys: VectorKeys, body: Body) -> FloatArray:
    """A vector (3,), body axes, from the centre through a point of the surface."""
    latitude, longitude = _read_angles(label, keys.sub_point, 2)
    if not abs(latitude) <= 0.5 * np.pi + 1e-9:
        raise DataError(
            f"{label.path}: {keys.sub_point[0]} is {np.degrees(latitude):g} deg; wanted -90 to 90"
        )
    if _read_word(label, LATITUDE_WORDS, keys.latitude) == "planetographic":
        equator, pole = np.mean(body.radii_m[:2]), body.radii_m[2]
        # the angle of the point's direction, from that of the ellipsoid's normal
        latitude = np.arctan2(pole**2 * np.sin(latitude), equator**2 * np.cos(latitude))
    if _read_word(label, LONGITUDE_WORDS, keys.longitude) == "west":
        longitude = -longitude
    range_m = 1.0
    if keys.range:
        range_m = float(label.numbers((keys.range,), "length", keys.unit_m)[0])
        if not range_m > 0.0:
            raise DataError(f"{label.path}: {keys.range} is {range_m:g} m; wanted a distance > 0")
    return range_m * _compute_direction(longitude, latitude)


def _compute_direction(longitude: float, latitude: float) -> FloatArray:
    """The unit vector (3,) of two angles, rad."""
    return np.array([np.cos(latitude) * np.cos(longitude),
                     np.cos(latitude) * np.sin(longitude), np.sin(latitude)])  # fmt: skip


def _read_word(label: ArchiveLabel, words: Mapping[str, Mapping[str, str]], default: str) -> str:
    """Return the meaning of the first stated keyword of several, else the table's default."""
    for key, meanings in words.items():
        if label.is_stated(key):
            text = label.text(key).upper()
            if text in meanings:
                return meanings[text]
            if key != "COORDINATE_SYSTEM_NAME":  # which names frames, too
                raise DataError(
                    f"{label.path}: states {key} = {text[:40]}; wanted {' or '.join(meanings)}"
                )
    return default


def _read_angles(label: ArchiveLabel, keys: Keys, count: int) -> FloatArray:
    """Angles (count,), rad, of keywords. Raises DataError for other counts or too large ones."""
    angles = label.numbers(keys, "angle", DEGREE)
    if angles.shape != (count,):
        raise DataError(
            f"{label.path}: {', '.join(keys)} are {angles.size} numbers; wanted {count} angles"
        )
    if not np.abs(angles).max() < MAX_ANGLE_RAD:
        raise DataError(
            f"{label.path}: {', '.join(keys)} are {np.round(np.degrees(angles), 3).tolist()} deg; "
            "wanted angles within one turn"
        )
    return angles


def read_attitude(label: ArchiveLabel, keys: AttitudeKeys) -> Rotation:
    """The rotation from the stars' axes to the label's frame, or to the camera's."""
    if not (keys.quaternion or keys.boresight or keys.corners):
        raise DataError(
            f"{label.path}: its label states no attitude; name SPICE kernels with it (--kernel)"
        )
    check_frame(label, keys.quaternion or keys.boresight or keys.corners)
    if keys.quaternion:
        numbers = label.numbers(keys.quaternion)
        if numbers.shape != (4,):
            raise DataError(f"{label.path}: its attitude has {numbers.size} numbers; wanted 4")
        if not abs(float(np.linalg.norm(numbers)) - 1.0) < 0.01:
            raise DataError(f"{label.path}: its quaternion has no length of 1")
        return Rotation.from_quat(numbers, scalar_first=True)
    if keys.corners:
        return _fit_corners(label, keys.corners)
    ascension, declination, clock = _read_angles(label, keys.boresight, 3)
    axis = _compute_direction(ascension, declination)
    east = np.array([-np.sin(ascension), np.cos(ascension), 0.0])
    north = np.cross(axis, east)
    # north stands `clock` right of the top; east, seen from inside the sphere, a quarter left of it
    up = np.cos(clock) * north + np.sin(clock) * east
    return Rotation.from_matrix(np.array([np.cross(-up, axis), -up, axis]))


def _fit_corners(label: ArchiveLabel, keys: Keys) -> Rotation:
    """The attitude of a picture whose corners lie in stated directions about its boresight."""
    angles = _read_angles(label, keys, 8).reshape(4, 2)
    upper_left, upper_right, lower_right, lower_left = (
        _compute_direction(*pair) for pair in angles
    )
    right = upper_right + lower_right - upper_left - lower_left
    down = lower_left + lower_right - upper_left - upper_right
    forward = upper_left + upper_right + lower_right + lower_left
    axes = np.array([right, down, forward])
    axes /= np.maximum(np.linalg.norm(axes, axis=1, keepdims=True), 1e-12)
    if not (np.abs(axes @ axes.T - np.eye(3)).max() < MAX_SKEW and np.linalg.det(axes) > 0.0):
        raise DataError(
            f"{label.path}: {', '.join(keys)} are no corners of a picture in this order; wanted "
            "upper left, upper right, lower right, lower left as the rows are stored"
        )
    left, _, back = np.linalg.svd(axes)
    return Rotation.from_matrix(left @ back)


def check_label(label: ArchiveLabel) -> list[str]:
    """Check what a label states about its geometry; return remarks. Raises DataError."""
    stated = []
    for name, texts in label.values.items():
        key = name.rpartition("/")[2]
        # blocks of PDS3 describe other objects than the picture, but for IMAGE
        key = key.removeprefix("IMAGE.")
        stated.append((key, ",".join(texts)))
    return check_keywords(label.path, stated, KEYWORDS)
