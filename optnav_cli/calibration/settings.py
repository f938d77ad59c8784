"""The calibration config: how wide the search is, and what is known of a camera before."""

from pathlib import Path
from typing import Annotated

import msgspec
from msgspec import Meta

from catalog.config import load_toml
from catalog.geometry.rotations import ARCSEC
from optnav_cli.estimation.models.common import Common, CommonNumber, common_numbers

Wide = Annotated[float, Meta(gt=0.0, le=1e6)]


class SearchSettings(msgspec.Struct, forbid_unknown_fields=True, frozen=True):
    """Widening of the search for control points, for a camera that is not as stated.

    position_m, attitude_arcsec  1 sigma beside those of frames.csv
    """

    position_m: Wide = 2000.0
    attitude_arcsec: Wide = 600.0


class CalibrationPriors(msgspec.Struct, forbid_unknown_fields=True, frozen=True):
    """1 sigma of what the camera file states: wider than any honest error by default."""

    focal_percent: Wide = 5.0
    centre_px: Wide = 100.0
    distortion_k1: Wide = 0.1
    mounting_arcsec: Wide = 3600.0
    clock_s: Wide = 2.0

    def get_sigma(self, kind: Common) -> float:
        """Get a prior's sigma in the unit of the state."""
        return {
            Common.FOCAL: 1e-2 * self.focal_percent,
            Common.CENTRE: self.centre_px,
            Common.DISTORTION: self.distortion_k1,
            Common.MOUNTING: self.mounting_arcsec * ARCSEC,
            Common.CLOCK: self.clock_s,
        }[kind]


class CalibrateSettings(msgspec.Struct, forbid_unknown_fields=True, frozen=True):
    """The whole calibration config."""

    search: SearchSettings = SearchSettings()
    prior: CalibrationPriors = CalibrationPriors()

    def list_numbers(self, kinds: list[Common], cameras: list[str]) -> tuple[CommonNumber, ...]:
        """List the numbers to solve for, with these priors."""
        numbers_in_common = common_numbers(kinds, cameras, 1.0)
        return tuple(
            CommonNumber(n.kind, n.axis, n.camera, self.prior.get_sigma(n.kind))
            for n in numbers_in_common
        )


def load_calibrate_settings(path: Path) -> CalibrateSettings:
    """Load the calibration config of a file. Raises ConfigError for a wrong one."""
    return load_toml(path, CalibrateSettings)
