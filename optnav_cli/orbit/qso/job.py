"""Settings to quasi-satellite orbits in a folder, as `optnav orbit qso` does."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import msgspec
import numpy as np

from catalog.arrays import FloatArray
from catalog.bodies.ephemeris import compute_mean_anomaly
from catalog.bodies.epochs import DAY_S, utc_from_tdb_s
from catalog.bodies.rotation import body_from_inertial
from catalog.config import resolve_config
from catalog.errors import NoSolutionError
from catalog.files import hash_file
from catalog.progress import Progress
from optnav_cli.frames.orbit_tables import BODY_STATE, INERTIAL, QSO, QSO_PASSES, QSO_PATHS
from optnav_cli.orbit.fit.oem import Oem, write_oem
from optnav_cli.orbit.qso.motion import MoonMotion
from optnav_cli.orbit.qso.search import QsoOrbit, QsoSearch, QsoStart
from optnav_cli.orbit.qso.settings import (
    FOLDER,
    PASSES_CSV,
    PATHS_CSV,
    QSO_CSV,
    QSO_KIND,
    QsoSection,
    distances_of,
    load_qso_settings,
    moon_of,
    motion_of_moon,
    start_times,
)
from optnav_cli.output.manifest import output_folder
from optnav_cli.output.wording import align_table

STAGE = "orbit qso"
PATH_STEP_S = 600.0


@dataclass(frozen=True, eq=False)
class QsoRow:
    """A start, and its orbit or why it has none."""

    number: int
    start: QsoStart
    anomaly: float
    orbit: QsoOrbit | None
    reason: str = ""


def qso_folder(settings_path: Path, output: Path, progress: Progress) -> tuple[list[QsoRow], float]:
    """Find the orbits that the settings ask for and write the folder; the moon's mean motion, too.

    Raises ConfigError for wrong settings, NothingToDoError, after the folder is written, when no
    orbit was found.
    """
    path = resolve_config(settings_path, FOLDER)
    settings = load_qso_settings(settings_path)
    section = settings.qso
    with output_folder(output, QSO_KIND, "orbit qso", [path], STAGE) as out:
        moon = moon_of(section.body, path)
        motion = motion_of_moon(settings.forces, moon, path.parent)
        rows = find_orbits(section, motion, progress)
        QSO.write(out.path / QSO_CSV, (_cells(row, motion) for row in rows))
        QSO_PASSES.write(
            out.path / PASSES_CSV,
            (cells for row in rows if row.orbit for cells in _pass_cells(row, motion)),
        )
        QSO_PATHS.write(
            out.path / PATHS_CSV,
            (cells for row in rows for cells in _path_cells(row, section.days, motion)),
        )
        for row in rows:
            if row.orbit is not None:
                name = f"orbit_{row.number:02d}"
                oem = _oem(row, row.orbit, section, motion)
                write_oem(out.path / f"{name}.oem", oem, name.upper())
        out.options = msgspec.to_builtins(settings)
        out.inputs = {"settings": path, "settings_sha256": hash_file(path)}
        count = sum(row.orbit is not None for row in rows)
        out.results = {"orbits": len(rows), "found": count}
        if not count:
            out.failure = f"{settings_path}: no orbit was found; the first: {rows[0].reason}"
    return rows, motion.mean_motion


def find_orbits(section: QsoSection, motion: MoonMotion, progress: Progress) -> list[QsoRow]:
    """The orbits of all distances and times; the distance runs fastest."""
    rows: list[QsoRow] = []
    distances, times = distances_of(section), start_times(section, motion)
    with progress.stage(STAGE, len(distances) * len(times), "start") as bar:
        for tdb_s in times:
            for distance in distances:
                longitude = float(np.radians(section.longitude_deg))
                start = QsoStart(1e3 * distance, longitude, float(tdb_s))
                number = len(rows) + 1
                anomaly = float(compute_mean_anomaly(motion.orbit, tdb_s)) % (2.0 * np.pi)
                try:
                    search = QsoSearch(motion, start, section.days, section.start == "greatest")
                    orbit = search.solve(section.velocity)
                    rows.append(QsoRow(number, start, anomaly, orbit))
                except NoSolutionError as error:
                    rows.append(QsoRow(number, start, anomaly, None, str(error)))
                bar.advance()
    return rows


def states_cells(
    motion: MoonMotion, tdb_s: FloatArray, states: FloatArray
) -> list[dict[str, float]]:
    """Cells of body-fixed and inertial states (n, 6) at times (n,)."""
    turns, before, after = (
        body_from_inertial(motion.moon, tdb_s + seconds) for seconds in (0.0, -1.0, 1.0)
    )
    rates = after - before  # over two seconds: 1e-9 of the speed
    places = np.einsum("nij,nj->ni", turns, states[:, :3])
    speeds = np.einsum("nij,nj->ni", turns, states[:, 3:])
    speeds += np.einsum("nij,nj->ni", 0.5 * rates, states[:, :3])
    fixed = np.hstack([places, speeds])
    return [
        dict(zip((*BODY_STATE, *INERTIAL), map(float, (*fixed_state, *other)), strict=True))
        for fixed_state, other in zip(fixed, states, strict=True)
    ]


def _cells(row: QsoRow, motion: MoonMotion) -> dict[str, object]:
    start, orbit = row.start, row.orbit
    cells: dict[str, object] = {
        "orbit": row.number,
        "distance_km": start.distance_m / 1e3,
        "longitude_deg": float(np.degrees(start.longitude)),
        "utc": utc_from_tdb_s(start.tdb_s, 3),
        "anomaly_deg": float(np.degrees(row.anomaly)),
        "status": "unsolved" if orbit is None else "solved",
        "reason": row.reason,
    }
    if orbit is None:
        return cells
    cells |= states_cells(motion, np.array([start.tdb_s]), orbit.state[None])[0]
    rates = orbit.passes.rates(motion.mean_motion)
    cells |= {
        "radius_km": orbit.radius_m / 1e3,
        "spread_km": orbit.spread_m / 1e3,
        "ring_km": orbit.ring_m / 1e3,
        "theory_spread_km": orbit.guess_spread_m / 1e3,
        "rate": float(rates.mean()),
        "rate_min": float(rates.min()),
        "rate_max": float(rates.max()),
        "theory_rate": orbit.theory_rate,
        "theory_dv_m_s": float(np.linalg.norm(orbit.state[3:] - orbit.guess[3:])),
        "passes": len(orbit.passes.tdb_s),
        "trials": orbit.trials,
    }
    return cells


def _pass_cells(row: QsoRow, motion: MoonMotion) -> list[dict[str, object]]:
    orbit = row.orbit
    if orbit is None:
        return []
    passes = orbit.passes
    surface_m = orbit.radius_m - row.start.distance_m
    rates = [None, *passes.rates(motion.mean_motion).tolist()]
    states = states_cells(motion, passes.tdb_s, passes.states)
    return [
        {
            "orbit": row.number,
            "pass": number,
            "utc": utc_from_tdb_s(float(passes.tdb_s[number]), 3),
            "distance_km": float(passes.radius_m[number] - surface_m) / 1e3,
            "rate": rates[number],
            **states[number],
        }
        for number in range(len(passes.tdb_s))
    ]


def _path_cells(row: QsoRow, days: float, motion: MoonMotion) -> Iterator[dict[str, object]]:
    """The paths of an orbit and of its first guess in the turning frame, for drawings."""
    if row.orbit is None:
        return
    seconds = np.append(np.arange(0.0, DAY_S * days, PATH_STEP_S), DAY_S * days)
    turning = motion.turning_from_inertial(row.start.tdb_s + seconds)
    for kind, state in (("orbit", row.orbit.state), ("theory", row.orbit.guess)):
        states = motion.propagate(state, row.start.tdb_s + seconds, PATH_STEP_S)
        places = np.einsum("nij,nj->ni", turning, states[:, :3]) / 1e3
        for after, position in zip(seconds, places, strict=True):
            # a path that falls in or leaves is drawn as far as it is one
            share = 1e3 * float(np.linalg.norm(position)) / row.orbit.radius_m
            if not 0.05 < share < 9.0:
                break
            axes = dict(zip(("x_km", "y_km", "z_km"), map(float, position), strict=True))
            yield {"orbit": row.number, "kind": kind, "seconds": float(after), **axes}


def _oem(row: QsoRow, orbit: QsoOrbit, section: QsoSection, motion: MoonMotion) -> Oem:
    seconds = DAY_S * section.days
    times = row.start.tdb_s + np.append(np.arange(0.0, seconds, section.step_s), seconds)
    states = motion.propagate(orbit.state, times, min(section.step_s, PATH_STEP_S))
    return Oem(motion.moon.name, times, states)


def qso_lines(rows: list[QsoRow], mean_motion: float) -> list[str]:
    """A summary for people."""
    head = ("orbit", "distance, km", "anomaly", "spread, km", "ring", "rate - 1", "by theory", "")
    table: list[tuple[str, ...]] = [head]
    for row in rows:
        distance, anomaly = row.start.distance_m / 1e3, np.degrees(row.anomaly)
        first = (str(row.number), f"{distance:g}", f"{anomaly:.0f}")
        if row.orbit is None:
            table.append((*first, "", "", "", "", row.reason))
            continue
        rate = float(row.orbit.passes.rates(mean_motion).mean())
        numbers = (row.orbit.spread_m / 1e3, row.orbit.ring_m / 1e3)
        shown = (*(f"{n:.2f}" for n in numbers), f"{rate:.3f}", f"{row.orbit.theory_rate:.3f}")
        table.append((*first, *shown, ""))
    return align_table(table, left=(7,))
