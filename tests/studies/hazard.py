"""How safe the pads of a hazard map are, and whether their stated danger is that which is found.

Fields of synthetic ground are drawn by Hapke's law with their shadows under a Sun of 20 and 5 deg
from any azimuth, mapped by both methods, and judged by the slopes of a model of 2 m. The numbers of
configs/models/hazard.toml are fitted (--fit) on other fields than those that are judged.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from itertools import product
from typing import Any

import msgspec
import numpy as np
from scipy.optimize import minimize
from scipy.special import ndtr

from catalog.arrays import BoolArray, Float32Array, FloatArray
from catalog.progress import Progress
from catalog.terrain.slopes import (
    CRITICAL_DEG,
    DANGEROUS_DEG,
    compute_slope_components,
    convert_to_degrees,
)
from optnav_cli.camera.camera_file import preset_camera
from optnav_cli.hazard.ground_view import PictureOnGround, look_down, resize_grid
from optnav_cli.hazard.hazard_map import combine_slopes
from optnav_cli.hazard.pads import Pad, RiskMap, choose_pads, map_variance, rate_slopes
from optnav_cli.hazard.settings import ErrorOfSlopes, HazardModel, load_hazard_model
from optnav_cli.hazard.shading import compute_narrowness, compute_rating_features, map_slopes
from tests.studies.hazard_fields import (
    CELL_M,
    JUDGED_M,
    GroundField,
    field_view,
    make_field,
    perspective_picture,
    true_shares,
)
from tests.studies.hazard_variance import (
    FITTED_SUNS,
    PAD_M,
    SQUARE_M,
    FittedField,
    fit_bounds,
    list_lines,
    make_fitted_field,
)
from tests.studies.tables import StudyReport, StudyTable, columns

PAD_CELLS = 21
STEP = 5  # cells between the pads that expected and found shares are compared of
EDGES = (0.0, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 1.0)
MIN_PADS = 200  # of a bin
FIRST_FIT_SEED, FIT_FIELDS = 101, 4
FIRST_SEED = 201  # of the fields that are judged
FIT_ELEVATIONS = (5.0, 10.0, 20.0, 40.0)
FIT_STEP, NARROW_STEP, FIT_BORDER = 4, 3, 12  # judged nodes
# How pads are chosen: `flatness` and `most_longer` of the model, tried with --fit.
CHOICES = ((0.02, 3.0), (0.1, 3.0), (0.5, 3.0), (2.0, 3.0), (0.5, 1.0), (0.5, 2.0), (0.5, 4.0))
NARROW_CELLS = 410  # a picture from 500 m
NARROW_PARTS = ((0.1, 0.2), (0.3, 0.9), (0.6, 0.5), (0.9, 0.1))  # of the way to the far side
PRIOR_M, PRIOR_ERROR_DEG = 20.0, 1.0
PICTURE_CAMERA, PICTURE_HEIGHT_M, PICTURE_DRAWN_M = "tsnn2_narrow", 500.0, 0.25
PICTURE_NODES = 2000


@dataclass(frozen=True)
class HazardCase:
    """One row: ground, Sun, method and what is unusual about it."""

    kind: str
    elevation_deg: float
    method: str = "shading"
    albedo_rms: float = 0.03
    off_nadir_deg: float = 0.0
    prior: bool = False

    @property
    def label(self) -> str:
        more = []
        if self.albedo_rms != 0.03:
            more.append(f"albedo {self.albedo_rms:.0%}")
        if self.off_nadir_deg:
            more.append(f"{self.off_nadir_deg:g} deg off nadir, across the Sun")
        if self.prior:
            more.append("with a prior of 20 m, 1 deg")
        return ", ".join((self.method, *more))


SUNS = (20.0, 5.0)
CASES = (
    *(
        HazardCase(kind, sun, method)
        for kind in ("rough", "even")
        for method in ("variance", "shading")
        for sun in SUNS
    ),
    *(HazardCase("rough", sun, albedo_rms=0.06) for sun in SUNS),
    *(HazardCase("rough", sun, off_nadir_deg=20.0) for sun in SUNS),
    *(HazardCase("rough", sun, prior=True) for sun in SUNS),
)
# Share above 7 deg that pads by the shipped criterion may have on average, %.
LIMITS = {
    **{HazardCase("rough", sun, "variance"): most for sun, most in ((20.0, 15.0), (5.0, 17.0))},
    **{HazardCase("even", sun, "variance"): 5.5 for sun in SUNS},
}
BINNED = (CASES[2], CASES[3], CASES[6], CASES[7])


@dataclass
class Score:
    """What was found on the pads of a case; sums over fields.

    area     shares above 7 and 15 deg and mean squared slope of the fields
    pads     the same of the chosen pads, one each, with the expected share first
    bins     pads, their expected and their found shares, by the expected one
    """

    squares: int = 0
    area: list[tuple[float, float, float]] = field(default_factory=list)
    pads: list[tuple[float, float, float, float]] = field(default_factory=list)
    bins: FloatArray = field(default_factory=lambda: np.zeros((3, len(EDGES) - 1)))

    def add_area(self, ground: GroundField) -> None:
        squares = float(np.mean(np.nan_to_num(ground.degrees[2:-2, 2:-2]) ** 2))
        shares = ground.share_above(DANGEROUS_DEG), ground.share_above(CRITICAL_DEG)
        self.area.append((*shares, squares))

    def add_pads(
        self, pads: Sequence[Pad], ground: GroundField, truth: dict[str, Float32Array]
    ) -> None:
        """What is found on the pads of a whole field."""
        self.squares += len(pads)
        self.add_area(ground)
        for pad in pads:
            if pad.cell is None:
                continue
            at = round(pad.cell[0]), round(pad.cell[1])
            expected_share = pad.shares.get("expected_dangerous_share", math.nan)
            on = [float(truth[name][at]) for name in ("dangerous", "critical", "squares")]
            self.pads.append((expected_share, on[0], on[1], on[2]))

    def add_bins(self, expected: FloatArray, found: FloatArray) -> None:
        at = np.clip(np.digitize(expected, EDGES) - 1, 0, len(EDGES) - 2)
        for row, values in enumerate((np.ones_like(expected), expected, found)):
            self.bins[row] += np.bincount(at, values, len(EDGES) - 1)


Found = dict[HazardCase, Score]


@dataclass
class HazardFigures:
    """Scores of the cases, and of whole pictures from 500 m by the Sun's elevation.

    flattest  mean squared slope (deg^2) of the flattest pad of each square by the truth, by ground
    """

    cases: Found
    pictures: dict[float, Score]
    flattest: dict[str, list[float]]
    fields: int
    fitted: str = ""
    choices: dict[tuple[HazardCase, float, float], Score] = field(default_factory=dict)


def run(progress: Progress, fields: int = 8, fit: bool = False, rows: str = "") -> HazardFigures:
    """Judge cases on so many fields of each ground; `fit` finds the model's numbers before.

    rows  only cases whose label contains this, without whole pictures; all when empty
    """
    model, text, choices = load_hazard_model(), "", {}
    if fit:
        model = fit_bounds(_fitted_fields(model), fit_model(model, progress))
        text, choices = model_sections(model), judge_choices(model)
    scores: Found = {case: Score() for case in CASES if rows in case.label}
    pictures = {} if rows else {sun: Score() for sun in SUNS}
    flattest: dict[str, list[float]] = {"rough": [], "even": []}
    with progress.stage("hazard", 2 * fields, "field") as bar:
        for kind, best in flattest.items():
            for seed in range(FIRST_SEED, FIRST_SEED + fields):
                ground = make_field(kind, seed)
                truth = true_shares(ground, PAD_CELLS)
                best += flattest_pads(truth["squares"])
                for case in scores:
                    if case.kind == kind:
                        judge(case, ground, truth, model, scores[case])
                if kind == "rough" and pictures:
                    judge_pictures(seed, model, pictures)
                bar.advance()
    return HazardFigures(scores, pictures, flattest, fields, text, choices)


def judge_choices(model: HazardModel) -> dict[tuple[HazardCase, float, float], Score]:
    """The pads of the fields that numbers are fitted on, by how they are chosen."""
    scores = {(case, *choice): Score() for case in BINNED for choice in CHOICES}
    for kind, seed in _fit_fields():
        ground = make_field(kind, seed)
        truth = true_shares(ground, PAD_CELLS)
        for case in BINNED:
            if case.kind != kind:
                continue
            view = field_view(ground, case.elevation_deg)
            slopes = map_slopes(view, model)
            for flatness, longer in CHOICES:
                tried = msgspec.structs.replace(model, flatness=flatness, most_longer=longer)
                risk = rate_slopes(view, slopes, PAD_M, tried)
                pads = choose_pads(view, risk, SQUARE_M)
                scores[case, flatness, longer].add_pads(pads, ground, truth)
    return scores


def flattest_pads(squares: Float32Array) -> list[float]:
    """The least of the mean squared slopes of pads (by their middles) in each square."""
    side, reach = round(SQUARE_M / CELL_M), PAD_CELLS // 2
    many = len(squares) // side
    start = (len(squares) - many * side) // 2
    lows = [start + side * number + reach for number in range(many)]
    wide = side - 2 * reach
    return [float(squares[a : a + wide, b : b + wide].min()) for a in lows for b in lows]


def judge(
    case: HazardCase,
    ground: GroundField,
    truth: dict[str, Float32Array],
    model: HazardModel,
    score: Score,
) -> None:
    """Map one field and add what is found on its pads."""
    view = field_view(ground, case.elevation_deg, case.albedo_rms, case.off_nadir_deg)
    risk = _risk(case, ground, view, model)
    score.add_pads(choose_pads(view, risk, SQUARE_M), ground, truth)
    if case.method == "shading":
        kept = np.isfinite(risk.score)[::STEP, ::STEP]
        expected = risk.shares["expected_dangerous_share"][::STEP, ::STEP][kept]
        found = truth["dangerous"][::STEP, ::STEP][kept]
        score.add_bins(expected.astype(np.float64), found.astype(np.float64))


def _risk(
    case: HazardCase, ground: GroundField, view: PictureOnGround, model: HazardModel
) -> RiskMap:
    if case.method == "variance":
        return map_variance(view, PAD_M, model)
    slopes = map_slopes(view, model)
    if case.prior:
        slopes = combine_slopes(view, slopes, prior_slopes(ground, view), PRIOR_M, model)
    return rate_slopes(view, slopes, PAD_M, model)


def prior_slopes(ground: GroundField, view: PictureOnGround) -> Float32Array:
    """What a map of slopes from orbit, with its error, says at the cells of a view."""
    many = round(PRIOR_M / (CELL_M * view.brightness.shape[0] / len(ground.heights)))
    size = len(ground.heights) // many
    coarse = resize_grid(ground.heights, (size, size))
    padded = np.pad(coarse, 1, mode="reflect", reflect_type="odd")
    degrees = convert_to_degrees(compute_slope_components(padded, PRIOR_M, PRIOR_M, PRIOR_M))[
        1:-1, 1:-1
    ]
    rng = np.random.default_rng([ground.seed, 31])
    degrees = np.abs(degrees + PRIOR_ERROR_DEG * rng.standard_normal(degrees.shape))
    rows, cols = view.brightness.shape
    return resize_grid(degrees.astype(np.float32), (cols, rows))


def judge_pictures(seed: int, model: HazardModel, scores: dict[float, Score]) -> None:
    """Map whole pictures of a camera above the middle of finer ground."""
    ground = make_field("rough", seed, PICTURE_NODES, PICTURE_DRAWN_M)
    camera = preset_camera(PICTURE_CAMERA)
    for elevation, score in scores.items():
        picture = perspective_picture(ground, camera, PICTURE_HEIGHT_M, elevation, PICTURE_DRAWN_M)
        view = look_down(picture, camera, PICTURE_HEIGHT_M, elevation, ground.azimuth_deg())
        risk = rate_slopes(view, map_slopes(view, model), PAD_M, model)
        pads = choose_pads(view, risk, SQUARE_M)
        score.squares += len(pads)
        score.add_area(ground)
        score.pads += pads_below(ground, view, pads)


def pads_below(
    ground: GroundField, view: PictureOnGround, pads: Sequence[Pad]
) -> list[tuple[float, float, float, float]]:
    """Of each pad of a view of the middle of a field, as `Score.pads` has them."""
    found = []
    middle, half = 0.5 * (len(ground.degrees) - 1), round(0.5 * PAD_M / JUDGED_M)
    for pad in pads:
        if pad.cell is None:
            continue
        x, y = (float(value) / JUDGED_M for value in view.xy_m(*pad.cell))
        row, col = round(middle - y + 0.5), round(middle + x + 0.5)
        on = np.nan_to_num(ground.degrees[row - half : row + half, col - half : col + half])
        shares = float((on > DANGEROUS_DEG).mean()), float((on > CRITICAL_DEG).mean())
        expected = pad.shares["expected_dangerous_share"]
        found.append((expected, *shares, float((on**2).mean())))
    return found


def _fit_fields() -> Iterator[tuple[str, int]]:
    """Kinds and seeds of the fields that numbers are fitted on."""
    return product(("rough", "even"), range(FIRST_FIT_SEED, FIRST_FIT_SEED + FIT_FIELDS))


@lru_cache(maxsize=1)
def _fit_data(model: HazardModel) -> dict[float, FloatArray]:
    """Features and truth of cells of the fields that numbers are fitted on, by the Sun."""
    parts: dict[float, list[FloatArray]] = {elevation: [] for elevation in FIT_ELEVATIONS}
    for kind, seed in _fit_fields():
        ground = make_field(kind, seed)
        for elevation in FIT_ELEVATIONS:
            whole = field_view(ground, elevation)
            for part, corner in _parts(whole):
                parts[elevation].append(_features(part, corner, ground, model))
    return {elevation: np.concatenate(rows, axis=1) for elevation, rows in parts.items()}


def _parts(view: PictureOnGround) -> Iterator[tuple[PictureOnGround, tuple[int, int]]]:
    """A view of a field and narrower ones cut out of it, with the cells where they begin."""
    yield view, (0, 0)
    size = len(view.brightness)
    for row, col in NARROW_PARTS:
        first = round(row * (size - NARROW_CELLS)), round(col * (size - NARROW_CELLS))
        place = tuple(slice(at, at + NARROW_CELLS) for at in first)
        cut = np.ascontiguousarray(view.brightness[place])
        yield replace(view, brightness=cut, valid=view.valid[place]), first


def _features(
    view: PictureOnGround, corner: tuple[int, int], ground: GroundField, model: HazardModel
) -> FloatArray:
    """Features, narrowness and true slopes (6, n) of some of a view's cells."""
    many = round(JUDGED_M / CELL_M)
    first = [at // many for at in corner]
    high, wide = (size // many for size in view.brightness.shape)
    true = np.nan_to_num(ground.degrees)[first[0] : first[0] + high, first[1] : first[1] + wide]
    features = compute_rating_features(view, map_slopes(view, model), model)
    # slopes are judged at nodes, each of which is 2 x 2 cells
    grids = [*(resize_grid(part, true.shape[::-1]) for part in features), true]
    step = FIT_STEP if high * many > 2 * NARROW_CELLS else NARROW_STEP
    nodes = np.arange(FIT_BORDER, high - FIT_BORDER, step)
    rows = [grid[np.ix_(nodes, nodes)].ravel().astype(np.float64) for grid in grids]
    rows.insert(4, np.full(rows[0].size, compute_narrowness(view, model)))
    return np.stack(rows)


def _fitted_fields(model: HazardModel) -> list[FittedField]:
    """Pads of the fields that numbers are fitted on, for the bounds of the variance."""
    fields = []
    for kind, seed in _fit_fields():
        ground = make_field(kind, seed)
        dangerous = true_shares(ground, PAD_CELLS)["dangerous"]
        area = ground.share_above(DANGEROUS_DEG)
        for sun in FITTED_SUNS:
            view = field_view(ground, sun)
            fields.append(make_fitted_field(kind, sun, view, dangerous, area, model))
    return fields


def fit_model(model: HazardModel, progress: Progress) -> HazardModel:
    """The model with its chances of dangerous slopes fitted by maximum likelihood."""
    with progress.stage("fit", 2 * len(FIT_ELEVATIONS), "elevation") as bar:
        data = _fit_data(model)
        parts = {}
        for name, limit in (("dangerous", DANGEROUS_DEG), ("critical", CRITICAL_DEG)):
            terms = []
            for elevation in FIT_ELEVATIONS:
                terms.append(fit_terms(data[elevation], limit))
                bar.advance()
            columns_of = zip(*terms, strict=True)
            parts[name] = ErrorOfSlopes(*(tuple(column) for column in columns_of))
    shading = msgspec.structs.replace(model.shading, sun_elevation_deg=FIT_ELEVATIONS, **parts)
    return msgspec.structs.replace(model, shading=shading)


def chances(terms: FloatArray, data: FloatArray, limit_deg: float) -> FloatArray:
    """How likely slopes (n) are above a limit, by the terms of `ErrorOfSlopes` for one Sun.

    data  (5 or more, n): slope, local and regional rms slopes (tangents), share of shadow,
          narrowness
    """
    slope, local, regional, dark, narrow = data[:5]
    wide = narrow * regional
    sigma = terms[4] + terms[5] * local + terms[6] * dark + terms[8] * wide
    middle = slope - math.tan(math.radians(limit_deg)) * terms[0] + terms[1] * local
    middle += terms[2] * regional + terms[3] * dark + terms[7] * wide
    found: FloatArray = ndtr(middle / np.maximum(sigma, 0.01))
    return found


def misfit(terms: FloatArray, data: FloatArray, above: BoolArray, limit_deg: float) -> float:
    """Less the mean logarithm of the likelihood that slopes are above a limit where they are."""
    chance = np.clip(chances(terms, data, limit_deg), 1e-6, 1.0 - 1e-6)
    return -float(np.mean(np.where(above, np.log(chance), np.log1p(-chance))))


def fit_terms(data: FloatArray, limit_deg: float) -> list[float]:
    """The terms of `ErrorOfSlopes` under which the true slopes are the likeliest.

    data  (6, n): as for `chances`, and the true slopes, deg
    """
    above = data[5] > limit_deg
    start = np.array([1.0, 0.0, 0.0, 0.0, 0.03, 0.0, 0.0, 0.0, 0.0])
    bounds = [(0.2, 4.0), *[(-1.5, 1.5)] * 2, (-0.5, 0.5), (0.01, 0.2), (-0.3, 1.0), (-0.1, 0.5)]
    bounds += [(-1.0, 1.0), (0.0, 1.0)]
    found = minimize(misfit, start, (data, above, limit_deg), method="L-BFGS-B", bounds=bounds)
    return [float(f"{value:.4f}") for value in found.x]


def model_sections(model: HazardModel) -> str:
    """The fitted sections as they stand in configs/models/hazard.toml."""
    lines = [f"sun_elevation_deg = {list(model.shading.sun_elevation_deg)}"]
    for name in ("dangerous", "critical"):
        lines += ["", f"[shading.{name}]"]
        part = getattr(model.shading, name)
        lines += [f"{key} = {list(getattr(part, key))}" for key in part.__struct_fields__]
    return "\n".join([*lines, "", "[variance]", *list_lines(model)])


_COLUMNS = columns(
    "ground; sun = Sun [deg] .0f; method; area_7 = area > 7° [%] .1f; pads_7 = pads > 7° [%] .1f;"
    "expected = expected [%] .1f; area_15 = area > 15° [%] .1f; pads_15 = pads > 15° [%] .2f;"
    "found = squares with a pad [%] .0f; rms = rms slope less by [%] .0f; pads .0f;"
    "pads_limit = limit [%] .1f"
)


def _row(kind: str, sun: float, label: str, score: Score) -> tuple[Any, ...]:
    area, pads = np.array(score.area), np.array(score.pads).reshape(-1, 4)
    rms = 100.0 * (1.0 - math.sqrt(pads[:, 3].mean() / area[:, 2].mean()))
    mean = [100.0 * float(value) for value in (*area.mean(axis=0)[:2], *pads[:, :3].mean(axis=0))]
    found = 100.0 * len(pads) / score.squares
    return (kind, sun, label, mean[0], mean[3], mean[2], mean[1], mean[4], found, rms, len(pads))


def report(result: HazardFigures) -> StudyReport:
    """Tables of the pads, and of expected against found shares."""
    rows = [
        (*_row(case.kind, case.elevation_deg, case.label, score), LIMITS.get(case))
        for case, score in result.cases.items()
    ]
    label = f"{PICTURE_CAMERA}, {PICTURE_HEIGHT_M:g} m"
    rows += [(*_row("rough", sun, label, score), None) for sun, score in result.pictures.items()]
    first = StudyTable(
        f"Pads of {PAD_M:g} m in squares of {SQUARE_M:g} m, {result.fields} fields of each ground",
        _COLUMNS,
        tuple(rows),
    )
    second = StudyTable(
        "Expected and found shares above 7 deg of all pads that are not refused",
        columns(
            "ground; sun = Sun [deg] .0f; bin = expected; expected = its mean .3f;"
            "found .3f; difference = found - expected +.3f; pads .0f"
        ),
        tuple(_bin_rows(result.cases)),
    )
    notes = (
        _flattest_note(result),
        "variance is the paper's criterion, whose percentages (12-15 % of 38 %, 3 % of 16 %) come "
        "from one real model of 2 m.",
    )
    if not result.fitted:
        return StudyReport((first, second), notes)
    return StudyReport((first, second, _choices(result)), (*notes, result.fitted))


def _choices(result: HazardFigures) -> StudyTable:
    rows = []
    for (case, flatness, longer), score in result.choices.items():
        row = _row(case.kind, case.elevation_deg, "", score)
        rows.append((*row[:2], flatness, longer, row[4], row[7], row[9], row[10]))
    return StudyTable(
        "How pads are chosen, on the fields that the numbers are fitted on",
        columns(
            "ground; sun = Sun [deg] .0f; flatness .2f; longer = most_longer .0f;"
            "pads_7 = pads > 7° [%] .1f; pads_15 = pads > 15° [%] .2f;"
            "rms = rms slope less by [%] .1f; pads .0f"
        ),
        tuple(rows),
    )


def _flattest_note(result: HazardFigures) -> str:
    parts = []
    for kind, best in result.flattest.items():
        area = next((s.area for case, s in result.cases.items() if case.kind == kind), None)
        if area is None:
            continue
        ratio = math.sqrt(float(np.mean(best) / np.mean([squares for _, _, squares in area])))
        parts.append(f"{1.0 - ratio:.0%} on {kind} ground")
    return (
        "The flattest pad of each square, chosen by the true slopes, has a rms slope less by "
        f"{' and '.join(parts)}: no method can reach more."
    )


def _bin_rows(scores: Found) -> Iterator[tuple[Any, ...]]:
    for case in BINNED:
        if case not in scores:
            continue
        count, expected, found = scores[case].bins
        for number in range(len(EDGES) - 1):
            if count[number] >= MIN_PADS:
                means = expected[number] / count[number], found[number] / count[number]
                words = f"{EDGES[number]:g}-{EDGES[number + 1]:g}"
                yield (
                    *(case.kind, case.elevation_deg, words),
                    *(*means, means[1] - means[0], int(count[number])),
                )
