"""Attitudes from stars: how often random pointings are found, and that none is found wrongly."""

import time
from dataclasses import dataclass
from pathlib import Path
from typing import cast

import msgspec
import numpy as np
from scipy.spatial.transform import Rotation

from catalog.arrays import FloatArray
from catalog.bodies.ephemeris import compute_velocity_inertial
from catalog.bodies.stars import apply_aberration, load_bright_stars
from catalog.config import resource
from catalog.errors import NoSolutionError
from catalog.geometry.rotations import ARCSEC
from catalog.geometry.vectors import unit
from catalog.places import make_folder
from catalog.progress import Progress
from optnav_cli.camera.camera import Camera
from optnav_cli.camera.camera_file import preset_camera
from optnav_cli.frames.folder import Folder, read_folder
from optnav_cli.frames.picture import load_picture
from optnav_cli.frames.truth import Truth, read_truth
from optnav_cli.simulation.passes import Scenario
from optnav_cli.simulation.scenario import load_scenario
from optnav_cli.stars.identify import StarFix, StarIdentifier
from optnav_cli.stars.sky import SkyView
from optnav_cli.stars.spots import MAX_SPOTS, StarSpots, find_spots
from tests.studies import flights
from tests.studies.tables import Cell, StudyReport, StudyTable, columns, rms

CAMERAS = {"unk": 5.0, "kam_s": 4.5, "shnk": 4.0}  # down to which magnitude spots are seen
FALSE_SPOTS, MIN_STARS = 4, 8
SPOT_PX, MAGNITUDE = 0.15, 0.2  # errors of spots
WRONG_PX = 3.0
FOUND = columns(
    "camera; faintest = to V .1f; frames; found; wrong; share = found [%] .1f; "
    "across = across, rms [″] .2f; about = about the axis, rms [″] .2f; nees = NEES .2f; "
    "median = identification, median [ms] .0f; longest [ms] .0f"
)
EMPTY = columns("camera; frames; accepted; median = median [ms] .0f")
BESIDE = columns(
    "scenario; pictures; solved; share = solved [%] .1f; wrong; across = across, rms [″] .2f; "
    "about = about the axis, rms [″] .2f; nees = NEES .2f; inside = within 3σ [%] .0f; "
    "fewest = fewest stars"
)
SCENARIO = "stars_10000km"
FAR_OFF = 16.3  # squared, over its covariance: three numbers pass it once in a thousand


@dataclass(frozen=True, eq=False)
class StarFigures:
    """Rows of the study's tables."""

    found: list[tuple[Cell, ...]]
    empty: list[tuple[Cell, ...]]
    beside: list[tuple[Cell, ...]]


def run(
    output: Path, progress: Progress, trials: int = 334, pictures: int = 60, seed: int = 1
) -> StarFigures:
    """Random pointings with false spots, and random spots without a star, of each camera; pictures
    of stars beside the lit Moon.

    output  folder for these; those that are there are used again
    """
    found: list[tuple[Cell, ...]] = []
    empty: list[tuple[Cell, ...]] = []
    with progress.stage("study stars", 2 * len(CAMERAS), "row") as bar:
        for name, faintest in CAMERAS.items():
            rng = np.random.default_rng([seed, len(found)])
            found.append(_found(preset_camera(name), faintest, trials, rng))
            bar.advance()
            empty.append(_empty(preset_camera(name), trials, rng))
            bar.advance()
    beside = [_beside(_drawn(output, pictures, seed, progress), seed)] if pictures else []
    return StarFigures(found, empty, beside)


def _drawn(output: Path, pictures: int, seed: int, progress: Progress) -> Path:
    """The folder of the shipped scenario's pictures, so many, with places of their own."""
    scenario = cast(Scenario, load_scenario(resource(f"configs/scenarios/{SCENARIO}.toml")))
    orbit = msgspec.structs.replace(scenario.orbit, passes=pictures)
    scenario = msgspec.structs.replace(scenario, seed=1000 + seed, orbit=orbit)
    make_folder(output)
    return flights.made_pictures(scenario, output / "pictures" / SCENARIO, progress)


def _beside(place: Path, seed: int) -> tuple[Cell, ...]:
    """Attitudes by the stars of drawn pictures against the truth.

    The simulator's craft stands still; one that flies sees the stars displaced by its own motion,
    which nobody states. A circle's speed in a level direction is drawn for it.
    """
    folder, rng = read_folder(place), np.random.default_rng([seed, 60])
    errors: list[FloatArray] = []
    squares: list[float] = []
    counts: list[int] = []
    truths = read_truth(place / "truth.csv", folder.attitude)
    wrong = 0
    for truth in truths:
        camera, fix, covariance = _attitude(folder, truth, rng)
        if fix is None:
            continue
        true = truth.camera_from_body * folder.attitude.inertial_from_body(truth.tdb_s).inv()
        off = (fix.camera_from_sky * true.inv()).as_rotvec()
        counts.append(int(fix.used.sum()))
        wrong += float(np.linalg.norm(off)) * camera.focal_length_px > WRONG_PX
        errors.append(off / ARCSEC)
        squares.append(float(off @ np.linalg.solve(covariance, off)))
    table = np.array(errors).reshape(-1, 3)
    share, honest = 100.0 * len(errors) / len(truths), np.array(squares)
    sizes = (rms(table[:, :2].ravel()), rms(table[:, 2]), float(honest.mean()) / 3.0)
    inside = 100.0 * float((honest < FAR_OFF).mean())
    return (SCENARIO, len(truths), len(errors), share, wrong, *sizes, inside, min(counts))


def _attitude(
    folder: Folder, truth: Truth, rng: np.random.Generator
) -> tuple[Camera, StarFix | None, FloatArray]:
    """The camera of a picture, its attitude and the covariance (3, 3) that is stated of it."""
    (frame,) = (one for one in folder.frames if one.file == truth.file)
    camera, body = folder.cameras[frame.camera], folder.body
    picture = load_picture(folder.picture_path(frame), camera)
    distance = float(np.linalg.norm(truth.position_m))
    ahead = unit(np.cross(truth.position_m, rng.normal(size=3)))
    ahead = folder.attitude.inertial_from_body(truth.tdb_s).apply(ahead)
    flying = np.sqrt(body.gm_m3_s2 / distance) * ahead
    # in the picture the craft stands: to the one that flies so, this is the sky that it expects
    stars = load_bright_stars().propagate(truth.tdb_s)
    expected = apply_aberration(stars, compute_velocity_inertial(body, truth.tdb_s) - flying)
    view = SkyView(body, truth.tdb_s, distance)
    try:
        spots = find_spots(picture.values, picture.saturation)
        fix = StarIdentifier(camera, expected).identify(spots)
    except NoSolutionError:
        return camera, None, np.empty(0)
    return camera, fix, fix.covariance + np.diag(view.variances)


def _timed(identifier: StarIdentifier, spots: StarSpots) -> tuple[StarFix | None, float]:
    before = time.process_time()
    fix = identifier.attempt(spots)
    return fix, 1e3 * (time.process_time() - before)


def _found(
    camera: Camera, faintest: float, trials: int, rng: np.random.Generator
) -> tuple[Cell, ...]:
    stars = load_bright_stars()
    identifier = StarIdentifier(camera, stars.propagate(None))
    errors: list[FloatArray] = []
    squares: list[float] = []
    times: list[float] = []
    wrong = 0
    while len(times) < trials:
        turn = Rotation.random(random_state=rng)
        spots = _spots(camera, turn, faintest, rng)
        if len(spots) < MIN_STARS + FALSE_SPOTS:
            continue
        fix, took = _timed(identifier, spots)
        times.append(took)
        if fix is None:
            continue
        off = (fix.camera_from_sky * turn.inv()).as_rotvec()
        if float(np.linalg.norm(off)) * camera.focal_length_px > WRONG_PX:
            wrong += 1
            continue
        errors.append(off / ARCSEC)
        squares.append(float(off @ np.linalg.solve(fix.covariance, off)) / 3.0)
    table = np.array(errors).reshape(-1, 3)
    across, about = rms(table[:, :2].ravel()), rms(table[:, 2])
    counts = (len(times), len(errors), wrong, 100.0 * len(errors) / len(times))
    spread = (across, about, float(np.mean(squares)))
    return (camera.name, faintest, *counts, *spread, float(np.median(times)), max(times))


def _empty(camera: Camera, trials: int, rng: np.random.Generator) -> tuple[Cell, ...]:
    identifier = StarIdentifier(camera, load_bright_stars().propagate(None))
    accepted = 0
    times: list[float] = []
    for _ in range(trials):
        count = int(rng.integers(8, 40))
        places = _anywhere(camera, count, rng)
        light = np.sort(rng.pareto(1.2, count))[::-1]
        fix, took = _timed(identifier, _spotted(places, light))
        accepted += fix is not None
        times.append(took)
    return camera.name, trials, accepted, float(np.median(times))


def _spots(camera: Camera, turn: Rotation, faintest: float, rng: np.random.Generator) -> StarSpots:
    stars = load_bright_stars()
    pixels = camera.project(turn.apply(stars.propagate(None)))
    seen = np.flatnonzero(np.isfinite(pixels).all(axis=1) & (stars.magnitudes < faintest))
    seen = seen[camera.contains(pixels[seen])][: MAX_SPOTS - FALSE_SPOTS]
    places = pixels[seen] + rng.normal(0.0, SPOT_PX, (len(seen), 2))
    places = np.vstack([places, _anywhere(camera, FALSE_SPOTS, rng)])
    magnitudes = stars.magnitudes[seen] + rng.normal(0.0, MAGNITUDE, len(seen))
    magnitudes = np.append(magnitudes, rng.uniform(0.0, faintest, FALSE_SPOTS))
    order = np.argsort(magnitudes)
    return _spotted(places[order], 10.0 ** (-0.4 * magnitudes[order]))


def _anywhere(camera: Camera, count: int, rng: np.random.Generator) -> FloatArray:
    return rng.uniform(0.0, 1.0, (count, 2)) * (camera.width_px - 1, camera.height_px - 1)


def _spotted(places: FloatArray, light: FloatArray) -> StarSpots:
    return StarSpots(places, light, np.full(len(places), SPOT_PX), 0, 0, 0.0)


def report(result: StarFigures) -> StudyReport:
    """The tables."""
    return StudyReport(
        (
            StudyTable("Random pointings", FOUND, tuple(result.found)),
            StudyTable("Random spots, no stars", EMPTY, tuple(result.empty)),
            StudyTable("Beside the lit Moon", BESIDE, tuple(result.beside)),
        ),
        (
            f"spots of the catalog's stars to {SPOT_PX:g} px and {MAGNITUDE:g} mag, {FALSE_SPOTS} "
            f"false ones among them, at least {MIN_STARS} stars; wrong: over {WRONG_PX:g} px off",
            "asked: 98 % found, none wrong, none of the starless accepted, 50 ms in the median",
            "asked beside the Moon: 95 % solved and NEES 0.7-1.4; the craft flies by a circle's "
            "speed, of which only the size is known",
        ),
    )
