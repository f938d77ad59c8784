"""What a fit through zenith distances writes into its folder."""

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from catalog.bodies.epochs import utc_from_tdb_s
from catalog.geometry.rotations import ARCSEC
from optnav_cli.frames.orbit_tables import DISTURBANCES, ZENITH_RESIDUALS
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
from optnav_cli.orbit.fit.oem import Oem, write_oem
from optnav_cli.orbit.fit.output import disturbance_rows, orbit_file, parameter_lines
from optnav_cli.orbit.fit.settings import OrbitFitSettings
from optnav_cli.orbit.fit.zenith_fit import ZenithFit
from optnav_cli.output.wording import format_length

ZENITH_RESIDUALS_CSV = "zenith_residuals.csv"
LEFT_OUT = "disagrees with the orbit of the others"
MAX_NAMED = 10  # sights left out that are named on the screen


def write_zenith_folder(
    place: Path,
    fit: ZenithFit,
    dense: ZenithFit,
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
    ZENITH_RESIDUALS.write(place / ZENITH_RESIDUALS_CSV, _residual_rows(fit))
    DISTURBANCES.write(place / DISTURBANCES_CSV, disturbance_rows(fit))
    oem = Oem(
        dense.problem.ephemeris.body.name,
        times,
        rows.states,
        fit.problem.times,
        fit.covariances,
    )
    write_oem(place / ORBIT_OEM, oem, "CRAFT", utc_from_tdb_s(float(times[-1]), 0))


def _residual_rows(fit: ZenithFit) -> Iterator[dict[str, object]]:
    sights, looks = fit.sights, fit.looks
    for k in range(len(sights)):
        used = bool(looks.used[k])
        yield {
            "utc": utc_from_tdb_s(float(sights.tdb_s[k])),
            "star": sights.names[sights.star_of[k]],
            "value_deg": float(np.degrees(sights.values_rad[k])),
            "residual_arcsec": float(looks.residual_rad[k]) / ARCSEC,
            "sigma_arcsec": float(sights.sigmas_rad[k]) / ARCSEC,
            "chi_square": float(looks.chi_square[k]),
            "used": used,
            "reason": "" if used else LEFT_OUT,
        }


def zenith_summary(fit: ZenithFit) -> list[str]:
    """A few lines for people."""
    first, last = (utc_from_tdb_s(float(fit.problem.times[k]), 0) for k in (0, -1))
    sights, looks = fit.sights, fit.looks
    used = looks.used
    rms = float(np.sqrt(np.mean(looks.residual_rad[used] ** 2))) / ARCSEC
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
