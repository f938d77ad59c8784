"""What is written of a fitted orbit: predictions, and files that other programs read."""

import logging
from pathlib import Path

import numpy as np

from catalog.bodies.epochs import utc_from_tdb_s, utc_to_tdb_s
from catalog.errors import DataError, NothingToDoError, UsageError
from catalog.files import make_prefix_test, replace_file, write_output
from catalog.geometry.ellipsoid import geodetic_from_xyz
from catalog.geometry.rotations import rnb_axes
from catalog.progress import Progress
from optnav_cli.dynamics.left_out import warn_of_unknown_gravity
from optnav_cli.frames.orbit_tables import PICTURE_TIMES
from optnav_cli.orbit.fit.folder import (
    ORBIT_CSV,
    OrbitRows,
    StoredOrbit,
    read_orbit,
    stated_turn,
    write_orbit_rows,
)
from optnav_cli.orbit.fit.job import read_fixes
from optnav_cli.orbit.fit.known_orbit import PictureTime, known_orbit, picture_times
from optnav_cli.orbit.fit.oem import BEGINNING, SPK_BEGINNING, Oem, write_oem, write_spk
from optnav_cli.orbit.fit.predict import OrbitPath, Prediction
from optnav_cli.output.run_folder import read_run
from optnav_cli.output.wording import align_table

log = logging.getLogger(__name__)

MAX_ROWS = 500_000
CSV, OEM = ".csv", ".oem"
CSV_BEGINNING = b"utc,kind,"
SHOWN_ROWS = 25  # of a prediction on the screen


def predict_orbit(
    folder: Path, to_utc: str, step_s: float, progress: Progress
) -> tuple[OrbitPath, Prediction]:
    """A stored orbit from the end of its arc to a time, or from a time to its start.

    Raises UsageError for a time within the arc or too many steps to it, NothingToDoError where the
    path meets the body before the first of them.
    """
    path = OrbitPath(read_orbit(folder))
    warn_of_unknown_gravity(path.orbit.body, path.orbit.forces)
    to_s = utc_to_tdb_s(to_utc, "--to")
    if path.first_s <= to_s <= path.last_s:
        ends = " to ".join(utc_from_tdb_s(t, 0) for t in (path.first_s, path.last_s))
        raise UsageError(
            f"--to {to_utc} lies within the arc, {ends}; orbit.csv has its states: name a time "
            "after or before it"
        )
    from_s = path.last_s if to_s > path.last_s else path.first_s
    count = int(np.ceil(abs(to_s - from_s) / step_s))
    if count > MAX_ROWS:
        raise UsageError(
            f"--step {step_s:g} makes {count} rows to {to_utc}, more than {MAX_ROWS}; give a "
            "longer step"
        )
    side = 1.0 if to_s > from_s else -1.0
    times = np.append(from_s + side * step_s * np.arange(1.0, count), to_s)
    with progress.stage("predict", len(times), "state") as bar:
        prediction = path.rows(times, bar.advance)
    if len(prediction.rows.times) == 0:
        raise NothingToDoError(f"{folder}: {prediction.meeting}, before the first step to {to_utc}")
    if prediction.meeting:
        log.warning("%s; the prediction ends there", prediction.meeting)
    return path, prediction


def prediction_lines(path: OrbitPath, prediction: Prediction) -> list[str]:
    """A table for people: place, height and stated errors, at most some rows of it.

    Latitude and height of a spheroid are geodetic.
    """
    rows, body = prediction.rows, path.orbit.body
    count = len(rows.times)
    shown = np.unique(np.linspace(0, count - 1, min(count, SHOWN_ROWS)).round().astype(int))
    lat_name = "geodetic lat" if body.flattening else "lat"
    table = [("utc", lat_name, "lon", "height", "sigma R", "N", "B"), ("", *"°°", "km", *"mmm")]
    lines = [tuple(map(str, line)) for line in table]
    for k in shown:
        time, state = float(rows.times[k]), rows.states[k]
        x, y, z = stated_turn(path.orbit.ephemeris, time) @ state[:3]
        latitude, longitude = np.degrees([np.arctan2(z, np.hypot(x, y)), np.arctan2(y, x)])
        height_m = path.height_m(time, state)
        if body.flattening:
            lat, _, above = geodetic_from_xyz((x, y, z), body.radii_m)
            latitude, height_m = np.degrees(lat), float(above)
        axes = rnb_axes(state[:3], state[3:])
        sigmas = np.sqrt(np.diag(axes @ rows.covariances[k][:3, :3] @ axes.T))
        position = f"{latitude:.4f}", f"{longitude:.4f}", f"{height_m / 1e3:.3f}"
        lines.append((utc_from_tdb_s(time, 3), *position, *(f"{s:.1f}" for s in sigmas)))
    return align_table(lines, left=(0,))


def write_orbit(orbit: StoredOrbit, rows: OrbitRows, output: Path, craft: int) -> None:
    """Write states as .csv (the columns of orbit.csv), CCSDS .oem or SPICE .bsp, by the ending.

    craft  NAIF number of the craft in a .bsp
    """
    ending = output.suffix.lower()
    if ending == CSV:
        with replace_file(output, make_prefix_test(CSV_BEGINNING)) as new:
            write_orbit_rows(new, rows, orbit.ephemeris)
    elif ending == OEM:
        oem = Oem(orbit.body.name, rows.times, rows.states, rows.times, rows.covariances)
        with replace_file(output, make_prefix_test(BEGINNING)) as new:
            # the day of its last state, not of its writing: the same orbit makes the same file
            write_oem(new, oem, "CRAFT", utc_from_tdb_s(float(rows.times[-1]), 0))
    else:
        spice = orbit.body.spice
        if spice is None:
            raise DataError(
                f"{orbit.body.name}: its body file has no [spice] naif, which a .bsp needs as its "
                "centre; add it, or write an .oem"
            )
        with replace_file(output, make_prefix_test(SPK_BEGINNING)) as new:
            write_spk(new, rows.times, rows.states, craft, spice.naif[0])


def export_orbit(folder: Path, output: Path, craft: int) -> None:
    """Write the states of an orbit's folder as another file. Raises DataError for a damaged one."""
    orbit = read_orbit(folder)
    if output.suffix.lower() == CSV:
        write_output(output, (folder / ORBIT_CSV).read_bytes(), make_prefix_test(CSV_BEGINNING))
    else:
        write_orbit(orbit, orbit.rows, output, craft)


def time_pictures(run: Path, folder: Path, output: Path, margin_s: float, craft: int) -> list[str]:
    """Write when the solved pictures of a run were taken; lines for people.

    Raises DataError for a run about another body, NothingToDoError where the orbit passes none.
    """
    run_fixes = read_fixes([read_run(run)], timeless=True)
    path = known_orbit(folder, run_fixes.body, craft)
    if path.note:
        log.info("%s", path.note)
    timed = picture_times(path, run_fixes.fixes, margin_s)
    with replace_file(output, make_prefix_test(b"file,utc_stamp,utc,")) as new:
        PICTURE_TIMES.write(new, map(_time_cells, timed))
    best = [
        (picture.best.tdb_s, picture.fix.tdb_s) for picture in timed if picture.best is not None
    ]
    offsets = [time - stamp for time, stamp in best if np.isfinite(stamp)]
    if not best:
        raise NothingToDoError(
            f"{run}: {folder} passes none of its {len(timed)} positions within 3 sigmas; see that "
            "it is of the same flight, or search farther by --margin"
        )
    several = sum(len(picture.passes) > 1 for picture in timed)
    lines = [f"{len(best)} of {len(timed)} pictures lie on the orbit; {several} at several times"]
    if offsets:
        lines.append(f"median of time less stamp: {np.median(offsets):+.6f} s")
    return lines


def _time_cells(timed: PictureTime) -> dict[str, object]:
    best = timed.best
    cells: dict[str, object] = {"file": timed.fix.file, "utc_stamp": timed.fix.utc}
    if best is not None:
        cells |= {"utc": utc_from_tdb_s(best.tdb_s), "sigma_s": best.sigma_s}
        cells["candidates"] = ";".join(
            utc_from_tdb_s(candidate.tdb_s) for candidate in timed.passes
        )
    return cells
