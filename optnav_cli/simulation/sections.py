"""The sections of a scenario file that all scenarios share; see `scenario`."""

from typing import Annotated, Literal

import msgspec
from msgspec import Meta

Positive = Annotated[float, Meta(gt=0.0)]
NotNegative = Annotated[float, Meta(ge=0.0)]
Inclination = Annotated[float, Meta(ge=0.0, le=180.0)]


class FlightSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """One orbit in inertial space, moved by gravity alone, under the Sun of its date.

    lowest_km, highest_km  heights of its ends over the reference sphere
    inclination_deg        to the equator of the start
    node_deg               longitude on the body of the ascending node at the start
    lowest_at_deg          from the node to the lowest point, along the flight
    start_at_deg           from the node to where the first picture is taken
    rough_gravity          also what the force model leaves out, of its known size, by the seed
    """

    lowest_km: Positive
    highest_km: Positive
    inclination_deg: Inclination = 90.0
    node_deg: float = 0.0
    lowest_at_deg: float = 0.0
    start_at_deg: float = 0.0
    start_utc: str = "2026-01-01T00:00:00Z"
    frames: Annotated[int, Meta(ge=1)] = 1
    spacing_s: Positive = 60.0
    rough_gravity: bool = True


class TransferSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """An approach to the lowest point of a path that comes from far away.

    from_km, to_km   heights over the reference sphere of the first and the last, lowest picture
    excess_speed_km_s  speed against the body that the path would have far away from it
    frames           pictures at distances from the centre in even ratios
    inclination_deg, node_deg, lowest_at_deg  as in [flight], at the arrival
    """

    from_km: Positive = 100_000.0
    to_km: Positive = 100.0
    excess_speed_km_s: Positive = 0.9
    inclination_deg: Inclination = 60.0
    node_deg: float = 0.0
    lowest_at_deg: float = 0.0
    arrival_utc: str = "2026-01-01T00:00:00Z"
    frames: Annotated[int, Meta(ge=2)] = 60


class ApproachSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """A slow way to the lowest point of a path past a small body; see `approach`.

    from_km, to_km   from the body's centre: the first picture and the last, lowest one
    speed_m_s        at the lowest point, against the body
    frames           pictures at distances from the centre in even ratios
    inclination_deg, node_deg, lowest_at_deg  as in [flight], at the arrival
    """

    from_km: Positive = 300.0
    to_km: Positive = 20.0
    speed_m_s: Positive = 30.0
    inclination_deg: Inclination = 90.0
    node_deg: float = 0.0
    lowest_at_deg: float = 0.0
    arrival_utc: str = "2026-01-01T00:00:00Z"
    frames: Annotated[int, Meta(ge=2)] = 60


class MountedCamera(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A camera of a ship that has several; it looks down unless turned, as in [pointing].

    name  a shipped camera, or a path to a camera file, relative to the scenario
    """

    name: str
    forward_deg: float = 0.0
    right_deg: float = 0.0
    roll_deg: float = 0.0


AttitudeFrame = Literal["body", "inertial"]


Pixel = tuple[float, float]


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

    strength: NotNegative = 0.0
    falloff_deg: Annotated[float, Meta(gt=0.0)] = 30.0


class StructureSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A part of the ship in view of a camera, in front of everything.

    outline_px   corners, px
    width_px     of a rod along the corners; 0: the corners bound a panel
    brightness   share of the bright ground; 0 is black
    camera       which camera sees it; "" for every one
    """

    outline_px: Annotated[tuple[Pixel, ...], Meta(min_length=2)]
    width_px: NotNegative = 0.0
    brightness: NotNegative = 0.0
    camera: str = ""


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

    It is made by catalog.terrain.synthetic.relief.

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
