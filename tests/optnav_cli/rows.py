"""Rows of solution.csv made up for the tests of what reads them."""

import numpy as np

from optnav_cli.fix import Evidence, Fix, Method, NoFix, Solution
from optnav_cli.reasons import Reason, ReasonCode


def solved(
    file, utc, method, position_m, covariance_m2, camera_from_body, attitude_sigma_rad,
    *, prior="", **evidence,
):  # fmt: skip
    """A solved frame; `evidence` as the fields of `Evidence`."""
    fix = Fix(
        Method(method),
        np.array(position_m, dtype=np.float64),
        np.array(covariance_m2, dtype=np.float64),
        camera_from_body,
        attitude_sigma_rad,
        Evidence(**evidence),
    )
    return Solution(file, utc, fix, prior)


def unsolved(file, utc, text, code=ReasonCode.NO_SOLUTION, **evidence):
    """A frame without a position, for a reason in words."""
    return Solution(file, utc, NoFix(Reason(code, text), None, Evidence(**evidence)))
