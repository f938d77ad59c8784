"""Runs to an orbit and its folder, as `optnav orbit fit` does."""

import logging
import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from catalog.bodies.body import Body
from catalog.bodies.ephemeris import Ephemeris, load_ephemeris
from catalog.bodies.epochs import utc_to_tdb_s
from catalog.errors import DataError, NothingToDoError
from catalog.files import MANIFEST, hash_file
from catalog.terrain.dem.file import resolve_path
from optnav_cli.camera.camera import Camera
from optnav_cli.dynamics.forces import Forces
from optnav_cli.dynamics.left_out import warn_of_unknown_gravity
from optnav_cli.fix import Method, Solution
from optnav_cli.frames.orbit_tables import MEASUREMENT_RESIDUALS
from optnav_cli.frames.run_settings import (
    RUN_TOML,
    FileAttitude,
    RunSettings,
    write_run_settings,
)
from optnav_cli.orbit.fit.fit import OrbitFit, densify, fit_orbit
from optnav_cli.orbit.fit.folder import SMOOTHED
from optnav_cli.orbit.fit.lens import (
    sight_of,
    with_lens_errors,
    with_solved,
    without_lens_error,
    write_calibrated,
)
from optnav_cli.orbit.fit.measurements import (
    MEASUREMENT_RESIDUALS_CSV,
    measurement_lines,
    measurement_rows,
    orbit_priors,
    read_measurements,
    with_considered_signals,
)
from optnav_cli.orbit.fit.motion import ArcMotion
from optnav_cli.orbit.fit.output import record, smoothed_solutions, summary, write_orbit_folder
from optnav_cli.orbit.fit.problem import OrbitFix, OrbitPrior, OrbitProblem
from optnav_cli.orbit.fit.settings import (
    KIND,
    OF_SIGHTS,
    OF_SIGNALS,
    PARAMETERS,
    Name,
    OrbitFitSettings,
    ParameterSettings,
)
from optnav_cli.orbit.fit.zenith import ZENITH_CSV
from optnav_cli.orbit.fit.zenith_job import (
    fit_zenith_files,
    is_zenith,
    read_zenith_inputs,
    source_settings,
    write_zenith_residuals,
)
from optnav_cli.output.manifest import OutputFolder, hash_files, output_folder, read_manifest
from optnav_cli.output.run_folder import RECORDING, SOLUTION, RunFolder, read_run
from optnav_cli.output.tables import write_solutions

log = logging.getLogger(__name__)

MAX_FIXES = 20_000
DEEPEST = 0.9  # of the least radius: no fix is deeper, whatever its error
MIN_SIGMA_M = 1e-4  # what the columns of positions resolve


@dataclass(frozen=True)
class TrackingFiles:
    """A measurements.csv, and the stations of its signals."""

    measurements: Path
    stations: Path | None = None

    @property
    def paths(self) -> list[Path]:
        """The files that there are."""
        return [path for path in (self.measurements, self.stations) if path is not None]


@dataclass(frozen=True, eq=False)
class RunFixes:
    """The rows of several runs, under names that differ, and the fixes among them."""

    rows: list[tuple[Solution, Camera | None]]
    fixes: list[OrbitFix]
    body: Body
    attitude: FileAttitude


def fit_runs(
    runs: Sequence[Path],
    output: Path,
    settings: OrbitFitSettings,
    solve: Sequence[str] = (),
    beside: Path = Path(),
    tracking: TrackingFiles | None = None,
) -> list[str]:
    """Fit an orbit through the solved frames of runs and write its folder; lines for people.

    runs    their folders, and files or folders of zenith distances
    tracking  further measurements
    solve   names of parameters in short, besides those of the settings
    beside  the folder that files named in the settings are sought from
    Raises DataError for runs that cannot be used, NothingToDoError without fixes, NoSolutionError
    where they fit no orbit.
    """
    with output_folder(output, KIND, "orbit fit", runs, "orbit") as out:
        if tracking is not None or len({is_zenith(path) for path in runs}) > 1:
            settings = _with_whole_paths(settings, beside)
            return _fit_together(runs, out, settings, solve, beside, tracking)
        if any(map(is_zenith, runs)):
            settings = _with_whole_paths(settings, beside)
            return fit_zenith_files(runs, out, settings, solve, beside)
        read = [read_run(path) for path in runs]
        named = {*solve, *(parameter.name for parameter in settings.parameter)}
        run_fixes = read_fixes(read, lens="focal" in named)
        kernels = _kernels(read, settings, beside)
        ephemeris = load_ephemeris(run_fixes.body, [Path(name) for name in kernels])
        warn_of_unknown_gravity(run_fixes.body, settings.forces)
        priors = orbit_priors(settings.prior, ephemeris, beside, _ends(run_fixes.fixes))
        run_fixes = _with_times(run_fixes, settings.fixes.time_sigma_s)
        settings = _with_whole_paths(settings, beside)
        settings = with_solved(settings, solve, run_fixes.fixes, priors)
        cameras = [camera for _, camera in run_fixes.rows]
        settings = with_lens_errors(settings, cameras)
        problem = problem_of(run_fixes, settings, ephemeris, priors, beside)
        fit = fit_orbit(problem, settings.noise.model, settings.gate_probability)
        _write(out.path, fit, settings, kernels, run_fixes, read)
        lenses = write_calibrated(out.path, fit, cameras)
        out.options = {"config": msgspec.to_builtins(settings), "solve": list(solve)}
        out.inputs = _inputs(runs, ephemeris)
        out.results = {"fixes": len(fit.residuals), "used": fit.used}
    return [*summary(fit), *lenses, *_other_sights(runs)]


def _fit_together(
    paths: Sequence[Path],
    out: OutputFolder,
    settings: OrbitFitSettings,
    solve: Sequence[str],
    beside: Path,
    tracking: TrackingFiles | None,
) -> list[str]:
    """Fit one orbit through fixes, zenith distances and the measurements of a file."""
    runs = [path for path in paths if not is_zenith(path)]
    read = [read_run(path) for path in runs]
    names = {*solve, *(parameter.name for parameter in settings.parameter)}
    run_fixes = read_fixes(read, lens="focal" in names) if read else None
    sights = None
    if len(runs) < len(paths):
        sights = read_zenith_inputs([path for path in paths if is_zenith(path)])
    sources: list[tuple[RunSettings, Body]] = [(run.settings, run.attitude.body) for run in read]
    sources += [(sights.settings, sights.body)] if sights else []
    if tracking is not None and (not sources or (tracking.measurements.parent / RUN_TOML).exists()):
        sources.append(source_settings(tracking.measurements))
    run_settings, body = sources[0]
    if any(other != body for _, other in sources):
        known = ", ".join(sorted({other.name for _, other in sources}))
        raise DataError(f"the measurements are about {known}; fit each body by itself")
    kernels = [str(resolve_path(name, beside).resolve()) for name in settings.spice.kernels]
    kernels = _kernels(read, settings, beside) if read else kernels
    ephemeris = load_ephemeris(body, [Path(name) for name in kernels])
    warn_of_unknown_gravity(body, settings.forces)
    source = None
    if tracking is not None:
        source = read_measurements(tracking.measurements, tracking.stations, ephemeris)
    times = [*(source.ends if source else ()), *(sights.sights.tdb_s if sights else ())]
    fixes = _with_times(run_fixes, settings.fixes.time_sigma_s).fixes if run_fixes else []
    times += [fix.tdb_s for fix in fixes]
    priors = orbit_priors(settings.prior, ephemeris, beside, (min(times), max(times)))
    settings = _with_named(settings, [*PARAMETERS, *OF_SIGHTS, *OF_SIGNALS], solve)
    sets = source.sets if source else []
    settings = with_considered_signals(settings, sets, ephemeris)
    motion = ArcMotion(Forces(ephemeris, settings.forces, beside), settings.noise)
    problem = OrbitProblem(
        motion,
        fixes,
        priors,
        list(settings.parameter),
        body.radius_m,
        sights=sights.sights if sights else None,
        tracking=sets,
    )
    fit = fit_orbit(problem, settings.noise.model, settings.gate_probability)
    write_run_settings(run_settings, out.path)
    if run_fixes is not None:
        _write(out.path, fit, settings, kernels, run_fixes, read)
    else:
        write_orbit_folder(out.path, fit, densify(fit, settings.step_s), settings, kernels)
    lines = summary(fit)
    if sights is not None:
        write_zenith_residuals(out.path, sights.sights, fit)
    if source is not None:
        residuals = measurement_rows(source, fit)
        MEASUREMENT_RESIDUALS.write(out.path / MEASUREMENT_RESIDUALS_CSV, residuals)
        lines += measurement_lines(source, fit)
    files = [*(sights.paths if sights else ()), *(tracking.paths if tracking else ())]
    out.options = {"config": msgspec.to_builtins(settings), "solve": list(solve)}
    out.inputs = _inputs(runs, ephemeris) | {
        "files": [{"path": str(path), "sha256": hash_file(path)} for path in files]
    }
    out.results = {"measurements": fit.count, "used": fit.used}
    return lines


def _with_named(
    settings: OrbitFitSettings, known: Sequence[Name], solve: Sequence[str]
) -> OrbitFitSettings:
    """Add the parameters that --solve names, each common to all that it belongs to."""
    stated = {parameter.name for parameter in settings.parameter}
    added = [ParameterSettings(name) for name in known if name in solve and name not in stated]
    return msgspec.structs.replace(settings, parameter=(*settings.parameter, *added))


def _other_sights(runs: Sequence[Path]) -> list[str]:
    """Say what else in the runs an orbit can be fitted through."""
    files = [run / ZENITH_CSV for run in runs]
    return [
        f"{file} is there too: name it to fit the zenith distances in place of the fixes"
        for file in files
        if file.is_file()
    ]


def _write(
    place: Path,
    fit: OrbitFit,
    settings: OrbitFitSettings,
    kernels: Sequence[str],
    found: RunFixes,
    read: Sequence[RunFolder],
) -> None:
    write_orbit_folder(place, fit, densify(fit, settings.step_s), settings, kernels)
    write_run_settings(read[0].settings, place)
    smoothed = smoothed_solutions(fit, [solution for solution, _ in found.rows])
    write_solutions(place / SMOOTHED, smoothed, found.attitude)
    cameras = [camera for _, camera in found.rows]
    record(place / RECORDING, found.body, list(zip(smoothed, cameras, strict=True)))


def _with_whole_paths(settings: OrbitFitSettings, beside: Path) -> OrbitFitSettings:
    """The settings with the field's file as it is found from anywhere."""
    if settings.forces.field is None:
        return settings
    field = str(resolve_path(settings.forces.field, beside).resolve())
    forces = msgspec.structs.replace(settings.forces, field=field)
    return msgspec.structs.replace(settings, forces=forces)


def problem_of(
    found: RunFixes,
    settings: OrbitFitSettings,
    ephemeris: Ephemeris,
    priors: list[OrbitPrior],
    beside: Path,
) -> OrbitProblem:
    """Prepare the problem; beside: where a gravity field is sought."""
    motion = ArcMotion(Forces(ephemeris, settings.forces, beside), settings.noise)
    parameters = list(settings.parameter)
    return OrbitProblem(motion, found.fixes, priors, parameters, found.body.radius_m)


def read_fixes(
    runs: Sequence[RunFolder], *, lens: bool = False, timeless: bool = False
) -> RunFixes:
    """The solved frames of runs; lens: without what is stated of the focal lengths.

    timeless  whether a row may have no time: its fix then is of NaN TDB s

    Raises DataError for runs of several bodies or damaged fixes.
    """
    first = runs[0]
    places = Counter(run.path.resolve() for run in runs)
    for run in runs:
        if places[run.path.resolve()] > 1:
            raise DataError(f"{run.path}: is named twice; name each run once")
        if run.attitude.body != first.attitude.body:
            raise DataError(
                f"{run.path}: its fixes are about {run.attitude.body.name}, those of {first.path} "
                f"about {first.attitude.body.name}; fit each body by itself"
            )
    files = Counter(solution.file for run in runs for solution in run.solutions)
    prefixed = max(files.values(), default=1) > 1
    rows: list[tuple[Solution, Camera | None]] = []
    fixes = []
    for run in runs:
        twice = Counter(solution.file for solution in run.solutions)
        for solution in without_lens_error(run) if lens else run.solutions:
            where = f"{run.path / SOLUTION}: {solution.file}"
            if twice[solution.file] > 1:
                raise DataError(f"{where}: stands there twice; keep one row")
            camera = run.cameras.get(solution.file)
            name = f"{run.path.name}/{solution.file}" if prefixed else solution.file
            row = replace(solution, file=name)
            rows.append((row, camera))
            if solution.solved and solution.method != Method.ORBIT:
                if not row.utc and not timeless:
                    raise DataError(
                        f"{where}: has no utc; `optnav orbit time` finds it by an orbit"
                    )
                fix = _fix(row, run, camera.name if camera else "", where)
                sigma = run.time_sigmas_s.get(solution.file)
                fixes.append(replace(fix, time_sigma_s=sigma))
    if not fixes:
        raise NothingToDoError(
            f"{', '.join(str(run.path) for run in runs)}: no frame is solved, so there is nothing "
            "to fit an orbit through; see the reasons in solution.csv"
        )
    if len(fixes) > MAX_FIXES:
        raise DataError(f"{len(fixes)} fixes are more than {MAX_FIXES}; fit parts of the flight")
    return RunFixes(rows, fixes, first.attitude.body, first.attitude)


def _fix(solution: Solution, run: RunFolder, camera: str, where: str) -> OrbitFix:
    frame = run.attitude.places
    position, covariance = solution.position_m, solution.covariance_m2
    if position is None or covariance is None:
        raise DataError(f"{where}: has no covariance; navigate again")
    stated = frame.transform_covariance_to_stated(covariance)
    if float(np.linalg.eigvalsh(stated)[0]) < MIN_SIGMA_M**2:
        raise DataError(
            f"{where}: its covariance is below the digits of its position, {MIN_SIGMA_M:g} m; "
            "navigate again"
        )
    if float(np.linalg.norm(position)) < DEEPEST * min(run.attitude.body.radii_m):
        raise DataError(
            f"{where}: its position lies inside {run.attitude.body.name}; see that run.toml names "
            "the right body, or navigate again"
        )
    try:
        time = math.nan if not solution.utc else utc_to_tdb_s(solution.utc)
    except DataError as error:
        raise DataError(f"{where}: {error}") from None
    name = run.path.resolve().name
    place_m, sight = frame.transform_to_stated(position), None
    if solution.fix is not None:
        sight = sight_of(solution.fix, run.attitude.body.radius_m)
    if sight is not None:
        sight = frame.rotate_to_stated(sight)
    method = str(solution.method)
    return OrbitFix(solution.file, solution.utc, time, name, camera, place_m, stated, method, sight)


def _with_times(found: RunFixes, sigma_s: float) -> RunFixes:
    """The fixes with the common error of their times where none of theirs is stated."""
    fixes = [
        replace(fix, time_sigma_s=sigma_s if fix.time_sigma_s is None else fix.time_sigma_s)
        for fix in found.fixes
    ]
    return replace(found, fixes=fixes)


def _kernels(runs: Sequence[RunFolder], settings: OrbitFitSettings, beside: Path) -> list[str]:
    """SPICE kernels: of the settings, else those that the first run was navigated with."""
    if settings.spice.kernels:
        return [str(resolve_path(name, beside).resolve()) for name in settings.spice.kernels]
    if not (runs[0].path / MANIFEST).exists():
        return []
    config = read_manifest(runs[0].path).get("options", {}).get("config", {})
    named = config.get("spice", {}).get("kernels", []) if isinstance(config, dict) else []
    missing = [name for name in named if not Path(name).is_file()]
    if missing:
        log.warning(
            "%s: was navigated with %s, which is not there; the rotation is by theory",
            runs[0].path,
            missing[0],
        )
        return []
    return list(named)


def _ends(fixes: Sequence[OrbitFix]) -> tuple[float, float]:
    """TDB s of the first and the last one."""
    times = [fix.tdb_s for fix in fixes]
    return min(times), max(times)


def _inputs(runs: Sequence[Path], ephemeris: Ephemeris) -> dict[str, Any]:
    hashes = [{"path": str(p), "files_sha256": hash_files(p, [SOLUTION])} for p in runs]
    return {"runs": hashes, "motion": ephemeris.name}
