"""The page about a run: how good, where, which control points, and what went wrong."""

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
from optnav_cli.output.manifest import read_manifest
from optnav_cli.output.methods import method_words
from optnav_cli.output.overlay import overlay_path
from optnav_cli.output.report.error_plots import error_plots
from optnav_cli.output.report.error_tables import errors_table, length_words, read_evaluation
from optnav_cli.output.report.page import (
    data_uri,
    figure,
    folded,
    image,
    listing,
    page,
    paragraph,
    section,
    table,
    tiles,
)
from optnav_cli.output.report.run_plots import ground_plot, residual_plots
from optnav_cli.output.run_folder import OVERLAYS, RunFolder, read_run
from optnav_cli.output.tables import fixed
from optnav_cli.solution import Solution

MOST_THUMBNAILS = 24
THUMBNAIL_PX = 560
ROWS_OPEN = 40  # longer tables are folded


def run_page(folder: Path) -> str:
    """The HTML page about a run folder. Raises DataError for a folder that is no run."""
    run = read_run(folder)
    evaluation = read_evaluation(folder)
    solved = [solution for solution in run.solutions if solution.solved]
    sections = [_main_numbers(run, evaluation)]
    if evaluation is not None:
        sections.append(errors_table(evaluation))
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


def _main_numbers(run: RunFolder, evaluation: dict[str, Any] | None) -> str:
    solved = [s for s in run.solutions if s.solved]
    values = [(f"{len(solved)} of {len(run.solutions)}", "frames solved")]
    if evaluation is not None:
        values += [
            (length_words(evaluation["horizontal_rms_m"]), "horizontal error, rms"),
            (length_words(evaluation["height_rms_m"]), "height error, rms"),
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
