"""Fit the sizes of the errors of limbs, and score them on other ground.

The limbs of pictures are compared with the skyline of the relief as it is seen from their true
poses: what is left of each limb point is its error. The sizes of [light] and [crest] in FILE are
chosen under which these errors are likeliest: each point's own, those that points of a sector share
and those that all share. What crests next to each other share besides is left to the residuals, by
which a fix is widened: sizes are scored by the NEES of whole fixes.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import msgspec
import numpy as np

from catalog.arrays import FloatArray
from catalog.config import read_toml_text, resource
from catalog.errors import NoSolutionError, NothingToDoError
from catalog.files import check_file, make_prefix_test, write_output
from catalog.geometry.vectors import squared_distance
from catalog.places import make_folder
from catalog.progress import Progress
from catalog.terrain.dem.file import resolve_path
from catalog.terrain.relief.relief import GlobalRelief
from catalog.terrain.relief.sums import load_relief
from optnav_cli.frames.folder import read_folder
from optnav_cli.frames.picture import load_picture
from optnav_cli.frames.truth import read_truth
from optnav_cli.outline.limb.detection import LimbPoints
from optnav_cli.outline.limb.ground_skyline import make_relief_skyline
from optnav_cli.outline.limb.limb_rays import (
    FILE,
    HorizonSizes,
    LimbRays,
    compute_edge_errors,
    compute_rough_errors,
    group_by_sector,
    load_horizon_sizes,
    make_limb_rays,
)
from optnav_cli.outline.limb.skyline import add_limb_errors, fit_repeatedly, select_usable_rays
from optnav_cli.outline.one_body import detect_limb
from tests.studies import flights, horizon_flights, likelihood
from tests.studies.tables import Cell, StudyReport, StudyTable, columns

FITTED = ("horizon_100km", "real_horizon_100km")
SCORED = ("real_horizon_050km", "real_horizon_200km")
NAMES = [
    "light.noise_px",
    "light.sector_px",
    "light.sector_low_px",
    "light.sector_fall_deg",
    "crest.noise_m",
    "crest.sigma_m",
    "crest.model_sector",
]
# Sizes of ground in long shadows, fitted on flights of their own (`--rows real_flights`).
ROUGH_NAMES = ["light.rough_share", "light.rough_px"]
MAX_FACTOR = 4.0
MAX_SIGMAS = 5.0  # points beyond are no errors of a size but other crests
BEGINNING = b"# Errors of limbs and crests"


@dataclass(frozen=True, eq=False)
class SeenLimb:
    """The limb of a picture, with its true position (3,), m, and Sun (3,), body frame."""

    rays: LimbRays
    position_m: FloatArray
    sun: FloatArray
    relief: GlobalRelief


@dataclass(frozen=True, eq=False)
class TrueLimb:
    """The limb of a picture beside the skyline from its true position.

    missed  (n,) rad, how far out each point was found
    rays, azimuths, sun_sine  of the points, as `SkylineFit` has them
    distance_m   to the limb;  cells  posting of the relief in those of [crest]
    model_m      stated error of the relief's model, 0 for none
    seen         all of the limb, to be solved with other sizes; None: not scored
    """

    case: str
    missed: FloatArray
    rays: LimbRays
    azimuths: FloatArray
    sun_sine: FloatArray
    distance_m: float
    cells: float
    model_m: float = 0.0
    seen: SeenLimb | None = None

    def errors(self, sizes: HorizonSizes) -> tuple[FloatArray, FloatArray]:
        """Variances of the points' own errors (n,), rad^2, and shared ones (n, m), 1 sigma, rad."""
        crest = self.cells / self.distance_m
        own = self.rays.compute_point_sigmas(sizes.light) ** 2 + (sizes.crest.noise_m * crest) ** 2
        shared = compute_edge_errors(self.rays, self.azimuths, self.sun_sine, sizes.light)
        height = np.full((len(own), 1), sizes.crest.sigma_m * crest)
        model = group_by_sector(self.azimuths) * (sizes.crest.model_sector * self.model_m)
        rough = compute_rough_errors(self.rays, self.azimuths, sizes.light)
        return own, np.concatenate([shared, height, model / self.distance_m, rough], axis=1)


def run(
    progress: Progress,
    folder: Path,
    frames: int | None = None,
    rows: str = "",
    output: Path | None = None,
) -> "HorizonFitResult":
    """Fit the sizes; a TOML file with them goes to `output`.

    folder  of `make study-horizon`, whose pictures are used again
    frames  pictures of a scenario, its own number when None
    rows    only scenarios whose name contains this; horizon_flights.NAME: sizes of ROUGH_NAMES by
            the flights of horizon_flights, scored on those of another seed
    """
    if output is not None:
        check_file(output, make_prefix_test(BEGINNING))
    globe = resolve_path(flights.GLOBE, Path.cwd())
    make_folder(folder)
    names = NAMES
    if rows == horizon_flights.NAME:
        names = ROUGH_NAMES
        fit, held = (
            [
                limb
                for place in horizon_flights.pictures(folder, seed, frames, progress)
                for limb in limbs_of(place, rows, globe)
            ]
            for seed in (horizon_flights.FITTED_SEED, horizon_flights.SCORED_SEED)
        )
    else:
        fit, held = (
            [
                limb
                for name in scenarios
                if rows in name
                for limb in limbs_of(
                    flights.shipped_pictures(folder, name, frames, progress), name, globe
                )
            ]
            for scenarios in (FITTED, SCORED)
        )
    if not fit:
        known = ", ".join((*FITTED, horizon_flights.NAME))
        raise NothingToDoError(f"no scenario to fit with is called '{rows}': {known}")
    old = load_horizon_sizes()
    new = fitted(fit, old, names)
    if output is not None:
        pairs = numbers(old, names), numbers(new, names)
        text = likelihood.with_numbers(read_toml_text(resource(FILE)), *pairs)
        write_output(output, text.encode(), make_prefix_test(BEGINNING))
    return HorizonFitResult(old, new, fit, held, names)


def limbs_of(place: Path, name: str, globe: Path) -> list[TrueLimb]:
    """The limbs of a scenario's pictures from their true poses; without those that have none."""
    pictures = read_folder(place)
    relief = load_relief(str(globe), pictures.body, flights.stated_error_of(name))
    truths = {t.file: t for t in read_truth(pictures.path / "truth.csv", pictures.attitude)}
    found = []
    for frame in pictures.frames:
        camera, truth = pictures.cameras[frame.camera], truths[frame.file]
        turn, sun = truth.camera_from_body, frame.sun_body
        if sun is None:
            continue
        picture = load_picture(pictures.picture_path(frame), camera)
        try:
            limb: LimbPoints = detect_limb(picture, camera, turn, sun, pictures.body)
            rays = make_limb_rays(limb, camera, turn)
            found.append(of_limb(name, SeenLimb(rays, truth.position_m, sun, relief)))
        except NoSolutionError:
            continue
    return found


def of_limb(case: str, seen: SeenLimb) -> TrueLimb:
    """A limb beside the skyline from the true position. Raises NoSolutionError."""
    place, relief, distance = seen.position_m, seen.relief, float(np.linalg.norm(seen.position_m))
    reach, lit, sun_sine = make_relief_skyline(relief, case).predict_sizes(
        place, seen.rays, seen.sun
    )
    usable, kept = select_usable_rays(seen.rays, place, lit, sun_sine)
    passing = np.linalg.norm(np.cross(place, kept.rays), axis=1)
    crests = np.arcsin(reach[usable] * relief.radius_m / distance)
    limb = TrueLimb(
        case,
        np.arcsin(passing / distance) - crests,
        kept,
        kept.compute_azimuths(place),
        sun_sine[usable],
        float(np.sqrt(max(distance**2 - relief.radius_m**2, 1.0))),
        relief.posting_m / load_horizon_sizes().crest.posting_m,
        relief.error_m or 0.0,
        seen,
    )
    own, shared = limb.errors(load_horizon_sizes())
    good = limb.missed**2 < MAX_SIGMAS**2 * (own + (shared**2).sum(axis=1))
    return replace(
        limb,
        missed=limb.missed[good],
        rays=kept.subset(good),
        azimuths=limb.azimuths[good],
        sun_sine=limb.sun_sine[good],
    )


def log_likelihood(limbs: Sequence[TrueLimb], sizes: HorizonSizes) -> float:
    """Of the errors of all limb points, logarithm, less what no size changes."""
    total = 0.0
    for limb in limbs:
        own, shared = limb.errors(sizes)
        weighted = shared / own[:, None]
        inner = np.eye(shared.shape[1]) + shared.T @ weighted
        seen = weighted.T @ limb.missed
        square = float((limb.missed**2 / own).sum() - seen @ np.linalg.solve(inner, seen))
        total -= 0.5 * (square + float(np.log(own).sum()) + float(np.linalg.slogdet(inner)[1]))
    return total


def position_nees(limb: TrueLimb, sizes: HorizonSizes) -> float:
    """Squared error of the picture's position over its covariance, a degree of freedom.

    With the exact attitude.
    """
    if limb.seen is None:
        return float("nan")
    truth = limb.seen.position_m
    skyline = make_relief_skyline(limb.seen.relief, limb.case, sizes)
    last = fit_repeatedly(skyline, limb.seen.rays, truth, limb.seen.sun)
    position, covariance = add_limb_errors(skyline, last.fit, sizes.light)
    return squared_distance(position - truth, covariance) / 3.0


def numbers(sizes: HorizonSizes, names: Sequence[str] = NAMES) -> dict[str, float]:
    """The sizes that limbs tell of, by their names."""
    parts = msgspec.to_builtins(sizes)
    return {name: parts[name.split(".")[0]][name.split(".")[1]] for name in names}


def scaled(sizes: HorizonSizes, factors: Mapping[str, float]) -> HorizonSizes:
    """The sizes with some, by their names, multiplied."""
    parts = msgspec.to_builtins(sizes)
    for name, factor in factors.items():
        section, own = name.split(".")
        parts[section][own] *= factor
    return msgspec.convert(parts, HorizonSizes)


def fitted(
    limbs: Sequence[TrueLimb], sizes: HorizonSizes, names: Sequence[str] = NAMES
) -> HorizonSizes:
    """The likeliest sizes, of those on which the limbs depend."""
    factors = likelihood.likeliest_factors(
        lambda some: log_likelihood(limbs, scaled(sizes, some)), names, MAX_FACTOR
    )
    return scaled(sizes, factors)


@dataclass(frozen=True, eq=False)
class HorizonFitResult:
    """Sizes before and after, and the limbs that they were fitted with and are scored on."""

    old: HorizonSizes
    new: HorizonSizes
    fit: Sequence[TrueLimb]
    held: Sequence[TrueLimb]
    names: Sequence[str] = tuple(NAMES)


SCORES = columns(
    "scenario; frames; ground; NEES_old = NEES, old .2f; NEES_new = NEES, new .2f; "
    "worst_old = worst, old [σ] .1f; worst_new = worst, new [σ] .1f"
)


def report(result: HorizonFitResult) -> StudyReport:
    """The sizes with what halving and doubling the new ones costs, and NEES by scenario."""
    found = likelihood.drops(
        lambda factors: log_likelihood(result.fit, scaled(result.new, factors)), result.names
    )
    sizes = likelihood.sizes_table(
        numbers(result.old, result.names), numbers(result.new, result.names), found
    )
    scores: list[tuple[Cell, ...]] = []
    for ground, limbs in (("fitted with", result.fit), ("held back", result.held)):
        for name in dict.fromkeys(limb.case for limb in limbs):
            own = [limb for limb in limbs if limb.case == name]
            nees = [np.array([position_nees(limb, s) for limb in own])
                    for s in (result.old, result.new)]  # fmt: skip
            worst = [float(np.sqrt(3.0 * some.max())) for some in nees]
            scores.append((name, len(own), ground, nees[0].mean(), nees[1].mean(), *worst))
    note = f"{likelihood.NOTE}; NEES of fixes, exact attitude"
    return StudyReport((sizes, StudyTable("Scores", SCORES, tuple(scores))), (note,))
