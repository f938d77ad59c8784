"""A run's errors against the truth in tables, from what `optnav evaluate` left in its folder."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from catalog.errors import DataError
from optnav_cli.output.evaluation_files import EVALUATION_JSON
from optnav_cli.output.methods import method_words
from optnav_cli.output.report.page import paragraph, section, subsection, table
from optnav_cli.output.tables import fixed

IN_KM_M = 10e3  # lengths from here on are told in km


def read_evaluation(folder: Path) -> dict[str, Any] | None:
    """The figures of a run folder; None for a run that was not evaluated.

    Raises DataError for a damaged file.
    """
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


def errors_table(evaluation: dict[str, Any]) -> str:
    """The section about errors by axis, and by method where there are several."""
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


def length_words(metres: float) -> str:
    """A length in m, or in km when it is long."""
    return f"{metres / 1e3:.1f} km" if metres >= IN_KM_M else f"{metres:.1f} m"
