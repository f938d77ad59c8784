"""An orbit against the truth: position and velocity on the arc, and predictions after it.

Truth files have places alone. The velocity's error is the slope of the position's error, which
varies over an orbit and not from frame to frame.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.interpolate import CubicSpline

from catalog.arrays import BoolArray, FloatArray
from catalog.bodies.epochs import utc_from_tdb_s
from catalog.errors import DataError
from catalog.files import make_prefix_test, replace_file
from catalog.progress import log_stage
from optnav_cli.evaluation.evaluation import Evaluation, evaluate
from optnav_cli.evaluation.figures import Figures
from optnav_cli.evaluation.files import (
    EVALUATION_CSV,
    EVALUATION_JSON,
    format_table,
    make_error_cells,
    summarise,
)
from optnav_cli.fix import Fix, Method, Solution
from optnav_cli.frames.orbit_tables import AXES, ORBIT_ERRORS, ORBIT_RESIDUALS
from optnav_cli.frames.run_settings import RUN_TOML, FileAttitude, read_run_settings
from optnav_cli.frames.tables import EVALUATION
from optnav_cli.frames.truth import Truth, read_truth
from optnav_cli.orbit.fit.folder import (
    RESIDUALS,
    SMOOTHED,
    StoredOrbit,
    read_orbit,
    rnb_turn,
    stated_turn,
)
from optnav_cli.orbit.fit.predict import OrbitPath
from optnav_cli.output.tables import read_solutions
from optnav_cli.output.wording import align_table, choose_length_unit, format_json

ERRORS_CSV = "orbit_errors.csv"
SAME_ROW_S = 0.01
MIN_FOR_VELOCITY = 6
# The slope of an error needs places no farther apart than a radian of the motion over this.
PLACES_A_RADIAN = 3.0
HOURS = (1.0, 3.0, 6.0, 12.0, 24.0)


@dataclass(frozen=True, eq=False)
class OrbitErrors:
    """Errors of an orbit at the times of a truth.

    hours       (n,) since the last fix; positive: predictions
    errors      (n, 6) orbit less truth along R, N, B, m and m/s; velocities NaN where not known
    covariances (n, 6, 6) as stated, along R, N, B
    """

    times: FloatArray
    hours: FloatArray
    errors: FloatArray
    covariances: FloatArray

    @property
    def inside(self) -> BoolArray:
        """Which lie on the arc."""
        return self.hours <= 0.0

    @property
    def sigmas(self) -> FloatArray:
        """(n, 6) as stated."""
        return np.sqrt(np.diagonal(self.covariances, axis1=1, axis2=2))

    def squares(self, part: slice) -> FloatArray:
        """(n,) squared errors over their covariance, a component; NaN where not known."""
        return np.array(
            [
                float(e[part] @ np.linalg.solve(p[part, part], e[part])) / 3.0
                if np.isfinite(e[part]).all()
                else math.nan
                for e, p in zip(self.errors, self.covariances, strict=True)
            ]
        )


@dataclass(frozen=True, eq=False)
class OrbitEvaluation:
    """The rows of smoothed.csv against the truth, and the orbit itself.

    fixes_rms_m  (3,) of the fixes that the orbit was made of, along R, N, B; None where unknown
    """

    at_fixes: Evaluation
    orbit: OrbitErrors
    fixes_rms_m: FloatArray | None

    @property
    def figures(self) -> Figures:
        """Figures of the rows of smoothed.csv."""
        return self.at_fixes.figures_if_any()

    def summary(self) -> dict[str, object]:
        """All figures as JSON values."""
        velocity = self._velocity()
        return summarise(self.at_fixes) | {
            "fixes_rms_rnb_m": None if self.fixes_rms_m is None else _rounded(self.fixes_rms_m, 3),
            "velocity_rms_rnb_m_s": None if velocity is None else velocity[0],
            "velocity_normalised_error_squared": None if velocity is None else velocity[1],
            "predictions": list(self._predictions()),
        }

    def to_text(self) -> str:
        """The figures for people."""
        lines = [format_table(self.at_fixes)]
        if self.fixes_rms_m is not None:
            r, n, b = self.fixes_rms_m
            orbit = self.figures
            lines.append(
                f"the fixes used, themselves, rms: R {r:.1f} m, N {n:.1f} m, B {b:.1f} m; the "
                f"orbit R {orbit.r.rms:.1f} m, N {orbit.n.rms:.1f} m, B {orbit.b.rms:.1f} m"
            )
        velocity = self._velocity()
        if velocity is not None:
            (r, n, b), square = velocity
            lines.append(
                f"velocity, rms: R {r:.4f} m/s, N {n:.4f} m/s, B {b:.4f} m/s; normalised error "
                f"squared {square:.2f}"
            )
        rows = list(self._predictions())
        if rows:
            table = [("prediction, h after the last fix", "unit", "error", "stated sigma", "NEES")]
            for row in rows:
                unit = choose_length_unit(max(row["error_m"], row["sigma_m"]))
                error, sigma = unit.text(row["error_m"]), unit.text(row["sigma_m"])
                nees = f"{row['normalised_error_squared']:.2f}"
                table.append((f"{row['hours']:.1f}", unit.name, error, sigma, nees))
            lines += ["", *align_table(table, left=(1,))]
        return "\n".join(lines)

    def _velocity(self) -> tuple[list[float], float] | None:
        """Rms along R, N, B, and the normalised error squared."""
        inside = self.orbit.inside
        errors = self.orbit.errors[inside, 3:]
        known = np.isfinite(errors).all(axis=1)
        if not known.any():
            return None
        squares = self.orbit.squares(slice(3, 6))[inside][known]
        rms = np.sqrt(np.mean(errors[known] ** 2, axis=0))
        return _rounded(rms, 6), round(float(np.mean(squares)), 6)

    def _predictions(self) -> Iterator[dict[str, float]]:
        """The last truth before each of some hours; lengths of the error, and of the sigmas."""
        orbit = self.orbit
        squares, sigmas = orbit.squares(slice(0, 3)), orbit.sigmas
        ahead = np.flatnonzero(~orbit.inside)
        shown = {
            int(ahead[np.argmin(np.abs(orbit.hours[ahead] - hour))])
            for hour in HOURS
            if ahead.size and orbit.hours[ahead[-1]] > 0.9 * hour
        }
        if ahead.size and not shown:
            shown = {int(ahead[-1])}
        for k in sorted(shown):
            yield {
                "hours": round(float(orbit.hours[k]), 4),
                "error_m": round(float(np.linalg.norm(orbit.errors[k, :3])), 3),
                "sigma_m": round(float(np.linalg.norm(sigmas[k, :3])), 3),
                "normalised_error_squared": round(float(squares[k]), 6),
            }


def evaluate_orbit(folder: Path, truth: Path) -> OrbitEvaluation:
    """Compare an orbit's folder with a truth.csv.

    Raises DataError for a folder that is no orbit, a damaged file, a truth of other frames.
    """
    with log_stage("evaluate"):
        orbit = read_orbit(folder)
        settings, body = read_run_settings(folder / RUN_TOML)
        attitude = FileAttitude(settings.attitude, body)
        truths = read_truth(truth, attitude)
        files = {row.file for row in truths}
        if (folder / SMOOTHED).exists():
            rows = [s for s in read_solutions(folder / SMOOTHED, attitude) if s.file in files]
            what = f"the frames of {folder / SMOOTHED}"
        else:  # through zenith distances: it has the places at all times
            rows, what = list(_rows_of_path(orbit, truths)), f"a time of the arc of {folder}"
        if not rows:
            raise DataError(f"{truth}: has none of {what}")
        try:
            evaluation = evaluate(rows, truths, body.radius_m)
        except DataError as error:
            raise DataError(f"{truth}: {error}") from error
        evaluation = Evaluation(evaluation.frames)
        return OrbitEvaluation(evaluation, errors_of(orbit, truths), _fixes_rms(folder, evaluation))


def _rows_of_path(orbit: StoredOrbit, truths: Sequence[Truth]) -> Iterator[Solution]:
    """The orbit's places at the times of a truth within its arc, as rows of solution.csv."""
    path = OrbitPath(orbit)
    inside = [t for t in truths if path.first_s <= t.tdb_s <= path.last_s]
    inside.sort(key=lambda row: row.tdb_s)
    predicted = path.rows(np.array([row.tdb_s for row in inside])).rows
    frame = orbit.body.catalog_frame
    for row, state, spread in zip(inside, predicted.states, predicted.covariances, strict=True):
        turn = stated_turn(orbit.ephemeris, row.tdb_s)
        position = frame.transform_to_catalog(turn @ state[:3])
        covariance = frame.transform_covariance_to_catalog(turn @ spread[:3, :3] @ turn.T)
        yield Solution(row.file, row.utc, Fix(Method.ORBIT, position, covariance))


def errors_of(orbit: StoredOrbit, truths: Sequence[Truth]) -> OrbitErrors:
    """The orbit against places at any times from its first row on."""
    times = np.array([row.tdb_s for row in truths])
    frame = orbit.body.catalog_frame
    places = np.array([frame.transform_to_stated(row.position_m) for row in truths])
    order = np.unique(times, return_index=True)[1]
    order = order[times[order] > orbit.rows.times[0] - SAME_ROW_S]
    times, places = times[order], places[order]
    prediction = OrbitPath(orbit).rows(times)
    states, covariances = prediction.rows.states, prediction.rows.covariances
    # without those after the path meets the body
    kept = np.isin(times, prediction.rows.times)
    times, places = times[kept], places[kept]
    errors = np.full((len(times), 6), np.nan)
    offsets = np.empty((len(times), 3))
    for k, time in enumerate(times):
        offsets[k] = states[k, :3] - stated_turn(orbit.ephemeris, time).T @ places[k]
    slopes = _slopes(times, offsets, orbit, states)
    turned = np.empty_like(covariances)
    for k, state in enumerate(states):
        turn = rnb_turn(state)
        turned[k] = turn @ covariances[k] @ turn.T
        errors[k] = turn @ np.concatenate([offsets[k], slopes[k]])
    hours = (times - orbit.epoch_s - SAME_ROW_S) / 3600.0
    return OrbitErrors(times, hours, errors, turned)


def _slopes(
    times: FloatArray, offsets: FloatArray, orbit: StoredOrbit, states: FloatArray
) -> FloatArray:
    """(n, 3) of the errors, inertial, m/s; NaN where places stand too far apart."""
    slopes = np.full((len(times), 3), np.nan)
    if len(times) < MIN_FOR_VELOCITY:
        return slopes
    body = orbit.body
    radians = np.sqrt(np.linalg.norm(states[:, :3], axis=1) ** 3 / body.gm_m3_s2)
    gaps = np.diff(times, prepend=np.nan, append=np.nan)
    near = np.fmax(gaps[:-1], gaps[1:]) < radians / PLACES_A_RADIAN
    derivative: FloatArray = CubicSpline(times, offsets)(times, 1)
    slopes[near] = derivative[near]
    return slopes


def _fixes_rms(folder: Path, found: Evaluation) -> FloatArray | None:
    """Rms of the fixes' own errors: residual and error of the orbit together."""
    residuals = {}
    if not (folder / RESIDUALS).exists():
        return None
    for row in ORBIT_RESIDUALS.rows(folder / RESIDUALS):
        if row.flag("used"):
            residuals[row["file"]] = row.vector([f"residual_{a}_m" for a in AXES])
    errors = []
    for frame in found.frames:
        residual = residuals.get(frame.file)
        if residual is not None and frame.error_rnb_m is not None:
            errors.append(frame.error_rnb_m + residual)
    return np.sqrt(np.mean(np.square(errors), axis=0)) if errors else None


def write_orbit_evaluation(found: OrbitEvaluation, folder: Path) -> None:
    """Write evaluation.json, evaluation.csv and orbit_errors.csv into an orbit's folder."""
    found.at_fixes.figures()
    with replace_file(folder / EVALUATION_CSV, make_prefix_test(b"file,utc,status,")) as path:
        EVALUATION.write(path, map(make_error_cells, found.at_fixes.frames))
    with replace_file(folder / ERRORS_CSV, make_prefix_test(b"utc,hours,")) as path:
        ORBIT_ERRORS.write(path, _rows(found.orbit))
    with replace_file(folder / EVALUATION_JSON, make_prefix_test(b'{\n  "frames"')) as path:
        path.write_text(format_json(found.summary()) + "\n", encoding="utf-8")


def _rows(orbit: OrbitErrors) -> Iterator[dict[str, object]]:
    sigmas, squares = orbit.sigmas, orbit.squares(slice(0, 3))
    for k, time in enumerate(orbit.times):
        cells: dict[str, object] = {"utc": utc_from_tdb_s(float(time))}
        cells |= {"hours": float(orbit.hours[k]), "normalised_error_squared": float(squares[k])}
        for i, a in enumerate(AXES):
            cells[f"error_{a}_m"] = float(orbit.errors[k, i])
            cells[f"sigma_{a}_m"] = float(sigmas[k, i])
            cells[f"error_v{a}_m_s"] = float(orbit.errors[k, 3 + i])
            cells[f"sigma_v{a}_m_s"] = float(sigmas[k, 3 + i])
        yield cells


def _rounded(values: FloatArray, digits: int) -> list[float]:
    return [round(float(value), digits) for value in values]
