"""What becomes of the geometry keywords of FITS, PDS3, PDS4 and VICAR labels.

Numbers are read by the keywords that an import table names. Those that say what such numbers mean
(frame, equinox, time system, direction) are used or refused here, whatever the table.
"""

from catalog.keywords import Keyword, check_keywords
from optnav_cli.archives.label import ArchiveLabel

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


def check_label(label: ArchiveLabel) -> list[str]:
    """Check what a label states about its geometry; return remarks. Raises DataError."""
    stated = []
    for name, texts in label.values.items():
        key = name.rpartition("/")[2]
        # blocks of PDS3 describe other objects than the picture, but for IMAGE
        key = key.removeprefix("IMAGE.")
        stated.append((key, ",".join(texts)))
    return check_keywords(label.path, stated, KEYWORDS)
