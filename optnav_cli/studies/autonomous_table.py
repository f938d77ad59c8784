"""The autonomous study's figures: their two tables as text, and every frame of them as JSON."""

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from optnav_cli.evaluation.figures import FrameError, figures_of
from optnav_cli.studies.navigation import STAR_SENSOR_M_PER_KM

ENOUGH_ARC_DEG = 140.0
MIN_SOLVED = 0.95
MAX_SIGMAS = 5.0


@dataclass(frozen=True)
class Row:
    """One line of the table: a scenario, whose camera counts, and the figures to reach, m.

    star_sensor  whether horizontal_m is for exact attitudes, so that the star sensor's part is
                 added in quadrature
    """

    name: str
    scenario: str
    camera: str
    horizontal_m: float
    height_m: float
    star_sensor: bool = False


@dataclass(frozen=True, eq=False)
class RowResult:
    """The frames of a row's camera."""

    row: Row
    frames: tuple[FrameError, ...]

    @property
    def limit_m(self) -> float:
        """What the horizontal error may be; the star sensor adds its part in quadrature."""
        if not self.row.star_sensor:
            return self.row.horizontal_m
        heights_km = np.array([frame.height_m for frame in self.frames]) / 1e3
        extra = float(np.mean((STAR_SENSOR_M_PER_KM * heights_km) ** 2))
        return float(np.hypot(self.row.horizontal_m, np.sqrt(extra)))


@dataclass(frozen=True, eq=False)
class ShareResult:
    """The frames of a scenario and the arc of lit limb that each truly shows, deg."""

    scenario: str
    frames: tuple[FrameError, ...]
    arcs_deg: tuple[float, ...]


@dataclass(frozen=True, eq=False)
class Results:
    """Both tables."""

    rows: tuple[RowResult, ...]
    shares: tuple[ShareResult, ...]


def sigmas_off(frame: FrameError) -> float:
    """How far a solved frame is off in its own sigmas; 0 for an unsolved one."""
    return 0.0 if frame.nees is None else float(np.sqrt(frame.nees))


def format_results(results: Results) -> str:
    """Both tables in text."""
    lines = []
    if results.rows:
        lines.append(
            f"{'case':<24}{'solved':>8}{'horizontal':>18}{'height':>18}{'NEES':>7}{'worst':>8}"
        )
    for result in results.rows:
        solved = [frame for frame in result.frames if frame.nees is not None]
        start = f"{result.row.name:<24}{len(solved):>4}/{len(result.frames):<3}"
        if not solved:
            lines.append(f"{start}  none solved")
            continue
        f = figures_of(result.frames)
        worst = max(sigmas_off(frame) for frame in solved)
        lines.append(
            f"{start}{f.horizontal_rms_m:>8.1f} (≤ {result.limit_m:.0f}) m"
            f"{f.height_rms_m:>9.1f} (≤ {result.row.height_m:.0f}) m{f.nees:>7.2f}{worst:>6.1f} σ"
        )
    if results.shares:
        lines += ["", f"{'arc of lit limb':<24}{'≥ 140°':>12}{'less':>12}{'worst':>10}  methods"]
    for share in results.shares:
        lines.append(_share_line(share.scenario, [share]))
    if len(results.shares) > 1:
        lines.append(_share_line("together", results.shares))
        lines.append(f"wanted: {100 * MIN_SOLVED:.0f} % of those with an arc of 140°")
    every = [f for row in results.rows for f in row.frames]
    every += [f for share in results.shares for f in share.frames]
    wrong = sum(sigmas_off(frame) > MAX_SIGMAS for frame in every)
    lines.append(
        f"wrong by more than {MAX_SIGMAS:.0f} of their own sigmas: {wrong} of {len(every)}"
    )
    return "\n".join(lines)


def _share_line(name: str, shares: Sequence[ShareResult]) -> str:
    pairs = [pair for s in shares for pair in zip(s.frames, s.arcs_deg, strict=True)]
    counts = []
    for wide in (True, False):
        group = [frame for frame, arc in pairs if (arc >= ENOUGH_ARC_DEG) is wide]
        counts.append(f"{sum(f.nees is not None for f in group):>5}/{len(group):<4}")
    worst = max((sigmas_off(frame) for frame, _ in pairs), default=0.0)
    methods = [frame.solution.method for frame, _ in pairs if frame.nees is not None]
    tally = ", ".join(f"{methods.count(m)} {m.replace('_', ' ')}" for m in sorted(set(methods)))
    return f"{name:<24}{counts[0]:>12}{counts[1]:>12}{worst:>8.1f} σ  {tally}"


def write_figures(path: Path, rows: Sequence[RowResult], shares: Sequence[ShareResult]) -> None:
    """Write every frame of both tables as JSON."""
    content = {
        "rows": [
            {
                "case": result.row.name,
                "horizontal_limit_m": result.limit_m,
                "height_limit_m": result.row.height_m,
                "frames": [_frame(frame) for frame in result.frames],
            }
            for result in rows
        ],
        "shares": [
            {
                "scenario": share.scenario,
                "frames": [
                    {"lit_arc_deg": arc, **_frame(frame)}
                    for frame, arc in zip(share.frames, share.arcs_deg, strict=True)
                ],
            }
            for share in shares
        ],
    }
    path.write_text(json.dumps(content, indent=2) + "\n", encoding="utf-8")


def _frame(frame: FrameError) -> dict[str, object]:
    error = None if frame.error_rnb_m is None else [float(v) for v in frame.error_rnb_m]
    return {
        "file": frame.file,
        "method": frame.solution.method,
        "prior": frame.solution.prior,
        "error_rnb_m": error,
        "sigmas": sigmas_off(frame) if error else None,
        "reason": frame.solution.reason,
    }
