"""Limits that a run's figures must keep, as a pipeline sets them."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

from catalog.errors import DifferenceError
from optnav_cli.evaluation.figures import BEYOND_SIGMAS, Figures
from optnav_cli.output.wording import length
from optnav_cli.reasons import told_apart


@dataclass(frozen=True)
class Limits:
    """What the figures are held against; None for no limit.

    max_horizontal_m, max_height_m  rms of the errors along and across; of the height
    min_solved  solved frames: how many (int), or the share of all (float, 0 to 1)
    max_nees    mean of the error squared over its covariance, a degree of freedom: 1 if honest
    max_wrong   solved frames whose error is beyond 5 stated sigmas
    """

    max_horizontal_m: float | None = None
    max_height_m: float | None = None
    min_solved: int | float | None = None
    max_nees: float | None = None
    max_wrong: int | None = None


class LimitCheck(NamedTuple):
    """A figure beside its limit; `words` say how it passes it."""

    name: str
    limit: float
    figure: float
    kept: bool
    words: str


def limit_checks(figures: Figures, limits: Limits) -> list[LimitCheck]:
    """The limits that are set, each with its figure; without a solved frame min_solved alone."""
    return [*_solved(figures, limits), *(_of_solved(figures, limits) if figures.solved else ())]


def check_limits(figures: Figures, limits: Limits) -> None:
    """Raise DifferenceError naming the figures that pass their limits."""
    passed = [check.words for check in limit_checks(figures, limits) if not check.kept]
    if passed:
        raise DifferenceError("; ".join(passed))


def _solved(figures: Figures, limits: Limits) -> Iterator[LimitCheck]:
    limit = limits.min_solved
    if limit is None:
        return
    share = isinstance(limit, float)
    figure = figures.solved / max(figures.frames, 1) if share else figures.solved
    words, wanted = f"{figures.solved} of {figures.frames} frames are solved", f"{limit}"
    if share:
        percent, wanted = (f"{n} %" for n in told_apart(100.0 * figure, 100.0 * limit, 1))
        words = f"{words} ({percent})"
    yield LimitCheck(
        "min_solved", limit, figure, figure >= limit, f"{words}, fewer than the limit of {wanted}"
    )


def _of_solved(figures: Figures, limits: Limits) -> Iterator[LimitCheck]:
    beyond = f"{figures.beyond_5_sigma} of {figures.solved} solved frames are off by more than "
    for name, figure, words in (
        ("max_horizontal_m", figures.horizontal_rms_m, "horizontal error {} (rms)"),
        ("max_height_m", figures.height_rms_m, "height error {} (rms)"),
        ("max_nees", figures.nees, "normalised error squared {}"),
        ("max_wrong", figures.beyond_5_sigma, f"{beyond}{BEYOND_SIGMAS:g} stated sigmas, which"),
    ):
        limit = getattr(limits, name)
        if limit is not None:
            metres = " m" if name.endswith("_m") else ""
            shown, most = length(figure) if metres else f"{figure:.3g}", f"{limit:g}{metres}"
            if abs(figure - limit) < 0.01 * limit:
                shown, most = (f"{n}{metres}" for n in told_apart(figure, limit, 2))
            text = f"{words.format(shown)} passes the limit of {most}"
            # not >, so that a figure which is no number is reported
            yield LimitCheck(name, limit, figure, figure <= limit, text)
