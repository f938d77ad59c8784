"""Where the planet of a tidally locked moon stands, from the moon's own rotation.

The moon turns evenly but for its libration, and its orbit goes round as often: what the planet
wanders about the prime meridian is the equation of the centre (R. M. Green, "Spherical Astronomy",
1985, to the square of the eccentricity) less the libration. The moon's equator is taken for the
plane of its orbit. Phobos' Mars so found is within 0.02 deg of published ephemerides in longitude,
0.01 deg in latitude and 0.2 km in distance (of 9400), held by a test.
"""

import numpy as np

from catalog.arrays import FloatArray
from catalog.bodies.body import Body, LockedOrbit
from catalog.bodies.epochs import DAY_S

CENTURY_S = 36525.0 * DAY_S


def planet_body(body: Body, orbit: LockedOrbit, tdb_s: float) -> FloatArray:
    """Position (3,) of the planet's centre from the moon's, body frame, m; tdb_s TDB seconds."""
    century = tdb_s / CENTURY_S
    argument = orbit.mean_anomaly_deg_by_century
    mean = float(np.radians(np.polynomial.polynomial.polyval(century, np.array(argument))))
    e = orbit.eccentricity
    swing = sum(t.meridian_deg for t in body.rotation.terms if t.angle_deg_by_century == argument)
    centre = 2.0 * e * np.sin(mean) + 1.25 * e**2 * np.sin(2.0 * mean)
    longitude = centre - np.radians(swing) * np.sin(mean)
    # r/a of the ellipse, to the square of e as well
    share = 1.0 - e * np.cos(mean) + 0.5 * e**2 * (1.0 - np.cos(2.0 * mean))
    distance = 1e3 * orbit.semi_major_axis_km * share
    return np.asarray(distance * np.array([np.cos(longitude), np.sin(longitude), 0.0]))
