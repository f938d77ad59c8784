"""What a horizon gives: a position with its covariance."""

from dataclasses import dataclass

from catalog.arrays import FloatArray


@dataclass(frozen=True, eq=False)
class HorizonFix:
    """A camera position from limb points.

    position_m       (3,)   body frame
    covariance_m2    (3, 3)
    arc_deg          azimuth about the nadir that the used points cover
    residual_rms_px  across the limb, of the used points
    residuals_px     (n_points,) of each, positive away from the body; NaN of those left out
    n_points         offered
    n_used           kept: lit by the relief, and not outvoted
    terrain          whether the relief's skyline was the model, or the bare ellipsoid
    passes           over the relief's skyline; 0 without it
    remark           what a reader should know; empty when nothing
    """

    position_m: FloatArray
    covariance_m2: FloatArray
    arc_deg: float
    residual_rms_px: float
    residuals_px: FloatArray
    n_points: int
    n_used: int
    terrain: bool
    passes: int
    remark: str
