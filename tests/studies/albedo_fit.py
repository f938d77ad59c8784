"""How the Moon's albedo follows its relief, by an albedo map against a terrain model.

Squares of ground as wide as templates are treated as matches treat them: the logarithm of
brightness, less its mean about each node, is fitted by steepness and crests of the heights. The
mean of each strength over all squares, and its rms about that, are the numbers of
configs/models/albedo.toml. Squares where the scenarios of `make study-navigation` fly under this
map only score.

Beside both stands how brightness goes with rises toward east and north. Albedo knows no direction
but a map of it may hold some shading, or corrections that were too strong: both show there.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from catalog.arrays import FloatArray
from catalog.bodies.body import Body, load_body
from catalog.config import read_toml_text, resource
from catalog.correlation.filters import filter_high_pass
from catalog.correlation.relief_albedo import (
    FILE,
    ReliefAlbedo,
    compute_steepness_and_crests,
    load_shipped_strengths,
)
from catalog.errors import NothingToDoError
from catalog.files import check_file, make_prefix_test, write_output
from catalog.geometry.latlon import xyz_from_latlon
from catalog.progress import Progress
from catalog.terrain.dem.source import DemSettings, DemSource
from optnav_cli.simulation.albedo import AlbedoMap
from optnav_cli.simulation.scenario import load_scenario
from tests.studies import flights, likelihood
from tests.studies.tables import Cell, StudyReport, StudyTable, columns

Box = tuple[float, float, float, float]  # west, south, east, north, deg

MAPPED = "real_mare_400km"  # the scenario that names the map
FITTED: dict[str, Box] = {
    "Mare Imbrium": (-28.0, 28.0, -10.0, 42.0),
    "Oceanus Procellarum": (-60.0, 10.0, -42.0, 24.0),
    "Mare Crisium": (52.0, 10.0, 64.0, 23.0),
    "Mare Fecunditatis": (45.0, -12.0, 58.0, 2.0),
    "Mare Nubium": (-25.0, -24.0, -8.0, -10.0),
    "Mare Humorum": (-46.0, -31.0, -32.0, -16.0),
    "southern highlands": (5.0, -35.0, 25.0, -15.0),
    "far side, 180 E": (170.0, 5.0, 190.0, 25.0),
    "far side, 230 E": (220.0, -20.0, 240.0, 0.0),
}
SCORED: dict[str, Box] = {
    "real_mare_400km": (20.5, 6.5, 31.5, 17.5),
    "real_farside_400km": (134.0, -26.0, 152.0, -12.0),
}
# Where the map's own shading is strong, and no scenario flies.
SHOWN: dict[str, Box] = {
    "far side, 55 N": (150.0, 50.0, 170.0, 60.0),
    "far side, 55 S": (150.0, -60.0, 170.0, -50.0),
}
POSTINGS_DEG = 1.0 / 32.0  # of the terrain model
SIDE = 80  # nodes of a square, as of a template
BEGINNING = b"# How the Moon's albedo follows"


@dataclass(frozen=True, eq=False)
class BoxStrengths:
    """How albedo goes with relief in the squares of a box.

    strengths  (n, 2) of steepness and crests, and explained (n,) the shares that they explain
    rises      (n, 2) logarithm of brightness a unit of slope, rising toward east and north, fitted
               beside both; shaded (n,) the share that these explain more
    """

    name: str
    strengths: FloatArray
    explained: FloatArray
    rises: FloatArray
    shaded: FloatArray


@dataclass(frozen=True, eq=False)
class AlbedoFitResult:
    """Numbers before and after; the boxes fitted with, those that score, those shown alone."""

    old: ReliefAlbedo
    new: Mapping[str, float]
    fit: Sequence[BoxStrengths]
    held: Sequence[BoxStrengths]
    shown: Sequence[BoxStrengths] = ()


def run(progress: Progress, rows: str, output: Path | None) -> AlbedoFitResult:
    """Fit the strengths; a TOML file with them goes to `output`.

    rows  only boxes whose name contains this
    """
    if output is not None:
        check_file(output, make_prefix_test(BEGINNING))
    chosen = {name: box for name, box in FITTED.items() if rows in name}
    if not chosen:
        raise NothingToDoError(f"no ground to fit with is called '{rows}': {', '.join(FITTED)}")
    flights.check_shared_files([MAPPED])
    body = load_body("moon")
    settings = load_scenario(resource(f"configs/scenarios/{MAPPED}.toml")).world.albedo_map
    if not settings:
        raise NothingToDoError(f"{MAPPED} names no albedo_map")
    albedo = AlbedoMap(settings, body)
    source = DemSource.open(DemSettings(path=flights.GLOBE), Path.cwd(), body)
    held, shown = (SCORED, SHOWN) if not rows else ({}, {})
    found = {}
    every = chosen | held | shown
    with progress.stage("squares", len(every), "box") as bar:
        for name, box in every.items():
            found[name] = of_box(name, box, source, albedo, body)
            bar.advance()
    source.close()
    fit = [found[name] for name in chosen]
    old = load_shipped_strengths()
    new = fitted(fit)
    if output is not None:
        text = likelihood.with_numbers(read_toml_text(resource(FILE)), numbers(old), new)
        write_output(output, text.encode(), make_prefix_test(BEGINNING))
    rest = ([found[name] for name in names] for names in (held, shown))
    return AlbedoFitResult(old, new, fit, *rest)


def of_box(name: str, box: Box, source: DemSource, albedo: AlbedoMap, body: Body) -> BoxStrengths:
    """The strengths in the squares of a box."""
    west, south, east, north = box
    lat = np.radians(np.arange(north - POSTINGS_DEG / 2.0, south, -POSTINGS_DEG))
    lon = np.radians(np.arange(west + POSTINGS_DEG / 2.0, east, POSTINGS_DEG))
    lats, lons = np.meshgrid(lat, lon, indexing="ij")
    heights = source.heights_at(lats, lons).astype(np.float64)
    directions = xyz_from_latlon(lats, lons, 1.0).reshape(-1, 3)
    brightness = albedo.at(directions).reshape(heights.shape)
    row_m = float(np.radians(POSTINGS_DEG)) * body.radius_m
    return squares(name, heights, brightness, (row_m, row_m * float(np.cos(lat.mean()))))


def squares(
    name: str, heights: FloatArray, brightness: FloatArray, postings_m: tuple[float, float]
) -> BoxStrengths:
    """The strengths in the squares of a grid (n, m) of heights and brightness.

    postings_m  from row to row and from column to column
    """
    down, east = (np.asarray(g) for g in np.gradient(heights, *postings_m))
    patterns = (*compute_steepness_and_crests(heights, postings_m), east, -down)
    *relief, logs = (
        filter_high_pass(g.astype(np.float32)) for g in (*patterns, np.log(brightness))
    )
    found, explained = [], []
    rises, shaded = [], []
    rows, cols = heights.shape
    for row in range(0, rows - SIDE + 1, SIDE):
        for col in range(0, cols - SIDE + 1, SIDE):
            part = slice(row, row + SIDE), slice(col, col + SIDE)
            laid = np.stack([grid[part].ravel() for grid in relief], axis=1).astype(np.float64)
            values = logs[part].ravel().astype(np.float64)
            strengths, share = _fit(laid[:, :2], values)
            all_four, with_rises = _fit(laid, values)
            found.append(strengths)
            explained.append(share)
            rises.append(all_four[2:])
            shaded.append(with_rises - share)
    pairs = (np.array(some).reshape(-1, 2) for some in (found, rises))
    return BoxStrengths(name, next(pairs), np.array(explained), next(pairs), np.array(shaded))


def _fit(patterns: FloatArray, values: FloatArray) -> tuple[FloatArray, float]:
    """Strengths (k,) of patterns (n, k) in values (n,), and the share of these they explain."""
    strengths = np.asarray(np.linalg.lstsq(patterns, values)[0], np.float64)
    rest = values - patterns @ strengths
    return strengths, 1.0 - float(rest @ rest) / max(float(values @ values), 1e-30)


def fitted(boxes: Sequence[BoxStrengths]) -> dict[str, float]:
    """Mean and rms about it of each strength, over all squares alike, by their names."""
    every = np.concatenate([box.strengths for box in boxes])
    mean, sigma = every.mean(axis=0), every.std(axis=0)
    return {
        f"{name}.{what}": float(values[k])
        for k, name in enumerate(("steepness", "crests"))
        for what, values in (("mean", mean), ("sigma", sigma))
    }


def numbers(strengths: ReliefAlbedo) -> dict[str, float]:
    """All numbers of FILE by their names."""
    return {
        f"{name}.{what}": getattr(getattr(strengths, name), what)
        for name in ("steepness", "crests")
        for what in ("mean", "sigma")
    }


NUMBERS = columns("number; old .2g; new .2g")
SCORES = columns(
    "ground; squares; used; steepness .2f; steepness_rms = rms .2f; crests .2f; "
    "crests_rms = rms .2f; explained = explained [%] .0f; sigmas = mean off [σ] .1f; "
    "east = rising east .2f; north = rising north .2f; shaded = explained more [%] .1f"
)


def report(result: AlbedoFitResult) -> StudyReport:
    """The numbers, and the strengths on every ground."""
    old = numbers(result.old)
    sizes = tuple((name, old[name], value) for name, value in result.new.items())
    scores: list[tuple[Cell, ...]] = []
    uses = ("fitted with", "other ground", "shown alone")
    for used, boxes in zip(uses, (result.fit, result.held, result.shown), strict=True):
        for box in boxes:
            mean, rms = box.strengths.mean(axis=0), box.strengths.std(axis=0)
            shown = (float(mean[0]), float(rms[0]), float(mean[1]), float(rms[1]))
            off = max(
                abs(mean[k] - result.new[f"{name}.mean"]) / result.new[f"{name}.sigma"]
                for k, name in enumerate(("steepness", "crests"))
            )
            share, more = (100.0 * float(np.median(s)) for s in (box.explained, box.shaded))
            east, north = map(float, box.rises.mean(axis=0))
            row = (box.name, len(box.strengths), used, *shown, share, float(off), east, north, more)
            scores.append(row)
    tables = (StudyTable("Numbers", NUMBERS, sizes), StudyTable("Grounds", SCORES, tuple(scores)))
    note = (
        f"squares of {SIDE} nodes of 948 m; logarithm of brightness a unit of slope, and a unit of "
        "slope change over a kilometre; of rises toward east and north beside both"
    )
    return StudyReport(tables, (note,))
