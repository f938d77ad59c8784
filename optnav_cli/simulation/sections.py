"""The sections of a scenario file that all scenarios share; see `scenario`."""

from typing import Annotated

import msgspec
from msgspec import Meta

from optnav_cli.simulation.flight_settings import AttitudeFrame

Positive = Annotated[float, Meta(gt=0.0)]
NotNegative = Annotated[float, Meta(ge=0.0)]
Count = Annotated[int, Meta(ge=1)]
Latitude = Annotated[float, Meta(ge=-90.0, le=90.0)]
Elevation = Annotated[float, Meta(ge=-90.0, le=90.0)]
Phase = Annotated[float, Meta(ge=0.0, le=180.0)]


class GlobeDetailSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Relief below the globe's posting around terrain models; see DetailSettings for the rest."""

    smallest_m: Positive
    rms_slope_deg: NotNegative
    saturation: NotNegative = 0.05


class GlobeSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The ground outside the terrain models, all round the body.

    detail  relief to add there, with the seeds of [detail]; smooth when unset
    """

    path: str = "moon_gld100_4ppd.tif"
    # unset, not null, so that the copy of a scenario without it has no such line
    detail: GlobeDetailSettings | msgspec.UnsetType = msgspec.UNSET


class DetailSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Relief added below the posting of the first terrain model, or else of the globe.

    It is made by catalog.terrain.detail.

    seeds  one ground each; passes take them in turn, in equal parts. Empty adds nothing
    """

    seeds: tuple[int, ...] = (1,)
    smallest_m: Positive = 30.0
    rms_slope_deg: NotNegative = 3.0
    saturation: NotNegative = 0.05


class CameraSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """name: a shipped camera, or a path to a camera file, relative to the scenario."""

    name: str


class OrbitSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Passes on circular orbits, each over its own place.

    box_deg      west, south, east, north of where the middles of the passes lie
    heading_deg  lowest and highest direction of flight there, east of north
    """

    altitude_km: Positive
    box_deg: tuple[float, Latitude, float, Latitude]
    passes: Count = 1
    frames: Count = 1
    spacing_s: Positive = 10.0
    heading_deg: tuple[float, float] = (-180.0, 180.0)
    start_utc: str = "2026-01-01T00:00:00Z"
    pass_interval_s: Positive = 7200.0


class PortraitSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Single pictures of a whole body from all sides.

    distance_km            from the body's centre: of the first picture and of the last one
    phase_deg              lowest and highest angle at the body between the camera and the Sun
    subsolar_latitude_deg  how far from the equator the Sun stands overhead at most
    """

    distance_km: tuple[Positive, Positive]
    frames: Count = 1
    phase_deg: tuple[Phase, Phase] = (20.0, 70.0)
    subsolar_latitude_deg: NotNegative = 26.0
    start_utc: str = "2026-01-01T00:00:00Z"
    interval_s: Positive = 86400.0


class PointingSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Boresight and roll about the way down and forward, each with its scatter (1 sigma a frame).

    forward_deg, right_deg  where the boresight meets the ground from the point below, as angles
    """

    forward_deg: float = 0.0
    right_deg: float = 0.0
    roll_deg: float = 0.0
    tilt_sigma_deg: NotNegative = 0.0
    roll_sigma_deg: NotNegative = 0.0


class SunSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The Sun of each pass, morning or evening, as high at the pass' middle as the range says.

    elevation_deg          lowest and highest; the passes share the range evenly
    subsolar_latitude_deg  how far from the equator the Sun stands overhead at most (Moon: 1.54)
    """

    elevation_deg: tuple[Elevation, Elevation] = (10.0, 45.0)
    subsolar_latitude_deg: NotNegative = 1.5


class SensorSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """psf_sigma_px: the lens' blur; snr: of the mean lit signal, shot and read noise together.

    hot_pixels  how many pixels shine by themselves, the same ones in all pictures of a camera
    """

    psf_sigma_px: NotNegative = 0.7
    snr: Positive = 50.0
    read_noise_e: NotNegative = 10.0
    bits: Annotated[int, Meta(ge=6, le=16)] = 8
    exposure: Annotated[float, Meta(gt=0.0, le=1.0)] = 0.85
    hot_pixels: Annotated[int, Meta(ge=0)] = 0


class PriorSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """position_sigma_m: 1 sigma a component of the error added to the prior position.

    given  false: frames.csv tells no position
    """

    position_sigma_m: NotNegative = 3000.0
    given: bool = True


class AttitudeSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """sigma_arcsec: 1 sigma an axis of the error added to the attitude, 0 for exact.

    free         the attitude in frames.csv is a first guess only: its sigma is left empty
    relative_to  what frames.csv gives it against, the body's axes or the stars'
    """

    sigma_arcsec: NotNegative = 0.0
    free: bool = False
    relative_to: AttitudeFrame = "body"
