"""What a fit writes: the tables of its folder, its scene, and its summary for people."""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from catalog.arrays import FloatArray
from catalog.bodies.body import Body
from catalog.bodies.epochs import utc_from_tdb_s
from optnav_cli.camera.camera import Camera
from optnav_cli.fix import Method, Solution
from optnav_cli.frames.orbit_tables import AXES, DISTURBANCES, ORBIT_RESIDUALS
from optnav_cli.orbit.fit.fit import OrbitFit
from optnav_cli.orbit.fit.folder import (
    DISTURBANCES_CSV,
    ORBIT_CSV,
    ORBIT_OEM,
    ORBIT_TOML,
    RESIDUALS,
    Kind,
    OrbitFile,
    OrbitRows,
    StoredParameter,
    StoredState,
    StoredTest,
    toml_of,
    triangle_of,
    write_orbit_rows,
)
from optnav_cli.orbit.fit.motion import rnb_of
from optnav_cli.orbit.fit.oem import Oem, write_oem
from optnav_cli.orbit.fit.parameters import UNOBSERVED
from optnav_cli.orbit.fit.settings import UNITS, OrbitFitSettings
from optnav_cli.output.recording import Recording
from optnav_cli.output.wording import align_table, format_length

LEFT_OUT = "disagrees with the orbit of the others"


def rows_of_fit(fit: OrbitFit) -> OrbitRows:
    """The rows of orbit.csv."""
    nodes = set(fit.problem.node_of)
    kinds: list[Kind] = ["fix" if i in nodes else "between" for i in range(len(fit.problem.times))]
    return OrbitRows(fit.problem.times, kinds, fit.trajectory.states, fit.covariances)


def orbit_file(fit: OrbitFit, settings: OrbitFitSettings, kernels: Sequence[str]) -> OrbitFile:
    """orbit.toml. The state is that of the last node."""
    problem, at = fit.problem, fit.trajectory
    epoch = float(problem.times[-1])
    state = StoredState(
        utc_from_tdb_s(epoch),
        epoch,
        tuple(map(float, at.states[-1, :3])),
        tuple(map(float, at.states[-1, 3:])),
        triangle_of(fit.last_covariance),
    )
    test = StoredTest(
        fit.count,
        fit.used,
        float(fit.chi_square),
        fit.degrees_of_freedom,
        fit.steps,
        tuple(fit.remarks),
    )
    return OrbitFile(
        body=problem.ephemeris.body.name,
        rotation=problem.ephemeris.name,
        kernels=tuple(kernels),
        state=state,
        forces=settings.forces,
        noise=settings.noise,
        test=test,
        parameter=tuple(stored_parameters(fit)),
    )


def stored_parameters(fit: OrbitFit) -> Iterator[StoredParameter]:
    """Those estimated, then those considered."""
    sigmas = np.sqrt(np.diag(fit.parameter_covariance))
    for p in (*fit.problem.estimated, *fit.problem.considered):
        stated, estimated = p.settings, p.settings.mode == "estimate"
        value = fit.trajectory.parameters[p.span] if estimated else np.zeros(p.size)
        before = np.sqrt(np.diag(p.covariance))
        sigma = sigmas[p.span] if estimated else before
        yield StoredParameter(
            p.name,
            stated.camera,
            stated.run,
            stated.mode,
            float(before.max()),
            tuple(map(float, value)),
            tuple(map(float, sigma)),
            bool(estimated and (sigma <= UNOBSERVED * before).any()),
        )


def write_orbit_folder(
    place: Path, fit: OrbitFit, dense: OrbitFit, settings: OrbitFitSettings, kernels: Sequence[str]
) -> None:
    """Write orbit.toml, orbit.csv, residuals.csv, disturbances.csv and orbit.oem.

    dense  the fit with nodes between the fixes
    """
    text = toml_of(orbit_file(dense, settings, kernels))
    (place / ORBIT_TOML).write_text(text, encoding="utf-8")
    rows = rows_of_fit(dense)
    write_orbit_rows(place / ORBIT_CSV, rows, fit.problem.ephemeris)
    if fit.problem.fixes or fit.problem.sights is None:
        ORBIT_RESIDUALS.write(place / RESIDUALS, residual_rows(fit))
    DISTURBANCES.write(place / DISTURBANCES_CSV, disturbance_rows(fit))
    fixes = np.array([kind == "fix" for kind in rows.kinds])
    body = fit.problem.ephemeris.body.name
    if not fixes.any():
        fixes = np.isin(rows.times, fit.problem.times)
    oem = Oem(body, rows.times, rows.states, rows.times[fixes], rows.covariances[fixes])
    # the day of its last state, not of its writing: the same fixes make the same file
    write_oem(place / ORBIT_OEM, oem, "CRAFT", utc_from_tdb_s(float(rows.times[-1]), 0))


def residual_rows(fit: OrbitFit) -> Iterator[dict[str, object]]:
    """The rows of residuals.csv."""
    problem = fit.problem
    for number, (fix, residual) in enumerate(zip(problem.fixes, fit.residuals, strict=True)):
        axes = rnb_of(fit.trajectory.states[problem.node_of[number]]) @ problem.turn(number).T
        sigmas = np.sqrt(np.diag(axes @ fix.covariance_m2 @ axes.T))
        cells: dict[str, object] = {"file": fix.file, "utc": fix.utc, "camera": fix.camera}
        cells |= {"run": fix.run, "chi_square": residual.chi_square, "used": residual.used}
        cells |= {"reason": "" if residual.used else LEFT_OUT}
        cells |= zip((f"residual_{a}_m" for a in AXES), axes @ residual.residual_m, strict=True)
        cells |= zip((f"sigma_{a}_m" for a in AXES), sigmas, strict=True)
        yield cells


def disturbance_rows(fit: OrbitFit) -> Iterator[dict[str, object]]:
    """The rows of disturbances.csv."""
    problem = fit.problem
    for i, moved in enumerate(fit.disturbances):
        start, end = (float(problem.times[k]) for k in (i, i + 1))
        state = fit.trajectory.states[i + 1]
        axes = rnb_of(state)
        density = float(np.mean(problem.motion.densities(state[None, :3])))
        cells: dict[str, object] = {
            "from_utc": utc_from_tdb_s(start),
            "to_utc": utc_from_tdb_s(end),
        }
        cells |= zip((f"moved_{a}_m" for a in AXES), axes @ moved[:3], strict=True)
        cells |= zip((f"moved_v{a}_m_s" for a in AXES), axes @ moved[3:], strict=True)
        yield cells | {"sigma_m_s2": float(np.sqrt(density / (end - start)))}


def smoothed_solutions(fit: OrbitFit, solutions: Sequence[Solution]) -> list[Solution]:
    """The rows of solution.csv with the orbit's places; frames without a fix stay as they are."""
    problem = fit.problem
    numbers = {fix.file: number for number, fix in enumerate(problem.fixes)}
    frame = problem.ephemeris.body.catalog_frame
    smoothed = []
    for solution in solutions:
        number, before = numbers.get(solution.file), solution.fix
        if number is None or before is None:
            smoothed.append(solution)
            continue
        position, covariance = smoothed_place(fit, number)
        outcome = replace(
            before,
            method=Method.ORBIT,
            position_m=frame.transform_to_catalog(position),
            covariance_m2=frame.transform_covariance_to_catalog(covariance),
        )
        smoothed.append(replace(solution, outcome=outcome))
    return smoothed


def smoothed_place(fit: OrbitFit, number: int) -> tuple[FloatArray, FloatArray]:
    """Where the orbit has the craft at a fix (3,), m, body-fixed, and its covariance (3, 3)."""
    problem = fit.problem
    node = problem.node_of[number]
    state, covariance = fit.trajectory.states[node], fit.covariances[node]
    offset = problem.clock(number, fit.trajectory)
    after = problem.fixes[number].tdb_s + offset - float(problem.times[node])
    if after:
        state, bring = problem.motion.carry(state, float(problem.times[node]), after)
        covariance = bring @ covariance @ bring.T
    turn = problem.turn(number, offset)
    return turn @ state[:3], turn @ covariance[:3, :3] @ turn.T


def record(path: Path, body: Body, rows: Sequence[tuple[Solution, Camera | None]]) -> None:
    """Write run.mcap: the body, the path and the places with their ellipsoids."""
    names = sorted({camera.name for _, camera in rows if camera is not None})
    with Recording(path, body, None, names, {"command": "orbit fit"}) as recording:
        for solution, camera in rows:
            recording.add_frame(solution, (), camera)


def parameter_lines(fit: OrbitFit) -> list[str]:
    """A table of the parameters for people; none without any."""
    parameters = list(stored_parameters(fit))
    if not parameters:
        return []
    table = [("parameter", "", "value", "sigma", "before", "")]
    for p in parameters:
        whose = " ".join(filter(None, (p.camera, p.run)))
        unit = UNITS.get(p.name, UNITS["acceleration"])
        for value, sigma in zip(p.value, p.sigma, strict=True):
            known = "considered" if p.mode == "consider" else ""
            known = known or ("" if p.observed else "not observed")
            cells = (f"{value:.6g}", f"{sigma:.2g}", f"{p.prior_sigma:.2g}")
            table.append((f"{p.name} {unit}".strip(), whose, *cells, known))
    return align_table(table, left=(0, 1, 5))


def summary(fit: OrbitFit) -> list[str]:
    """A few lines for people."""
    first, last = (utc_from_tdb_s(float(fit.problem.times[k]), 0) for k in (0, -1))
    lines = [
        f"orbit through {fit.used} of {fit.count} {fit.problem.measured} from {first} to {last}, "
        f"{fit.steps} steps",
        f"chi-square {fit.chi_square:.0f} of {fit.degrees_of_freedom}",
    ]
    sigmas = np.sqrt(np.trace(fit.covariances[:, :3, :3], axis1=1, axis2=2) / 3.0)
    fixes = [np.sqrt(np.trace(fix.covariance_m2) / 3.0) for fix in fit.problem.fixes]
    line = f"median sigma an axis: {format_length(float(np.median(sigmas)))} of the orbit"
    lines.append(f"{line}, {format_length(float(np.median(fixes)))} of a fix" if fixes else line)
    lines += parameter_lines(fit)
    left_out = [
        f"left out {fix.file}: {LEFT_OUT} (chi-square {residual.chi_square:.0f} of 3)"
        for fix, residual in zip(fit.problem.fixes, fit.residuals, strict=True)
        if not residual.used
    ]
    return [*lines, *left_out, *fit.remarks]
