"""The sections of a scenario file that all kinds of scenario share; see `scenario_base`."""

import math
from itertools import pairwise
from typing import Annotated, Literal

import msgspec
import numpy as np
from msgspec import Meta

from catalog.bodies.body import Body
from catalog.config import NotNegative, Slope, Turn
from catalog.errors import ConfigError
from catalog.photometry.sets import LUNAR, HapkeParameters
from catalog.terrain.error_model import ErrorSpectrum, load_terrain_laws
from catalog.terrain.synthetic.model_error import ModelError, SlopeMap
from catalog.terrain.synthetic.relief import SyntheticRelief
from optnav_cli.frames.run_settings import AltimeterSettings

Inclination = Annotated[float, Meta(ge=0.0, le=180.0)]
Latitude = Annotated[float, Meta(ge=-90.0, le=90.0)]
SunLatitude = Annotated[float, Meta(ge=0.0, le=90.0)]
Distance = Annotated[float, Meta(ge=1e-3, le=1e9)]  # km: to Jupiter
Elevation = Annotated[float, Meta(ge=-90.0, le=90.0)]
Seed = Annotated[int, Meta(ge=0, le=2**32 - 1)]
Phase = Annotated[float, Meta(ge=0.0, le=180.0)]
Along = Annotated[float, Meta(ge=-1e6, le=1e6)]
Pixel = tuple[Along, Along]
Brightness = Annotated[float, Meta(ge=0.0, le=1e3)]  # share of the bright ground
Smallest = Annotated[float, Meta(ge=0.01, le=1e6)]  # m
Saturation = Annotated[float, Meta(ge=0.0, le=1.0)]
AttitudeFrame = Literal["body", "inertial"]


class MountedCamera(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A camera of a ship that has several; it looks down unless turned, as in [pointing].

    name  a shipped camera, or a path to a camera file, relative to the scenario
    """

    name: str
    forward_deg: Turn = 0.0
    right_deg: Turn = 0.0
    roll_deg: Turn = 0.0


class SkySettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The sky behind the body.

    stars_to_magnitude  the star that stands out by 5 sigma of the dark noise; brighter ones by as
                        much as they are brighter, fainter ones drown. 0 shows no stars
    earth               the Earth as a lit disc where the picture looks at it
    """

    stars_to_magnitude: Annotated[float, Meta(ge=0.0, le=6.5)] = 0.0
    earth: bool = False


class GlareSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A smooth veil of stray sunlight.

    strength     at the pixel nearest the Sun, as a share of the bright ground; 0 for none
    falloff_deg  farther from the Sun by this angle the veil is fainter by e
    """

    strength: Brightness = 0.0
    falloff_deg: Annotated[float, Meta(ge=1e-3, le=3600.0)] = 30.0


class StructureSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A part of the ship in view of a camera, in front of everything.

    outline_px   corners, px
    width_px     of a rod along the corners; 0: the corners bound a panel
    brightness   share of the bright ground; 0 is black
    camera       which camera sees it; "" for every one
    """

    outline_px: Annotated[tuple[Pixel, ...], Meta(min_length=2)]
    width_px: Annotated[float, Meta(ge=0.0, le=1e4)] = 0.0
    brightness: Brightness = 0.0
    camera: str = ""


class GlobeDetailSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Relief below the globe's posting around terrain models; see DetailSettings for the rest."""

    smallest_m: Smallest
    rms_slope_deg: Slope
    saturation: Saturation = 0.05


class GlobeSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The ground outside the terrain models, all round the body.

    detail  relief to add there, with the seeds of [detail]; smooth when unset
    """

    path: str = "moon_gld100_4ppd.tif"
    # unset, not null, so that the copy of a scenario without it has no such line
    detail: GlobeDetailSettings | msgspec.UnsetType = msgspec.UNSET


class DetailSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Relief added below the posting of the first terrain model, or else of the globe.

    It is made by catalog.terrain.synthetic.relief.

    seeds  one ground each; passes take them in turn, in equal parts. Empty adds nothing
    """

    seeds: tuple[Seed, ...] = (1,)
    smallest_m: Smallest = 30.0
    rms_slope_deg: Slope = 3.0
    saturation: Saturation = 0.05


BoxKm = Annotated[float, Meta(gt=0.0, le=1e5)]
ErrorRms = Annotated[float, Meta(gt=0.0, le=1e5)]  # m
RmsSlope = Annotated[float, Meta(ge=0.0, le=10.0)]  # tangent
# Ground that scatters otherwise than the navigator's law has it: darker, smoother, less backwards.
OTHER_SURFACE = LUNAR._replace(w=0.25, b=0.3, c=0.1, bs0=1.2, theta_bar=math.radians(15.0))


ERROR_ABOVE = 1.4  # postings: below, the octaves of [detail] go on


class ErrorTable(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """A terrain model's error by the size of the ground that it is averaged over, and by slope.

    box_km, rms_m         sides of squares, rising, and the rms of means over them
    slope, slope_rms_m    rms slopes over 1.9 km (tangents), rising, and the rms error of the
                          smallest squares on such ground; by default the same everywhere
    """

    box_km: Annotated[tuple[BoxKm, ...], Meta(min_length=1, max_length=100)]
    rms_m: tuple[ErrorRms, ...]
    slope: tuple[RmsSlope, ...] = ()
    slope_rms_m: tuple[ErrorRms, ...] = ()

    def spectrum(self) -> ErrorSpectrum:
        """Return the spectrum of the truth. Raises ConfigError for lists that do not match."""
        where = "[truth] model_error"
        pairs = ("box_km", "rms_m"), ("slope", "slope_rms_m")
        for by, of in pairs:
            keys, values = getattr(self, by), getattr(self, of)
            if len(keys) != len(values):
                raise ConfigError(
                    f"{where} has {len(keys)} {by} and {len(values)} {of}; "
                    "wanted one value for each"
                )
            if any(a >= b for a, b in pairwise(keys)):
                raise ConfigError(f"{where} {by} is not rising; sort it, smallest first")
        if not self.slope:
            return ErrorSpectrum(self.box_km, self.rms_m)
        at = float(np.interp(self.rms_m[0], self.slope_rms_m, self.slope))
        return ErrorSpectrum(self.box_km, self.rms_m, self.slope, self.slope_rms_m, at)


class AlbedoMapSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """A map of brightness in equal steps of latitude and longitude.

    path        beside the scenario, or "shared:NAME"
    extent_deg  west, south, east, north of its edges; left out where the file has a CRS
    coding      "srgb" for a picture as screens show it, "linear" for reflectance
    """

    path: str
    extent_deg: tuple[Turn, Latitude, Turn, Latitude] | msgspec.UnsetType = msgspec.UNSET
    coding: Literal["srgb", "linear"] = "srgb"


class AltimeterSection(AltimeterSettings, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """[altimeter]: ranges in frames.csv, of the first camera's pictures.

    sigma_m  1 sigma of a range
    beam     as in run.toml
    """

    sigma_m: Annotated[float, Meta(ge=1e-3, le=1e4)] = 1.0

    def measure(self, true_m: float, rng: np.random.Generator) -> float:
        """A range with its error, m."""
        return true_m + self.sigma_m * float(rng.normal())


class TruthSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Differences of the true world from the navigator's models.

    model_error  what the terrain model is wrong by: "none", "gld100" (LROC WAC GLD100 against
                 LOLA), or a table
    albedo       "uniform", "fractal" (5 % rms an octave), or "real": albedo_map, and fractal
                 below its pixels, as much an octave as it has itself about each place
    phase_law    "catalog": the law that catalogs are rendered by; "other": another surface's
    camera       "exact", or "drawn": blur and mounting as far off as the camera file's sigmas say
    """

    model_error: Literal["none", "gld100"] | ErrorTable = "none"
    albedo: Literal["uniform", "fractal", "real"] = "uniform"
    albedo_map: AlbedoMapSettings | msgspec.UnsetType = msgspec.UNSET
    phase_law: Literal["catalog", "other"] = "catalog"
    camera: Literal["exact", "drawn"] = "exact"

    def check(self) -> None:
        """Raise ConfigError for settings that do not go together."""
        self.spectrum()
        if self.albedo == "real" and not self.albedo_map:
            raise ConfigError(
                '[truth] albedo is "real", and there is no albedo_map; '
                'name one, or set albedo = "fractal"'
            )
        if self.albedo_map and self.albedo != "real":
            raise ConfigError(
                f'[truth] has an albedo_map, and albedo is "{self.albedo}"; set "real"'
            )

    def spectrum(self) -> ErrorSpectrum | None:
        """The error of the terrain model, None for none."""
        if isinstance(self.model_error, ErrorTable):
            return self.model_error.spectrum()
        return load_terrain_laws().spectrum.get(self.model_error)

    def find_surface(self, body: Body) -> HapkeParameters:
        """Hapke's parameters of the true ground of a body."""
        return body.photometry.surface if self.phase_law == "catalog" else OTHER_SURFACE


class MainCamera(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """name: a shipped camera, or a path to a camera file, relative to the scenario."""

    name: str


class PointingSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Boresight and roll about the way down and forward, each with its scatter (1 sigma a frame).

    forward_deg, right_deg  where the boresight meets the ground from the point below, as angles
    """

    forward_deg: Turn = 0.0
    right_deg: Turn = 0.0
    roll_deg: Turn = 0.0
    tilt_sigma_deg: Annotated[float, Meta(ge=0.0, le=90.0)] = 0.0
    roll_sigma_deg: Annotated[float, Meta(ge=0.0, le=180.0)] = 0.0


class SensorSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """psf_sigma_px: the lens' blur; snr: of the mean lit signal, shot and read noise together.

    hot_pixels  how many pixels shine by themselves, the same ones in all pictures of a camera
    """

    psf_sigma_px: Annotated[float, Meta(ge=0.0, le=50.0)] = 0.7
    snr: Annotated[float, Meta(ge=1e-3, le=1e6)] = 50.0
    read_noise_e: Annotated[float, Meta(ge=0.0, le=1e6)] = 10.0
    bits: Annotated[int, Meta(ge=6, le=16)] = 8
    exposure: Annotated[float, Meta(ge=1e-3, le=1.0)] = 0.85
    hot_pixels: Annotated[int, Meta(ge=0, le=1_000_000)] = 0


class PriorSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """position_sigma_m: 1 sigma a component of the error added to the prior position.

    along_sigma_m  1 sigma of a further error along the motion, as of a clock that is off
    given          false: frames.csv tells no position
    """

    position_sigma_m: NotNegative = 3000.0
    along_sigma_m: NotNegative | msgspec.UnsetType = msgspec.UNSET
    given: bool = True

    @property
    def component_sigma_m(self) -> float:
        """1 sigma a component, the error along the motion shared out over the three."""
        along = 0.0 if self.along_sigma_m is msgspec.UNSET else self.along_sigma_m
        return math.hypot(self.position_sigma_m, along / math.sqrt(3.0))


class AttitudeSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """sigma_arcsec: 1 sigma an axis of the error added to the attitude, 0 for exact.

    free         the attitude in frames.csv is a first guess only: its sigma is left empty
    relative_to  what frames.csv gives it against, the body's axes or the stars'
    """

    sigma_arcsec: Annotated[float, Meta(ge=0.0, le=648_000.0)] = 0.0
    free: bool = False
    relative_to: AttitudeFrame = "body"


def relief_below(
    settings: DetailSettings | GlobeDetailSettings, seed: int, posting_m: float, radius_m: float
) -> SyntheticRelief:
    """The seeded relief that a section adds below the posting of a model."""
    smallest_m, slope_deg = min(settings.smallest_m, posting_m), settings.rms_slope_deg
    share = settings.saturation
    return SyntheticRelief(seed, posting_m, radius_m, smallest_m, slope_deg, saturation=share)


def error_above(
    spectrum: ErrorSpectrum, seed: int | None, posting_m: float, slopes: SlopeMap, body: Body
) -> ModelError:
    """The error of a terrain model down to its posting, where the relief of [detail] begins."""
    return ModelError(seed or 0, spectrum, ERROR_ABOVE * posting_m, body.radius_m, slopes)
