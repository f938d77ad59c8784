"""[[prior]]: a state that is known of an orbit without its fixes, or the OEM of another source."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from catalog.arrays import FloatArray
from catalog.bodies.ephemeris import Ephemeris
from catalog.bodies.epochs import utc_from_tdb_s, utc_to_tdb_s
from catalog.errors import ConfigError, DataError
from optnav_cli.orbit.fit.folder import ROTATION_STEP_S, matrix_of, stated_turn
from optnav_cli.orbit.fit.oem_reader import read_oem
from optnav_cli.orbit.fit.problem import OrbitPrior
from optnav_cli.orbit.fit.settings import OrbitPriorSettings


def orbit_priors(
    settings: Sequence[OrbitPriorSettings],
    ephemeris: Ephemeris,
    beside: Path,
    ends: tuple[float, float],
) -> list[OrbitPrior]:
    """The priors, each at one time; ends: TDB s of the first and last measurement.

    Raises ConfigError or DataError for one that is wrong."""
    known = []
    for section in settings:
        if section.oem:
            known.append(_of_oem(section, ephemeris, beside / section.oem, ends))
        else:
            known.append(_of_state(section, ephemeris))
    for prior in known:
        if not np.linalg.eigvalsh(prior.covariance)[0] > 0.0:
            raise ConfigError(f"[[prior]] {prior.source}: its covariance is not positive definite")
    return known


def _of_state(settings: OrbitPriorSettings, ephemeris: Ephemeris) -> OrbitPrior:
    try:
        time = utc_to_tdb_s(settings.utc)
    except DataError as error:
        raise ConfigError(f"[[prior]] utc: {error}") from None
    state = np.array([*(settings.position_m or ()), *(settings.velocity_m_s or ())])
    covariance = matrix_of(settings.covariance) if settings.covariance else _spread(settings)
    if settings.frame == "body":
        step = ROTATION_STEP_S
        turn = stated_turn(ephemeris, time)
        rate = stated_turn(ephemeris, time + step) - stated_turn(ephemeris, time - step)
        # x' = Q x, v' = Q v + Q' x
        inertial_from_body = np.kron(np.eye(2), turn.T)
        inertial_from_body[3:, :3] = -turn.T @ rate @ turn.T / (2.0 * step)
        state = inertial_from_body @ state
        covariance = inertial_from_body @ covariance @ inertial_from_body.T
    return OrbitPrior(time, state, covariance, f"state at {settings.utc}")


def _of_oem(
    settings: OrbitPriorSettings, ephemeris: Ephemeris, path: Path, ends: tuple[float, float]
) -> OrbitPrior:
    """Its state at a covariance nearest the middle of the fixes, or with the stated sigmas.

    With these it is a state of the file itself, which no interpolation can be wrong by.
    """
    oem = read_oem(path, ephemeris.body)
    first, last = ends
    middle = 0.5 * (first + last)
    if oem.times[-1] < first or oem.times[0] > last:
        start, end = (utc_from_tdb_s(float(oem.times[k]), 0) for k in (0, -1))
        raise DataError(f"{path}: its states, {start} to {end}, are of another time than the fixes")
    if settings.position_sigma_m is not None and settings.velocity_sigma_m_s is not None:
        k = int(np.argmin(np.abs(oem.times - middle)))
        return OrbitPrior(float(oem.times[k]), oem.states[k], _spread(settings), str(path))
    if not len(oem.covariances):
        raise DataError(
            f"{path}: has no covariance; add position_sigma_m and velocity_sigma_m_s to its "
            "[[prior]]"
        )
    k = int(np.argmin(np.abs(oem.covariance_times - middle)))
    time = float(oem.covariance_times[k])
    return OrbitPrior(time, oem.state_at(time), oem.covariances[k], str(path))


def _spread(settings: OrbitPriorSettings) -> FloatArray:
    position, velocity = settings.position_sigma_m or 0.0, settings.velocity_sigma_m_s or 0.0
    return np.diag([position**2] * 3 + [velocity**2] * 3)
