"""Fit the sizes of the errors of a descent's windows, and score them on other ground.

The windows of all frames of a flight are matched from their true poses: what is left is their
error. The sizes in FILE are those under which all errors of the flights together are likeliest: of
the ground, the same in each frame that shows it, alike where windows share ground and, in a part,
in all of a flight; and fresh ones. How wrong a flight's model is, is learned as the filter does. A
prior holds sizes at the present ones where the flights say nothing. Fitted with the model of the
truth, with one that is wrong, and with a 12 m model; what a stated error does, then, with ground
that differs as the Moon does from a model that states its error.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import msgspec
import numpy as np
from scipy.linalg import cho_factor, cho_solve

from catalog.arrays import BoolArray, FloatArray, IndexArray
from catalog.config import read_toml_text, resource
from catalog.errors import NothingToDoError
from catalog.files import check_file, make_prefix_test, write_output
from catalog.places import make_folder
from catalog.progress import Progress
from optnav_cli.control_points.expectation import FrameContext
from optnav_cli.control_points.picture_pyramid import PicturePyramid
from optnav_cli.estimation.models.points import Pose, predict
from optnav_cli.frames.folder import make_observation
from optnav_cli.frames.picture import load_picture
from optnav_cli.frames.truth import read_truth
from optnav_cli.navigate.descent.filter import GATE
from optnav_cli.navigate.descent.state import (
    FILE,
    SCALES,
    DescentErrorSizes,
    WindowGround,
    WindowSpread,
    compute_sunward_shift_px,
    correlate_errors,
    load_descent_sizes,
    make_window_ground,
)
from optnav_cli.navigate.descent.windows import (
    WindowField,
    WindowKey,
    choose_windows,
    match_window,
)
from optnav_cli.navigate.inputs import open_ground
from optnav_cli.navigate.worker import FrameWorker, RunInputs
from tests.studies import likelihood
from tests.studies.descent_flights import Way, catalog_of, pictures_of
from tests.studies.tables import Cell, StudyReport, StudyTable, columns

# Grounds that sizes are fitted with, and one that only scores; seeds of the wrong models of both.
# The Sun of those fitted with stands on opposite sides, which tells what follows it from the rest.
FITTED, HELD = (0, 5), (6,)
FITTED_WRONG, HELD_WRONG = 4, 5
SEARCHED_M = 20.0  # 1 sigma of the true position, for the search
MAX_FACTOR = 8.0
MAX_SHARE = 0.9
# No sizes of windows.
KEPT = "landmark_px", "landmark_shift", "landmark_height_postings", "altimeter_postings"
# Of windows over a model that states its error: fitted with such flights, the others held.
STATED = "stated_shift", "stated_height", "stated_width", "stated_own"
SHARES = ("common", "fresh_share")
BEGINNING = b"# How far a window of the terrain model"


@dataclass(frozen=True, eq=False)
class FlightErrors:
    """Errors of the windows of a flight from its true poses.

    grounds      (k) windows
    of_window    (n,) which of them each sighting is of
    missed_px    (n, 2) measured less predicted;  sunward_px (n, 2) by a unit of sunward_postings
    by_ground    (n, 2, 3) derivative of the pixel by the ground's place
    left_px2     (n, 2, 2) what each match leaves over
    held_sunward  by which to tell how wrong the model is, if not by sunward_postings of the sizes
    """

    case: str
    grounds: Sequence[WindowGround]
    of_window: IndexArray
    missed_px: FloatArray
    sunward_px: FloatArray
    by_ground: FloatArray
    left_px2: FloatArray
    held_sunward: float | None = None

    @property
    def is_stated(self) -> bool:
        """Whether the terrain model states its error."""
        return bool(self.grounds[0].stated.sigmas_m.any())

    def subset(self, kept: BoolArray) -> "FlightErrors":
        """Some of the sightings."""
        names = ("of_window", "missed_px", "sunward_px", "by_ground", "left_px2")
        return replace(self, **{name: getattr(self, name)[kept] for name in names})

    def scale(self, sizes: DescentErrorSizes) -> float:
        """How wrong the flight's model is, by the windows' first sightings; see `WindowSpread`."""
        _, first = np.unique(self.of_window, return_index=True)
        held = self.held_sunward
        sunward = sizes.sunward_postings if held is None else held
        missed = self.missed_px - sunward * self.sunward_px
        grounds = [self.grounds[k] for k in self.of_window[first]]
        level = self.by_ground[first] @ np.array([ground.axes[:, :2] for ground in grounds])
        off = np.linalg.pinv(level) @ missed[first, :, None]
        spreads = [ground.compute_level_m2(sizes) for ground in grounds]
        widest = np.array([stays + SCALES[-1] * scaled for stays, scaled in spreads])
        squares = (off * np.linalg.solve(widest, off)).sum(axis=(1, 2))
        return WindowSpread().add_windows(grounds, squares, float(SCALES[-1]), sizes).scale

    def errors(self, sizes: DescentErrorSizes) -> tuple[FloatArray, FloatArray]:
        """What was missed (2 n,), px, and its covariance (2 n, 2 n) by some sizes."""
        missed = self.missed_px - sizes.sunward_postings * self.sunward_px
        scale = self.scale(sizes)
        errors = [ground.compute_error(sizes, scale) for ground in self.grounds]
        count, rows = len(self.grounds), len(self.of_window)
        ground_m2 = correlate_errors(errors, errors).reshape(count, 3, count, 3)
        of_sightings = ground_m2[self.of_window][:, :, self.of_window]
        covariance = np.einsum(
            "iap,ipjq,jbq->iajb", self.by_ground, of_sightings, self.by_ground, optimize=True
        ).reshape(2 * rows, 2 * rows)
        fresh = sizes.fresh_px**2 * np.eye(2) + scale * sizes.fresh_share * self.left_px2
        for k, own in enumerate(fresh):
            covariance[2 * k : 2 * k + 2, 2 * k : 2 * k + 2] += own
        return missed.ravel(), covariance


def run(
    progress: Progress, folder: Path, rows: str = "", output: Path | None = None
) -> "DescentFitResult":
    """Fit the sizes; a TOML file with them goes to `output`.

    folder  of `make study-descent`, whose catalogs and pictures are used again
    rows    only flights whose name contains this
    """
    if output is not None:
        check_file(output, make_prefix_test(BEGINNING))
    make_folder(folder)
    fit = _gathered(folder, FITTED, FITTED_WRONG, rows, progress)
    held = _gathered(folder, HELD, HELD_WRONG, rows, progress)
    if not fit:
        raise NothingToDoError(f"no flight to fit with is called '{rows}'")
    old = load_descent_sizes()
    new = fitted(fit, old)
    if output is not None:
        text = with_sizes(read_toml_text(resource(FILE)), new)
        write_output(output, text.encode(), make_prefix_test(BEGINNING))
    return DescentFitResult(old, new, fit, held)


def _gathered(
    folder: Path, grounds: Sequence[int], wrong: int, rows: str, progress: Progress
) -> list[FlightErrors]:
    cases = {
        "118 m": (Way.LONG, 0),
        "118 m, wrong": (Way.LONG, wrong),
        "12 m": (Way.FINE, 0),
        "118 m as the Moon differs": (Way.MOON, 0),
    }
    found = []
    for ground in grounds:
        for case, (way, seed) in cases.items():
            name = f"{case}, ground {ground}"
            if rows in name:
                pictures = pictures_of(folder, ground, way, progress)
                catalog = catalog_of(folder, pictures, way, progress, wrong=seed)
                found.append(gathered(name, pictures, catalog, progress))
    return found


def gathered(case: str, pictures: Path, catalog: Path, progress: Progress) -> FlightErrors:
    """The windows of a flight, matched from its true poses, without wrong matches."""
    worker = FrameWorker(RunInputs(pictures, [catalog]))
    grounds: dict[WindowKey, WindowGround] = {}
    rows: list[tuple[WindowKey, FloatArray, FloatArray, FloatArray, FloatArray]] = []
    try:
        folder, inputs = worker.folder, worker.inputs
        field = open_ground(worker.catalogs, folder.body)
        truths = read_truth(pictures / "truth.csv", folder.attitude)
        if field is None:
            raise NothingToDoError(f"{catalog}: has no patches")
        windows, known = WindowField(field, truths[-1].position_m), list[WindowKey]()
        with progress.stage(f"match {case}", len(truths), "frame") as bar:
            for frame, truth in zip(folder.frames, truths, strict=True):
                camera = folder.cameras[frame.camera]
                picture = load_picture(folder.picture_path(frame), camera)
                seen = make_observation(frame, camera, picture)
                values = PicturePyramid(picture.values)
                context = FrameContext(seen, values, field, inputs.settings, inputs.matcher)
                pose = Pose(truth.position_m, truth.camera_from_body)
                chosen = choose_windows(context, pose, windows, known)
                known = []
                for window in chosen:
                    pixel, by_pose = predict(camera, pose, window.place_m[None])
                    by_position = by_pose[0, :, :3]
                    sigma = SEARCHED_M * float(np.linalg.norm(by_position, 2))
                    match = match_window(context, pose, window, sigma)
                    if match.reason or match.pixel is None or match.covariance_px2 is None:
                        continue
                    known.append(window.key)
                    if window.key not in grounds:
                        grounds[window.key] = make_window_ground(window, match, by_position)
                    place, posting, sun = window.place_m, window.posting_m, context.sun_body
                    shift = compute_sunward_shift_px(place, posting, by_position, sun)
                    left = match.covariance_px2
                    rows.append((window.key, match.pixel - pixel[0], shift, -by_position, left))
                bar.advance()
    finally:
        worker.close()
    if not rows:
        raise NothingToDoError(f"{case}: no window was found")
    keys = list(grounds)
    numbers: IndexArray = np.array([keys.index(row[0]) for row in rows])
    parts = (np.array(part, np.float64) for part in list(zip(*rows, strict=True))[1:])
    missed, shifts, by_ground, left = parts
    known_grounds = list(grounds.values())
    flight = FlightErrors(case, known_grounds, numbers, missed, shifts, by_ground, left)
    off, covariance = flight.errors(load_descent_sizes())
    each = off.reshape(-1, 2)
    count = len(each)
    own = covariance.reshape(count, 2, count, 2)[np.arange(count), :, np.arange(count)]
    squares = np.einsum("ni,nij,nj->n", each, np.linalg.inv(own), each)
    return flight.subset(squares < GATE)


def log_likelihood(flights: Sequence[FlightErrors], sizes: DescentErrorSizes) -> float:
    """Of the errors of all windows, logarithm, less what no size changes."""
    total = 0.0
    for flight in flights:
        missed, covariance = flight.errors(sizes)
        factored = cho_factor(covariance, lower=True)
        determinant = 2.0 * float(np.log(np.diag(factored[0])).sum())
        total -= 0.5 * (float(missed @ cho_solve(factored, missed)) + determinant)
    return total


def scaled(sizes: DescentErrorSizes, factors: Mapping[str, float]) -> DescentErrorSizes:
    """The sizes with some, by their names, multiplied; shares stay below MAX_SHARE."""
    changed = {name: getattr(sizes, name) * factor for name, factor in factors.items()}
    changed |= {name: min(changed[name], MAX_SHARE) for name in SHARES if name in changed}
    return msgspec.structs.replace(sizes, **changed)


def split_flights(
    flights: Sequence[FlightErrors],
) -> list[tuple[list[FlightErrors], tuple[str, ...]]]:
    """Flights in the order of their fits, each with the sizes that they tell of."""
    of_windows = tuple(
        name for name in DescentErrorSizes.__struct_fields__ if name not in (*KEPT, *STATED)
    )
    groups = ((False, of_windows), (True, STATED))
    split = [([f for f in flights if f.is_stated == stated], names) for stated, names in groups]
    return [(some, names) for some, names in split if some]


def drops(
    flights: Sequence[FlightErrors], sizes: DescentErrorSizes
) -> dict[str, tuple[float, float]]:
    """By how much halving and doubling each size lowers the logarithm of the likelihood."""
    found: dict[str, tuple[float, float]] = {}
    for some, names in split_flights(_held(flights, sizes)):
        found |= likelihood.drops(_likelihood_by_factors(some, sizes), names)
    return found


def _likelihood_by_factors(
    flights: Sequence[FlightErrors], sizes: DescentErrorSizes
) -> likelihood.Likelihood:
    return lambda factors: log_likelihood(flights, scaled(sizes, factors))


def _held(flights: Sequence[FlightErrors], sizes: DescentErrorSizes) -> list[FlightErrors]:
    """The flights, their models as wrong as they are with this shift away from the Sun.

    Were it to follow the shift that is tried, a wrong one would pass for a wrong model.
    """
    return [replace(flight, held_sunward=sizes.sunward_postings) for flight in flights]


def fitted(flights: Sequence[FlightErrors], sizes: DescentErrorSizes) -> DescentErrorSizes:
    """The likeliest sizes, of those on which the flights depend."""
    for some, names in split_flights(_held(flights, sizes)):
        likely = _likelihood_by_factors(some, sizes)
        sizes = scaled(sizes, likelihood.likeliest_factors(likely, names, MAX_FACTOR))
    return sizes


def with_sizes(text: str, sizes: DescentErrorSizes) -> str:
    """The text of the shipped sizes' file with other values, to two digits; comments stay."""
    old, lines = load_descent_sizes(), []
    for line in text.splitlines():
        name, _, _ = line.partition(" = ")
        if name in old.__struct_fields__ and getattr(sizes, name) != getattr(old, name):
            line = f"{name} = {getattr(sizes, name):.2g}"
        lines.append(line)
    return "\n".join(lines) + "\n"


@dataclass(frozen=True, eq=False)
class DescentFitResult:
    """Sizes before and after, and the flights that they were fitted with and are scored on."""

    old: DescentErrorSizes
    new: DescentErrorSizes
    fit: Sequence[FlightErrors]
    held: Sequence[FlightErrors]


SCORES = columns(
    "flight; ground; windows; square_old = square a degree, old .2f; "
    "square_new = square a degree, new .2f"
)


def report(result: DescentFitResult) -> StudyReport:
    """The sizes with what halving and doubling the new ones costs, and squares of the errors."""
    old, new = result.old, result.new
    before, after = (msgspec.to_builtins(sizes) for sizes in (old, new))
    sizes = likelihood.sizes_table(before, after, drops(result.fit, new))
    scores: list[tuple[Cell, ...]] = []
    for ground, flights in (("fitted with", result.fit), ("held back", result.held)):
        for flight in flights:
            squares = [_square(flight, each) for each in (old, new)]
            scores.append((flight.case, ground, len(flight.missed_px), *squares))
    note = f"{likelihood.NOTE}; square of all errors of a flight over their joint covariance"
    return StudyReport((sizes, StudyTable("Scores", SCORES, tuple(scores))), (note,))


def _square(flight: FlightErrors, sizes: DescentErrorSizes) -> float:
    """Squared errors over their joint covariance, a degree of freedom."""
    missed, covariance = flight.errors(sizes)
    return float(missed @ np.linalg.solve(covariance, missed)) / missed.size
