"""Errors of a run against time and distance, by method and camera, with 3 stated sigmas.

Zhukov (2025), figures 4 and 5, shows the same: R, N, B over an orbit, and the errors of range and
direction over a transfer, each method in its own colour.
"""

import math
from collections import Counter
from dataclasses import dataclass
from itertools import groupby

import numpy as np
from markupsafe import Markup

from catalog.arrays import BoolArray, FloatArray, IndexArray
from catalog.bodies.epochs import utc_to_tdb_s
from catalog.errors import DataError
from optnav_cli.evaluation.figures import describe_method, rank_method
from optnav_cli.evaluation.files import EVALUATION_CSV, ErrorRow, make_stated_rows, read_error_rows
from optnav_cli.output.run_folder import RunFolder
from optnav_cli.report.page import figure, side_by_side
from optnav_cli.report.sheet import LegendEntry, Panel, draw_sheet
from optnav_cli.report.svg import MOST, NARROW, WIDE, Plot, PlotAxis, draw_key_mark, find_span

SIGNS = {
    "brightness_centre": ("s3", "diamond"),
    "horizon_sphere": ("s5", "square"),
    "horizon": ("s2", "triangle"),
    "control_points": ("s1", "circle"),
    "descent": ("s1", "circle"),
    "relative_landmarks": ("s3", "diamond"),
}
OTHER_SIGN = ("muted", "down")
MAX_GAP_S = 600.5  # frames farther apart in time (half a second is rounding) are not joined
UNEVEN = 20.0  # gaps so many times the median one: frames are drawn by number, not by time
TIME_UNITS = ((600.0, 1.0, "minutes"), (100.0 * 60.0, 60.0, "hours"), (np.inf, 1440.0, "days"))
AXES = (("R", "height"), ("N", "along the motion"), ("B", "across"))
UNLIKE = 10.0  # sigmas so far apart that one linear scale would hide the small ones
BELOW = 0.05  # of the least bound: errors smaller than that stand at the foot of a log plot
DRAWN = (1e-12, 1e30)  # what a damaged table holds beyond is no size of an error
FAR = 4.0  # farthest over nearest height from which errors are drawn over the distance, too
IN_KM_M = 5e3  # errors typically larger are drawn in km
MAX_REASONS = 4


@dataclass(frozen=True, eq=False)
class Frames:
    """The frames of a run in order of time, with what is drawn of them.

    x         (n,) along the time axis
    time_s    (n,) NaN where a time is not understood
    error, sigma  (n, 3) along R, N, B, m; NaN where there is none
    """

    rows: list[ErrorRow]
    x: FloatArray
    time_s: FloatArray
    x_label: str
    error: FloatArray
    sigma: FloatArray
    wide: frozenset[str]  # cameras that are not the narrowest of the run

    @property
    def compared(self) -> bool:
        """Whether there is a truth."""
        return bool(np.isfinite(self.error).any())

    @property
    def series(self) -> list[tuple[str, str]]:
        """Methods and cameras of the solved frames, from afar to near."""
        keys = {(row.method, row.camera) for row in self.rows if row.solved}
        return sorted(keys, key=lambda key: (*rank_method(key[0]), key[1]))

    def select(self, method: str, camera: str) -> IndexArray:
        """Select a series' solved frames, by index."""
        key = (True, method, camera)
        same = [(row.solved, row.method, row.camera) == key for row in self.rows]
        return np.flatnonzero(same)

    def choose_sign(self, method: str, camera: str) -> tuple[str, str]:
        """Choose series and shape of a method's marks, hollow for the wider cameras."""
        series, shape = SIGNS.get(method, OTHER_SIGN)
        return (f"{series} hollow" if camera in self.wide else series), shape

    @property
    def heights_km(self) -> FloatArray:
        """(n,) above the surface; NaN where it is not known, or not above it."""
        heights = np.array([row.height_m or np.nan for row in self.rows]) / 1e3
        return np.where(heights > 0.0, heights, np.nan)

    def list_stretches(self) -> list[tuple[str, IndexArray]]:
        """List series and indices of frames that follow one another in a camera by one method.

        None is farther from the one before it than MAX_GAP_S.
        """
        stretches = []
        for camera in sorted({row.camera for row in self.rows}):
            places = np.array([i for i, row in enumerate(self.rows) if row.camera == camera])
            passes = np.cumsum(is_apart(self.time_s[places]))
            kinds = [(self.rows[i].solved, self.rows[i].method, p) for i, p in zip(places, passes)]
            for kind, run in groupby(range(len(places)), kinds.__getitem__):
                if kind[0]:
                    series, _ = SIGNS.get(kind[1], OTHER_SIGN)
                    stretches.append((series, places[list(run)]))
        return stretches


def collect_frames(run: RunFolder, stated: bool = False) -> Frames:
    """Collect what is drawn of a run. Raises DataError for a damaged evaluation.

    stated  whether to draw what the solutions state even where the run was compared with a truth
    """
    path = run.path / EVALUATION_CSV
    rows = read_error_rows(path) if path.exists() and not stated else make_stated_rows(run)
    rows, x, time_s, x_label = _order_by_time(rows)
    none = np.full(3, np.nan)
    error = np.array([none if row.error_rnb_m is None else row.error_rnb_m for row in rows])
    sigma = np.array([none if row.sigma_rnb_m is None else row.sigma_rnb_m for row in rows])
    error, sigma = (np.where(np.abs(v) < MOST, v, np.nan) for v in (error, sigma))
    if not (np.isfinite(sigma) & (np.isfinite(error) | stated | (not path.exists()))).any():
        raise DataError(f"{path}: holds no error with its sigma; run `optnav evaluate` again")
    widths = {camera.name: camera.angular_resolution for camera in run.cameras.values()}
    narrowest = min(widths.values(), default=0.0)
    wide = frozenset(name for name, width in widths.items() if width > narrowest)
    return Frames(rows, x, time_s, x_label, error, sigma, wide)


def parse_time(utc: str) -> float:
    """Parse a frame's time to seconds; NaN where it is not understood."""
    try:
        return utc_to_tdb_s(utc)
    except DataError:
        return math.nan


def is_apart(time_s: FloatArray) -> BoolArray:
    """Which of some frames (n,) are too far in time from the one before to be joined with it."""
    apart: BoolArray = ~(np.abs(np.diff(time_s, prepend=time_s[:1])) <= MAX_GAP_S)
    return apart


def _order_by_time(rows: list[ErrorRow]) -> tuple[list[ErrorRow], FloatArray, FloatArray, str]:
    """Order rows by time; return their axis (time, or number when gaps are uneven) and times."""
    number = np.arange(1.0, len(rows) + 1.0)
    seconds = np.array([parse_time(row.utc) for row in rows])
    if not np.isfinite(seconds).all():
        return rows, number, seconds, "frame"
    order = np.argsort(seconds, kind="stable")
    rows, seconds = [rows[i] for i in order], seconds[order]
    gaps = np.diff(np.unique(seconds))
    if len(gaps) == 0 or gaps.max() > UNEVEN * np.median(gaps):
        return rows, number, seconds, "frame"
    minutes = (seconds - seconds[0]) / 60.0
    unit, name = next((u, name) for most, u, name in TIME_UNITS if minutes[-1] <= most)
    return rows, minutes / unit, seconds, f"{name} after {rows[0].utc}"


def plot_errors(run: RunFolder, stated: bool = False) -> list[Markup]:
    """Plot a run with a solved frame; without a truth, what its solutions state.

    Raises and `stated` as for `collect_frames`.
    """
    frames = collect_frames(run, stated)
    keys = Markup().join(draw_key_mark(e.series, e.shape, e.words) for e in _list_legend(frames))
    figures = []
    both = zip(_plot_panels(frames, WIDE), _plot_panels(frames, NARROW), strict=True)
    for number, ((wide, caption), (narrow, _)) in enumerate(both):
        drawings = [
            side_by_side(kind, [panel.plot.svg(panel.description) for panel in panels])
            for kind, panels in (("wider", wide), ("narrow", narrow))
        ]
        more = "" if number else _describe_reasons(frames)
        figures.append(figure(Markup().join(drawings), caption + more, None, keys))
    return figures


def draw_error_sheet(run: RunFolder) -> str:
    """Draw the plots as one picture (SVG) that stands alone."""
    frames = collect_frames(run)
    compared = "solution minus truth" if frames.compared else "stated sigmas"
    title = f"{run.attitude.body.name.capitalize()}, run {run.path.resolve().name}: {compared}"
    rows = [[panel] for panels, _ in _plot_panels(frames, WIDE) for panel in panels]
    return draw_sheet(title, _list_legend(frames), rows)


def _plot_panels(frames: Frames, width: int) -> list[tuple[list[Panel], str]]:
    """Plot panels with their captions: over time, and over the height where it changes much."""
    drawn = [_plot_over_time(frames, width)]
    heights = frames.heights_km[np.isfinite(frames.heights_km)]
    if heights.size and heights.max() > FAR * heights.min():
        drawn.append(_plot_over_distance(frames, width))
    return drawn


def _plot_over_time(frames: Frames, width: int) -> tuple[list[Panel], str]:
    """Plot R, N, B over time, with a caption."""
    shown = frames.error if frames.compared else frames.sigma
    bound = 3.0 * frames.sigma if frames.compared else frames.sigma
    sizes = np.abs(bound[np.isfinite(bound)])
    low, high = np.percentile(sizes, [10.0, 90.0])
    log = high > UNLIKE * max(low, 1e-9)
    unit, name = (1e3, "km") if np.median(sizes) > IN_KM_M else (1.0, "m")
    panels = []
    for axis, (letter, words) in enumerate(AXES):
        values, band = shown[:, axis] / unit, bound[:, axis] / unit
        size = f"|{letter}|" if log else letter
        label = f"{size}, {name}" if frames.compared else f"sigma {letter}, {name}"
        x_label = frames.x_label if axis == 2 else ""
        plot = _plot_axis_over_time(frames, values, band, (x_label, label), log, width)
        what = "Error" if frames.compared else "Stated sigma"
        words = f"{what} along {letter} ({words}) of each frame, {name}"
        panels.append(Panel("", plot, words))
    caption = "Solution minus truth" if frames.compared else "Stated sigmas, 1 sigma an axis,"
    caption = f"{caption} for each solved frame{', sizes alone' if log and frames.compared else ''}"
    alone = "dashes" if log else "bars"
    caption += f"; bands and {alone} are 3 stated sigmas." if frames.compared else "."
    return panels, caption


def _plot_axis_over_time(
    frames: Frames,
    values: FloatArray,
    band: FloatArray,
    labels: tuple[str, str],
    log: bool,
    width: int,
) -> Plot:
    sizes, outside = np.abs(values), np.abs(values) > band
    if log:
        y = _find_log_range(sizes, band)
        values, low, high = _take_log(sizes, y), np.full(len(band), y[0]), _take_log(band, y)
    else:
        low, high = -band, band
        y = find_span(np.concatenate([values, high, low if frames.compared else np.zeros(1)]), 0.08)
    x_axis = PlotAxis(find_span(frames.x, 0.03), labels[0])
    plot = Plot(x_axis, PlotAxis(y, labels[1], log), width=width, height=230 if log else 200)
    for series, places in frames.list_stretches() if frames.compared else ():
        x, bottom, top = frames.x[places], low[places], high[places]
        if len(places) > 1:
            plot.band(x, bottom, top, series)
            if log:
                plot.line(x, top, f"{series} thin")
        elif log:
            plot.marks(x, top, series, "dash")
        else:
            plot.line(np.repeat(x, 2), np.concatenate([bottom, top]), f"{series} thin")
    if frames.compared and not log:
        plot.level(0.0)
    _draw_marks(plot, frames, frames.x, values, outside)
    return plot


def _plot_over_distance(frames: Frames, width: int) -> tuple[list[Panel], str]:
    """Plot range (percent of the height) and direction over the height, with a caption."""
    rows = frames.rows
    x = np.log10(frames.heights_km)
    panels = []
    ranges = [(row.range_percent, row.range_sigma) for row in rows]
    directions = [(row.direction_arcsec, row.direction_sigma) for row in rows]
    for label, words, pairs, unit in (
        ("range, % of height", "range to the surface", ranges, 1.0),
        ("direction, arcmin", "direction to the centre", directions, 60.0),
    ):
        error, stated = np.array(pairs, dtype=np.float64).T / unit
        bound = 3.0 * stated if frames.compared else stated
        values = np.abs(error) if frames.compared else stated
        y = _find_log_range(values, bound)
        last = label.startswith("direction")
        x_axis = PlotAxis(
            find_span(x, 0.03), "height above the surface, km" if last else "", log=True
        )
        plot = Plot(x_axis, PlotAxis(y, label, log=True), width=width, height=260)
        if frames.compared:
            for method, camera in frames.series:
                series, _ = SIGNS.get(method, OTHER_SIGN)
                places = frames.select(method, camera)
                plot.marks(x[places], _take_log(bound[places], y), series, "dash")
        _draw_marks(plot, frames, x, _take_log(values, y), values > bound)
        what = "Error" if frames.compared else "Stated sigma"
        panels.append(Panel("", plot, f"{what} of the {words} of each frame over the height"))
    caption = "Errors of range and direction over the height; dashes are 3 stated sigmas."
    if not frames.compared:
        caption = "Stated sigmas of range and direction over the height."
    return panels, caption


def _draw_marks(
    plot: Plot, frames: Frames, x: FloatArray, y: FloatArray, outside: BoolArray
) -> None:
    """Draw solved frames, and crosses at the foot for the others, with names under the pointer."""
    for method, camera in frames.series:
        series, shape = frames.choose_sign(method, camera)
        places = frames.select(method, camera)
        titles = [f"{frames.rows[i].file}, {describe_method(method)}" for i in places]
        plot.marks(x[places], y[places], series, shape, titles=titles)
        far = places[outside[places]] if frames.compared else places[:0]
        names = [f"{frames.rows[i].file}, outside 3 sigmas" for i in far]
        plot.marks(x[far], y[far], "s4", shape, 4.2, names)
    unsolved = [i for i, row in enumerate(frames.rows) if not row.solved]
    titles = [f"{frames.rows[i].file}: {frames.rows[i].reason}" for i in unsolved]
    foot = np.full(len(unsolved), plot.y[0] + 0.05 * (plot.y[1] - plot.y[0]))
    plot.marks(x[unsolved], foot, "muted", "cross", 3.6, titles)


def _list_legend(frames: Frames) -> list[LegendEntry]:
    entries = []
    for method, camera in frames.series:
        series, shape = frames.choose_sign(method, camera)
        of_camera = sum(row.camera == camera for row in frames.rows)
        name = describe_method(method) + (f", {camera}" if camera else "")
        words = f"{name}: {len(frames.select(method, camera))} of {of_camera}"
        entries.append(LegendEntry(series, words, shape, line=False))
    if (np.abs(frames.error) > 3.0 * frames.sigma).any():
        entries.append(LegendEntry("s4", "outside 3 stated sigmas", "circle", line=False))
    unsolved = sum(not row.solved for row in frames.rows)
    if unsolved:
        entries.append(LegendEntry("muted", f"unsolved: {unsolved}", "cross", line=False))
    return entries


def _describe_reasons(frames: Frames) -> str:
    """Describe why frames are unsolved, the most frequent reasons."""
    reasons = Counter(row.reason.code.label for row in frames.rows if not row.solved)
    if not reasons:
        return ""
    named = "; ".join(f"{n} × {why}" for why, n in reasons.most_common(MAX_REASONS))
    more = "; others below" if len(reasons) > MAX_REASONS else ""
    return f" Unsolved: {named}{more}."


def _find_log_range(sizes: FloatArray, bound: FloatArray) -> tuple[float, float]:
    """Find logarithms of whole powers of ten about sizes and bounds, but not about least sizes."""
    known = np.concatenate([sizes, bound])
    known = known[np.isfinite(known) & (known > 0.0)]
    least = bound[np.isfinite(bound) & (bound > 0.0)]
    if known.size == 0 or least.size == 0:
        return 0.0, 1.0
    high = float(np.ceil(np.log10(np.clip(known.max(), *DRAWN)) + 0.1))
    low = float(np.floor(np.log10(np.clip(BELOW * least.min(), *DRAWN))))
    return min(low, high - 1.0), high


def _take_log(sizes: FloatArray, y: tuple[float, float]) -> FloatArray:
    """Take logarithms; what is smaller than the range stands at its foot."""
    with np.errstate(divide="ignore"):
        return np.maximum(np.log10(sizes), y[0])
