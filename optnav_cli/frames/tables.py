"""The columns of every CSV file of a picture folder and of a run folder.

Lengths are written to 0.1 mm; 12 decimals of a quaternion are 0.4 microarcseconds. The "z" of a
form writes what rounds to zero without a sign.
"""

from dataclasses import replace

from catalog.tables import CsvColumn, CsvTable

POSITION = ("x_m", "y_m", "z_m")
QUATERNION = ("qw", "qx", "qy", "qz")
SUN = ("sun_x", "sun_y", "sun_z")
RANGE = ("range_m", "range_sigma_m")
COVARIANCE = ("cov_xx_m2", "cov_xy_m2", "cov_xz_m2", "cov_yy_m2", "cov_yz_m2", "cov_zz_m2")
ERRORS = ("error_r_m", "error_n_m", "error_b_m")
SIGMAS = ("sigma_r_m", "sigma_n_m", "sigma_b_m")


def text(name: str, meaning: str, empty: bool = False) -> CsvColumn:
    """A column of words."""
    return CsvColumn(name, meaning, "text", empty=empty)


def count(name: str, meaning: str, empty: bool = True, newer: bool = False) -> CsvColumn:
    """A column of whole numbers."""
    return CsvColumn(name, meaning, "count", empty=empty, newer=newer)


def number(
    name: str, meaning: str, unit: str, form: str, empty: bool = True, newer: bool = False
) -> CsvColumn:
    """A column of real numbers."""
    return CsvColumn(name, meaning, "number", unit, form, empty, newer)


def _position(what: str, form: str, empty: bool = True) -> list[CsvColumn]:
    return [number(name, f"{what}, body frame, {name[0]}", "m", form, empty) for name in POSITION]


def _quaternion(what: str, form: str, empty: bool = True) -> list[CsvColumn]:
    what = f"{what}: quaternion of the rotation that run.toml names as `attitude`"
    return [number(name, f"{what}, {name[1]}", "", form, empty) for name in QUATERNION]


def _pixel(name: str, meaning: str, empty: bool = True, newer: bool = False) -> list[CsvColumn]:
    names = [(f"{name}_{i}_px", f"{meaning}, {i}") for i in "xy"]
    return [number(*words, "px", "z.4f", empty, newer) for words in names]


FILE = text("file", "name of the picture, relative to the picture folder")
UTC = text("utc", "time, UTC, as 2023-08-17T05:23:10.250Z")
CAMERA = text("camera", "name of the camera, that of a file in cameras/")
PREDICTED = count("n_predicted", "control points expected in view, lit, unhidden, inside")
MATCHED = count("n_matched", "of these, matched")
USED = count("n_used", "of these, used by the solution")
STATUS = text("status", "solved or unsolved")
METHOD = text("method", "method that solved the frame, or the last one tried", empty=True)
REASON = text("reason", "why unsolved, unused or retired, or a remark", empty=True)
REASON_CODE = CsvColumn("reason_code", "code of that reason", "text", empty=True, newer=True)

# Of frames.csv and solution.csv, where people add it.
UTC_SIGMA = replace(number("utc_sigma_s", "1 sigma of utc", "s", ".6g"), newer=True)
TO_SUN = "unit vector to the Sun, body frame"
FRAMES = CsvTable(
    (
        *(FILE, UTC, CAMERA, *_quaternion("attitude", ".12f")),
        number("attitude_sigma_arcsec", "1 sigma per axis; 0: exact, empty: free", "arcsec", ".6g"),
        *_position("prior position of the camera", ".4f"),
        number("position_sigma_m", "1 sigma of the prior position per component", "m", ".6g"),
        *(number(name, f"{TO_SUN}, {name[-1]}; empty: from the time", "", ".12f") for name in SUN),
        number("range_m", "altimeter: slant range along its beam", "m", ".4f", newer=True),
        number("range_sigma_m", "1 sigma of the range; over 0", "m", ".6g", newer=True),
    ),
    by_hand=True,
    together=(QUATERNION, POSITION, SUN, RANGE),
)

PICKED_POINTS = CsvTable(
    (
        FILE,
        *(number(f"{i}_px", f"the point in the picture, {i}", "px", ".4f", False) for i in "xy"),
        number("lat_deg", "its latitude, as `[points]` of run.toml says", "deg", ".9f", False),
        number("lon_deg", "its longitude, east positive", "deg", ".9f", False),
        number("height_m", "its height, as `[points]` of run.toml says", "m", ".4f", False),
        number("sigma_px", "1 sigma of the pick per coordinate; over 0", "px", ".6g", False),
        number("sigma_m", "1 sigma of its coordinates, each; 0: exact", "m", ".6g", False),
        text("name", "point name, unique per picture; empty: its number", empty=True),
    ),
    by_hand=True,
)

STAR_FRAMES = CsvTable(
    (
        *(FILE, text("utc", f"{UTC.meaning}; empty: J2025", empty=True), CAMERA),
        *_position("position where known: speed of an orbit there", ".4f"),
    ),
    by_hand=True,
    together=(POSITION,),
)

ATTITUDES = CsvTable(
    (
        *(FILE, text("utc", UTC.meaning, empty=True), STATUS),
        *(
            number(name, f"quaternion camera_from_inertial, {name[1]}", "", "z.15f")
            for name in QUATERNION
        ),
        *(
            number(f"sigma_{i}_arcsec", f"1 sigma about the camera's {i}", "arcsec", "z.4f")
            for i in "xyz"
        ),
        count("n_spots", "spots of light in the picture"),
        count("n_matched", "spots matched to a star"),
        count("n_used", "matched spots used"),
        number("residual_rms_px", "rms of the residuals, per coordinate", "px", "z.5f"),
        number("focal_scale", "focal length over the stated one", "", "z.7f"),
        number("chance", "expected number of chance attitudes as good", "", ".3g"),
        REASON,
    )
)

TIMES = CsvTable((FILE, UTC), by_hand=True)
TIMES_AND_CAMERAS = CsvTable((FILE, UTC, CAMERA))

TRUTH = CsvTable(
    (
        *(FILE, UTC, *_position("position", ".4f", empty=False)),
        *_quaternion("attitude", ".12f"),
    ),
    by_hand=True,
)

STAR_TRUTH = CsvTable(
    (
        *(FILE, text("utc", UTC.meaning, empty=True)),
        *_quaternion("attitude", ".12f", empty=False),
    ),
    by_hand=True,
)

MEASURED = CsvTable(
    (
        *(FILE, text("quantity", "what was measured")),
        text("unit", "of the error and its sigma"),
        number("error", "measured less true", "", ".6g"),
        number("sigma", "its stated 1 sigma", "", ".6g"),
    )
)

SOLUTION = CsvTable(
    (
        *(FILE, UTC, STATUS, METHOD, *_position("position", "z.4f")),
        *(
            number(name, f"covariance of the position, {name[4:6]}", "m²", ".9e")
            for name in COVARIANCE
        ),
        *_quaternion("attitude", "z.15f"),
        number("attitude_sigma_arcsec", "1 sigma per axis; 0: exact", "arcsec", "z.6f"),
        number("lat_deg", "planetocentric latitude", "deg", "z.9f"),
        number("lon_deg", "longitude, -180 to 180, east positive", "deg", "z.9f"),
        number("height_m", "height above the reference sphere", "m", "z.4f"),
        *(PREDICTED, MATCHED, USED),
        number("residual_rms_px", "rms of the residuals, per coordinate", "px", "z.5f"),
        text(
            "prior",
            "source of the prior: frames.csv, orbit, a method, camera or arc",
            empty=True,
        ),
        count("n_limb", "limb points used"),
        number("arc_deg", "their extent about the nadir", "deg", "z.2f"),
        *(REASON, REASON_CODE),
        count("n_windows", "terrain windows used in a descent", newer=True),
        count("n_landmarks", "landmarks used in a descent", newer=True),
        CsvColumn(
            "attitude_source",
            "source of the attitude: frames.csv, stars or points",
            "text",
            empty=True,
            newer=True,
        ),
    )
)

# Further columns of solution.csv: of a run whose body is a spheroid; whose lens is estimated.
SOLUTION_SPHEROID = CsvTable(
    (
        number("lat_geodetic_deg", "geodetic latitude", "deg", "z.9f", newer=True),
        number("height_ellipsoid_m", "height above the body's ellipsoid", "m", "z.4f", newer=True),
    )
)
LENS_SHIFT = ("principal_shift_x_px", "principal_shift_y_px")
LENS_SHIFT_SIGMA = ("principal_shift_sigma_x_px", "principal_shift_sigma_y_px")
SOLUTION_LENS = CsvTable(
    (
        number("focal_scale", "focal length over the stated one", "", "z.7f", newer=True),
        number("focal_scale_sigma", "its 1 sigma", "", "z.7f", newer=True),
        *_pixel("principal_shift", "principal point less the stated one", newer=True),
        *_pixel("principal_shift_sigma", "its 1 sigma", newer=True),
    )
)

MATCHES = CsvTable(
    (
        FILE,
        text("catalog", "file name of the catalog", empty=True),
        text("id", "id in the catalog, or a picked point's name"),
        count("level", "pyramid level of the last match, 0 is the finest", empty=False),
        number("lat_deg", "planetocentric latitude", "deg", "z.9f", empty=False),
        number("lon_deg", "longitude, -180 to 180, east positive", "deg", "z.9f", empty=False),
        number("radius_m", "distance from the body's centre", "m", "z.4f", empty=False),
        *_pixel("predicted", "predicted from the final pose", empty=False),
        *_pixel("measured", "position of the match"),
        number("score", "correlation of the best match", "", "z.5f"),
        number("runner_up", "correlation of the best rival", "", "z.5f"),
        number("sun_elevation_deg", "Sun elevation at the point", "deg", "z.4f"),
        *_pixel("residual", "measured less predicted, after the solution"),
        CsvColumn("used", "whether the solution uses it", "flag"),
        REASON,
        REASON_CODE,
        *_pixel("prior", "predicted from the prior", newer=True),
        CsvColumn(
            "kind",
            "control_point, window, landmark or picked_point; empty: control_point",
            "text",
            empty=True,
            newer=True,
        ),
    )
)

GROUND_COVARIANCE = ("cov_ee_m2", "cov_en_m2", "cov_eu_m2", "cov_nn_m2", "cov_nu_m2", "cov_uu_m2")
LANDMARKS = CsvTable(
    (
        count("id", "number of the landmark", empty=False),
        text("first_file", "first picture"),
        text("last_file", "last picture"),
        count("n_seen", "pictures that show it", empty=False),
        number("lat_deg", "planetocentric latitude", "deg", "z.9f", empty=False),
        number("lon_deg", "longitude, -180 to 180, east positive", "deg", "z.9f", empty=False),
        number("radius_m", "distance from the body's centre", "m", "z.4f", empty=False),
        *(
            number(name, f"last covariance (east, north, up), {name[4:6]}", "m²", ".9e", False)
            for name in GROUND_COVARIANCE
        ),
        text("status", "tracked to the end, or retired"),
        REASON,
    )
)

ADJUSTED_MATCHES = CsvTable(
    (
        *MATCHES.columns,
        *_pixel("stated", "measured less predicted from the stated pose"),
        *_pixel("constants", "the same with what is common to the frames"),
        number("weight", "of the match, 0 to 1", "", "z.4f"),
    )
)

COMMON_NUMBERS = CsvTable(
    (
        text("name", "what it is a part of, as --solve names it"),
        text("camera", "of one of a camera: its name", empty=True),
        text("axis", "x, y or z of a vector", empty=True),
        number("value", "as found", "", ".9g", empty=False),
        number("sigma", "its 1 sigma", "", ".6g", empty=False),
        number("prior_sigma", "1 sigma before the frames were looked at", "", ".6g", empty=False),
        text("unit", "of the three", empty=True),
        CsvColumn("observed", "whether the frames tell it from its prior and the others", "flag"),
    )
)

EVALUATION = CsvTable(
    (
        *(FILE, UTC, STATUS, METHOD),
        replace(CAMERA, empty=True),
        text("forward", "definition of the axis N: motion, or local north"),
        number("truth_height_m", "true height above the reference sphere", "m", "z.3f"),
        *(
            number(name, f"solution less truth along {name[6].upper()}", "m", "z.3f")
            for name in ERRORS
        ),
        *(number(name, f"stated sigma along {name[6].upper()}", "m", "z.3f") for name in SIGMAS),
        number("range_error_percent", "error along R, share of the true height", "%", "z.6f"),
        number("range_sigma_percent", "its stated sigma", "%", "z.6f"),
        number("direction_error_arcsec", "error of the direction to the centre", "arcsec", "z.4f"),
        number("direction_sigma_arcsec", "its stated rms", "arcsec", "z.4f"),
        number(
            "normalised_error_squared",
            "error squared over its covariance; 3 is expected",
            "",
            "z.6f",
        ),
        number("attitude_error_arcsec", "rotation angle of the attitude error", "arcsec", "z.4f"),
        *(PREDICTED, MATCHED, USED),
        count("n_wrong", "of these, more than 3 px from the truth"),
        *(REASON, REASON_CODE),
    )
)

HEIGHTS = CsvTable(
    (
        text("file_left", "picture of the first [[mount]]", empty=True),
        text("file_right", "picture of the second [[mount]]", empty=True),
        UTC,
        number("height_m", "height of the ship over the mean ground", "m", "z.4f"),
        number("sigma_m", "1 sigma from noise and relief", "m", "z.5f"),
        number("sigma_mounting_m", "1 sigma from the mounting, common to all rows", "m", "z.5f"),
        count("n_windows", "windows used; they overlap"),
        number("velocity_x_m_s", "velocity since the previous pair, ship frame, x", "m/s", "z.5f"),
        number("velocity_y_m_s", "velocity since the previous pair, ship frame, y", "m/s", "z.5f"),
        number("velocity_sigma_m_s", "1 sigma of the velocity per component", "m/s", "z.5f"),
        *(STATUS, REASON),
    )
)

ORTHO = CsvTable(
    (
        FILE,
        STATUS,
        text("ortho", "its map, a GeoTIFF: counts, and horizontal 1 sigma in m", empty=True),
        number("lat_deg", "planetocentric latitude of the map's centre", "deg", "z.9f"),
        number("lon_deg", "its longitude, -180 to 180, east positive", "deg", "z.9f"),
        number("posting_m", "size of a map pixel", "m", "z.4f"),
        number("covered", "share of map pixels with a value", "", "z.4f"),
        number("sigma_median_m", "1 sigma a horizontal axis, median", "m", "z.4f"),
        number("sigma_max_m", "the same, largest", "m", "z.4f"),
        REASON,
    )
)

JUDGED_PADS = CsvTable(
    (
        FILE,
        count("square_row", "row of the square, from the upper left", empty=False),
        count("square_col", "column of the square", empty=False),
        number("lat_deg", "planetocentric latitude", "deg", "z.9f", empty=False),
        number("lon_deg", "longitude, -180 to 180, east positive", "deg", "z.9f", empty=False),
        number("expected_dangerous_share", "expected share above 7 deg", "", "z.5f"),
        number("dangerous_share", "its share above 7 deg, by the truth", "", "z.5f", empty=False),
        number("critical_share", "its share above 15 deg", "", "z.5f", empty=False),
        number("rms_slope_deg", "rms slope", "deg", "z.3f", empty=False),
    )
)

RISK_OF_PAD = (
    number("expected_dangerous_share", "expected share above 7 deg", "", "z.5f"),
    number("expected_critical_share", "expected share above 15 deg", "", "z.5f"),
    number("shadow_share", "share in shadow", "", "z.5f"),
    number("mean_slope_deg", "mean slope", "deg", "z.3f"),
    number("prior_slope_deg", "mean slope by --slopes or --dem", "deg", "z.3f"),
    count("n_rocks", "rocks on it; empty: not looked for", newer=True),
    number("rock_share", "share within 1.5 m of rocks", "", "z.5f", newer=True),
)

PADS = CsvTable(
    (
        FILE,
        count("square_row", "row of the square from the upper left"),
        count("square_col", "column of the square"),
        *(number(f"{axis}_px", f"centre of the pad, {axis}", "px", "z.3f") for axis in "xy"),
        number("lat_deg", "planetocentric latitude", "deg", "z.9f"),
        number("lon_deg", "longitude, -180 to 180, east positive", "deg", "z.9f"),
        *RISK_OF_PAD,
        *(
            number(f"dir_{frame}_{i}", f"direction to the pad, {frame} frame, {i}", "", "z.9f")
            for frame in ("camera", "body")
            for i in "xyz"
        ),
        REASON,
    )
)

CARRIED_PADS = CsvTable(
    (
        count("id", "number of the pad", empty=False),
        text("first_file", "first picture"),
        FILE,
        count("n_seen", "pictures that show it", empty=False),
        number("lat_deg", "planetocentric latitude", "deg", "z.9f", empty=False),
        number("lon_deg", "longitude, -180 to 180, east positive", "deg", "z.9f", empty=False),
        number("height_m", "height above the reference sphere", "m", "z.3f", empty=False),
        number("sigma_east_m", "1 sigma of its place, east", "m", "z.4f", empty=False),
        number("sigma_north_m", "1 sigma of its place, north", "m", "z.4f", empty=False),
        number("correlation", "of east and north", "", "z.5f", empty=False),
        number("moved_m", "from its first place", "m", "z.3f", empty=False),
        *(number(f"{axis}_px", f"centre of the pad, {axis}", "px", "z.3f") for axis in "xy"),
        *RISK_OF_PAD,
        text("status", "carried or given_up"),
        REASON,
    )
)

ROCKS = CsvTable(
    (
        FILE,
        *(number(f"{axis}_px", f"its foot in the picture, {axis}", "px", "z.3f") for axis in "xy"),
        number("lat_deg", "planetocentric latitude", "deg", "z.9f"),
        number("lon_deg", "longitude, -180 to 180, east positive", "deg", "z.9f"),
        number("diameter_m", "diameter across the Sun", "m", "z.3f"),
        number("height_m", "height by its shadow", "m", "z.3f"),
        number("height_sigma_m", "1 sigma of the height", "m", "z.3f"),
        number("chance", "probability that it is a rock", "", "z.4f"),
        REASON,
    )
)

CALIBRATION_RESIDUALS = CsvTable(
    (
        *(FILE, CAMERA),
        text("catalog", "file name of the catalog", empty=True),
        count("id", "id in the catalog", empty=False),
        *_pixel("measured", "position of the match"),
        *_pixel("before", "measured less predicted, as stated"),
        *_pixel("after", "measured less predicted, calibrated"),
        number("weight", "of the match, 0 to 1", "", "z.4f"),
    )
)

CYLINDER = CsvTable(
    (
        *(FILE, UTC, STATUS),
        text("zone", "ok, full_face, crescent, glare or cut", empty=True),
        number("d_m", "distance to the nearest surface", "m", "z.5f"),
        number("d_sigma_m", "its 1 sigma", "m", "z.5f"),
        number(
            "theta_deg", "light angle at the axis from the camera, positive right", "deg", "z.4f"
        ),
        number("theta_sigma_deg", "its 1 sigma", "deg", "z.4f"),
        number(
            "bearing_deg", "bearing of the axis from the boresight, positive right", "deg", "z.4f"
        ),
        number("vx_m_s", "velocity of the camera towards the light", "m/s", "z.5f"),
        number("vy_m_s", "velocity across, towards growing theta", "m/s", "z.5f"),
        number("v_sigma_m_s", "1 sigma of the velocity per component", "m/s", "z.5f"),
        REASON,
    )
)

CYLINDER_TRUTH = CsvTable(
    (
        *(FILE, text("utc", UTC.meaning, empty=True)),
        number("d_m", "true distance to the nearest surface", "m", "z.5f", empty=False),
        number("theta_deg", "true angle of the light", "deg", "z.4f"),
        number("bearing_deg", "true bearing of the axis", "deg", "z.4f"),
        number("vx_m_s", "true velocity to the light", "m/s", "z.5f"),
        number("vy_m_s", "true velocity across", "m/s", "z.5f"),
    ),
    by_hand=True,
)
