"""What picked points leave open where they are seen from nearly above.

There only perspective tells which way a camera leans, and foreshortening, which grows with the
square of the lean, tells by how much. The cost of a pose is then no parabola: a lean of some
degrees that noise has made stands on a steep wall, before a wide valley of lesser leans, and the
curvature at the best pose tells nothing of the valley. The covariance is taken over the whole
likelihood instead: on a grid of places along the two axes that are known least, all other unknowns
solved for at each.
"""

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from catalog.arrays import FloatArray
from optnav_cli.estimation.least_squares import Estimate
from optnav_cli.estimation.models.points import Pose, ProjectingCamera
from optnav_cli.points.model import LensPose, LensPrior, PickedSightings

SIDE = 17  # places of the grid along either axis
REACH_SIGMAS = 4.0  # of the first grid, beyond the best pose and beyond its mirror image
LIKELY = 14.0  # a cost that is higher by so much has a likelihood of 0.1 %
ENOUGH, ZOOMS = 0.1, 4  # a grid is fine enough when so many of its places are likely
ROUNDS = 3  # of solving for the others, by derivatives that hardly change over the grid


@dataclass(frozen=True, eq=False)
class PickedLikelihood:
    """The cost of poses near the best one, from points that are all used."""

    camera: ProjectingCamera
    points: PickedSightings
    lens: LensPrior
    best: Estimate[LensPose]

    def covariance(self, mirror: Pose) -> FloatArray:
        """Return the mean square (k, k) of likely steps from the best pose, in the fit's unknowns.

        mirror  the pose with the lean to the other side, from which the points are seen nearly so
        """
        stated = self.best.covariance[:3, :3]
        weak = np.linalg.eigh(stated)[1][:, 1:]
        to_mirror = mirror.position_m - self.best.state.pose.position_m
        middle = 0.5 * to_mirror @ weak
        half = np.abs(middle) + REACH_SIGMAS * np.sqrt(np.diag(weak.T @ stated @ weak))
        basis, inner = self._split_unknowns(weak)
        line = np.linspace(-1.0, 1.0, SIDE)
        grid = np.stack(np.meshgrid(line, line), axis=-1).reshape(-1, 2)
        for _ in range(ZOOMS + 1):
            places = middle + grid * half
            steps, costs = self._solve_at(places @ weak.T, basis, inner)
            likely = places[costs < self.best.cost + LIKELY]
            if len(likely) > ENOUGH * len(grid):
                break
            # a box around them and the best pose, wider by a step of the grid
            step = 2.0 * half / (SIDE - 1)
            low, high = likely.min(axis=0, initial=0.0), likely.max(axis=0, initial=0.0)
            middle, half = 0.5 * (low + high), 0.5 * (high - low) + step
        share = np.exp(-0.5 * (costs - costs.min()))
        share /= share.sum()
        mean_square: FloatArray = (steps * share[:, None]).T @ steps + basis @ inner @ basis.T
        return mean_square

    def _split_unknowns(self, weak: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return directions (k, k - 2) of the unknowns besides two axes (3, 2), and covariance."""
        axes = np.zeros((2, len(self.best.covariance)))
        axes[:, :3] = weak.T
        directions = np.linalg.svd(axes)[2][2:].T
        normal = self._normal
        basis = directions / np.sqrt(np.einsum("ik,ij,jk->k", directions, normal, directions))
        return basis, np.linalg.inv(basis.T @ normal @ basis)

    @property
    def _normal(self) -> FloatArray:
        total: FloatArray = np.sum([term.normal for term in self.best.terms], axis=0)
        return total

    def _solve_at(
        self, offsets_m: FloatArray, basis: FloatArray, inner: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Return steps (m, k) to the best poses at offsets (m, 3) of the place, and costs (m,)."""
        normal = self._normal
        steps = np.zeros((len(offsets_m), len(normal)))
        steps[:, :3] = offsets_m
        steps -= (steps @ normal @ basis) @ inner @ basis.T  # where a parabola has them
        for _ in range(ROUNDS):
            steps += (self._evaluate_at(steps)[0] @ basis) @ inner @ basis.T
        return steps, self._evaluate_at(steps)[1]

    def _evaluate_at(self, steps: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return J' W r (m, k), with J of the best pose, and costs (m,) after steps (m, k)."""
        state, measured = self.best.state, self.best.measured
        turns = Rotation.from_rotvec(steps[:, 3:6]) * state.pose.camera_from_body
        sights = self.points.places_m - (state.pose.position_m + steps[:, :3])[:, None]
        pixels = self.camera.project(np.einsum("mij,mnj->mni", turns.as_matrix(), sights))
        first = 6 + (self.lens.focal > 0.0)
        focal = state.focal + (steps[:, 6] if first > 6 else np.zeros(len(steps)))
        shift = state.shift_px + (steps[:, first:] if self.lens.centre_px > 0.0 else np.zeros(2))
        out = pixels - self.lens.middle_px
        predicted = self.lens.middle_px + (1.0 + focal)[:, None, None] * out
        residuals = self.points.pixels - predicted - np.reshape(shift, (-1, 1, 2))
        weighted = np.einsum("nij,mnj->mni", measured.weights, residuals)
        costs = np.einsum("mni,mni->m", residuals, weighted)
        gradients = np.einsum("mni,nik->mk", weighted, measured.jacobian)
        for term in self.best.terms[1:]:  # what is stated of the lens is linear
            left = term.residuals - steps @ term.jacobian.T
            costs = costs + left**2 @ term.weights
            gradients = gradients + (left * term.weights) @ term.jacobian
        # a place from which points are out of view is none
        seen = np.isfinite(costs)
        return np.where(seen[:, None], gradients, 0.0), np.where(seen, costs, np.inf)
