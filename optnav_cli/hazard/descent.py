"""A descent from frame to frame: poses refined by windows, pads carried with their covariance.

The frames of a navigated run come in the order of time. Each is laid on the ground by its pose,
which windows of the terrain model refine where the picture shows enough of its postings, and then
windows of the frame before. Pads are followed to nearer frames with the covariance of their places.
"""

import logging
import math
from functools import partial

import numpy as np

from catalog.arrays import FloatArray
from catalog.errors import NoSolutionError
from optnav_cli.camera.camera import Camera
from optnav_cli.fix import Solution
from optnav_cli.frames.folder import Folder
from optnav_cli.frames.picture import Picture, load_frame_picture
from optnav_cli.hazard.ground_view import Heights, KnownPose, PictureOnGround, look_from
from optnav_cli.hazard.hazard_map import HazardMap, PriorSlopes, map_hazard
from optnav_cli.hazard.output import MappedFrame
from optnav_cli.hazard.pads import CarriedPad
from optnav_cli.hazard.registration import (
    MAX_REACH,
    Reference,
    UncertainPose,
    coarsen_view,
    compute_place_jacobian,
    draw_terrain,
    make_grid,
    match_windows,
    refine_pose,
    sample_ground,
)
from optnav_cli.hazard.settings import HazardSettings, load_hazard_model

log = logging.getLogger(__name__)

MIN_POSTINGS = 28  # that a picture must show along a side: four windows of 14
# How far the craft still reaches, over its height: squares of 200 m are the source's at 500 m.
REACH = 0.2
PASSES = 2  # of laying the picture on the ground anew by the refined pose


class Descent:
    """Frames of a descent that were mapped, and the pads that are carried along.

    heights  of the ground, by latitudes and longitudes; None: the body's sphere
    prior    slopes of the terrain model or of a slope map
    """

    def __init__(
        self,
        folder: Folder,
        heights: Heights | None,
        settings: HazardSettings,
        prior: PriorSlopes | None,
        posting_m: float | None = None,
    ) -> None:
        self._folder, self._heights, self._settings = folder, heights, settings
        self._prior, self._posting_m = prior, posting_m
        self._last: tuple[HazardMap, UncertainPose] | None = None
        self.pads: list[CarriedPad] = []

    def map_frame(self, frame: MappedFrame, solution: Solution) -> None:
        """Map a frame by its refined pose and carry the pads to it.

        Raises NoSolutionError with the reason why not, DataError for its picture.
        """
        row, camera = frame.row, frame.camera
        fix = solution.fix
        if row is None or row.problem or camera is None:
            raise NoSolutionError("has no usable row in frames.csv", "bad_row")
        if fix is None:
            words = f"is not solved: {solution.outcome.reason.text}"
            raise NoSolutionError(words, "no_pose")
        turn = fix.camera_from_body or row.camera_from_body
        if turn is None or row.sun_body is None:
            raise NoSolutionError("the run states no attitude or Sun for it", "no_pose")
        frame.picture = load_frame_picture(self._folder.path, row.file, camera)
        for remark in frame.picture.remarks:
            log.warning("%s", remark)
        radius_m = self._folder.body.radius_m
        pose = KnownPose(fix.position_m, turn, row.sun_body, radius_m)
        sigma = fix.attitude_sigma_rad
        sigma = row.attitude_sigma_rad if sigma is None else sigma
        ground_m = self._settings.ground_sigma_m
        given = UncertainPose.make(pose, fix.covariance_m2, sigma or 0.0, ground_m)
        view, refined = self._refine(frame.picture, camera, given)
        earlier = None if self._last is None else self._last[0]
        ground = self._raise_ground(refined)
        look = partial(look_from, frame.picture, camera, refined.pose, ground)
        frame.mapped = map_hazard(view, self._settings, self._prior, earlier, look)
        self.pads = carry_pads(
            self.pads, frame.file, frame.mapped, refined, self._settings, self._heights
        )
        self._last = frame.mapped, refined

    def describe(self) -> str:
        """Describe the pads in a line for people."""
        kept = [pad for pad in self.pads if not pad.reason]
        if not kept:
            return "no pad is left"
        sigmas = [math.sqrt(0.5 * float(np.trace(pad.covariance))) for pad in kept]
        last = max(pad.n_seen for pad in kept)
        return (
            f"{len(kept)} of {len(self.pads)} carried pads are left, the longest over {last} "
            f"pictures; median sigma {float(np.median(sigmas)):.2f} m per axis"
        )

    def _refine(
        self, picture: Picture, camera: Camera, given: UncertainPose
    ) -> tuple[PictureOnGround, UncertainPose]:
        """Lay a picture on the ground and refine its pose by all references that there are."""
        view = look_from(picture, camera, given.pose, self._raise_ground(given))
        for make in (self._draw_terrain, self._sample_last):
            best = given
            for _ in range(PASSES):
                reference = make(view, best)
                if reference is None:
                    break
                reach = _measure_reach(view, best, reference.step_m)
                matches = match_windows(view, reference, reach)
                refined = refine_pose(given, best, view, matches, reference)
                if refined is None:
                    break
                best = refined
                view = look_from(picture, camera, best.pose, self._raise_ground(best))
            given = best
        return view, given

    def _raise_ground(self, pose: UncertainPose) -> Heights | float:
        """Return the heights of the ground as a pose has found them."""
        heights, raised_m = self._heights, pose.raised_m
        if heights is None:
            return raised_m
        return lambda lat, lon: heights(lat, lon) + np.float32(raised_m)

    def _draw_terrain(self, view: PictureOnGround, pose: UncertainPose) -> Reference | None:
        """Draw the terrain model at half its postings; None where the picture shows too few."""
        if self._heights is None or self._posting_m is None:
            return None
        step_m = max(0.5 * self._posting_m, view.cell_m)
        if min(view.brightness.shape) * view.cell_m < MIN_POSTINGS * 2.0 * step_m:
            return None
        margin = _measure_margin(view, pose, np.zeros((2, 2)), step_m)
        bright = draw_terrain(view, self._heights, step_m, margin, self._folder.body.radius_m)
        numbers = load_hazard_model().registration
        (east, north), covariance = numbers.compute_shift(view.sun, self._posting_m)
        coarse = coarsen_view(view, step_m)
        return Reference(bright, *coarse, step_m, margin, covariance, True, (east, north))

    def _sample_last(self, view: PictureOnGround, pose: UncertainPose) -> Reference | None:
        """Sample the ground of the frame before."""
        if self._last is None:
            return None
        mapped, then = self._last
        foot = mapped.view.placed.xy_from_latlon(view.placed.lat, view.placed.lon)
        covariance = then.compute_place_covariance(mapped.view, *(float(at) for at in foot))
        step_m = max(view.cell_m, mapped.view.cell_m)
        margin = _measure_margin(view, pose, covariance, step_m)
        x, y = make_grid(view, step_m, margin)
        bright = sample_ground(mapped.view.brightness, mapped.view.valid, mapped.view, x, y, view)
        return Reference(bright, *coarsen_view(view, step_m), step_m, margin, covariance, False)


def _measure_margin(
    view: PictureOnGround, pose: UncertainPose, covariance: FloatArray, step_m: float
) -> int:
    """Measure the nodes that a view may be off its reference, its corners further: 3 sigma."""
    total = pose.compute_place_covariance(view, 0.0, 0.0) + covariance
    widest = math.sqrt(float(np.linalg.eigvalsh(total)[-1]))
    common = math.ceil(3.0 * widest / step_m) + 6
    return min(common + _measure_reach(view, pose, step_m), MAX_REACH)


def _measure_reach(view: PictureOnGround, pose: UncertainPose, step_m: float) -> int:
    """Measure the nodes that windows at the corners may be off the shift of the middle."""
    rows, cols = view.brightness.shape
    corner = 0.5 * view.cell_m * np.array([[cols, rows], [-cols, rows], [0.0, 0.0]])
    moved = compute_place_jacobian(view, pose.pose, corner)
    apart = moved[:2] - moved[2]
    total = apart @ pose.covariance @ np.swapaxes(apart, 1, 2)
    widest = math.sqrt(max(float(np.linalg.eigvalsh(each)[-1]) for each in total))
    return min(math.ceil(3.0 * widest / step_m) + 2, 30)


def carry_pads(
    pads: list[CarriedPad],
    file: str,
    mapped: HazardMap,
    pose: UncertainPose,
    settings: HazardSettings,
    heights: Heights | None = None,
) -> list[CarriedPad]:
    """Follow pads in a nearer frame, each to the best place that the craft still reaches.

    A pad that the frame does not show whole stays as it is; one whose surroundings are all refused
    is given up. Squares that a frame shows whole and that have no pad get one. Returns all pads;
    those of `pads` are changed.

    heights  of the ground; None: one level, that of the view
    """
    view, risk = mapped.view, mapped.risk
    projection = view.placed
    half_m = 0.5 * settings.square_m
    reach_m = min(max(REACH * float(view.camera_m[2]), 0.5 * settings.pad_m), half_m)
    reach = max(1, round(reach_m / view.cell_m / risk.step))
    score = risk.score.copy()
    rows, cols = view.brightness.shape
    taken: list[tuple[float, float]] = []
    for pad in pads:
        x, y = (float(part) for part in projection.xy_from_latlon(*pad.centre[:2]))
        cell = 0.5 * (rows - 1) - y / view.cell_m, x / view.cell_m + 0.5 * (cols - 1)
        taken.append(cell)
        at = [round((part - risk.origin) / risk.step) for part in cell]
        if pad.reason or not all(0 <= a < size for a, size in zip(at, score.shape)):
            continue
        if risk.refused["not whole in the picture"][at[0], at[1]]:
            continue
        top, left = (max(a - reach, 0) for a in at)
        part = score[top : at[0] + reach + 1, left : at[1] + reach + 1]
        best = np.unravel_index(int(np.argmin(part)), part.shape)
        if not np.isfinite(part[best]):
            pad.reason = f"{file}: all places within {reach_m:.3g} m are refused"
            continue
        row, col = top + int(best[0]), left + int(best[1])
        shares = {name: float(values[row, col]) for name, values in risk.shares.items()}
        chosen = risk.origin + risk.step * row, risk.origin + risk.step * col
        taken[-1] = chosen
        pad.file, pad.n_seen, pad.shares = file, pad.n_seen + 1, shares
        pad.centre, pad.covariance, pad.pixel = _place_pad(mapped, chosen, pose, heights)
        wide = math.ceil(risk.cells / risk.step)  # pads do not overlap
        score[max(row - wide, 0) : row + wide + 1, max(col - wide, 0) : col + wide + 1] = np.inf
    if pads and min(rows, cols) * view.cell_m < settings.square_m:
        return pads
    added = list(pads)
    apart = half_m / view.cell_m
    for new in mapped.pads:
        middle = new.cell
        if middle is None or any(
            max(abs(a - b) for a, b in zip(middle, cell)) < apart for cell in taken
        ):
            continue
        centre, covariance, pixel = _place_pad(mapped, middle, pose, heights)
        number, shares = len(added) + 1, dict(new.shares)
        pad = CarriedPad(number, file, file, 1, centre, covariance, pixel, shares, centre)
        added.append(pad)
    return added


def _place_pad(
    mapped: HazardMap, cell: tuple[float, float], pose: UncertainPose, heights: Heights | None
) -> tuple[tuple[float, float, float], FloatArray, tuple[float, float]]:
    """Place a pad: latitude, longitude, height; covariance east and north; its pixel."""
    view = mapped.view
    x, y = (float(part) for part in view.xy_m(*cell))
    lat, lon = (float(angle) for angle in view.placed.latlon(x, y))
    level_m = float(np.linalg.norm(pose.pose.position_m)) - pose.pose.radius_m
    height_m = level_m - float(view.camera_m[2])
    if heights is not None:
        height_m = float(np.ravel(heights(np.atleast_1d(lat), np.atleast_1d(lon)))[0])
    covariance = pose.compute_place_covariance(view, x, y)
    return (lat, lon, height_m), covariance, view.find_pixel(*cell)
