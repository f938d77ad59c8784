"""Picked points: what constructions cost against least squares, and what the lens does."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from catalog.arrays import FloatArray
from catalog.bodies.body import load_body
from catalog.errors import NoSolutionError
from catalog.geometry.latlon import latlon_from_xyz, xyz_from_latlon
from catalog.progress import Progress
from optnav_cli.fix import Fix, Solution
from optnav_cli.frames.frames import Frame
from optnav_cli.frames.points import PickedPoint
from optnav_cli.frames.run_settings import FileAttitude, PointsSettings
from optnav_cli.points.constructions import CircleGround, Picks, locate_by_circles, locate_by_tori
from optnav_cli.points.method import PickedFrames
from optnav_cli.report.sheet import LegendEntry, Panel, draw_sheet
from optnav_cli.report.svg import Plot, PlotAxis
from tests.studies.picked_lens import picked_lens_figures
from tests.studies.picked_orbits import series_figures
from tests.studies.picked_pictures import CAMERA, RELIEF_M, PickedPicture, picked_picture
from tests.studies.tables import Cell, StudyReport, StudyTable, columns, rms

PICK_PX, PLACE_M, OFF_DEG, LENS = 0.7, 10.0, 37.0, 0.009
BLUNDER_PX = 68.0
COUNTS, ANGLES_DEG = (4, 5, 8, 20, 50, 100), (0.0, 10.0, 20.0, 30.0, 37.0, 50.0)
INSIDE = 14.16  # of a chi-square of three: 3 sigmas
WAYS = columns(
    "way; points; trials; horizontal [km] .3f; vertical [km] .3f; "
    "unsolved; seed = source; trial = prototype; asked = asked ≤"
)
NUMBERS = columns(
    "points; horizontal [km] .3f; vertical [km] .3f; nees = NEES .2f; inside = in 3σ [%] .0f; "
    "unsolved"
)
TILTS = columns(
    "angle = off the nadir [°] .0f; horizontal [km] .3f; vertical [km] .3f; nees = NEES .2f; "
    "unsolved"
)
SERIES = columns("figure; wanted; found .3g; flights")
LENSES = columns(
    "lens; horizontal [km] .2f; vertical [km] .2f; angle = from the line of sight, median [°] .1f; "
    "nees = NEES .2f; inside = in 3σ [%] .0f"
)
BLUNDERS = columns(
    "points; blunders; found [%] .1f; dropped = right ones left out [%] .2f; solved [%] .0f; "
    "kept = error with them kept [km] .2f; error = error [km] .2f"
)


@dataclass(frozen=True, eq=False)
class PointsFigures:
    """Rows of the study's tables."""

    ways: list[tuple[Cell, ...]]
    numbers: list[tuple[Cell, ...]]
    tilts: list[tuple[Cell, ...]]
    lenses: list[tuple[Cell, ...]]
    blunders: list[tuple[Cell, ...]]
    three: tuple[int, int, float]
    series: list[tuple[Cell, ...]]


@dataclass(frozen=True, eq=False)
class _Trial:
    """A picture with noise, and what `optnav navigate` makes of it."""

    picture: PickedPicture
    places_m: FloatArray
    pixels: FloatArray
    row: Solution

    @property
    def error(self) -> tuple[float, float]:
        """Horizontal and vertical, m; NaN of an unsolved one."""
        place = self.row.position_m
        return (np.nan, np.nan) if place is None else self.picture.error_of(place)

    @property
    def normalised(self) -> float:
        """Squared error over its covariance."""
        fix = self.row.fix
        if fix is None:
            return np.nan
        off = fix.position_m - self.picture.position_m
        return float(off @ np.linalg.solve(fix.covariance_m2, off))


class _Study:
    """Draws pictures of the Earth and solves them by the method of `optnav navigate`."""

    def __init__(self, trials: int, seed: int) -> None:
        self.trials, self._seed = trials, seed
        self.body = load_body("earth")
        attitude = FileAttitude("camera_from_body", self.body)
        self._frames = PickedFrames(attitude, PointsSettings("planetocentric", "sphere"))

    def trial(
        self,
        number: int,
        count: int,
        off_deg: float = OFF_DEG,
        lens: tuple[float, float] = (1.0, 0.0),
        blunders: int = 0,
        noise: float = 1.0,
    ) -> _Trial:
        """lens: the true focal length over the stated one, and its stated error.

        noise: of picks and places, over the stated one; without any the ground has no relief
        """
        rng = np.random.default_rng([self._seed, number, count, round(off_deg)])
        picture = picked_picture(
            self.body, rng, count, off_deg, lens[0], RELIEF_M if noise else 0.0
        )
        pixels = picture.pixels + noise * rng.normal(0.0, PICK_PX, (count, 2))
        places = picture.places_m + noise * rng.normal(0.0, PLACE_M, (count, 3))
        angle = rng.uniform(0.0, 2.0 * np.pi, blunders)
        pixels[:blunders] += BLUNDER_PX * np.column_stack([np.cos(angle), np.sin(angle)])
        camera = replace(CAMERA, focal_length_error=lens[1])
        frame = Frame("a", "2024-06-01T10:00:00Z", camera.name)
        row = self._frames.solve(frame, camera, self._points(places, pixels))
        return _Trial(picture, places, pixels, row)

    def _points(self, places: FloatArray, pixels: FloatArray) -> list[PickedPoint]:
        lat, lon, radius = latlon_from_xyz(places)
        latlon = np.degrees(np.column_stack([lat, lon]))
        heights = radius - self.body.radius_m
        return [
            PickedPoint("a", str(n), pixels[n], latlon[n], float(heights[n]), PICK_PX, PLACE_M)
            for n in range(len(pixels))
        ]


def run(progress: Progress, trials: int = 200, seed: int = 1) -> PointsFigures:
    """All tables."""
    study = _Study(trials, seed)
    parts: list[Callable[[_Study], list[tuple[Cell, ...]]]] = [
        _ways,
        _numbers,
        _tilts,
        _lenses,
        _blunders,
    ]
    rows = []
    with progress.stage("study points", len(parts) + 2, "table") as bar:
        for part in parts:
            rows.append(part(study))
            bar.advance()
        three = _three(study)
        bar.advance()
        flights = max(2 * trials // 5, 2)
        figures = [*series_figures(flights, seed), *picked_lens_figures(flights, seed)]
        series: list[tuple[Cell, ...]] = [(f.what, f.wanted, f.found, f.flights) for f in figures]
        bar.advance()
    ways, numbers, tilts, lenses, blunders = rows
    return PointsFigures(ways, numbers, tilts, lenses, blunders, three, series)


def _sizes(errors: Sequence[tuple[float, float]]) -> tuple[float, float, int]:
    """Rms of both in km, and how many are not solved."""
    known = np.array([e for e in errors if np.isfinite(e).all()]).reshape(-1, 2)
    return rms(known[:, 0]) / 1e3, rms(known[:, 1]) / 1e3, len(errors) - len(known)


def _ways(study: _Study) -> list[tuple[Cell, ...]]:
    few, many, exact = (
        [study.trial(n, count, noise=noise) for n in range(study.trials)]
        for count, noise in ((4, 1.0), (20, 1.0), (4, 0.0))
    )
    rows: list[tuple[Cell, ...]] = []

    def add(way: str, tried: list[_Trial], errors: list[tuple[float, float]], *said: str) -> None:
        rows.append((way, len(tried[0].pixels), len(tried), *_sizes(errors), *said))

    add("least squares", many, [t.error for t in many], "3 / 4-6", "0.27 / 0.19", "0.30 / 0.25")
    add("least squares", few, [t.error for t in few], "3 / 4-6", "0.41 / 0.29", "0.45 / 0.35")
    circles = [_circles(t, "tangent") for t in few]
    add("circles, points moved to the tangent plane", few, circles, "", "1.3 / 4.5", "")
    circles = [_circles(t, "tangent") for t in many]
    add("circles, points moved to the tangent plane", many, circles, "", "", "")
    circles = [_circles(t, "map") for t in exact]
    add("circles by a map of latitude, longitude, exact points", exact, circles, "", "4 / 16", "")
    circles = [_circles(t, "flat") for t in exact]
    add("circles on a flat map of east, north, exact points", exact, circles, "", "", "")
    circles = [_circles(t, "tangent") for t in exact]
    add("circles on the tangent plane, exact points", exact, circles, "", "", "")
    add("tori of the three widest points", many, [_tori(t) for t in many], "", "", "")
    return rows


def _picks(trial: _Trial) -> Picks:
    rays = CAMERA.unproject(trial.pixels)
    half = min(CAMERA.shape) / 2.0 / CAMERA.focal_length_px
    return Picks(trial.places_m, rays[:, :2] / rays[:, 2:], half)


def _circles(trial: _Trial, ground: CircleGround) -> tuple[float, float]:
    try:
        return trial.picture.error_of(locate_by_circles(_picks(trial), ground))
    except NoSolutionError:
        return np.nan, np.nan


def _tori(trial: _Trial) -> tuple[float, float]:
    if trial.row.position_m is None:
        return np.nan, np.nan
    try:
        return trial.picture.error_of(locate_by_tori(_picks(trial), trial.row.position_m))
    except NoSolutionError:
        return np.nan, np.nan


def _honesty(trials: Sequence[_Trial]) -> tuple[float, float]:
    """Mean normalised error squared over its expectation, and share inside 3 sigmas, %."""
    squares = np.array([t.normalised for t in trials if t.row.solved])
    return float(squares.mean()) / 3.0, 100.0 * float((squares < INSIDE).mean())


def _numbers(study: _Study) -> list[tuple[Cell, ...]]:
    rows: list[tuple[Cell, ...]] = []
    for count in COUNTS:
        tried = [study.trial(n, count) for n in range(study.trials)]
        horizontal, vertical, unsolved = _sizes([t.error for t in tried])
        rows.append((count, horizontal, vertical, *_honesty(tried), unsolved))
    return rows


def _tilts(study: _Study) -> list[tuple[Cell, ...]]:
    rows: list[tuple[Cell, ...]] = []
    for angle in ANGLES_DEG:
        tried = [study.trial(n, 20, angle) for n in range(study.trials)]
        horizontal, vertical, unsolved = _sizes([t.error for t in tried])
        rows.append((angle, horizontal, vertical, _honesty(tried)[0], unsolved))
    return rows


def _lenses(study: _Study) -> list[tuple[Cell, ...]]:
    rng = np.random.default_rng(study.trials)
    drawn = 1.0 + LENS * rng.normal(size=study.trials)
    cases = {
        "0.9 % longer, not stated": [(1.0 + LENS, 0.0)] * study.trials,
        "0.9 % longer, 0.9 % stated": [(1.0 + LENS, LENS)] * study.trials,
        "off by 0.9 % (1σ), stated": [(float(focal), LENS) for focal in drawn],
    }
    rows: list[tuple[Cell, ...]] = []
    for name, lenses in cases.items():
        tried = [study.trial(n, 20, lens=lens) for n, lens in enumerate(lenses)]
        horizontal, vertical, _ = _sizes([t.error for t in tried])
        angles = []
        for t in tried:
            if isinstance(t.row.outcome, Fix):
                off = t.row.outcome.position_m - t.picture.position_m
                sight = t.picture.camera_from_body.inv().apply((0.0, 0.0, 1.0))
                cosine = abs(off @ sight) / np.linalg.norm(off)
                angles.append(np.degrees(np.arccos(min(float(cosine), 1.0))))
        rows.append((name, horizontal, vertical, float(np.median(angles)), *_honesty(tried)))
    return rows


def _blunders(study: _Study) -> list[tuple[Cell, ...]]:
    rows: list[tuple[Cell, ...]] = []
    for count, blunders in ((6, 1), (8, 1), (20, 1), (20, 4), (50, 10)):
        tried = [study.trial(n, count, blunders=blunders) for n in range(study.trials)]
        solved = [t for t in tried if t.row.solved]
        used = np.array([[m.used for m in t.row.evidence.matches] for t in solved])
        kept = [t for t in solved if any(m.used for m in t.row.evidence.matches[:blunders])]
        clean = [t for t in solved if t not in kept]
        rows.append(
            (
                count,
                blunders,
                100.0 * float((~used[:, :blunders]).mean()),
                100.0 * float((~used[:, blunders:]).mean()),
                100.0 * len(solved) / len(tried),
                rms(np.array([np.hypot(*t.error) for t in kept])) / 1e3 if kept else None,
                rms(np.array([np.hypot(*t.error) for t in clean])) / 1e3,
            )
        )
    return rows


def _three(study: _Study) -> tuple[int, int, float]:
    """Pictures of three points; those with two places above the ground; their distance, km."""
    tried = [study.trial(n, 3) for n in range(min(study.trials, 60))]
    two, apart = 0, []
    for trial in tried:
        words = trial.row.reason
        two += "from 2 places" in words
        if "from 2 places" in words:
            places = [_place_of(part) for part in words.split(": ")[-1].split("; ")[:2]]
            apart.append(float(np.linalg.norm(places[0] - places[1])))
    return len(tried), two, float(np.median(apart)) / 1e3 if apart else np.nan


def _place_of(words: str) -> FloatArray:
    """Read the place (3,), m, that a reason writes as "geodetic LAT LON deg, H km high"."""
    lat, lon, _, height = words.removeprefix("geodetic ").split()[:4]
    up = xyz_from_latlon(np.radians(float(lat)), np.radians(float(lon)), 1.0)
    radii = np.array(load_body("earth").radii_m)
    # the point of the ellipsoid whose normal is `up`
    place: FloatArray = radii**2 * up / np.linalg.norm(radii * up) + 1e3 * float(height) * up
    return place


def report(result: PointsFigures) -> StudyReport:
    """The tables."""
    pictures, two, apart = result.three
    return StudyReport(
        (
            StudyTable("Ways to a place", WAYS, tuple(result.ways)),
            StudyTable("Least squares by the number of points", NUMBERS, tuple(result.numbers)),
            StudyTable("20 points by the angle off the nadir", TILTS, tuple(result.tilts)),
            StudyTable("A lens that is not what it says, 20 points", LENSES, tuple(result.lenses)),
            StudyTable(f"Blunders of {BLUNDER_PX:g} px", BLUNDERS, tuple(result.blunders)),
            StudyTable("An orbit through a series of pictures", SERIES, tuple(result.series)),
        ),
        (
            f"pictures of the Earth from 420 km through 400 mm, {OFF_DEG:g}° off the nadir, picked "
            f"to {PICK_PX:g} px on a map good to {PLACE_M:g} m; rms. Truth: relief on WGS 84, rays "
            "through the air by Bouguer's law",
            f"three points: {two} of {pictures} pictures have two places above the ground, "
            f"{apart:.0f} km apart in the median",
        ),
    )


def picture(result: PointsFigures) -> str:
    """Errors by number of points and by angle (SVG)."""
    legend = [
        LegendEntry("s1", "horizontal", "circle"),
        LegendEntry("s3", "vertical", "triangle"),
    ]
    panels = [
        _panel("number of points", result.numbers, log_x=True),
        _panel("angle off the nadir, °", result.tilts, log_x=False),
    ]
    return draw_sheet("Errors of a place from picked points, rms", legend, [panels])


def _panel(title: str, rows: Sequence[tuple[Cell, ...]], *, log_x: bool) -> Panel:
    x = [float(str(row[0])) for row in rows]
    at = np.log10(x) if log_x else np.array(x)
    span = (float(at.min()) - 0.05 * float(np.ptp(at)), float(at.max()) + 0.05 * float(np.ptp(at)))
    x_axis = PlotAxis(span, title, log=True) if log_x else PlotAxis(span, title)
    plot = Plot(x_axis, PlotAxis((-1.5, 1.0), "error, km", log=True), width=480, height=340)
    for series, shape, place in (("s1", "circle", 1), ("s3", "triangle", 2)):
        y = np.log10([float(str(row[place])) for row in rows])
        plot.line(at, y, series)
        plot.marks(at, y, series, shape)
    return Panel(title, plot, f"Errors against the {title}, log scale")
