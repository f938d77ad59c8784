"""Files that a fit reads besides runs: measurements.csv, and the OEM or state of a [[prior]]."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import msgspec
import numpy as np

from catalog.arrays import FloatArray, IntArray
from catalog.bodies.ephemeris import AnalyticEphemeris, Ephemeris
from catalog.bodies.epochs import utc_from_tdb_s, utc_to_tdb_s
from catalog.errors import ConfigError, DataError, UsageError
from catalog.geometry.latlon import xyz_from_latlon
from catalog.tables import CsvRow
from optnav_cli.frames.orbit_tables import MEASUREMENTS
from optnav_cli.orbit.fit.fit import OrbitFit
from optnav_cli.orbit.fit.folder import ROTATION_STEP_S, matrix_of, stated_turn
from optnav_cli.orbit.fit.oem_reader import read_oem
from optnav_cli.orbit.fit.problem import OrbitPrior
from optnav_cli.orbit.fit.settings import (
    CONSIDERED,
    OrbitFitSettings,
    OrbitPriorSettings,
    ParameterSettings,
)
from optnav_cli.orbit.fit.stations import SignalGeometry, StationNetwork, load_stations
from optnav_cli.orbit.fit.tracking import (
    Altitudes,
    Angles,
    Passes,
    RangeRates,
    Ranges,
    SignalSet,
    TrackingSet,
    find_body_turns,
)

TWO_WAY, THREE_WAY, RATE = "two_way_range_m", "three_way_range_m", "range_rate_m_s"
RIGHT_ASCENSION, DECLINATION, ALTITUDE = "right_ascension_deg", "declination_deg", "altimeter_m"
SIGNALS = (TWO_WAY, THREE_WAY, RATE)
KINDS = (*SIGNALS, RIGHT_ASCENSION, DECLINATION, ALTITUDE)
# Values beyond these are of another unit or sense.
LIMITS = {
    TWO_WAY: (0.0, 1e13),
    THREE_WAY: (0.0, 1e13),
    RATE: (-1e5, 1e5),
    RIGHT_ASCENSION: (-360.0, 360.0),
    DECLINATION: (-90.0, 90.0),
    ALTITUDE: (0.0, 1e8),
}
MEASUREMENT_RESIDUALS_CSV = "measurement_residuals.csv"
LEFT_OUT = "disagrees with the orbit of the others"
MAX_NAMED = 10  # measurements left out that are named on the screen
MAX_MEASUREMENTS = 100_000
MAX_COUNT_S = 3600.0
PASS_GAP_S = 1800.0  # between signals of a station: a later one is of another pass
MAX_APART = 0.2  # share of the distance of station and body that a craft is off the body by
# Of the Moon from the Earth by SOFA's moon98: rms against ELP/MPP02, a component (its note 3).
ANALYTIC_MOON_M = 6.1e3 / 3.0**0.5


@dataclass(frozen=True, eq=False)
class Measurement:
    """A row of measurements.csv; stations by number, -1 where the kind has none."""

    line: int
    where: str
    kind: str
    tdb_s: float
    value: float
    sigma: float
    receiver: int
    sender: int
    count_s: float
    point_m: FloatArray


@dataclass(frozen=True, eq=False)
class ReadMeasurements:
    """The sets of a file, its rows by their lines, and the names of the stations."""

    path: Path
    sets: list[TrackingSet]
    rows: dict[int, Measurement]
    stations: list[str]

    @property
    def ends(self) -> tuple[float, float]:
        """TDB s of the first and the last one."""
        times = [row.tdb_s for row in self.rows.values()]
        return min(times), max(times)


def read_measurements(
    path: Path, stations_path: Path | None, ephemeris: Ephemeris
) -> ReadMeasurements:
    """Read the measurements of a file as sets for a fit.

    Raises DataError, with line and column, for damaged rows, unknown kinds and stations, values
    of another unit, a body below a station's least elevation, and times that ephemeris or table of
    the Earth do not cover; UsageError for signals without a file of stations.
    """
    file, orientation = (None, None) if stations_path is None else load_stations(stations_path)
    names = [] if file is None else [station.name for station in file.station]
    radii = ephemeris.body.radii_m
    rows = MEASUREMENTS.read(path, lambda row: _parse(row, names, radii))
    if len(rows) > MAX_MEASUREMENTS:
        raise DataError(f"{path}: has more than {MAX_MEASUREMENTS} rows; fit parts of it")
    rows.sort(key=lambda row: row.tdb_s)
    sets: list[TrackingSet] = []
    signals = [row for row in rows if row.kind in SIGNALS]
    if signals:
        if file is None:
            raise UsageError(
                f"{signals[0].where}: {signals[0].kind} needs the places of stations; name their "
                "file by --stations"
            )
        ends = signals[0].tdb_s - MAX_COUNT_S, signals[-1].tdb_s + MAX_COUNT_S
        try:
            network = StationNetwork(file.station, orientation, ephemeris, ends)
            sets += _signal_sets(network, signals)
        except DataError as error:
            raise DataError(f"{path}: {error}") from None
    angles = [row for row in rows if row.kind in (RIGHT_ASCENSION, DECLINATION)]
    if angles:
        sets.append(_angles(angles, ephemeris))
    heights = [row for row in rows if row.kind == ALTITUDE]
    if heights:
        if radii[0] != radii[1]:
            raise DataError(
                f"{heights[0].where}: {ALTITUDE} is over an ellipsoid of revolution, and that of "
                f"{ephemeris.body.name} has three axes; remove these rows"
            )
        times, values, sigmas, lines = _columns(heights)
        sets.append(
            Altitudes(values, sigmas, lines, times, find_body_turns(ephemeris, times), radii)
        )
    return ReadMeasurements(path, sets, {row.line: row for row in rows}, names)


def _parse(row: CsvRow, names: Sequence[str], radii: tuple[float, float, float]) -> Measurement:
    kind = row["kind"]
    if kind not in KINDS:
        raise DataError(f"kind is '{kind}'; wanted one of {', '.join(KINDS)}")
    value, sigma = row.number("value"), row.number("sigma")
    low, high = LIMITS[kind]
    if value is None or not low <= value <= high:
        raise DataError(f"value is '{row['value']}'; a {kind} is from {low:g} to {high:g}")
    if sigma is None or not 0.0 < sigma <= 1e9:
        raise DataError(f"sigma is '{row['sigma']}'; wanted 1 sigma of the value, above 0")
    stations = [-1, -1]
    if kind in SIGNALS:
        sender = row["transmitter"] or row["station"]
        if kind == TWO_WAY and sender != row["station"]:
            raise DataError(f"transmitter is '{sender}'; with another than station: {THREE_WAY}")
        if kind == THREE_WAY and sender == row["station"]:
            raise DataError(f"transmitter is '{sender}', the station itself; then it is {TWO_WAY}")
        for k, (column, name) in enumerate((("station", row["station"]), ("transmitter", sender))):
            if names and name not in names:
                raise DataError(
                    f"{column} is '{name}'; the file of stations has {', '.join(names)}"
                )
            stations[k] = names.index(name) if names else -1
    count_s = row.number("count_s") or 0.0
    if (kind == RATE) != (0.0 < count_s <= MAX_COUNT_S):
        wanted = f"above 0 to {MAX_COUNT_S:g}" if kind == RATE else "none"
        raise DataError(f"count_s is '{row['count_s']}'; wanted {wanted} for {kind}")
    point = row.vector(("lat_deg", "lon_deg", "height_m"))
    if point is not None and kind not in (RIGHT_ASCENSION, DECLINATION):
        raise DataError(f"lat_deg is '{row['lat_deg']}', and a {kind} is of no point; empty it")
    xyz = np.zeros(3)
    if point is not None:
        lat, lon = np.radians(point[:2])
        up = xyz_from_latlon(lat, lon, 1.0)
        squares = np.square(radii) * up  # the foot of a normal: a^2 n over its size in the axes
        xyz = squares / np.sqrt(squares @ up) + point[2] * up
    time = utc_to_tdb_s(row["utc"], "utc")
    line = int(row.where.rpartition(" ")[2])
    numbers = (stations[0], stations[1], count_s, xyz)
    return Measurement(line, row.where, kind, time, value, sigma, *numbers)


def _columns(rows: Sequence[Measurement]) -> tuple[FloatArray, FloatArray, FloatArray, IntArray]:
    """Times, values, sigmas and lines (n,)."""
    numbers = np.array([(row.tdb_s, row.value, row.sigma) for row in rows]).T
    return numbers[0], numbers[1], numbers[2], np.array([row.line for row in rows])


def _signal_sets(network: StationNetwork, rows: Sequence[Measurement]) -> Iterator[TrackingSet]:
    passes = _passes(network, rows)
    for kinds in ((TWO_WAY, THREE_WAY), (RATE,)):
        chosen = np.array([row.kind in kinds for row in rows])
        here = [row for row in rows if row.kind in kinds]
        if not here:
            continue
        times, values, sigmas, lines = _columns(here)
        receiver = np.array([row.receiver for row in here])
        sender = np.array([row.sender for row in here])
        if kinds == (RATE,):
            counts = np.array([row.count_s for row in here])
            start, end = (
                SignalGeometry(network, times + side * counts, receiver, sender)
                for side in (-0.5, 0.5)
            )
            _check_seen(network, here, start)
            _check_seen(network, here, end)
            yield RangeRates(values, sigmas, lines, passes.part(chosen), counts, start, end)
        else:
            geometry = SignalGeometry(network, times, receiver, sender)
            _check_seen(network, here, geometry)
            if not network.at_home:
                _check_units(here, geometry)
            yield Ranges(values, sigmas, lines, passes.part(chosen), geometry)


def _passes(network: StationNetwork, rows: Sequence[Measurement]) -> Passes:
    """Number the passes of each station, which end where its signals pause."""
    last: dict[int, tuple[float, int]] = {}
    pass_of, count = [], 0
    for row in rows:
        time, number = last.get(row.receiver, (-np.inf, -1))
        if row.tdb_s - time > PASS_GAP_S:
            number, count = count, count + 1
        last[row.receiver] = row.tdb_s, number
        pass_of.append(number)
    receiver = np.array([row.receiver for row in rows])
    return Passes(network, receiver, np.array(pass_of), count)


def _check_seen(
    network: StationNetwork, rows: Sequence[Measurement], geometry: SignalGeometry
) -> None:
    """Raise DataError for signals from where the body is below a station's least elevation."""
    if network.at_home:
        return
    sines = geometry.elevation_sines()
    for k, (column, stations) in enumerate(
        (("station", geometry.receiver), ("transmitter", geometry.sender))
    ):
        least = np.sin(np.radians([s.min_elevation_deg for s in network.stations]))[stations]
        low = np.flatnonzero(sines[:, k] < least)
        if len(low):
            row, station = rows[low[0]], network.stations[stations[low[0]]]
            elevation = float(np.degrees(np.arcsin(sines[low[0], k])))
            raise DataError(
                f"{row.where}: {column} {station.name} has the body at an elevation of "
                f"{elevation:.1f} deg at {utc_from_tdb_s(row.tdb_s, 0)}; wanted its "
                f"min_elevation_deg, {station.min_elevation_deg:g}, or more ({len(low)} such "
                "rows): see the station's place and the times, or remove them"
            )


def _check_units(rows: Sequence[Measurement], geometry: SignalGeometry) -> None:
    """Raise DataError for ranges that are far from the distance of the body."""
    lengths = geometry.distances_m()
    for row, length in zip(rows, lengths, strict=True):
        if abs(row.value - length) <= MAX_APART * length:
            continue
        ratio = row.value / length
        hint = "see station, time and unit"
        for factor, words in ((1e-3, "it may be in km"), (2.0, "it may be of both ways")):
            if abs(ratio / factor - 1.0) < MAX_APART:
                hint = words
        raise DataError(
            f"{row.where}: a {row.kind} of {row.value:.6g} is {ratio:.3g} times the distance of "
            f"the body, {length:.6g} m; wanted half of the round trip in m: {hint}"
        )


def _angles(rows: Sequence[Measurement], ephemeris: Ephemeris) -> Angles:
    times, values, sigmas, lines = _columns(rows)
    axis = np.array([int(row.kind == DECLINATION) for row in rows])
    points = np.array([row.point_m for row in rows])
    turned = (points[:, None] @ find_body_turns(ephemeris, times))[:, 0]
    return Angles(values, sigmas, lines, times, axis, turned)


def with_considered_signals(
    settings: OrbitFitSettings, sets: Sequence[TrackingSet], ephemeris: Ephemeris
) -> OrbitFitSettings:
    """Consider places of stations, troposphere and ephemeris where nothing is stated of them.

    Raises ConfigError for an ephemeris whose error is not known.
    """
    if not any(isinstance(part, SignalSet) for part in sets):
        return settings
    stated = {parameter.name for parameter in settings.parameter}
    added = []
    for name in CONSIDERED:
        if name in stated or (name == "ephemeris" and ephemeris.body.name == "earth"):
            continue
        sigma = None
        if name == "ephemeris" and isinstance(ephemeris, AnalyticEphemeris):
            if ephemeris.body.name != "moon":
                raise ConfigError(
                    f"the Earth's place as seen from {ephemeris.body.name} has no stated error "
                    "without SPICE kernels; name them in [spice], or state a [[parameter]] name = "
                    '"ephemeris" with its prior_sigma in m and mode = "consider"'
                )
            sigma = ANALYTIC_MOON_M
        added.append(ParameterSettings(name, prior_sigma=sigma, mode="consider"))
    return msgspec.structs.replace(settings, parameter=(*settings.parameter, *added))


def measurement_rows(source: ReadMeasurements, fit: OrbitFit) -> Iterator[dict[str, object]]:
    """Yield the rows of measurement_residuals.csv."""
    problem, looks = fit.problem, fit.looks
    for part, span in zip(problem.sets, problem.scalars.spans, strict=True):
        if not isinstance(part, TrackingSet):
            continue
        for k, number in enumerate(range(span.start, span.stop)):
            row, used = source.rows[int(part.lines[k])], bool(looks.used[number])
            yield {
                "utc": utc_from_tdb_s(row.tdb_s),
                "kind": row.kind,
                "station": source.stations[row.receiver] if row.receiver >= 0 else "",
                "line": row.line,
                "value": row.value,
                "residual": float(looks.residual[number]),
                "sigma": row.sigma,
                "chi_square": float(looks.chi_square[number]),
                "used": used,
                "reason": "" if used else LEFT_OUT,
            }


def measurement_lines(source: ReadMeasurements, fit: OrbitFit) -> list[str]:
    """Summarise the kinds for people: how many are used, and their residuals."""
    lines = []
    rows = list(measurement_rows(source, fit))
    for kind in dict.fromkeys(str(row["kind"]) for row in rows):
        of_kind = [row for row in rows if row["kind"] == kind]
        used = [row for row in of_kind if row["used"]]
        rms = float(np.sqrt(np.mean([float(str(row["residual"])) ** 2 for row in used] or [0.0])))
        lines.append(f"{kind}: {len(used)} of {len(of_kind)} used, residuals {rms:.3g} rms")
        out = [row for row in of_kind if not row["used"]]
        lines += [f"left out {kind} of line {row['line']}: {LEFT_OUT}" for row in out[:MAX_NAMED]]
        if len(out) > MAX_NAMED:
            lines.append(f"left out {len(out) - MAX_NAMED} more; see {MEASUREMENT_RESIDUALS_CSV}")
    return lines


def orbit_priors(
    settings: Sequence[OrbitPriorSettings],
    ephemeris: Ephemeris,
    beside: Path,
    ends: tuple[float, float],
) -> list[OrbitPrior]:
    """The priors, each at one time; ends: TDB s of the first and last measurement.

    Raises ConfigError or DataError for one that is wrong."""
    known = []
    for section in settings:
        if section.oem:
            known.append(_of_oem(section, ephemeris, beside / section.oem, ends))
        else:
            known.append(_of_state(section, ephemeris))
    for prior in known:
        if not np.linalg.eigvalsh(prior.covariance)[0] > 0.0:
            raise ConfigError(f"[[prior]] {prior.source}: its covariance is not positive definite")
    return known


def _of_state(settings: OrbitPriorSettings, ephemeris: Ephemeris) -> OrbitPrior:
    try:
        time = utc_to_tdb_s(settings.utc)
    except DataError as error:
        raise ConfigError(f"[[prior]] utc: {error}") from None
    state = np.array([*(settings.position_m or ()), *(settings.velocity_m_s or ())])
    covariance = matrix_of(settings.covariance) if settings.covariance else _spread(settings)
    if settings.frame == "body":
        step = ROTATION_STEP_S
        turn = stated_turn(ephemeris, time)
        rate = stated_turn(ephemeris, time + step) - stated_turn(ephemeris, time - step)
        # x' = Q x, v' = Q v + Q' x
        inertial_from_body = np.kron(np.eye(2), turn.T)
        inertial_from_body[3:, :3] = -turn.T @ rate @ turn.T / (2.0 * step)
        state = inertial_from_body @ state
        covariance = inertial_from_body @ covariance @ inertial_from_body.T
    return OrbitPrior(time, state, covariance, f"state at {settings.utc}")


def _of_oem(
    settings: OrbitPriorSettings, ephemeris: Ephemeris, path: Path, ends: tuple[float, float]
) -> OrbitPrior:
    """Its state at a covariance nearest the middle of the fixes, or with the stated sigmas.

    With these it is a state of the file itself, which no interpolation can be wrong by.
    """
    oem = read_oem(path, ephemeris.body)
    first, last = ends
    middle = 0.5 * (first + last)
    if oem.times[-1] < first or oem.times[0] > last:
        start, end = (utc_from_tdb_s(float(oem.times[k]), 0) for k in (0, -1))
        raise DataError(f"{path}: its states, {start} to {end}, are of another time than the fixes")
    if settings.position_sigma_m is not None and settings.velocity_sigma_m_s is not None:
        k = int(np.argmin(np.abs(oem.times - middle)))
        return OrbitPrior(float(oem.times[k]), oem.states[k], _spread(settings), str(path))
    if not len(oem.covariances):
        raise DataError(
            f"{path}: has no covariance; add position_sigma_m and velocity_sigma_m_s to its "
            "[[prior]]"
        )
    k = int(np.argmin(np.abs(oem.covariance_times - middle)))
    time = float(oem.covariance_times[k])
    return OrbitPrior(time, oem.state_at(time), oem.covariances[k], str(path))


def _spread(settings: OrbitPriorSettings) -> FloatArray:
    position, velocity = settings.position_sigma_m or 0.0, settings.velocity_sigma_m_s or 0.0
    return np.diag([position**2] * 3 + [velocity**2] * 3)
