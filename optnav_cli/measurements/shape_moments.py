"""Moments of the light of a small disc whose body is no sphere.

A sphere's moments follow from the phase alone. Those of an elongated body turn with it, so they are
summed up over its ground as a camera far away and the Sun see it: its relief where that is known,
with the shadows that it throws and the ground that it hides, else its ellipsoid.
"""

from dataclasses import dataclass

import numpy as np

from catalog.arrays import BoolArray, Float32Array, FloatArray
from catalog.bodies.body import Body
from catalog.geometry.ellipsoid import surface_at
from catalog.geometry.kernel import kernel
from catalog.geometry.latlon import xyz_from_latlon
from catalog.terrain.relief import GlobalRelief, relief_height
from optnav_cli.measurements.disc_moments import LAWS, sphere_moments

STEPS = 60  # from pole to pole: moments are right to 0.2 %
# Half axes that differ by less of their mean: a sphere.
ROUND = 0.01
# Of the radius, along a ray from the ground: a cell's own bend hides nothing, nor less than a step.
FIRST_STEP, LEAST_STEP = 0.05, 0.02


@dataclass(frozen=True, eq=False)
class LightMoments:
    """Light of a body in units of its mean half axis; x toward the Sun in the picture, y beside it.

    offset (2,)   middle of light from the centre
    second (2, 2) second moments about it
    """

    offset: FloatArray
    second: FloatArray


def is_round(body: Body) -> bool:
    """Whether a body counts as a sphere here."""
    radii = np.array(body.radii_m)
    return bool(np.ptp(radii) < ROUND * radii.mean())


def light_moments(
    body: Body,
    relief: GlobalRelief | None,
    axes_body: FloatArray,
    sun_body: FloatArray,
    phase: float,
) -> list[LightMoments]:
    """Moments for each of LAWS.

    axes_body  (3, 3) rows: x and y of the picture and the direction to the camera, body frame
    sun_body   (3,) unit vector;  phase  rad, between Sun and camera
    """
    if is_round(body):
        return [
            LightMoments(np.array([s.offset, 0.0]), np.diag([s.along, s.across]))
            for s in sphere_moments(phase)
        ]
    middles, across = _ground(body, relief)
    areas = np.linalg.norm(across, axis=1)
    normals = across / areas[:, None]
    mu, mu0 = normals @ axes_body[2], normals @ sun_body
    lit = (mu > 0.0) & (mu0 > 0.0)
    if relief is not None:
        places = np.ascontiguousarray(middles * np.mean(body.radii_m))
        highest = relief.radius_m + float(relief.heights.max())
        for direction in (sun_body, axes_body[2]):
            towards = np.ascontiguousarray(direction, dtype=np.float64)
            _shade(relief.heights, relief.radius_m, highest, places, towards, lit)
    places = middles[lit] @ axes_body[:2].T
    found = []
    for law in LAWS:
        light = law(mu0[lit], mu[lit], np.cos(phase)) * mu[lit] * areas[lit]
        light /= light.sum()
        offset = light @ places
        away = places - offset
        found.append(LightMoments(offset, (light[:, None] * away).T @ away))
    return found


@kernel
def _shade(
    heights: Float32Array,
    radius: float,
    highest: float,
    places: FloatArray,
    direction: FloatArray,
    free: BoolArray,
) -> None:
    """Clear `free` (n,) where ground stands in a direction (3,) from places (n, 3), m.

    highest  distance from the centre, m, beyond which there is no ground
    """
    for i in range(len(places)):
        if not free[i]:
            continue
        along = FIRST_STEP * radius
        while True:
            x = places[i, 0] + along * direction[0]
            y = places[i, 1] + along * direction[1]
            z = places[i, 2] + along * direction[2]
            out = np.sqrt(x * x + y * y + z * z)
            if out > highest:
                break
            above = out - radius - relief_height(heights, np.arcsin(z / out), np.arctan2(y, x))
            if above < 0.0:
                free[i] = False
                break
            along += max(0.5 * above, LEAST_STEP * radius)


def _ground(body: Body, relief: GlobalRelief | None) -> tuple[FloatArray, FloatArray]:
    """Middles (n, 3) of the body's ground in mean half axes, and its areas as outward vectors."""
    lat = np.linspace(0.5 * np.pi, -0.5 * np.pi, STEPS + 1)[:, None]
    lon = np.linspace(-np.pi, np.pi, 2 * STEPS + 1)[None, :]
    directions = xyz_from_latlon(lat, lon, 1.0)
    if relief is None:
        corners = surface_at(directions, body.radii_m)
    else:
        corners = directions * (relief.radius_m + relief.heights_at(lat, lon))[..., None]
    corners /= np.mean(body.radii_m)
    a, b, c, d = corners[:-1, :-1], corners[1:, :-1], corners[1:, 1:], corners[:-1, 1:]
    middles = 0.25 * (a + b + c + d)
    return middles.reshape(-1, 3), 0.5 * np.cross(c - a, d - b).reshape(-1, 3)
