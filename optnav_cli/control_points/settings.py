"""What a user can set about navigation; every key has a default that works."""

from math import radians
from pathlib import Path
from typing import Annotated, Literal

import msgspec

from catalog.config import load_toml
from catalog.errors import ConfigError
from catalog.terrain.dem.file import resolve_path
from optnav_cli.frames.run_settings import SpiceSettings

Share = Annotated[float, msgspec.Meta(gt=0.0, lt=1.0)]
Construction = Literal["least_squares", "circles", "tori"]
Elevation = Annotated[float, msgspec.Meta(ge=0.0, le=90.0)]


class ViewSettings(msgspec.Struct, forbid_unknown_fields=True, frozen=True):
    """Which control points of the catalog are looked for in a frame."""

    sun_min_deg: Elevation = 5.0
    sun_max_deg: Elevation = 60.0
    emission_max_deg: Elevation = 70.0


class MatchSettings(msgspec.Struct, forbid_unknown_fields=True, frozen=True):
    """Settings of the search of control points and of the acceptance of matches."""

    template_nodes: Annotated[int, msgspec.Meta(ge=16, le=256)] = 80
    # finest level used: its posting over the pixel on the ground
    finest_posting_per_gsd: Annotated[float, msgspec.Meta(ge=0.01, le=100.0)] = 0.4
    max_search_nodes: Annotated[int, msgspec.Meta(ge=4, le=128)] = 24
    search_sigmas: Annotated[float, msgspec.Meta(ge=0.1, le=100.0)] = 3.5
    min_score: Share = 0.3
    rival_ratio: Share = 0.9


class SolveSettings(msgspec.Struct, forbid_unknown_fields=True, frozen=True):
    """Settings of the solution of a position from matches."""

    max_passes: Annotated[int, msgspec.Meta(ge=1, le=20)] = 6
    gate_probability: Share = 0.9999
    # how far a free attitude's first guess may be off, 1 sigma an axis
    free_attitude_deg: Annotated[float, msgspec.Meta(ge=1e-6, le=180.0)] = 1.0
    max_first_pass_points: Annotated[int, msgspec.Meta(ge=4, le=10_000)] = 24
    # in the later rounds: a wide picture shows more than its accuracy gains from
    max_points: Annotated[int, msgspec.Meta(ge=4, le=10_000)] = 200


class PickedSettings(msgspec.Struct, forbid_unknown_fields=True, frozen=True):
    """Settings of positions from picked points."""

    construction: Construction = "least_squares"


class StarsSettings(msgspec.Struct, forbid_unknown_fields=True, frozen=True):
    """[stars]: the catalogue that attitudes from stars rest on.

    catalogue  a CSV of the user's own, beside the config; None for the stars that ship
    epoch      Julian year of its places, where it has no column of it
    """

    catalogue: str | None = None
    epoch: Annotated[float, msgspec.Meta(ge=1800.0, le=2200.0)] | None = None


class DescentSection(msgspec.Struct, forbid_unknown_fields=True, frozen=True):
    """[descent]: of folders with [inertial].

    windows_above_m  from lower over the ground relative landmarks alone navigate; 0: windows too
    """

    windows_above_m: Annotated[float, msgspec.Meta(ge=0.0, le=1e6)] = 0.0


class NavigateSettings(msgspec.Struct, forbid_unknown_fields=True, frozen=True):
    """The navigation config."""

    view: ViewSettings = ViewSettings()
    match: MatchSettings = MatchSettings()
    solve: SolveSettings = SolveSettings()
    points: PickedSettings = PickedSettings()
    stars: StarsSettings = StarsSettings()
    descent: DescentSection = DescentSection()
    spice: SpiceSettings = SpiceSettings()

    def attitude_sigma_rad(self, stated: float | None) -> float:
        """Return 1 sigma per axis of an attitude: the stated one, or a free one's first guess."""
        return radians(self.solve.free_attitude_deg) if stated is None else stated


def load_settings(path: Path) -> NavigateSettings:
    """Load the navigation config of a file; its kernels lie beside it.

    Raises ConfigError for a wrong file and for a shared kernel that is not there.
    """
    settings = load_toml(path, NavigateSettings)
    kernels = tuple(str(resolve_path(name, path.parent)) for name in settings.spice.kernels)
    stars = settings.stars
    if stars.catalogue is not None:
        catalogue = str(resolve_path(stars.catalogue, path.parent))
        stars = msgspec.structs.replace(stars, catalogue=catalogue)
    elif stars.epoch is not None:
        raise ConfigError(f"{path}: [stars] epoch is that of `catalogue`, which is not set")
    return msgspec.structs.replace(settings, spice=SpiceSettings(kernels), stars=stars)
