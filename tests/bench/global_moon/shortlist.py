"""Selection alone: the closed-form response over all cells of the Moon, one core, no renders.

The code is the render stage's own up to its shortlist: heights on each zone's graticule, the
response of every window for all its Suns, the strongest places of every cell.
"""

import cProfile
import pstats
import time
from collections.abc import Iterator
from pathlib import Path

from catalog.bodies.body import load_body
from catalog.geometry.cells import CellGrid
from catalog.pipeline import shortlist
from catalog.pipeline.config import BodySettings, BuildConfig
from catalog.pipeline.context import StageContext
from catalog.terrain.dem.mosaic import Mosaic
from catalog.terrain.dem.source import DemSettings
from tests.bench.global_moon import hillshade
from tests.bench.timing import one_core

PASSES = 3.0  # of hillshade: what the figures ask for
RUNS = 3
# Of the profile: what a function and all below it used.
PARTS = {
    "heights": "graticule_heights",
    "of it reading": "read_raw",
    "sums": "sum_tiles",
    "eigenvalues": "compute_window_eigenvalues",
    "peaks": "find_strongest_windows",
    "cells about the poles": "_search_cell",
}


def shortlist_lines(raster: Path, folder: Path) -> Iterator[str]:
    """Time over all cells, its parts, and its ratio to one hillshade pass of the raster.

    Processor time of one core on both sides, the least of some runs that take turns; reading and
    decoding the raster count. The folder takes overviews and the hillshade.
    """
    overviews = folder / f"bench_overviews_{raster.stem}"
    dem = DemSettings(path=str(raster))
    config = BuildConfig(body=BodySettings("moon"), dem=(dem,))
    mosaic = Mosaic.from_files([dem], raster.parent, load_body("moon"), overviews)
    context = StageContext(mosaic.body, mosaic, CellGrid(1.0), mosaic.posting_m, config)
    own, shades = [], []
    with one_core():
        # compiled and tables made: a zone and some cells of a pole
        shortlist.make_shortlists(context, [*range(20), context.grid.total // 2])
        for _ in range(RUNS):
            mosaic.close()
            started = time.process_time()
            found = shortlist.make_shortlists(context, range(context.grid.total))
            own.append(time.process_time() - started)
            shades.append(hillshade.one_pass(raster, folder).cpu_s)
        mosaic.close()
        profile = cProfile.Profile()
        profile.runcall(shortlist.make_shortlists, context, range(context.grid.total))
    yield (
        f"selection alone at {mosaic.posting_m:.0f} m, {context.grid.total} cells, window "
        f"{config.render.window_nodes} nodes, one core: {min(own):.2f} s, "
        f"{sum(len(one.places) for one in found.values())} places"
    )
    yield f"  {_parts(profile)}"
    yield (
        f"  one hillshade pass of the same raster {min(shades):.2f} s: "
        f"{min(own) / min(shades):.1f} passes (wanted {PASSES:g})"
    )


def _parts(profile: cProfile.Profile) -> str:
    """Seconds of the parts, in a run whose profile was taken: it is somewhat slower."""
    used: dict[str, float] = {}
    for (_, _, name), row in pstats.Stats(profile).stats.items():  # type: ignore[attr-defined]
        used[name] = used.get(name, 0.0) + row[3]
    return "profile: " + ", ".join(f"{part} {used[name]:.2f} s" for part, name in PARTS.items())
