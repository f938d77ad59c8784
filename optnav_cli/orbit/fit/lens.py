"""Clocks and lenses of an orbit's fixes: whose they are, and fixes without their lens's error.

What a camera file states of its focal length (focal_length_error) is in the covariance of each fix
of picked points. Where the lens is a parameter common to all of them, it must not be there as well:
the frames are solved again without it.
"""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import msgspec
import numpy as np

from catalog.arrays import FloatArray
from catalog.errors import ConfigError, UsageError
from optnav_cli.camera.camera import Camera
from optnav_cli.camera.camera_file import write_camera
from optnav_cli.fix import Fix, Method, Solution
from optnav_cli.frames.folder import read_folder
from optnav_cli.frames.points import POINTS_CSV
from optnav_cli.orbit.fit.fit import OrbitFit
from optnav_cli.orbit.fit.parameters import UNOBSERVED
from optnav_cli.orbit.fit.problem import OrbitFix, OrbitPrior
from optnav_cli.orbit.fit.settings import (
    OF_SIGHTS,
    OF_SIGNALS,
    PARAMETERS,
    OrbitFitSettings,
    ParameterSettings,
)
from optnav_cli.orbit.fit.zenith import ZENITH_CSV
from optnav_cli.output.run_folder import CAMERAS, RunFolder
from optnav_cli.points.method import PickedFrames


def without_lens_error(run: RunFolder) -> list[Solution]:
    """The rows of a run, those of picked points solved without an error of the focal length.

    Raises DataError where the run's copies of the picture folder's files are damaged.
    """
    if not (run.path / POINTS_CSV).exists():
        return run.solutions
    folder = read_folder(run.path)
    how = PickedFrames(folder.attitude, folder.settings.points.filled, judges_lens=False)
    frames = {frame.file: frame for frame in folder.frames}
    solutions = []
    for row in run.solutions:
        frame, camera = frames.get(row.file), run.cameras.get(row.file)
        points = (folder.points or {}).get(row.file)
        again = None
        if row.solved and row.method is Method.PICKED_POINTS and frame and camera and points:
            again = how.solve(frame, replace(camera, focal_length_error=0.0), points)
        solutions.append(again if again is not None and again.solved else row)
    return solutions


def sight_of(fix: Fix, radius_m: float) -> FloatArray | None:
    """(3,) m, from the ground in the middle of a picked picture to the craft, body-fixed.

    A focal length wrong by a share moves the fix by this times the share. None of other fixes.
    """
    if fix.method is not Method.PICKED_POINTS or fix.camera_from_body is None:
        return None
    position = fix.position_m
    ahead = fix.camera_from_body.inv().apply((0.0, 0.0, 1.0))
    along = float(position @ ahead)
    under = along**2 - float(position @ position) + radius_m**2
    distance = -along - np.sqrt(under) if under > 0.0 and along < 0.0 else 0.0
    if distance <= 0.0:
        # the middle of the picture is beyond the limb: its points lie about the horizon
        distance = float(np.sqrt(max(float(position @ position) - radius_m**2, 0.0)))
    sight: FloatArray = -distance * np.asarray(ahead, np.float64)
    return sight


def with_lens_errors(
    settings: OrbitFitSettings, cameras: Sequence[Camera | None]
) -> OrbitFitSettings:
    """The settings with what camera files state of their focal lengths as priors of `focal`."""
    stated = {c.name: c.focal_length_error for c in cameras if c and c.focal_length_error > 0.0}

    def with_prior(one: ParameterSettings) -> ParameterSettings:
        if one.name != "focal" or one.prior_sigma is not None:
            return one
        errors = [size for name, size in stated.items() if one.camera in ("", name)]
        return msgspec.structs.replace(one, prior_sigma=max(errors)) if errors else one

    parameters = tuple(map(with_prior, settings.parameter))
    return msgspec.structs.replace(settings, parameter=parameters)


def write_calibrated(place: Path, fit: OrbitFit, cameras: Sequence[Camera | None]) -> list[str]:
    """Write cameras/NAME.toml of lenses that the orbit tells, with errors; lines for people."""
    sigmas = np.sqrt(np.diag(fit.parameter_covariance))
    known = {camera.name: camera for camera in cameras if camera is not None}
    lines = []
    for p in fit.problem.estimated:
        sigma = float(sigmas[p.span][0])
        if p.name != "focal" or p.settings.run or sigma > UNOBSERVED * p.settings.sigma:
            continue
        share = float(fit.trajectory.parameters[p.span][0])
        for name, camera in known.items():
            if p.settings.camera not in ("", name):
                continue
            calibrated = _scaled(camera, 1.0 / (1.0 + share), sigma)
            (place / CAMERAS).mkdir(exist_ok=True)
            write_camera(place / CAMERAS, calibrated)
            lines.append(
                f"{name}: focal length {calibrated.focal_length_px:.6g} px, not "
                f"{camera.focal_length_px:.6g}, to {100.0 * sigma:.2g} %; in {CAMERAS}/{name}.toml"
            )
    return lines


def _scaled(camera: Camera, scale: float, error: float) -> Camera:
    y = camera.focal_length_y_px
    return replace(
        camera,
        focal_length_px=camera.focal_length_px * scale,
        focal_length_y_px=None if y is None else y * scale,
        focal_length_error=error,
    )


def with_solved(
    settings: OrbitFitSettings,
    solve: Sequence[str],
    fixes: Sequence[OrbitFix],
    priors: Sequence[OrbitPrior],
) -> OrbitFitSettings:
    """The settings with the parameters that --solve names and that the noise model needs.

    Raises UsageError or ConfigError for one that no fix depends on, or that nothing can tell.
    """
    parameters = list(settings.parameter)
    stated = {parameter.name for parameter in parameters}
    for name in PARAMETERS:
        if name not in solve or name in stated:
            continue
        if name == "clock":
            parameters += _clocks(fixes, bool(priors) or _are_picked(fixes))
        elif name == "focal":
            parameters += _lenses(fixes)
        else:
            parameters.append(ParameterSettings(name))
    names = {parameter.name for parameter in parameters}
    if settings.noise.model == "mean" and "acceleration" not in names:
        parameters.append(ParameterSettings("acceleration"))
    _check_owners(parameters, fixes)
    if not priors and not _are_picked(fixes):
        _check_clocks(parameters, fixes)
    return msgspec.structs.replace(settings, parameter=tuple(parameters))


def _lenses(fixes: Sequence[OrbitFix]) -> list[ParameterSettings]:
    """A focal length for each camera."""
    names = list(dict.fromkeys(fix.camera for fix in fixes))
    return [ParameterSettings("focal", camera=name if len(names) > 1 else "") for name in names]


def _are_picked(fixes: Sequence[OrbitFix]) -> bool:
    """Whether all are of picked points: the clock of such a series is known by its stamps alone.

    It then stays at its prior and is said not to be observed, for the orbit's sigma needs it.
    """
    return all(fix.sight_m is not None for fix in fixes)


def _clocks(fixes: Sequence[OrbitFix], with_prior: bool) -> list[ParameterSettings]:
    """A clock for each camera, or of one camera for each run; without a prior not for the first."""
    for kind in ("camera", "run"):
        names = list(dict.fromkeys(getattr(fix, kind) for fix in fixes))
        if len(names) > 1:
            wanted = names if with_prior else names[1:]
            return [ParameterSettings("clock", **{kind: name}) for name in wanted]
    return [ParameterSettings("clock")]


def _check_owners(parameters: Sequence[ParameterSettings], fixes: Sequence[OrbitFix]) -> None:
    cameras, runs = {fix.camera for fix in fixes}, {fix.run for fix in fixes}
    for parameter in parameters:
        if parameter.name in OF_SIGHTS or parameter.name in OF_SIGNALS:
            raise ConfigError(
                f"[[parameter]] {parameter.name} belongs to zenith distances or signals, and there "
                f"are fixes alone; remove it, or name a {ZENITH_CSV} or --measurements"
            )
        for kind, name, known in (
            ("camera", parameter.camera, cameras),
            ("run", parameter.run, runs),
        ):
            if name and name not in known:
                raise ConfigError(
                    f"[[parameter]] {parameter.name}: no fix is of the {kind} '{name}'; there are "
                    f"{', '.join(sorted(known))}"
                )


def _check_clocks(parameters: Sequence[ParameterSettings], fixes: Sequence[OrbitFix]) -> None:
    """Raise UsageError where all fixes have clocks to solve for, and nothing states the orbit."""
    clocks = [p for p in parameters if p.name == "clock" and p.mode == "estimate"]

    def has_clock(fix: OrbitFix) -> bool:
        return any(p.camera in ("", fix.camera) and p.run in ("", fix.run) for p in clocks)

    if clocks and all(map(has_clock, fixes)):
        raise UsageError(
            "a clock offset common to all fixes is not observable: the body-fixed motion later is "
            "another orbit as good as this one (1 sigma 5e4 s about the Moon); state a [[prior]], "
            "leave one camera's or run's clock out, or give it mode = \"consider\""
        )
