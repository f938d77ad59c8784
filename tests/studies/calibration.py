"""Calibration in flight: routes with a lens that is not the told one, against the truth.

Routes at measurement level, for the statistics, and one through drawn pictures and matching, which
is then navigated with the camera of before and after.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from catalog.arrays import FloatArray
from catalog.config import resource
from catalog.geometry.rotations import ARCSEC
from catalog.places import make_folder
from catalog.progress import Progress
from catalog.store.reader import Catalog
from optnav_cli.calibration.adjustment import Adjustment, adjust
from optnav_cli.calibration.model import find_inseparable
from optnav_cli.camera.camera_file import preset_camera
from optnav_cli.estimation.models.common import Common
from optnav_cli.evaluation.figures import compute_figures, make_unsolved_figures
from tests.studies import flights
from tests.studies.calibration_pictures import PictureRoute, picture_route
from tests.studies.calibration_routes import OFF, Route, simulated_route
from tests.studies.tables import Cell, StudyReport, StudyTable, columns

HEIGHTS_KM = (100.0, 200.0, 300.0, 400.0)
LOST = 0.5
# the catalog of the drawn route: its cells, and the part of the bundled terrain that it needs
CELL_DEG, BOX_DEG = 0.5, (-15.0, -46.5, -7.0, -39.5)
# per cent, px, 1, arcsec and ms for one of the state
SHOWN = {
    Common.FOCAL: 100.0,
    Common.CENTRE: 1.0,
    Common.DISTORTION: 1.0,
    Common.MOUNTING: 1.0 / ARCSEC,
    Common.CLOCK: 1e3,
}
KMSS = (
    "published of KMSS-2 (B. S. Zhukov, Autonomous optical navigation near the Moon and small "
    "bodies, thesis summary): 28 routes, 11 583 of 34 665 control points (33 %), 1779 of 3933 "
    "frames (45 %), residual sigma 36 m along, 61 m across, 297 m in height, tens of metres of it "
    "of the pictures it was compared with; clouds are here only a share of points lost"
)


@dataclass(frozen=True, eq=False)
class RouteResult:
    """A route that was calibrated: errors (k,) and covariance of the numbers, in their units.

    residual  rms of the residuals of matches over their stated sigma
    """

    case: str
    errors: FloatArray
    adjustment: Adjustment
    residual: float

    @property
    def nees(self) -> float:
        """A degree of freedom."""
        solved = np.linalg.solve(self.adjustment.covariance, self.errors)
        return float(self.errors @ solved) / len(self.errors)

    @property
    def ratios(self) -> FloatArray:
        """(k,) errors over their sigmas."""
        return self.errors / self.adjustment.sigmas


@dataclass(frozen=True, eq=False)
class CalibrationStudy:
    """All that the study found."""

    routes: list[RouteResult]
    table: list[RouteResult]
    drawn: PictureRoute | None


def run(
    output: Path,
    progress: Progress,
    trials: int,
    pictures: int,
    frames: int,
    seed: int,
    catalog: Path | None = None,
) -> CalibrationStudy:
    """Calibrate routes.

    output    folder for the drawn route
    trials    routes at measurement level
    pictures  of the drawn route; 0 draws none
    frames    of each route at measurement level
    catalog   of the bundled Tycho terrain; built when None
    """
    if catalog is not None:  # wrong ones are told before the routes, not after
        with Catalog.open(catalog):
            pass
    make_folder(output)
    camera = preset_camera("unk")
    flown = Route(camera, frames, HEIGHTS_KM, rolled=True, lost=LOST)
    cases = {
        "one height, one roll": Route(camera, frames),
        "one height, roll varied": Route(camera, frames, rolled=True),
        "heights 100-400 km, one roll": Route(camera, frames, HEIGHTS_KM),
        "heights and roll varied": Route(camera, frames, HEIGHTS_KM, rolled=True),
        "heights and roll varied, half of the points lost": flown,
    }
    routes, table = [], []
    with progress.stage("calibration", trials + len(cases), "route") as bar:
        for number in range(trials):
            routes.append(_calibrated("", flown, seed + number))
            bar.advance()
        for name, route in cases.items():
            table.append(_calibrated(name, route, seed))
            bar.advance()
    drawn = None
    if pictures and catalog is None:
        text = resource("configs/catalogs/tycho.toml").read_text(encoding="utf-8")
        text += f"\n[grid]\ncell_deg = {CELL_DEG}\n"
        catalog = flights.built_catalog(output / "tycho.toml", text, progress, BOX_DEG)
    if pictures and catalog is not None:
        drawn = picture_route(output / "drawn", catalog, pictures, progress)
    return CalibrationStudy(routes, table, drawn)


def _calibrated(case: str, route: Route, seed: int) -> RouteResult:
    frames, truth = simulated_route(route, seed)
    found = adjust(frames, truth.numbers, by_direction=True)
    squares, freedom = 0.0, -float(len(truth.numbers))
    for frame, result in zip(frames, found.frames, strict=True):
        off, weights = result.residuals_px, result.weights
        information = np.linalg.inv(frame.sightings.covariances_px2)
        squares += float(np.einsum("n,ni,nij,nj->", weights, off, information, off))
        freedom += 2.0 * float(weights.sum()) - 3.0  # statements hold half of a pose
    ratio = float(np.sqrt(squares / freedom))
    return RouteResult(case, found.common.values - truth.values, found, ratio)


STATISTICS = columns(
    "number; off = told off by; error = error, rms .3g; sigma = stated sigma .3g; "
    "largest = largest error [sigma] .2f; unit"
)
SUMMARY = columns(
    "routes; NEES = NEES a degree of freedom .2f; largest = largest error of any [sigma] .2f; "
    "beyond = beyond 3 sigma; residual = residual over its sigma .3f; asked = asked NEES"
)
ACCURACY = columns(
    "route; focal = f [%] .4f; centre_x = centre x [px] .2f; centre_y = centre y [px] .2f; "
    "mounting [″] .1f; clock [ms] .2f; directions = not told apart"
)
DRAWN = columns(
    "what; frames; of; horizontal = horizontal, rms [m] .1f; height = height, rms [m] .1f; NEES .2f"
)
FOUND = columns("number; true .4f; found .4f; sigma .2g; error = error [sigma] .2f; unit")
UNITS = {
    Common.FOCAL: "%",
    Common.CENTRE: "px",
    Common.DISTORTION: "",
    Common.MOUNTING: "″",
    Common.CLOCK: "ms",
}


def report(found: CalibrationStudy) -> StudyReport:
    """Tables of the statistics, of the accuracy by route, and of the drawn route."""
    tables = []
    notes = [
        "routes: unk, 100 frames unless another number is given, 60 control points in view, 0.15 "
        "px, control points 10 m, positions 10 m, attitudes 10″; f off by 0.3 %, centre 8 px, k1 "
        "0.01, mounting 200″ an axis, clock 80 ms",
        "asked: f 0.004 %, centre 0.25 px, clock 3 ms with roll or height varied; one height and "
        "one roll: says that they cannot be told apart",
    ]
    if found.routes:
        tables += _statistics(found.routes)
    tables.append(
        StudyTable("Stated sigmas by route", ACCURACY, tuple(map(_accuracy, found.table)))
    )
    if found.drawn is not None:
        tables += _drawn(found.drawn)
        result = found.drawn.calibration
        notes.append(
            f"drawn route: {result.used} of {result.matches} matches in {result.frames} frames, "
            f"residual {result.before_px:.2f} px as told, {result.after_px:.2f} px after, "
            f"{result.sigma_px:.2f} px stated"
        )
    return StudyReport(tuple(tables), (*notes, KMSS))


def _statistics(routes: list[RouteResult]) -> list[StudyTable]:
    numbers = routes[0].adjustment.common.numbers
    errors = np.array([route.errors for route in routes])
    sigmas = np.array([route.adjustment.sigmas for route in routes])
    ratios = np.abs(np.array([route.ratios for route in routes]))
    rows: list[tuple[Cell, ...]] = []
    for k, number in enumerate(numbers):
        per = SHOWN[number.kind]
        rms = [float(np.sqrt(np.mean(values[:, k] ** 2))) * per for values in (errors, sigmas)]
        name = f"{number.kind.value} {number.axis}".strip()
        rows.append(
            (
                name,
                f"{per * OFF[number.kind]:g}",
                *rms,
                float(ratios[:, k].max()),
                UNITS[number.kind],
            )
        )
    whole: tuple[Cell, ...] = (
        len(routes),
        float(np.mean([route.nees for route in routes])),
        float(ratios.max()),
        int((ratios > 3.0).sum()),
        float(np.mean([route.residual for route in routes])),
        "0.7-1.4",
    )
    return [
        StudyTable("Routes, half of the points lost", SUMMARY, (whole,)),
        StudyTable("Their numbers", STATISTICS, tuple(rows)),
    ]


def _accuracy(result: RouteResult) -> tuple[Cell, ...]:
    adjustment = result.adjustment
    numbers = adjustment.common.numbers
    shown = {
        (number.kind, number.axis): float(sigma) * SHOWN[number.kind]
        for number, sigma in zip(numbers, adjustment.sigmas, strict=True)
    }
    directions = find_inseparable(numbers, adjustment.covariance)
    words = "; ".join(" + ".join(d.labels) for d in directions).replace(" of unk", "") or "none"
    mounting = max(shown[Common.MOUNTING, axis] for axis in "xyz")
    return (
        result.case,
        shown[Common.FOCAL, ""],
        *(shown[Common.CENTRE, axis] for axis in "xy"),
        mounting,
        shown[Common.CLOCK, ""],
        words,
    )


def _drawn(drawn: PictureRoute) -> list[StudyTable]:
    adjustment = drawn.calibration.adjustment
    rows: list[tuple[Cell, ...]] = []
    columns_of = zip(
        adjustment.common.numbers,
        drawn.truth.values,
        adjustment.common.values,
        adjustment.sigmas,
        strict=True,
    )
    for number, true, value, sigma in columns_of:
        per = SHOWN[number.kind]
        name = f"{number.kind.value} {number.axis}".strip()
        ratio = float((value - true) / sigma)
        shown = per * float(true), per * float(value), per * float(sigma)
        rows.append((name, *shown, ratio, UNITS[number.kind]))
    runs: list[tuple[Cell, ...]] = []
    for name, evaluation in (("camera as told", drawn.old), ("camera as calibrated", drawn.new)):
        solved = any(frame.error_rnb_m is not None for frame in evaluation.frames)
        f = (
            compute_figures(evaluation.frames)
            if solved
            else make_unsolved_figures(evaluation.frames)
        )
        runs.append((name, f.solved, f.frames, f.horizontal_rms_m, f.height_rms_m, f.nees))
    return [
        StudyTable("A route through drawn pictures: the numbers", FOUND, tuple(rows)),
        StudyTable("The same route navigated from priors 3 km off", DRAWN, tuple(runs)),
    ]
