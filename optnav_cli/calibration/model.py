"""What the numbers of a camera's calibration change: pixels by its lens, statements by its clock.

The mounting turns the camera from what attitudes state. The clock's offset says how much later a
picture was taken than its time states: the ship had gone on, and had turned.
"""

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from catalog.arrays import FloatArray
from optnav_cli.estimation.models.common import AdjustableCamera, Common, CommonState
from optnav_cli.estimation.models.points import Pose, predict

K1_STEP = 1e-5  # pixels are linear in k1: any small step serves


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
