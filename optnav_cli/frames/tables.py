"""The columns of every CSV file of a picture folder and of a run folder.

Lengths are written to 0.1 mm; 12 decimals of a quaternion are 0.4 microarcseconds. The "z" of a
form writes what rounds to zero without a sign.
"""

from catalog.tables import CsvColumn, CsvTable

POSITION = ("x_m", "y_m", "z_m")
QUATERNION = ("qw", "qx", "qy", "qz")
SUN = ("sun_x", "sun_y", "sun_z")
COVARIANCE = ("cov_xx_m2", "cov_xy_m2", "cov_xz_m2", "cov_yy_m2", "cov_yz_m2", "cov_zz_m2")
ERRORS = ("error_r_m", "error_n_m", "error_b_m")
SIGMAS = ("sigma_r_m", "sigma_n_m", "sigma_b_m")


def _text(name: str, meaning: str, empty: bool = False) -> CsvColumn:
    return CsvColumn(name, meaning, "text", empty=empty)


def _count(name: str, meaning: str, empty: bool = True, newer: bool = False) -> CsvColumn:
    return CsvColumn(name, meaning, "count", empty=empty, newer=newer)


def _number(
    name: str, meaning: str, unit: str, form: str, empty: bool = True, newer: bool = False
) -> CsvColumn:
    return CsvColumn(name, meaning, "number", unit, form, empty, newer)


def _position(what: str, form: str, empty: bool = True) -> list[CsvColumn]:
    return [_number(name, f"{what}, body frame, {name[0]}", "m", form, empty) for name in POSITION]


def _quaternion(what: str, form: str, empty: bool = True) -> list[CsvColumn]:
    what = f"{what}: quaternion of the rotation that run.toml names as `attitude`"
    return [_number(name, f"{what}, {name[1]}", "", form, empty) for name in QUATERNION]


def _pixel(name: str, meaning: str, empty: bool = True, newer: bool = False) -> list[CsvColumn]:
    names = [(f"{name}_{i}_px", f"{meaning}, {i}") for i in "xy"]
    return [_number(*words, "px", "z.4f", empty, newer) for words in names]


FILE = _text("file", "name of the picture, relative to the picture folder")
UTC = _text("utc", "time of the picture, UTC, as 2023-08-17T05:23:10.250Z")
CAMERA = _text("camera", "name of the camera, that of a file in cameras/")
PREDICTED = _count("n_predicted", "control points expected in view, lit, unhidden, inside")
MATCHED = _count("n_matched", "of these, found: the matcher accepts a place")
USED = _count("n_used", "of these, kept by the solution")
STATUS = _text("status", "solved or unsolved")
METHOD = _text("method", "how the frame was solved, or how far it got", empty=True)
REASON = _text("reason", "why a frame is unsolved, or a remark", empty=True)
REASON_CODE = CsvColumn(
    "reason_code", "the code of that reason, for programs", "text", empty=True, newer=True
)

TO_SUN = "unit vector to the Sun, body frame"
FRAMES = CsvTable(
    (
        *(FILE, UTC, CAMERA, *_quaternion("attitude", ".12f")),
        _number("attitude_sigma_arcsec", "1 sigma an axis; 0: exact, empty: free", "arcsec", ".6g"),
        *_position("prior position of the camera", ".4f"),
        _number("position_sigma_m", "1 sigma of the prior position, a component", "m", ".6g"),
        *(_number(name, f"{TO_SUN}, {name[-1]}; empty: by the time", "", ".12f") for name in SUN),
    ),
    by_hand=True,
    together=(QUATERNION, POSITION, SUN),
)

PICKED_POINTS = CsvTable(
    (
        FILE,
        *(_number(f"{i}_px", f"the point in the picture, {i}", "px", ".4f", False) for i in "xy"),
        _number("lat_deg", "its latitude, as `[points]` of run.toml says", "deg", ".9f", False),
        _number("lon_deg", "its longitude, east positive", "deg", ".9f", False),
        _number("height_m", "its height, as `[points]` of run.toml says", "m", ".4f", False),
        _number("sigma_px", "1 sigma of the pick, a coordinate; over 0", "px", ".6g", False),
        _number("sigma_m", "1 sigma of the place, a coordinate; 0: exact", "m", ".6g", False),
        _text("name", "of the point, once in a picture; empty: its number", empty=True),
    ),
    by_hand=True,
)

STAR_FRAMES = CsvTable(
    (FILE, _text("utc", f"{UTC.meaning}; empty: J2025", empty=True), CAMERA), by_hand=True
)

ATTITUDES = CsvTable(
    (
        *(FILE, _text("utc", UTC.meaning, empty=True), STATUS),
        *(
            _number(name, f"camera_from_inertial as a quaternion, {name[1]}", "", "z.15f")
            for name in QUATERNION
        ),
        *(
            _number(f"sigma_{i}_arcsec", f"1 sigma about the camera's {i}", "arcsec", "z.4f")
            for i in "xyz"
        ),
        _count("n_spots", "spots of light in the picture"),
        _count("n_matched", "of these, with a star of the catalog"),
        _count("n_used", "of these, kept by the attitude"),
        _number("residual_rms_px", "rms of their residuals, a coordinate", "px", "z.5f"),
        _number("focal_scale", "focal length over that of the camera file", "", "z.7f"),
        _number("chance", "expected number of attitudes that chance gives so well", "", ".3g"),
        REASON,
    )
)

TIMES = CsvTable((FILE, UTC), by_hand=True)
TIMES_AND_CAMERAS = CsvTable((FILE, UTC, CAMERA))

TRUTH = CsvTable(
    (
        *(FILE, UTC, *_position("true position of the camera", ".4f", empty=False)),
        *_quaternion("true attitude", ".12f", empty=False),
    ),
    by_hand=True,
)

SOLUTION = CsvTable(
    (
        *(FILE, UTC, STATUS, METHOD, *_position("position of the camera", "z.4f")),
        *(
            _number(name, f"covariance of the position, {name[4:6]}", "m²", ".9e")
            for name in COVARIANCE
        ),
        *_quaternion("attitude used or solved for", "z.15f"),
        _number("attitude_sigma_arcsec", "its 1 sigma an axis; 0: exact", "arcsec", "z.6f"),
        _number("lat_deg", "latitude below the camera, planetocentric", "deg", "z.9f"),
        _number("lon_deg", "longitude below the camera, -180 to 180, east positive", "deg", "z.9f"),
        _number("height_m", "height above the body's reference sphere", "m", "z.4f"),
        *(PREDICTED, MATCHED, USED),
        _number("residual_rms_px", "rms of the residuals, a coordinate", "px", "z.5f"),
        _text(
            "prior",
            "where the search began: frames.csv, orbit, a method, camera or arc",
            empty=True,
        ),
        _count("n_limb", "limb points that the solution rests on"),
        _number("arc_deg", "of the limb that they cover, about the nadir", "deg", "z.2f"),
        *(REASON, REASON_CODE),
        _count("n_windows", "windows of the terrain model that a descent keeps", newer=True),
        _count("n_landmarks", "landmarks that it keeps", newer=True),
        CsvColumn(
            "attitude_source",
            "what the attitude is from: frames.csv, stars, or points",
            "text",
            empty=True,
            newer=True,
        ),
    )
)

MATCHES = CsvTable(
    (
        FILE,
        _text("catalog", "file name of the control point's catalog", empty=True),
        _text("id", "the control point's id in its catalog, or a picked point's name"),
        _count("level", "pyramid level of the last match, 0 is the finest", empty=False),
        _number("lat_deg", "the point's latitude, planetocentric", "deg", "z.9f", empty=False),
        _number("lon_deg", "its longitude, -180 to 180, east positive", "deg", "z.9f", empty=False),
        _number("radius_m", "its distance from the body's centre", "m", "z.4f", empty=False),
        *_pixel("predicted", "where the final pose predicts it", empty=False),
        *_pixel("measured", "where it was found; empty where it was not"),
        _number("score", "correlation of the best match", "", "z.5f"),
        _number("runner_up", "correlation of the best rival", "", "z.5f"),
        _number("sun_elevation_deg", "the Sun above the point's horizon", "deg", "z.4f"),
        *_pixel("residual", "measured less predicted, after the solution"),
        CsvColumn("used", "whether the solution keeps it", "flag"),
        _text("reason", "why not", empty=True),
        REASON_CODE,
        *_pixel("prior", "where the pose predicted it from which the search began", newer=True),
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
        _count("id", "the landmark's number", empty=False),
        _text("first_file", "the picture in which it was chosen"),
        _text("last_file", "the last one in which it was found"),
        _count("n_seen", "pictures in which it was found, the first one too", empty=False),
        _number("lat_deg", "its latitude, planetocentric", "deg", "z.9f", empty=False),
        _number("lon_deg", "its longitude, -180 to 180, east positive", "deg", "z.9f", empty=False),
        _number("radius_m", "its distance from the body's centre", "m", "z.4f", empty=False),
        *(
            _number(
                name, f"covariance at its end, {name[4:6]}: east, north, up", "m²", ".9e", False
            )
            for name in GROUND_COVARIANCE
        ),
        _text("status", "tracked to the end, or retired"),
        _text("reason", "why it was retired", empty=True),
    )
)

ADJUSTED_MATCHES = CsvTable(
    (
        *MATCHES.columns,
        *_pixel("stated", "measured less predicted from the stated pose"),
        *_pixel("constants", "the same with what is common to the frames"),
        _number("weight", "of the match, 0 to 1", "", "z.4f"),
    )
)

COMMON_NUMBERS = CsvTable(
    (
        _text("name", "what it is a part of, as --solve names it"),
        _text("camera", "of one of a camera: its name", empty=True),
        _text("axis", "x, y or z of a vector", empty=True),
        _number("value", "as found", "", ".9g", empty=False),
        _number("sigma", "its 1 sigma", "", ".6g", empty=False),
        _number("prior_sigma", "1 sigma before the frames were looked at", "", ".6g", empty=False),
        _text("unit", "of the three", empty=True),
        CsvColumn("observed", "whether the frames tell it from its prior and the others", "flag"),
    )
)

EVALUATION = CsvTable(
    (
        *(FILE, UTC, STATUS, METHOD),
        _text("camera", "name of the camera, where it is known", empty=True),
        _text("forward", "what the axis N rests on: motion, or local north"),
        _number("truth_height_m", "true height above the reference sphere", "m", "z.3f"),
        *(_number(name, f"error along {name[6].upper()}", "m", "z.3f") for name in ERRORS),
        *(_number(name, f"stated sigma along {name[6].upper()}", "m", "z.3f") for name in SIGMAS),
        _number("range_error_percent", "error along R, of the true height", "%", "z.6f"),
        _number("range_sigma_percent", "its stated sigma", "%", "z.6f"),
        _number("direction_error_arcsec", "error of the direction to the centre", "arcsec", "z.4f"),
        _number("direction_sigma_arcsec", "its stated rms", "arcsec", "z.4f"),
        _number("normalised_error_squared", "over its covariance; 3 is expected", "", "z.6f"),
        _number("attitude_error_arcsec", "angle of the attitude's error", "arcsec", "z.4f"),
        *(PREDICTED, MATCHED, USED),
        _count("n_wrong", "of these, more than 3 px from the truth"),
        *(REASON, REASON_CODE),
    )
)

HEIGHTS = CsvTable(
    (
        _text("file_left", "picture of the camera of the first [[mount]]", empty=True),
        _text("file_right", "picture of that of the second", empty=True),
        UTC,
        _number("height_m", "of the ship over the mean ground below it", "m", "z.4f"),
        _number("sigma_m", "its 1 sigma by the windows: noise, and relief", "m", "z.5f"),
        _number("sigma_mounting_m", "what the mounting's error adds, in all rows", "m", "z.5f"),
        _count("n_windows", "windows that the height rests on; they overlap"),
        _number("velocity_x_m_s", "against the pair before, ship frame, x", "m/s", "z.5f"),
        _number("velocity_y_m_s", "the same, y", "m/s", "z.5f"),
        _number("velocity_sigma_m_s", "1 sigma of these, a component", "m/s", "z.5f"),
        *(STATUS, REASON),
    )
)

JUDGED_PADS = CsvTable(
    (
        FILE,
        _count("square_row", "row of the square, from the upper left", empty=False),
        _count("square_col", "column of the square", empty=False),
        _number("lat_deg", "the pad's latitude, planetocentric", "deg", "z.9f", empty=False),
        _number("lon_deg", "its longitude, -180 to 180, east positive", "deg", "z.9f", empty=False),
        _number("expected_dangerous_share", "expected share above 7 deg", "", "z.5f"),
        _number("dangerous_share", "its share above 7 deg, by the truth", "", "z.5f", empty=False),
        _number("critical_share", "its share above 15 deg", "", "z.5f", empty=False),
        _number("rms_slope_deg", "rms slope", "deg", "z.3f", empty=False),
    )
)

PADS = CsvTable(
    (
        FILE,
        _count("square_row", "row of the square, from the upper left; empty: no squares"),
        _count("square_col", "column of the square"),
        *(
            _number(f"{axis}_px", f"the pad's middle in the picture, {axis}", "px", "z.3f")
            for axis in "xy"
        ),
        _number("lat_deg", "its latitude, planetocentric; empty without a pose", "deg", "z.9f"),
        _number("lon_deg", "its longitude, -180 to 180, east positive", "deg", "z.9f"),
        _number("expected_dangerous_share", "expected share above 7 deg", "", "z.5f"),
        _number("expected_critical_share", "expected share above 15 deg", "", "z.5f"),
        _number("shadow_share", "share in shadow", "", "z.5f"),
        _number("mean_slope_deg", "mean slope", "deg", "z.3f"),
        _number("prior_slope_deg", "mean slope by --slopes", "deg", "z.3f"),
        *(
            _number(f"dir_camera_{i}", f"direction to it, camera frame, {i}", "", "z.9f")
            for i in "xyz"
        ),
        *(_number(f"dir_body_{i}", f"the same, body frame, {i}", "", "z.9f") for i in "xyz"),
        _text("reason", "why the square has no pad", empty=True),
    )
)

CALIBRATION_RESIDUALS = CsvTable(
    (
        *(FILE, CAMERA),
        _text("catalog", "file name of the control point's catalog", empty=True),
        _count("id", "the control point's id in its catalog", empty=False),
        *_pixel("measured", "where it was found"),
        *_pixel("before", "measured less predicted, all as stated"),
        *_pixel("after", "the same after the calibration"),
        _number("weight", "of the match, 0 to 1", "", "z.4f"),
    )
)

INERTIAL = tuple(f"inertial_{name}" for name in (*POSITION, "vx_m_s", "vy_m_s", "vz_m_s"))
BODY_STATE = (*POSITION, "vx_m_s", "vy_m_s", "vz_m_s")


def _states(what: str, empty: bool = True) -> list[CsvColumn]:
    """Six columns each of a state: body-fixed, and inertial."""
    found = []
    for frame, names in (("body frame", BODY_STATE), ("inertial", INERTIAL)):
        for name in names:
            kind, unit = ("velocity", "m/s") if name.endswith("_s") else ("position", "m")
            meaning = f"{kind} {what}, {frame}, {name.removeprefix('inertial_').lstrip('v')[0]}"
            found.append(_number(name, meaning, unit, "z.6f" if unit == "m/s" else "z.3f", empty))
    return found


QSO = CsvTable(
    (
        _count("orbit", "number of the orbit, from 1; its file is orbit_NUMBER.oem", empty=False),
        _number("distance_km", "asked for, from the surface", "km", ".6g", empty=False),
        _number("longitude_deg", "of the passes, east", "deg", ".6g", empty=False),
        _text("utc", "of the start"),
        _number("anomaly_deg", "mean anomaly of the moon then", "deg", "z.3f", empty=False),
        *(STATUS, *_states("at the start")),
        _number("radius_km", "of the start, from the centre", "km", "z.4f"),
        _number("spread_km", "largest difference of a pass from the start", "km", "z.4f"),
        _number("ring_km", "distance of the farthest pass less the nearest", "km", "z.4f"),
        _number("theory_spread_km", "the first of these of the averaged theory's", "km", "z.4f"),
        _number("rate", "revolutions a revolution of the moon, less 1, mean", "", "z.5f"),
        _number("rate_min", "of the slowest revolution", "", "z.5f"),
        _number("rate_max", "of the quickest", "", "z.5f"),
        _number("theory_rate", "by the averaged theory", "", "z.5f"),
        _number("theory_dv_m_s", "velocity of the start less that of the theory", "m/s", "z.4f"),
        _count("passes", "of the longitude, the start among them"),
        _count("trials", "flights that the search took"),
        REASON,
    )
)

QSO_PASSES = CsvTable(
    (
        _count("orbit", "number of the orbit", empty=False),
        _count("pass", "number of the pass; 0 is the start", empty=False),
        _text("utc", "of the pass"),
        _number("distance_km", "from the surface over the longitude", "km", "z.4f", empty=False),
        _number("rate", "of the revolution before it, less 1", "", "z.5f"),
        *_states("then", empty=False),
    )
)

QSO_PATHS = CsvTable(
    (
        _count("orbit", "number of the orbit", empty=False),
        _text("kind", "orbit, or theory: from the first velocity of the averaged theory"),
        _number("seconds", "since the start", "s", ".6g", empty=False),
        _number("x_km", "turning frame: away from the planet", "km", "z.3f", empty=False),
        _number("y_km", "the same: along the moon's motion", "km", "z.3f", empty=False),
        _number("z_km", "the same: up", "km", "z.3f", empty=False),
    )
)

LANDING = CsvTable(
    (
        _count("trial", "number of the trial, from 1", empty=False),
        STATUS,
        _number("arrival_error_m", "of the navigation at the arrival over the target", "m", "z.3f"),
        _number("arrival_sigma_m", "its stated 1 sigma, a length", "m", "z.3f"),
        _number("arrival_error_m_s", "of the velocity then", "m/s", "z.5f"),
        _number("arrival_nees", "errors squared over their covariance, over 6", "", "z.3f"),
        _count("steps", "of the fit that took most"),
        _count("starts", "of that fit: more than one after a wrong minimum"),
        _number(
            "end_height_error_m", "of the navigation at the altimeter's last height", "m", "z.3f"
        ),
        _number("end_side_error_m", "the same, across", "m", "z.3f"),
        _number("end_down_error_m_s", "the same, velocity along up", "m/s", "z.5f"),
        _number("end_side_error_m_s", "the same, velocity across", "m/s", "z.5f"),
        _number("end_nees", "the same, errors squared over their covariance, over 6", "", "z.3f"),
        _number("east_m", "touchdown, east of the target", "m", "z.3f"),
        _number("north_m", "touchdown, north of it", "m", "z.3f"),
        _number("down_m_s", "velocity down at the touchdown", "m/s", "z.4f"),
        _number("side_m_s", "velocity across then", "m/s", "z.4f"),
        _number("dv_m_s", "of all burns, without what holds the craft up", "m/s", "z.3f"),
        REASON,
    )
)

LANDING_IMPULSE = CsvTable(
    (
        _count("step", "of Newton's method", empty=False),
        *(
            _number(f"dv_{i}_m_s", f"its change of the impulse, inertial, {i}", "m/s", ".9g")
            for i in "xyz"
        ),
        _number("left_m_s", "of the impulse still to find after it", "m/s", ".6g", empty=False),
    )
)

LANDING_PATH = CsvTable(
    (
        _text("kind", "transfer, descent (of the first trial), ground, or beam (two rows each)"),
        _number("seconds", "since the departure", "s", ".6g"),
        _number("along_km", "level, towards the target in the plane of the transfer", "km", "z.5f"),
        _number("up_km", "over the target", "km", "z.5f"),
        _number("side_km", "across that plane", "km", "z.5f"),
    )
)

_AIM = (("xi_km", "xi", "km"), ("eta_km", "eta", "km"), ("tau_s", "time of the pericentre", "s"))

DELIVERY_STAGES = CsvTable(
    (
        _text("stage", "injection, correction NUMBER, or arrival: the errors before it"),
        _number("day", "since the start", "d", ".6g", empty=False),
        _number("condition", "of what velocity does to the arrival", "", ".4g"),
        *(_number(f"bound_{i}", f"largest {w} by the boxes", u, ".6g") for i, w, u in _AIM),
        *(_number(f"trials_{i}", f"99.73 % of the trials' {w}", u, ".6g") for i, w, u in _AIM),
        *(_number(f"navigation_{i}", f"1 sigma of {w} then", u, ".6g") for i, w, u in _AIM),
        _number("bound_dv_m_s", "largest change of velocity of the correction", "m/s", ".6g"),
        _number("trials_dv_m_s", "99.73 % of the trials'", "m/s", ".6g"),
        _number("largest_dv_m_s", "the largest trial's", "m/s", ".6g"),
        _count("boxes", "that hold the errors"),
    )
)

DELIVERY_BOXES = CsvTable(
    (
        _text("stage", "of stages.csv"),
        *(_number(f"{i}_from", f"{w}: the box's lower side", u, ".6g") for i, w, u in _AIM),
        *(_number(f"{i}_to", f"{w}: its upper side", u, ".6g") for i, w, u in _AIM),
        _number("spent_m_s", "the most that leads there", "m/s", ".6g", empty=False),
    )
)

DELIVERY_ARRIVALS = CsvTable(
    (
        _count("trial", "number of the trial, from 1; the first ones", empty=False),
        *(_number(i, f"{w} less the aim's", u, ".6g", empty=False) for i, w, u in _AIM),
        _number("dv_m_s", "of all corrections", "m/s", ".6g", empty=False),
    )
)

CYLINDER = CsvTable(
    (
        *(FILE, UTC, STATUS),
        _text("zone", "ok, full_face, crescent, glare or cut", empty=True),
        _number("d_m", "from the camera to the cylinder's nearest surface", "m", "z.5f"),
        _number("d_sigma_m", "its 1 sigma", "m", "z.5f"),
        _number("theta_deg", "of the light at the axis from the camera; right: +", "deg", "z.4f"),
        _number("theta_sigma_deg", "its 1 sigma", "deg", "z.4f"),
        _number("bearing_deg", "of the axis from the boresight, to the right", "deg", "z.4f"),
        _number("vx_m_s", "velocity of the camera to the light", "m/s", "z.5f"),
        _number("vy_m_s", "across, to where theta grows", "m/s", "z.5f"),
        _number("v_sigma_m_s", "1 sigma of these, a component", "m/s", "z.5f"),
        REASON,
    )
)

CYLINDER_TRUTH = CsvTable(
    (
        *(FILE, UTC),
        _number("d_m", "true distance to the nearest surface", "m", "z.5f", empty=False),
        _number("theta_deg", "true angle of the light", "deg", "z.4f", empty=False),
        _number("bearing_deg", "true bearing of the axis", "deg", "z.4f", empty=False),
        _number("vx_m_s", "true velocity to the light", "m/s", "z.5f", empty=False),
        _number("vy_m_s", "true velocity across", "m/s", "z.5f", empty=False),
    ),
    by_hand=True,
)
