"""The page about an orbit's folder: residuals, errors or sigmas, ellipses, parameters, track."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from markupsafe import Markup

from catalog.arrays import BoolArray, FloatArray
from catalog.bodies.epochs import utc_from_tdb_s, utc_to_tdb_s
from catalog.geometry.ellipsoid import geodetic_from_xyz
from catalog.geometry.latlon import latlon_from_xyz
from catalog.tables import CsvRow
from optnav_cli.frames.orbit_tables import AXES, ORBIT_ERRORS, ORBIT_RESIDUALS, ZENITH_RESIDUALS
from optnav_cli.orbit.fit.evaluate import ERRORS_CSV
from optnav_cli.orbit.fit.folder import RESIDUALS, StoredOrbit, read_orbit, rnb_turn, stated_turn
from optnav_cli.orbit.fit.settings import UNITS
from optnav_cli.orbit.fit.zenith_job import ZENITH_RESIDUALS_CSV
from optnav_cli.output.manifest import read_manifest
from optnav_cli.output.wording import format_json, format_length
from optnav_cli.report import page as html
from optnav_cli.report.sheet import LegendEntry, Panel, draw_sheet
from optnav_cli.report.svg import HALF, NARROW, WIDE, Plot, PlotAxis, find_span

HOURS = "h after the first row"
ELLIPSES = 5  # times whose ellipses are drawn
STATED = 3.0  # sigmas of bands and ellipses
SERIES = ("s1", "s2", "s3", "s5", "s4")
SQUARE = 380


@dataclass(frozen=True, eq=False)
class OrbitPicture:
    """Data of the plots: times in hours after the first row of orbit.csv.

    fix_hours, residuals, fix_sigmas, used  of the fixes, (n,), (n, 3), (n, 3), (n,), m
    hours, errors, sigmas                   of the orbit against a truth; empty without one
    path_hours, path_sigmas                 of the rows, (k,), (k, 3)
    looks                                   of zenith distances in place of fixes, (m, 4): hours,
                                            residual and sigma in arc seconds, whether used
    """

    orbit: StoredOrbit
    fix_hours: FloatArray
    residuals: FloatArray
    fix_sigmas: FloatArray
    used: BoolArray
    hours: FloatArray
    errors: FloatArray
    sigmas: FloatArray
    ahead: BoolArray
    looks: FloatArray | None = None

    @property
    def path_hours(self) -> FloatArray:
        """Times of the rows of orbit.csv, h."""
        times = self.orbit.rows.times
        hours: FloatArray = (times - times[0]) / 3600.0
        return hours

    def own(self, k: int) -> FloatArray:
        """Covariance (3, 3) of a row's place along R, N, B."""
        rows = self.orbit.rows
        turn = rnb_turn(rows.states[k])
        covariance: FloatArray = turn[:3] @ rows.covariances[k] @ turn[:3].T
        return covariance


def read_picture(folder: Path) -> OrbitPicture:
    """Read the files of a folder. Raises DataError for damaged ones."""
    orbit = read_orbit(folder)
    start = float(orbit.rows.times[0])
    fixes, looks = [], None
    if (folder / ZENITH_RESIDUALS_CSV).exists():
        looks = np.array(ZENITH_RESIDUALS.read(folder / ZENITH_RESIDUALS_CSV, _look))
        looks[:, 0] = (looks[:, 0] - start) / 3600.0
    else:
        fixes = ORBIT_RESIDUALS.read(folder / RESIDUALS, lambda row: _fix(row, start))
    errors: list[tuple[float, float, FloatArray, FloatArray]] = []
    if (folder / ERRORS_CSV).exists():
        errors = ORBIT_ERRORS.read(folder / ERRORS_CSV, lambda row: _error(row, start))
    return OrbitPicture(
        orbit,
        np.array([fix[0] for fix in fixes]),
        np.array([fix[1] for fix in fixes]).reshape(-1, 3),
        np.array([fix[2] for fix in fixes]).reshape(-1, 3),
        np.array([fix[3] for fix in fixes], bool),
        np.array([error[0] for error in errors]),
        np.array([error[2] for error in errors]).reshape(-1, 3),
        np.array([error[3] for error in errors]).reshape(-1, 3),
        np.array([error[1] > 0.0 for error in errors], bool),
        looks,
    )


def orbit_page(folder: Path) -> str:
    """The page. Raises DataError for a folder whose tables are damaged."""
    drawn = read_picture(folder)
    orbit, test = drawn.orbit, drawn.orbit.file.test
    first, last = (utc_from_tdb_s(float(orbit.rows.times[k]), 0) for k in (0, -1))
    numbers = [
        (f"{test.used} of {test.fixes}", f"{_measured(drawn)} used"),
        (format_length(_middle_sigma(drawn)), "median sigma an axis"),
        (f"{test.chi_square:.0f} of {test.degrees_of_freedom}", "chi-square"),
    ]
    if len(drawn.errors) and not drawn.ahead.all():
        rms = float(np.sqrt(np.mean(drawn.errors[~drawn.ahead] ** 2)))
        numbers.append((format_length(rms), "error, rms an axis"))
    remarks = [html.paragraph(remark, "note") for remark in test.remarks]
    sections = [
        html.section("Result", html.tiles(numbers), *remarks),
        html.section("Residuals", _residuals(drawn)),
        html.section("Errors" if len(drawn.errors) else "Stated sigmas", *_errors(drawn)),
        html.section("Covariances", _ellipses(drawn)),
        html.section("Parameters", _parameters(orbit)),
        html.section("Ground track", _track(drawn)),
        html.section("How it was made", html.format_listing(format_json(read_manifest(folder)))),
    ]
    words = f"{orbit.body.name.capitalize()}, {first} to {last}"
    return html.build_page(f"An orbit through {_measured(drawn)}", words, sections)


def orbit_sheet(folder: Path) -> str:
    """Errors along R, N, B as a picture that stands alone; residuals where there is no truth."""
    drawn = read_picture(folder)
    inside = ~drawn.ahead
    compared = bool(len(drawn.errors) and inside.any())
    if drawn.looks is not None:
        plot = _look_plot(drawn.looks, WIDE)
        legend = [LegendEntry("s1", "residuals, 3 sigma"), LegendEntry("s4", "left out", "circle")]
        what = f"Zenith distances less the orbit, {drawn.orbit.body.name.capitalize()}"
        return draw_sheet(what, legend, [[Panel("", plot, "Residuals of zenith distances")]])
    panels = []
    for axis, name in enumerate(AXES):
        plot = (
            _error_plot(drawn, axis, inside, HALF)
            if compared
            else _residual_plot(drawn, axis, HALF)
        )
        panels.append([Panel("", plot, f"along {name.upper()}")])
    legend = [LegendEntry("s1", "orbit, 3 sigma"), LegendEntry("s3", "fixes", "circle", False)]
    if not compared:
        legend = [LegendEntry("s1", "residuals, 3 sigma"), LegendEntry("s4", "left out", "circle")]
    what = "An orbit and its fixes against the truth" if compared else "Fixes less the orbit"
    return draw_sheet(f"{what}, {drawn.orbit.body.name.capitalize()}", legend, panels)


def _measured(drawn: OrbitPicture) -> str:
    return "fixes" if drawn.looks is None else "zenith distances"


def _look_plot(looks: FloatArray, width: int) -> Plot:
    """Residuals of zenith distances with their sigmas."""
    hours, residuals, bound, used = looks[:, 0], looks[:, 1], STATED * looks[:, 2], looks[:, 3] > 0
    ends = find_span(np.concatenate([residuals[used], bound, -bound]), 0.08)
    axes = PlotAxis(find_span(hours, 0.03), HOURS), PlotAxis(ends, "residual, arc seconds")
    plot = Plot(*axes, width=width, height=230)
    plot.band(hours, -bound, bound, "s1")
    plot.level(0.0)
    plot.marks(hours[used], residuals[used], "s1", "circle", 1.6)
    plot.marks(hours[~used], np.clip(residuals[~used], *ends), "s4", "circle", 4.2)
    return plot


def _look_residuals(looks: FloatArray) -> Markup:
    drawings = [
        html.side_by_side(kind, [_look_plot(looks, width).svg("Residuals of zenith distances")])
        for kind, width in (("wider", WIDE), ("narrow", NARROW))
    ]
    out = int((looks[:, 3] == 0.0).sum())
    caption = (
        f"Zenith distance less that of the orbit; the band is 3 stated sigmas; {out} left out."
    )
    keys = {"k1": "used", "k4": "left out"} if out else None
    return html.figure(Markup().join(drawings), caption, keys)


def _residuals(drawn: OrbitPicture) -> Markup:
    if drawn.looks is not None:
        return _look_residuals(drawn.looks)
    drawings = []
    for kind, width in (("wider", WIDE), ("narrow", NARROW)):
        plots = [
            _residual_plot(drawn, axis, width).svg(f"Residuals along {name.upper()}")
            for axis, name in enumerate(AXES)
        ]
        drawings.append(html.side_by_side(kind, plots))
    out = int((~drawn.used).sum())
    caption = f"Fix less orbit; bands are 3 stated sigmas of the fixes; {out} left out."
    keys = {"k1": "used", "k4": "left out"} if out else None
    return html.figure(Markup().join(drawings), caption, keys)


def _residual_plot(drawn: OrbitPicture, axis: int, width: int) -> Plot:
    x, y = drawn.fix_hours, drawn.residuals[:, axis]
    bound = STATED * drawn.fix_sigmas[:, axis]
    ends = find_span(np.concatenate([y[drawn.used], bound, -bound]), 0.08)
    inside = np.clip(y, *ends)  # one that is left out may lie anywhere: at the edge then
    axes = (
        PlotAxis(find_span(x, 0.03), HOURS if axis == 2 else ""),
        PlotAxis(ends, f"{AXES[axis].upper()}, m"),
    )
    plot = Plot(*axes, width=width, height=190)
    if len(x) > 1:
        plot.band(x, -bound, bound, "s1")
    plot.level(0.0)
    plot.marks(x[drawn.used], y[drawn.used], "s1", "circle")
    plot.marks(x[~drawn.used], inside[~drawn.used], "s4", "circle", 4.2)
    return plot


def _errors(drawn: OrbitPicture) -> Iterator[Markup]:
    """Errors on the arc, and of predictions; without a truth the sigmas of the rows."""
    if not len(drawn.errors):
        yield _sigmas(drawn)
        return
    inside = ~drawn.ahead
    for chosen, words in (
        (inside, "Orbit less truth; bands are 3 stated sigmas; dots are the fixes' own errors."),
        (drawn.ahead, "Predictions after the last fix; bands are 3 stated sigmas."),
    ):
        if not chosen.any():
            continue
        drawings = []
        for kind, width in (("wider", WIDE), ("narrow", NARROW)):
            plots = [
                _error_plot(drawn, axis, chosen, width).svg(f"Errors along {name.upper()}")
                for axis, name in enumerate(AXES)
            ]
            drawings.append(html.side_by_side(kind, plots))
        keys = {"k1": "orbit", "k3": "fixes"} if chosen is inside else None
        yield html.figure(Markup().join(drawings), words, keys)


def _error_plot(drawn: OrbitPicture, axis: int, chosen: BoolArray, width: int) -> Plot:
    x, y = drawn.hours[chosen], drawn.errors[chosen, axis]
    bound = STATED * drawn.sigmas[chosen, axis]
    on_arc = not drawn.ahead[chosen].any()
    fixes_x, fixes_y = _own_errors(drawn, axis) if on_arc else (np.empty(0), np.empty(0))
    ends = find_span(np.concatenate([y, bound, -bound, fixes_y]), 0.08)
    unit, name = (1e3, "km") if max(map(abs, ends)) > 5e3 else (1.0, "m")
    label = f"{AXES[axis].upper()}, {name}"
    axes = (
        PlotAxis(find_span(x, 0.03), HOURS if axis == 2 else ""),
        PlotAxis((ends[0] / unit, ends[1] / unit), label),
    )
    plot = Plot(*axes, width=width, height=190)
    if len(x) > 1:
        plot.band(x, -bound / unit, bound / unit, "s1")
    plot.level(0.0)
    plot.marks(fixes_x, fixes_y / unit, "s3", "circle", 2.4)
    plot.line(x, y / unit, "s1")
    plot.marks(x, y / unit, "s1", "circle", 2.4)
    return plot


def _own_errors(drawn: OrbitPicture, axis: int) -> tuple[FloatArray, FloatArray]:
    """Match the orbit's error and the residual of each fix used, where both have the same time."""
    inside = ~drawn.ahead
    if not inside.any():
        return np.empty(0), np.empty(0)
    near = np.abs(drawn.hours[inside][None] - drawn.fix_hours[:, None]).argmin(axis=1)
    apart = np.abs(drawn.hours[inside][near] - drawn.fix_hours) * 3600.0
    kept = drawn.used & (apart < 0.05)
    errors = drawn.errors[inside][near, axis] + drawn.residuals[:, axis]
    return drawn.fix_hours[kept], errors[kept]


def _sigmas(drawn: OrbitPicture) -> Markup:
    hours = drawn.path_hours
    sigmas = np.array([np.sqrt(np.diag(drawn.own(k))) for k in range(len(hours))])
    drawings = []
    for kind, width in (("wider", WIDE), ("narrow", NARROW)):
        axes = (
            PlotAxis(find_span(hours, 0.03), HOURS),
            PlotAxis((0.0, 1.08 * float(sigmas.max())), "sigma, m"),
        )
        plot = Plot(*axes, width=width, height=230)
        for axis, series in enumerate(SERIES[:3]):
            plot.line(hours, sigmas[:, axis], series)
        drawings.append(html.side_by_side(kind, [plot.svg("Stated sigmas over time")]))
    keys = {"k1": "R, up", "k2": "N, forward", "k3": "B, across"}
    return html.figure(Markup().join(drawings), "Stated 1 sigma of the orbit's place.", keys)


def _ellipses(drawn: OrbitPicture) -> Markup:
    """3-sigma ellipses of the place in two planes, at some times of the arc."""
    chosen = np.unique(np.linspace(0, len(drawn.path_hours) - 1, ELLIPSES).astype(int))
    plots, keys = [], {}
    turns = np.linspace(0.0, 2.0 * np.pi, 73)
    circle = np.stack([np.cos(turns), np.sin(turns)])
    for across, name in ((1, "N, forward"), (2, "B, across")):
        curves = []
        for k in chosen:
            part = drawn.own(int(k))[np.ix_([across, 0], [across, 0])]
            curves.append(STATED * np.linalg.cholesky(part) @ circle)
        reach = 1.1 * max(float(np.abs(curve).max()) for curve in curves)
        axes = PlotAxis((-reach, reach), f"{name}, m"), PlotAxis((-reach, reach), "R, up, m")
        plot = Plot(*axes, width=HALF, height=SQUARE, equal=True)
        for number, curve in enumerate(curves):
            plot.line(curve[0], curve[1], SERIES[number], closed=True)
        plots.append(plot.svg(f"Ellipses of 3 sigma, R over {name}"))
    for number, k in enumerate(chosen):
        keys[f"k{SERIES[number][1]}"] = f"{drawn.path_hours[k]:.1f} h"
    words = "Ellipses of 3 stated sigmas at times of the arc."
    return html.figure(html.side_by_side("pair", plots), words, keys)


def _parameters(orbit: StoredOrbit) -> Markup:
    rows = []
    for p in orbit.parameters:
        whose = " ".join(filter(None, (p.camera, p.run))) or "all"
        unit = UNITS.get(p.name, UNITS["acceleration"])
        for value, sigma in zip(p.value, p.sigma, strict=True):
            known = (
                "considered"
                if p.mode == "consider"
                else "observed"
                if p.observed
                else "not observed"
            )
            numbers = (f"{value:.6g}", f"{sigma:.2g}", f"{p.prior_sigma:.2g}")
            rows.append((p.name, whose, unit, known, *numbers))
    if not rows:
        return html.paragraph("Nothing but the orbit was solved for.")
    header = ("parameter", "of", "unit", "", "value", "sigma", "sigma before")
    return html.table(header, rows, text_columns=4)


def _track(drawn: OrbitPicture) -> Markup:
    rows, orbit = drawn.orbit.rows, drawn.orbit
    places = np.array(
        [
            stated_turn(orbit.ephemeris, float(time)) @ state[:3]
            for time, state in zip(rows.times, rows.states, strict=True)
        ]
    )
    body = orbit.body
    kind = "geodetic latitude" if body.flattening else "latitude"
    angles = geodetic_from_xyz(places, body.radii_m) if body.flattening else latlon_from_xyz(places)
    lat, lon = (np.degrees(v) for v in angles[:2])
    broken = np.flatnonzero(np.abs(np.diff(lon)) > 180.0) + 1
    line = np.insert(lon, broken, np.nan), np.insert(lat, broken, np.nan)
    fixes = np.array([kind == "fix" for kind in rows.kinds])
    degrees = PlotAxis((-180.0, 180.0), "longitude, °", numbers=range(-180, 181, 60))
    plot = Plot(
        degrees, PlotAxis((-90.0, 90.0), f"{kind}, °", numbers=range(-90, 91, 30)), height=400
    )
    plot.line(*line, "s1 thin")
    plot.marks(lon[fixes], lat[fixes], "s3", "circle", 2.4)
    keys = {"k1": "orbit", "k3": "fixes"} if fixes.any() else None
    words = "Ground below the orbit, and its fixes." if fixes.any() else "Ground below the orbit."
    return html.figure(plot.svg("Ground track"), words, keys)


def _middle_sigma(drawn: OrbitPicture) -> float:
    variances = [np.trace(c[:3, :3]) / 3.0 for c in drawn.orbit.rows.covariances]
    return float(np.sqrt(np.median(variances)))


def _fix(row: CsvRow, start: float) -> tuple[float, FloatArray, FloatArray, bool]:
    residual = row.vector([f"residual_{a}_m" for a in AXES])
    sigma = row.vector([f"sigma_{a}_m" for a in AXES])
    hours = (utc_to_tdb_s(row["utc"]) - start) / 3600.0
    nothing = np.full(3, np.nan)
    return (
        hours,
        nothing if residual is None else residual,
        nothing if sigma is None else sigma,
        row.flag("used"),
    )


def _look(row: CsvRow) -> tuple[float, float, float, float]:
    """TDB s, residual and sigma in arc seconds, whether it is used."""
    residual, sigma = row.number("residual_arcsec") or 0.0, row.number("sigma_arcsec") or 0.0
    return utc_to_tdb_s(row["utc"]), residual, sigma, float(row.flag("used"))


def _error(row: CsvRow, start: float) -> tuple[float, float, FloatArray, FloatArray]:
    error = row.vector([f"error_{a}_m" for a in AXES])
    sigma = row.vector([f"sigma_{a}_m" for a in AXES])
    hours = (utc_to_tdb_s(row["utc"]) - start) / 3600.0
    nothing = np.full(3, np.nan)
    return (
        hours,
        row.number("hours") or 0.0,
        nothing if error is None else error,
        nothing if sigma is None else sigma,
    )
