"""A lit cylinder: errors of distance, angle of the light and speed, and the printed formula (6).

Pictures are drawn with cloth and light that the fit does not have. With `fit` the sizes of
configs/models/cylinder.toml are found, on other cloths, another cylinder and other draws.
"""

import math
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import msgspec
import numpy as np
from scipy.optimize import minimize

from catalog.arrays import FloatArray
from catalog.config import resource
from catalog.errors import NoSolutionError
from catalog.progress import Progress, SilentProgress
from optnav_cli.camera.camera_file import preset_camera
from optnav_cli.cylinder.fit import fit_cylinder
from optnav_cli.cylinder.geometry import (
    CylinderErrorSizes,
    CylinderSize,
    compute_grazing,
    find_lit_edges,
    load_error_sizes,
    solve_printed_formulas,
)
from optnav_cli.cylinder.job import (
    CylinderRow,
    add_velocities,
    measure_cylinder_folder,
    remove_distortion,
)
from optnav_cli.cylinder.profile import measure_profile
from optnav_cli.frames.tables import CYLINDER_TRUTH
from optnav_cli.simulation.cylinder_scenario import CylinderScenario, CylinderSurface, draw_cylinder
from optnav_cli.simulation.job import simulate_folder
from optnav_cli.simulation.scenario import load_scenario
from optnav_cli.simulation.sections import SensorSettings
from optnav_cli.simulation.sensor import expose
from tests.studies.cylinder_coding import coded_rows
from tests.studies.tables import Cell, StudyReport, StudyTable, columns, rms

CAMERA = "lab_20deg"
SCENARIO = "configs/scenarios/cylinder_circle.toml"
# angles of the light, and the largest errors that are asked for, m and deg
BANDS = (
    ((3.0, 100.0), (2e-3, 0.5)),
    ((100.0, 130.0), (5e-3, 1.0)),
    ((130.0, 145.0), (30e-3, 2.5)),
    ((145.0, 160.0), (math.nan, math.nan)),
)
FITTED_BANDS = 3  # of these, those that sizes are fitted with
SIZE, FITTED_SIZE = CylinderSize(0.14, 0.15), CylinderSize(0.10, 0.20)
CIRCLE_PICTURES, CIRCLE_M_S = 30, 0.049  # of a circle
# Other circles than the shipped one, of cloths that are drawn: angle of the light where they begin,
# deg, and distance from the axis, m.
CIRCLES = ((-120.0, 1.0), (10.0, 1.8), (60.0, 2.4))
AWAY_M, BEARING_DEG = (0.9, 2.5), 2.5  # of the surface; of the axis, to either side
FORMULA_M, FORMULA_DEG = 1.34, (6, 15, 30, 60, 90, 120)
SPEED_WITHIN_DEG = 130.0
CODED_SHARE = 10  # of a band's trials that have a picture of each coding, which takes some seconds
PLOTTED = 7  # numbers of a trial
ERRORS = columns(
    "light = light [°]; trials; solved; d_rms = d, rms [mm] .2f; d_max = d, largest [mm] .2f; "
    "d_asked = asked [mm] .0f; d_nees = NEES .2f; theta_rms = θ, rms [°] .2f; "
    "theta_max = θ, largest [°] .2f; theta_asked = asked [°] .1f; theta_nees = NEES .2f; "
    "kept = within asked [%] .0f; held = within 3σ [%] .0f"
)
SPEED = columns(
    "circle; pictures; speed = speed [mm/s] .0f; rms = error, rms a component [mm/s] .2f; "
    "largest = largest [mm/s] .2f; asked = asked [mm/s] .0f; sigma = stated [mm/s] .2f; "
    "nees = NEES .2f"
)
CODED = columns(
    "coding; pictures; solved; gamma = γ, mean .2f; gamma_sigma = its σ .2f; "
    "d_rms = d, rms [mm] .2f; d_sigma = stated [mm] .2f; d_nees = NEES .2f; "
    "theta_rms = θ, rms [°] .2f; theta_nees = NEES .2f; held = within 3σ [%] .0f; "
    "known_rms = d with the coding stated, rms [mm] .2f; known_sigma = stated [mm] .2f"
)
FORMULA = columns("true = true θ [°]; printed = formula (6) [°] .1f; exact = exact widths [°] .1f")


@dataclass(frozen=True, eq=False)
class CylinderFigures:
    """Trials (n, 7): band, theta deg, error and sigma of d m, of theta deg, distance m; other rows.

    lost  reasons of pictures without a number, with the band of each
    """

    trials: FloatArray
    lost: list[tuple[int, str]]
    count: int
    speed: list[tuple[Cell, ...]]
    formula: list[tuple[Cell, ...]]
    fitted: CylinderErrorSizes | None = None
    coded: Sequence[tuple[Cell, ...]] = ()


@dataclass(frozen=True, eq=False)
class Circle:
    """A run of pictures from a circle: its rows, and true velocities (n, 2), m/s."""

    rows: list[CylinderRow]
    true_m_s: FloatArray

    def speeds(self, alone: bool = False) -> tuple[FloatArray, FloatArray]:
        """Errors (m, 2) of velocities, m/s, and their stated sigmas (m,).

        alone  with the cloth of three pictures each, as if there were no others
        """
        rows, true_m_s = self.rows, self.true_m_s
        if alone:
            middles = range(1, len(rows) - 1)
            rows = [add_velocities(rows[k - 1 : k + 2])[1] for k in middles]
            true_m_s = true_m_s[1:-1]
        errors, sigmas = [], []
        for row, true in zip(rows, true_m_s, strict=True):
            if row.velocity is None or abs(row.theta_deg or 0.0) > SPEED_WITHIN_DEG:
                continue
            errors.append(np.array(row.velocity[:2]) - true)
            sigmas.append(row.velocity[2])
        return np.array(errors), np.array(sigmas)


def run(progress: Progress, trials: int = 40, seed: int = 1, fit: bool = False) -> CylinderFigures:
    """Draw pictures in each band of light and fit them; fly a circle; compute formula (6)."""
    bands = BANDS[:FITTED_BANDS] if fit else BANDS
    found: list[FloatArray] = []
    lost: list[tuple[int, str]] = []
    with progress.stage("study cylinder", len(bands) * trials, "picture") as bar:
        for band, (light, _) in enumerate(bands):
            rng = np.random.default_rng([seed, band, int(fit)])
            for _ in range(trials):
                try:
                    found.append(np.array([band, *_trial(rng, light, fit)]))
                except NoSolutionError as error:
                    lost.append((band, str(error)))
                bar.advance()
    table = np.array(found).reshape(-1, PLOTTED)
    if fit:
        return CylinderFigures(table, lost, trials, [], [], fitted_sizes(table))
    shipped = _circled(progress)
    speed = [_speed_row("shipped", shipped), _speed_row("three pictures alone", shipped, True)]
    for number, (theta_deg, distance_m) in enumerate(CIRCLES, 1):
        rng = np.random.default_rng([seed, len(bands), number])
        flown = _circled(progress, (theta_deg, distance_m, _cloth(rng)), number)
        speed.append(_speed_row(f"from {theta_deg:.0f} deg at {distance_m:g} m", flown))
    coded = coded_rows(progress, math.ceil(trials / CODED_SHARE), seed)
    return CylinderFigures(table, lost, trials, speed, _formula(), coded=coded)


def _trial(
    rng: np.random.Generator, light: tuple[float, float], fit: bool
) -> tuple[float, float, float, float, float, float]:
    """Angle of the light, error and sigma of the distance, m, of the angle, deg; the distance."""
    size, surface = (FITTED_SIZE, _other_cloth(rng)) if fit else (SIZE, _cloth(rng))
    theta = math.radians(rng.uniform(*light)) * float(rng.choice([-1.0, 1.0]))
    distance = size.radius_m + float(rng.uniform(*AWAY_M))
    bearing = math.radians(rng.uniform(-BEARING_DEG, BEARING_DEG))
    sensor = SensorSettings(float(rng.uniform(0.6, 1.1)), float(rng.uniform(80.0, 100.0)))
    camera = preset_camera(CAMERA)
    drawn = draw_cylinder(
        camera, (size.radius_m, size.height_m), (distance, bearing, theta), surface
    )
    counts = expose(drawn, sensor, rng)
    fix = fit_cylinder(
        measure_profile(counts.astype(np.float32), 255.0), remove_distortion(camera), size
    )
    sigma = np.sqrt(np.diag(fix.covariance))
    off = math.degrees((fix.theta - theta + math.pi) % (2.0 * math.pi) - math.pi)
    place = fix.distance_m - distance, float(sigma[0])
    return math.degrees(abs(theta)), *place, off, math.degrees(sigma[2]), distance


def _cloth(rng: np.random.Generator) -> CylinderSurface:
    """What scores: Lambert's cloth with gloss, a lamp of 4 deg that stands 5 deg high."""
    return CylinderSurface(
        gloss=float(rng.uniform(0.05, 0.2)),
        gloss_power=float(rng.uniform(10.0, 40.0)),
        ambient=float(rng.uniform(0.02, 0.05)),
    )


def _other_cloth(rng: np.random.Generator) -> CylinderSurface:
    """What sizes are fitted with: rough cloth, wider and narrower gloss, lamps of other widths."""
    return CylinderSurface(
        reflectance="oren_nayar",
        roughness_deg=float(rng.uniform(5.0, 30.0)),
        gloss=float(rng.uniform(0.0, 0.25)),
        gloss_power=float(rng.uniform(8.0, 50.0)),
        ambient=float(rng.uniform(0.0, 0.08)),
        light_half_width_deg=float(rng.uniform(0.5, 4.0)),
        light_elevation_deg=float(rng.uniform(-5.0, 5.0)),
    )


def fitted_sizes(trials: FloatArray) -> CylinderErrorSizes:
    """The sizes under which the errors of trials (n, 7) are likeliest."""
    grazing = np.array([compute_grazing(math.radians(theta)) for theta in trials[:, 1]])
    present = load_error_sizes()
    sizes: list[float] = []
    for place, unit in ((2, trials[:, 6]), (4, np.ones(len(trials)))):
        off, sigma = trials[:, place] / unit, trials[:, place + 1] / unit
        known = np.array([present.compute_variances(math.radians(t), 1.0) for t in trials[:, 1]])
        # the picture's part: without the present sizes
        shipped = known[:, 0] if place == 2 else known[:, 1] * math.degrees(1.0) ** 2
        own = np.maximum(sigma**2 - shipped, 0.0)

        def cost(logs: FloatArray, off: FloatArray = off, own: FloatArray = own) -> float:
            variance = own + np.exp(2.0 * logs[0]) + (np.exp(logs[1]) * grazing) ** 2
            return float(np.sum(np.log(variance) + off**2 / variance))

        start = np.full(2, math.log(max(rms(off), 1e-6)))
        sizes += np.exp(minimize(cost, start, method="Nelder-Mead").x).tolist()
    return CylinderErrorSizes(
        distance_share=sizes[0],
        distance_grazing_share=sizes[1],
        theta_deg=sizes[2],
        theta_grazing_deg=sizes[3],
        distance_crescent_share=present.distance_crescent_share,
        theta_crescent_deg=present.theta_crescent_deg,
    )


def _circled(
    progress: Progress, other: tuple[float, float, CylinderSurface] | None = None, number: int = 0
) -> Circle:
    """The shipped craft that circles, or another circle and cloth: pictures 2 s apart.

    other  angle of the light at the start, deg, distance, m, and cloth
    """
    scenario = load_scenario(resource(SCENARIO))
    if not isinstance(scenario, CylinderScenario):
        raise TypeError(f"{SCENARIO} is no scenario of a cylinder")
    if other is not None:
        theta_deg, distance_m, surface = other
        cylinder = msgspec.structs.replace(
            scenario.cylinder,
            theta_deg=theta_deg,
            distance_m=distance_m,
            theta_rate_deg_s=math.degrees(CIRCLE_M_S / distance_m),
            surface=surface,
        )
        scenario = msgspec.structs.replace(scenario, cylinder=cylinder, seed=scenario.seed + number)
    with tempfile.TemporaryDirectory() as folder:
        drawn, run_folder = Path(folder) / "pictures", Path(folder) / "run"
        simulate_folder(scenario.shortened(CIRCLE_PICTURES), drawn, SilentProgress(), workers=1)
        rows = measure_cylinder_folder(drawn, run_folder, "fit", progress)
        truths = CYLINDER_TRUTH.rows(drawn / "truth.csv")
    true = [[truth.number(name) or 0.0 for name in ("vx_m_s", "vy_m_s")] for truth in truths]
    return Circle(rows, np.array(true))


def _speed_row(name: str, circle: Circle, alone: bool = False) -> tuple[Cell, ...]:
    """Errors of speeds by three pictures each."""
    errors, stated = (1e3 * one for one in circle.speeds(alone))
    nees = float(np.mean((errors / stated[:, None]) ** 2))
    largest = float(np.hypot(*errors.T).max())
    speed = 1e3 * float(np.hypot(*circle.true_m_s.T).mean())
    return name, len(errors), speed, rms(errors.ravel()), largest, 1.0, rms(stated), nees


def _formula() -> list[tuple[Cell, ...]]:
    """Formula (6) with the exact angles of the lit area, and theta by the exact geometry."""
    rows: list[tuple[Cell, ...]] = []
    for degrees in FORMULA_DEG:
        left, right = find_lit_edges(math.radians(degrees), SIZE.radius_m, FORMULA_M)
        seen = SIZE.height_m / (FORMULA_M - SIZE.radius_m), right - left
        _, theta = solve_printed_formulas(*seen, SIZE)
        limb = math.asin(SIZE.radius_m / FORMULA_M)
        beta = limb - (right - left)
        exact = 0.5 * math.pi + math.asin(FORMULA_M / SIZE.radius_m * math.sin(beta)) - beta
        rows.append((degrees, math.degrees(theta), math.degrees(exact)))
    return rows


def _row(result: CylinderFigures, band: int) -> tuple[Cell, ...]:
    (low, high), (most_m, most_deg) = BANDS[band]
    _, _, d_off, d_sigma, off, sigma, _ = result.trials[result.trials[:, 0] == band].T
    kept = (np.abs(d_off) <= most_m) & (np.abs(off) <= most_deg)
    held = (np.abs(d_off) <= 3.0 * d_sigma) & (np.abs(off) <= 3.0 * sigma)
    share = 100.0 * float(np.mean(kept)) if math.isfinite(most_m) else math.nan
    distance = 1e3 * rms(d_off), 1e3 * float(np.abs(d_off).max()), 1e3 * most_m
    angle = rms(off), float(np.abs(off).max()), most_deg
    return (
        *(f"{low:.0f}-{high:.0f}", result.count, len(off)),
        *(*distance, float(np.mean((d_off / d_sigma) ** 2))),
        *(*angle, float(np.mean((off / sigma) ** 2))),
        *(share, 100.0 * float(np.mean(held))),
    )


def report(result: CylinderFigures) -> StudyReport:
    """The tables."""
    bands = sorted({int(band) for band in result.trials[:, 0]})
    rows = tuple(_row(result, band) for band in bands)
    tables = [StudyTable("Distance and angle of the light", ERRORS, rows)]
    notes = [f"no number: {reason}" for _, reason in result.lost]
    if result.fitted is not None:
        sizes = msgspec.structs.asdict(result.fitted)
        notes += ["fitted sizes:", *(f"{name} = {size:.2g}" for name, size in sizes.items())]
        return StudyReport(tuple(tables), tuple(notes))
    tables.append(StudyTable("Speed by three pictures 2 s apart", SPEED, tuple(result.speed)))
    tables.append(StudyTable("Counts of a coding that is not stated", CODED, tuple(result.coded)))
    tables.append(
        StudyTable("Formula (6) as printed, seen from 1.34 m", FORMULA, tuple(result.formula))
    )
    notes += [
        "pictures: Lambert's cloth with 5-20 % of gloss (powers 10-40) and 2-5 % of ambient light, "
        "a lamp 4 deg wide and 5 deg high, of which the fit knows nothing; radius 0.14 m, strip "
        "0.15 m high, 0.9-2.5 m away, 640 x 480 px, SNR 80-100; speed: 30 "
        "pictures of the scenario cylinder_circle, rough cloth, and of circles about cloths as "
        "above, with one cloth for all pictures of a folder; alone: folders of three pictures",
        "counts of a coding: pictures of the first three lights, blurred between pixels, coded in "
        "8 bits; gamma is an unknown of each",
        "formula (6) takes a parallel projection: of the full face it makes 31 deg at 1.34 m; "
        "exact widths give no angle where the whole face is lit, up to 6 deg",
    ]
    return StudyReport(tuple(tables), tuple(notes))
