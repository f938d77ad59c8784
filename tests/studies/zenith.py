"""Orbits through zenith distances of stars: the source's tables, and their causes."""

import time
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from catalog.arrays import FloatArray
from catalog.progress import Progress
from optnav_cli.orbit.fit.motion import ArcMotion
from optnav_cli.orbit.fit.settings import ParameterSettings
from optnav_cli.orbit.fit.zenith_job import fit_zenith
from optnav_cli.report.sheet import LegendEntry, Panel, draw_sheet
from optnav_cli.report.svg import Plot, PlotAxis
from tests.studies.tables import Cell, StudyReport, StudyTable, columns
from tests.studies.zenith_flights import (
    GATE,
    SESSIONS,
    JudgedFit,
    SightErrors,
    ZenithFlight,
    fit_motion,
    forecast_m,
    judged,
    noisier,
)

# Kuznetsov and others (2018), table 2, R' of craft 1.1 by sessions a revolution, m: mean, sigma,
# largest.
TABLE_2 = {
    100: (0.80, 0.435, 2.93),
    300: (0.48, 0.202, 1.64),
    500: (0.34, 0.166, 1.22),
    750: (0.31, 0.157, 1.09),
    1000: (0.25, 0.125, 0.846),
}
# Table 3, by craft: mean R', m, V', mm/s, S', m.
TABLE_3 = {
    "1.1": (0.34, 45.0, 0.123),
    "1.3": (0.37, 50.0, 0.134),
    "1.5": (0.37, 48.0, 0.137),
    "1.6": (0.38, 49.0, 0.150),
    "2.1": (0.33, 44.0, 0.113),
    "2.3": (0.31, 44.0, 0.0945),
    "2.4": (0.33, 46.0, 0.110),
    "2.5": (0.29, 40.0, 0.0937),
    "3.2": (0.34, 46.0, 0.109),
    "3.3": (0.34, 47.0, 0.107),
    "3.5": (0.36, 48.0, 0.125),
    "3.6": (0.33, 44.0, 0.125),
}
# Table 4 and figure 5: by revolutions of forecast after one of sights, m.
TABLE_4 = {1: "1-2", 3: "3", 5: "5", 34: "30.8"}
FIRST_CRAFT, WORST_CRAFT = "1.1", "1.5"
CATALOGS_ARCSEC = (0.001, 0.005, 0.02, 0.05, 0.12)
SENSORS_ARCSEC = (0.05, 0.1, 0.2, 0.5, 1.0)
AHEAD = 34
FORECAST_ROWS = 24  # a revolution
LIMB = SightErrors(vertical_arcsec=2.0)
LIMB_PICTURES, LIMB_REVOLUTIONS = 60, 3
MAX_SPEED_TRIALS = 3

SUNLIGHT = ParameterSettings("srp")
BIAS_ARCSEC, STARS_ARCSEC = 0.1, 0.12
BIAS = ParameterSettings("vertical", prior_sigma=BIAS_ARCSEC, mode="consider")
STARS = ParameterSettings("star_catalog", prior_sigma=STARS_ARCSEC, mode="consider")

NUMBERS = columns(
    "sessions = sessions a revolution; seed = R' seed [m] .2f; mean = R' [m] .2f; over = over the "
    "seed's .2f; root = times √N/500 [m] .2f; sigma_seed = σ seed [m] .2f; sigma = σ [m] .2f; "
    "largest_seed = largest, seed [m] .2f; largest [m] .2f; v = V' [mm/s] .3f; nees = NEES .2f"
)
CRAFT = columns(
    "craft; seed = R' seed [m] .2f; mean = R' [m] .2f; largest [m] .2f; v_seed = V' seed [µm/s] "
    ".0f; v = V' [µm/s] .0f; s_seed = S' seed [m] .3f; s = S' [m] .3f; nees = NEES .2f"
)
CYCLES = columns(
    "ahead = revolutions ahead; seed = seed [m]; mean [m] .1f; low = 5 % [m] .1f; high = 95 % [m] "
    ".1f; holds = seed's inside"
)
CURVES = columns(
    "what; sigma = 1 sigma [arcsec] .3f; mean = R' [m] .2f; v = V' [µm/s] .0f; s = S' [m] .3f"
)
RESTS = columns(
    "what; mean = R' [m] .2f; stated = stated sigma [m] .2f; nees = NEES .2f; residuals = "
    "residuals over their sigma .2f; ahead = R' after 34 revolutions [m] .0f"
)
LIMBS = columns(
    "what; fits; mean = R' [m] .1f; largest [m] .1f; stated = stated sigma [m] .1f; nees = NEES .2f"
)


@dataclass(frozen=True, eq=False)
class ZenithFigures:
    """Rows of the study's tables, and processor seconds of a fit of 3 revolutions x 500 sights."""

    craft: str
    numbers: list[tuple[Cell, ...]]
    crafts: list[tuple[Cell, ...]]
    cycles: list[tuple[Cell, ...]]
    curves: list[tuple[Cell, ...]]
    rests: list[tuple[Cell, ...]]
    limbs: list[tuple[Cell, ...]]
    seconds: float


class ZenithTrials:
    """Flights and fits, each with its own draw."""

    def __init__(self, craft: str, revolutions: int, trials: int, seed: int) -> None:
        self.craft, self.revolutions, self.trials, self._seed = craft, revolutions, trials, seed
        self.motion = fit_motion()

    def fit(
        self,
        flight: ZenithFlight,
        number: int,
        sessions: int = SESSIONS,
        errors: SightErrors | None = None,
        parameters: tuple[ParameterSettings, ...] = (SUNLIGHT,),
        motion: ArcMotion | None = None,
        revolutions: float = 1.0,
    ) -> JudgedFit:
        """Of one revolution, or more from there on."""
        rng = np.random.default_rng([self._seed, number, sessions])
        times = flight.sessions(number, revolutions, sessions)
        sights = flight.sights(times, errors or SightErrors(), rng)
        return judged(flight, sights, motion or self.motion, parameters, rng)


def run(
    progress: Progress,
    craft: str = WORST_CRAFT,
    revolutions: int = 35,
    trials: int = 20,
    seed: int = 1,
) -> ZenithFigures:
    """All tables. craft: of cycles and curves; revolutions: each fitted by itself, of each row."""
    study = ZenithTrials(craft, revolutions, trials, seed)
    with progress.stage("study zenith", 7, "table") as bar:
        found = []
        for part in (_numbers, _crafts, _cycles, _curves, _rests, _limbs):
            found.append(part(study))
            bar.advance()
        seconds = _speed(study)
        bar.advance()
    numbers, crafts, cycles, curves, rests, limbs = found
    return ZenithFigures(craft, numbers, crafts, cycles, curves, rests, limbs, seconds)


def _sizes(fits: Sequence[JudgedFit]) -> FloatArray:
    """(n, 3) of each fit."""
    return np.array([one.sizes for one in fits])


def _numbers(study: ZenithTrials) -> list[tuple[Cell, ...]]:
    flight, rows = ZenithFlight(FIRST_CRAFT, study.revolutions + 0.1), []
    for count, (mean, sigma, largest) in TABLE_2.items():
        fits = [study.fit(flight, k, count) for k in range(study.revolutions)]
        sizes = _sizes(fits)
        place = sizes[:, 0]
        row: tuple[Cell, ...] = (
            *(count, mean, float(place.mean()), float(place.mean()) / mean),
            *(float(place.mean()) * float(np.sqrt(count / SESSIONS)), sigma, float(place.std())),
            *(largest, float(max(np.linalg.norm(f.errors[:, :3], axis=1).max() for f in fits))),
            *(1e3 * float(sizes[:, 1].mean()), float(np.mean([one.nees for one in fits]))),
        )
        rows.append(row)
    return rows


def _crafts(study: ZenithTrials) -> list[tuple[Cell, ...]]:
    rows = []
    for craft, (place, speed, height) in TABLE_3.items():
        flight = ZenithFlight(craft, study.revolutions + 0.1)
        fits = [study.fit(flight, k) for k in range(study.revolutions)]
        sizes = _sizes(fits)
        largest = float(max(np.linalg.norm(f.errors[:, :3], axis=1).max() for f in fits))
        nees = float(np.mean([one.nees for one in fits]))
        means = sizes.mean(axis=0)
        row: tuple[Cell, ...] = (
            *(craft, place, float(means[0]), largest, speed, 1e6 * float(means[1])),
            *(height, float(means[2]), nees),
        )
        rows.append(row)
    return rows


def _cycles(study: ZenithTrials) -> list[tuple[Cell, ...]]:
    """Errors of forecasts, each after a revolution of sights of another draw."""
    flight = ZenithFlight(study.craft, study.trials + AHEAD + 1.1)
    steps = flight.period_s / FORECAST_ROWS * np.arange(1.0, FORECAST_ROWS * AHEAD + 1.0)
    ahead = []
    for k in range(study.trials):
        one = study.fit(flight, k)
        off = forecast_m(flight, one, float(one.fit.problem.times[-1]) + steps)
        ahead.append(off.reshape(AHEAD, FORECAST_ROWS).mean(axis=1))
    sizes = np.array(ahead)
    rows: list[tuple[Cell, ...]] = []
    for number, printed in TABLE_4.items():
        values = sizes[:, number - 1]
        low, high = (float(v) for v in np.percentile(values, [5.0, 95.0]))
        wanted = [float(v) for v in printed.split("-")]
        inside = any(low <= v <= high for v in wanted)
        rows.append((number, printed, float(values.mean()), low, high, "yes" if inside else "no"))
    return rows


def _curves(study: ZenithTrials) -> list[tuple[Cell, ...]]:
    flight = ZenithFlight(study.craft, study.trials + 0.1)
    cases = [
        (f"catalogue, drawn anew each time, sensor {0.1:g}″", size, np.hypot(0.1, size))
        for size in CATALOGS_ARCSEC
    ]
    cases += [("sensor", size, size) for size in SENSORS_ARCSEC]
    rows: list[tuple[Cell, ...]] = []
    for what, size, whole in cases:
        errors = noisier(SightErrors(), float(whole))
        sizes = _sizes([study.fit(flight, k, errors=errors) for k in range(study.trials)])
        place, speed, height = (float(v) for v in sizes.mean(axis=0))
        rows.append((what, size, place, 1e6 * speed, height))
    return rows


def _rests(study: ZenithTrials) -> list[tuple[Cell, ...]]:
    """The same truth with what the table does not have."""
    flight = ZenithFlight(study.craft, study.trials + AHEAD + 1.1)
    bias, stars = SightErrors(bias_arcsec=BIAS_ARCSEC), SightErrors(stars_arcsec=STARS_ARCSEC)
    plain, tried = SightErrors(), (SUNLIGHT,)
    few = {degree: fit_motion(degree) for degree in (2, 3, 4)}
    cases = {
        "nothing left out": (plain, tried, study.motion),
        "0.1″ of constant vertical bias, considered": (bias, (*tried, BIAS), study.motion),
        "the same, not considered": (bias, tried, study.motion),
        "0.12″ of fixed star errors, considered": (stars, (*tried, STARS), study.motion),
        "the same, not considered ": (stars, tried, study.motion),
        "degree 4 only": (plain, tried, few[4]),
        "degree 3 only": (plain, tried, few[3]),
        "degree 2 only": (plain, tried, few[2]),
        "no sunlight": (plain, (), study.motion),
    }
    rows: list[tuple[Cell, ...]] = []
    for what, (errors, parameters, motion) in cases.items():
        fits = [
            study.fit(flight, k, errors=errors, parameters=parameters, motion=motion)
            for k in range(study.trials)
        ]
        ahead = []
        for one in fits:
            last = float(one.fit.problem.times[-1]) + flight.period_s * (
                AHEAD - 1.0 + np.arange(1.0, FORECAST_ROWS + 1.0) / FORECAST_ROWS
            )
            ahead.append(float(forecast_m(flight, one, last).mean()))
        ratios = [one.fit.chi_square / one.fit.degrees_of_freedom for one in fits]
        rows.append(
            (
                what.strip(),
                float(_sizes(fits)[:, 0].mean()),
                float(np.mean([one.sigma_m for one in fits])),
                float(np.mean([one.nees for one in fits])),
                float(np.sqrt(np.mean(ratios))),
                float(np.mean(ahead)),
            )
        )
    return rows


def _limbs(study: ZenithTrials) -> list[tuple[Cell, ...]]:
    """Orbits of a vertical from the limb, by drawn errors of the vertical."""
    flight = ZenithFlight(study.craft, study.trials + LIMB_REVOLUTIONS + 0.1)
    rows: list[tuple[Cell, ...]] = []
    for arcsec, pictures, revolutions in ((2.0, LIMB_PICTURES, LIMB_REVOLUTIONS), (1.0, 50, 1)):
        errors = SightErrors(vertical_arcsec=arcsec)
        fits = [
            study.fit(flight, k, pictures, errors, revolutions=revolutions)
            for k in range(study.trials)
        ]
        sizes = _sizes(fits)[:, 0]
        words = f"{arcsec:g}″, {pictures} a revolution, {revolutions} revolution"
        rows.append(
            (
                words + ("s" if revolutions > 1 else ""),
                len(fits),
                float(sizes.mean()),
                float(sizes.max()),
                float(np.mean([one.sigma_m for one in fits])),
                float(np.mean([one.nees for one in fits])),
            )
        )
    return rows


def _speed(study: ZenithTrials) -> float:
    """Processor seconds of a fit of 3 revolutions x 500 sights without a prior, degree 8."""
    flight = ZenithFlight(FIRST_CRAFT, 3.1)
    rng = np.random.default_rng(1)
    sights = flight.sights(flight.sessions(0.0, 3.0, SESSIONS // 2), SightErrors(), rng)
    spent = []
    for _ in range(MAX_SPEED_TRIALS):
        began = time.process_time()
        fit_zenith(study.motion, sights, [], [SUNLIGHT], GATE)
        spent.append(time.process_time() - began)
    return min(spent)


def report(result: ZenithFigures) -> StudyReport:
    """The tables."""
    rests = f"What the table rests on: {SESSIONS} sessions on one revolution, craft {result.craft}"
    return StudyReport(
        (
            StudyTable("Table 2: one revolution of craft 1.1", NUMBERS, tuple(result.numbers)),
            StudyTable(f"Table 3: {SESSIONS} sessions", CRAFT, tuple(result.crafts)),
            StudyTable(
                f"Table 4 and figure 5: forecasts, craft {result.craft}",
                CYCLES,
                tuple(result.cycles),
            ),
            StudyTable(f"Figures 3 and 4: craft {result.craft}", CURVES, tuple(result.curves)),
            StudyTable(rests, RESTS, tuple(result.rests)),
            StudyTable("A vertical from the limb, drawn errors", LIMBS, tuple(result.limbs)),
        ),
        (
            "truth: degree 20, sunlight on 0.02 m²/kg, another integrator; fits: degree 8, "
            "sunlight a parameter; a session measures two stars to 0.1″ with a vertical that is "
            "known, from a first orbit 1 km off; R' is the mean error of a place over the "
            "revolution",
            "a fit of 3 revolutions x 500 sights without a prior, degree 8: "
            f"{result.seconds:.2f} s of a processor; wanted 2",
        ),
    )


def picture(result: ZenithFigures) -> str:
    """Errors by sessions and by the sensor's noise, and of forecasts (SVG)."""
    legend = [
        LegendEntry("s1", "found", "circle"),
        LegendEntry("s3", "Kuznetsov et al. 2018", "triangle"),
    ]
    count = [float(str(row[0])) for row in result.numbers]
    ours = [float(str(row[2])) for row in result.numbers]
    seeds = [float(str(row[1])) for row in result.numbers]
    sensor = [row for row in result.curves if row[0] == "sensor"]
    ahead = [float(str(row[0])) for row in result.cycles]
    panels = [
        _panel("sessions a revolution", count, ours, seeds),
        _panel(
            "1 sigma of the sensor, arcsec",
            [float(str(row[1])) for row in sensor],
            [float(str(row[2])) for row in sensor],
            [],
        ),
        _panel(
            "revolutions of forecast",
            ahead,
            [float(str(row[2])) for row in result.cycles],
            [float(np.mean([float(v) for v in text.split("-")])) for text in TABLE_4.values()],
        ),
    ]
    return draw_sheet("Errors of orbits through zenith distances", legend, [panels])


def _panel(title: str, x: list[float], ours: list[float], seeds: list[float]) -> Panel:
    at, found = np.log10(x), np.log10(ours)
    printed = np.log10(seeds) if seeds else np.empty(0)
    values = np.concatenate([found, printed])
    axes = [
        PlotAxis((float(v.min()) - 0.08, float(v.max()) + 0.08), name, log=True)
        for v, name in ((at, title), (values, "error, m"))
    ]
    plot = Plot(axes[0], axes[1], width=340, height=300)
    plot.line(at, found, "s1")
    plot.marks(at, found, "s1", "circle")
    if len(printed):
        plot.marks(at, printed, "s3", "triangle")
    return Panel(title, plot, f"Errors against {title}, log scale")
