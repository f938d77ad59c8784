"""The horizon study's figures and their table."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

DIRECTION_ARCSEC, DIRECTION_STAR_ARCSEC = 5.0, 20.0  # what far rows ask for
MAX_SSP_M = 600.0
BETTER = 10.0  # times, of relief against sphere over the ground
NEES = (0.7, 1.4)


@dataclass(frozen=True)
class Row:
    """One line of the table, a scenario, and what is asked of the terrain-aware horizon.

    ssp_m, ssp_star_m  rms over the ground with exact attitude and with the star sensor's
    height_m           rms of the height
    range_share        rms of the range as a share of it, of a far row
    Nothing is asked of a crescent but that no solution is wrong by 5 of its own sigmas.
    """

    name: str
    scenario: str
    ssp_m: float | None = None
    ssp_star_m: float | None = None
    height_m: float | None = None
    range_share: float | None = None

    @property
    def far(self) -> bool:
        """Whether the Earth may stand beside the Moon."""
        return self.range_share is not None


@dataclass(frozen=True)
class FrameResult:
    """A picture solved in one way; without a solution only the reason counts.

    ssp_m, direction_arcsec  angle at the body's centre between the true and the found position, as
                             metres of ground and as an angle: the direction of the centre is off
                             by as much
    nees                     normalised error squared over its expectation
    seconds                  of the processor, edges included
    """

    file: str
    terrain: bool
    star_sensor: bool
    ssp_m: float = np.nan
    height_m: float = np.nan
    range_share: float = np.nan
    direction_arcsec: float = np.nan
    nees: float = np.nan
    arc_deg: float = np.nan
    seconds: float = np.nan
    reason: str = ""


@dataclass(frozen=True)
class CaseFigures:
    """Figures over the pictures of a row solved in one way; NaN where none is solved."""

    frames: int
    solved: int
    ssp_rms_m: float
    ssp_max_m: float
    height_rms_m: float
    range_rms_share: float
    direction_rms_arcsec: float
    nees: float
    worst_sigmas: float
    median_seconds: float
    reasons: tuple[str, ...]


class Result(Protocol):
    """What the table needs of a row's result."""

    @property
    def row(self) -> Row: ...
    @property
    def sphere(self) -> CaseFigures: ...
    @property
    def terrain(self) -> CaseFigures: ...
    @property
    def terrain_star(self) -> CaseFigures: ...


def figures_of(frames: Sequence[FrameResult]) -> CaseFigures:
    """Figures over frames that were solved in the same way."""
    good = [frame for frame in frames if not frame.reason]

    def rms(name: str) -> float:
        values = np.array([getattr(frame, name) for frame in good])
        return float(np.sqrt(np.mean(values**2))) if good else float("nan")

    nees = np.array([frame.nees for frame in good])
    return CaseFigures(
        frames=len(frames),
        solved=len(good),
        ssp_rms_m=rms("ssp_m"),
        ssp_max_m=max((frame.ssp_m for frame in good), default=float("nan")),
        height_rms_m=rms("height_m"),
        range_rms_share=rms("range_share"),
        direction_rms_arcsec=rms("direction_arcsec"),
        nees=float(nees.mean()) if good else float("nan"),
        worst_sigmas=float(np.sqrt(3.0 * nees.max())) if good else float("nan"),
        median_seconds=float(np.median([f.seconds for f in good])) if good else float("nan"),
        reasons=tuple(frame.reason for frame in frames if frame.reason),
    )


def format_results(results: Sequence[Result]) -> str:
    """The table in text: near rows, far rows, and why frames were not solved."""
    near = [result for result in results if result.row.range_share is None]
    far = [result for result in results if result.row.range_share is not None]
    lines = []
    if near:
        lines.append(
            f"{'case, rms m':<24}{'solved':>8}{'sphere SSP, h':>16}{'terrain SSP':>18}{'max':>6}"
            f"{'height':>15}{'SSP, 10″':>15}{'better':>8}{'NEES':>12}{'worst':>7}{'CPU':>9}"
        )
    for result in near:
        lines.append(_near_line(result))
    if far:
        lines.append(
            f"{'case':<24}{'solved':>8}{'sphere range':>14}{'terrain range':>20}"
            f"{'direction':>13}{'10″':>13}{'NEES':>12}{'worst':>7}{'CPU':>9}"
        )
    for result in far:
        lines.append(_far_line(result))
    for result in results:
        for reason in sorted(set(result.terrain.reasons)):
            count = result.terrain.reasons.count(reason)
            lines.append(f"{result.row.name}: {count} not solved: {reason}")
    lines.append(
        f"wanted besides: max {MAX_SSP_M:.0f} m, {BETTER:.0f} times better than the sphere, "
        f"NEES {NEES[0]}-{NEES[1]}, worst below 5 σ"
    )
    return "\n".join(lines)


def _near_line(result: Result) -> str:
    row, sphere, terrain, star = result.row, result.sphere, result.terrain, result.terrain_star
    return (
        f"{row.name:<24}{terrain.solved:>4}/{terrain.frames:<3}"
        f"{sphere.ssp_rms_m:>9.0f} {sphere.height_rms_m:>5.0f} "
        f"{terrain.ssp_rms_m:>9.0f}{_limit(row.ssp_m):>9}{terrain.ssp_max_m:>6.0f}"
        f"{terrain.height_rms_m:>7.0f}{_limit(row.height_m):>8}"
        f"{star.ssp_rms_m:>7.0f}{_limit(row.ssp_star_m):>8}"
        f"{sphere.ssp_rms_m / terrain.ssp_rms_m:>7.0f}x{terrain.nees:>6.2f}{star.nees:>6.2f}"
        f"{max(terrain.worst_sigmas, star.worst_sigmas):>5.1f} σ"
        f"{terrain.median_seconds * 1e3:>6.0f} ms"
    )


def _far_line(result: Result) -> str:
    row, sphere, terrain, star = result.row, result.sphere, result.terrain, result.terrain_star
    asked = "" if row.range_share is None else f"(≤{100.0 * row.range_share:.2f})"
    return (
        f"{row.name:<24}{terrain.solved:>4}/{terrain.frames:<3}"
        f"{100.0 * sphere.range_rms_share:>12.4f} %"
        f"{100.0 * terrain.range_rms_share:>10.4f} {asked:<8}%"
        f"{terrain.direction_rms_arcsec:>6.1f} (≤{DIRECTION_ARCSEC:.0f})″"
        f"{star.direction_rms_arcsec:>6.1f} (≤{DIRECTION_STAR_ARCSEC:.0f})″"
        f"{terrain.nees:>6.2f}{star.nees:>6.2f}"
        f"{max(terrain.worst_sigmas, star.worst_sigmas):>5.1f} σ"
        f"{terrain.median_seconds * 1e3:>6.0f} ms"
    )


def _limit(asked: float | None) -> str:
    return "" if asked is None else f" (≤{asked:.0f})"
