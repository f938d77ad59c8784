"""Zenith distances to an orbit and its folder, as `optnav orbit fit` does with a zenith.csv."""

import logging
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import msgspec
import numpy as np

from catalog.arrays import FloatArray
from catalog.bodies.body import Body, load_body
from catalog.bodies.ephemeris import load_ephemeris
from catalog.bodies.epochs import utc_from_tdb_s
from catalog.errors import DataError, UsageError
from catalog.files import hash_file
from catalog.geometry.rotations import ARCSEC
from catalog.terrain.dem.file import resolve_path
from optnav_cli.dynamics.forces import Forces
from optnav_cli.dynamics.left_out import warn_of_unknown_gravity
from optnav_cli.frames.orbit_tables import DISTURBANCES, ZENITH_RESIDUALS
from optnav_cli.frames.run_settings import (
    RUN_TOML,
    RunSettings,
    read_run_settings,
    write_run_settings,
)
from optnav_cli.orbit.fit.first import with_nodes
from optnav_cli.orbit.fit.fit import OrbitFit, densify, fit_orbit, settle_fit
from optnav_cli.orbit.fit.folder import (
    DISTURBANCES_CSV,
    ORBIT_CSV,
    ORBIT_OEM,
    ORBIT_TOML,
    Kind,
    OrbitRows,
    toml_of,
    write_orbit_rows,
)
from optnav_cli.orbit.fit.measurements import orbit_priors
from optnav_cli.orbit.fit.motion import ArcMotion
from optnav_cli.orbit.fit.oem import Oem, write_oem
from optnav_cli.orbit.fit.output import disturbance_rows, orbit_file, parameter_lines
from optnav_cli.orbit.fit.problem import OrbitPrior, OrbitProblem, Trajectory
from optnav_cli.orbit.fit.settings import (
    OF_FIXES,
    OF_SIGHTS,
    PARAMETERS,
    OrbitFitSettings,
    ParameterSettings,
)
from optnav_cli.orbit.fit.solver import OrbitSolver
from optnav_cli.orbit.fit.zenith import ZENITH_CSV, ZenithSights, read_zenith
from optnav_cli.output.manifest import OutputFolder
from optnav_cli.output.run_folder import SOLUTION
from optnav_cli.output.wording import format_length

ZENITH_RESIDUALS_CSV = "zenith_residuals.csv"
LEFT_OUT = "disagrees with the orbit of the others"
MAX_NAMED = 10  # sights left out that are named on the screen
log = logging.getLogger(__name__)

CSV = ".csv"
DEFAULT_BODY = "moon"  # of a file without a run.toml beside it


def write_zenith_folder(
    place: Path,
    sights: ZenithSights,
    fit: OrbitFit,
    dense: OrbitFit,
    settings: OrbitFitSettings,
    kernels: Sequence[str],
) -> None:
    """Write orbit.toml, orbit.csv, zenith_residuals.csv, disturbances.csv and orbit.oem.

    dense  the fit with nodes as the rows of orbit.csv
    """
    text = toml_of(orbit_file(dense, settings, kernels))
    (place / ORBIT_TOML).write_text(text, encoding="utf-8")
    times = dense.problem.times
    kinds: list[Kind] = ["between"] * len(times)
    rows = OrbitRows(times, kinds, dense.trajectory.states, dense.covariances)
    write_orbit_rows(place / ORBIT_CSV, rows, dense.problem.ephemeris)
    write_zenith_residuals(place, sights, fit)
    DISTURBANCES.write(place / DISTURBANCES_CSV, disturbance_rows(fit))
    oem = Oem(
        dense.problem.ephemeris.body.name, times, rows.states, fit.problem.times, fit.covariances
    )
    write_oem(place / ORBIT_OEM, oem, "CRAFT", utc_from_tdb_s(float(times[-1]), 0))


def write_zenith_residuals(place: Path, sights: ZenithSights, fit: OrbitFit) -> None:
    """Write zenith_residuals.csv to a folder."""
    ZENITH_RESIDUALS.write(place / ZENITH_RESIDUALS_CSV, _residual_rows(sights, fit))


def _residual_rows(sights: ZenithSights, fit: OrbitFit) -> Iterator[dict[str, object]]:
    looks = fit.looks
    for k in range(len(sights)):
        used = bool(looks.used[k])
        yield {
            "utc": utc_from_tdb_s(float(sights.tdb_s[k])),
            "star": sights.names[sights.star_of[k]],
            "value_deg": float(np.degrees(sights.values_rad[k])),
            "residual_arcsec": float(looks.residual[k]) / ARCSEC,
            "sigma_arcsec": float(sights.sigmas_rad[k]) / ARCSEC,
            "chi_square": float(looks.chi_square[k]),
            "used": used,
            "reason": "" if used else LEFT_OUT,
        }


def zenith_summary(sights: ZenithSights, fit: OrbitFit) -> list[str]:
    """A few lines for people."""
    first, last = (utc_from_tdb_s(float(fit.problem.times[k]), 0) for k in (0, -1))
    looks = fit.looks
    used = looks.used
    rms = float(np.sqrt(np.mean(looks.residual[used] ** 2))) / ARCSEC
    sigmas = np.sqrt(np.trace(fit.covariances[:, :3, :3], axis1=1, axis2=2) / 3.0)
    lines = [
        f"orbit through {fit.used} of {fit.count} zenith distances of "
        f"{', '.join(sights.stars_used)} from {first} to {last}, {fit.steps} steps",
        f'chi-square {fit.chi_square:.0f} of {fit.degrees_of_freedom}, residuals {rms:.3g}" rms, '
        f'sigma {float(np.median(sights.sigmas_rad)) / ARCSEC:.3g}" in the middle',
        f"median sigma an axis: {format_length(float(np.median(sigmas)))} of the orbit",
        *parameter_lines(fit),
    ]
    out = np.flatnonzero(~used)
    for k in out[:MAX_NAMED]:
        star = sights.names[sights.star_of[k]]
        lines.append(f"left out {star} at {utc_from_tdb_s(float(sights.tdb_s[k]), 0)}: {LEFT_OUT}")
    if len(out) > MAX_NAMED:
        lines.append(f"left out {len(out) - MAX_NAMED} more; see {ZENITH_RESIDUALS_CSV}")
    return [*lines, *fit.remarks]


@dataclass(frozen=True, eq=False)
class ZenithInputs:
    """The sights of some files, in the order of time, and the body that they are about."""

    paths: list[Path]
    sights: ZenithSights
    body: Body
    settings: RunSettings


def is_zenith(path: Path) -> bool:
    """Whether an input of the fit is a zenith.csv, or a folder that has that and no solution."""
    if path.suffix == CSV:
        return True
    return (path / ZENITH_CSV).is_file() and not (path / SOLUTION).exists()


def read_zenith_inputs(inputs: Sequence[Path]) -> ZenithInputs:
    """The sights of files, or of folders that have one.

    Raises DataError for damaged ones or several bodies, UsageError for one that is named twice.
    """
    paths = [path if path.suffix == CSV else path / ZENITH_CSV for path in inputs]
    if len({path.resolve() for path in paths}) < len(paths):
        raise UsageError("a file of zenith distances is named twice; name each once")
    parts = [read_zenith(path) for path in paths]
    sources = [source_settings(path) for path in paths]
    for path, (_, body) in zip(paths, sources, strict=True):
        if body != sources[0][1]:
            raise DataError(
                f"{path}: is about {body.name}, {paths[0]} about {sources[0][1].name}; fit each "
                "body by itself"
            )
    return ZenithInputs(paths, _joined(parts), sources[0][1], sources[0][0])


def fit_zenith_files(
    inputs: Sequence[Path],
    out: OutputFolder,
    settings: OrbitFitSettings,
    solve: Sequence[str],
    beside: Path,
) -> list[str]:
    """Fit an orbit through zenith distances and fill its folder; lines for people.

    Raises DataError, UsageError or ConfigError for what cannot be used, NoSolutionError where the
    sights leave the orbit open or fit none.
    """
    source = read_zenith_inputs(inputs)
    kernels = [str(resolve_path(name, beside).resolve()) for name in settings.spice.kernels]
    ephemeris = load_ephemeris(source.body, [Path(name) for name in kernels])
    warn_of_unknown_gravity(source.body, settings.forces)
    settings = _with_solved(settings, solve)
    ends = float(source.sights.tdb_s[0]), float(source.sights.tdb_s[-1])
    priors = orbit_priors(settings.prior, ephemeris, beside, ends)
    motion = ArcMotion(Forces(ephemeris, settings.forces, beside), settings.noise)
    fit = fit_zenith(motion, source.sights, priors, settings.parameter, settings.gate_probability)
    write_zenith_folder(
        out.path, source.sights, fit, densify(fit, settings.step_s), settings, kernels
    )
    write_run_settings(source.settings, out.path)
    out.options = {"config": msgspec.to_builtins(settings), "solve": list(solve)}
    out.inputs = {
        "zenith": [{"path": str(p), "sha256": hash_file(p)} for p in source.paths],
        "motion": ephemeris.name,
    }
    out.results = {"zenith_distances": fit.count, "used": fit.used}
    return zenith_summary(source.sights, fit)


def source_settings(path: Path) -> tuple[RunSettings, Body]:
    """Read the run.toml beside a file of measurements; without one they are of the Moon."""
    beside = path.parent / RUN_TOML
    if beside.is_file():
        return read_run_settings(beside)
    log.warning(
        "%s: no run.toml stands beside it; its measurements are taken for those of the %s",
        path,
        DEFAULT_BODY,
    )
    return RunSettings(DEFAULT_BODY, "camera_from_body"), load_body(DEFAULT_BODY)


def _joined(parts: Sequence[ZenithSights]) -> ZenithSights:
    if len(parts) == 1:
        return parts[0]
    names = list(dict.fromkeys(name for part in parts for name in part.names))
    star_of = [
        np.array([names.index(name) for name in part.names], np.int64)[part.star_of]
        for part in parts
    ]
    order = np.argsort(np.concatenate([part.tdb_s for part in parts]), kind="stable")
    return ZenithSights(
        np.concatenate([part.tdb_s for part in parts])[order],
        np.concatenate([part.directions for part in parts])[order],
        np.concatenate([part.values_rad for part in parts])[order],
        np.concatenate([part.sigmas_rad for part in parts])[order],
        np.concatenate(star_of)[order],
        tuple(names),
    )


def _with_solved(settings: OrbitFitSettings, solve: Sequence[str]) -> OrbitFitSettings:
    """The settings with what --solve names. Raises UsageError for what belongs to fixes."""
    parameters = list(settings.parameter)
    stated = {parameter.name for parameter in parameters}
    for name in (*PARAMETERS, *OF_SIGHTS):
        if name in solve and name not in stated:
            parameters.append(ParameterSettings(name))
            stated.add(name)
    if settings.noise.model == "mean" and "acceleration" not in stated:
        parameters.append(ParameterSettings("acceleration"))
    for parameter in parameters:
        if parameter.name in OF_FIXES:
            raise UsageError(
                f"{parameter.name} belongs to fixes, and zenith distances do not depend on it; "
                "solve for srp, acceleration or vertical, or fit a run"
            )
    return msgspec.structs.replace(settings, parameter=tuple(parameters))


def zenith_problem(
    motion: ArcMotion,
    sights: ZenithSights,
    priors: Sequence[OrbitPrior],
    parameters: Sequence[ParameterSettings],
    state: FloatArray,
    step_s: float = math.inf,
) -> OrbitProblem:
    """Prepare the problem with its nodes.

    state   (6,) of about the orbit, whose motion the nodes' distance follows
    step_s  nodes are no farther apart

    Raises NoSolutionError for an arc of too many nodes.
    """
    return with_nodes(_problem_of(motion, sights, priors, parameters), state, step_s)


def _problem_of(
    motion: ArcMotion,
    sights: ZenithSights,
    priors: Sequence[OrbitPrior],
    parameters: Sequence[ParameterSettings],
) -> OrbitProblem:
    radius = motion.ephemeris.body.radius_m
    return OrbitProblem(motion, [], list(priors), list(parameters), radius, sights=sights)


def fit_zenith(
    motion: ArcMotion,
    sights: ZenithSights,
    priors: Sequence[OrbitPrior],
    parameters: Sequence[ParameterSettings],
    gate_probability: float,
) -> OrbitFit:
    """Fit. Raises NoSolutionError where the sights leave the orbit open or fit none."""
    problem = _problem_of(motion, sights, priors, parameters)
    return fit_orbit(problem, "white", gate_probability)


def settled(problem: OrbitProblem, at: Trajectory, gate_probability: float) -> OrbitFit:
    """Fit from a trajectory near it. Raises NoSolutionError where the steps do not converge."""
    return settle_fit(OrbitSolver(problem, "white"), at, gate_probability)
