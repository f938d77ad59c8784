"""The lit edge of a body against the sky, as one picture shows it."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class LimbPoints:
    """Points of the lit limb, ordered by azimuth about the body's centre in the picture.

    pixels            (n, 2)  x, y of the edge
    sigma_px          (n,)    1-sigma error along `inward`, each point's own (noise)
    inward            (n, 2)  unit vectors in the picture from the sky to the body, across the limb
    common_sigma_px   what the edge model may leave common to all points, along `inward`
    blur_px           sigma of the blur across the limb, as the edges show it
    cone_axis_camera  (3,)    unit vector to the centre of the circular cone that fits them best
    cone_angle        half angle of that cone, rad
    arc_deg           azimuth about the cone's axis that the points cover
    lit_pixels        area of the lit body in the picture
    cut_by_frame      whether the body reaches the picture's edge
    saturated_share   of the lit area at full scale
    """

    pixels: FloatArray
    sigma_px: FloatArray
    inward: FloatArray
    common_sigma_px: float
    blur_px: float
    cone_axis_camera: FloatArray
    cone_angle: float
    arc_deg: float
    lit_pixels: int
    cut_by_frame: bool
    saturated_share: float

    def __len__(self) -> int:
        return len(self.pixels)
