"""Settings of a hazard map, each with a default, and its fitted numbers.

The numbers stand in configs/models/hazard.toml, which says what each is.
"""

import math
from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec
import numpy as np

from catalog.arrays import FloatArray
from catalog.config import NotNegative, Positive, load_toml, resource
from catalog.errors import ConfigError

KIND, PADS_FILE = "hazard", "pads.csv"  # of the output folder
CARRIED_FILE, LAYER_FILE = "carried_pads.csv", "carried_pads.gpkg"  # of a run

Length = Annotated[float, msgspec.Meta(ge=0.1, le=1e5)]
Share = Annotated[float, msgspec.Meta(gt=0.0, lt=1.0)]
Method = Literal["shading", "variance"]
MODEL_FILE = "configs/models/hazard.toml"
Numbers = Annotated[tuple[float, ...], msgspec.Meta(min_length=1, max_length=50)]


class HazardSettings(msgspec.Struct, forbid_unknown_fields=True, frozen=True, kw_only=True):
    """The config of a hazard map; see configs/templates/hazard.toml."""

    method: Method = "shading"
    pad_m: Length = 20.0
    square_m: Length = 200.0
    law: Literal["hapke", "lommel_seeliger", "lunar_lambert", "lambert"] = "hapke"
    shadow: Share = 0.3
    max_shadow: Share = 0.1
    min_rock_m: Annotated[float, msgspec.Meta(ge=0.0, le=100.0)] = 0.3
    ground_sigma_m: Annotated[float, msgspec.Meta(ge=0.0, le=1e4)] = 5.0


OPTIONS = ("method", "pad_m", "square_m")  # that the command line may set, too


def load_settings(path: Path | None, options: Mapping[str, Any]) -> HazardSettings:
    """Load the settings of a file, or the defaults; options that are not None take precedence.

    Raises ConfigError for a wrong file.
    """
    settings = HazardSettings() if path is None else load_toml(path, HazardSettings)
    given = {key: value for key, value in options.items() if value is not None}
    return msgspec.structs.replace(settings, **given)


class ErrorOfSlopes(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Terms of the probability that a slope is above a limit, one for each elevation of the Sun.

    It is the normal distribution of slope - limit * level + local * r + (regional + narrow * x) * R
    + dark * f over sigma + sigma_local * r + sigma_dark * f + sigma_narrow * x * R, tangents; r and
    R are rms slopes about a cell, f the share of shadow there, and x grows as the picture gets
    smaller than `wide_m`: waves longer than it, which run across the Sun, are in no brightness.
    """

    limit: Numbers
    local: Numbers
    regional: Numbers
    dark: Numbers
    sigma: Numbers
    sigma_local: Numbers
    sigma_dark: Numbers
    narrow: Numbers
    sigma_narrow: Numbers


class ShadingNumbers(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Numbers of the slopes from brightness."""

    noise: Positive
    spectrum: Annotated[float, msgspec.Meta(ge=0.0, le=6.0)]
    local_m: Positive
    regional_m: Positive
    wide_m: Positive
    sun_elevation_deg: Numbers
    dangerous: ErrorOfSlopes
    critical: ErrorOfSlopes


class VarianceNumbers(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Step of the map, and bounds of a pad's mean brightness over the most frequent one."""

    cell_m: Positive
    darkest: Positive
    brightest: Positive


class RegistrationNumbers(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Errors of windows of a terrain model that all have in common, in its postings.

    shared_postings   1 sigma a coordinate
    sunward_postings  how far windows of a picture are found away from the Sun when it stands at
                      45 deg, which goes with its cotangent; also 1 sigma of that
    """

    shared_postings: Positive
    sunward_postings: Positive

    def compute_shift(self, sun: FloatArray, posting_m: float) -> tuple[FloatArray, FloatArray]:
        """Compute how far (2,) shifts to the model are off on the map, m, and its covariance.

        sun  (3,) unit vector east, north, up
        """
        level = sun[:2] / max(float(sun[2]), math.sin(math.radians(3.0)))
        shift = self.sunward_postings * posting_m * level
        shared_m2 = (self.shared_postings * posting_m) ** 2
        return shift, np.outer(shift, shift) + shared_m2 * np.eye(2)


class RockNumbers(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Numbers of the rocks; `rocks` says what they are for."""

    max_pixel: Positive
    min_shadow_px: Positive
    longer_px: Annotated[float, msgspec.Meta(ge=-5.0, le=5.0)]
    slope_weight: Annotated[float, msgspec.Meta(ge=0.0, le=2.0)]
    sigma_px: Positive
    sigma_share: NotNegative
    sigma_slope: NotNegative
    sun_elevation_deg: Numbers
    least_chance: Numbers
    weights: Annotated[tuple[Numbers, ...], msgspec.Meta(min_length=1, max_length=20)]


class HazardModel(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Content of configs/models/hazard.toml."""

    shadow: Share
    max_shadow: Share
    shadow_sun_deg: Positive
    most_longer: Annotated[float, msgspec.Meta(ge=1.0)]
    flatness: NotNegative
    shading: ShadingNumbers
    variance: VarianceNumbers
    registration: RegistrationNumbers
    rocks: RockNumbers
    prior_sigma_deg: NotNegative
    tilt_sigma_deg: Positive

    def limit_shadow(self, sun_elevation_deg: float) -> float:
        """Return the share of shadow that a pad may have.

        It is what rocks that cover a fixed share of the ground cast at this elevation.
        """
        known, now = (math.radians(deg) for deg in (self.shadow_sun_deg, sun_elevation_deg))
        longer = math.tan(known) / math.tan(now)
        return self.max_shadow * min(max(longer, 1.0), self.most_longer)


@cache
def load_hazard_model() -> HazardModel:
    """Load the numbers that ship with optnav. Raises ConfigError for a wrong file."""
    model = load_toml(resource(MODEL_FILE), HazardModel)
    count = len(model.shading.sun_elevation_deg)
    for part in (model.shading.dangerous, model.shading.critical):
        for name in part.__struct_fields__:
            if len(getattr(part, name)) != count:
                raise ConfigError(f"{MODEL_FILE}: {name} has not {count} numbers, one an elevation")
    rocks = model.rocks
    if {len(rocks.least_chance), len(rocks.weights)} != {len(rocks.sun_elevation_deg)}:
        raise ConfigError(f"{MODEL_FILE}: [rocks] wants a row of weights for each elevation")
    return model


def interpolate_terms(
    part: ErrorOfSlopes, elevations: Numbers, elevation_deg: float
) -> list[float]:
    """Interpolate the numbers of a part at an elevation of the Sun, in their order."""
    return [
        float(np.interp(elevation_deg, elevations, getattr(part, name)))
        for name in part.__struct_fields__
    ]
