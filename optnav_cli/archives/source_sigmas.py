"""Default errors of positions and attitudes, 1 sigma an axis, by what their source can know.

A source's error in position grows with the distance that it was measured over, so a default is a
share of the camera's height above the body. The shares are judgements from the archives at hand,
no fits; a table of `configs/imports` that states sigmas has precedence:

label          Rosetta at 67P 0.5-1.7 km at 80-130 km, Apollo 15 frame 0297 1.3 km at 116 km: 1 %.
               Attitudes 0.3-0.7 deg, which holds what the body's axes are off by
cube           Galileo's orbits in cubes called "reconstructed" are 84 km from the label's at Io,
               19 900 km off: 0.4 %. Intercepts of Io and Europa differ by 0.03 deg from the label's
orbit kernel   after the fact 0.02 % (Cassini at the moons of Saturn: some km over 10^5 km); before
               it 0.5 %, since Galileo's orbit in those cubes was made ten months ahead; an orbit
               that does not say which is between both
attitude       after the fact 0.05 deg, as star trackers and their mounting allow; before it 0.2 deg
"""

from typing import NamedTuple

import numpy as np

from catalog.arrays import FloatArray
from catalog.bodies.coverage import Quality


class Share(NamedTuple):
    """A position's default sigma: a share of the height, and the least of it, m."""

    share: float
    least_m: float

    @property
    def words(self) -> str:
        return f"position {100.0 * self.share:g} % of the height, at least {self.least_m:g} m"

    def sigma_m(self, position_m: FloatArray, radius_m: float) -> float:
        """Sigma of a camera position (3,), m, body frame, above a body of a mean radius."""
        height_m = max(float(np.linalg.norm(position_m)) - radius_m, 0.0)
        return max(self.share * height_m, self.least_m)


class SourceSigmas(NamedTuple):
    """Defaults of one source: its name, the position's, and the attitude's, deg; None: free."""

    source: str
    position: Share
    attitude_deg: float | None

    def words(self, *, attitude: bool, position: bool) -> str:
        """Say which defaults were taken."""
        parts = []
        if attitude and self.attitude_deg is not None:
            parts.append(f"attitude {self.attitude_deg:g} deg")
        if position:
            parts.append(self.position.words)
        return f"1-sigma errors are defaults: {', '.join(parts)} ({self.source})" if parts else ""


LABEL = SourceSigmas("of a label", Share(0.01, 10.0), 0.5)
_CUBE = {"reconstructed": Share(0.005, 10.0), "predicted": Share(0.01, 1000.0)}
_CUBE_DEG = {"reconstructed": 0.1, "predicted": 0.5, "nadir": None}
_ORBIT = {
    "reconstructed": Share(2e-4, 100.0),
    "": Share(1e-3, 200.0),
    "predicted": Share(0.005, 1000.0),
}
_ATTITUDE_DEG = {"reconstructed": 0.05, "": 0.1, "predicted": 0.2}


def choose_cube_sigmas(position: str, pointing: str) -> SourceSigmas:
    """Defaults of an ISIS cube by what spiceinit calls its orbit and pointing."""
    return SourceSigmas(
        f"of a cube whose orbit is {position or 'not said how made'}, whose pointing "
        f"{pointing or 'not either'}",
        _CUBE.get(position, LABEL.position),
        _CUBE_DEG.get(pointing, LABEL.attitude_deg),
    )


def choose_kernel_sigmas(orbit: Quality, attitude: Quality) -> SourceSigmas:
    """Defaults of SPICE kernels by what their names and comments call them."""
    return SourceSigmas(
        f"of an orbit kernel {_describe_quality(orbit)}, "
        f"and attitudes {_describe_quality(attitude)}",
        _ORBIT[orbit],
        _ATTITUDE_DEG[attitude],
    )


def _describe_quality(quality: Quality) -> str:
    return f"called {quality}" if quality else "that says neither reconstructed nor predicted"
