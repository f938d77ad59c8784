"""Lit cylinders in counts whose coding is not stated, for `study cylinder`.

Pictures are drawn with several rows a pixel and blurred between them, as a lens does: edges of a
picture that is blurred pixel by pixel have kinks, by which gamma shows better than in real ones.
"""

import math
from collections.abc import Callable
from dataclasses import replace

import cv2
import numpy as np

from catalog.arrays import Float32Array, FloatArray
from catalog.errors import NoSolutionError
from catalog.progress import Progress
from optnav_cli.camera.camera import Camera
from optnav_cli.camera.camera_file import preset_camera
from optnav_cli.cylinder.fit import CylinderFit, fit_cylinder
from optnav_cli.cylinder.gamma import fit_coded_cylinder
from optnav_cli.cylinder.geometry import CylinderSize, IdealLens
from optnav_cli.cylinder.profile import measure_profile
from optnav_cli.simulation.cylinder_scenario import CylinderSurface, draw_cylinder
from optnav_cli.simulation.sections import SensorSettings
from optnav_cli.simulation.sensor import expose
from tests.studies.tables import Cell, rms

CAMERA, SIZE = "lab_20deg", CylinderSize(0.14, 0.15)
LIGHTS_DEG = ((3.0, 100.0), (100.0, 130.0), (130.0, 145.0))
AWAY_M, BEARING_DEG, BLUR_PX = (0.9, 2.5), 2.5, (0.5, 1.0)
ROWS, BITS, FULL = 5, 14, 255.0  # drawn a pixel; of the sensor, before the counts are coded

# Light, a share of full scale, to counts of full scale 1, and back; sRGB of IEC 61966-2-1.
Curve = Callable[[FloatArray], FloatArray]
CODINGS: dict[str, tuple[Curve, Curve]] = {
    "linear": (lambda light: light, lambda counts: counts),
    "gamma 2.2": (lambda light: light ** (1.0 / 2.2), lambda counts: counts**2.2),
    "sRGB": (
        lambda x: np.where(x <= 0.0031308, 12.92 * x, 1.055 * x ** (1.0 / 2.4) - 0.055),
        lambda y: np.where(y <= 0.04045, y / 12.92, ((y + 0.055) / 1.055) ** 2.4),
    ),
}


def coded_rows(progress: Progress, trials: int, seed: int) -> list[tuple[Cell, ...]]:
    """A row per coding over pictures of three bands of light, `trials` of each."""
    rows = []
    with progress.stage("codings", len(CODINGS) * len(LIGHTS_DEG) * trials, "picture") as bar:
        for name, curves in CODINGS.items():
            solved = []
            for band in range(len(LIGHTS_DEG)):
                for trial in range(trials):
                    try:
                        rng = np.random.default_rng([seed, 9, band, trial])
                        solved.append(_trial(rng, band, curves))
                    except NoSolutionError:
                        pass
                    bar.advance()
            rows.append((name, len(LIGHTS_DEG) * trials, len(solved), *_cells(solved)))
    return rows


def _trial(rng: np.random.Generator, band: int, curves: tuple[Curve, Curve]) -> list[float]:
    """Gamma and its sigma; errors and sigmas of d, m, and theta, rad; of d with a known coding."""
    theta = math.radians(rng.uniform(*LIGHTS_DEG[band])) * float(rng.choice([-1.0, 1.0]))
    distance = SIZE.radius_m + float(rng.uniform(*AWAY_M))
    place = distance, math.radians(rng.uniform(-BEARING_DEG, BEARING_DEG)), theta
    camera = preset_camera(CAMERA)
    counts = coded_picture(camera, place, curves[0], rng)
    lens = IdealLens(*(camera.focal_length_px,) * 2, *camera.principal_point_px)
    coded = fit_coded_cylinder(counts, FULL, measure_profile(counts, FULL), lens, SIZE)
    light = FULL * curves[1](counts.astype(np.float64) / FULL)
    known = fit_cylinder(measure_profile(light.astype(np.float32), FULL), lens, SIZE)
    off = (coded.fit.theta - theta + math.pi) % (2.0 * math.pi) - math.pi
    sigma, known_sigma = (_sigmas(fit) for fit in (coded.fit, known))
    return [
        *(coded.gamma, coded.gamma_sigma, coded.fit.distance_m - distance, sigma[0]),
        *(off, sigma[1], known.distance_m - distance, known_sigma[0]),
    ]


def coded_picture(
    camera: Camera, place: tuple[float, float, float], curve: Curve, rng: np.random.Generator
) -> Float32Array:
    """Counts (rows, columns) of 8 bits of a drawn cloth; place as `draw_cylinder` has it."""
    rows, columns = camera.shape
    x, y = camera.principal_point_px
    fine = replace(
        camera,
        height_px=ROWS * rows,
        focal_length_y_px=ROWS * camera.focal_length_px,
        principal_point_px=(x, ROWS * y + 0.5 * (ROWS - 1)),
    )
    surface = CylinderSurface(
        gloss=float(rng.uniform(0.05, 0.2)),
        gloss_power=float(rng.uniform(10.0, 40.0)),
        ambient=float(rng.uniform(0.02, 0.05)),
    )
    blur = float(rng.uniform(*BLUR_PX))
    sensor = SensorSettings(0.0, float(rng.uniform(80.0, 100.0)), bits=BITS)
    drawn = draw_cylinder(fine, (SIZE.radius_m, SIZE.height_m), place, surface)
    blurred = cv2.GaussianBlur(drawn, (0, 0), sigmaX=blur, sigmaY=ROWS * blur)
    pixels = blurred.reshape(rows, ROWS, columns).mean(axis=1)
    light = expose(pixels.astype(np.float32), sensor, rng) / (2.0**BITS - 1.0)
    counts: Float32Array = np.rint(FULL * curve(light)).astype(np.float32)
    return counts


def _sigmas(fit: CylinderFit) -> tuple[float, float]:
    """1 sigma of the distance, m, and of theta, rad."""
    return math.sqrt(fit.covariance[0, 0]), math.sqrt(fit.covariance[2, 2])


def _cells(solved: list[list[float]]) -> tuple[Cell, ...]:
    gamma, gamma_sigma, d, d_sigma, theta, theta_sigma, known, known_sigma = (
        np.array(solved).reshape(-1, 8).T
    )
    held = (np.abs(d) <= 3.0 * d_sigma) & (np.abs(theta) <= 3.0 * theta_sigma)
    return (
        *(float(gamma.mean()), rms(gamma_sigma), 1e3 * rms(d), 1e3 * rms(d_sigma)),
        *(float(np.mean((d / d_sigma) ** 2)), math.degrees(rms(theta))),
        *(float(np.mean((theta / theta_sigma) ** 2)), 100.0 * float(held.mean())),
        *(1e3 * rms(known), 1e3 * rms(known_sigma)),
    )
