"""Moments of the light of a small disc whose body is no sphere.

A sphere's moments follow from the phase alone. Those of an elongated body turn with it, so they are
summed up over its ground as a camera far away and the Sun see it: its relief where that is known,
else its ellipsoid. Ground that other ground hides or shades counts as if it stood free, which is
right for convex bodies.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from catalog.bodies.body import Body
from catalog.geometry.ellipsoid import surface_at
from catalog.geometry.latlon import xyz_from_latlon
from catalog.terrain.relief import GlobalRelief
from optnav_cli.measurements.disc_moments import LAWS, sphere_moments

FloatArray = NDArray[np.float64]

STEPS = 60  # from pole to pole: moments are right to 0.2 %
# Half axes that differ by less of their mean: a sphere.
ROUND = 0.01


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
    places = middles[lit] @ axes_body[:2].T
    found = []
    for law in LAWS:
        light = law(mu0[lit], mu[lit], np.cos(phase)) * mu[lit] * areas[lit]
        light /= light.sum()
        offset = light @ places
        away = places - offset
        found.append(LightMoments(offset, (light[:, None] * away).T @ away))
    return found


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
