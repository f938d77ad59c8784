"""Cases of files that say something about their numbers: units, masks, datums, directions."""

import os
import re
from collections.abc import Callable
from pathlib import Path

import numpy as np

from catalog.bodies.body import load_body
from catalog.errors import DataError
from catalog.terrain.dem.source import DemSource
from tests.cases.command import (
    Outcome,
    Run,
    judge_refusal,
    judge_solution,
    navigate,
    read_rows,
    read_vector,
    run_command,
)

BASE_M = 240  # of slopes
SAME_HEIGHT_M = 1.0  # heights are whole metres


def compare_slopes(case: Path, out: Path, name: str, *words: str) -> Outcome:
    """Compare the rms slope of a file with that of the right one beside it, or expect a refusal."""
    right = run_command("slopes", case / "right_nan.tif", "--base-m", BASE_M)
    run = run_command("slopes", case / name, "--base-m", BASE_M)
    if run.code:
        return judge_refusal(run, *words)
    rms = [re.search(r"rms\s+([\d.]+) deg", each.text) for each in (run, right)]
    shown = [match[1] if match else "none" for match in rms]
    return Outcome("right" if shown[0] == shown[1] else "wrong", f"rms {shown[0]} deg")


def compare_heights(case: Path, first: str, second: str) -> Outcome:
    """Compare the heights of two files at the same places."""
    sources = []
    try:
        for name in (first, second):
            sources.append(DemSource.open_alone(case / name, load_body("moon")))
    except DataError as error:
        return Outcome("refused", str(error)[:160])
    rows, cols = sources[1].georeference.shape
    col, row = np.meshgrid(np.linspace(2, cols - 3, 9), np.linspace(2, rows - 3, 9))
    lat, lon = sources[1].georeference.latlon_from_pixel(col, row)
    heights = [source.heights_at(lat, lon) for source in sources]
    differences = np.abs(heights[0] - heights[1])
    same = bool(np.nanmax(differences) <= SAME_HEIGHT_M) and np.isfinite(differences).mean() > 0.9
    shown = f"differ by {np.nanmean(differences):.4g} m on average"
    return Outcome("right" if same else "wrong", shown)


def compare_imports(right: Path, case: Path, out: Path, table: str, camera: Path) -> Outcome:
    """Compare the frame that a label gives with that of a right label."""
    rows = []
    for number, label in enumerate((right, case)):
        folder = out / str(number)
        words = ("--table", table, "--camera", camera, "--body", "67p", "-o", folder)
        run = run_command("import", label, *words)
        if run.code:
            return Outcome("wrong", run.error[:160])
        rows.append(read_rows(folder / "frames.csv")[0])
    names = "qw qx qy qz x_m y_m z_m sun_x sun_y sun_z"
    off = np.abs(read_vector(rows[0], names) - read_vector(rows[1], names)).max()
    same = bool(off < 1e-2) and rows[0]["utc"] == rows[1]["utc"]
    return Outcome("right" if same else "wrong", f"differs by {off:.3g}, time {rows[1]['utc']}")


def compare_priors(case: Path, out: Path) -> Outcome:
    """Compare the orbit from a prior with covariances along RTN with that of inertial ones.

    The file's own states give the RTN axes; the orbits differ by what the states are off.
    """
    places, nees = [], []
    for name in ("inertial", "rtn"):
        folder = out / name
        words = ("--config", case / f"{name}.toml", "-o", folder)
        run = run_command("orbit", "fit", case / "run", *words)
        if run.code:
            return judge_refusal(run, "COV_REF_FRAME")
        rows = read_rows(folder / "orbit.csv")
        places.append([read_vector(row, "x_m y_m z_m") for row in rows])
        run = run_command("evaluate", folder, "--truth", case / "run/truth.csv")
        nees.append(_read_nees(run))
    off = float(np.abs(np.array(places[0]) - np.array(places[1])).max())
    same = off < 100.0 and abs(nees[0] - nees[1]) < 0.1
    return Outcome(
        "right" if same else "wrong", f"differ by {off:.3g} m; NEES {nees[1]}, {nees[0]}"
    )


def _read_nees(run: Run) -> float:
    match = re.search(r"normalised error squared ([\d.]+)", run.text)
    return float(match[1]) if match else float("nan")


def fit_with_segments(case: Path, out: Path) -> Outcome:
    """Fit an orbit with a prior of two segments, and judge it by the truth."""
    words = ("--config", case / "two_segments.toml", "-o", out / "orbit")
    run = run_command("orbit", "fit", case / "run", *words)
    if run.code:
        return judge_refusal(run)
    run = run_command("evaluate", out / "orbit", "--truth", case / "run/truth.csv", "--max-nees", 3)
    return Outcome("right" if run.code == 0 else "wrong", f"NEES {_read_nees(run)}")


def import_gap(case: Path, out: Path) -> Outcome:
    """Import times of which the second lies in a gap of the kernel: it is left out, named."""
    words = ("--table", case / "t.toml", "--camera", case / "cam.toml")
    shared = Path(os.environ.get("OPTNAV_SHARED_DATA", "")) / "spice"
    names = "moon_080317.tf moon_pa_de421_1900-2050.bpc naif0012.tls de405s_littleendian.bsp"
    paths = [case / "gap09.bsp", *(shared / name for name in names.split())]
    kernels = [word for path in paths for word in ("--kernel", path)]
    run = run_command("import", case / "times09.csv", *words, *kernels, "-o", out / "folder")
    named = re.search(r"b\.png.*gap|gap.*b\.png", run.text, re.S | re.I)
    line = next((line for line in run.text.splitlines() if "b.png" in line), run.error)
    return Outcome("refused" if named and run.code in (0, 3) else "wrong", line[:200])


def _solve(folder: Path, out: Path, *reasons: str) -> Outcome:
    run, row = navigate(folder, out / "run")
    truth = folder / "truth.csv"
    if not truth.is_file():
        truth = folder.parent / "exif3/truth.csv"
    return judge_solution(run, row, truth, *reasons)


def cases(files: Path) -> dict[str, Callable[[Path], Outcome]]:
    """List the cases of a folder by their names: functions of the folder for outputs."""
    labels, text = files / "label-units", files / "pds3-text"
    right3, right4 = labels / "pds3-km/PIC.LBL", labels / "pds4-km/PIC.xml"
    pictures = files / "picture-content"

    def label(right: Path, case: Path, table: str):  # type: ignore[no-untyped-def]
        return lambda out: compare_imports(right, case, out, table, labels / "cam64.toml")

    return {
        "oem-covariance-frame": lambda out: compare_priors(files / "oem-covariance-frame", out),
        "oem-segments": lambda out: fit_with_segments(files / "oem-segments", out),
        "overexposed/plain": lambda out: _solve(files / "overexposed/plain", out),
        "overexposed/over12": lambda out: _solve(
            files / "overexposed/over12", out, "saturat", "full scale", "overexposed"
        ),
        "label-units/pds3-m": label(right3, labels / "pds3-m/PIC.LBL", "pds3"),
        "label-units/pds4-rad": label(right4, labels / "pds4-rad/PIC.xml", "pds4"),
        "dem-mask/alpha": lambda out: compare_slopes(files / "dem-mask", out, "alpha.tif"),
        "map-sphere": lambda _: compare_heights(
            files / "map-sphere", "above_1738000.tif", "above_1737400.tif"
        ),
        "west-longitudes": lambda _: compare_heights(
            files / "west-longitudes", "west.cub", "east.cub"
        ),
        "untagged-nodata": lambda out: compare_slopes(
            files / "untagged-nodata", out, "minus_9999_untagged.tif", "-9999"
        ),
        "isis-special-pixels/i16_null": lambda out: _solve(
            files / "isis-special-pixels/i16_null", out
        ),
        "spk-gap": lambda out: import_gap(files / "spk-gap", out),
        "pds3-text/doy": label(right3, text / "doy/PIC.LBL", "pds3"),
        "pds3-text/empty_time": label(right3, text / "empty_time/PIC.LBL", "pds3"),
        "pds3-text/star_slash": label(right3, text / "star_slash/PIC.LBL", "pds3"),
        "picture-content/text": lambda out: _solve(pictures / "text", out, "text", "corner"),
        "picture-content/exif3": lambda out: _solve(pictures / "exif3", out, "exif", "orientation"),
    }
