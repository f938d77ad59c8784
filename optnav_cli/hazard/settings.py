"""What a user can set about a hazard map; every key has a default that works."""

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec

from catalog.config import load_toml

KIND, PADS_FILE = "hazard", "pads.csv"  # of the output folder
CARRIED_FILE, LAYER_FILE = "carried_pads.csv", "carried_pads.gpkg"  # of a run

Length = Annotated[float, msgspec.Meta(ge=0.1, le=1e5)]
Share = Annotated[float, msgspec.Meta(gt=0.0, lt=1.0)]
Method = Literal["shading", "variance"]


class HazardSettings(msgspec.Struct, forbid_unknown_fields=True, frozen=True, kw_only=True):
    """The config of a hazard map; see configs/templates/hazard.toml."""

    method: Method = "shading"
    pad_m: Length = 20.0
    square_m: Length = 200.0
    law: Literal["hapke", "lommel_seeliger", "lunar_lambert", "lambert"] = "hapke"
    shadow: Share = 0.3
    max_shadow: Share = 0.1
    ground_sigma_m: Annotated[float, msgspec.Meta(ge=0.0, le=1e4)] = 5.0


OPTIONS = ("method", "pad_m", "square_m")  # that the command line may set, too


def load_settings(path: Path | None, options: Mapping[str, Any]) -> HazardSettings:
    """Load the settings of a file, or the defaults; options that are not None take precedence.

    Raises ConfigError for a wrong file.
    """
    settings = HazardSettings() if path is None else load_toml(path, HazardSettings)
    given = {key: value for key, value in options.items() if value is not None}
    return msgspec.structs.replace(settings, **given)
