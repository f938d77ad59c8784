"""The evaluation of a run folder: read, printed as a table, written as evaluation.json and .csv."""

import json
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from catalog.errors import DataError
from catalog.files import replacing_file, starts_with
from catalog.geometry.rotations import ARCSEC
from optnav_cli.evaluation.error_rows import error_cells
from optnav_cli.evaluation.evaluation import WRONG_PX, Evaluation, evaluate
from optnav_cli.evaluation.figures import Figures, MethodFigures, Spread, method_words
from optnav_cli.frames.tables import EVALUATION
from optnav_cli.frames.truth import read_truth
from optnav_cli.output.run_folder import read_run
from optnav_cli.output.tables import fixed


def spread_summary(values: Spread) -> dict[str, float | None]:
    """One component's errors as JSON values, m."""
    return {f"{k}_m": None if v is None else round(v, 3) for k, v in asdict(values).items()}


def method_summary(method: MethodFigures) -> dict[str, Any]:
    """A method's figures as JSON values, rounded as they are written."""
    figures = method.figures
    inside = (round(v, 6) for v in figures.inside_3_sigma)
    ranges = None if method.range_rms is None else round(100.0 * method.range_rms, 6)
    return {
        "method": method.method,
        "camera": method.camera,
        "frames_of_camera": method.of_frames,
        "solved": figures.solved,
        "r": spread_summary(figures.r),
        "n": spread_summary(figures.n),
        "b": spread_summary(figures.b),
        "share_inside_3_sigma": dict(zip("rnb", inside, strict=True)),
        "normalised_error_squared": round(figures.nees, 6),
        "range_rms_percent": ranges,
        "direction_rms_arcsec": round(method.direction_rms / ARCSEC, 4),
    }


def method_lines(methods: Sequence[MethodFigures]) -> list[str]:
    """Lines of a table, three a method: R, N, B."""
    lines = [
        f"{'method, camera':<28}{'solved':>14}  {'m':<3}{'bias':>10}{'sigma':>10}{'max':>10}"
        f"{'in 3 sigma':>12}{'NEES':>7}"
    ]
    for method in methods:
        figures = method.figures
        name = method_words(method.method) + (f", {method.camera}" if method.camera else "")
        share = f"{figures.solved} of {method.of_frames}"
        spreads = (figures.r, figures.n, figures.b)
        for axis, spread, inside in zip("RNB", spreads, figures.inside_3_sigma, strict=True):
            sigma = "-" if spread.sigma is None else fixed(spread.sigma, 1)
            nees = f"{figures.nees:>7.2f}" if axis == "R" else ""
            lines.append(
                f"{name:<28}{share:>14}  {axis:<3}{spread.bias:>+10.1f}{sigma:>10}"
                f"{spread.max:>10.1f}{100.0 * inside:>10.1f} %{nees}"
            )
            name = share = ""
        ranges = "" if method.range_rms is None else f"range {100.0 * method.range_rms:.3g} %, "
        direction = method.direction_rms / ARCSEC
        lines.append(f'{"":<28}  {ranges}direction to the centre {direction:.3g}", rms')
    return lines


EVALUATION_JSON, EVALUATION_CSV = "evaluation.json", "evaluation.csv"


def evaluate_run(run: Path, truth: Path) -> Evaluation:
    """Compare a run folder with a truth.csv.

    Raises DataError for a folder that is no run, a damaged file, a truth of other frames.
    """
    folder = read_run(run)
    truths = read_truth(truth, folder.attitude)
    try:
        return evaluate(
            folder.solutions,
            truths,
            folder.attitude.body.radius_m,
            folder.matches,
            folder.cameras,
        )
    except DataError as error:
        raise DataError(f"{truth}: {error}") from error


def write_evaluation(evaluation: Evaluation, folder: Path) -> None:
    """Write evaluation.json and evaluation.csv into a run folder.

    Raises NothingToDoError when no frame is solved, OutputError when the folder is not writable.
    """
    summary = summary_of(evaluation)
    text = json.dumps(summary, indent=2, ensure_ascii=False, allow_nan=False) + "\n"
    with replacing_file(folder / EVALUATION_CSV, starts_with(b"file,utc,status,")) as path:
        EVALUATION.write(path, map(error_cells, evaluation.frames))
    with replacing_file(folder / EVALUATION_JSON, starts_with(b'{\n  "frames"')) as path:
        path.write_text(text, encoding="utf-8")


def summary_of(evaluation: Evaluation) -> dict[str, Any]:
    """The figures as plain JSON values, rounded as they are written."""
    figures = evaluation.figures()

    def arcsec(angle: float | None) -> float | None:
        return None if angle is None else round(angle / ARCSEC, 3)

    return {
        "frames": figures.frames,
        "solved": figures.solved,
        "share_solved": round(figures.solved / figures.frames, 6),
        "r": spread_summary(figures.r),
        "n": spread_summary(figures.n),
        "b": spread_summary(figures.b),
        "horizontal_rms_m": round(figures.horizontal_rms_m, 3),
        "horizontal_max_m": round(figures.horizontal_max_m, 3),
        "height_rms_m": round(figures.height_rms_m, 3),
        "share_inside_3_sigma": dict(
            zip("rnb", (round(v, 6) for v in figures.inside_3_sigma), strict=True)
        ),
        "normalised_error_squared": round(figures.nees, 6),
        "normalised_error_squared_95_percent": [round(v, 6) for v in figures.nees_range],
        "attitude_rms_arcsec": arcsec(figures.attitude_rms),
        "attitude_max_arcsec": arcsec(figures.attitude_max),
        "control_points": {
            "predicted": figures.n_predicted,
            "matched": figures.n_matched,
            "used": figures.n_used,
            "checked": figures.n_checked,
            "wrong": figures.n_wrong,
        },
        "methods": [method_summary(method) for method in evaluation.by_method()],
        "frames_with_local_north": figures.north_frames,
        "unsolved_reasons": dict(figures.unsolved_reasons),
        "remarks": list(evaluation.remarks),
    }


def format_table(evaluation: Evaluation) -> str:
    """The figures as a table for people. Raises NothingToDoError when no frame is solved."""
    figures = evaluation.figures()
    share = _percent(figures.solved, figures.frames)
    lines = [
        f"solved {figures.solved} of {figures.frames} frames ({share})",
        "",
        f"{'error, m':<14}{'bias':>10}{'sigma':>10}{'rms':>10}{'max':>10}{'inside 3 sigma':>17}",
    ]
    names = ("R  height", "N  along", "B  across")
    spreads = (figures.r, figures.n, figures.b)
    for name, spread, inside in zip(names, spreads, figures.inside_3_sigma, strict=True):
        sigma = "-" if spread.sigma is None else fixed(spread.sigma, 1)
        lines.append(
            f"{name:<14}{spread.bias:>+10.1f}{sigma:>10}{spread.rms:>10.1f}{spread.max:>10.1f}"
            f"{100.0 * inside:>15.1f} %"
        )
    lines += [
        f"{'horizontal':<34}{figures.horizontal_rms_m:>10.1f}{figures.horizontal_max_m:>10.1f}",
        "",
        f"normalised error squared {figures.nees:.2f} (1 expected; {figures.nees_range[0]:.2f} to "
        f"{figures.nees_range[1]:.2f} in 95 % of cases with an honest covariance)",
    ]
    methods = evaluation.by_method()
    if len(methods) > 1 or methods[0].method != "control_points":
        lines += ["", *method_lines(methods), ""]
    lines += _notes(figures, evaluation.remarks)
    return "\n".join(lines)


def _notes(figures: Figures, remarks: tuple[str, ...]) -> list[str]:
    lines = []
    if figures.attitude_rms is not None and figures.attitude_max is not None:
        rms, largest = figures.attitude_rms / ARCSEC, figures.attitude_max / ARCSEC
        lines.append(f'attitude error {rms:.1f}" rms, {largest:.1f}" max')
    if figures.n_predicted:  # a run by the horizon alone has none
        lines += _control_points(figures)
    if figures.north_frames:
        lines.append(
            f"N is local north for {figures.north_frames} of {figures.solved} frames "
            "that have no neighbour in their pass"
        )
    lines += [f"unsolved {n} times: {why}" for why, n in figures.unsolved_reasons.items()]
    return lines + list(remarks)


def _control_points(figures: Figures) -> list[str]:
    lines = [
        f"control points: {figures.n_predicted} predicted, {figures.n_matched} found "
        f"({_percent(figures.n_matched, figures.n_predicted)}), {figures.n_used} used "
        f"({_percent(figures.n_used, figures.n_predicted)})"
    ]
    if figures.n_checked:
        lines.append(
            f"wrong matches used (> {WRONG_PX:g} px from the truth): {figures.n_wrong} of "
            f"{figures.n_checked} ({_percent(figures.n_wrong, figures.n_checked, 2)})"
        )
    else:
        lines.append("wrong matches: not checked (the run has no camera files)")
    return lines


def _percent(part: int, whole: int, decimals: int = 1) -> str:
    return f"{100.0 * part / whole:.{decimals}f} %" if whole else "-"
