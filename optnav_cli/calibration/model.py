"""What the numbers of a camera's calibration change: pixels by its lens, statements by its clock.

The mounting turns the camera from what attitudes state. The clock's offset says how much later a
picture was taken than its time states: the ship had gone on, and had turned. Also the config: how
wide the search is, and what is known of a camera before.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import msgspec
import numpy as np
from msgspec import Meta
from scipy.spatial.transform import Rotation

from catalog.arrays import FloatArray
from catalog.config import load_toml
from catalog.geometry.rotations import ARCSEC
from optnav_cli.estimation.models.common import (
    AdjustableCamera,
    Common,
    CommonNumber,
    CommonState,
    common_numbers,
)
from optnav_cli.estimation.models.points import Pose, predict

K1_STEP = 1e-5  # pixels are linear in k1: any small step serves
MAX_GAP_S = 120.0  # between neighbours: beyond, a parabola errs by metres a second
# A variance that is so many times that for known others: the number is not told from them.
MAX_INFLATION = 100.0
JOINS_INFLATION, JOINS_CORRELATION = 10.0, 0.4  # what belongs to the same direction
TIED_CORRELATION = 0.95
Wide = Annotated[float, Meta(gt=0.0, le=1e6)]


class SearchSettings(msgspec.Struct, forbid_unknown_fields=True, frozen=True):
    """Widening of the search for control points, for a camera that is not as stated.

    position_m, attitude_arcsec  1 sigma beside those of frames.csv
    """

    position_m: Wide = 2000.0
    attitude_arcsec: Wide = 600.0


class CalibrationPriors(msgspec.Struct, forbid_unknown_fields=True, frozen=True):
    """1 sigma of what the camera file states: wider than any honest error by default."""

    focal_percent: Wide = 5.0
    centre_px: Wide = 100.0
    distortion_k1: Wide = 0.1
    mounting_arcsec: Wide = 3600.0
    clock_s: Wide = 2.0

    def get_sigma(self, kind: Common) -> float:
        """Get a prior's sigma in the unit of the state."""
        return {
            Common.FOCAL: 1e-2 * self.focal_percent,
            Common.CENTRE: self.centre_px,
            Common.DISTORTION: self.distortion_k1,
            Common.MOUNTING: self.mounting_arcsec * ARCSEC,
            Common.CLOCK: self.clock_s,
        }[kind]


class CalibrateSettings(msgspec.Struct, forbid_unknown_fields=True, frozen=True):
    """The whole calibration config."""

    search: SearchSettings = SearchSettings()
    prior: CalibrationPriors = CalibrationPriors()

    def list_numbers(self, kinds: list[Common], cameras: list[str]) -> tuple[CommonNumber, ...]:
        """List the numbers to solve for, with these priors."""
        numbers_in_common = common_numbers(kinds, cameras, 1.0)
        return tuple(
            CommonNumber(n.kind, n.axis, n.camera, self.prior.get_sigma(n.kind))
            for n in numbers_in_common
        )


def load_calibrate_settings(path: Path) -> CalibrateSettings:
    """Load the calibration config of a file. Raises ConfigError for a wrong one."""
    return load_toml(path, CalibrateSettings)


@dataclass(frozen=True, eq=False)
class FrameMotion:
    """Motion of a ship about the time of a picture, body frame.

    velocity_m_s  (3,);  turn_rad_s (3,) angular velocity of the ship, and its camera
    """

    velocity_m_s: FloatArray
    turn_rad_s: FloatArray

    def propagate(
        self, position_m: FloatArray | None, camera_from_body: Rotation | None, seconds: float
    ) -> tuple[FloatArray | None, Rotation | None, FloatArray, FloatArray]:
        """Propagate position and attitude by some time; return their rates, too.

        The change of the attitude is a rotation vector in the camera frame, rad/s.
        """
        position = None if position_m is None else position_m + self.velocity_m_s * seconds
        if camera_from_body is None:
            return position, None, self.velocity_m_s, np.zeros(3)
        # the ship turns by w: what it sees turns the other way
        rate = -camera_from_body.apply(self.turn_rad_s)
        turn = Rotation.from_rotvec(rate * seconds) * camera_from_body
        return position, turn, self.velocity_m_s, rate


def differentiate_lens(
    camera: AdjustableCamera, common: CommonState, pose: Pose, places_m: FloatArray
) -> dict[Common, FloatArray]:
    """Return the change of pixels (n, 2, k) with the numbers of a lens that are solved for.

    camera  with its lens as found so far;  places_m (n, 3) of the points, body frame
    """
    columns: dict[Common, FloatArray] = {}
    if common.places(Common.CENTRE, camera.name).size:
        columns[Common.CENTRE] = np.tile(np.eye(2), (len(places_m), 1, 1))
    if common.places(Common.DISTORTION, camera.name).size:
        sights = pose.camera_from_body.apply(places_m - pose.position_m)
        ends = [
            camera.with_lens(1.0, np.zeros(2), step).project_with_jacobian(sights)[0]
            for step in (K1_STEP, -K1_STEP)
        ]
        columns[Common.DISTORTION] = ((ends[0] - ends[1]) / (2.0 * K1_STEP))[:, :, None]
    return columns


def propagate_ground_errors(
    camera: AdjustableCamera, pose: Pose, places_m: FloatArray, sigma_m: float
) -> FloatArray:
    """Propagate errors of control points' places to covariances (n, 2, 2), px², in the picture.

    sigma_m  1 sigma a component. Each point of a frame errs by itself: its place is a nuisance
             that is eliminated by widening its pixels; what frames share of it is found afterwards
    """
    _, by_pose = predict(camera, pose, places_m)
    by_place = -by_pose[:, :, :3]
    covariances: FloatArray = sigma_m**2 * np.einsum("nia,nja->nij", by_place, by_place)
    return covariances


def estimate_clustered_excess(sums: FloatArray, chance: FloatArray) -> FloatArray:
    """Estimate what the scores of points seen in several frames have beyond chance, (k, k).

    sums  (points, k) scores of each point, summed over its frames
    own   (k, k) what their products would be by chance
    Directions in which there is less than by chance count as chance.
    """
    values, vectors = np.linalg.eigh(chance)
    kept = values > 1e-12 * values.max(initial=0.0)
    root = vectors[:, kept] * np.sqrt(values[kept])
    inverse = vectors[:, kept] / np.sqrt(values[kept])
    ratios, turned = np.linalg.eigh(inverse.T @ (sums.T @ sums) @ inverse)
    back = root @ turned
    excess: FloatArray = back * np.maximum(ratios - 1.0, 0.0) @ back.T
    return excess


def compute_weight_slope(weights: FloatArray) -> float:
    """Compute the ratio of the change of scores with a state to Tukey's weights (n,).

    A larger residual has a smaller weight: along it the score w r changes by 5 w - 4 sqrt(w),
    across it by w. Normal matrices are made of w alone.
    """
    used = weights[weights > 0.0]
    if not used.size:
        return 1.0
    return max(float((3.0 * used - 2.0 * np.sqrt(used)).sum() / used.sum()), 0.5)


def estimate_frame_motions(
    times_s: Sequence[float], positions_m: Sequence[FloatArray | None]
) -> list[FrameMotion | None]:
    """Estimate the motion about each frame; None where two neighbours near in time are missing.

    times_s      of the frames, in any order
    positions_m  (3,) as stated, body frame; None where not
    """
    order = [int(n) for n in np.argsort(times_s, kind="stable") if positions_m[n] is not None]
    motions: list[FrameMotion | None] = [None] * len(times_s)
    for here, number in enumerate(order):
        near = _find_neighbours(order, here, times_s)
        if len(near) < 3:
            continue
        after = np.array([times_s[n] - times_s[number] for n in near])
        places = np.array([positions_m[n] for n in near], dtype=np.float64)
        velocity = np.linalg.solve(np.vander(after, 3, increasing=True), places)[1]
        position = np.asarray(positions_m[number], dtype=np.float64)
        motions[number] = FrameMotion(
            velocity, np.cross(position, velocity) / float(position @ position)
        )
    return motions


def _find_neighbours(order: Sequence[int], here: int, times_s: Sequence[float]) -> list[int]:
    """Find three frames about one without a gap between them; fewer where there are not so many."""
    for first in (here - 1, here - 2, here):
        if first < 0 or first + 3 > len(order):
            continue
        chosen = list(order[first : first + 3])
        gaps = np.diff([times_s[n] for n in chosen])
        if gaps.min() > 0.0 and gaps.max() <= MAX_GAP_S:
            return chosen
    return []


@dataclass(frozen=True)
class Direction:
    """Numbers (their places) that move the picture in the same way; a pair has a correlation.

    moves_px  1 sigma of what they do to the picture together; None where that is not one shift
    """

    places: tuple[int, ...]
    labels: tuple[str, ...]
    correlation: float | None = None
    moves_px: float | None = None

    def describe(self) -> str:
        """Describe for people."""
        names = f"{', '.join(self.labels[:-1])} and {self.labels[-1]}"
        if self.correlation is None:
            return (
                f"{names} cannot be told apart: fly at several heights, or turn the camera about "
                "its boresight"
            )
        moved = (
            "" if self.moves_px is None else f"; together they move it by {self.moves_px:.2g} px"
        )
        return f"{names} move the picture alike (correlation {self.correlation:.3f}){moved}"


def find_inseparable(numbers: Sequence[CommonNumber], covariance: FloatArray) -> list[Direction]:
    """Find directions in which the frames observe only a combination of several numbers."""
    inflation, correlation = _compute_inflation(covariance)
    left = [k for k in range(len(numbers)) if inflation[k] > MAX_INFLATION]
    directions = []
    while left:
        group = {left[0]}
        for k in range(len(numbers)):
            if numbers[k].camera != numbers[left[0]].camera or inflation[k] < JOINS_INFLATION:
                continue
            if any(abs(correlation[k, j]) > JOINS_CORRELATION for j in [*group]):
                group.add(k)
        left = [k for k in left if k not in group]
        if len(group) > 1:
            places = tuple(sorted(group))
            directions.append(Direction(places, tuple(numbers[k].label for k in places)))
    return directions


def find_tied_pairs(
    numbers: Sequence[CommonNumber], covariance: FloatArray, focal_px: dict[str, float]
) -> list[Direction]:
    """Find pairs of numbers whose errors nearly cancel in the picture."""
    _, correlation = _compute_inflation(covariance)
    pairs = []
    for i in range(len(numbers)):
        for j in range(i + 1, len(numbers)):
            if abs(correlation[i, j]) < TIED_CORRELATION:
                continue
            labels = numbers[i].label, numbers[j].label
            moved = _propagate_to_picture(
                numbers[i], numbers[j], covariance[np.ix_([i, j], [i, j])], focal_px
            )
            pairs.append(Direction((i, j), labels, float(correlation[i, j]), moved))
    return pairs


def _compute_inflation(covariance: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Compute the inflation of each variance by the other numbers, and the correlations (k, k)."""
    sigmas = np.sqrt(np.diag(covariance))
    correlation: FloatArray = covariance / np.outer(sigmas, sigmas)
    return np.diag(np.linalg.inv(correlation)), correlation


def _propagate_to_picture(
    first: CommonNumber, second: CommonNumber, covariance: FloatArray, focal_px: dict[str, float]
) -> float | None:
    """Propagate a shift of the principal point and a turn of the mounting to the picture, px."""
    if (first.kind, second.kind) != (
        Common.CENTRE,
        Common.MOUNTING,
    ) or first.camera != second.camera:
        return None
    # a turn about y moves what is seen along x by f, one about x along y by -f
    sides = {("x", "y"): 1.0, ("y", "x"): -1.0}
    if (first.axis, second.axis) not in sides:
        return None
    effect = np.array([1.0, sides[first.axis, second.axis] * focal_px[first.camera]])
    return float(np.sqrt(effect @ covariance @ effect))
