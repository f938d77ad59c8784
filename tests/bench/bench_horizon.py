"""The fit of a limb, and a whole horizon frame from its picture, edges and relief included."""

import numpy as np
import pytest

from catalog.terrain.relief.sums import load_relief
from catalog.terrain.skyline.limb import make_nadir_axes
from optnav_cli.frames.picture import Picture
from optnav_cli.outline.limb.model import fit_limb
from optnav_cli.outline.method import navigate
from tests.bench.timing import best, one_core, result, sized, within
from tests.optnav_cli.conftest import pixel_grid
from tests.optnav_cli.outline.limb.limbs import CAMERA, MOON, attitude, place

pytestmark = pytest.mark.bench

FITS = sized(50, 1)
FIT_MS, GIANT_FIT_MS = 0.2, 37.0  # what the figures ask for; NASA's GIANT
FRAME_MS = 500.0
GIANT_FRAME_MS = 800.0  # of a sphere, in a picture of 1024 x 1024


@pytest.mark.parametrize("radii", [(1737400.0,) * 3, (13000.0, 11400.0, 9100.0)])
def test_the_fit_of_1000_limb_points(radii):
    # a circular cone in the frame where the body is the unit sphere
    position = 1.5 * np.array([0.4, -0.5, 0.9])
    axes = make_nadir_axes(position)
    azimuths = np.linspace(-2.5, 2.5, 1000)
    across = np.cos(azimuths)[:, None] * axes[0] + np.sin(azimuths)[:, None] * axes[1]
    sine = 1.0 / np.linalg.norm(position)
    rays = (sine * across - np.sqrt(1.0 - sine**2) * axes[2]) * radii
    rays /= np.linalg.norm(rays, axis=1)[:, None]
    rays += np.random.default_rng(1).normal(0.0, 1e-4, rays.shape)

    def many():
        for _ in range(FITS):
            fit_limb(rays, 1e-4, radii)

    with one_core():
        milliseconds = 1e3 * best(many, 5) / FITS
    shape = "a sphere" if len(set(radii)) == 1 else "an ellipsoid"
    result(
        f"the limb of {shape} through 1000 points, with covariance",
        f"{milliseconds:.3f} ms",
        f"limit {FIT_MS:g} ms; NASA's GIANT {GIANT_FIT_MS:g} ms",
    )
    assert within(milliseconds, FIT_MS)


def test_a_whole_frame_over_relief():
    """2048 x 2048 pixels: the bundled Moon's own skyline, drawn as an even bright body."""
    relief = load_relief("bundled:moon_gld100_4ppd.tif", MOON)
    position = place(2e5, 3)
    turned = attitude(position)
    up = position / np.linalg.norm(position)
    picture = Picture(_drawn(relief, position, turned), 255.0)

    def call():
        return navigate(picture, CAMERA, turned, 0.0, up, MOON, relief)

    with one_core():
        milliseconds = 1e3 * best(call, 5)
        found = call()
    error = float(np.linalg.norm(found.position_m - position))
    result(
        "a frame of 2048² by the limb over relief",
        f"{milliseconds:.0f} ms, {error:.0f} m off",
        f"limit {FRAME_MS:g} ms; NASA's GIANT {GIANT_FRAME_MS:g} ms for a sphere, 1024²",
    )
    assert within(milliseconds, FRAME_MS)


def _drawn(relief, position, turned):
    """Counts (2048, 2048) of a body bright up to its skyline, blurred by a pixel's share."""
    from optnav_cli.outline.limb.ground_skyline import make_relief_skyline

    axes = make_nadir_axes(position)
    table = np.linspace(-np.pi, np.pi, 4001)
    line = make_relief_skyline(relief, "moon").limb.skyline(position, axes, table)
    rays = turned.inv().apply(CAMERA.unproject(pixel_grid(CAMERA)).reshape(-1, 3)) @ axes.T
    off_nadir = np.arccos(np.clip(-rays[:, 2], -1.0, 1.0))
    edge = np.interp(np.arctan2(rays[:, 1], rays[:, 0]), table, line.off_nadir)
    depth = (edge - off_nadir) / CAMERA.angular_resolution
    bright = 200.0 / (1.0 + np.exp(-np.clip(depth, -50.0, 50.0) / 0.45))
    noise = np.random.default_rng(1).normal(3.0, 1.5, bright.shape)
    counts = np.clip(np.rint(bright + noise), 0, 255)
    return counts.reshape(CAMERA.shape).astype(np.float32)
