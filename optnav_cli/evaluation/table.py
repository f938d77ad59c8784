"""The evaluation of a run as a table for people: each row in the unit that suits its lengths."""

from collections.abc import Iterator, Sequence

from optnav_cli.evaluation.evaluation import WRONG_PX, Evaluation
from optnav_cli.evaluation.figures import (
    BEYOND_SIGMAS,
    Figures,
    MethodFigures,
    Spread,
    method_words,
)
from optnav_cli.output.wording import align_table, choose_length_unit, format_angle


def format_table(evaluation: Evaluation) -> str:
    """The figures as a table; where no frame is solved, that and why."""
    figures = evaluation.figures_if_any()
    lines = [
        f"solved {figures.solved} of {figures.frames} frames "
        f"({_percent(figures.solved, figures.frames)})"
    ]
    if figures.solved:
        lines += ["", *_error_lines(figures), "", *_honesty(figures)]
        methods = evaluation.by_method()
        if len(methods) > 1 or methods[0].method != "control_points":
            lines += ["", *method_lines(methods), ""]
    lines += _notes(figures, evaluation.remarks)
    return "\n".join(lines)


def method_lines(methods: Sequence[MethodFigures]) -> list[str]:
    """Lines of a table, three a method: R, N, B; then its range and direction."""
    rows = [
        ("method, camera", "solved", "axis", "unit", "bias", "sigma", "max", "in 3 sigma", "NEES")
    ]
    for method in methods:
        figures = method.figures
        name = method_words(method.method) + (f", {method.camera}" if method.camera else "")
        share, nees = f"{figures.solved} of {method.of_frames}", f"{figures.nees:.2f}"
        for axis, (spread, inside) in zip("RNB", _components(figures), strict=True):
            unit, bias, sigma, _, largest = _cells(spread)
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


def _error_lines(figures: Figures) -> list[str]:
    rows = [("error", "unit", "bias", "sigma", "rms", "max", "inside 3 sigma")]
    names = ("R  height", "N  along", "B  across")
    for name, (spread, inside) in zip(names, _components(figures), strict=True):
        rows.append((name, *_cells(spread), inside))
    rms, largest = figures.horizontal_rms_m, figures.horizontal_max_m
    unit = choose_length_unit(largest)
    rows.append(("horizontal", unit.name, "", "", unit.text(rms), unit.text(largest), ""))
    return align_table(rows, left=(0, 1))


def _components(figures: Figures) -> Iterator[tuple[Spread, str]]:
    """Each component's spread, and its share inside 3 stated sigmas in words."""
    for spread, inside in zip((figures.r, figures.n, figures.b), figures.inside_3_sigma):
        yield spread, f"{100.0 * inside:.1f} %"


def _cells(spread: Spread) -> tuple[str, str, str, str, str]:
    """Unit, bias, sigma, rms, largest."""
    unit = choose_length_unit(spread.max)
    sigma = "-" if spread.sigma is None else unit.text(spread.sigma)
    return (
        unit.name,
        unit.text(spread.bias, "+"),
        sigma,
        unit.text(spread.rms),
        unit.text(spread.max),
    )


def _honesty(figures: Figures) -> Iterator[str]:
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


def _notes(figures: Figures, remarks: tuple[str, ...]) -> list[str]:
    lines = []
    if figures.attitude_rms is not None and figures.attitude_max is not None:
        rms, largest = format_angle(figures.attitude_rms), format_angle(figures.attitude_max)
        lines.append(f"attitude error {rms} rms, {largest} max")
    if figures.n_predicted:  # a run by the horizon alone has none
        lines += _control_points(figures)
    if figures.north_frames:
        lines.append(
            f"N is local north for {figures.north_frames} of {figures.solved} frames "
            "that have no neighbour in their pass"
        )
    lines += [f"unsolved {n} times: {why.label}" for why, n in figures.unsolved_reasons.items()]
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
        why = "no control point was kept; where windows and landmarks lie is not known to a pixel"
        if figures.n_checked is None:
            why = "the run has no camera files, or the truth's attitude is of another frame"
        lines.append(f"wrong matches: not checked ({why})")
    return lines


def _percent(part: int, whole: int, decimals: int = 1) -> str:
    return f"{100.0 * part / whole:.{decimals}f} %" if whole else "-"
