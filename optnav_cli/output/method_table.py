"""What each method did, for evaluation.json and for people."""

from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

from catalog.geometry.rotations import ARCSEC
from optnav_cli.output.figures import MethodFigures, Spread
from optnav_cli.output.methods import method_words
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
