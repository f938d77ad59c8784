"""Small discs: how good directions and ranges are, and whether they are as good as they say.

Discs of the Moon and of Phobos, 2.2 to 40 pixels across, each over its own ground, from its own
side, at its own phase (0-120 deg), blur (0.5-1.2 px), noise (SNR 20-100) and depth of counts (8 or
12 bits), by the shipped cameras. Each is solved as `optnav navigate` solves a lone frame with an
exact attitude, once with its blur calibrated to 0.05 px and once without. No size of the error
model was set by these discs.
"""

import json
from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from itertools import pairwise
from pathlib import Path

import numpy as np

from catalog.errors import NoSolutionError
from catalog.progress import Progress
from optnav_cli.navigation.outline import method as outline
from optnav_cli.studies.disc_scene import GROUNDS, Disc, DiscScene, Shape

SEED = 77031
SHAPES: tuple[Shape, ...] = ("moon", "phobos")
EDGES_PX = (2.2, 3.0, 4.0, 6.0, 10.0, 16.0, 25.0, 40.0)  # of the bins of diameter
NEES = (0.7, 1.4)


@dataclass(frozen=True)
class DiscResult:
    """A disc solved, or why not.

    direction_px   error of the direction to the centre, rms of an axis, in pixels
    range_share    of the range, over it
    direction_nees, range_nees  squared errors over their expectation
    """

    shape: str
    blur_known: bool
    diameter_px: float
    phase_deg: float
    method: str = ""
    direction_px: float = np.nan
    range_share: float = np.nan
    direction_nees: float = np.nan
    range_nees: float = np.nan
    reason: str = ""


def run(progress: Progress, discs: int, output: Path | None) -> list[DiscResult]:
    """Draw and solve `discs` discs a bin and body; output is a JSON file of all results."""
    found: list[DiscResult] = []
    bins = list(pairwise(EDGES_PX))
    for which, shape in enumerate(SHAPES):
        scene = DiscScene(shape)
        total = discs * len(bins)
        with progress.stage(f"discs of {shape}", total, "disc") as bar:
            for number in range(total):
                rng = np.random.default_rng([SEED, which, number])
                low, high = bins[number % len(bins)]
                diameter = float(np.exp(rng.uniform(np.log(low), np.log(high))))
                disc = scene.draw(diameter, GROUNDS[number * len(GROUNDS) // total], rng)
                found += [solve(scene, disc, blur_known) for blur_known in (True, False)]
                bar.advance()
    if output is not None:
        text = json.dumps([asdict(result) for result in found], indent=1)
        output.write_text(text + "\n", encoding="utf-8")
    return found


def solve(scene: DiscScene, disc: Disc, blur_known: bool) -> DiscResult:
    """Solve a disc and compare it with its truth."""
    body, camera = scene.body, disc.camera
    if not blur_known:
        camera = replace(camera, psf_sigma_px=None, psf_error_px=None)
    result = DiscResult(body.name, blur_known, disc.diameter_px, disc.phase_deg)
    try:
        fix = outline.navigate(
            disc.picture, camera, disc.camera_from_body, 0.0, disc.sun_body, body, scene.relief
        )
    except NoSolutionError as error:
        return replace(result, reason=str(error))
    error_m = fix.position_m - disc.position_m
    distance = float(np.linalg.norm(disc.position_m))
    up = disc.position_m / distance
    square = np.linalg.svd(up[None])[2][1:]
    across = square @ error_m
    covariance = square @ fix.covariance_m2 @ square.T
    px_per_m = 0.5 * disc.diameter_px / float(np.mean(body.radii_m))
    return replace(
        result,
        method=fix.method,
        direction_px=float(np.linalg.norm(across)) * px_per_m / np.sqrt(2.0),
        range_share=float(error_m @ up) / distance,
        direction_nees=float(across @ np.linalg.solve(covariance, across)) / 2.0,
        range_nees=float(error_m @ up) ** 2 / float(up @ fix.covariance_m2 @ up),
    )


def format_table(results: Sequence[DiscResult]) -> str:
    """One line a body, knowledge of the blur and bin of diameter."""
    lines = [
        f"{'disc':<28}{'solved':>8}{'direction':>12}{'NEES':>7}{'range':>9}{'NEES':>7}{'worst':>8}"
        "  methods"
    ]
    for shape in SHAPES:
        for blur_known in (True, False):
            for low, high in pairwise(EDGES_PX):
                own = [
                    r
                    for r in results
                    if (r.shape, r.blur_known) == (shape, blur_known)
                    and low <= r.diameter_px < high
                ]
                name = f"{shape}, {low:g}-{high:g} px" + ("" if blur_known else ", blur unknown")
                lines.append(_line(name, own))
    lines.append(f"wanted: NEES {NEES[0]}-{NEES[1]}; worst: of direction or range, in sigmas")
    reasons = Counter(r.reason.rpartition("; ")[2][:90] for r in results if not r.method)
    lines += [f"{count} not solved: {reason}" for reason, count in reasons.most_common(6)]
    return "\n".join(lines)


def _line(name: str, results: Sequence[DiscResult]) -> str:
    solved = [r for r in results if r.method]
    start = f"{name:<28}{len(solved):>4}/{len(results):<3}"
    if not solved:
        return f"{start}  none solved"
    direction = np.sqrt(np.mean([r.direction_px**2 for r in solved]))
    share = 100.0 * np.sqrt(np.mean([r.range_share**2 for r in solved]))
    across, along = (
        np.array([getattr(r, key) for r in solved]) for key in ("direction_nees", "range_nees")
    )
    worst = np.sqrt(max(2.0 * across.max(), along.max()))
    methods = Counter(r.method.replace("_", " ") for r in solved)
    tally = ", ".join(f"{count} {method}" for method, count in sorted(methods.items()))
    return (
        f"{start}{direction:>9.3f} px{across.mean():>7.2f}{share:>7.2f} %{along.mean():>7.2f}"
        f"{worst:>6.1f} σ  {tally}"
    )
