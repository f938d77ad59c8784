"""Parameters of an orbit's fit that its measurements do not observe."""

import numpy as np

from catalog.arrays import FloatArray
from optnav_cli.orbit.fit.problem import OrbitProblem
from optnav_cli.orbit.fit.settings import PRIOR_SIGMAS

UNOBSERVED = 0.9  # of the prior's sigma
AXES_OF = {"vertical": "NB"}  # of parameters of which one axis may be open and another not


def unobserved_remarks(problem: OrbitProblem, covariance: FloatArray) -> list[str]:
    """Name the parameters that the measurements leave open.

    covariance  (p, p) of the parameters after the fit
    """
    remarks = []
    for parameter in problem.estimated:
        sigmas = np.sqrt(np.diag(covariance)[parameter.span])
        left = sigmas / np.sqrt(np.diag(parameter.covariance))
        axes = AXES_OF.get(parameter.name, "")
        whose = parameter.settings.label
        # an arc of thrust is known before: there is nothing to say where the fixes add nothing
        if parameter.name not in PRIOR_SIGMAS or not (left > UNOBSERVED).any():
            continue
        if not (left > UNOBSERVED).all():
            if not axes:
                continue
            hidden = (axis for axis, share in zip(axes, left, strict=True) if share > UNOBSERVED)
            whose += f" along {', '.join(hidden)}"
        share = float(left[left > UNOBSERVED].min())
        remarks.append(
            f"{whose} is not observed: the measurements leave {100.0 * share:.0f} % of its prior "
            "sigma"
        )
    return remarks
