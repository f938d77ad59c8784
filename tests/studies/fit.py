"""Fit the sizes of the errors of matches, and score them on other frames and other ground.

Frames of shipped scenarios are matched from their true poses: what is left of each match is its
error. The sizes in configs/models/control_points.toml are chosen under which these errors are
likeliest: normal, with each point's own, correlated where templates overlap, and those common to a
frame. The positions that follow are scored by NEES, linearised at the truth.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from scipy.linalg import cho_factor, cho_solve

from catalog.arrays import BoolArray, FloatArray
from catalog.config import read_toml_text, resource
from catalog.errors import NothingToDoError, UsageError
from catalog.files import check_file, make_prefix_test, write_output
from catalog.geometry.vectors import squared_distance
from catalog.places import make_folder
from catalog.progress import Progress
from optnav_cli.control_points.error_model import (
    FILE,
    MatchedPoints,
    PointErrorSizes,
    compute_scatter_shares,
    load_error_sizes,
)
from optnav_cli.control_points.expectation import FrameContext, find_expected, select_evenly
from optnav_cli.control_points.picture_pyramid import PicturePyramid
from optnav_cli.control_points.solve import (
    MatchedFrame,
    make_matched_frame,
    match_all,
    plan_search,
)
from optnav_cli.estimation.least_squares import inverse_of, linearised
from optnav_cli.estimation.models.points import Pose, predict
from optnav_cli.estimation.resection import errors_of_scatter, with_dependent_errors
from optnav_cli.estimation.robust import variance_factor
from optnav_cli.frames.folder import Observation, make_observation
from optnav_cli.frames.picture import load_picture
from optnav_cli.frames.truth import Truth, read_truth
from optnav_cli.navigate.answers import NavigationInputs
from optnav_cli.navigate.worker import FrameWorker, RunInputs
from tests.studies import albedo_fit, descent_fit, flights, horizon_fit, likelihood, navigation
from tests.studies.tables import Cell, StudyReport, StudyTable, columns

# Folders that catalogs and pictures of a model are taken from.
FOLDERS = {
    "control_points": "optnav-navigation",
    "descent": "optnav-descent",
    "horizon": "optnav-horizon",
    "albedo": "",  # of none
}
# Scenarios with their catalogs: of some the first frames are fitted with, the others only score.
# A model that errs, one that is right but for what lies below its 118 m, one below its 948 m, one
# that is right under albedo and one that errs less and says so.
FITTED = {
    "real_unk_200km": "tycho",
    "unk_400km": "tycho",
    "orbit_400km": "moon",
    "real_unk_400km_right": "tycho",
    "real_unk_400km_better": "tycho",
}
SCORED = {
    "real_unk_400km": "tycho",
    "real_shnk_200km": "tycho",
    "real_farside_400km": "farside",
    "unk_200km": "tycho",
}
OWN_FRAMES = 15  # at most, of a scenario over the simulator's own ground
CELL_DEG = 1.0
FIT_SHARE = 0.6  # of a scenario's frames, the first: of the first three of five grounds
SEARCHED_M = 50.0  # 1 sigma of the true position, for the search
MIN_POINTS = 3
# Points beyond are no errors of a size but wrong places.
MAX_SIGMAS = 5.0
# Of what overlapping templates share: less than all, as each peak has its own noise.
SHARED = 0.95
MAX_FACTOR = 4.0
LENGTHS = ("region_km",)  # no sizes
BEGINNING = b"# Errors of matched control points"


@dataclass(frozen=True, eq=False)
class TrueFrame:
    """Matches of a frame from its true pose.

    case    scenario
    pixels  (n, 2) where the true pose puts the points
    """

    case: str
    matched: MatchedFrame
    pixels: FloatArray


def run(
    progress: Progress,
    name: str,
    folder: Path | None = None,
    frames: int | None = None,
    rows: str = "",
    output: Path | None = None,
) -> "AnyResult":
    """Fit the sizes of one of FOLDERS' models; a TOML file with them goes to `output`.

    folder  of a study, whose catalogs and pictures are used again; None for that of FOLDERS
    frames  pictures of a scenario, its own number when None; of a descent always all
    rows    only scenarios whose name contains this
    """
    if name == "albedo":
        if folder or frames:
            raise UsageError("albedo is fitted without pictures; leave --folder and --frames out")
        return albedo_fit.run(progress, rows, output)
    folder = folder or Path(FOLDERS[name])
    if name == "descent":
        return descent_fit.run(progress, folder, rows, output)
    if name == "horizon":
        return horizon_fit.run(progress, folder, frames, rows, output)
    if output is not None:
        check_file(output, make_prefix_test(BEGINNING))
    make_folder(folder)
    chosen = {n: c for n, c in (FITTED | SCORED).items() if rows in n}
    if not chosen.keys() & FITTED.keys():
        raise NothingToDoError(f"no scenario to fit with is called '{rows}': {', '.join(FITTED)}")
    fit: list[TrueFrame] = []
    held: list[TrueFrame] = []
    for scenario, catalog in chosen.items():
        most = frames if scenario.startswith("real") else min(frames or OWN_FRAMES, OWN_FRAMES)
        found = gathered(folder, scenario, catalog, most, progress)
        first = round(FIT_SHARE * len(found)) if scenario in FITTED else 0
        fit += found[:first]
        held += found[first:]
    if not fit:
        raise NothingToDoError("too few points in the frames to fit with; give more by --frames")
    old = load_error_sizes()
    new = fitted(fit, old)
    if output is not None:
        text = with_sizes(read_toml_text(resource(FILE)), new)
        write_output(output, text.encode(), make_prefix_test(BEGINNING))
    return FitResult(old, new, fit, held)


def gathered(
    folder: Path, name: str, catalog: str, frames: int | None, progress: Progress
) -> list[TrueFrame]:
    """The frames of a scenario, matched from their true poses.

    Arguments otherwise as `run`
    """
    pictures = flights.shipped_pictures(folder, name, frames, progress)
    if catalog == "moon":
        place = flights.built_catalog(folder / "moon.toml", flights.MOON, progress)
    else:
        stated = flights.points_error_of(name)
        place = navigation.case_catalog(folder, catalog, CELL_DEG, stated, progress)
    worker = FrameWorker(RunInputs(pictures, [place]))
    truths = {t.file: t for t in read_truth(pictures / "truth.csv", worker.folder.attitude)}
    found = []
    try:
        with progress.stage(f"match {name}", len(truths), "frame") as bar:
            for frame in worker.folder.frames:
                camera = worker.folder.cameras[frame.camera]
                picture = load_picture(worker.folder.picture_path(frame), camera)
                seen = make_observation(frame, camera, picture)
                one = of_frame(worker.inputs, seen, truths[frame.file], name)
                if one is not None:
                    found.append(one)
                bar.advance()
    finally:
        worker.close()
    return found


def of_frame(
    inputs: NavigationInputs, seen: Observation, truth: Truth, case: str
) -> TrueFrame | None:
    """A frame matched from its true pose, without wrong matches; None: too few points."""
    if inputs.points is None:
        return None
    settings = inputs.settings
    picture = PicturePyramid(seen.picture.values)
    context = FrameContext(seen, picture, inputs.points, settings, inputs.matcher)
    pose = Pose(truth.position_m, truth.camera_from_body)
    view = select_evenly(find_expected(context, pose, whole=True), settings.solve.max_points)
    if len(view) == 0:
        return None
    covariance = np.diag([SEARCHED_M**2] * 3 + [0.0] * 3)
    matches, _ = match_all(plan_search(context, view, pose, covariance), {})
    matched = make_matched_frame(context, view, matches, pose)
    if matched.errors is None:
        return None
    pixels, _ = predict(seen.camera, pose, matched.sightings.points_body_m)
    frame = TrueFrame(case, matched, pixels)
    missed, own, common = _errors(frame, load_error_sizes())
    own = own + np.einsum("nik,njk->nij", common, common)
    good = np.einsum("ni,nij,nj->n", missed, np.linalg.inv(own), missed) < MAX_SIGMAS**2
    return subset(frame, good) if good.sum() >= MIN_POINTS else None


def subset(frame: TrueFrame, kept: BoolArray) -> TrueFrame:
    """Some of a frame's matches, at least one."""
    whole, parts = frame.matched, dict[str, Any]()
    for name, values in vars(whole.errors).items():
        parts[name] = None if values is None else values[kept]
    correlation = None if whole.correlation is None else whole.correlation[np.ix_(kept, kept)]
    matched = MatchedFrame(
        whole.sightings.subset(kept), MatchedPoints(**parts), correlation, whole.sun_body
    )
    return TrueFrame(frame.case, matched, frame.pixels[kept])


def log_likelihood(frames: Sequence[TrueFrame], sizes: PointErrorSizes) -> float:
    """Of the errors of all matches, logarithm, less what no size changes."""
    return sum(_log_likelihood(frame, sizes) for frame in frames)


def _log_likelihood(frame: TrueFrame, sizes: PointErrorSizes) -> float:
    missed, own, common = _errors(frame, sizes)
    roots, both = np.linalg.cholesky(own).reshape(missed.size, 2), common.reshape(missed.size, -1)
    shared = np.eye(len(missed))
    if frame.matched.correlation is not None:
        shared = SHARED * frame.matched.correlation + (1.0 - SHARED) * shared
    covariance = (roots @ roots.T) * shared.repeat(2, axis=0).repeat(2, axis=1) + both @ both.T
    factored = cho_factor(covariance, lower=True, check_finite=False)
    determinant = 2.0 * float(np.log(np.diag(factored[0])).sum())
    return -0.5 * (float(missed.ravel() @ cho_solve(factored, missed.ravel())) + determinant)


def _errors(
    frame: TrueFrame, sizes: PointErrorSizes, factor: float = 1.0
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """By how much the points were missed (n, 2), and what these sizes expect, px.

    That is the covariances of their own errors (n, 2, 2), and one sigma of each error that is
    common to all (n, 2, k).
    """
    seen, common = frame.matched.weigh(sizes)
    shares = compute_scatter_shares(frame.matched.errors, sizes)
    errors = errors_of_scatter(seen, factor, *shares)
    if common is not None:
        errors = np.concatenate([errors, common], axis=2)
    return seen.pixels - frame.pixels, seen.covariances_px2.astype(np.float64), errors


def position_nees(frame: TrueFrame, sizes: PointErrorSizes) -> float:
    """Squared error of the frame's position over its covariance, a degree of freedom.

    Linear at the truth; the attitude is exact.
    """
    points = frame.matched.errors
    if points is None:
        raise NothingToDoError(f"{frame.case}: no matches")
    missed, own, _ = _errors(frame, sizes)
    by_place = -points.pixel_per_metre
    weights = np.linalg.inv(own).astype(np.float64)
    measured = linearised(missed, by_place, weights)
    noise = inverse_of(measured.normal)
    error = noise @ measured.gradient
    rest = missed - by_place @ error
    squares = np.einsum("ni,nij,nj->n", rest, measured.weights, rest)
    factor = variance_factor(squares, missed.size - 3)
    _, _, common = _errors(frame, sizes, factor)
    seen, _ = frame.matched.weigh(sizes)
    step, covariance = with_dependent_errors(
        factor * noise,
        measured._replace(residuals=rest),
        factor,
        seen,
        common,
        frame.matched.correlation,
    )
    return squared_distance(error + step, covariance) / 3.0


def numbers(sizes: PointErrorSizes) -> dict[str, float]:
    """Every size by its name, such as "own.fixed_m"."""
    parts = msgspec.to_builtins(sizes)
    return {
        f"{section}.{name}": value
        for section, own in parts.items()
        if section not in LENGTHS
        for name, value in own.items()
    }


def scaled(sizes: PointErrorSizes, factors: Mapping[str, float]) -> PointErrorSizes:
    """The sizes with some, by their names, multiplied."""
    parts = msgspec.to_builtins(sizes)
    for name, factor in factors.items():
        section, own = name.split(".")
        parts[section][own] *= factor
    return msgspec.convert(parts, PointErrorSizes)


def drops(frames: Sequence[TrueFrame], sizes: PointErrorSizes) -> dict[str, tuple[float, float]]:
    """By how much halving and doubling each size lowers the logarithm of the likelihood."""
    return likelihood.drops(
        lambda factors: log_likelihood(frames, scaled(sizes, factors)), numbers(sizes)
    )


def fitted(frames: Sequence[TrueFrame], sizes: PointErrorSizes) -> PointErrorSizes:
    """The likeliest sizes, of those on which the frames depend."""
    factors = likelihood.likeliest_factors(
        lambda some: log_likelihood(frames, scaled(sizes, some)), numbers(sizes), MAX_FACTOR
    )
    return scaled(sizes, factors)


def with_sizes(text: str, sizes: PointErrorSizes) -> str:
    """The text of the shipped sizes' file with other values, to two digits; comments stay."""
    return likelihood.with_numbers(text, numbers(load_error_sizes()), numbers(sizes))


@dataclass(frozen=True, eq=False)
class FitResult:
    """Sizes before and after, and the frames that they were fitted with and are scored on."""

    old: PointErrorSizes
    new: PointErrorSizes
    fit: Sequence[TrueFrame]
    held: Sequence[TrueFrame]


SCORES = columns("scenario; frames; ground; NEES_old = NEES, old .2f; NEES_new = NEES, new .2f; "
                 "worst_old = worst, old [σ] .1f; worst_new = worst, new [σ] .1f")  # fmt: skip


AnyResult = (
    FitResult
    | albedo_fit.AlbedoFitResult
    | descent_fit.DescentFitResult
    | horizon_fit.HorizonFitResult
)


def report(result: AnyResult) -> StudyReport:
    """The sizes with what halving and doubling the new ones costs, and NEES by scenario."""
    if isinstance(result, albedo_fit.AlbedoFitResult):
        return albedo_fit.report(result)
    if isinstance(result, descent_fit.DescentFitResult):
        return descent_fit.report(result)
    if isinstance(result, horizon_fit.HorizonFitResult):
        return horizon_fit.report(result)
    old, new = numbers(result.old), numbers(result.new)
    sizes = likelihood.sizes_table(old, new, drops(result.fit, result.new))
    scores: list[tuple[Cell, ...]] = []
    for ground, frames in (("fitted with", result.fit), ("held back", result.held)):
        for name in dict.fromkeys(frame.case for frame in frames):
            own = [frame for frame in frames if frame.case == name]
            kind = ground if name in FITTED else "other flight"
            before, after = (
                np.array([position_nees(frame, s) for frame in own])
                for s in (result.old, result.new)
            )
            worst = [float(np.sqrt(3.0 * some.max())) for some in (before, after)]
            scores.append((name, len(own), kind, before.mean(), after.mean(), *worst))
    note = f"{likelihood.NOTE}; NEES of positions from the true pose's matches, exact attitude"
    return StudyReport((sizes, StudyTable("Scores", SCORES, tuple(scores))), (note,))
