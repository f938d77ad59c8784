"""The navigation figures: simulated flights over richer ground, navigated, against the truth.

Every row flies a shipped scenario (other ground seeds, places, Suns and headings a pass), builds
the catalog of the bundled terrain at the row's cell size, navigates every picture from a prior 3 km
off, and adds the errors up. The rows with a star sensor reuse the pictures with attitudes that are
off by 10 arc seconds an axis.

Real rows fly over ground that differs from the terrain model as the Moon does, at all scales and in
albedo; own rows over the terrain model with relief below its posting, as in all other studies.
"""

import math
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path

import msgspec

from catalog.config import resource
from catalog.errors import NothingToDoError
from catalog.pipeline.ingest import Bbox
from catalog.places import make_folder
from catalog.progress import Progress
from catalog.terrain.dem.source import DemSettings
from catalog.terrain.error_model import StatedError
from optnav_cli.evaluation.evaluation import Evaluation, combine_evaluations
from optnav_cli.evaluation.figures import (
    Figures,
    FrameError,
    compute_figures,
    make_unsolved_figures,
)
from optnav_cli.evaluation.files import evaluate_run
from optnav_cli.navigate.job import navigate_folder
from optnav_cli.navigate.worker import RunInputs
from optnav_cli.output.run_folder import SOLUTION
from tests.studies import drawn_mare, flights
from tests.studies.tables import Cell, StudyReport, StudyTable, columns


@dataclass(frozen=True)
class FlightCase(flights.Case):
    """One line of the table: scenarios pooled, the catalog's cell, and the figures to reach.

    catalog    of configs/catalogs
    bbox       west, south, east, north of its cells, deg; None: all that the terrain model shows
    drawn      over the model of drawn_mare.py
    posting_m  of its finest patches; None: of its terrain model
    """

    scenarios: tuple[str, ...]
    cell_deg: float
    horizontal_m: float
    height_m: float
    catalog: str = "tycho"
    bbox: Bbox | None = None
    drawn: bool = False
    posting_m: float | None = None

    @property
    def ground(self) -> str:
        """Over which ground it flies; each has a table."""
        return flights.ground_of(self.scenarios[0])


# Half of a model's posting, where pixels of 96 m resolve it: shading from node to node of the model
# itself lacks most of what its waves of two to four nodes show.
HALF_948_M, HALF_474_M = 473.8, 236.9
MARE = FlightCase(
    "real, 1° cells of 948 m, mare: unk 400 km",
    ("real_mare_400km",),
    1.0,
    30.0,
    75.0,
    "mare",
    (17.0, 3.0, 35.0, 21.0),
    posting_m=HALF_948_M,
)
DRAWN_FRAMES = 40
# The seed of its pictures after that of the scenario. On ten pictures of the first one after it the
# patches' posting was chosen; the second showed that albedo is to be fitted at these, too.
DRAWN_SEED = 3
REAL_SHNK = ("real_shnk_100km", "real_shnk_200km", "real_shnk_400km")
ROWS = (
    FlightCase("real, 1° cells: unk 200 km", ("real_unk_200km",), 1.0, 30.0, 70.0),
    FlightCase("real, 0.25° cells: unk 200 km", ("real_unk_200km",), 0.25, 15.0, 60.0),
    FlightCase("real, 1° cells: unk 400 km", ("real_unk_400km",), 1.0, 20.0, 40.0),
    FlightCase("real, 0.25° cells: unk 400 km", ("real_unk_400km",), 0.25, 15.0, 20.0),
    FlightCase("real, 1° cells: shnk 100-400 km", REAL_SHNK, 1.0, 12.0, 12.0),
    FlightCase(
        "real, 1° cells of 474 m: unk 400 km",
        ("real_farside_400km", "real_farside_400km_other"),
        1.0,
        30.0,
        75.0,
        "farside",
        posting_m=HALF_474_M,
    ),
    FlightCase(
        "real, 1° cells of 948 m: shnk 50 km",
        ("real_shnk_050km",),
        1.0,
        30.0,
        30.0,
        "mare",
        (132.0, -28.0, 152.0, -8.0),
    ),
    MARE,
    replace(
        MARE,
        name="real, 1° cells of 474 m, mare drawn below 948 m: unk 400 km",
        drawn=True,
        posting_m=HALF_474_M,
    ),
    FlightCase("unk 200 km, 1° cells", ("unk_200km",), 1.0, 30.0, 150.0),
    FlightCase("unk 200 km, 0.5° cells", ("unk_200km",), 0.5, 20.0, 80.0),
    FlightCase("unk 400 km, 1° cells", ("unk_400km",), 1.0, 20.0, 50.0),
    FlightCase(
        "shnk 100-400 km, 1° cells", ("shnk_100km", "shnk_200km", "shnk_400km"), 1.0, 25.0, 25.0
    ),
)


@dataclass(frozen=True)
class FlightResult:
    """A row's figures; `limit_m` is what the horizontal error may be."""

    row: FlightCase
    star_sensor: bool
    evaluation: Evaluation
    limit_m: float

    @property
    def case(self) -> str:
        """Name of the row, and whether a star sensor's attitudes were stated."""
        return self.row.name + (", 10″" if self.star_sensor else "")


def run(
    output: Path,
    progress: Progress,
    frames: int | None = None,
    rows: str = "",
    kept: bool = False,
) -> list[FlightResult]:
    """Fly, navigate and evaluate every row; pictures that are there already are used again.

    output  folder for catalogs, pictures, runs and figures.json
    frames  pictures of a scenario, its own number when None
    rows    only rows whose name contains this
    kept    runs that the folder holds are evaluated as they are, not made again
    Raises ConfigError where a row needs shared data that are not named.
    """
    chosen = flights.rows_named(ROWS, rows)
    flights.check_shared_files(name for row in chosen for name in row.scenarios)
    make_folder(output)
    results: list[FlightResult] = []
    for row in chosen:
        model = drawn_mare.write_drawn_mare(output) if row.drawn else None
        for star_sensor in (False, True):
            parts = []
            for name in row.scenarios:
                pictures = _pictures(output, name, model, frames, progress)
                if star_sensor:
                    pictures = flights.with_star_sensor(pictures)
                place = output / "runs" / f"{pictures.name}-{row.cell_deg:g}deg"
                place.parent.mkdir(exist_ok=True)
                if not (kept and (place / SOLUTION).is_file()):
                    wanted = row.catalog, row.cell_deg, flights.points_error_of(name)
                    where = row.bbox, model, row.posting_m
                    catalog = case_catalog(output, *wanted, progress, *where)
                    # a row without any solution is a figure, too
                    with suppress(NothingToDoError):
                        navigate_folder(RunInputs(pictures, [catalog]), place, progress)
                parts.append(evaluate_run(place, pictures / "truth.csv"))
            evaluation = combine_evaluations(parts)
            limit = row.horizontal_m
            if star_sensor:
                limit = flights.limit_with_star_sensor(limit, evaluation.frames)
            results.append(FlightResult(row, star_sensor, evaluation, limit))
            single = flights.frames_table({r.case: r.evaluation.frames for r in results})
            StudyReport((*report(results).tables, single)).write(output / flights.FIGURES)
    return results


def _pictures(
    output: Path, name: str, model: Path | None, frames: int | None, progress: Progress
) -> Path:
    """The pictures of a shipped scenario; over another model DRAWN_FRAMES, of other places."""
    if model is None:
        return flights.shipped_pictures(output, name, frames, progress)
    scenario = flights.shipped_scenario(name)
    dem = (DemSettings(path=str(model)),)
    other = msgspec.structs.replace(scenario, seed=scenario.seed + DRAWN_SEED, dem=dem)
    other = other.shortened(DRAWN_FRAMES if frames is None else frames)
    return flights.made_pictures(other, output / "pictures" / f"{name}_drawn", progress)


def case_catalog(
    output: Path,
    name: str,
    cell_deg: float,
    stated: StatedError,
    progress: Progress,
    bbox: Bbox | None = None,
    model: Path | None = None,
    posting_m: float | None = None,
) -> Path:
    """The catalog of a shipped configuration at a cell size, in the study's folder.

    stated     the error of its terrain model, by numbers or not at all
    bbox       west, south, east, north of its cells, deg
    model      instead of the configuration's, if that is the shared one of the whole Moon
    posting_m  of its finest patches; None: of its terrain model
    """
    text = resource(f"configs/catalogs/{name}.toml").read_text(encoding="utf-8")
    if model is not None:
        name, text = model.stem, text.replace(flights.GLOBE, model.name)
    if stated.error_m is not None:
        name += f"-{stated.error_m:g}m"
        numbers = {"error_m": stated.error_m, "resolution_km": stated.resolution_km}
        lines = (f"{key} = {value}\n" for key, value in numbers.items() if value is not None)
        text = text.replace("[[dem]]\n", "[[dem]]\n" + "".join(lines))
    text += f"\n[grid]\ncell_deg = {cell_deg}\n"
    if posting_m is not None:
        name += f"-patches_{posting_m:g}m"
        text += f"\n[pyramid]\nposting_m = {posting_m}\n"
    return flights.built_catalog(output / f"{name}-{cell_deg:g}deg.toml", text, progress, bbox)


COLUMNS = columns(
    "case; solved; frames; horizontal, rms [m] .1f; horizontal_limit_m = asked ≤ [m] .0f; "
    "height, rms [m] .1f; height_limit_m = asked ≤ [m] .0f; NEES .2f; "
    "inside_3_sigma = in 3σ [%] .0f; worst [σ] .1f; used [%] .2f; wrong; checked"
)
WORST_SIGMAS, SOLVED_SHARE = 4.5, 0.97  # asked of all rows; every scenario's Sun is 10-45 deg high


def report(results: Sequence[FlightResult]) -> StudyReport:
    """A table for each kind of ground, one line a row, and the counts over all rows."""
    rows: dict[str, list[tuple[Cell, ...]]] = {ground: [] for ground in flights.GROUNDS}
    figures = [_figures(result.evaluation.frames) for result in results]
    for result, f in zip(results, figures, strict=True):
        errors = (f.horizontal_rms_m, result.limit_m, f.height_rms_m, result.row.height_m, f.nees)
        used = 100.0 * f.n_used / max(f.n_predicted, 1)
        inside = 100.0 * min(f.inside_3_sigma)
        honesty = (inside, _worst(result) if f.solved else math.nan)
        counts = (used, f.n_wrong, f.n_checked or 0)
        rows[result.row.ground].append(
            (result.case, f.solved, f.frames, *errors, *honesty, *counts)
        )
    counted = [(f.n_wrong, f.n_checked or 0, f.n_used, f.n_predicted) for f in figures]
    wrong, checked, used, predicted = map(sum, zip(*counted))
    solved, frames = (sum(getattr(f, name) for f in figures) for name in ("solved", "frames"))
    worst = max(results, key=_worst)
    notes = (
        f"solved {solved} of {frames} frames ({100.0 * solved / frames:.1f} %) under a Sun of "
        f"10-45°; asked ≥ {100.0 * SOLVED_SHARE:g} %",
        f"worst frame {_worst(worst):.1f} σ ({worst.case}); asked: none over {WORST_SIGMAS:g}",
        f"recognised {used} of {predicted} ({100.0 * used / max(predicted, 1):.2f} %)",
        f"wrong matches kept {wrong} of {checked} ({100.0 * wrong / max(checked, 1):.3f} %)",
        "relative to the terrain model's own frame; GLD100 itself is about 50 m from LOLA",
    )
    tables = (StudyTable(g, COLUMNS, tuple(own)) for g, own in rows.items() if own)
    return StudyReport(tuple(tables), notes)


def _worst(result: FlightResult) -> float:
    """The largest error of a solved frame in its own sigmas, 0 without one."""
    return max(map(flights.sigmas_off, result.evaluation.frames), default=0.0)


def _figures(frames: Sequence[FrameError]) -> Figures:
    solved = any(frame.error_rnb_m is not None for frame in frames)
    return compute_figures(frames) if solved else make_unsolved_figures(frames)
