"""The evaluation of a run folder: read, written as evaluation.json and .csv, shown as a table."""

import logging
import math
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from catalog.arrays import FloatArray
from catalog.bodies.epochs import utc_to_tdb_s
from catalog.errors import DataError
from catalog.files import make_prefix_test, replace_file
from catalog.geometry.rotations import ARCSEC
from catalog.progress import log_stage
from catalog.tables import CsvRow
from optnav_cli.evaluation.evaluation import WRONG_PX, Evaluation, evaluate
from optnav_cli.evaluation.figures import (
    BEYOND_SIGMAS,
    Figures,
    FrameError,
    MethodFigures,
    Spread,
    TimedPlace,
    describe_method,
    find_motion_axes,
    identify_other_frame,
)
from optnav_cli.frames.tables import ERRORS, EVALUATION, SIGMAS
from optnav_cli.frames.truth import read_truth
from optnav_cli.output.run_folder import RunFolder, read_run
from optnav_cli.output.tables import read_reason_code
from optnav_cli.output.wording import align_table, choose_length_unit, format_angle, format_json
from optnav_cli.reasons import Reason

log = logging.getLogger(__name__)

EVALUATION_JSON, EVALUATION_CSV = "evaluation.json", "evaluation.csv"


@dataclass(frozen=True, eq=False)
class ErrorRow:
    """One frame of a run as it is drawn; what is not known or does not apply is None.

    height_m                      above the reference sphere: true, or solved where there is no
                                  truth
    error_rnb_m, sigma_rnb_m      (3,) along R, N, B
    range_percent, range_sigma    error along R and its sigma, percent of the height
    direction_arcsec, direction_sigma  of the direction to the centre
    """

    file: str
    utc: str
    solved: bool
    method: str
    camera: str
    reason: Reason
    height_m: float | None
    error_rnb_m: FloatArray | None = None
    sigma_rnb_m: FloatArray | None = None
    range_percent: float | None = None
    range_sigma: float | None = None
    direction_arcsec: float | None = None
    direction_sigma: float | None = None


def make_error_cells(frame: FrameError) -> dict[str, object]:
    """Make a row of evaluation.csv."""
    solution = frame.solution
    of_solution = "status", "method", "n_predicted", "n_matched", "n_used", "reason", "reason_code"
    cells: dict[str, object] = {name: getattr(solution, name) for name in of_solution}
    of_frame = ("file", "utc", "camera", "forward", "n_wrong")
    cells |= {name: getattr(frame, name) for name in of_frame}
    cells |= {"truth_height_m": frame.height_m, "normalised_error_squared": frame.nees}
    for columns, values in ((ERRORS, frame.error_rnb_m), (SIGMAS, frame.sigma_rnb_m)):
        if values is not None:
            cells |= zip(columns, values, strict=True)
    if frame.range_error is not None:
        error, sigma = (100.0 * share for share in frame.range_error)
        cells |= {"range_error_percent": error, "range_sigma_percent": sigma}
    if frame.direction_error is not None:
        error, sigma = (angle / ARCSEC for angle in frame.direction_error)
        cells |= {"direction_error_arcsec": error, "direction_sigma_arcsec": sigma}
    if frame.attitude_error_rad is not None:
        cells["attitude_error_arcsec"] = frame.attitude_error_rad / ARCSEC
    return cells


def read_error_rows(path: Path) -> list[ErrorRow]:
    """Read the frames of an evaluation.csv. Raises DataError for a damaged table or an old one."""
    try:
        rows = EVALUATION.read(path, _read_error_row)
        if not any(row.error_rnb_m is not None and row.sigma_rnb_m is not None for row in rows):
            raise DataError(f"{path}: has no frame with an error")
    except DataError as error:
        raise DataError(f"{error}; run `optnav evaluate` again") from error
    return rows


def _read_error_row(row: CsvRow) -> ErrorRow:
    return ErrorRow(
        file=row["file"],
        utc=row["utc"],
        solved=row["status"] == "solved",
        method=row["method"],
        camera=row["camera"],
        reason=Reason(read_reason_code(row), row["reason"]),
        height_m=row.number("truth_height_m"),
        error_rnb_m=row.vector(ERRORS),
        sigma_rnb_m=row.vector(SIGMAS),
        range_percent=row.number("range_error_percent"),
        range_sigma=row.number("range_sigma_percent"),
        direction_arcsec=row.number("direction_error_arcsec"),
        direction_sigma=row.number("direction_sigma_arcsec"),
    )


def make_stated_rows(run: RunFolder) -> list[ErrorRow]:
    """Make the rows of a run that was not compared with a truth: what its solutions state.

    R, N, B follow the solved positions.
    """
    solved = [s for s in run.solutions if s.position_m is not None and s.covariance_m2 is not None]
    places = [TimedPlace(read_time(s.utc), np.asarray(s.position_m)) for s in solved]
    axes = dict(zip((s.file for s in solved), find_motion_axes(places), strict=True))
    rows = []
    for s in run.solutions:
        camera = run.cameras.get(s.file)
        name = camera.name if camera else ""
        row = ErrorRow(s.file, s.utc, s.file in axes, s.method, name, s.outcome.reason, None)
        if s.position_m is not None and s.covariance_m2 is not None:
            rnb_from_body, _ = axes[s.file]
            sigma = np.sqrt(np.diag(rnb_from_body @ s.covariance_m2 @ rnb_from_body.T))
            distance = float(np.linalg.norm(s.position_m))
            height = distance - run.attitude.body.radius_m
            across = math.hypot(float(sigma[1]), float(sigma[2])) / distance
            row = replace(
                row,
                height_m=height,
                sigma_rnb_m=sigma,
                range_sigma=100.0 * float(sigma[0]) / height if height > 0.0 else None,
                direction_sigma=across / ARCSEC,
            )
        rows.append(row)
    return rows


def read_time(utc: str) -> float:
    """Return seconds; a time that is not understood puts its frame before all others."""
    try:
        return utc_to_tdb_s(utc)
    except DataError:
        return -math.inf


def _round_spreads(figures: Figures) -> dict[str, dict[str, float | None]]:
    """Round each component's errors to JSON values, m."""
    return {
        axis: {f"{k}_m": None if v is None else round(v, 3) for k, v in asdict(spread).items()}
        for axis, spread in zip("rnb", (figures.r, figures.n, figures.b), strict=True)
    }


def _round_shares(figures: Figures) -> dict[str, float]:
    return {axis: round(v, 6) for axis, v in zip("rnb", figures.inside_3_sigma, strict=True)}


def summarise_method(method: MethodFigures) -> dict[str, Any]:
    """Return a method's figures as JSON values, rounded as they are written."""
    figures = method.figures
    ranges = None if method.range_rms is None else round(100.0 * method.range_rms, 6)
    return {
        "method": method.method,
        "camera": method.camera,
        "frames_of_camera": method.of_frames,
        "solved": figures.solved,
        **_round_spreads(figures),
        "share_inside_3_sigma": _round_shares(figures),
        "normalised_error_squared": round(figures.nees, 6),
        "range_rms_percent": ranges,
        "direction_rms_arcsec": round(method.direction_rms / ARCSEC, 4),
    }


def evaluate_run(run: Path, truth: Path) -> Evaluation:
    """Compare a run folder with a truth.csv.

    Raises DataError for a folder that is no run, a damaged file, a truth of other frames.
    """
    with log_stage("evaluate"):
        folder = read_run(run)
        rows, radius_m = folder.solutions, folder.attitude.body.radius_m
        truths = read_truth(truth, folder.attitude)
        try:
            evaluation = evaluate(rows, truths, radius_m, folder.matches, folder.cameras)
        except DataError as error:
            raise DataError(f"{truth}: {error}") from error
        other = identify_other_frame(rows, truths, replace(folder.attitude, motion=None))
        if other:
            remark = (
                f"{truth}: its quaternions are {other}; wanted {folder.attitude.name}, as run.toml "
                "says; attitude errors and wrong points are left out"
            )
            evaluation = evaluation.without_attitudes(remark)
        for frame in evaluation.frames:
            row = frame.solution
            log.debug("%s: compared with its truth", row.file, extra=row.event("evaluate"))
    return evaluation


def write_evaluation(evaluation: Evaluation, folder: Path) -> None:
    """Write evaluation.json and evaluation.csv into a run folder.

    Raises NothingToDoError when no frame is solved, OutputError when the folder is not writable.
    """
    evaluation.figures()
    text = format_json(summarise(evaluation)) + "\n"
    with replace_file(folder / EVALUATION_CSV, make_prefix_test(b"file,utc,status,")) as path:
        EVALUATION.write(path, map(make_error_cells, evaluation.frames))
    with replace_file(folder / EVALUATION_JSON, make_prefix_test(b'{\n  "frames"')) as path:
        path.write_text(text, encoding="utf-8")


def summarise(evaluation: Evaluation) -> dict[str, Any]:
    """Return the figures as JSON values, rounded as they are written; NaN where none is solved."""
    figures = evaluation.figures_if_any()

    def round_arcsec(angle: float | None) -> float | None:
        return None if angle is None else round(angle / ARCSEC, 3)

    return {
        "frames": figures.frames,
        "solved": figures.solved,
        "share_solved": round(figures.solved / max(figures.frames, 1), 6),
        **_round_spreads(figures),
        "horizontal_rms_m": round(figures.horizontal_rms_m, 3),
        "horizontal_max_m": round(figures.horizontal_max_m, 3),
        "height_rms_m": round(figures.height_rms_m, 3),
        "share_inside_3_sigma": _round_shares(figures),
        "normalised_error_squared": round(figures.nees, 6),
        "normalised_error_squared_95_percent": [round(v, 6) for v in figures.nees_range],
        "attitude_rms_arcsec": round_arcsec(figures.attitude_rms),
        "attitude_max_arcsec": round_arcsec(figures.attitude_max),
        "frames_beyond_5_sigma": figures.beyond_5_sigma,
        "control_points": {
            name: getattr(figures, f"n_{name}")
            for name in ("predicted", "matched", "used", "checked", "wrong")
        },
        "methods": [summarise_method(method) for method in evaluation.by_method()],
        "frames_with_local_north": figures.north_frames,
        "unsolved_reasons": {k.value: v for k, v in figures.unsolved_reasons.items()},
        "remarks": list(evaluation.remarks),
    }


def format_table(evaluation: Evaluation) -> str:
    """Format the figures as a table; where no frame is solved, that and why."""
    figures = evaluation.figures_if_any()
    lines = [
        f"solved {figures.solved} of {figures.frames} frames "
        f"({_format_percent(figures.solved, figures.frames)})"
    ]
    if figures.solved:
        lines += ["", *_format_errors(figures), "", *_describe_honesty(figures)]
        methods = evaluation.by_method()
        if len(methods) > 1 or methods[0].method != "control_points":
            lines += ["", *format_methods(methods), ""]
    lines += _format_notes(figures, evaluation.remarks)
    return "\n".join(lines)


def format_methods(methods: Sequence[MethodFigures]) -> list[str]:
    """Format lines of a table, three per method: R, N, B; then its range and direction."""
    rows = [
        ("method, camera", "solved", "axis", "unit", "bias", "sigma", "max", "in 3 sigma", "NEES")
    ]
    for method in methods:
        figures = method.figures
        name = describe_method(method.method) + (f", {method.camera}" if method.camera else "")
        share, nees = f"{figures.solved} of {method.of_frames}", f"{figures.nees:.2f}"
        for axis, (spread, inside) in zip("RNB", _list_components(figures), strict=True):
            unit, bias, sigma, _, largest = _format_cells(spread)
            rows.append((name, share, axis, unit, bias, sigma, largest, inside, nees))
            name = share = nees = ""
    header, *lines = align_table(rows, left=range(4))
    shown = [header]
    for number, method in enumerate(methods):
        shown += lines[3 * number : 3 * number + 3]
        of_range = method.range_rms
        ranges = "" if of_range is None else f"range {100.0 * of_range:.3g} %, "
        shown.append(f"  {ranges}direction to the centre {format_angle(method.direction_rms)}, rms")
    return shown


def _format_errors(figures: Figures) -> list[str]:
    rows = [("error", "unit", "bias", "sigma", "rms", "max", "inside 3 sigma")]
    names = ("R  height", "N  along", "B  across")
    for name, (spread, inside) in zip(names, _list_components(figures), strict=True):
        rows.append((name, *_format_cells(spread), inside))
    rms, largest = figures.horizontal_rms_m, figures.horizontal_max_m
    unit = choose_length_unit(largest)
    rows.append(("horizontal", unit.name, "", "", unit.text(rms), unit.text(largest), ""))
    return align_table(rows, left=(0, 1))


def _list_components(figures: Figures) -> Iterator[tuple[Spread, str]]:
    """List each component's spread, and its share inside 3 stated sigmas in words."""
    for spread, inside in zip((figures.r, figures.n, figures.b), figures.inside_3_sigma):
        yield spread, f"{100.0 * inside:.1f} %"


def _format_cells(spread: Spread) -> tuple[str, str, str, str, str]:
    """Format unit, bias, sigma, rms, largest."""
    unit = choose_length_unit(spread.max)
    sigma = "-" if spread.sigma is None else unit.text(spread.sigma)
    return (
        unit.name,
        unit.text(spread.bias, "+"),
        sigma,
        unit.text(spread.rms),
        unit.text(spread.max),
    )


def _describe_honesty(figures: Figures) -> Iterator[str]:
    low, high = figures.nees_range
    yield (
        f"normalised error squared {figures.nees:.2f} (1 expected; {low:.2f} to {high:.2f} in "
        "95 % of cases with an honest covariance)"
    )
    if figures.beyond_5_sigma:
        yield (
            f"off by more than {BEYOND_SIGMAS:g} stated sigmas: {figures.beyond_5_sigma} of "
            f"{figures.solved} solved frames"
        )


def _format_notes(figures: Figures, remarks: tuple[str, ...]) -> list[str]:
    lines = []
    if figures.attitude_rms is not None and figures.attitude_max is not None:
        rms, largest = format_angle(figures.attitude_rms), format_angle(figures.attitude_max)
        lines.append(f"attitude error {rms} rms, {largest} max")
    if figures.n_predicted:  # a run by the horizon alone has none
        lines += _format_control_points(figures)
    if figures.north_frames:
        lines.append(
            f"N is local north for {figures.north_frames} of {figures.solved} frames "
            "that have no neighbour in their pass"
        )
    lines += [f"unsolved {n} times: {why.label}" for why, n in figures.unsolved_reasons.items()]
    return lines + list(remarks)


def _format_control_points(figures: Figures) -> list[str]:
    lines = [
        f"control points: {figures.n_predicted} predicted, {figures.n_matched} found "
        f"({_format_percent(figures.n_matched, figures.n_predicted)}), {figures.n_used} used "
        f"({_format_percent(figures.n_used, figures.n_predicted)})"
    ]
    if figures.n_checked:
        lines.append(
            f"wrong matches used (> {WRONG_PX:g} px from the truth): {figures.n_wrong} of "
            f"{figures.n_checked} ({_format_percent(figures.n_wrong, figures.n_checked, 2)})"
        )
    else:
        why = "no control point was kept; where windows and landmarks lie is not known to a pixel"
        if figures.n_checked is None:
            why = "the run has no camera files, or the truth's attitude is of another frame"
        lines.append(f"wrong matches: not checked ({why})")
    return lines


def _format_percent(part: int, total: int, decimals: int = 1) -> str:
    return f"{100.0 * part / total:.{decimals}f} %" if total else "-"
