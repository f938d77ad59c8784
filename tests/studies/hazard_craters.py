"""Which craters are dangerous, how many a pad has, and what they do to the variance of brightness.

The source calls young craters above 2 m dangerous, middle ones above 2.5 m and old ones above 4 m,
and expects about 3 of them on 20 x 20 m. Published depths over diameter: fresh craters below 1 km
0.1 to 0.2, the less the smaller (S. Sun, Z. Yue and K. Di, Icarus 309 (2018) 61); fresh ones of 40
to 100 m 0.13 (J. D. Stopar et al., Icarus 298 (2017) 34); decimetres to metres at Chang'E-4, of all
ages, 0.061 on average (B. Wu et al., Earth Planet. Sci. Lett. 553 (2021) 116666). Drawn are 0.2
fresh, 0.03 worn, 0.087 on average, so that no drawn crater is gentler than published ones.
"""

import math
from collections.abc import Iterator
from functools import cache
from typing import Any

import cv2
import numpy as np

from catalog.arrays import Float32Array, FloatArray
from catalog.rendering.map_view import render_map
from catalog.terrain.slopes import BASE_M, DANGEROUS_DEG
from catalog.terrain.synthetic.relief import (
    FRESH_DEPTH,
    GEOMETRIC_SATURATION,
    REACH,
    WORN_DEPTH,
    SyntheticRelief,
    evaluate_profile,
)
from tests.studies.hazard_fields import KINDS, RADIUS_M, SITE, sun_vector
from tests.studies.tables import StudyTable, columns

# Freshness of drawn craters, 1 of the youngest, the square of what is drawn evenly; the source's
# limits. A worn crater, of 0, is nowhere above 7 deg.
AGES = {"young": (1.0, 2.0), "middle": (0.5, 2.5), "old": (0.2, 4.0)}
RADII = np.linspace(0.0, REACH, 501)
POSTING_M, PAD_M = 0.05, 20.0
RESOLUTIONS_M = (0.2, 0.3, 0.5, 0.75, 1.0, 1.5, 2.0)
DIAMETERS_M = (0.5, 1.0, 1.5, 2.0, 2.5, 4.0, 6.0)
DANGEROUS_M, LARGEST_SMALL_M = 2.5, 2.0  # the crater to tell; those that must not count
SUNS = (20.0, 5.0)
SATURATION, ALBEDO = 0.02, 0.03
PADS = 16  # of small craters alone, along each side of the ground


def crater_heights(
    x: FloatArray, diameter_m: float, freshness: float, depth: float | None = None
) -> FloatArray:
    """Heights (n,) at distances from the middle, m; depth over diameter as drawn if left out."""
    share = WORN_DEPTH + (FRESH_DEPTH - WORN_DEPTH) * freshness if depth is None else depth
    heights = np.interp(np.abs(x) / (0.5 * diameter_m), RADII, tabulate_profile(freshness))
    return share * diameter_m * heights


@cache
def tabulate_profile(freshness: float) -> FloatArray:
    """Tabulate the drawn profile at RADII."""
    return np.array([evaluate_profile(float(r), 1.0 - freshness) for r in RADII])


def steepest_deg(diameter_m: float, freshness: float, depth: float | None = None) -> float:
    """Steepest slope on the base of 3 m anywhere along a line through the middle."""
    x = np.arange(-0.5 * REACH * diameter_m - BASE_M, 0.0, 0.04)
    ahead, behind = (crater_heights(x + s * 0.5 * BASE_M, diameter_m, freshness, depth)
                     for s in (1, -1))  # fmt: skip
    return math.degrees(math.atan(float(np.abs(ahead - behind).max()) / BASE_M))


def dangerous_diameter_m(freshness: float) -> float:
    """The least diameter of drawn craters of a freshness with slopes above 7 deg."""
    sizes = np.geomspace(1.0, 40.0, 150)
    steep = (d for d in sizes if steepest_deg(float(d), freshness) > DANGEROUS_DEG)
    return float(next(steep, math.inf))


def needed_depth(diameter_m: float, freshness: float) -> float:
    """Depth over diameter at which a crater of this size has 7 deg."""
    # slopes grow with the depth in proportion
    tangent = math.tan(math.radians(steepest_deg(diameter_m, freshness, 0.1)))
    return 0.1 * math.tan(math.radians(DANGEROUS_DEG)) / tangent


def count_dangerous(saturation: float, pad_m: float = PAD_M) -> float:
    """Expected dangerous craters whose middles lie on a pad, of all ages."""
    drawn = (np.arange(40) + 0.5) / 40.0  # evenly drawn; freshness is its square
    inverse = [dangerous_diameter_m(float(u * u)) ** -2 for u in drawn]
    return saturation * GEOMETRIC_SATURATION * pad_m**2 * float(np.mean(inverse))


def pad_variance(heights: Float32Array, sun_deg: float, resolution_m: float) -> Float32Array:
    """1000 x variance over squared mean of each pad of a ground, seen at a resolution."""
    bright = render_map(heights, POSTING_M, sun_vector(sun_deg, 90.0), radius_m=RADIUS_M)
    size = round(len(bright) * POSTING_M / resolution_m)
    # the optics blur by half a pixel, sigma, before pixels average
    blurred = cv2.GaussianBlur(bright, (0, 0), 0.5 * resolution_m / POSTING_M)
    seen = cv2.resize(blurred, (size, size), interpolation=cv2.INTER_AREA)
    wide = round(PAD_M / resolution_m)
    many = size // wide
    pads = seen[: many * wide, : many * wide].reshape(many, wide, many, wide)
    mean, square = pads.mean(axis=(1, 3)), (pads**2).mean(axis=(1, 3))
    alpha: Float32Array = (1000.0 * (square / mean**2 - 1.0)).astype(np.float32)
    return alpha


def one_crater(diameter_m: float, freshness: float = 1.0) -> Float32Array:
    """A pad of level ground with a crater in its middle."""
    nodes = round(PAD_M / POSTING_M)
    axis = (np.arange(nodes) - 0.5 * (nodes - 1)) * POSTING_M
    radius = np.hypot(axis[:, None], axis[None, :])
    lines = np.arange(0.0, radius.max() + 0.01, 0.01)
    heights = crater_heights(lines, diameter_m, freshness)
    pad: Float32Array = np.interp(radius, lines, heights).astype(np.float32)
    return pad


def small_craters(seed: int = 1) -> Float32Array:
    """Ground whose only relief are craters too small to be dangerous, in equilibrium."""
    relief = SyntheticRelief(
        seed, 0.5 * LARGEST_SMALL_M, RADIUS_M, 0.25, 1e-6, saturation=SATURATION
    )
    return relief.sample_local(SITE, POSTING_M, round(PADS * PAD_M / POSTING_M))


def size_table() -> StudyTable:
    """Dangerous diameters by age, and what depths the source's would need."""
    rows = [
        (
            age, fresh, limit, dangerous_diameter_m(fresh),
            WORN_DEPTH + (FRESH_DEPTH - WORN_DEPTH) * fresh, needed_depth(limit, fresh),
            {"young": "0.1-0.2", "middle": "0.061 of all ages", "old": "below 0.061"}[age],
        )
        for age, (fresh, limit) in AGES.items()
    ]  # fmt: skip
    return StudyTable(
        "Least dangerous diameter of craters: 7 deg on 3 m",
        columns(
            "age; freshness .1f; source [m] .1f; drawn [m] .1f; depth = drawn depth/diameter .3f;"
            "needed = depth/diameter for the source's .3f; published"
        ),
        tuple(rows),
    )


def density_table() -> StudyTable:
    """Dangerous craters of a pad by ground."""
    rows: list[tuple[Any, ...]] = [("source", None, 3.0)]
    third = float(np.mean([limit**-2 for _, limit in AGES.values()]))
    rows.append(
        ("its diameters, a third each", SATURATION,
         SATURATION * GEOMETRIC_SATURATION * PAD_M**2 * third)
    )  # fmt: skip
    rows += [(kind, ground.saturation, count_dangerous(ground.saturation))
             for kind, ground in KINDS.items()]  # fmt: skip
    return StudyTable(
        f"Dangerous craters on {PAD_M:g} x {PAD_M:g} m",
        columns("ground; saturation .3f; craters .1f"),
        tuple(rows),
    )


def variance_table() -> StudyTable:
    """Variance of a pad with one young crater by size and resolution, and the best resolution."""
    return StudyTable(
        "1000 variance / mean² of a pad with one young crater, and of small craters alone",
        columns(
            "sun = Sun [deg] .0f; resolution [m] .2f;"
            + ";".join(f"d_{round(10 * d)} = {d:g} m .2f" for d in DIAMETERS_M)
            + f";small = all below {LARGEST_SMALL_M:g} m .2f;"
            f"ratio = {DANGEROUS_M:g} m / small .2f;"
            "albedo = with albedo of 3 % .2f; best"
        ),
        tuple(_variance_rows()),
    )


def _variance_rows() -> Iterator[tuple[Any, ...]]:
    crowd, ones = small_craters(), {d: one_crater(d) for d in DIAMETERS_M}
    for sun in SUNS:
        rows = []
        for resolution in RESOLUTIONS_M:
            single = {d: float(pad_variance(h, sun, resolution).mean()) for d, h in ones.items()}
            small = float(np.median(pad_variance(crowd, sun, resolution)))
            ratio = single[DANGEROUS_M] / small
            patchy = single[DANGEROUS_M] / (small + 1000.0 * ALBEDO**2)
            rows.append((sun, resolution, *single.values(), small, ratio, patchy))
        best = max(row[-2] for row in rows), max(row[-1] for row in rows)
        words = " and ".join
        yield from (
            (*row, words(name for name, most, value in
                         zip(("craters", "with albedo"), best, row[-2:]) if value == most))
            for row in rows
        )  # fmt: skip
