"""The columns of the CSV files of `optnav orbit`. R is up, N forward, B across the motion."""

from functools import partial
from itertools import product

from catalog.tables import CsvColumn, CsvTable
from optnav_cli.frames.tables import (
    CAMERA,
    FILE,
    POSITION,
    REASON,
    STATUS,
    UTC,
    count,
    number,
    text,
)

VELOCITY = ("vx_m_s", "vy_m_s", "vz_m_s")
BODY_STATE = (*POSITION, *VELOCITY)
INERTIAL = tuple(f"inertial_{name}" for name in BODY_STATE)
AXES = ("r", "n", "b")
# The lower triangle, row by row, of the covariance of position and velocity along R, N, B.
_NAMES = (*AXES, *(f"v{axis}" for axis in AXES))
LOWER = tuple((i, j) for i, j in product(range(6), range(6)) if j <= i)
_POWERS = ("m2", "m2_s", "m2_s2")


def _format_covariance_name(i: int, j: int) -> str:
    apart = "_" if i > 2 else ""
    return f"cov_{_NAMES[i]}{apart}{_NAMES[j]}_{_POWERS[(i > 2) + (j > 2)]}"


STATE_COVARIANCE = tuple(_format_covariance_name(i, j) for i, j in LOWER)


def _make_state_columns(empty: bool = True) -> list[CsvColumn]:
    """Six columns each of a state: body-fixed, and inertial."""
    states = []
    for frame, names in (("body frame", BODY_STATE), ("inertial", INERTIAL)):
        for name in names:
            kind, unit = ("velocity", "m/s") if name.endswith("_s") else ("position", "m")
            meaning = f"{kind}, {frame}, {name.removeprefix('inertial_').lstrip('v')[0]}"
            states.append(number(name, meaning, unit, "z.6f" if unit == "m/s" else "z.3f", empty))
    return states


_filled = partial(number, empty=False)  # a number that is always there

ORBIT = CsvTable(
    (
        UTC,
        text("kind", "fix, between or prediction"),
        *(_filled(name, f"position, body frame, {name[0]}", "m", "z.4f") for name in POSITION),
        *(_filled(name, f"velocity, body frame, {name[1]}", "m/s", "z.8f") for name in VELOCITY),
        *(_filled(name, f"position, inertial, {name[9]}", "m", "z.4f") for name in INERTIAL[:3]),
        *(_filled(name, f"velocity, inertial, {name[10]}", "m/s", "z.8f") for name in INERTIAL[3:]),
        *(
            _filled(name, "covariance along R, N, B of the inertial motion", "", ".9e")
            for name in STATE_COVARIANCE
        ),
    )
)

ORBIT_RESIDUALS = CsvTable(
    (
        *(FILE, UTC, CAMERA),
        text("run", "folder of the run"),
        *(
            _filled(f"residual_{a}_m", f"fix less orbit along {a.upper()}", "m", "z.4f")
            for a in AXES
        ),
        *(_filled(f"sigma_{a}_m", f"stated sigma along {a.upper()}", "m", "z.4f") for a in AXES),
        _filled("chi_square", "normalised residual squared; 3 is expected", "", "z.4f"),
        CsvColumn("used", "whether the solution uses it", "flag"),
        REASON,
    )
)

_SIGHT = (
    UTC,
    text("type", "star_zenith"),
    _filled("ra_deg", "right ascension of the star at that time, ICRS", "deg", "z.6f"),
    _filled("dec_deg", "declination of the star", "deg", "z.6f"),
    _filled(
        "value_deg",
        "zenith distance: angle from the craft's position vector to the star, without aberration",
        "deg",
        "z.8f",
    ),
    _filled("sigma_arcsec", "1 sigma", "arcsec", ".6g"),
)

ZENITH = CsvTable(_SIGHT)

ZENITH_RESIDUALS = CsvTable(
    (
        _SIGHT[0],
        text("star", "name or Hipparcos number"),
        _filled("value_deg", "measured zenith distance", "deg", "z.8f"),
        _filled("residual_arcsec", "measured less that of the orbit", "arcsec", "z.4f"),
        _filled("sigma_arcsec", "1 sigma", "arcsec", ".6g"),
        _filled("chi_square", "normalised residual squared; 1 is expected", "", "z.4f"),
        CsvColumn("used", "whether the solution uses it", "flag"),
        REASON,
    )
)

MEASUREMENTS = CsvTable(
    (
        UTC,
        text("kind", "two_way_range_m and others; its name has the unit"),
        _filled("value", "measured, in that unit", "", "z.9f"),
        _filled("sigma", "1 sigma", "", ".6g"),
        text("station", "receiver of a signal", empty=True),
        text("transmitter", "sender, if another", empty=True),
        number("count_s", "length of the count", "s", "z.6f"),
        number("lat_deg", "point that an angle is of, if not the centre", "deg", "z.8f"),
        number("lon_deg", "its east longitude", "deg", "z.8f"),
        number("height_m", "its height over the ellipsoid", "m", "z.3f"),
    ),
    by_hand=True,
    together=(("lat_deg", "lon_deg", "height_m"),),
)

MEASUREMENT_RESIDUALS = CsvTable(
    (
        UTC,
        text("kind", "as in measurements.csv"),
        text("station", "receiver", empty=True),
        count("line", "line of measurements.csv", empty=False),
        _filled("value", "measured, in the unit of the kind", "", "z.9f"),
        _filled("residual", "measured less that of the orbit", "", "z.9f"),
        _filled("sigma", "1 sigma", "", ".6g"),
        _filled("chi_square", "normalised residual squared; 1 is expected", "", "z.4f"),
        CsvColumn("used", "whether the solution uses it", "flag"),
        REASON,
    )
)

DISTURBANCES = CsvTable(
    (
        text("from_utc", "start of the interval"),
        text("to_utc", "end of the interval"),
        *(
            _filled(f"moved_{a}_m", f"displacement by unmodelled forces, {a.upper()}", "m", "z.6f")
            for a in AXES
        ),
        *(
            _filled(f"moved_v{a}_m_s", f"velocity change by them, {a.upper()}", "m/s", "z.9f")
            for a in AXES
        ),
        _filled("sigma_m_s2", "expected 1 sigma of their acceleration", "m/s²", ".6g"),
    )
)

ORBIT_ERRORS = CsvTable(
    (
        UTC,
        _filled("hours", "since the last fix; above 0: a prediction", "h", "z.6f"),
        *(_filled(f"error_{a}_m", f"orbit less truth, {a.upper()}", "m", "z.4f") for a in AXES),
        *(_filled(f"sigma_{a}_m", "stated sigma", "m", "z.4f") for a in AXES),
        *(
            _filled(
                f"error_v{a}_m_s", f"velocity less truth, {a.upper()}", "m/s", "z.7f", empty=True
            )
            for a in AXES
        ),
        *(_filled(f"sigma_v{a}_m_s", "stated sigma of the velocity", "m/s", "z.7f") for a in AXES),
        _filled(
            "normalised_error_squared", "of the position per component; 1 is expected", "", "z.6f"
        ),
    )
)

PICTURE_TIMES = CsvTable(
    (
        FILE,
        text("utc_stamp", "stated time of the picture, UTC"),
        text("utc", "time at which the orbit passes the fix", empty=True),
        _filled("sigma_s", "1 sigma of `utc`", "s", ".6f", empty=True),
        text("candidates", "all passes within 3 sigmas, separated by semicolons", empty=True),
    )
)

QSO = CsvTable(
    (
        count("orbit", "number of the orbit", empty=False),
        number("distance_km", "requested distance from the surface", "km", ".6g", empty=False),
        number("longitude_deg", "east longitude of the passes", "deg", ".6g", empty=False),
        UTC,
        number("anomaly_deg", "mean anomaly of the moon at the start", "deg", "z.3f", empty=False),
        *(STATUS, *_make_state_columns()),
        number("radius_km", "distance of the start from the centre", "km", "z.4f"),
        number("spread_km", "largest difference of a pass from the start", "km", "z.4f"),
        number("ring_km", "distance of the farthest pass less the nearest", "km", "z.4f"),
        number("theory_spread_km", "`spread_km` of the averaged theory", "km", "z.4f"),
        number("rate", "mean revolutions per revolution of the moon, less 1", "", "z.5f"),
        number("rate_min", "`rate` of the slowest revolution", "", "z.5f"),
        number("rate_max", "`rate` of the fastest revolution", "", "z.5f"),
        number("theory_rate", "`rate` of the averaged theory", "", "z.5f"),
        number("theory_dv_m_s", "start velocity less that of the theory", "m/s", "z.4f"),
        count("passes", "passes of the longitude, with the start"),
        count("trials", "trajectories computed"),
        REASON,
    )
)

QSO_PASSES = CsvTable(
    (
        count("orbit", "number of the orbit", empty=False),
        count("pass", "number of the pass; 0 is the start", empty=False),
        UTC,
        number("distance_km", "distance from the surface", "km", "z.4f", empty=False),
        number("rate", "`rate` of the revolution before", "", "z.5f"),
        *_make_state_columns(empty=False),
    )
)

QSO_PATHS = CsvTable(
    (
        count("orbit", "number of the orbit", empty=False),
        text("kind", "orbit, or theory (start velocity of the averaged theory)"),
        number("seconds", "since the start", "s", ".6g", empty=False),
        number("x_km", "away from the planet, rotating frame", "km", "z.3f", empty=False),
        number("y_km", "along the moon's motion", "km", "z.3f", empty=False),
        number("z_km", "along the orbit normal", "km", "z.3f", empty=False),
    )
)

LANDING = CsvTable(
    (
        count("trial", "number of the trial, from 1", empty=False),
        STATUS,
        number("arrival_error_m", "position error at the arrival over the target", "m", "z.3f"),
        number("arrival_sigma_m", "its stated 1 sigma", "m", "z.3f"),
        number("arrival_error_m_s", "velocity error at the arrival", "m/s", "z.5f"),
        number("arrival_nees", "NEES of the state at the arrival", "", "z.3f"),
        count("steps", "iterations of the longest fit"),
        count("starts", "starts of that fit; over 1 after a wrong minimum"),
        number("end_height_error_m", "height error at the last altimeter height", "m", "z.3f"),
        number("end_side_error_m", "horizontal error there", "m", "z.3f"),
        number("end_down_error_m_s", "vertical velocity error there", "m/s", "z.5f"),
        number("end_side_error_m_s", "horizontal velocity error there", "m/s", "z.5f"),
        number("end_nees", "NEES of the state there", "", "z.3f"),
        number("east_m", "touchdown, east of the target", "m", "z.3f"),
        number("north_m", "touchdown, north of the target", "m", "z.3f"),
        number("down_m_s", "vertical velocity at touchdown, down", "m/s", "z.4f"),
        number("side_m_s", "horizontal velocity at touchdown", "m/s", "z.4f"),
        number("dv_m_s", "velocity change of all burns, without hovering", "m/s", "z.3f"),
        REASON,
    )
)

LANDING_IMPULSE = CsvTable(
    (
        count("step", "iteration of Newton's method", empty=False),
        *(
            number(f"dv_{i}_m_s", f"change of the impulse, inertial, {i}", "m/s", ".9g")
            for i in "xyz"
        ),
        number("left_m_s", "remaining error of the impulse", "m/s", ".6g", empty=False),
    )
)

LANDING_PATH = CsvTable(
    (
        text("kind", "transfer, descent (of the first trial), ground, or beam (two rows each)"),
        number("seconds", "since the departure", "s", ".6g"),
        number("along_km", "horizontal, towards the target in the transfer plane", "km", "z.5f"),
        number("up_km", "height over the target", "km", "z.5f"),
        number("side_km", "across the transfer plane", "km", "z.5f"),
    )
)

_AIM = (("xi_km", "xi", "km"), ("eta_km", "eta", "km"), ("tau_s", "time of the pericentre", "s"))

DELIVERY_STAGES = CsvTable(
    (
        text("stage", "injection, correction NUMBER, or arrival: the errors before it"),
        number("day", "since the start", "d", ".6g", empty=False),
        number("condition", "condition number of the matrix from velocity to arrival", "", ".4g"),
        *(number(f"bound_{i}", f"bound by the boxes, {w}", u, ".6g") for i, w, u in _AIM),
        *(number(f"trials_{i}", f"99.73 % of the trials, {w}", u, ".6g") for i, w, u in _AIM),
        *(number(f"navigation_{i}", f"navigation's 1 sigma, {w}", u, ".6g") for i, w, u in _AIM),
        number("bound_dv_m_s", "bound of the correction", "m/s", ".6g"),
        number("trials_dv_m_s", "99.73 % of the trials' correction", "m/s", ".6g"),
        number("largest_dv_m_s", "largest correction of the trials", "m/s", ".6g"),
        count("boxes", "number of boxes"),
    )
)

DELIVERY_BOXES = CsvTable(
    (
        text("stage", "stage of stages.csv"),
        *(number(f"{i}_from", f"lower side of the box, {w}", u, ".6g") for i, w, u in _AIM),
        *(number(f"{i}_to", f"upper side of the box, {w}", u, ".6g") for i, w, u in _AIM),
        number("spent_m_s", "largest total velocity change", "m/s", ".6g", empty=False),
    )
)

DELIVERY_ARRIVALS = CsvTable(
    (
        count("trial", "number of the trial, from 1", empty=False),
        *(number(i, f"less the aim, {w}", u, ".6g", empty=False) for i, w, u in _AIM),
        number("dv_m_s", "velocity change of all corrections", "m/s", ".6g", empty=False),
    )
)
