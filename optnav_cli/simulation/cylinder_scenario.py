"""[cylinder] of a scenario: a lit cylinder, its pictures, and the craft, still or in a circle."""

import math
from typing import Annotated, Literal, Self

import msgspec
import numpy as np
from msgspec import Meta

from catalog.arrays import Float32Array, FloatArray
from catalog.bodies.ephemeris import Ephemeris
from catalog.config import Count, Seconds
from catalog.errors import ConfigError
from optnav_cli.camera.camera import Camera
from optnav_cli.simulation.scenario_base import Epoch, ScenarioBase

COLUMNS = 4  # drawn a pixel; limbs and ends of the strip are smoothed over one of them
MARGIN_PX = 4  # about the strip; beyond it there is nothing to draw
SOURCE_RAYS = 5  # across the source
SOURCE_BRIGHTNESS = 60.0  # of the source in view, over the bright part of the strip

Share = Annotated[float, Meta(ge=0.0, le=10.0)]
Lobe = Annotated[float, Meta(ge=1.0, le=1000.0)]
HalfAngle = Annotated[float, Meta(ge=0.0, le=20.0)]
Elevation = Annotated[float, Meta(ge=-60.0, le=60.0)]
Roughness = Annotated[float, Meta(ge=0.0, le=60.0)]
Length = Annotated[float, Meta(gt=0.0, le=1e4)]
Angle = Annotated[float, Meta(ge=-180.0, le=180.0)]


class CylinderSurface(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """The strip, its light and what lies behind it.

    reflectance     of the cloth without gloss
    roughness_deg   of "oren_nayar": the scatter of its facets
    gloss           of the lobe's peak over the cloth lit straight;  gloss_power  its exponent
    ambient         light from all sides, as brightness of the strip over that of full light
    background      brightness behind it, the same way
    light_half_width_deg, light_elevation_deg  of the source, a disc far away
    """

    reflectance: Literal["lambert", "oren_nayar"] = "lambert"
    roughness_deg: Roughness = 20.0
    gloss: Share = 0.1
    gloss_power: Lobe = 20.0
    ambient: Share = 0.02
    background: Share = 0.0
    light_half_width_deg: HalfAngle = 2.0
    light_elevation_deg: Elevation = 5.0


def draw_cylinder(
    camera: Camera,
    size_m: tuple[float, float],
    place: tuple[float, float, float],
    surface: CylinderSurface,
    below_middle_m: float = 0.0,
) -> Float32Array:
    """Radiance (rows, columns) of a cylinder; 1 is the cloth lit straight.

    size_m  radius, and height of the strip
    place   distance of the axis, m, its bearing and the angle of the light, rad
    below_middle_m  of the camera, from the middle of the strip
    """
    radius, height = size_m
    distance, axis, theta = place
    picture = np.full(camera.shape, surface.background, np.float32)
    first, last, left, right = _box(camera, size_m, place, below_middle_m)
    fine = (np.arange(left * COLUMNS, right * COLUMNS) + 0.5) / COLUMNS - 0.5
    x, y = np.meshgrid(fine, np.arange(first, last, dtype=np.float64))
    if not x.size:
        return picture
    rays = camera.unproject(np.stack([x, y], axis=-1))
    flat = np.hypot(rays[..., 0], rays[..., 2])
    bearing = np.arctan2(rays[..., 0], rays[..., 2]) - axis
    slope = rays[..., 1] / flat  # down, a metre away
    limb = math.asin(radius / distance)
    # a limb falls off over one fine column, an end of the strip over one row
    fine_step = np.abs(np.gradient(bearing, axis=1))
    across = np.clip((limb - np.abs(bearing)) / fine_step + 0.5, 0.0, 1.0)
    sine = np.clip(distance / radius * np.sin(bearing), -1.0, 1.0)
    psi = np.arcsin(sine) - bearing
    distances = np.sqrt(distance**2 + radius**2 - 2.0 * distance * radius * np.cos(psi))
    down = distances * slope - below_middle_m  # of the seen point from the middle of the strip
    row_step = np.abs(np.gradient(slope, axis=0)) * distances
    along = np.clip((0.5 * height - np.abs(down)) / row_step + 0.5, 0.0, 1.0)
    light = _brightness(psi, bearing, slope, theta, surface)
    cover = across * along
    seen = cover * light + (1.0 - cover) * surface.background
    mean: FloatArray = seen.reshape(last - first, right - left, COLUMNS).mean(axis=2)
    picture[first:last, left:right] = mean.astype(np.float32)
    return picture


def _box(
    camera: Camera,
    size_m: tuple[float, float],
    place: tuple[float, float, float],
    below_middle_m: float,
) -> tuple[int, int, int, int]:
    """First row and the row after the last, and columns, that may show the strip."""
    radius, height = size_m
    distance, axis, _ = place
    rows, columns = camera.shape
    limb = math.asin(radius / distance)
    bearings = axis + np.linspace(-limb, limb, 33)
    ends = (np.array([-0.5, 0.5]) * height + below_middle_m) / (distance - radius)
    rays = np.array([[math.sin(b), end, math.cos(b)] for b in bearings for end in (*ends, 0.0)])
    pixels = camera.project(rays)
    if not np.isfinite(pixels).all():
        return 0, rows, 0, columns
    low, high = np.floor(pixels.min(axis=0)) - MARGIN_PX, np.ceil(pixels.max(axis=0)) + MARGIN_PX
    left, right = (int(np.clip(n, 0, columns)) for n in (low[0], high[0] + 1))
    first, last = (int(np.clip(n, 0, rows)) for n in (low[1], high[1] + 1))
    return (first, last, left, right) if last - first > 1 else (0, 0, 0, 0)


def source_glare(
    camera: Camera, axis: float, theta: float, surface: CylinderSurface, falloff_deg: float = 4.0
) -> Float32Array | None:
    """The source in view and its flare (rows, columns), over the bright strip; None if it is not.

    The source is seen at 180 deg less theta from the axis. Flare falls off by e over an angle.
    """
    at = axis + math.copysign(math.pi - abs(theta), theta)
    up = math.radians(surface.light_elevation_deg)
    to_light = np.array([math.cos(up) * math.sin(at), -math.sin(up), math.cos(up) * math.cos(at)])
    rows, columns = camera.shape
    pixels = np.stack(np.meshgrid(np.arange(columns), np.arange(rows)), axis=-1)
    rays = camera.unproject(pixels.astype(np.float64))
    angle = np.degrees(np.arccos(np.clip(rays @ to_light, -1.0, 1.0)))
    half = surface.light_half_width_deg
    if float(angle.min()) > half + falloff_deg:
        return None
    veil = 0.5 * SOURCE_BRIGHTNESS * np.exp(-np.maximum(angle - half, 0.0) * 6.0 / falloff_deg)
    flare: FloatArray = np.where(angle < half, SOURCE_BRIGHTNESS, veil)
    return flare.astype(np.float32)


def _brightness(
    psi: FloatArray, bearing: FloatArray, slope: FloatArray, theta: float, surface: CylinderSurface
) -> FloatArray:
    """Compute brightness by psi, bearing from the axis and slope down to the points."""
    up = math.radians(surface.light_elevation_deg)
    half = math.radians(surface.light_half_width_deg)
    brightness = np.full(psi.shape, surface.ambient)
    # chords of the disc at equal steps across it
    places = (np.arange(SOURCE_RAYS) + 0.5) / SOURCE_RAYS * 2.0 - 1.0
    shares = np.sqrt(1.0 - places**2)
    shares /= shares.sum()
    outgoing = 1.0 / np.sqrt(1.0 + slope**2)
    emission = np.clip(outgoing * np.cos(psi + bearing), 1e-6, 1.0)
    for chord, share in zip(places, shares, strict=True):
        turn = psi - theta - half * chord
        incidence = np.clip(math.cos(up) * np.cos(turn), 0.0, 1.0)
        cloth = incidence * _roughened(incidence, emission, turn, psi + bearing, surface)
        brightness += share * np.where(incidence > 0.0, cloth, 0.0)
        if surface.gloss > 0.0:
            # the half vector's part along the normal: of two unit vectors
            upward = math.sin(up) + slope * outgoing
            middle = math.cos(up) * np.cos(turn) + emission
            turned = math.cos(up) * np.sin(-turn) - outgoing * np.sin(psi + bearing)
            length = np.sqrt(middle**2 + turned**2 + upward**2)
            lobe = np.maximum(middle / np.maximum(length, 1e-9), 0.0) ** surface.gloss_power
            brightness += share * surface.gloss * np.where(incidence > 0.0, lobe, 0.0)
    return brightness


def _roughened(
    incidence: FloatArray,
    emission: FloatArray,
    turn: FloatArray,
    leave: FloatArray,
    surface: CylinderSurface,
) -> FloatArray | float:
    """Oren and Nayar's factor on Lambert's law; light and camera are taken to be level for it."""
    if surface.reflectance == "lambert":
        return 1.0
    square = math.radians(surface.roughness_deg) ** 2
    first = 1.0 - 0.5 * square / (square + 0.33)
    second = 0.45 * square / (square + 0.09)
    incidence_angle, emission_angle = np.arccos(incidence), np.arccos(emission)
    large, small = (
        np.maximum(incidence_angle, emission_angle),
        np.minimum(incidence_angle, emission_angle),
    )
    # on the same side of the normal the azimuths agree, on the other they are opposite
    same = np.maximum(np.sign(turn) * np.sign(leave), 0.0)
    factor: FloatArray = first + second * same * np.sin(large) * np.tan(np.minimum(small, 1.5))
    return factor


class CylinderSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """The cylinder, and where the craft is.

    distance_m      of the craft from the axis at the start
    theta_deg       angle of the light from the craft at the start;  theta_rate_deg_s  its rate: 0
                    is a craft that is held still
    bearing_deg     of the axis from the camera's boresight
    sway_m, sway_deg, sway_s  how far a craft drifts about the path, and the period
    """

    radius_m: Length
    height_m: Length
    distance_m: Length
    theta_deg: Angle
    theta_rate_deg_s: Annotated[float, Meta(ge=-90.0, le=90.0)] = 0.0
    bearing_deg: Annotated[float, Meta(ge=-60.0, le=60.0)] = 0.0
    sway_m: Annotated[float, Meta(ge=0.0, le=100.0)] = 0.0
    sway_deg: Annotated[float, Meta(ge=0.0, le=90.0)] = 0.0
    sway_s: Annotated[float, Meta(gt=0.0, le=1e6)] = 60.0
    pictures: Count = 10
    spacing_s: Seconds = 2.0
    start_utc: str = "2026-01-01T00:00:00Z"
    surface: CylinderSurface = CylinderSurface()


class CylinderScenario(ScenarioBase, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """A cylinder on a table, with [camera], [sensor] and `seed` of any scenario."""

    cylinder: CylinderSettings
    dem: tuple[()] = ()

    def check(self) -> None:
        super().check()
        section = self.cylinder
        if section.distance_m - section.sway_m < 1.2 * section.radius_m:
            raise ConfigError(
                f"[cylinder] distance_m is {section.distance_m:g} and radius_m "
                f"{section.radius_m:g}; wanted a craft outside the cylinder"
            )
        if self.beside:
            raise ConfigError("[cylinder] is seen by one camera; leave out [[beside]]")

    def shortened(self, frames: int) -> Self:
        fewer = min(frames, self.cylinder.pictures)
        return msgspec.structs.replace(
            self, cylinder=msgspec.structs.replace(self.cylinder, pictures=fewer)
        )

    def epochs(self, motion: Ephemeris) -> list[Epoch]:
        return []  # no body is flown over; see `states`

    def states(self) -> FloatArray:
        """Seconds, distance m, theta rad and velocity m/s along x, y (n, 5).

        x points towards the light, y to where theta grows.
        """
        section = self.cylinder
        seconds = np.arange(section.pictures) * section.spacing_s
        pace = 2.0 * math.pi / section.sway_s
        distance = section.distance_m + section.sway_m * np.sin(pace * seconds)
        closing = section.sway_m * pace * np.cos(pace * seconds)
        swing = math.radians(section.sway_deg)
        theta = np.radians(section.theta_deg + section.theta_rate_deg_s * seconds)
        theta = theta + swing * np.sin(1.3 * pace * seconds)
        rate = math.radians(section.theta_rate_deg_s) + 1.3 * pace * swing * np.cos(
            1.3 * pace * seconds
        )
        vx = closing * np.cos(theta) - distance * rate * np.sin(theta)
        vy = closing * np.sin(theta) + distance * rate * np.cos(theta)
        theta = (theta + math.pi) % (2.0 * math.pi) - math.pi
        return np.stack([seconds, distance, theta, vx, vy], axis=1)
