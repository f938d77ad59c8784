"""The columns of the CSV files of an orbit's folder. R is up, N forward, B across the motion."""

from itertools import product

from catalog.tables import CsvColumn, CsvTable
from optnav_cli.frames.tables import CAMERA, FILE, POSITION, UTC

VELOCITY = ("vx_m_s", "vy_m_s", "vz_m_s")
INERTIAL = tuple(f"inertial_{name}" for name in (*POSITION, *VELOCITY))
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


def _number(name: str, meaning: str, unit: str, form: str, empty: bool = False) -> CsvColumn:
    return CsvColumn(name, meaning, "number", unit, form, empty)


def _text(name: str, meaning: str, empty: bool = False) -> CsvColumn:
    return CsvColumn(name, meaning, "text", empty=empty)


ORBIT = CsvTable(
    (
        UTC,
        _text("kind", "fix, between or prediction"),
        *(_number(name, f"position, body frame, {name[0]}", "m", "z.4f") for name in POSITION),
        *(
            _number(name, f"velocity as the body frame sees it, {name[1]}", "m/s", "z.8f")
            for name in VELOCITY
        ),
        *(_number(name, "the same, ICRF axes", "m", "z.4f") for name in INERTIAL[:3]),
        *(_number(name, "the same, ICRF axes", "m/s", "z.8f") for name in INERTIAL[3:]),
        *(
            _number(name, "covariance along R, N, B of the inertial motion", "", ".9e")
            for name in STATE_COVARIANCE
        ),
    )
)

ORBIT_RESIDUALS = CsvTable(
    (
        *(FILE, UTC, CAMERA),
        _text("run", "folder of the run"),
        *(
            _number(f"residual_{a}_m", f"fix less orbit, along {a.upper()}", "m", "z.4f")
            for a in AXES
        ),
        *(
            _number(f"sigma_{a}_m", f"the fix's stated sigma along {a.upper()}", "m", "z.4f")
            for a in AXES
        ),
        _number("chi_square", "of the residual by its own covariance; 3 is expected", "", "z.4f"),
        CsvColumn("used", "whether the orbit rests on it", "flag"),
        _text("reason", "why not", empty=True),
    )
)

DISTURBANCES = CsvTable(
    (
        _text("from_utc", "start of the interval"),
        _text("to_utc", "its end, to which the disturbance belongs"),
        *(
            _number(f"moved_{a}_m", f"what the forces left out moved, {a.upper()}", "m", "z.6f")
            for a in AXES
        ),
        *(_number(f"moved_v{a}_m_s", f"and sped up, {a.upper()}", "m/s", "z.9f") for a in AXES),
        _number("sigma_m_s2", "of the acceleration that they were expected to be", "m/s²", ".6g"),
    )
)

ORBIT_ERRORS = CsvTable(
    (
        UTC,
        _number("hours", "since the last fix; above 0: a prediction", "h", "z.6f"),
        *(_number(f"error_{a}_m", f"orbit less truth, {a.upper()}", "m", "z.4f") for a in AXES),
        *(_number(f"sigma_{a}_m", "its stated sigma", "m", "z.4f") for a in AXES),
        *(
            _number(f"error_v{a}_m_s", f"of the velocity, {a.upper()}", "m/s", "z.7f", True)
            for a in AXES
        ),
        *(_number(f"sigma_v{a}_m_s", "its stated sigma", "m/s", "z.7f") for a in AXES),
        _number("normalised_error_squared", "of the place, a component; 1 is expected", "", "z.6f"),
    )
)

PICTURE_TIMES = CsvTable(
    (
        FILE,
        _text("utc_stamp", "time of the picture as its run states it, UTC"),
        _text("utc", "when the orbit passes its position, nearest to the stamp", empty=True),
        _number("sigma_s", "1 sigma of that time", "s", ".6f", empty=True),
        _text("candidates", "all passes within 3 sigmas, with semicolons between", empty=True),
    )
)
