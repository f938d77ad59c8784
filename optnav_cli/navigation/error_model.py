"""How far a matched control point may be from its true place on the ground.

The peak's curvature knows about noise; it does not know that the reference's terrain is coarser
than the ground, nor that the shading law differs. Those errors belong to the control point. They
grow with the posting and with q = tan(Sun elevation) / sqrt(lambda_H): little relief under a high
Sun gives a weak, easily biased pattern.
"""

import numpy as np

# Fitted on simulated frames over terrain richer than the catalog's (study navigation).
NODES_AT_GOOD_LIGHT = 0.05
NODES_PER_Q = 0.05


def match_sigma_m(posting_m: float, sun_elevation_deg: float, hessian_eigenvalue: float) -> float:
    """One-sigma ground error of a match per axis, m, that its correlation peak does not show.

    posting_m           of the level that was matched
    sun_elevation_deg   at the point
    hessian_eigenvalue  of the point (dimensionless)
    """
    relief = max(hessian_eigenvalue, 1e-6)
    q = np.tan(np.radians(min(sun_elevation_deg, 85.0))) / np.sqrt(relief)
    return float(posting_m * (NODES_AT_GOOD_LIGHT + NODES_PER_Q * min(q, 5.0)))
