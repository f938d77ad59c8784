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


def _covariance_name(i: int, j: int) -> str:
    apart = "_" if i > 2 else ""
    return f"cov_{_NAMES[i]}{apart}{_NAMES[j]}_{_POWERS[(i > 2) + (j > 2)]}"


STATE_COVARIANCE = tuple(_covariance_name(i, j) for i, j in LOWER)
SIGMAS_OF_STATE = ("sigma_r_m", "sigma_n_m", "sigma_b_m")


def _states(what: str, empty: bool = True) -> list[CsvColumn]:
    """Six columns each of a state: body-fixed, and inertial."""
    states = []
    for frame, names in (("body frame", BODY_STATE), ("inertial", INERTIAL)):
        for name in names:
            kind, unit = ("velocity", "m/s") if name.endswith("_s") else ("position", "m")
            meaning = f"{kind} {what}, {frame}, {name.removeprefix('inertial_').lstrip('v')[0]}"
            states.append(number(name, meaning, unit, "z.6f" if unit == "m/s" else "z.3f", empty))
    return states


_filled = partial(number, empty=False)  # a number that is always there

ORBIT = CsvTable(
    (
        UTC,
        text("kind", "fix, between or prediction"),
        *(_filled(name, f"position, body frame, {name[0]}", "m", "z.4f") for name in POSITION),
        *(
            _filled(name, f"velocity as the body frame sees it, {name[1]}", "m/s", "z.8f")
            for name in VELOCITY
        ),
        *(_filled(name, "the same, ICRF axes", "m", "z.4f") for name in INERTIAL[:3]),
        *(_filled(name, "the same, ICRF axes", "m/s", "z.8f") for name in INERTIAL[3:]),
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
            _filled(f"residual_{a}_m", f"fix less orbit, along {a.upper()}", "m", "z.4f")
            for a in AXES
        ),
        *(
            _filled(f"sigma_{a}_m", f"the fix's stated sigma along {a.upper()}", "m", "z.4f")
            for a in AXES
        ),
        _filled("chi_square", "of the residual by its own covariance; 3 is expected", "", "z.4f"),
        CsvColumn("used", "whether the orbit rests on it", "flag"),
        text("reason", "why not", empty=True),
    )
)

_SIGHT = (
    text("utc", "time of the sight, UTC, with as many digits as it is known to"),
    text("type", "star_zenith"),
    _filled("ra_deg", "right ascension of the star, ICRS, proper motion in it", "deg", "z.6f"),
    _filled("dec_deg", "declination of the star", "deg", "z.6f"),
    _filled(
        "value_deg",
        "angle between the craft's place from the body's centre and the star, without aberration",
        "deg",
        "z.8f",
    ),
    _filled("sigma_arcsec", "1 sigma of it", "arcsec", ".6g"),
)

ZENITH = CsvTable(_SIGHT)

ZENITH_RESIDUALS = CsvTable(
    (
        _SIGHT[0],
        text("star", "its name, or its number in the Hipparcos catalogue"),
        _filled("value_deg", "the zenith distance measured", "deg", "z.8f"),
        _filled("residual_arcsec", "measured less that of the orbit", "arcsec", "z.4f"),
        _filled("sigma_arcsec", "1 sigma as stated", "arcsec", ".6g"),
        _filled("chi_square", "of the residual by its own covariance; 1 is expected", "", "z.4f"),
        CsvColumn("used", "whether the orbit rests on it", "flag"),
        text("reason", "why not", empty=True),
    )
)

DISTURBANCES = CsvTable(
    (
        text("from_utc", "start of the interval"),
        text("to_utc", "its end, to which the disturbance belongs"),
        *(
            _filled(f"moved_{a}_m", f"what the forces left out moved, {a.upper()}", "m", "z.6f")
            for a in AXES
        ),
        *(_filled(f"moved_v{a}_m_s", f"and sped up, {a.upper()}", "m/s", "z.9f") for a in AXES),
        _filled("sigma_m_s2", "of the acceleration that they were expected to be", "m/s²", ".6g"),
    )
)

ORBIT_ERRORS = CsvTable(
    (
        UTC,
        _filled("hours", "since the last fix; above 0: a prediction", "h", "z.6f"),
        *(_filled(f"error_{a}_m", f"orbit less truth, {a.upper()}", "m", "z.4f") for a in AXES),
        *(_filled(f"sigma_{a}_m", "its stated sigma", "m", "z.4f") for a in AXES),
        *(
            _filled(f"error_v{a}_m_s", f"of the velocity, {a.upper()}", "m/s", "z.7f", empty=True)
            for a in AXES
        ),
        *(_filled(f"sigma_v{a}_m_s", "its stated sigma", "m/s", "z.7f") for a in AXES),
        _filled("normalised_error_squared", "of the place, a component; 1 is expected", "", "z.6f"),
    )
)

PICTURE_TIMES = CsvTable(
    (
        FILE,
        text("utc_stamp", "time of the picture as its run states it, UTC"),
        text("utc", "when the orbit passes its position, nearest to the stamp", empty=True),
        _filled("sigma_s", "1 sigma of that time", "s", ".6f", empty=True),
        text("candidates", "all passes within 3 sigmas, with semicolons between", empty=True),
    )
)

QSO = CsvTable(
    (
        count("orbit", "number of the orbit, from 1; its file is orbit_NUMBER.oem", empty=False),
        number("distance_km", "asked for, from the surface", "km", ".6g", empty=False),
        number("longitude_deg", "of the passes, east", "deg", ".6g", empty=False),
        text("utc", "of the start"),
        number("anomaly_deg", "mean anomaly of the moon then", "deg", "z.3f", empty=False),
        *(STATUS, *_states("at the start")),
        number("radius_km", "of the start, from the centre", "km", "z.4f"),
        number("spread_km", "largest difference of a pass from the start", "km", "z.4f"),
        number("ring_km", "distance of the farthest pass less the nearest", "km", "z.4f"),
        number("theory_spread_km", "the first of these of the averaged theory's", "km", "z.4f"),
        number("rate", "revolutions a revolution of the moon, less 1, mean", "", "z.5f"),
        number("rate_min", "of the slowest revolution", "", "z.5f"),
        number("rate_max", "of the quickest", "", "z.5f"),
        number("theory_rate", "by the averaged theory", "", "z.5f"),
        number("theory_dv_m_s", "velocity of the start less that of the theory", "m/s", "z.4f"),
        count("passes", "of the longitude, the start among them"),
        count("trials", "flights that the search took"),
        REASON,
    )
)

QSO_PASSES = CsvTable(
    (
        count("orbit", "number of the orbit", empty=False),
        count("pass", "number of the pass; 0 is the start", empty=False),
        text("utc", "of the pass"),
        number("distance_km", "from the surface over the longitude", "km", "z.4f", empty=False),
        number("rate", "of the revolution before it, less 1", "", "z.5f"),
        *_states("then", empty=False),
    )
)

QSO_PATHS = CsvTable(
    (
        count("orbit", "number of the orbit", empty=False),
        text("kind", "orbit, or theory: from the first velocity of the averaged theory"),
        number("seconds", "since the start", "s", ".6g", empty=False),
        number("x_km", "turning frame: away from the planet", "km", "z.3f", empty=False),
        number("y_km", "the same: along the moon's motion", "km", "z.3f", empty=False),
        number("z_km", "the same: up", "km", "z.3f", empty=False),
    )
)

LANDING = CsvTable(
    (
        count("trial", "number of the trial, from 1", empty=False),
        STATUS,
        number("arrival_error_m", "of the navigation at the arrival over the target", "m", "z.3f"),
        number("arrival_sigma_m", "its stated 1 sigma, a length", "m", "z.3f"),
        number("arrival_error_m_s", "of the velocity then", "m/s", "z.5f"),
        number("arrival_nees", "errors squared over their covariance, over 6", "", "z.3f"),
        count("steps", "of the fit that took most"),
        count("starts", "of that fit: more than one after a wrong minimum"),
        number(
            "end_height_error_m", "of the navigation at the altimeter's last height", "m", "z.3f"
        ),
        number("end_side_error_m", "the same, across", "m", "z.3f"),
        number("end_down_error_m_s", "the same, velocity along up", "m/s", "z.5f"),
        number("end_side_error_m_s", "the same, velocity across", "m/s", "z.5f"),
        number("end_nees", "the same, errors squared over their covariance, over 6", "", "z.3f"),
        number("east_m", "touchdown, east of the target", "m", "z.3f"),
        number("north_m", "touchdown, north of it", "m", "z.3f"),
        number("down_m_s", "velocity down at the touchdown", "m/s", "z.4f"),
        number("side_m_s", "velocity across then", "m/s", "z.4f"),
        number("dv_m_s", "of all burns, without what holds the craft up", "m/s", "z.3f"),
        REASON,
    )
)

LANDING_IMPULSE = CsvTable(
    (
        count("step", "of Newton's method", empty=False),
        *(
            number(f"dv_{i}_m_s", f"its change of the impulse, inertial, {i}", "m/s", ".9g")
            for i in "xyz"
        ),
        number("left_m_s", "of the impulse still to find after it", "m/s", ".6g", empty=False),
    )
)

LANDING_PATH = CsvTable(
    (
        text("kind", "transfer, descent (of the first trial), ground, or beam (two rows each)"),
        number("seconds", "since the departure", "s", ".6g"),
        number("along_km", "level, towards the target in the plane of the transfer", "km", "z.5f"),
        number("up_km", "over the target", "km", "z.5f"),
        number("side_km", "across that plane", "km", "z.5f"),
    )
)

_AIM = (("xi_km", "xi", "km"), ("eta_km", "eta", "km"), ("tau_s", "time of the pericentre", "s"))

DELIVERY_STAGES = CsvTable(
    (
        text("stage", "injection, correction NUMBER, or arrival: the errors before it"),
        number("day", "since the start", "d", ".6g", empty=False),
        number("condition", "of what velocity does to the arrival", "", ".4g"),
        *(number(f"bound_{i}", f"largest {w} by the boxes", u, ".6g") for i, w, u in _AIM),
        *(number(f"trials_{i}", f"99.73 % of the trials' {w}", u, ".6g") for i, w, u in _AIM),
        *(number(f"navigation_{i}", f"1 sigma of {w} then", u, ".6g") for i, w, u in _AIM),
        number("bound_dv_m_s", "largest change of velocity of the correction", "m/s", ".6g"),
        number("trials_dv_m_s", "99.73 % of the trials'", "m/s", ".6g"),
        number("largest_dv_m_s", "the largest trial's", "m/s", ".6g"),
        count("boxes", "that hold the errors"),
    )
)

DELIVERY_BOXES = CsvTable(
    (
        text("stage", "of stages.csv"),
        *(number(f"{i}_from", f"{w}: the box's lower side", u, ".6g") for i, w, u in _AIM),
        *(number(f"{i}_to", f"{w}: its upper side", u, ".6g") for i, w, u in _AIM),
        number("spent_m_s", "the most that leads there", "m/s", ".6g", empty=False),
    )
)

DELIVERY_ARRIVALS = CsvTable(
    (
        count("trial", "number of the trial, from 1; the first ones", empty=False),
        *(number(i, f"{w} less the aim's", u, ".6g", empty=False) for i, w, u in _AIM),
        number("dv_m_s", "of all corrections", "m/s", ".6g", empty=False),
    )
)
