"""Real pictures with real labels: how many are solved, and how far the labels are off.

A set's pictures are imported with their labels and navigated. Labels of a set err alike, so its
frames are adjusted together (`runs.adjust_runs`), navigated again with what that finds, and
compared with the labels so corrected: the nearest to a truth that there is. The labels' own errors
of each frame are part of what is found.
"""

import shutil
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from catalog.config import resource
from catalog.errors import DataError, NoSolutionError, NothingToDoError
from catalog.geometry.rotations import ARCSEC
from catalog.geometry.vectors import squared_distance
from catalog.pipeline import build
from catalog.places import make_folder
from catalog.progress import Progress
from optnav_cli.archives.job import ImportOptions, import_folder
from optnav_cli.calibration.adjust_job import LabelScatter, adjust_runs
from optnav_cli.calibration.adjusted_folder import AdjustedRuns
from optnav_cli.estimation.models.common import Common
from optnav_cli.frames.folder import read_folder, write_folder
from optnav_cli.frames.frames import Frame
from optnav_cli.navigate.job import navigate_folder
from optnav_cli.navigate.worker import RunInputs
from optnav_cli.output.run_folder import CAMERAS, RunFolder, read_run
from tests.studies import apollo, flights
from tests.studies.tables import Cell, StudyReport, StudyTable, columns

MIN_SET = 5  # frames from which what is common to them can be told
BEYOND_SIGMAS = 5.0
PICTURES, CORRECTED = "pictures", "pictures-corrected"
# Of labels that were corrected: what is asked of a navigator at 67P.
CORRECTED_M, CORRECTED_RAD = 300.0, 200.0 * ARCSEC
# What the labels of 67P scatter by once that is taken out, from frame to frame: 0.7 px, 23 arcsec.
SCATTER = LabelScatter(20.0, 20.0)
KINDS = (Common.BODY_ROTATION, Common.ORIGIN, Common.SCALE, Common.BORESIGHT)


@dataclass(frozen=True)
class RealSet(flights.Case):
    """A set of real pictures.

    labels  of the set's folder, as a pattern; "" for the bundled one
    shape   the body's shape model there, as a pattern, with its build settings
    """

    labels: str = ""
    shape: str = ""
    build: str = ""


SETS = (
    RealSet("Apollo 15 metric, Moon"),
    RealSet(
        "Rosetta NavCam, 67P",
        "rosetta/pictures/*.lbl",
        "rosetta/67p*.obj",
        '[body]\nname = "67p"\n\n[[mesh]]\npath = "{shape}"\nunits = "km"\n\n[grid]\n'
        "cell_deg = 10.0\n\n[render]\nsun_declination_deg = 52.0\n\n[check]\n"
        "relief_slope_deg = 24.0\nmax_error_nodes = 4.0\n",
    ),
    RealSet("NEAR MSI, Eros", "near/*.fit", "near/*eros*.*"),
)


@dataclass(frozen=True, eq=False)
class SetResult:
    """What came of a set.

    first, last  the run with the labels as they are, and the one with the corrected ones
    common       what is common to the labels, where there are frames enough
    adjusted     the folder of the adjustment that found it
    nees         (n,) of the solved frames against the corrected labels, a degree of freedom;
                 nothing where labels are not corrected
    skipped      why there is nothing
    """

    name: str
    first: RunFolder | None = None
    last: RunFolder | None = None
    common: AdjustedRuns | None = None
    adjusted: Path | None = None
    nees: Sequence[float] = ()
    skipped: str = ""


def run(
    folder: Path, output: Path, progress: Progress, frames: int | None = None, rows: str = ""
) -> list[SetResult]:
    """Import, navigate and adjust each set; all files go into `output`.

    folder  where sets lie in folders of their own, as rosetta/pictures and near
    frames  pictures of a set, evenly taken; all when None
    """
    _begin(folder, output)
    return [
        _of_set(one, folder, output, progress, frames) for one in flights.rows_named(SETS, rows)
    ]


def corrected_set(
    name: str, folder: Path, output: Path, progress: Progress, frames: int | None
) -> tuple[Path, list[Path]]:
    """Pictures of the set whose name contains a text, with corrected labels, and its catalogs.

    The labels are corrected by what both rounds find together: what the first one finds from
    labels that are far off leaves some 40 arc seconds. Arguments otherwise as `run`.
    Raises DataError where labels cannot be corrected.
    """
    _begin(folder, output)
    (one,) = flights.rows_named(SETS, name)
    result, place = _of_set(one, folder, output, progress, frames), _place(one, output)
    if result.adjusted is None:
        few = f"fewer than {MIN_SET} frames are solved as labelled"
        raise DataError(
            f"{folder}: {one.name}: {result.skipped or few}; the labels stay as they are"
        )
    pictures = _corrected(place / PICTURES, result.adjusted, place / f"{CORRECTED}-twice")
    return pictures, [place / "catalog.gpkg"]


def labels_of(name: str, folder: Path) -> list[Path]:
    """The labels of the set whose name contains a text, in order."""
    (one,) = flights.rows_named(SETS, name)
    return sorted(folder.glob(one.labels))


def _begin(folder: Path, output: Path) -> None:
    if not folder.is_dir():
        raise DataError(f"{folder}: there is no such folder; name the one that holds the sets")
    make_folder(output)


def _place(one: RealSet, output: Path) -> Path:
    return output / one.name.lower().replace(", ", "-").replace(" ", "-")


def _of_set(
    one: RealSet, folder: Path, output: Path, progress: Progress, most: int | None
) -> SetResult:
    place = _place(one, output)
    files = sorted(folder.glob(one.labels)) if one.labels else [resource(apollo.CUBE)]
    if not files:
        return SetResult(one.name, skipped=f"{folder / one.labels}: no such file")
    if most is not None and most < len(files):
        files = [files[k] for k in np.unique(np.linspace(0, len(files) - 1, most).astype(int))]
    make_folder(place)
    own = () if one.labels else (resource(apollo.PICTURE),)
    pictures = place / PICTURES
    import_folder(files, pictures, ImportOptions(pictures=own))
    catalogs = _catalogs(one, folder, place, progress)
    first = _navigated(pictures, catalogs, place / "run", progress)
    adjusted = place / "adjusted"
    common = _adjusted(first, adjusted)
    if common is None or common.frames < MIN_SET:
        return SetResult(one.name, first, first)
    corrected = _corrected(pictures, adjusted, place / CORRECTED)
    last = _navigated(corrected, catalogs, place / "run-corrected", progress)
    again = _adjusted(last, place / "adjusted-corrected")
    if again is not None:
        common, adjusted = again, place / "adjusted-corrected"
    found = _nees(last, read_folder(corrected).frames)
    return SetResult(one.name, first, last, common, adjusted, found)


def _catalogs(one: RealSet, folder: Path, place: Path, progress: Progress) -> list[Path]:
    """The catalog of a set's body; none where there is no shape model of it."""
    if not one.labels:
        config = resource("configs/catalogs/farside.toml")
        build.run(config, output=place / "farside.gpkg", progress=progress)
        return [place / "farside.gpkg"]
    shapes = sorted(folder.glob(one.shape))
    if not (shapes and one.build):
        return []
    text = one.build.format(shape=shapes[0].resolve().as_posix())
    return [flights.built_catalog(place / "catalog.toml", text, progress)]


def _navigated(
    pictures: Path, catalogs: Sequence[Path], place: Path, progress: Progress
) -> RunFolder:
    with suppress(NothingToDoError):  # without a solution the run says why
        navigate_folder(RunInputs(pictures, catalogs), place, progress)
    return read_run(place)


def _adjusted(run_folder: RunFolder, place: Path) -> AdjustedRuns | None:
    with suppress(NothingToDoError, NoSolutionError):
        return adjust_runs([run_folder.path], place, KINDS, SCATTER)
    return None


def _corrected(pictures: Path, adjusted: Path, place: Path) -> Path:
    """The same pictures with labels corrected by what is common to them, and sigmas of those."""
    shutil.rmtree(place, ignore_errors=True)
    shutil.copytree(pictures, place)
    for path in (*adjusted.glob("*.toml"), *(adjusted / CAMERAS).glob("*.toml")):
        shutil.copyfile(path, place / path.relative_to(adjusted))
    read = read_folder(place)
    cameras = [replace(c, boresight_sigma_arcsec=0.0) for c in read.cameras.values()]
    frames = [
        replace(
            frame,
            position_sigma_m=CORRECTED_M,
            attitude_sigma_rad=CORRECTED_RAD,
            common_sigma_rad=0.0,
        )
        for frame in read.frames
    ]
    write_folder(place, read.settings, cameras, frames)
    return place


def _nees(run_folder: RunFolder, labels: Sequence[Frame]) -> list[float]:
    """Squared errors of the solved frames over their covariance, a degree of freedom."""
    stated = {frame.file: frame.position_m for frame in labels}
    found = []
    for solution in run_folder.solutions:
        fix, label = solution.fix, stated.get(solution.file)
        if fix is not None and label is not None:
            found.append(squared_distance(fix.position_m - label, fix.covariance_m2) / 3.0)
    return found


COLUMNS = columns(
    "set; frames; solved_as_labelled = solved, labels as they are; solved; "
    "residual, rms [px] .2f; NEES = NEES against labels .2f; "
    "beyond = beyond 5 σ; across, left of labels [m] .1f; shift, left [px] .2f; "
    "roll, left [°] .3f; range, left [%] .3f"
)
COMMON = columns("set; common to the labels; axis; value .5g; sigma .2g; unit")


def report(results: Sequence[SetResult]) -> StudyReport:
    """The table of sets, what is common to their labels, and what was left out or unsolved."""
    tables = [StudyTable("Real pictures", COLUMNS, tuple(_cells(result) for result in results))]
    rows: list[tuple[Cell, ...]] = []
    notes = []
    for result in results:
        if result.skipped:
            notes.append(f"{result.name}: skipped, {result.skipped}")
            continue
        if result.common is not None:
            keys = ("name", "axis", "value", "sigma", "unit")
            rows += [(result.name, *(row[k] for k in keys)) for row in _common(result)]
            notes += [f"{result.name}: {note}" for note in result.common.notes]
        if result.last is not None:
            reasons = [s.reason.partition(";")[0] for s in result.last.solutions if not s.solved]
            notes += flights.not_solved(result.name, reasons)
    if rows:
        tables.append(StudyTable("What the labels of a set share", COMMON, tuple(rows)))
    return StudyReport(tuple(tables), tuple(notes))


def _common(result: SetResult) -> list[dict[str, Cell]]:
    """The common numbers in all, of both rounds: as the body's and the camera's files hold them."""
    if result.adjusted is None or result.common is None:
        return []
    sigmas = {(row["name"], row["axis"]): row["sigma"] for row in result.common.rows()}
    found = read_run(result.adjusted)
    frame = found.attitude.body.catalog_frame
    camera = next(iter(found.cameras.values()))
    boresight = camera.boresight_arcsec or (0.0, 0.0, 0.0)
    values = (
        *(("body_rotation", axis, v, "deg") for axis, v in zip("xyz", frame.turn_deg, strict=True)),
        *(("origin", axis, v, "m") for axis, v in zip("xyz", frame.offset_m, strict=True)),
        ("scale", "", frame.scale, ""),
        *(("boresight", axis, v, "arcsec") for axis, v in zip("xy", boresight, strict=False)),
    )
    return [
        {"name": name, "axis": axis, "value": v, "sigma": float(str(sigmas[name, axis])), "unit": u}
        for name, axis, v, u in values
    ]


def _cells(result: SetResult) -> tuple[Cell, ...]:
    if result.first is None or result.last is None:
        return (result.name, *[None] * (len(COLUMNS) - 1))
    solved = [sum(s.solved for s in found.solutions) for found in (result.first, result.last)]
    squares = [m.residual_px for m in result.last.matches if m.used and m.residual_px is not None]
    residual = float(np.sqrt(np.mean(np.square(squares)))) if squares else None
    nees = np.array(result.nees)
    left = {} if result.common is None else result.common.misfit
    names = ("shift_m", "shift_px", "roll_deg", "range_percent")
    return (
        result.name,
        len(result.last.solutions),
        *solved,
        residual,
        float(nees.mean()) if nees.size else None,
        int((3.0 * nees > BEYOND_SIGMAS**2).sum()) if nees.size else None,
        *(left.get(name) for name in names),
    )
