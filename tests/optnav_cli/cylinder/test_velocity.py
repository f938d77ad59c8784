"""Speeds by pictures of one cylinder: one cloth for all, and what their errors add up to."""

import math

import numpy as np
import pytest

from optnav_cli.cylinder.fit import UNKNOWNS, CylinderFit
from optnav_cli.cylinder.velocity import (
    CLOTH,
    CLOTH_SIGMAS,
    compute_velocity,
    place_series,
)

TURN = 0.4  # of theta, rad, by an error of the first lobe of gloss
DISTANCE_M, RATE = 1.34, math.radians(2.1)
WEIGHTS = np.array([-0.25, 0.0, 0.25])  # three pictures 2 s apart


def fit_at(theta: float, cloth: np.ndarray, off: np.ndarray) -> CylinderFit:
    """A picture's fit: its cloth is off, and theta with its first lobe."""
    state = np.zeros(UNKNOWNS)
    state[[0, 2, 7]] = DISTANCE_M, theta + TURN * off[-3], 1.0
    state[CLOTH] = cloth + off
    covariance = np.diag(np.full(UNKNOWNS, 1e-10))
    covariance[CLOTH, CLOTH] = (0.1 * CLOTH_SIGMAS) ** 2
    lobe = CLOTH[-3]
    covariance[2, lobe] = covariance[lobe, 2] = TURN * covariance[lobe, lobe]
    covariance[2, 2] += TURN**2 * covariance[lobe, lobe]
    noise = np.diag(np.full(UNKNOWNS, 1e-11))
    return CylinderFit(
        DISTANCE_M, 0.0, float(state[2]), covariance[:3, :3], 0.3, state, covariance, noise, 100.0
    )


def flight(seed: int, count: int = 30) -> list[CylinderFit]:
    """Pictures of a circle, each with an error of its cloth of its own."""
    rng = np.random.default_rng(seed)
    cloth = CLOTH_SIGMAS * rng.normal(size=len(CLOTH))
    thetas = -0.5 + 2.0 * RATE * np.arange(count)
    return [fit_at(t, cloth, 0.1 * CLOTH_SIGMAS * rng.normal(size=len(CLOTH))) for t in thetas]


def test_one_cloth_takes_out_of_speeds_what_pictures_alone_cannot_tell() -> None:
    fits = flight(1)
    turns = np.array([fits[k + 2].theta - fits[k].theta for k in range(28)])
    off_alone = DISTANCE_M * np.abs(turns - 4.0 * RATE) / 4.0
    places = place_series(fits)
    speeds = [math.hypot(*compute_velocity(places[k : k + 3], WEIGHTS)[:2]) for k in range(28)]
    # the chord of 4 s; what is left of the cloth's error turns all places alike
    chord = DISTANCE_M * math.sin(2.0 * RATE) / 2.0
    assert np.abs(np.array(speeds) - chord).max() < 1e-9 < 1e-3 < max(off_alone)


def test_a_picture_of_another_cloth_leads_the_rest_hardly_astray() -> None:
    fits = flight(2)
    alone = [place.position for place in place_series(fits)]
    odd = fit_at(0.2, fits[0].state[CLOTH], 40.0 * 0.1 * CLOTH_SIGMAS)
    mixed = [place.position for place in place_series([*fits, odd])]
    # a fair share of 31 would move them by 4 / 31 sigmas of the lobe: 0.014 m
    moved = np.linalg.norm(np.array(mixed[:30]) - alone, axis=1)
    assert moved.max() < 0.2 * DISTANCE_M * TURN * 4.0 * CLOTH_SIGMAS[-3] / 31.0


def test_the_sigma_of_a_speed_is_that_of_noise_and_cloth() -> None:
    """The cloth's error is one for all, and turns with the axes; a picture's own errors add up."""
    places = place_series(flight(3))
    sigma = compute_velocity(places[:3], WEIGHTS)[2]
    noise = [float(np.trace(place.noise)) for place in places[:3]]
    own = sum(weight**2 * one for weight, one in zip(WEIGHTS, noise, strict=True))
    lobe = 0.1 * CLOTH_SIGMAS[-3] * TURN * DISTANCE_M * 2.0 * math.sin(2.0 * RATE) / 4.0
    # pictures of cloths that scatter by their sigmas widen them by some hundredths
    assert sigma == pytest.approx(math.sqrt(0.5 * (own + lobe**2)), rel=0.1)


def test_no_pictures_have_no_places() -> None:
    assert place_series([]) == []
