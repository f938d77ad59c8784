"""Multiple shooting along an arc: one linear step for the states of all nodes, three ways.

Every node keeps its own state; what the motion from one node leaves to the next is its defect. One
step of Gauss and Newton finds the deviations of all nodes from

    delta[i+1] = F[i] delta[i] + c[i] + v[i],  v[i] ~ (0, Q[i]);   y[i] = H[i] delta[i] + noise R[i]

with a prior on delta[0]. The defect c holds the whole disturbance so far, so v is the whole one:
a penalty on the change of a step alone, as in equation (16) of Tuchin's chapter 3, forgets it.

`smooth` is a filter with the backward sweep of adjoint states (Bryson and Frazier; Rauch, Tung and
Striebel give the same): neither the covariance nor F is inverted, so Q = 0 is no special case.
Covariances are the filter's joined with the information of what comes later, by roots: the
difference P - P W P of the same sweep loses its digits where the filter knows a thousand times
less than the result, and may come out as no covariance.
`batch` is least squares by QR for Q = 0 (Akim and Eneev), `nuisance` the estimate of the last node
alone, into whose weights the disturbances go with all blocks between measurements.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from scipy.linalg import cho_factor, cho_solve, solve_triangular

from catalog.arrays import FloatArray
from catalog.errors import NoSolutionError

MAX_NUISANCE_ROWS = 6000  # a dense matrix of their square is 0.3 GB


@dataclass(frozen=True, eq=False)
class NodeMeasurement:
    """A measurement at a node: y - h(x).

    node        its number
    residual    (m, k)  measured less computed; further columns are other right sides
    design      (m, n)  derivative of h by the node's state
    covariance  (m, m)  of the measurement
    """

    node: int
    residual: FloatArray
    design: FloatArray
    covariance: FloatArray


@dataclass(frozen=True, eq=False)
class LinearArc:
    """One linear problem along an arc of N nodes with n numbers each.

    transitions  (N-1, n, n)  F
    defects      (N-1, n, k)  c, a column for each right side
    noises       (N-1, n, n)  Q
    offset       (n, k)  of the prior from the first node's state, and its covariance (n, n)
    """

    transitions: FloatArray
    defects: FloatArray
    noises: FloatArray
    measurements: Sequence[NodeMeasurement]
    offset: FloatArray
    prior_covariance: FloatArray

    @property
    def by_node(self) -> list[list[NodeMeasurement]]:
        """The measurements of each node."""
        grouped: list[list[NodeMeasurement]] = [[] for _ in range(len(self.transitions) + 1)]
        for measurement in self.measurements:
            grouped[measurement.node].append(measurement)
        return grouped


@dataclass(frozen=True, eq=False)
class SmoothedArc:
    """The solution of a LinearArc.

    deviations     (N, n, k)
    covariances    (N, n, n)
    disturbances   (N-1, n, k)  v; empty where a method has none
    scores         (N-1, n)     adjoint state of each interval, and its information (N-1, n, n):
                   a shock there would be -information^-1 score, (score' information^-1 score) its
                   chi-square
    chi_square     of the measurements used, by their innovations
    count          of measured numbers
    """

    deviations: FloatArray
    covariances: FloatArray
    disturbances: FloatArray
    chi_square: float
    count: int
    scores: FloatArray = field(default_factory=lambda: np.empty((0, 0)))
    information: FloatArray = field(default_factory=lambda: np.empty((0, 0, 0)))


@np.errstate(over="ignore", invalid="ignore")  # what runs away is refused below, in words
def smooth(arc: LinearArc) -> SmoothedArc:
    """Filter and smoother; measurements of one node are taken one after another.

    Raises NoSolutionError when a number is no longer finite.
    """
    count, n = len(arc.transitions) + 1, arc.prior_covariance.shape[0]
    columns = arc.offset.shape[1]
    identity = np.eye(n)
    by_node = arc.by_node
    d, p = arc.offset, arc.prior_covariance
    filtered_d, filtered_p = np.empty((count, n, columns)), np.empty((count, n, n))
    updates: list[list[tuple[FloatArray, FloatArray, FloatArray]]] = []
    chi_square, numbers = 0.0, 0
    for i in range(count):
        if i:
            f = arc.transitions[i - 1]
            d = f @ d + arc.defects[i - 1]
            p = f @ p @ f.T + arc.noises[i - 1]
        here = []
        for m in by_node[i]:
            h, r = m.design, m.covariance
            ph = p @ h.T
            weight = _inverse(h @ ph + r)
            gain = ph @ weight
            y = m.residual - h @ d
            c = identity - gain @ h
            d = d + gain @ y
            p = c @ p @ c.T + gain @ r @ gain.T
            p = 0.5 * (p + p.T)
            wy = weight @ y
            chi_square += float(y[:, 0] @ wy[:, 0])
            numbers += len(y)
            here.append((c, h.T @ wy, h.T @ weight @ h))
        updates.append(here)
        filtered_d[i], filtered_p[i] = d, p
    if not (np.isfinite(filtered_d).all() and np.isfinite(filtered_p).all()):
        raise NoSolutionError("the filter's numbers are not finite; the fixes fit no orbit")
    lam, info, later = np.zeros((n, columns)), np.zeros((n, n)), np.zeros((n, n))
    scores, information = np.empty((count - 1, n)), np.empty((count - 1, n, n))
    disturbances = np.empty((count - 1, n, columns))
    for i in range(count - 1, -1, -1):
        p = filtered_p[i]
        filtered_d[i] -= p @ lam
        filtered_p[i] = _joined(p, later)
        for m in by_node[i]:
            later = later + m.design.T @ _inverse(m.covariance) @ m.design
        for c, hy, hh in reversed(updates[i]):
            lam = c.T @ lam - hy
            info = hh + c.T @ info @ c
        if i:
            scores[i - 1], information[i - 1] = lam[:, 0], info
            disturbances[i - 1] = -arc.noises[i - 1] @ lam
            f = arc.transitions[i - 1]
            lam, info = f.T @ lam, f.T @ info @ f
            later = f.T @ np.linalg.solve(identity + later @ arc.noises[i - 1], later) @ f
            later = 0.5 * (later + later.T)
    return SmoothedArc(
        filtered_d, filtered_p, disturbances, chi_square, numbers, scores, information
    )


def _joined(covariance: FloatArray, information: FloatArray) -> FloatArray:
    """(P^-1 + I)^-1 of a covariance P = S S' and an information I, (n, n): S (1 + S' I S)^-1 S'."""
    sigmas = np.sqrt(np.maximum(np.diagonal(covariance), np.finfo(np.float64).tiny))
    values, axes = np.linalg.eigh(covariance / sigmas / sigmas[:, None])
    root = sigmas[:, None] * axes * np.sqrt(np.maximum(values, 0.0))
    gain = root.T @ information @ root
    try:
        inner = np.linalg.cholesky(np.eye(len(root)) + gain)
        joined = solve_triangular(inner, root.T, lower=True)
    except np.linalg.LinAlgError:
        # digits lost among gains of 1e16 and more make small ones negative
        gains, axes = np.linalg.eigh(0.5 * (gain + gain.T))
        joined = axes.T @ root.T / np.sqrt(1.0 + np.maximum(gains, 0.0))[:, None]
    combined: FloatArray = joined.T @ joined
    return combined


def _inverse(covariance: FloatArray) -> FloatArray:
    """Raises NoSolutionError where numbers have too few digits for it."""
    try:
        return np.linalg.inv(covariance).astype(np.float64, copy=False)
    except np.linalg.LinAlgError as error:
        raise NoSolutionError(
            "the stated sigmas are too small against the first orbit for numbers of 16 digits; "
            "see their unit"
        ) from error


def batch(arc: LinearArc) -> SmoothedArc:
    """Least squares for the first node by QR, without disturbances; Q is not looked at."""
    maps, shifts = _from_first(arc)
    n = arc.prior_covariance.shape[0]
    rows, right = [_whitened(arc.prior_covariance, np.eye(n))], []
    right.append(_whitened(arc.prior_covariance, arc.offset))
    for m in arc.measurements:
        rows.append(_whitened(m.covariance, m.design @ maps[m.node]))
        right.append(_whitened(m.covariance, m.residual - m.design @ shifts[m.node]))
    q, r = np.linalg.qr(np.concatenate(rows))
    z = np.concatenate(right)
    first = solve_triangular(r, q.T @ z)
    root = solve_triangular(r, np.eye(n))
    residual = z[:, 0] - np.concatenate(rows) @ first[:, 0]
    spread = maps @ root
    return SmoothedArc(
        maps @ first + shifts,
        spread @ spread.transpose(0, 2, 1),
        np.zeros_like(arc.defects),
        float(residual @ residual),
        sum(len(m.residual) for m in arc.measurements),
    )


def nuisance(arc: LinearArc) -> SmoothedArc:
    """The last node's deviation with the disturbances in the weights; from it all others.

    Equal to `smooth`; the matrix of all measurements is dense, so it serves for a check and for
    short arcs. Raises NoSolutionError for more than MAX_NUISANCE_ROWS rows.
    """
    count, n = len(arc.transitions) + 1, arc.prior_covariance.shape[0]
    rows_of = [len(m.residual) for m in arc.measurements]
    if sum(rows_of) + n > MAX_NUISANCE_ROWS:
        raise NoSolutionError(
            f"the nuisance method takes {MAX_NUISANCE_ROWS // 3} fixes at most; there are "
            f'{len(rows_of)}: use [noise] model = "white", which gives the same'
        )
    back, shift, cover = _from_last(arc)
    designs = [np.eye(n), *(m.design for m in arc.measurements)]
    nodes = [0, *(m.node for m in arc.measurements)]
    sides = [arc.offset, *(m.residual for m in arc.measurements)]
    noises = [arc.prior_covariance, *(m.covariance for m in arc.measurements)]
    a = np.concatenate([h @ back[i] for h, i in zip(designs, nodes, strict=True)])
    z = np.concatenate([y - h @ shift[i] for h, i, y in zip(designs, nodes, sides, strict=True)])
    starts = np.cumsum([0, *(len(h) for h in designs)])
    weight = np.empty((len(a), len(a)))
    spread = np.empty((count, n, len(a)))  # of each node's e with each measurement's
    for j, (h, i) in enumerate(zip(designs, nodes, strict=True)):
        spread[:, :, starts[j] : starts[j + 1]] = cover[:, i] @ h.T
    for j, (h, i, r) in enumerate(zip(designs, nodes, noises, strict=True)):
        block = slice(starts[j], starts[j + 1])
        weight[block] = h @ spread[i]
        weight[block, block] += r
    factor = cho_factor(weight, lower=True)
    wa = cho_solve(factor, a)
    covariance = np.linalg.inv(a.T @ wa)
    last = covariance @ (wa.T @ z)
    weighted = cho_solve(factor, z - a @ last)
    others = spread.reshape(count * n, -1)
    deviations = back @ last + shift + (others @ weighted).reshape(count, n, -1)
    maps = back - (others @ wa).reshape(count, n, n)
    solved = cho_solve(factor, others.T).T.reshape(count, n, -1)
    covariances = np.einsum("iab,icb->iac", maps @ covariance, maps)
    covariances += np.stack([cover[i, i] for i in range(count)])
    covariances -= np.einsum("iab,icb->iac", solved, spread)
    disturbances = deviations[1:] - arc.transitions @ deviations[:-1] - arc.defects
    chi_square = float((z - a @ last)[:, 0] @ weighted[:, 0])
    return SmoothedArc(deviations, covariances, disturbances, chi_square, sum(rows_of))


def _from_first(arc: LinearArc) -> tuple[FloatArray, FloatArray]:
    """Each node's deviation by the first one's: maps (N, n, n) and shifts (N, n, k)."""
    maps, shifts = [np.eye(arc.prior_covariance.shape[0])], [np.zeros_like(arc.offset)]
    for f, c in zip(arc.transitions, arc.defects, strict=True):
        maps.append(f @ maps[-1])
        shifts.append(f @ shifts[-1] + c)
    return np.stack(maps), np.stack(shifts)


def _from_last(arc: LinearArc) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Each node's deviation by the last one's: back (N, n, n), shift (N, n, k).

    And covariances (N, N, n, n) of e[i] = -(sum of what v moved between node i and the last).
    """
    count, n = len(arc.transitions) + 1, arc.prior_covariance.shape[0]
    back, shift = np.empty((count, n, n)), np.empty((count, *arc.offset.shape))
    spreads = np.empty((count, n, n))  # covariance of each e
    back[-1], shift[-1], spreads[-1] = np.eye(n), 0.0, 0.0
    inverses = np.empty_like(arc.transitions)
    for i in range(count - 2, -1, -1):
        inverse = inverses[i] = np.linalg.inv(arc.transitions[i])
        back[i] = inverse @ back[i + 1]
        shift[i] = inverse @ (shift[i + 1] - arc.defects[i])
        spreads[i] = inverse @ (spreads[i + 1] + arc.noises[i]) @ inverse.T
    cover = np.empty((count, count, n, n))
    for j in range(count):  # node i before j holds e[j] moved back, and more of its own
        moved = spreads[j]
        cover[j, j] = moved
        for i in range(j - 1, -1, -1):
            moved = inverses[i] @ moved
            cover[i, j], cover[j, i] = moved, moved.T
    return back, shift, cover


def _whitened(covariance: FloatArray, rows: FloatArray) -> FloatArray:
    root = np.linalg.cholesky(covariance)
    whitened: FloatArray = solve_triangular(root, rows, lower=True)
    return whitened
