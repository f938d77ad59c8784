"""The folder of an orbit: what it holds, written whole and read back.

orbit.toml has the last state with all that a prediction needs, orbit.csv the states of all nodes.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import msgspec
import numpy as np

from catalog.arrays import FloatArray
from catalog.bodies.body import Body
from catalog.bodies.ephemeris import Ephemeris, load_ephemeris
from catalog.bodies.epochs import utc_from_tdb_s, utc_to_tdb_s
from catalog.config import load_toml
from catalog.errors import ConfigError, DataError
from catalog.geometry.rotations import rnb_axes
from catalog.tables import CsvRow
from optnav_cli.dynamics.orbit_settings import ForcesSettings
from optnav_cli.frames.orbit_tables import INERTIAL, LOWER, ORBIT, STATE_COVARIANCE, VELOCITY
from optnav_cli.frames.run_settings import RUN_TOML, read_run_settings
from optnav_cli.frames.tables import POSITION
from optnav_cli.orbit.fit.settings import Mode, NoiseSettings

ORBIT_TOML, ORBIT_CSV, ORBIT_OEM = "orbit.toml", "orbit.csv", "orbit.oem"
RESIDUALS, DISTURBANCES_CSV, SMOOTHED = "residuals.csv", "disturbances.csv", "smoothed.csv"
Kind = Literal["fix", "between", "prediction"]
Numbers = tuple[float, ...]
ROTATION_STEP_S = 0.5
MAX_VARIANCE = 1e30  # m^2, (m/s)^2 or of a parameter
ROUNDED = 1e-6  # of a term, as files write it
SAME_TIME_S = 1e-3  # utc and tdb_s of one state
NO_COVARIANCE = "its covariance can be none of a state; fit the orbit again"


class StoredParameter(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A parameter of the fit: before and after it.

    value, sigma  a number each, or three; of one that was only considered 0 and the prior's
    observed      whether the fixes tell it
    """

    name: str
    camera: str
    run: str
    mode: Mode
    prior_sigma: float
    value: Numbers
    sigma: Numbers
    observed: bool


class StoredState(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The state at the last fix, inertial (ICRF axes at the body's centre), m and m/s.

    covariance  lower triangle, row by row, of position, velocity and the parameters estimated
    """

    utc: str
    tdb_s: float
    position_m: Numbers
    velocity_m_s: Numbers
    covariance: Numbers


class StoredTest(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A test of the residuals as it is stored."""

    fixes: int
    used: int
    chi_square: float
    degrees_of_freedom: int
    steps: int
    remarks: tuple[str, ...]


class OrbitFile(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """orbit.toml of an orbit's folder."""

    body: str
    rotation: str
    kernels: tuple[str, ...] = ()
    state: StoredState
    forces: ForcesSettings
    noise: NoiseSettings
    test: StoredTest
    parameter: tuple[StoredParameter, ...] = ()


@dataclass(frozen=True, eq=False)
class OrbitRows:
    """The rows of orbit.csv: TDB s (n,), inertial states (n, 6) and covariances (n, 6, 6)."""

    times: FloatArray
    kinds: list[Kind]
    states: FloatArray
    covariances: FloatArray


@dataclass(frozen=True, eq=False)
class StoredOrbit:
    """An orbit that was fitted.

    epoch_s     TDB s of the last fix, with the state (6,) there, inertial
    covariance  (6 + p, 6 + p) of that state and of the parameters estimated, in their order
    rows        the states of all nodes
    """

    path: Path
    body: Body
    ephemeris: Ephemeris
    file: OrbitFile
    rows: OrbitRows

    @property
    def forces(self) -> ForcesSettings:
        return self.file.forces

    @property
    def noise(self) -> NoiseSettings:
        return self.file.noise

    @property
    def parameters(self) -> tuple[StoredParameter, ...]:
        return self.file.parameter

    @property
    def epoch_s(self) -> float:
        return self.file.state.tdb_s

    @property
    def state(self) -> FloatArray:
        """(6,) at the epoch."""
        state = self.file.state
        return np.array([*state.position_m, *state.velocity_m_s])

    @property
    def covariance(self) -> FloatArray:
        """Covariance of the state at the epoch and of the parameters estimated."""
        return matrix_of(self.file.state.covariance)


def read_orbit(folder: Path) -> StoredOrbit:
    """Read an orbit's folder. Raises DataError for one that is none, or is damaged."""
    if not (folder / ORBIT_TOML).is_file():
        raise DataError(f"{folder}: has no {ORBIT_TOML}; name what `optnav orbit fit -o` wrote")
    try:
        file = load_toml(folder / ORBIT_TOML, OrbitFile)
        _, body = read_run_settings(folder / RUN_TOML)
    except ConfigError as error:
        raise DataError(f"{error}; fit the orbit again") from error
    state = file.state
    width = 6 + sum(len(p.value) for p in file.parameter if p.mode == "estimate")
    if (len(state.position_m), len(state.velocity_m_s)) != (3, 3) or (
        len(state.covariance) != width * (width + 1) // 2
    ):
        raise DataError(f"{folder / ORBIT_TOML}: [state] lacks numbers; fit the orbit again")
    try:
        tdb_s = utc_to_tdb_s(state.utc, "utc")
    except DataError as error:
        raise DataError(f"{folder / ORBIT_TOML}: [state] {error}; fit the orbit again") from None
    if not abs(tdb_s - state.tdb_s) < SAME_TIME_S:
        raise DataError(
            f"{folder / ORBIT_TOML}: [state] has utc {state.utc}, which is tdb_s {tdb_s:.3f}, and "
            f"tdb_s {state.tdb_s:.3f}; fit the orbit again"
        )
    if not _can_be(matrix_of(state.covariance)):
        raise DataError(f"{folder / ORBIT_TOML}: [state] {NO_COVARIANCE}")
    rows = rows_of(ORBIT.read(folder / ORBIT_CSV, _row))
    if len(rows.times) == 0 or not (np.diff(rows.times) > 0.0).all():
        raise DataError(f"{folder / ORBIT_CSV}: its times are missing or not in order; fit again")
    ephemeris = load_ephemeris(body, [Path(name) for name in file.kernels])
    return StoredOrbit(folder, body, ephemeris, file, rows)


def rows_of(rows: Sequence[tuple[float, Kind, FloatArray, FloatArray]]) -> OrbitRows:
    """Rows put together."""
    return OrbitRows(
        np.array([row[0] for row in rows]),
        [row[1] for row in rows],
        np.array([row[2] for row in rows]).reshape(-1, 6),
        np.array([row[3] for row in rows]).reshape(-1, 6, 6),
    )


def write_orbit_rows(path: Path, rows: OrbitRows, ephemeris: Ephemeris) -> None:
    """Write orbit.csv, or a prediction in its columns."""
    ORBIT.write(path, (_cells(rows, k, ephemeris) for k in range(len(rows.times))))


def _cells(rows: OrbitRows, k: int, ephemeris: Ephemeris) -> dict[str, object]:
    state, time = rows.states[k], float(rows.times[k])
    turn = rnb_turn(state)
    spread = turn @ rows.covariances[k] @ turn.T
    cells: dict[str, object] = {"utc": utc_from_tdb_s(time), "kind": rows.kinds[k]}
    fixed = body_fixed_state(ephemeris, time, state)
    cells |= zip((*POSITION, *VELOCITY), fixed, strict=True)
    cells |= zip(INERTIAL, state, strict=True)
    cells |= zip(STATE_COVARIANCE, (spread[i, j] for i, j in LOWER), strict=True)
    return cells


def _row(row: CsvRow) -> tuple[float, Kind, FloatArray, FloatArray]:
    kinds: dict[str, Kind] = {"fix": "fix", "between": "between", "prediction": "prediction"}
    if row["kind"] not in kinds:
        raise DataError(f"kind is '{row['kind']}'; wanted {', '.join(kinds)}")
    state, triangle = row.vector(INERTIAL), row.vector(STATE_COVARIANCE)
    if state is None or triangle is None:
        raise DataError("a state or covariance is empty; fit the orbit again")
    stated = matrix_of(triangle)
    if not _can_be(stated):
        raise DataError(NO_COVARIANCE)
    turn = rnb_turn(state)
    covariance = turn.T @ stated @ turn
    return utc_to_tdb_s(row["utc"], "utc"), kinds[row["kind"]], state, covariance


def _can_be(covariance: FloatArray) -> bool:
    """Whether a matrix may be a covariance: no term above what its two variances allow."""
    variances = covariance.diagonal()
    if not (np.abs(covariance).max() < MAX_VARIANCE and (variances >= 0.0).all()):
        return False
    most = np.sqrt(np.multiply.outer(variances, variances))
    return bool((np.abs(covariance) <= (1.0 + ROUNDED) * most).all())


def stated_turn(ephemeris: Ephemeris, tdb_s: float) -> FloatArray:
    """Rotation (3, 3) from inertial to the body frame that files state."""
    turn = ephemeris.body_from_inertial(tdb_s)
    stated: FloatArray = ephemeris.body.catalog_frame.rotate_to_stated(turn.T).T
    return stated


def body_fixed_state(ephemeris: Ephemeris, tdb_s: float, state: FloatArray) -> FloatArray:
    """An inertial state (6,) as the body frame sees it."""
    step = ROTATION_STEP_S
    before, after = (stated_turn(ephemeris, tdb_s + s) for s in (-step, step))
    turn, rate = stated_turn(ephemeris, tdb_s), (after - before) / (2.0 * step)
    return np.concatenate([turn @ state[:3], turn @ state[3:] + rate @ state[:3]])


def rnb_turn(state: FloatArray) -> FloatArray:
    """(6, 6): position and velocity along R, N, B of the inertial motion, from inertial axes."""
    return np.kron(np.eye(2), rnb_axes(state[:3], state[3:])).astype(np.float64)


def matrix_of(triangle: Sequence[float] | FloatArray) -> FloatArray:
    """A symmetric matrix of its lower triangle, row by row."""
    values = np.asarray(triangle, np.float64)
    size = int((np.sqrt(8.0 * len(values) + 1.0) - 1.0) / 2.0)
    matrix = np.zeros((size, size))
    matrix[np.tril_indices(size)] = values
    full: FloatArray = matrix + np.tril(matrix, -1).T
    return full


def triangle_of(matrix: FloatArray) -> Numbers:
    """The lower triangle of a matrix, row by row."""
    return tuple(float(v) for v in matrix[np.tril_indices(len(matrix))])


def toml_of(file: OrbitFile) -> str:
    """orbit.toml as text; floats with all their digits."""
    head, tables = [], []
    for name, value in msgspec.to_builtins(file).items():
        if isinstance(value, dict):
            tables += _section(name, value)
        elif name == "parameter":
            for table in value:
                tables += ["", "[[parameter]]", *_lines(table)]
        else:
            head += _lines({name: value})
    return "\n".join([*head, *tables]) + "\n"


def _section(name: str, values: Mapping[str, Any]) -> list[str]:
    plain = {k: v for k, v in values.items() if not _is_table(v)}
    lines = ["", f"[{name}]", *_lines(plain)]
    for key, value in values.items():
        if isinstance(value, dict):
            lines += _section(f"{name}.{key}", value)
        elif _is_table(value):
            for table in value:
                lines += ["", f"[[{name}.{key}]]", *_lines(table)]
    return lines


def _is_table(value: object) -> bool:
    inner = isinstance(value, list | tuple) and len(value) > 0 and isinstance(value[0], dict)
    return isinstance(value, dict) or inner


def _lines(values: Mapping[str, Any]) -> list[str]:
    return [f"{name} = {_toml(value)}" for name, value in values.items() if value is not None]


def _toml(value: object) -> str:
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, str):
        return msgspec.json.encode(value).decode()
    if isinstance(value, list | tuple):
        return f"[{', '.join(map(_toml, value))}]"
    return repr(value)
