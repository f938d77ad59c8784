"""One control point searched in a picture: window into map projection, reference, correlation."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from catalog.arrays import Float32Array, FloatArray, IntArray
from catalog.correlation.filters import (
    choose_thinning,
    crop,
    downsample_blurred,
    filter_grid_quickly,
    filter_low_pass,
    measure_edges,
)
from catalog.correlation.ncc import (
    add_remainder_covariance,
    cut_match,
    match_cut,
    match_ncc,
)
from catalog.correlation.peak import NODES_PER_SAMPLE, Match
from catalog.correlation.relief_albedo import (
    ReliefAlbedo,
    ReliefMatch,
    make_relief_match,
    make_relief_patterns,
)
from catalog.correlation.similarity import (
    Matcher,
    find_best_pair,
    match_similarity,
    rotate_and_scale,
)
from catalog.geometry.kernel import kernel
from optnav_cli.camera.camera import Camera
from optnav_cli.control_points.picture_pyramid import (
    PicturePyramid,
    average_as_seen,
    get_blur_px,
    is_ground_shown,
)
from optnav_cli.control_points.reference import Reference
from optnav_cli.control_points.search_plan import NO_DISTORTION, SearchPlan
from optnav_cli.estimation.models.points import Pose
from optnav_cli.reasons import NO_REASON, Reason, ReasonCode, format_distinct

# A reference lit or known over less than this share of its nodes is no picture of a place.
MIN_VALID_SHARE = 0.6
# Nodes of a reference without blur that count as one sample against chance.
CHANCE_NODES_PER_SAMPLE = 6.0
# Rendered beyond the template on every side, so that the high-pass does not end at its border.
MARGIN_NODES = 8

# How strong albedo that follows relief is was measured at nodes of 948 m; of much finer relief
# nothing is known. A catalog's finest patches may have half the posting of its terrain model.
MIN_ALBEDO_POSTING_M, MIN_FINEST_ALBEDO_POSTING_M = 400.0, 200.0


@dataclass(frozen=True)
class MatchGates:
    """When a correlation peak is accepted.

    min_score       correlation at the peak
    rival_ratio     the best rival's score over the peak's must stay below it
    min_strength  correlation times the root of the samples compared, where the frame may cut
    refuse_smooth   whether the picture must show more than smooth brightness and rounding
    """

    min_score: float = 0.5
    rival_ratio: float = 0.9
    min_strength: float = 0.0
    refuse_smooth: bool = False


@dataclass(frozen=True, eq=False)
class SeenPart:
    """The part of a template that the frame shows, where the template may be cut.

    place_m     (3,) body-fixed middle of the part's ground, and pixel (2,) where it was found
    corners_px  (4, 2) of the whole template, in turn
    samples     that were compared, each of which errs for itself
    """

    place_m: FloatArray
    pixel: FloatArray
    corners_px: FloatArray
    samples: float


@dataclass(frozen=True, eq=False)
class AlbedoFit:
    """A match on ground whose albedo may follow its relief, laid out only where that is asked.

    lay     lays the patterns of that albedo; None where they cannot be
    placed  makes the match of a place in the nodes
    """

    lay: Callable[[], ReliefMatch | None]
    placed: Callable[[Match], "PointMatch"]

    @cached_property
    def laid(self) -> ReliefMatch | None:
        """The match with its patterns."""
        return self.lay()


@dataclass(frozen=True, eq=False)
class PointMatch:
    """Where a control point was found, or why not.

    reason          why the match is not used; empty when it is
    pixel           (2,) measured, None when refused before a peak was located
    covariance_px2  (2, 2) of the pixel, from what the match leaves over; behind a blur by its peak
    offset_m        (2,) east and north of the place where the pose expected it
    part            what was compared, of patches finer than what is known
    albedo          where the ground's albedo may follow its relief
    under_albedo    whether it is the match with such albedo fitted
    """

    level: int
    reason: Reason
    pixel: FloatArray | None = None
    covariance_px2: FloatArray | None = None
    offset_m: FloatArray | None = None
    score: float | None = None
    runner_up: float | None = None
    part: SeenPart | None = None
    albedo: AlbedoFit | None = None
    under_albedo: bool = False

    def with_albedo(self, strengths: ReliefAlbedo) -> "PointMatch":
        """Return the match with albedo that follows relief so strongly, where allowed."""
        if self.albedo is None or self.albedo.laid is None:
            return self
        at = self.albedo.laid.apply_albedo(strengths)
        return replace(self.albedo.placed(at), under_albedo=True)


def match_point(
    reference: Reference,
    plan: SearchPlan,
    picture: PicturePyramid,
    camera: Camera,
    pose: Pose,
    sun_body: FloatArray,
    matcher: Matcher,
    gates: MatchGates,
) -> PointMatch:
    """Search a control point about where the pose expects it.

    sun_body (3,) unit vector, body frame
    """
    level, blur_nodes, step = plan.level, plan.blur_nodes, choose_thinning(plan.blur_nodes)
    margin, search_nodes = _compute_borders(plan)
    posting = reference.patches[level].posting_m
    border = search_nodes + margin
    heights = reference.heights(level, plan.template_nodes + 2 * border)
    around = crop(heights, search_nodes)
    sharp = reference.render(level, around, sun_body, pose.position_m)
    refusal = _check_template(crop(sharp, margin) if blur_nodes else sharp)
    if refusal:
        return PointMatch(level, refusal)
    surface = reference.surface(level, heights)
    camera_from_body = pose.turn
    pixels = camera.project_from_body(surface, pose.position_m, camera_from_body)
    window = shown = sampled = picture.sample(pixels, posting / plan.metres_per_pixel)
    if plan.soft_nodes:
        window = filter_low_pass(window, plan.soft_nodes)
    known, _ = _measure_shares(sampled, border)
    # A quarter of a template that the frame may cut must be in it.
    if known < (0.25 if blur_nodes else MIN_VALID_SHARE):
        return PointMatch(level, Reason(ReasonCode.OUTSIDE_FRAME, "outside the frame"))
    lens_px = get_blur_px(camera)
    template = average_as_seen(sharp, pixels, lens_px)
    even = plan.template_nodes % 2 == 0
    if blur_nodes:
        template = downsample_blurred(template, blur_nodes, even)
        window = shown = downsample_blurred(window, blur_nodes, even)
    measure = measure_edges if reference.has_image else np.asarray
    rendered, window = measure(template), measure(window)
    template, match = _match_template(rendered, window, plan, matcher)
    samples, at_nodes = 0.0, match
    if blur_nodes:
        samples = _count_common_nodes(template, window, match) / count_nodes_per_sample(
            blur_nodes / step
        )
        # A template behind a blur of s nodes has few independent samples, too few for a spectrum of
        # what it leaves over. White noise under the blur is correlated over 2 pi s^2 nodes.
        each = 1.0 + 2.0 * np.pi * (blur_nodes / step) ** 2 / NODES_PER_SAMPLE
        spread = match.covariance * each * step**2
        match = match._replace(dx=match.dx * step, dy=match.dy * step, covariance=spread)
    expected = camera.project_from_body(reference.place_m, pose.position_m, camera_from_body)

    def make_match(at: Match) -> PointMatch:
        shift, jacobian = _measure_displacement(pixels, at, plan.template_nodes)
        part = None
        if blur_nodes:
            in_frame = np.isfinite(crop(sampled, border))
            middle = crop(surface, border)[in_frame].mean(axis=0)
            seen = camera.project_from_body(middle, pose.position_m, camera_from_body) + shift
            corners = crop(pixels, border)[[0, 0, -1, -1], [0, -1, -1, 0]] + shift
            part = SeenPart(middle, seen, corners, samples)
        covariance = None
        if np.isfinite(at.covariance).all():
            covariance = jacobian @ at.covariance @ jacobian.T
        reason = _check_match(at, gates, samples)
        offset = np.array([at.dx, -at.dy]) * posting
        scores = at.score, at.runner_up
        return PointMatch(level, reason, expected + shift, covariance, offset, *scores, part)

    point_match = make_match(match)
    if gates.refuse_smooth and not point_match.reason:
        grid = thin_pixels(pixels, blur_nodes, even)
        point_match = _refuse_smooth(
            point_match, rendered, at_nodes, shown, grid, picture.count_step
        )
    least = MIN_ALBEDO_POSTING_M if level else MIN_FINEST_ALBEDO_POSTING_M
    fine = reference.has_image or posting < least
    if point_match.reason or fine or _is_rough(plan) or template is not rendered:
        return point_match

    def fit_patterns() -> ReliefMatch | None:
        patterns = make_relief_patterns(around, posting, sharp)
        seen = np.stack([average_as_seen(each, pixels, lens_px) for each in patterns])
        return make_relief_match(match, template, seen, window, MARGIN_NODES)

    return replace(point_match, albedo=AlbedoFit(fit_patterns, make_match))


def _is_rough(plan: SearchPlan) -> bool:
    return bool(plan.blur_nodes or plan.interim or plan.soft_nodes)


def _compute_borders(plan: SearchPlan) -> tuple[int, int]:
    """Compute the margin of a template and the room of its search, nodes before the thinning."""
    if not plan.blur_nodes:
        return MARGIN_NODES, plan.search_nodes
    step = choose_thinning(plan.blur_nodes)
    # A match behind a blur has room for three of the nodes that are kept on each side.
    room = max(plan.search_nodes, int(np.ceil(3 * step)))
    return int(np.ceil(MARGIN_NODES * step)), room


def thin_pixels(pixels: FloatArray, blur_nodes: float, even: bool) -> FloatArray:
    """Compute where the nodes kept behind a blur lie, from pixels (n, n, 2) of all nodes.

    The pixels are blurred, too: a smooth picture blurred over them has its brightness there.
    """
    if not blur_nodes:
        return pixels
    axes = (downsample_blurred(pixels[..., k].astype(np.float32), blur_nodes, even) for k in (0, 1))
    return np.stack(list(axes), axis=-1).astype(np.float64)


def _refuse_smooth(
    found: PointMatch,
    template: Float32Array,
    match: Match,
    shown: Float32Array,
    pixels: FloatArray,
    count_step: float,
) -> PointMatch:
    """Refuse a match where the picture shows no ground under the template and its margin.

    template (n, n)  and where it was found, in nodes that are kept
    shown (m, m), pixels (m, m, 2)  of the picture on these nodes, and where they lie in it
    """
    laid = cut_match(shown, template, match), cut_match(pixels, template, match)
    if is_ground_shown(*laid, MARGIN_NODES, count_step):
        return found
    return replace(
        found, reason=Reason(ReasonCode.LOW_SCORE, "smooth brightness or rounding alone, no ground")
    )


def count_nodes_per_sample(blur_nodes: float) -> float:
    """Count the nodes per sample against chance.

    White noise under a Gaussian of sigma s is correlated over an area of 2 pi s^2 nodes.
    """
    return CHANCE_NODES_PER_SAMPLE + 2.0 * np.pi * blur_nodes**2


def _match_template(
    template: Float32Array, window: Float32Array, plan: SearchPlan, matcher: Matcher
) -> tuple[Float32Array, Match]:
    """Match a template in a window; return it turned as it fits best, and the match."""
    turns = plan.distortion.rolls, plan.distortion.scales
    remainder = not (plan.blur_nodes or plan.interim)
    if matcher is match_ncc:
        image = filter_grid_quickly(window, MARGIN_NODES)
        if plan.distortion != NO_DISTORTION:
            pair = find_best_pair(template, image, *turns, MARGIN_NODES, halved=True)
            template = rotate_and_scale(template, *pair)
        return template, match_cut(template, window, image, MARGIN_NODES, remainder)
    if plan.distortion == NO_DISTORTION:
        match = matcher(template, window, MARGIN_NODES)
    else:
        match, *turn = match_similarity(template, window, *turns, matcher, MARGIN_NODES)
        template = rotate_and_scale(template, *turn)
    if remainder:
        match = add_remainder_covariance(match, template, window, MARGIN_NODES)
    return template, match


def _count_common_nodes(template: Float32Array, window: Float32Array, match: Match) -> int:
    """Count the nodes of a template without its margin that the window has where it matches."""
    inner = crop(template, MARGIN_NODES)
    border = (window.shape[0] - inner.shape[0]) // 2
    row, col = border + int(np.rint(match.dy)), border + int(np.rint(match.dx))
    seen = window[row : row + inner.shape[0], col : col + inner.shape[1]]
    return int((np.isfinite(inner) & np.isfinite(seen)).sum())


def _check_template(template: Float32Array) -> Reason:
    known, lit = _measure_shares(template, 0)
    if known < MIN_VALID_SHARE:
        return Reason(ReasonCode.NO_TERRAIN, "no terrain data")
    if lit < 0.1 * known:
        return Reason(ReasonCode.IN_SHADOW, "in shadow")
    return NO_REASON


@kernel
def _measure_shares(grid: Float32Array, margin: int) -> tuple[float, float]:
    """Measure the shares of a grid's nodes inside a margin that are finite and above zero."""
    rows, cols = grid.shape
    known = lit = 0
    for r in range(margin, rows - margin):
        for c in range(margin, cols - margin):
            known += np.isfinite(grid[r, c])
            lit += grid[r, c] > 0.0
    nodes = max((rows - 2 * margin) * (cols - 2 * margin), 1)
    return known / nodes, lit / nodes


def _check_match(match: Match, gates: MatchGates, samples: float) -> Reason:
    score = match.score
    if not np.isfinite(match.covariance).all():
        return Reason(ReasonCode.SEARCH_BORDER, "peak at the border of the search")
    if score < gates.min_score:
        low, wanted = format_distinct(score, gates.min_score, 2)
        return Reason(ReasonCode.LOW_SCORE, f"score {low} below {wanted}")
    # samples are counted behind a blur only
    if samples and score * np.sqrt(samples) < gates.min_strength:
        low, wanted = format_distinct(score, gates.min_strength / np.sqrt(samples), 2)
        text = f"score {low} below {wanted} over {samples:.0f} samples"
        return Reason(ReasonCode.LOW_SCORE, text)
    if match.runner_up > gates.rival_ratio * score:
        return Reason(ReasonCode.RIVAL, f"rival {match.runner_up:.2f} near score {score:.2f}")
    return NO_REASON


def _measure_displacement(
    pixels: FloatArray, match: Match, template_nodes: int
) -> tuple[FloatArray, FloatArray]:
    """Measure the match's offset (2,), px, from the expected pixel, and its derivative (2, 2).

    pixels (size, size, 2) of the window's nodes. A match is the agreement of a whole template, so
    its displacement is that of the template's mean place: the height of the one node in the middle
    must not matter, least of all at coarse levels, which flatten a crest.
    """
    border = (pixels.shape[0] - template_nodes) // 2
    most = 2.0 * border - 1e-9
    col, row = (min(max(border + float(by), 0.0), most) for by in (match.dx, match.dy))
    c, r = int(col), int(row)
    u, v = col - c, row - r
    # upper left corners: four blocks about the match, and the expected one with its neighbours
    top = np.array([r, r, r + 1, r + 1, border, border, border, border - 1, border + 1])
    left = np.array([c, c + 1, c, c + 1, border, border - 1, border + 1, border, border])
    mean = _average_blocks(np.ascontiguousarray(pixels), top, left, template_nodes)
    weights = np.array([(1 - v) * (1 - u), (1 - v) * u, v * (1 - u), v * u])
    slopes = np.stack([mean[6] - mean[5], mean[8] - mean[7]], axis=-1) / 2.0
    return weights @ mean[:4] - mean[4], slopes


@kernel
def _average_blocks(pixels: FloatArray, top: IntArray, left: IntArray, side: int) -> FloatArray:
    """Average pixels (k, 2) over square blocks of a window (n, n, 2) without NaN."""
    size = pixels.shape[0]
    # sums along a row from its begin on, of which a block's is a difference
    along, sums = np.zeros((size + 1, 3)), np.zeros((top.size, 3))
    for i in range(top.min(), top.max() + side):
        sum_x = sum_y = known = 0.0
        for j in range(size):
            x, y = pixels[i, j, 0], pixels[i, j, 1]
            if np.isfinite(x):
                sum_x += x
                sum_y += y
                known += 1.0
            along[j + 1, 0], along[j + 1, 1], along[j + 1, 2] = sum_x, sum_y, known
        for n in range(top.size):
            if top[n] <= i < top[n] + side:
                for k in range(3):
                    sums[n, k] += along[left[n] + side, k] - along[left[n], k]
    means = np.empty((top.size, 2))
    for n in range(top.size):
        means[n, 0], means[n, 1] = sums[n, 0] / sums[n, 2], sums[n, 1] / sums[n, 2]
    return means
