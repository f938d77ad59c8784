"""Band-limited random relief on a sphere: octaves of gradient noise with a power law.

The noise is Perlin's (SIGGRAPH 1985) with hashed gradients on a cubic lattice in body-fixed space,
read on the sphere: no poles, no seams, no net height. One octave of lattice spacing s has its power
about the wavelength 1.4 s and hardly any above 4 s.
"""

from typing import NamedTuple

import numba
import numpy as np

from catalog.arrays import Float32Array, FloatArray
from catalog.geometry.kernel import kernel, parallel_kernel

_A = np.uint64(0xBF58476D1CE4E5B9)
_B = np.uint64(0x94D049BB133111EB)
_GOLDEN = np.uint64(0x9E3779B97F4A7C15)
_S30, _S27, _S31, _S11 = np.uint64(30), np.uint64(27), np.uint64(31), np.uint64(11)
_TO_UNIT = 1.0 / 9007199254740992.0  # 2^-53


@kernel
def mix(value: np.uint64) -> np.uint64:
    """Scramble 64 bits so that neighbouring inputs give unrelated outputs."""
    value = (value ^ (value >> _S30)) * _A
    value = (value ^ (value >> _S27)) * _B
    return value ^ (value >> _S31)


@kernel
def join(state: np.uint64, number: int) -> np.uint64:
    """A new state from a state and an integer of any sign."""
    return mix(state + _GOLDEN + np.uint64(number) * _B)


@kernel
def scale_to_unit(state: np.uint64) -> float:
    """The state's number in [0, 1)."""
    return float(state >> _S11) * _TO_UNIT


WAVELENGTH = 1.4  # of an octave's strongest power, in lattice spacings
# rms surface gradient of the noise below on a random plane, lattice spacing 1; found by sampling
# 400 000 points, and held by a test
RMS_GRADIENT = 0.704
RMS_NOISE = 0.1913  # of the noise itself on such a plane, found likewise
_MASK = np.uint64(0x1FFFFF)
_S21, _S42 = np.uint64(21), np.uint64(42)
_TO_SIGNED = 2.0 / 2097151.0
_P, _Q = np.uint64(0x9E3779B97F4A7C15), np.uint64(0xC2B2AE3D27D4EB4F)
_R = np.uint64(0x165667B19E3779F9)


@kernel
def _evaluate_corner(
    state: np.uint64, i: int, j: int, k: int, x: float, y: float, z: float
) -> float:
    """Product of a lattice corner's random gradient with the way from the corner."""
    h = mix(state ^ (np.uint64(i) * _P + np.uint64(j) * _Q + np.uint64(k) * _R))
    gx = float(h & _MASK) * _TO_SIGNED - 1.0
    gy = float((h >> _S21) & _MASK) * _TO_SIGNED - 1.0
    gz = float((h >> _S42) & _MASK) * _TO_SIGNED - 1.0
    return gx * x + gy * y + gz * z


@kernel
def evaluate_noise(state: np.uint64, x: float, y: float, z: float) -> float:
    """Gradient noise at a point, lattice spacing 1."""
    i, j, k = int(np.floor(x)), int(np.floor(y)), int(np.floor(z))
    x, y, z = x - i, y - j, z - k
    # the quintic blend has no kink in its slope at the lattice planes
    u = x * x * x * (x * (x * 6.0 - 15.0) + 10.0)
    v = y * y * y * (y * (y * 6.0 - 15.0) + 10.0)
    w = z * z * z * (z * (z * 6.0 - 15.0) + 10.0)
    a = _evaluate_corner(state, i, j, k, x, y, z)
    a += u * (_evaluate_corner(state, i + 1, j, k, x - 1.0, y, z) - a)
    b = _evaluate_corner(state, i, j + 1, k, x, y - 1.0, z)
    b += u * (_evaluate_corner(state, i + 1, j + 1, k, x - 1.0, y - 1.0, z) - b)
    c = _evaluate_corner(state, i, j, k + 1, x, y, z - 1.0)
    c += u * (_evaluate_corner(state, i + 1, j, k + 1, x - 1.0, y, z - 1.0) - c)
    d = _evaluate_corner(state, i, j + 1, k + 1, x, y - 1.0, z - 1.0)
    d += u * (_evaluate_corner(state, i + 1, j + 1, k + 1, x - 1.0, y - 1.0, z - 1.0) - d)
    a += v * (b - a)
    c += v * (d - c)
    return a + w * (c - a)


class Octaves(NamedTuple):
    """Random relief as kernels take it.

    spacing, amplitude  (octaves,) m, lattice spacings and amplitudes
    radius              m, of the body
    """

    seed: int
    spacing: FloatArray
    amplitude: FloatArray
    radius: float


def select_resolved(octaves: Octaves, posting_m: float) -> Octaves:
    """The octaves that a grid can show, lowered by the averaging over its cells.

    A mean over a square of side p lowers a wave of length L by about exp(-(pi p / L)^2 / 6).
    """
    length = WAVELENGTH * octaves.spacing
    seen = length >= 2.0 * posting_m * 0.99
    factor = np.exp(-((np.pi * posting_m / length) ** 2) / 6.0)
    amplitude = (octaves.amplitude * factor)[seen]
    return octaves._replace(spacing=octaves.spacing[seen], amplitude=amplitude)


@kernel
def make_octave_state(seed: int, octave: int) -> np.uint64:
    """The noise's state for an octave of a seed."""
    return join(join(np.uint64(0xF2AC7A1), seed), octave)


@kernel
def sum_noise(octaves: Octaves, directions: FloatArray) -> FloatArray:
    """Summed octaves (n,), m, at unit directions (n, 3)."""
    out = np.zeros(directions.shape[0])
    for octave in range(octaves.spacing.size):
        state = make_octave_state(octaves.seed, octave)
        scale = octaves.radius / octaves.spacing[octave]
        for i in range(out.size):
            x, y, z = directions[i, 0], directions[i, 1], directions[i, 2]
            out[i] += octaves.amplitude[octave] * evaluate_noise(
                state, x * scale, y * scale, z * scale
            )
    return out


@parallel_kernel
def add_noise_window(out: Float32Array, octaves: Octaves, lat: FloatArray, lon: FloatArray) -> None:
    """Add the octaves to a grid with latitudes (rows,) and longitudes (cols,), in place."""
    cos_lon, sin_lon = np.cos(lon), np.sin(lon)
    for i in numba.prange(out.shape[0]):
        cos_lat, sin_lat = np.cos(lat[i]), np.sin(lat[i])
        for octave in range(octaves.spacing.size):
            state = make_octave_state(octaves.seed, octave)
            scale = octaves.radius / octaves.spacing[octave]
            z = sin_lat * scale
            for j in range(out.shape[1]):
                x, y = cos_lat * cos_lon[j] * scale, cos_lat * sin_lon[j] * scale
                out[i, j] += np.float32(octaves.amplitude[octave] * evaluate_noise(state, x, y, z))


@parallel_kernel
def add_noise_turned(
    out: Float32Array,
    octaves: Octaves,
    lat: FloatArray,
    lon: FloatArray,
    body_from_grid: FloatArray,
) -> None:
    """Add the octaves to a grid whose latitudes and longitudes are those of a turned frame."""
    cos_lon, sin_lon = np.cos(lon), np.sin(lon)
    m = body_from_grid
    for i in numba.prange(out.shape[0]):
        c, z = np.cos(lat[i]), np.sin(lat[i])
        for octave in range(octaves.spacing.size):
            state = make_octave_state(octaves.seed, octave)
            scale = octaves.radius / octaves.spacing[octave]
            for j in range(out.shape[1]):
                x, y = c * cos_lon[j], c * sin_lon[j]
                p = (m[0, 0] * x + m[0, 1] * y + m[0, 2] * z) * scale
                q = (m[1, 0] * x + m[1, 1] * y + m[1, 2] * z) * scale
                r = (m[2, 0] * x + m[2, 1] * y + m[2, 2] * z) * scale
                out[i, j] += np.float32(octaves.amplitude[octave] * evaluate_noise(state, p, q, r))
