"""Units of the numbers in labels."""

import numpy as np
import pytest

from optnav_cli.archives.label import extract_unit, find_unit


@pytest.mark.parametrize(
    ("unit", "quantity", "size"),
    [
        ("m", "length", 1.0), ("<KM>", None, 0.0), ("KM", "length", 1e3),
        ("Kilometers", "length", 1e3), ("metre", "length", 1.0), ("AU", "length", 1.495978707e11),
        ("deg", "angle", np.pi / 180), ("DEGREE", "angle", np.pi / 180), ("rad", "angle", 1.0),
        ("arcsec", "angle", np.pi / 648000), ("mrad", "angle", 1e-3), ("MS", "time", 1e-3),
        ("millisecond", "time", 1e-3), ("SECONDS", "time", 1.0), ("hr", "time", 3600.0),
        ("km/s", "speed", 1e3), ("DEG/S", "rate", np.pi / 180), ("N/A", "number", 1.0),
        ("pixel", None, 0.0), ("degC", None, 0.0), ("kelvin", None, 0.0), ("km/km", None, 0.0),
    ],
)  # fmt: skip
def test_units_are_known_by_name_and_symbol(unit: str, quantity: str | None, size: float) -> None:
    known = find_unit(unit)
    assert (None if known is None else known[0]) == quantity
    assert known is None or known[1] == pytest.approx(size, rel=1e-12)


@pytest.mark.parametrize(
    ("comment", "unit"),
    [
        ("[km] distance", "km"), ("[furlong] distance", "furlong"), ("RA (J2000) [deg]", "deg"),
        ("position in J2000, in (x) km", "km"), ("Exposure time in ms from it", "ms"),
        ("range (m)", "m"), ("number of frame(s)", ""), ("count [1/32 sec]", ""),
        ("Flag (0=off, 1=on)", ""), ("version (1)", ""), ("date in UTC", ""), ("", ""),
    ],
)  # fmt: skip
def test_units_of_fits_comments(comment: str, unit: str) -> None:
    assert extract_unit(comment) == unit
