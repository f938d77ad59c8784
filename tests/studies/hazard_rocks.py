"""How many rocks are found by their shadows, how tall they are told, and what is taken for one.

Ground with rocks by a published law is drawn and photographed from above under several Suns. The
numbers of [rocks] in configs/models/hazard.toml are fitted (--fit) on fields of seeds 101-104.
"""

import math
from dataclasses import dataclass, field
from functools import lru_cache
from itertools import product
from typing import Any, NamedTuple

import msgspec
import numpy as np
from scipy.optimize import minimize
from scipy.special import expit

from catalog.arrays import BoolArray, FloatArray
from catalog.errors import NoSolutionError
from catalog.progress import Progress
from optnav_cli.camera.camera_file import preset_camera
from optnav_cli.hazard.ground_view import PictureOnGround, look_down
from optnav_cli.hazard.rocks import (
    CELL_M,
    ShadowEdges,
    check_scale,
    find_rocks,
    find_shadow_edges,
    make_turn,
    measure_heights,
    place_edges,
    rate_edges,
)
from optnav_cli.hazard.settings import HazardModel, HazardSettings, RockNumbers, load_hazard_model
from tests.studies.hazard_craters import density_table, size_table, variance_table
from tests.studies.hazard_rocks_ground import (
    RockyGround,
    count_rocks,
    cut_camera,
    make_rocky_ground,
    measure_shadow_ratio,
    photograph,
)
from tests.studies.tables import StudyReport, StudyTable, columns

CAMERA, HEIGHT_M, SIDE_M = "tsnn2_narrow", 100.0, 60.0
EDGE_M = 2.0  # of the view, in which rocks are not counted
SETTINGS = HazardSettings()
ROCK_M = SETTINGS.min_rock_m
SMALL_M = 0.15  # of a rock that is listed: anything lower, or none, is false
SHARE = 0.05  # of the ground under rocks
SIZES_M = ((0.3, 0.4), (0.4, 0.6), (0.6, 9.0))
FIT_FIELDS = (("rough", 101), ("even", 102), ("rough", 103), ("even", 104))
FIT_SUNS = (5.0, 10.0, 20.0, 30.0)
FIT_LOWEST_M = 0.22  # told height of edges that are fitted
# Told over true height of an edge that is its rock's, and of one whose height is fitted.
LARGEST_RATIO, FIT_RATIO = 2.5, 1.6
DECAY = 1e-3  # of the weights' squares
# Share of listed edges that are none of rocks, on the fitted fields; above the chance too few of
# the rocks under a low Sun would be left.
MAX_FALSE, MAX_CHANCE = 0.04, 0.8


class RockCase(NamedTuple):
    """Ground, Sun, share of rocks, and height of the camera."""

    kind: str
    sun_deg: float
    share: float = SHARE
    height_m: float = HEIGHT_M


CASES = (
    *(RockCase(kind, sun) for kind in ("rough", "even") for sun in (5.0, 20.0, 30.0)),
    RockCase("rough", 20.0, 0.1),
    *(RockCase("rough", 20.0, height_m=height) for height in (150.0, 200.0)),
)


@dataclass
class RockScore:
    """Counts of a case.

    sizes   (3, 2) rocks of the size classes: all, and found;  lit  those that stand in light
    listed, false, small  listed ones; without a rock of SMALL_M; with one below ROCK_M
    ratios  told over true height, and error over its sigma, of found ones
    """

    sizes: FloatArray = field(default_factory=lambda: np.zeros((len(SIZES_M), 2)))
    listed: int = 0
    false: int = 0
    small: int = 0
    ratios: list[tuple[float, float]] = field(default_factory=list)
    reason: str = ""


class SeenRocks(NamedTuple):
    """Rocks of a ground (n,) where a camera sees their feet on level ground."""

    x: FloatArray
    y: FloatArray
    height: FloatArray
    reach: FloatArray


def see_rocks(ground: RockyGround, height_m: float, half_m: float) -> SeenRocks:
    """Places of the rocks in the view of a camera, relief shifting them."""
    rocks = ground.rocks
    scale = height_m / (height_m - rocks.z)
    x, y = rocks.x * scale, rocks.y * scale
    inside = np.maximum(np.abs(x), np.abs(y)) < half_m
    reach = np.maximum(0.5 * rocks.length, 0.25)
    return SeenRocks(x[inside], y[inside], rocks.height[inside], reach[inside])


def view_ground(ground: RockyGround, case: RockCase) -> PictureOnGround:
    """The fine view of the picture of a case. Raises NoSolutionError as the command does."""
    camera = cut_camera(preset_camera(CAMERA), case.height_m, SIDE_M)
    picture = photograph(ground, camera, case.height_m, case.sun_deg)
    azimuth = ground.azimuth_deg()
    return look_down(picture, camera, case.height_m, case.sun_deg, azimuth, CELL_M)


def score_view(
    view: PictureOnGround, seen: SeenRocks, half_m: float, model: HazardModel, score: RockScore
) -> None:
    """Match the listed rocks of a view, tallest first, with the true ones; add up."""
    found = [r for r in find_rocks(view, SETTINGS, model)
             if max(abs(r.x_m), abs(r.y_m)) < half_m - EDGE_M]  # fmt: skip
    free = np.ones(seen.x.size, bool)
    taken = np.zeros(seen.x.size, bool)
    for rock in found:
        distance = np.hypot(seen.x - rock.x_m, seen.y - rock.y_m)
        near = free & (distance < seen.reach + 0.1) & (seen.height > SMALL_M)
        score.listed += 1
        if not near.any():
            score.false += 1
            continue
        # of several rocks the one whose height is nearest
        misfit = np.where(near, np.abs(np.log(seen.height / rock.height_m)), np.inf)
        at = int(np.argmin(misfit))
        free[at], taken[at] = False, True
        true = float(seen.height[at])
        score.small += true < ROCK_M
        score.ratios.append((rock.height_m / true, (rock.height_m - true) / rock.height_sigma_m))
    inside = np.maximum(np.abs(seen.x), np.abs(seen.y)) < half_m - 2.0 * EDGE_M
    for row, (low, high) in enumerate(SIZES_M):
        counted = inside & (seen.height >= low) & (seen.height < high)
        score.sizes[row] += counted.sum(), (counted & taken).sum()


@dataclass
class RockFigures:
    cases: dict[RockCase, RockScore]
    fields: int
    fitted: str = ""


def run(progress: Progress, *, fields: int, fit: bool) -> RockFigures:
    """Score the cases on fields of seeds from 1 on."""
    model = load_hazard_model()
    text = ""
    if fit:
        model = fit_model(model, progress)
        text = format_section(model.rocks)
    scores = {case: RockScore() for case in CASES}
    with progress.stage("rocks", fields * len(CASES), "picture") as bar:
        for (kind, share), seed in product(
            dict.fromkeys((c.kind, c.share) for c in CASES), range(1, fields + 1)
        ):
            ground = make_rocky_ground(kind, seed, share)
            for case, score in scores.items():
                if (case.kind, case.share) == (kind, share):
                    judge(case, ground, model, score)
                    bar.advance()
    return RockFigures(scores, fields, text)


def judge(case: RockCase, ground: RockyGround, model: HazardModel, score: RockScore) -> None:
    """Look for the rocks of a ground as the command does, and add what is found."""
    camera = preset_camera(CAMERA)
    try:
        pixel_m = case.height_m * camera.angular_resolution
        check_scale(pixel_m, case.sun_deg, ROCK_M, model.rocks)
        view = view_ground(ground, case)
    except NoSolutionError as error:
        score.reason = str(error)
        return
    half = 0.5 * view.brightness.shape[0] * view.cell_m
    score_view(view, see_rocks(ground, case.height_m, half), half, model, score)


class FitData(NamedTuple):
    """Edges (n,) of fitted fields under one Sun: are they rocks, and how tall those are."""

    edges: ShadowEdges
    view: PictureOnGround
    true: FloatArray


@lru_cache(maxsize=1)
def _fit_data(model: HazardModel) -> dict[float, list[FitData]]:
    data: dict[float, list[FitData]] = {sun: [] for sun in FIT_SUNS}
    for kind, seed in FIT_FIELDS:
        ground = make_rocky_ground(kind, seed, SHARE)
        for sun in FIT_SUNS:
            view = view_ground(ground, RockCase(kind, sun))
            half = 0.5 * view.brightness.shape[0] * view.cell_m
            data[sun].append(label_edges(view, see_rocks(ground, HEIGHT_M, half), half, model))
    return data


def label_edges(
    view: PictureOnGround, seen: SeenRocks, half_m: float, model: HazardModel
) -> FitData:
    """Edges of a view with the heights of the rocks that they are of; 0 where there is none."""
    turn = make_turn(view)
    edges = find_shadow_edges(view, turn, SETTINGS, model)
    height, _ = measure_heights(edges, view, model.rocks)
    x, y = place_edges(edges, height, turn, view)
    kept = (height > FIT_LOWEST_M) & (np.maximum(np.abs(x), np.abs(y)) < half_m - EDGE_M)
    edges = ShadowEdges(*(part[kept] for part in edges))
    x, y, height = x[kept], y[kept], height[kept]
    true = np.zeros(x.size)
    for at in range(x.size):
        near = np.hypot(seen.x - x[at], seen.y - y[at]) < seen.reach + 0.1
        near &= height[at] < LARGEST_RATIO * seen.height
        if near.any():
            misfit = np.where(near, np.abs(np.log(seen.height / height[at])), np.inf)
            true[at] = seen.height[int(np.argmin(misfit))]
    return FitData(edges, view, true)


def fit_model(model: HazardModel, progress: Progress) -> HazardModel:
    """The model with its numbers of rocks fitted: heights first, then the rule that tells rocks."""
    with progress.stage("fit", 2, "step") as bar:
        data = _fit_data(model)
        bar.advance()
        numbers = fit_rule(data, fit_heights(data, model.rocks))
        bar.advance()
    return msgspec.structs.replace(model, rocks=numbers)


def fit_heights(data: dict[float, list[FitData]], numbers: RockNumbers) -> RockNumbers:
    """Numbers of heights and their sigmas under which the true heights are the likeliest.

    Errors beyond three sigmas, of a wrong rock or an interrupted shadow, weigh no more.
    """
    keys = ("longer_px", "slope_weight", "sigma_px", "sigma_share", "sigma_slope")

    def misfit(values: FloatArray) -> float:
        named = dict(zip(keys, map(float, values)))
        return misfit_heights(data, msgspec.structs.replace(numbers, **named))

    start = np.array([getattr(numbers, key) for key in keys])
    bounds = [(-2.0, 4.0), (0.0, 2.0), (0.2, 4.0), (0.0, 0.5), (0.0, 0.2)]
    best = minimize(misfit, start, method="Nelder-Mead", bounds=bounds,
                    options={"maxiter": 400, "xatol": 1e-3, "fatol": 1e-6})  # fmt: skip
    return msgspec.structs.replace(numbers, **dict(zip(keys, (round(float(v), 4) for v in best.x))))


def misfit_heights(data: dict[float, list[FitData]], numbers: RockNumbers) -> float:
    """Less the mean logarithm of the likelihood of true heights."""
    total, count = 0.0, 0
    for part in (part for parts in data.values() for part in parts):
        height, sigma = measure_heights(part.edges, part.view, numbers)
        real = np.abs(np.log(np.maximum(part.true, 1e-3) / height)) < math.log(FIT_RATIO)
        pull = ((height - part.true) / sigma)[real]
        total += float(np.sum(np.log(sigma[real]) + 0.5 * np.minimum(pull**2, 9.0)))
        count += int(real.sum())
    return total / max(count, 1)


def fit_rule(data: dict[float, list[FitData]], numbers: RockNumbers) -> RockNumbers:
    """The logistic rule of each Sun, and the chance from which on rocks are listed."""
    weights = []
    for parts in data.values():
        features = np.concatenate([part.edges.features for part in parts])
        rock = np.concatenate([part.true > 0.0 for part in parts])
        weights.append(tuple(round(float(w), 3) for w in fit_weights(features, rock)))
    numbers = msgspec.structs.replace(
        numbers, sun_elevation_deg=tuple(data), weights=tuple(weights)
    )
    least = tuple(_choose_chance(sun, parts, numbers) for sun, parts in data.items())
    return msgspec.structs.replace(numbers, least_chance=least)


def _choose_chance(sun_deg: float, parts: list[FitData], numbers: RockNumbers) -> float:
    """The chance from which on few of the listed edges are none of rocks."""
    listed = []
    for part in parts:
        height, sigma = measure_heights(part.edges, part.view, numbers)
        kept = height + sigma >= ROCK_M
        chance = rate_edges(part.edges.features, sun_deg, numbers)
        listed.append(np.stack([chance, part.true > SMALL_M])[:, kept])
    chance, right = np.concatenate(listed, axis=1)
    tried = np.arange(0.1, MAX_CHANCE + 0.01, 0.05)
    false = [float(np.mean(right[chance >= least] == 0.0)) for least in tried]
    good = [least for least, share in zip(tried, false) if share <= MAX_FALSE]
    return round(float(min(good) if good else tried[-1]), 2)


def fit_weights(features: FloatArray, rock: BoolArray) -> FloatArray:
    """Weights (1 + features) of the logistic rule, the first its constant."""
    grid = np.column_stack([np.ones(len(features)), features])
    sign = np.where(rock, 1.0, -1.0)

    def misfit(weights: FloatArray) -> tuple[float, FloatArray]:
        odds = sign * (grid @ weights)
        slope = -sign * expit(-odds)
        value = float(np.mean(np.logaddexp(0.0, -odds)) + DECAY * weights @ weights)
        return value, grid.T @ slope / len(grid) + 2.0 * DECAY * weights

    found: FloatArray = minimize(misfit, np.zeros(grid.shape[1]), jac=True, method="L-BFGS-B").x
    return found


def format_section(numbers: RockNumbers) -> str:
    """The section as it stands in configs/models/hazard.toml."""
    lines = ["[rocks]"]
    for key in numbers.__struct_fields__:
        value = getattr(numbers, key)
        if key == "weights":
            lines += ["weights = [", *(f"    {list(row)}," for row in value), "]"]
        else:
            lines.append(f"{key} = {list(value) if isinstance(value, tuple) else value}")
    return "\n".join(lines)


ASKED = 90.0, 5.0  # found in per cent, and false of 100 listed, from 100 m under a Sun of 20 deg
CRATER_TABLES = size_table, density_table, variance_table


def report(result: RockFigures) -> StudyReport:
    """Tables of the rocks that are found, of their law and shadows, and of craters."""
    return StudyReport(
        (_rock_table(result), _law_table(), _shadow_table(), *(table() for table in CRATER_TABLES)),
        (*([result.fitted] if result.fitted else []),),
    )


def _rock_table(result: RockFigures) -> StudyTable:
    rows = []
    for case, score in result.cases.items():
        found = score.sizes.sum(axis=0)
        shares = [100.0 * part[1] / part[0] if part[0] else None for part in (found, *score.sizes)]
        ratios = np.array(score.ratios).reshape(-1, 2)
        error = np.quantile(ratios[:, 0], [0.16, 0.5, 0.84]) if len(ratios) > 2 else [None] * 3
        pull = float(np.median(ratios[:, 1] ** 2) / 0.455) if len(ratios) > 2 else None
        listed = max(score.listed, 1)
        rows.append(
            (
                case.kind, case.sun_deg, case.height_m, 100.0 * case.share, int(found[0]), *shares,
                score.listed, *((100.0 * n / listed if score.listed else None)
                                for n in (score.false, score.small)),
                *(ASKED if case[1:] == (20.0, SHARE, HEIGHT_M) else (None, None)),
                error[1], None if error[0] is None else 0.5 * (error[2] - error[0]), pull,
                score.reason,
            )
        )  # fmt: skip
    return StudyTable(
        f"Rocks above {100 * ROCK_M:g} cm by their shadows, {CAMERA}, {result.fields} fields each",
        columns(
            "ground; sun = Sun [deg] .0f; camera = height [m] .0f; share = rocks cover [%] .0f;"
            "rocks .0f; found [%] .1f; found_40 = 30-40 cm [%] .1f; found_60 = 40-60 cm [%] .1f;"
            "found_over = above [%] .1f; listed .0f; false = false of 100 .1f;"
            "small = 15-30 cm of 100 .1f; found_asked = found: asked [%] .0f;"
            "false_asked = false: asked .0f; ratio = height told / true .2f; scatter .2f;"
            "chi = (error / sigma)² .2f; reason = why not"
        ),
        tuple(rows),
    )


SURVEYOR_I = 0.00234, 2.11  # rocks above D m per m^2, and the power


def _law_table() -> StudyTable:
    """Rocks of the law by what covers the ground, and of a published site."""
    sizes = np.array([0.3, 0.5, 1.0])
    rows = [(f"law, {100 * k:g} %", *(100.0 * count_rocks(k, sizes))) for k in (0.02, 0.05, 0.1)]
    rows.append(("Surveyor I", *(100.0 * SURVEYOR_I[0] * sizes ** -SURVEYOR_I[1])))
    return StudyTable(
        "Rocks on 100 m² above a diameter",
        columns("ground; " + "; ".join(f"above_{round(100 * d)} = {d:g} m .2f" for d in sizes)),
        tuple(rows),
    )


def _shadow_table() -> StudyTable:
    """Area of rocks of which the shadows cover 10 % of the ground."""
    rows: list[tuple[Any, ...]] = []
    for sun, source in ((20.0, 3.0), (5.0, 1.0)):
        # a disc as tall as it is wide: shadow d * d / tan e, area pi / 4 d^2
        upright = 10.0 * 0.25 * math.pi * math.tan(math.radians(sun))
        rows.append((sun, source, upright, 10.0 * measure_shadow_ratio(sun)))
    return StudyTable(
        "Area under rocks [%] whose shadows cover 10 % of the ground",
        columns(
            "sun = Sun [deg] .0f; source .1f; upright = as tall as wide .1f;drawn = as drawn .1f"
        ),
        tuple(rows),
    )
