"""The page about a run: how good, where, which control points, and what went wrong."""

import json
import math
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from markupsafe import Markup

from catalog.arrays import FloatArray
from catalog.errors import DataError
from catalog.files import MANIFEST
from catalog.geometry.rotations import ARCSEC
from catalog.inputs import read_input
from optnav_cli.evaluation.figures import describe_method
from optnav_cli.evaluation.files import EVALUATION_JSON
from optnav_cli.fix import Method, Solution
from optnav_cli.frames.tables import COMMON_NUMBERS
from optnav_cli.output.manifest import read_manifest
from optnav_cli.output.run_folder import COMMON_CSV, COMMON_JSON, RunFolder, read_run
from optnav_cli.output.tables import format_fixed
from optnav_cli.points.plots import is_picked, plot_picked_points
from optnav_cli.report import page as html
from optnav_cli.report.error_plots import AXES, collect_frames, plot_errors
from optnav_cli.report.page import build_pictures, figure, side_by_side
from optnav_cli.report.relief import plot_ground
from optnav_cli.report.svg import HALF, MOST, NARROW, WIDE, Plot, PlotAxis, find_span

HEIGHT = "height above the reference sphere, km"
COUNTS = (("n_windows", "s1"), ("n_landmarks", "s3"))
MAX_DOTS = 4000
IN_KM_M = 10e3  # lengths from here on are written in km


def is_descent(run: RunFolder) -> bool:
    """Whether a run has frames of a descent."""
    return any(
        solution.method in (Method.DESCENT, Method.RELATIVE_LANDMARKS) for solution in run.solutions
    )


def draw_descent(run: RunFolder, stated: bool = False) -> list[Markup]:
    """Draw errors along R, N, B over height, or stated sigmas without a truth; and counts.

    stated  as for `error_plots`, of which the errors raised are the same
    """
    frames = collect_frames(run, stated)
    heights = frames.heights_km
    shown = frames.error if frames.compared else frames.sigma
    known = np.isfinite(heights) & np.isfinite(shown).all(axis=1)
    order = np.flatnonzero(known)[np.argsort(heights[known])]
    if order.size == 0:
        return []
    x, values, bound = heights[order], shown[order], 3.0 * frames.sigma[order]
    drawings = []
    for kind, width in (("wider", WIDE), ("narrow", NARROW)):
        plots = [
            _draw_descent_errors(
                x, values[:, axis], bound[:, axis], AXES[axis][0], frames.compared, width
            )
            for axis in range(3)
        ]
        plots.append(_draw_counts(run, width))
        drawings.append(side_by_side(kind, plots))
    what = "Solution minus truth over the height; bands are 3 stated sigmas"
    if not frames.compared:
        what = "Stated sigmas over the height"
    keys = {"k1": "windows", "k3": "landmarks"}
    return [figure(Markup().join(drawings), f"{what}; what each frame's solution keeps.", keys)]


def _draw_descent_errors(
    x: FloatArray, values: FloatArray, bound: FloatArray, letter: str, compared: bool, width: int
) -> Markup:
    low, high = (-bound, bound) if compared else (np.zeros_like(values), values)
    y = find_span(np.concatenate([values, low, high]), 0.08)
    label = f"{letter}, m" if compared else f"sigma {letter}, m"
    plot = Plot(PlotAxis(find_span(x, 0.03), ""), PlotAxis(y, label), width=width, height=190)
    if compared and len(x) > 1:
        plot.band(x, low, high, "s1")
        plot.level(0.0)
    plot.marks(x, values, "s1", "circle")
    outside = np.abs(values) > bound
    if compared and outside.any():
        plot.marks(x[outside], values[outside], "s4", "circle", 4.2)
    return plot.svg(f"{'Error' if compared else 'Stated sigma'} along {letter} over the height")


def _draw_counts(run: RunFolder, width: int) -> Markup:
    """Draw the windows and landmarks that each frame's solution keeps, over its height."""
    radius = run.attitude.body.radius_m
    solved = [s for s in run.solutions if s.position_m is not None]
    places = [s.position_m for s in solved if s.position_m is not None]
    x = np.array([float(np.linalg.norm(position)) - radius for position in places])
    x = x / 1e3
    counts = {name: np.array([getattr(s, name) or 0 for s in solved]) for name, _ in COUNTS}
    most = max(float(values.max(initial=1)) for values in counts.values())
    axes = PlotAxis(find_span(x, 0.03), HEIGHT), PlotAxis((0.0, 1.1 * most), "kept")
    plot = Plot(*axes, width=width, height=190)
    for name, series in COUNTS:
        plot.marks(x, counts[name], series, "circle")
    return plot.svg("Windows and landmarks over the height")


def draw_residuals(run: RunFolder) -> list[Markup]:
    """Draw residuals of kept matches as a cloud, and scores of kept and refused ones."""
    residual = _collect_residuals(run)
    drawings = []
    if len(residual):
        rms = float(np.sqrt(np.mean(residual**2)))
        reach = max(3.2 * rms, float(np.percentile(np.abs(residual), 99.5)))
        x, y = (PlotAxis((-reach, reach), f"{name}, px") for name in "xy")
        plot = Plot(x, y, width=HALF, height=420, equal=True)
        few = residual[:: -(-len(residual) // MAX_DOTS)]
        plot.dots(few[:, 0], few[:, 1], "s1", 1.8)
        angle = np.linspace(0.0, 2.0 * np.pi, 73)
        plot.line(rms * np.cos(angle), rms * np.sin(angle), "s2", closed=True)
        drawn = plot.svg("Residuals of the control points used, px")
        words = f"Residuals of the {len(residual)} matches used"
        rms_words = f"rms a coordinate, {_format_residuals(residual)}"
        drawings.append(html.figure(drawn, words, {"k2": rms_words}))
    scores = [(m.score, m.used) for m in run.matches if m.score is not None]
    if scores:
        values = np.array([score for score, _ in scores])
        kept = np.array([flag for _, flag in scores], dtype=np.bool_)
        edges = np.linspace(*find_span(values, 0.0), 24 + 1)
        edges = edges if edges[-1] > edges[0] else edges[0] + np.linspace(-0.5, 0.5, 25)
        below, above = (np.histogram(values[c], edges)[0] for c in (~kept, kept))
        x = PlotAxis((edges[0], edges[-1]), "score")
        y = PlotAxis((0.0, 1.05 * float((below + above).max())), "matches")
        plot = Plot(x, y, width=HALF, height=420)
        plot.bars(edges, below, "s4")
        plot.bars(edges, above, "s3", below)
        drawn = plot.svg("Scores of matches")
        drawings.append(html.figure(drawn, "Scores.", {"k3": "used", "k4": "not used"}))
    return [html.side_by_side("pair", drawings)]


def read_evaluation(folder: Path) -> tuple[dict[str, Any] | None, Markup]:
    """Read the figures of a run folder and make their section; None for a run without.

    The section of a damaged file says so: the rest of the page stands without it.
    """
    path = folder / EVALUATION_JSON
    if not path.exists():
        return None, Markup()
    try:
        summary = json.loads(
            read_input(path), parse_float=_parse_finite, parse_constant=_parse_finite
        )
        section = make_errors_section(summary)
        _make_error_tiles(summary)
    except (DataError, ValueError, LookupError, TypeError, AttributeError, RecursionError) as error:
        what = f"{EVALUATION_JSON} is damaged ({type(error).__name__}: {error})"
        return None, html.paragraph(f"{what}; run `optnav evaluate` again.", "note")
    return summary, section


def _parse_finite(text: str) -> float:
    value = float(text)
    if not math.isfinite(value):
        raise ValueError(f"{text} is no finite number")
    return value


def make_errors_section(evaluation: dict[str, Any]) -> Markup:
    """Make the section about errors by axis, and by method where there are several."""
    names = {"r": "R (height)", "n": "N (along the motion)", "b": "B (across)"}
    largest = max(evaluation[axis]["max_m"] for axis in names)
    unit, unit_name = (1e3, "km") if largest >= IN_KM_M else (1.0, "m")
    rows = []
    for axis, name in names.items():
        spread = evaluation[axis]
        sigma = "-" if spread["sigma_m"] is None else f"{spread['sigma_m'] / unit:.1f}"
        rms, farthest = (f"{spread[key] / unit:.1f}" for key in ("rms_m", "max_m"))
        inside = f"{100.0 * evaluation['share_inside_3_sigma'][axis]:.1f} %"
        rows.append((name, f"{spread['bias_m'] / unit:+z.1f}", sigma, rms, farthest, inside))
    rms, farthest = (f"{evaluation[f'horizontal_{k}_m'] / unit:.1f}" for k in ("rms", "max"))
    rows.append(("horizontal", "", "", rms, farthest, ""))
    points = evaluation["control_points"]
    low, high = evaluation["normalised_error_squared_95_percent"]
    notes = [
        f"An honest covariance keeps the normalised error squared between {low:.2f} and "
        f"{high:.2f} in 95 % of cases; here it is {evaluation['normalised_error_squared']:.2f}."
    ]
    if points["checked"]:
        notes.append(
            f"Of {points['checked']} control points used, {points['wrong']} were found more than "
            "3 px from their true place."
        )
    if evaluation["frames_with_local_north"]:
        notes.append(
            f"N is local north for {evaluation['frames_with_local_north']} frames without a "
            "neighbour in their pass."
        )
    header = (f"error, {unit_name}", "bias", "sigma", "rms", "max", "inside 3 stated sigmas")
    parts = [html.table(header, rows), *map(html.paragraph, notes)]
    methods = evaluation.get("methods", [])
    if len(methods) > 1:
        parts.append(_make_methods_table(methods))
    return html.section("Against the truth", *parts)


def _make_methods_table(methods: Sequence[dict[str, Any]]) -> Markup:
    """Make a table of bias, sigma and greatest error of each method and camera, with NEES."""
    header = ["method", "solved", "R", "N", "B", "range, %", "dir., ″", "in 3 σ", "NEES"]
    rows = []
    for method in methods:
        name, camera = describe_method(method["method"]), method["camera"]
        inside = method["share_inside_3_sigma"]
        least = min(inside[axis] for axis in "rnb")
        ranges, direction = method["range_rms_percent"], method["direction_rms_arcsec"]
        row = [f"{name}, {camera}" if camera else name]
        row += [f"{method['solved']} of {method['frames_of_camera']}"]
        row += [_format_spread(method[axis]) for axis in "rnb"]
        row += ["" if ranges is None else f"{ranges:.2g}", f"{direction:.3g}"]
        rows.append([*row, f"{100.0 * least:.0f} %", f"{method['normalised_error_squared']:.2f}"])
    note = (
        "R, N, B: bias / sigma / greatest error. Range (of the height) and direction to the centre "
        "are rms. In 3 σ: the least share of R, N, B. NEES is 1 for an honest covariance."
    )
    return html.subsection("By method", html.table(header, rows), html.paragraph(note))


def _format_spread(values: dict[str, float]) -> str:
    """Format bias, sigma and greatest error in one unit."""
    largest = values["max_m"]
    unit, name = (1e3, "km") if largest >= IN_KM_M else (1.0, "m")
    decimals = 0 if largest / unit >= 100.0 else 1
    bias, sigma, most = (
        "-" if v is None else format_fixed(v / unit, decimals).replace("-", "\N{MINUS SIGN}")
        for v in (values["bias_m"], values["sigma_m"], largest)
    )
    return f"{bias} / {sigma} / {most} {name}"


def format_length(metres: float) -> str:
    """Format a length in m, or in km when it is long; long numbers without decimals."""
    value, unit = (metres / 1e3, "km") if metres >= IN_KM_M else (metres, "m")
    return f"{value:.{0 if value >= 100.0 else 1}f} {unit}"


def make_run_page(folder: Path) -> str:
    """Make the HTML page about a run folder. Raises DataError for a folder that is no run."""
    run = read_run(folder)
    evaluation, against_truth = read_evaluation(folder)
    solved = [solution for solution in run.solutions if solution.solved]
    sections = [_show_main_numbers(run, evaluation), against_truth, _make_common_section(folder)]
    if solved:
        sections.append(html.section("Errors and stated sigmas", *_draw_errors(run)))
        if is_descent(run):
            sections.append(html.section("Over the height", *_draw_descent(run)))
        sections.append(html.section("On the ground", plot_ground(run)))
    if is_picked(run):
        sections.append(html.section("Picked points", *plot_picked_points(run)))
    elif any(match.measured_px is not None for match in run.matches):
        sections.append(
            html.section("Control points", *draw_residuals(run), _make_refusals_table(run))
        )
    frames = html.section("Frames", _make_frames_table(run.solutions))
    sections += [build_pictures(run), _make_unsolved_section(run), frames, _show_manifest(folder)]
    title = f"{run.attitude.body.name.capitalize()}: run {folder.resolve().name}"
    subtitle = f"{len(run.solutions)} frames, {len(solved)} solved. Positions in the body frame."
    return html.build_page(title, subtitle, filter(None, sections))


def _make_common_section(folder: Path) -> Markup:
    """Make the section about parameters common to an adjusted run's frames; else nothing."""
    if not (folder / COMMON_JSON).exists():
        return Markup()
    header = ("common to the frames", "axis", "value", "sigma", "unit", "observed")
    try:
        rows = [
            (
                f"{row['name'].replace('_', ' ')} {row['camera']}".strip(),
                row["axis"],
                f"{row.number('value'):.6g}",
                f"{row.number('sigma'):.2g}",
                row["unit"],
                "yes" if row.flag("observed") else "no",
            )
            for row in COMMON_NUMBERS.rows(folder / COMMON_CSV)
        ]
        document = json.loads(read_input(folder / COMMON_JSON), parse_constant=_parse_finite)
        stages = [f"{name} {value:.2f}" for name, value in document["residual_rms_px"].items()]
        notes = [f"{note[:1].upper()}{note[1:]}." for note in document["not_observed"]]
    except (DataError, ValueError, LookupError, TypeError, AttributeError, RecursionError) as error:
        text = f"{COMMON_JSON} or {COMMON_CSV} is damaged ({error}); run `optnav adjust` again."
        return html.section("Common to the frames", html.paragraph(text, "note"))
    words = f"Residuals of the matches, rms a coordinate, px: {', '.join(stages)}."
    table = [html.table(header, rows, text_columns=2)] if rows else []
    parts = [*table, *map(html.paragraph, [words, *notes])]
    return html.section("Common to the frames", *parts)


def _draw_errors(run: RunFolder) -> list[Markup]:
    """Draw each frame's errors; stated sigmas, with a note, where stored errors are damaged."""
    try:
        return plot_errors(run)
    except DataError as error:
        return [html.paragraph(str(error), "note"), *plot_errors(run, stated=True)]


def _draw_descent(run: RunFolder) -> list[Markup]:
    """Draw a descent's errors over height; stated sigmas where stored errors are damaged."""
    try:
        return draw_descent(run)
    except DataError:
        return draw_descent(run, stated=True)


def _show_main_numbers(run: RunFolder, evaluation: dict[str, Any] | None) -> Markup:
    solved = [s for s in run.solutions if s.solved]
    values = [(f"{len(solved)} of {len(run.solutions)}", "frames solved")]
    if evaluation is not None:
        values += _make_error_tiles(evaluation)
    predicted = sum(s.n_predicted or 0 for s in solved)
    if predicted:
        used = sum(s.n_used or 0 for s in solved)
        values.append((f"{100.0 * used / predicted:.1f} %", "of predicted control points used"))
    residuals = _collect_residuals(run)
    rms_px = [s.residual_rms_px for s in solved if s.n_used is None]
    limbs = [rms for rms in rms_px if rms is not None]
    if len(residuals):
        values.append(
            (_format_residuals(residuals), "residual of control points, rms a coordinate")
        )
    elif limbs:
        values.append((f"{np.sqrt(np.mean(np.square(limbs))):.2f} px", "residual of the limb, rms"))
    if (run.path / EVALUATION_JSON).exists():
        return html.tiles(values)
    return html.tiles(values) + html.paragraph("Not compared with a truth: see `optnav evaluate`.")


def _make_error_tiles(evaluation: dict[str, Any]) -> list[tuple[str, str]]:
    nees = f"{evaluation['normalised_error_squared']:.2f}"
    return [
        (format_length(evaluation["horizontal_rms_m"]), "horizontal error, rms"),
        (format_length(evaluation["height_rms_m"]), "height error, rms"),
        (nees, "error squared over stated covariance (1 is honest)"),
    ]


def _collect_residuals(run: RunFolder) -> FloatArray:
    """Collect the residuals (n, 2), px, of the matches that solutions keep."""
    used = [m.residual_px for m in run.matches if m.used and m.residual_px is not None]
    residuals = np.array(used, np.float64).reshape(-1, 2)
    return residuals[(np.abs(residuals) < MOST).all(axis=1)]


def _format_residuals(residuals: FloatArray) -> str:
    """Format the rms of residuals, px."""
    return f"{np.sqrt(np.mean(residuals**2)):.2f} px"


def _make_refusals_table(run: RunFolder) -> Markup:
    reasons = Counter(m.reason_code for m in run.matches if not m.used)
    if not reasons:
        return Markup()
    most_first = sorted(reasons.items(), key=lambda item: (-item[1], item[0]))
    rows = [(code.label, code.meaning, str(count)) for code, count in most_first]
    header = "control points tried but not used", "because", "times"
    return html.table(header, rows[:12], text_columns=2)


def _make_unsolved_section(run: RunFolder) -> Markup:
    rows = [(s.file, s.utc, s.reason_code.label, s.reason) for s in run.solutions if not s.solved]
    if not rows:
        return Markup()
    return html.section(
        "Unsolved frames", html.table(("file", "UTC", "unsolved", "reason"), rows, text_columns=4)
    )


def _make_frames_table(solutions: Sequence[Solution]) -> Markup:
    header: tuple[str, ...] = (
        *("file", "UTC", "method", "x, km", "y, km", "z, km", "sigma, m"),
        *("attitude sigma, ″", "rms, px"),
    )
    points = any(s.n_predicted is not None for s in solutions)
    if points:
        header += ("predicted", "found", "used")
    limb = any(s.n_limb is not None for s in solutions)
    if limb:
        header += ("limb points", "arc, °")
    rows = []
    for s in solutions:
        position = ["unsolved", "", ""]
        if s.position_m is not None:
            position = [format_fixed(float(v) / 1e3, 4) for v in s.position_m]
        sigma = None if s.covariance_m2 is None else float(np.sqrt(np.trace(s.covariance_m2) / 3.0))
        angle = None if s.attitude_sigma_rad is None else s.attitude_sigma_rad / ARCSEC
        counts = ["" if n is None else str(n) for n in (s.n_predicted, s.n_matched, s.n_used)]
        row = [s.file, s.utc, describe_method(s.method) if s.method else "", *position]
        row += [format_fixed(sigma, 1), format_fixed(angle, 1), format_fixed(s.residual_rms_px, 2)]
        row += counts if points else []
        if limb:
            row += ["" if s.n_limb is None else str(s.n_limb), format_fixed(s.arc_deg, 0)]
        rows.append(row)
    content = html.table(header, rows, text_columns=3)
    # Longer tables are folded.
    return content if len(rows) <= 40 else html.folded(f"All {len(rows)} frames", content)


def _show_manifest(folder: Path) -> Markup:
    if not (folder / MANIFEST).exists():  # a run put together by hand is still worth a report
        return Markup()
    try:
        manifest = read_manifest(folder)
    except DataError as error:
        return html.section("Made from", html.paragraph(str(error), "note"))
    return html.section("Made from", html.folded("manifest.json", html.format_listing(manifest)))
