"""How often a wrong picture is accepted and a right one refused, by the gates of control points.

Pictures with a known pose, simulated over both grounds and real, become right situations (parts of
a picture, priors as far off as they state) and wrong ones (`acceptance_situations.WRONG`). All
are navigated. The margins of their poses give the curve: what would be accepted with other limits.

Gates are set with `--fit`, whose grounds, paths and draws are others than those that are scored.
Cameras are the shipped ones with pixels four times as wide, so that a situation takes a fraction of
a second.
"""

import os
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple
from zlib import crc32

import msgspec
import numpy as np

from catalog.arrays import Float32Array
from catalog.bodies.body import load_body
from catalog.config import resource
from catalog.files import make_prefix_test, write_output
from catalog.pipeline import build
from catalog.places import make_folder
from catalog.progress import Progress
from catalog.terrain.dem.file import SHARED_FOLDER
from optnav_cli.archives.job import ImportOptions, import_folder
from optnav_cli.camera.camera import Camera
from optnav_cli.camera.camera_file import camera_toml, preset_camera
from optnav_cli.control_points.field import ControlPointField
from optnav_cli.frames.folder import Folder, make_observation, read_folder
from optnav_cli.frames.picture import load_picture
from optnav_cli.frames.truth import read_truth
from optnav_cli.navigate.inputs import open_catalogs, open_field
from optnav_cli.reasons import ReasonCode
from optnav_cli.report.sheet import LegendEntry, Panel, draw_sheet, write_sheet
from optnav_cli.report.svg import Plot, PlotAxis
from optnav_cli.simulation.scenario import load_scenario
from optnav_cli.simulation.sections import MainCamera
from tests.studies import flights
from tests.studies.acceptance_situations import (
    RIGHT,
    WRONG,
    WRONG_SUN,
    PosedPicture,
    SituationOutcome,
    Surround,
    outcome,
    situations,
)
from tests.studies.apollo import CUBE, PICTURE
from tests.studies.tables import Cell, StudyReport, StudyTable, columns

FRAMES = 10  # pictures of a case
RIGHT_EACH, WRONG_EACH = 10, 6  # situations of a picture; wrong ones of each kind
MAX_WRONG, MAX_REFUSED = 0.001, 0.03  # asked of the shares
BINNED = 4  # pixels of the shipped cameras to a side of the study's
GROUNDS = 2  # of a scenario
FIT_SEEDS = 1000  # what is added to the seeds of grounds and paths to set gates
COMET = "rosetta/pictures"  # the folder of real pictures of 67P in the shared data
COMET_CATALOG = """# Comet 67P from a mesh, for pictures of August 2014.
[body]
name = "67p"

[[mesh]]
path = "shared:rosetta/67p-16k.obj"
units = "km"

[grid]
cell_deg = 10.0
"""


@dataclass(frozen=True)
class AcceptanceCase(flights.Case):
    """Pictures and the catalog that they are navigated by.

    catalog        of configs/catalogs;  cell_deg  None: as it stands there
    scenario       of configs/scenarios; empty for real pictures
    prior_sigma_m  lowest and highest sigma of priors;  apart_deg  of another ground
    """

    catalog: str
    scenario: str = ""
    cell_deg: float | None = None
    prior_sigma_m: tuple[float, float] = (300.0, 3000.0)
    apart_deg: float = 1.5


APOLLO = AcceptanceCase("Apollo 15 frame", "farside")
ROSETTA = AcceptanceCase("67P, real frames", "67p", apart_deg=30.0)
PHOBOS = AcceptanceCase("Phobos, 60 km", "phobos", "phobos_points_060km", None, (50.0, 200.0), 30.0)
SMALL = ("phobos", "67p")  # catalogs
ROWS = (
    AcceptanceCase("own, 200 km, 1° cells", "tycho", "unk_200km", 1.0),
    AcceptanceCase("real, 200 km, 1° cells", "tycho", "real_unk_200km", 1.0),
    AcceptanceCase("real, 400 km, 1° cells", "tycho", "real_unk_400km", 1.0),
    AcceptanceCase("real, 200 km, 0.5° cells", "tycho", "real_unk_200km", 0.5),
    AcceptanceCase("real, fisheye, 200 km", "tycho", "real_shnk_200km", 1.0),
    PHOBOS,
    APOLLO,
    ROSETTA,
)


class Acceptance(NamedTuple):
    """All outcomes; fit: of the seeds that gates are set with."""

    outcomes: list[SituationOutcome]
    fit: bool


def run(
    output: Path,
    progress: Progress,
    frames: int | None = None,
    rows: str = "",
    seed: int = 1,
    fit: bool = False,
) -> Acceptance:
    """Make pictures and catalogs, navigate all situations, and draw the curves into the folder.

    output  folder for catalogs, pictures, figures.json and acceptance.svg; used again
    frames  pictures of a case;  rows  only cases whose name contains this
    seed    of what is drawn for a situation;  fit  other grounds, paths and draws, to set gates
    """
    chosen = [row for row in flights.rows_named(ROWS, rows) if row != ROSETTA or comet_labels()]
    make_folder(output)
    found = Acceptance([], fit)
    count = FRAMES if frames is None else frames
    for row in chosen:
        folder = _pictures(output, row, count, fit, progress)
        catalog = _catalog(output, row, progress)
        with _opened(catalog) as points, progress.stage(row.name, count, "picture") as bar:
            views = _views(row, folder)
            around = Surround(points.xyz_m, _strangers(output, row, count, progress))
            for number in range(count):
                view = views[number % len(views)]
                rng = np.random.default_rng([seed, int(fit), crc32(row.name.encode()), number])
                for one in situations(view, around, rng, RIGHT_EACH, WRONG_EACH):
                    found.outcomes.append(outcome(row.name, one, view, points))
                bar.advance()
        write_sheet(picture(found), output / "acceptance.svg")
        report(found).write(output / flights.FIGURES)
    return found


def comet_labels() -> list[Path]:
    """The labels of the real pictures of 67P; empty where they are not there."""
    shared = os.environ.get(SHARED_FOLDER)
    return sorted((Path(shared) / COMET).glob("*.lbl")) if shared else []


def _pictures(
    output: Path, row: AcceptanceCase, count: int, fit: bool, progress: Progress
) -> Folder:
    """The folder of a case's pictures, made unless it is there."""
    if row == APOLLO:
        place = output / "pictures" / "apollo"
        make_folder(place.parent)
        import_folder([resource(CUBE)], place, ImportOptions(pictures=(resource(PICTURE),)))
        return read_folder(place)
    if row == ROSETTA:
        place = output / "pictures" / ("rosetta" + "-fit" * fit)
        make_folder(place.parent)
        import_folder(comet_labels()[int(fit) :: 2], place, ImportOptions())
        return read_folder(place)
    scenario = load_scenario(resource(f"configs/scenarios/{row.scenario}.toml"))
    camera = binned(preset_camera(scenario.camera.name))
    file = (output / "cameras" / f"{camera.name}.toml").resolve()
    make_folder(file.parent)
    write_output(file, camera_toml(camera).encode(), make_prefix_test(b"name = "))
    scenario = msgspec.structs.replace(scenario, camera=MainCamera(str(file)))
    # the finest relief goes with the pixels, and two grounds of a case are enough
    detail, offset = scenario.detail, FIT_SEEDS * fit
    seeds = tuple(seed + offset for seed in detail.seeds[:GROUNDS])
    coarser = 1.0 if scenario.shape else BINNED / 2.0  # a shape's is as coarse as it can be
    detail = msgspec.structs.replace(detail, seeds=seeds, smallest_m=coarser * detail.smallest_m)
    scenario = msgspec.structs.replace(scenario, seed=scenario.seed + offset, detail=detail)
    name = row.scenario + "-fit" * fit
    scenario = scenario.shortened(count)
    return read_folder(flights.made_pictures(scenario, output / "pictures" / name, progress))


def binned(camera: Camera) -> Camera:
    """A camera with fewer and wider pixels; its blur stays as many of them."""
    x, y = camera.principal_point_px
    circle = camera.image_circle_radius_px
    return replace(
        camera.with_focal_factor(1.0 / BINNED),
        name=f"{camera.name}_binned",
        width_px=camera.width_px // BINNED,
        height_px=camera.height_px // BINNED,
        principal_point_px=((x + 0.5) / BINNED - 0.5, (y + 0.5) / BINNED - 0.5),
        image_circle_radius_px=None if circle is None else circle / BINNED,
        pixel_pitch_um=None,
    )


def _catalog(output: Path, row: AcceptanceCase, progress: Progress) -> Path:
    if row == ROSETTA:
        return flights.built_catalog(output / "67p.toml", COMET_CATALOG, progress)
    config = resource(f"configs/catalogs/{row.catalog}.toml")
    if row.cell_deg is None:
        catalog = output / f"{row.catalog}.gpkg"
        build.run(config, output=catalog, progress=progress)
        return catalog
    text = f"{config.read_text(encoding='utf-8')}\n[grid]\ncell_deg = {row.cell_deg}\n"
    place = output / f"{row.catalog}-{row.cell_deg:g}deg.toml"
    return flights.built_catalog(place, text, progress)


@contextmanager
def _opened(catalog: Path) -> Iterator[ControlPointField]:
    with open_catalogs([catalog]) as found:
        points = open_field(found, load_body(found[0].meta.body))
        if points is None:
            raise ValueError(f"{catalog} gives no points")
        yield points


def _views(row: AcceptanceCase, folder: Folder) -> list[PosedPicture]:
    """The pictures of a folder with the true poses; of labels with the stated ones."""
    apart = float(np.radians(row.apart_deg))
    place = folder.path / "truth.csv"
    truths = {}
    if place.is_file():
        truths = {t.file: t for t in read_truth(place, folder.attitude)}
    views = []
    for frame in folder.frames:
        camera = folder.cameras[frame.camera]
        seen = make_observation(frame, camera, load_picture(folder.picture_path(frame), camera))
        truth = truths.get(frame.file)
        if truth is not None:
            views.append(
                PosedPicture(
                    seen, truth.position_m, truth.camera_from_body, row.prior_sigma_m, apart
                )
            )
        elif seen.prior is not None:
            sigma = float(np.sqrt(seen.prior.covariance_m2[0, 0]))
            views.append(PosedPicture(seen, seen.prior.position_m, None, (sigma, sigma), apart))
    return views


def _strangers(
    output: Path, row: AcceptanceCase, count: int, progress: Progress
) -> list[Float32Array]:
    """Pictures of a body that is not the case's, the real comet's where they are there."""
    if row.catalog in SMALL:
        other = ROWS[0]
    else:
        other = ROSETTA if comet_labels() else PHOBOS
    folder = _pictures(output, other, count, False, progress)
    return [view.observation.picture.values for view in _views(other, folder)[:count]]


MAX_SIGMAS = 5.0
SHARES = (-2.0, 2.0)  # ends of the axis of per cents, common logarithms
JUDGED = ("", ReasonCode.BY_CHANCE, ReasonCode.POINTS_DISAGREE)  # the others no limit brings back
RIGHT_COLUMNS = columns(
    "case; poor = too few points in view; situations; refused; share [%] .1f; chance = by chance; "
    "scatter = by their scatter; other reasons; within = within 5σ [%] .1f; NEES .2f"
)
WRONG_COLUMNS = columns("case; situations; solved; share [%] .2f; " + "; ".join(WRONG))


CURVES = (  # what a limit is moved by, the ends of the axis, how a margin is read
    ("powers of ten against chance, more than asked for today", (-8.0, 24.0)),
    ("widest accepted scatter, over today's", (0.0, 3.0)),
)


def report(result: Acceptance) -> StudyReport:
    """What was refused of right situations, what was solved of wrong ones, and a better limit."""
    outcomes = result.outcomes
    names = dict.fromkeys(one.case for one in outcomes)
    rows = [(name, [one for one in outcomes if one.case == name]) for name in names]
    rows.append(("all", outcomes))
    title = "Wrong situations: solved, and of how many of each kind"
    tables = (
        StudyTable("Right situations", RIGHT_COLUMNS, tuple(_right(*row) for row in rows)),
        StudyTable(title, WRONG_COLUMNS, tuple(_wrong(*row) for row in rows)),
    )
    good, bad = split(outcomes)
    close = [one for one in bad if one.sigmas is not None and one.sigmas <= MAX_SIGMAS]
    notes = (
        f"solved under a wrong Sun and yet within {MAX_SIGMAS:g}σ of the truth: {len(close)}",
        f"asked: at most {100.0 * MAX_WRONG:g} % of the wrong ones solved, "
        f"at most {100.0 * MAX_REFUSED:g} % of the right ones refused",
        _limit_note("all kinds", good, bad),
        _limit_note("all but a wrong Sun", good, [one for one in bad if one.kind != WRONG_SUN]),
        "" if result.fit else "a limit is set with --fit, on other seeds than these",
    )
    return StudyReport(tables, tuple(filter(None, notes)))


def _limit_note(
    kinds: str, good: Sequence[SituationOutcome], bad: Sequence[SituationOutcome]
) -> str:
    least = chance_limit(bad)
    if not np.isfinite(least):
        return f"of {kinds} hardly any reach the test against chance, and no limit is needed"
    kept = percent([is_accepted(one, least) for one in good])
    return (
        f"of {kinds} {100.0 * MAX_WRONG:g} % are met by asking for {least:+.1f} powers of ten "
        f"against chance more than today, which refuses {100.0 - kept:.1f} % of the right ones"
    )


def split(
    outcomes: Sequence[SituationOutcome],
) -> tuple[list[SituationOutcome], list[SituationOutcome]]:
    """Right ones with enough points in view to be solved, and wrong ones."""
    good = [one for one in outcomes if one.kind == RIGHT and not one.is_poor]
    return good, [one for one in outcomes if one.kind != RIGHT]


def percent(flags: Sequence[bool]) -> float:
    """Share of what is true; NaN of nothing."""
    return 100.0 * sum(flags) / len(flags) if flags else float("nan")


def is_accepted(one: SituationOutcome, chance: float = 0.0, scatter: float = 1.0) -> bool:
    """Whether a situation would be solved with limits that differ from today's.

    chance   powers of ten asked for beyond today's;  scatter  widest one over today's
    """
    if one.margins is None or one.code not in JUDGED:
        return False
    return one.margins.chance_decades >= chance and one.margins.scatter <= scatter


def chance_limit(bad: Sequence[SituationOutcome]) -> float:
    """The least powers of ten beyond today's that solve no more than MAX_WRONG of wrong ones."""
    found = [one.margins.chance_decades for one in bad if one.margins and is_accepted(one, -np.inf)]
    allowed = int(MAX_WRONG * len(bad))
    rest = sorted(found, reverse=True)[allowed:]
    return float(np.nextafter(rest[0], np.inf)) if rest else -np.inf


def picture(result: Acceptance) -> str:
    """Wrong ones solved and right ones refused against the limits of both gates (SVG)."""
    good, bad = split(result.outcomes)
    legend = [
        LegendEntry("s4", f"of {len(bad)} wrong situations solved", ""),
        LegendEntry("s1", f"of {len(good)} right situations refused", ""),
        LegendEntry("muted dashed", "asked for", ""),
    ]
    panels = []
    for label, ends in CURVES:
        limits = np.linspace(*ends, 129)
        chance = label == CURVES[0][0]
        moved = [(v, 1.0) if chance else (0.0, v) for v in limits]
        wrong = [percent([is_accepted(one, *limit) for one in bad]) for limit in moved]
        refused = [percent([not is_accepted(one, *limit) for one in good]) for limit in moved]
        plot = Plot(PlotAxis(ends, label), PlotAxis(SHARES, "%", True), width=470, height=280)
        for asked in (MAX_WRONG, MAX_REFUSED):
            plot.level(np.log10(100.0 * asked), "muted dashed")
        for series, values in (("s4", wrong), ("s1", refused)):
            plot.line(limits, np.log10(np.maximum(values, 10.0 ** SHARES[0])), series)
        panels.append(Panel("", plot, f"Wrong ones solved and right ones refused against {label}"))
    return draw_sheet("Acceptance of poses from control points", legend, [panels])


def _right(name: str, outcomes: Sequence[SituationOutcome]) -> tuple[Cell, ...]:
    own, _ = split(outcomes)
    why = Counter(one.code for one in own if not one.solved)
    gates = (why[ReasonCode.BY_CHANCE], why[ReasonCode.POINTS_DISAGREE])
    sigmas = np.array([one.sigmas for one in own if one.sigmas is not None])
    inside, nees = None, None
    if len(sigmas):
        inside, nees = percent(list(sigmas <= MAX_SIGMAS)), float(np.mean(sigmas**2)) / 3.0
    refused = sum(why.values())
    share = percent([not one.solved for one in own])
    poor = sum(one.kind == RIGHT and one.is_poor for one in outcomes)
    return (name, poor, len(own), refused, share, *gates, refused - sum(gates), inside, nees)


def _wrong(name: str, outcomes: Sequence[SituationOutcome]) -> tuple[Cell, ...]:
    _, bad = split(outcomes)
    cells = []
    for kind in WRONG:
        own = [one.solved for one in bad if one.kind == kind]
        cells.append(f"{sum(own)} of {len(own)}")
    solved = [one.solved for one in bad]
    return (name, len(bad), sum(solved), percent(solved), *cells)
