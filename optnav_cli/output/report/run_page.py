"""The page about a run: how good, where, which control points, and what went wrong."""

import json
import re
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from catalog.errors import DataError
from catalog.geometry.rotations import ARCSEC
from optnav_cli.output.display import resized, shrink_factor
from optnav_cli.output.evaluation_files import EVALUATION_JSON
from optnav_cli.output.manifest import read_manifest
from optnav_cli.output.methods import method_words
from optnav_cli.output.overlay import overlay_path
from optnav_cli.output.report.error_plots import error_plots
from optnav_cli.output.report.page import (
    data_uri,
    figure,
    folded,
    image,
    listing,
    page,
    paragraph,
    section,
    subsection,
    table,
    tiles,
)
from optnav_cli.output.report.run_plots import ground_plot, residual_plots
from optnav_cli.output.run_folder import OVERLAYS, RunFolder, read_run
from optnav_cli.output.tables import fixed
from optnav_cli.solution import Solution

MOST_THUMBNAILS = 24
THUMBNAIL_PX = 560
IN_KM_M = 10e3  # lengths from here on are told in km
ROWS_OPEN = 40  # longer tables are folded


def run_page(folder: Path) -> str:
    """The HTML page about a run folder. Raises DataError for a folder that is no run."""
    run = read_run(folder)
    evaluation = _evaluation(folder)
    solved = [solution for solution in run.solutions if solution.solved]
    sections = [_main_numbers(run, evaluation)]
    if evaluation is not None:
        sections.append(_errors_table(evaluation))
    if solved:
        sections.append(section("Errors and stated sigmas", *error_plots(run)))
        sections.append(section("On the ground", ground_plot(run)))
    if any(match.measured_px is not None for match in run.matches):
        sections.append(section("Control points", *residual_plots(run), _refusals(run)))
    sections.append(_thumbnails(run))
    sections.append(_unsolved(run))
    sections.append(section("Frames", _frames(run.solutions)))
    sections.append(_made_from(folder))
    body = run.attitude.body.name.capitalize()
    subtitle = f"{len(run.solutions)} frames, {len(solved)} solved. Positions in the body frame."
    return page(
        f"{body}: run {folder.resolve().name}", subtitle, [text for text in sections if text]
    )


def _evaluation(folder: Path) -> dict[str, Any] | None:
    path = folder / EVALUATION_JSON
    if not path.exists():
        return None
    try:
        summary: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
        for axis in "rnb":  # touched here, so that a damaged file is told at once
            summary[axis]["bias_m"], summary["share_inside_3_sigma"][axis]
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise DataError(f"{path}: is damaged ({error}); run `optnav evaluate` again") from error
    return summary


def _main_numbers(run: RunFolder, evaluation: dict[str, Any] | None) -> str:
    solved = [s for s in run.solutions if s.solved]
    values = [(f"{len(solved)} of {len(run.solutions)}", "frames solved")]
    if evaluation is not None:
        values += [
            (_length(evaluation["horizontal_rms_m"]), "horizontal error, rms"),
            (_length(evaluation["height_rms_m"]), "height error, rms"),
            (
                f"{evaluation['normalised_error_squared']:.2f}",
                "error squared over stated covariance (1 is honest)",
            ),
        ]
    predicted = sum(s.n_predicted or 0 for s in solved)
    if predicted:
        used = sum(s.n_used or 0 for s in solved)
        values.append((f"{100.0 * used / predicted:.1f} %", "of predicted control points used"))
    residuals = [s.residual_rms_px for s in solved if s.residual_rms_px is not None]
    if residuals:
        rms = float(np.sqrt(np.mean(np.square(residuals))))
        values.append((f"{rms:.2f} px", "residual, rms a coordinate"))
    note = "" if evaluation else paragraph("Not compared with a truth: see `optnav evaluate`.")
    return tiles(values) + note


def _errors_table(evaluation: dict[str, Any]) -> str:
    names = {"r": "R (height)", "n": "N (along the motion)", "b": "B (across)"}
    largest = max(evaluation[axis]["max_m"] for axis in names)
    unit, unit_name = (1e3, "km") if largest >= IN_KM_M else (1.0, "m")
    rows = []
    for axis, name in names.items():
        spread = evaluation[axis]
        sigma = "-" if spread["sigma_m"] is None else f"{spread['sigma_m'] / unit:.1f}"
        rows.append(
            (
                name,
                f"{spread['bias_m'] / unit:+.1f}",
                sigma,
                f"{spread['rms_m'] / unit:.1f}",
                f"{spread['max_m'] / unit:.1f}",
                f"{100.0 * evaluation['share_inside_3_sigma'][axis]:.1f} %",
            )
        )
    rms, farthest = (evaluation[f"horizontal_{name}_m"] / unit for name in ("rms", "max"))
    rows.append(("horizontal", "", "", f"{rms:.1f}", f"{farthest:.1f}", ""))
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
    parts = [table(header, rows), *map(paragraph, notes)]
    methods = evaluation.get("methods", [])
    if len(methods) > 1:
        parts.append(_methods_table(methods))
    return section("Against the truth", *parts)


def _methods_table(methods: Sequence[dict[str, Any]]) -> str:
    """Bias, sigma and greatest error of each method and camera, and whether it is honest."""
    header = (
        *("method", "solved", "R", "N", "B"),
        *("range, %", "direction, ″", "in 3 sigmas", "NEES"),
    )
    rows = []
    for method in methods:
        name, camera = method_words(method["method"]), method["camera"]
        inside = method["share_inside_3_sigma"]
        least = min(inside[axis] for axis in "rnb")
        rows.append(
            (
                f"{name}, {camera}" if camera else name,
                f"{method['solved']} of {method['frames_of_camera']}",
                *(_spread(method[axis]) for axis in "rnb"),
                "" if method["range_rms_percent"] is None else f"{method['range_rms_percent']:.2g}",
                f"{method['direction_rms_arcsec']:.3g}",
                f"{100.0 * least:.0f} %",
                f"{method['normalised_error_squared']:.2f}",
            )
        )
    note = (
        "R, N, B: bias / sigma / greatest error. Range (of the height) and direction to the centre "
        "are rms. In 3 sigmas: the least share of R, N, B. NEES is 1 for an honest covariance."
    )
    return subsection("By method", table(header, rows), paragraph(note))


def _spread(values: dict[str, float]) -> str:
    """Bias, sigma and greatest error in one unit."""
    largest = values["max_m"]
    unit, name = (1e3, "km") if largest >= IN_KM_M else (1.0, "m")
    decimals = 0 if largest / unit >= 100.0 else 1
    bias, sigma, most = (
        "-" if v is None else fixed(v / unit, decimals).replace("-", "\N{MINUS SIGN}")
        for v in (values["bias_m"], values["sigma_m"], largest)
    )
    return f"{bias} / {sigma} / {most} {name}"


def _length(metres: float) -> str:
    return f"{metres / 1e3:.1f} km" if metres >= IN_KM_M else f"{metres:.1f} m"


def _refusals(run: RunFolder) -> str:
    reasons = Counter(_kind(match.reason) for match in run.matches if not match.used)
    if not reasons:
        return ""
    rows = [(reason, str(count)) for reason, count in sorted(reasons.items(), key=_most_first)]
    return table(("control points tried but not used: why", "times"), rows[:12])


def _kind(reason: str) -> str:
    """A reason without the numbers of the one match."""
    return re.sub(r"(score|rival) \d+\.\d+", r"\1", reason) or "not used"


def _thumbnails(run: RunFolder) -> str:
    """Overlays, unsolved frames first among equals, evenly through the run."""
    there = [
        solution
        for solution in run.solutions
        if overlay_path(run.path / OVERLAYS, solution.file).is_file()
    ]
    if not there:
        return ""
    picked = there
    if len(there) > MOST_THUMBNAILS:
        places = np.linspace(0, len(there) - 1, MOST_THUMBNAILS).round().astype(int)
        picked = [there[place] for place in places]
    pictures = []
    for solution in picked:
        picture = cv2.imread(str(overlay_path(run.path / OVERLAYS, solution.file)))
        if picture is None:  # a damaged overlay is no reason to have no report
            continue
        pixels = np.asarray(picture, np.uint8)
        height, width = pixels.shape[:2]
        small = resized(pixels, shrink_factor(width, height, THUMBNAIL_PX))
        uri = data_uri(small, ".jpg", 72)
        pictures.append(figure(image(uri, f"overlay of {solution.file}"), solution.file))
    words = (
        "Predicted (blue rings) and found (crosses) control points; residuals enlarged 50 times."
    )
    shown = f" {len(picked)} of {len(there)} frames." if len(picked) < len(there) else ""
    return section(
        "Pictures", paragraph(words + shown), f'<div class="thumbs">{"".join(pictures)}</div>'
    )


def _unsolved(run: RunFolder) -> str:
    rows = [(s.file, s.utc, s.reason) for s in run.solutions if not s.solved]
    if not rows:
        return ""
    return section("Unsolved frames", table(("file", "UTC", "reason"), rows, text_columns=3))


def _frames(solutions: Sequence[Solution]) -> str:
    header: tuple[str, ...] = (
        *("file", "UTC", "method", "x, km", "y, km", "z, km", "sigma, m"),
        *("attitude sigma, ″", "predicted", "found", "used", "rms, px"),
    )
    limb = any(s.n_limb is not None for s in solutions)
    if limb:
        header += ("limb points", "arc, °")
    rows = []
    for s in solutions:
        place = ("unsolved", "", "") if s.position_m is None else _kilometres(s.position_m)
        sigma = None if s.covariance_m2 is None else float(np.sqrt(np.trace(s.covariance_m2) / 3.0))
        angle = None if s.attitude_sigma_rad is None else s.attitude_sigma_rad / ARCSEC
        counts = ("" if n is None else str(n) for n in (s.n_predicted, s.n_matched, s.n_used))
        rows.append(
            (
                *(s.file, s.utc, method_words(s.method) if s.method else "", *place),
                *(fixed(sigma, 1), fixed(angle, 1)),
                *counts,
                fixed(s.residual_rms_px, 3),
                *(("" if s.n_limb is None else str(s.n_limb), fixed(s.arc_deg, 0)) if limb else ()),
            )
        )
    content = table(header, rows, text_columns=3)
    return content if len(rows) <= ROWS_OPEN else folded(f"All {len(rows)} frames", content)


def _made_from(folder: Path) -> str:
    try:
        manifest = read_manifest(folder)
    except DataError:  # a run put together by hand is still worth a report
        return ""
    return section("Made from", folded("manifest.json", listing(manifest)))


def _kilometres(position_m: Any) -> tuple[str, str, str]:
    x, y, z = (fixed(float(v) / 1e3, 4) for v in position_m)
    return x, y, z


def _most_first(item: tuple[str, int]) -> tuple[int, str]:
    return -item[1], item[0]
