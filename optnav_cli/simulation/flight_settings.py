"""Settings of a scenario's real paths: an orbit in inertial space, an approach from afar."""

from typing import Annotated, Literal

import msgspec
from msgspec import Meta

Positive = Annotated[float, Meta(gt=0.0)]
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
