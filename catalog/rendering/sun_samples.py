"""Sun directions that can occur at a latitude, spread evenly and always the same.

The Sun stands within `max_declination` of the body's equator, so that at a latitude it passes each
elevation at two bands of azimuth, one in the morning and one in the afternoon; near the poles the
two grow together into the whole circle, and high elevations do not occur.
"""

import math

import numpy as np

from catalog.arrays import FloatArray

MOON_MAX_DECLINATION = math.radians(1.54)  # tilt of the Moon's equator to the ecliptic
LOW_ELEVATION = math.radians(8.0)  # below, most of the ground is in shadow
HIGH_ELEVATION = math.radians(45.0)  # above, relief hardly shows


def find_azimuth_band(
    lat: float, elevation: float, max_declination: float = MOON_MAX_DECLINATION
) -> tuple[float, float] | None:
    """Azimuths (rad from north, 0..pi, east side) at which the Sun passes an elevation.

    The west side is the mirror image. None where the Sun never stands so high (or so low).
    """
    # sin d = sin lat sin el + cos lat cos el cos az; monotonic in cos az
    level = math.cos(lat) * math.cos(elevation)
    tilt = math.sin(lat) * math.sin(elevation)
    reach = math.sin(max_declination)
    if level < 1e-12:  # at a pole: all azimuths or none
        return (0.0, math.pi) if abs(tilt) <= reach + 1e-12 else None
    south, north = (-reach - tilt) / level, (reach - tilt) / level
    if south > 1.0 or north < -1.0:
        return None
    return math.acos(min(north, 1.0)), math.acos(max(south, -1.0))


def find_highest_sun(lat: float, max_declination: float = MOON_MAX_DECLINATION) -> float:
    """The greatest elevation (rad) of the Sun at a latitude."""
    return math.pi / 2.0 - max(abs(lat) - max_declination, 0.0)


def sun_samples(
    lat: float,
    elevations: int = 4,
    azimuths: int = 8,
    *,
    max_declination: float = MOON_MAX_DECLINATION,
    lowest: float = LOW_ELEVATION,
    highest: float = HIGH_ELEVATION,
) -> FloatArray:
    """Unit vectors to the Sun, east, north, up, that can occur at a latitude.

    lat              rad
    elevations       how many elevations, evenly from `lowest` to `highest`, or to just below the
                     greatest that occurs, where that is lower (then from a quarter of it on)
    azimuths         how many azimuths an elevation, an even number: half in the morning
    max_declination  rad, how far from its equator the Sun stands over the body
    Returns (elevations * azimuths, 3), by elevation, then by azimuth.
    Raises ValueError for no elevation or an odd number of azimuths.
    """
    if elevations < 1 or azimuths < 2 or azimuths % 2:
        raise ValueError("sun_samples: at least one elevation and an even number of azimuths")
    top = min(highest, 0.98 * find_highest_sun(lat, max_declination))
    bottom = min(lowest, 0.25 * top)
    half = azimuths // 2
    suns = []
    # in plain numbers: a library takes several times as long for so few
    for number in range(elevations):
        elevation = bottom + (top - bottom) * number / max(elevations - 1, 1)
        band = find_azimuth_band(lat, elevation, max_declination)
        if band is None:
            raise ValueError(
                f"sun_samples: the Sun never stands {math.degrees(elevation):.1f} deg high at "
                f"latitude {math.degrees(lat):.1f}; ask for an elevation that occurs"
            )
        first, last = band
        # the middles of equal parts: at a pole the two sides do not meet in one azimuth
        east = [first + (last - first) * ((k + 0.5) / half) for k in range(half)]
        across, up = math.cos(elevation), math.sin(elevation)
        for azimuth in (*east, *(2.0 * math.pi - angle for angle in reversed(east))):
            suns.append((across * math.sin(azimuth), across * math.cos(azimuth), up))
    return np.array(suns)
