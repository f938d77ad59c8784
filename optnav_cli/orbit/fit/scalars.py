"""Scalar measurements of an orbit between its nodes: zenith distances, ranges, Doppler, angles.

A node for each would cost a filter's step each. Those of an interval are carried from the node
before them in one integration and made into at most as many rows as there are unknowns (QR), which
hold all that they say.
"""

import math
from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from typing import Self

import numpy as np

from catalog.arrays import BoolArray, FloatArray, IntArray
from optnav_cli.estimation.smoother import NodeMeasurement
from optnav_cli.orbit.fit.motion import ArcMotion
from optnav_cli.orbit.fit.parameters import FitParameter


@dataclass(frozen=True, eq=False)
class ScalarSet(ABC):
    """Measurements of one kind in the order of time, each of one number; fields of all (n, ...)."""

    @property
    @abstractmethod
    def measured(self) -> str:
        """Name of the measurements, in the plural."""

    @property
    @abstractmethod
    def values(self) -> FloatArray:
        """(n,) measured, in the unit of the kind."""

    @property
    @abstractmethod
    def sigmas(self) -> FloatArray:
        """(n,) 1 sigma of the values."""

    @property
    @abstractmethod
    def epochs(self) -> FloatArray:
        """(n, k) TDB s of the k states that each depends on."""

    @property
    @abstractmethod
    def series(self) -> IntArray:
        """(n,) number of the series of each, of one star or station."""

    @property
    def node_step_s(self) -> float:
        """Distance of nodes above which the noise of the motion between them is not small, s."""
        return math.inf

    @property
    def sizes(self) -> Mapping[str, int]:
        """Number of components of its parameters; 1 where not named."""
        return {}

    def __len__(self) -> int:
        return len(self.values)

    def part(self, kept: BoolArray | IntArray) -> Self:
        """Select some of them; what is common to all of them stays."""
        chosen = {part.name: getattr(self, part.name) for part in fields(self) if part.init}
        for name, value in chosen.items():
            if isinstance(value, np.ndarray):
                chosen[name] = value[kept]
            elif hasattr(value, "part"):
                chosen[name] = value.part(kept)
        return replace(self, **chosen)

    def cut(self, first_s: float, last_s: float) -> Self:
        """Select those whose states lie between two times, TDB s."""
        epochs = self.epochs
        return self.part((epochs.min(axis=1) >= first_s) & (epochs.max(axis=1) <= last_s))

    @abstractmethod
    def compute(self, states: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Compute the values (n,) of states (n, k, 6), and their derivatives (n, k, 6)."""

    def differentiate(
        self, parameter: FitParameter, states: FloatArray, by_states: FloatArray
    ) -> FloatArray | None:
        """Return the derivatives (n, size) by a parameter; None: they do not depend on it.

        states, by_states  (n, k, 6) as `compute` takes and returns them
        """
        return None


@dataclass(frozen=True, eq=False)
class ScalarRows:
    """All scalar measurements about a trajectory.

    residuals   (n,) measured less computed
    design      (n, 6 + p) derivative of the computed one by the node's state and the parameters
    considered  (n, q) by what is considered
    """

    residuals: FloatArray
    design: FloatArray
    considered: FloatArray


class ScalarArc:
    """Sets of scalar measurements along the nodes of an arc, one set after the other."""

    def __init__(self, sets: Sequence[ScalarSet], times: FloatArray) -> None:
        """Give each measurement the node before the first of its states; times (N,) of nodes."""
        self.sets, self._times = tuple(sets), times
        parts = [np.empty((0, 4)), *map(_columns, sets)]
        self.values, self.sigmas, self.tdb_s, first = np.concatenate(parts).T
        series, count = [np.empty(0, np.int64)], 0
        for measurements in sets:
            series.append(measurements.series + count)
            count = int(series[-1].max(initial=count - 1)) + 1
        self.series: IntArray = np.concatenate(series)
        number = np.searchsorted(times, first, "right") - 1
        self.node_of: IntArray = np.clip(number, 0, max(len(times) - 2, 0))

    def __len__(self) -> int:
        return len(self.values)

    @property
    def spans(self) -> list[slice]:
        """The measurements of each set."""
        ends = np.cumsum([0, *map(len, self.sets)])
        return [slice(int(ends[k]), int(ends[k + 1])) for k in range(len(self.sets))]

    def rows(
        self,
        motion: ArcMotion,
        states: FloatArray,
        values: FloatArray,
        parameters: tuple[Sequence[FitParameter], Sequence[FitParameter]],
    ) -> ScalarRows:
        """Compute all measurements about a trajectory.

        states      (N, 6) of the nodes
        values      (p,) of the parameters estimated
        parameters  those estimated, and those considered
        """
        every = [p for group in parameters for p in group]
        forces = [p for p in every if p.moves_craft]
        width, q = 6 + len(values), sum(p.size for p in parameters[1])
        design, considered = np.zeros((len(self), width)), np.zeros((len(self), q))
        computed = np.empty(len(self))
        epochs = [measurements.epochs for measurements in self.sets]
        carried = self._carry(motion, states, epochs, [p.name for p in forces])
        for k, (measurements, here) in enumerate(zip(self.sets, self.spans, strict=True)):
            there, maps, pushed = (array[k] for array in carried)
            predicted, by_states = measurements.compute(there)
            design[here, :6] = np.einsum("nki,nkij->nj", by_states, maps)
            by_forces = np.einsum("nki,nkij->nj", by_states, pushed)
            column = 0
            for p in every:
                if p.moves_craft:
                    by: FloatArray | None = by_forces[:, column : column + p.size]
                    column += p.size
                else:
                    by = measurements.differentiate(p, there, by_states)
                if by is None:
                    continue
                if p.settings.mode == "estimate":
                    design[here, 6 + p.first : 6 + p.first + p.size] = by
                    predicted = predicted if p.moves_craft else predicted + by @ values[p.span]
                else:
                    considered[here, p.span] = by
            computed[here] = predicted
        return ScalarRows(self.values - computed, design, considered)

    def _carry(
        self,
        motion: ArcMotion,
        states: FloatArray,
        epochs: Sequence[FloatArray],
        names: Sequence[str],
    ) -> tuple[list[FloatArray], list[FloatArray], list[FloatArray]]:
        """Bring the nodes' states to the epochs (n, k) of each set.

        Returns states (n, k, 6) and derivatives (n, k, 6, 6) and (n, k, 6, p) of each.
        """
        times = np.concatenate([part.ravel() for part in epochs])
        counts = [part.shape[1] for part in epochs]
        nodes = np.concatenate(
            [np.repeat(self.node_of[s], k) for s, k in zip(self.spans, counts, strict=True)]
        )
        order = np.lexsort((times, nodes))
        carried: list[FloatArray] = []
        ends = np.searchsorted(nodes[order], np.arange(len(self._times) + 1))
        for node in np.unique(nodes):
            here = order[int(ends[node]) : int(ends[node + 1])]
            start = float(self._times[node])
            partials = motion.partials(states[node], start, times[here], names)
            if not carried:
                carried = [np.empty((len(times), *part.shape[1:])) for part in partials]
            for array, part in zip(carried, partials, strict=True):
                array[here] = part
        cuts = np.cumsum([part.size for part in epochs])[:-1]
        there, maps, pushed = (
            [
                piece.reshape(len(piece) // k, k, *piece.shape[1:])
                for piece, k in zip(np.split(array, cuts), counts, strict=True)
            ]
            for array in carried
        )
        return there, maps, pushed

    def whitened(
        self, rows: ScalarRows, weights: FloatArray, paths: FloatArray
    ) -> Iterator[NodeMeasurement]:
        """Yield the rows of each interval over their sigmas, (m, 1 + q) right sides.

        weights  (n,);  paths  (N, 6 + p, q) of what is considered
        """
        scale = np.sqrt(weights) / self.sigmas
        for node in np.unique(self.node_of):
            here = np.flatnonzero((self.node_of == node) & (weights > 0.0))
            if not len(here):
                continue
            design = rows.design[here]
            more = design @ paths[node] + rows.considered[here]
            right = np.concatenate([rows.residuals[here, None], more], axis=1)
            whitened = design * scale[here, None]
            yield NodeMeasurement(int(node), right * scale[here, None], whitened, np.eye(len(here)))

    def compressed(
        self, rows: ScalarRows, weights: FloatArray, paths: FloatArray, width: int
    ) -> Iterator[NodeMeasurement]:
        """Yield at most as many rows an interval as there are unknowns; width: of the arc."""
        for measurement in self.whitened(rows, weights, paths):
            count = measurement.design.shape[1]
            if len(measurement.residual) > count:
                measurement = compress(measurement)[0]
            design = np.zeros((len(measurement.design), width))
            design[:, :count] = measurement.design
            yield NodeMeasurement(
                measurement.node, measurement.residual, design, measurement.covariance
            )

    def remainder(self, rows: ScalarRows, weights: FloatArray) -> float:
        """Return the part of chi-square that no change of the nodes' states takes away."""
        paths = np.zeros((len(self._times), *rows.design.shape[1:], rows.considered.shape[1]))
        return sum(
            compress(measurement)[1]
            for measurement in self.whitened(rows, weights, paths)
            if len(measurement.residual) > measurement.design.shape[1]
        )


def _columns(measurements: ScalarSet) -> FloatArray:
    """Values, sigmas, time and first epoch (n, 4) of a set."""
    epochs = measurements.epochs
    columns = (measurements.values, measurements.sigmas, epochs.mean(axis=1), epochs.min(axis=1))
    return np.stack(columns, axis=1)


def compress(measurement: NodeMeasurement) -> tuple[NodeMeasurement, float]:
    """Compress rows to as many as unknowns; also return the squares of the residual left."""
    q, r = np.linalg.qr(measurement.design)
    right = q.T @ measurement.residual
    before, after = (float((part[:, 0] ** 2).sum()) for part in (measurement.residual, right))
    return NodeMeasurement(measurement.node, right, r, np.eye(len(r))), before - after
