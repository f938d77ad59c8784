"""Sun and neighbours of a body from analytic theories without files.

Earth: SOFA epv00 (VSOP2000 fit); Moon: SOFA moon98 (Meeus) about that Earth; Mars and Phobos: SOFA
plan94 (Simon et al. 1994). Light arrives at a moving body from the apparent direction, so stellar
aberration (20" at 30 km/s) is applied, to first order (0.001" left out). The Sun's own motion
during the light time is left out (0.01"). Differences measured against DE405 are in the tests.
Positions are geometric. Against DE405 the Earth from the Moon is off by 7 km rms and 22 km at most,
the Sun by 8 km; Mars by 8000 km rms and 19 000 km at most.
"""

import warnings

import erfa
import numpy as np

from catalog.arrays import FloatArray
from catalog.bodies.body import Body
from catalog.bodies.epochs import DAY_S, J2000_JD
from catalog.bodies.locked_orbit import planet_body
from catalog.bodies.rotation import body_from_inertial
from catalog.errors import DataError

LIGHT_AU_PER_DAY = 173.1446326846693  # c * 86400 s / 149597870700 m
AU_M = 149597870700.0
MARS_NUMBER = 4  # of SOFA's plan94


def sun_direction_inertial(body: Body, tdb_s: float) -> FloatArray:
    """Unit vector (3,) to the apparent Sun, inertial axes, as seen from the body's centre."""
    from_sun, velocity = _heliocentric(body.sun, tdb_s / DAY_S)
    direction = -from_sun / np.linalg.norm(from_sun)
    apparent = direction + velocity / LIGHT_AU_PER_DAY
    return np.asarray(apparent / np.linalg.norm(apparent))


def position_inertial(body: Body, of: str, tdb_s: float) -> FloatArray:
    """Position (3,) of the centre of `of` from the body's centre at the same time, inertial, m.

    of  sun, earth, moon or mars. For Phobos all but Mars are seen from Mars, 9400 km off.
    Raises DataError for a moon's planet where the moon's file has no [orbit].
    """
    day = tdb_s / DAY_S
    if body.orbit is not None and of == body.orbit.around:
        turn = body_from_inertial(body, tdb_s)
        return np.asarray(turn.T @ planet_body(body, body.orbit, tdb_s))
    if of == body.name or of == body.sun:
        raise DataError(
            f"there is no theory here of {of} as seen from {body.name}; "
            "name SPICE kernels that have it"
        )
    if {of, body.sun} == {"earth", "moon"}:
        # the pair itself: the Sun's distance would cost digits
        sign = 1.0 if of == "moon" else -1.0
        return sign * _moon(day)[0] * AU_M
    seen_from = _heliocentric(body.sun, day)[0]
    there = np.zeros(3) if of == "sun" else _heliocentric(of, day)[0]
    return np.asarray((there - seen_from) * AU_M)


def _heliocentric(of: str, day: float) -> tuple[FloatArray, FloatArray]:
    """Position from the Sun, AU, and velocity, AU/day, `day` days after J2000."""
    with warnings.catch_warnings():
        # Outside 1900-2100 the theories warn; they stay far better than needed.
        warnings.simplefilter("ignore", erfa.ErfaWarning)
        if of == "mars":
            return _vectors(erfa.plan94(J2000_JD, day, MARS_NUMBER))
        # The Sun's own barycentric velocity, 15 m/s, changes the aberration by 0.01".
        heliocentric, _ = erfa.epv00(J2000_JD, day)
    position, velocity = _vectors(heliocentric)
    if of == "moon":
        moon_position, moon_velocity = _moon(day)
        return position + moon_position, velocity + moon_velocity
    return position, velocity


def _moon(day: float) -> tuple[FloatArray, FloatArray]:
    """Position of the Moon from the Earth, AU, and velocity, AU/day."""
    return _vectors(erfa.moon98(J2000_JD, day))


def _vectors(pv: object) -> tuple[FloatArray, FloatArray]:
    record = np.asarray(pv)
    return np.array(record["p"], dtype=np.float64), np.array(record["v"], dtype=np.float64)
