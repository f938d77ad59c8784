"""The gravity of a body of even density from its mesh, as coefficients to a degree.

The solid harmonics of degree n are homogeneous: over the tetrahedron between the centre and a face
their integral is 3/(n + 3) of its volume times their mean on the face. The mean is taken by the
rule of seven points, exact to degree 5; faces are a hundredth of the body, so above it as well.
"""

import math

import numpy as np

from catalog.arrays import FloatArray
from catalog.terrain.mesh.shape import Shape
from optnav_cli.dynamics.gravity_field import HarmonicField

# Rule of degree 5 on a triangle: Strang and Fix, "An Analysis of the Finite Element Method", 1973.
_ROOT = np.sqrt(15.0)
_NEAR, _FAR = (6.0 - _ROOT) / 21.0, (6.0 + _ROOT) / 21.0
_RULE = [(1.0 / 3.0, 1.0 / 3.0, 9.0 / 40.0)]
for _a, _w in ((_NEAR, (155.0 - _ROOT) / 1200.0), (_FAR, (155.0 + _ROOT) / 1200.0)):
    _RULE += [(_a, _a, _w), (1.0 - 2.0 * _a, _a, _w), (_a, 1.0 - 2.0 * _a, _w)]


def mesh_field(shape: Shape, radius_m: float, degree: int) -> HarmonicField:
    """Coefficients of degrees 2 to `degree` for a radius.

    Degrees 0 and 1 are 0: the point mass stands apart, and a body's ephemeris is that of its centre
    of mass, whatever its figure's centre is.
    """
    corners = shape.vertices[shape.faces] / radius_m
    a, b, c = (corners[:, k] for k in range(3))
    volume = np.einsum("ij,ij->i", a, np.cross(b, c)) / 6.0
    size = degree + 1
    sums = np.zeros((2, size, size))
    for u, v, weight in _RULE:
        points = (1.0 - u - v) * a + u * b + v * c
        sums += weight * np.einsum("knmi,i->knm", _solid(points, size), volume)
    cosines, sines = np.zeros((size, size)), np.zeros((size, size))
    for n in range(2, size):
        for m in range(n + 1):
            share = (2.0 if m else 1.0) * math.factorial(n - m) / math.factorial(n + m)
            scale = math.sqrt(share / (2.0 * n + 1.0)) * 3.0 / (n + 3.0) / float(volume.sum())
            cosines[n, m], sines[n, m] = scale * sums[:, n, m]
    return HarmonicField(radius_m, cosines, sines, None, "mesh of even density")


def _solid(points: FloatArray, size: int) -> FloatArray:
    """r^n P_nm(sin lat) times cos and sin of m lon (2, n, m, i) at points (i, 3)."""
    x, y, z = points.T
    squared = x * x + y * y + z * z
    harmonics = np.zeros((2, size, size, len(points)))
    harmonics[0, 0, 0] = 1.0
    for m in range(size):
        if m:
            c, s = harmonics[:, m - 1, m - 1]
            harmonics[:, m, m] = (2 * m - 1) * np.stack([x * c - y * s, x * s + y * c])
        for n in range(m + 1, size):
            harmonics[:, n, m] = (2 * n - 1) * z * harmonics[:, n - 1, m] / (n - m)
            if n > m + 1:
                harmonics[:, n, m] -= (n + m - 1) * squared * harmonics[:, n - 2, m] / (n - m)
    return harmonics
