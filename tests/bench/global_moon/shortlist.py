"""Selection alone: the closed-form response over all cells of the Moon, one core, no renders.

The code is the render stage's own up to its shortlist: a cell's ground is cut, the response for
all its Suns is computed in closed form, and the strongest peaks are taken.
"""

import time
from collections.abc import Iterator
from pathlib import Path

from catalog.bodies.body import load_body
from catalog.geometry.cells import CellGrid
from catalog.stages import render
from catalog.stages.context import BodySettings, StageContext
from catalog.stages.settings import BuildConfig
from catalog.terrain.mosaic import Mosaic
from catalog.terrain.source import DemSettings
from tests.bench.global_moon import hillshade
from tests.bench.timing import one_core

# The window's least size: 7.6 km at 474 m, the footprint of the finest template of a 118 m catalog.
WINDOW_NODES = 16
PASSES = 3.0  # of hillshade: what the figures ask for
WARM_CELLS = 50


def shortlist_lines(raster: Path, folder: Path) -> Iterator[str]:
    """Time over all cells, its parts, and its ratio to one hillshade pass of the raster.

    Processor time of one core on both sides; the folder takes overviews and the hillshade.
    """
    overviews = folder / f"bench_overviews_{raster.stem}"
    dem = DemSettings(path=str(raster))
    config = BuildConfig(
        body=BodySettings("moon"), dem=(dem,), render=render.Settings(window_nodes=WINDOW_NODES)
    )
    mosaic = Mosaic.from_files([dem], raster.parent, load_body("moon"), overviews)
    context = StageContext(mosaic.body, mosaic, CellGrid(1.0), mosaic.posting_m, config)
    with one_core():
        _run(context, range(0, context.grid.total, context.grid.total // WARM_CELLS))
        cutting, scoring = _run(context, range(context.grid.total))
    whole = cutting + scoring
    yield (
        f"selection alone at {mosaic.posting_m:.0f} m, {context.grid.total} cells, window "
        f"{WINDOW_NODES} nodes, one core: {whole:.1f} s (cutting ground {cutting:.1f} s, response "
        f"and peaks {scoring:.1f} s)"
    )
    shade = hillshade.one_pass(raster, folder)
    if shade is not None:
        yield (
            f"  one hillshade pass of the same raster {shade.cpu_s:.2f} s: "
            f"{whole / shade.cpu_s:.1f} passes (wanted {PASSES:g}), response and peaks alone "
            f"{scoring / shade.cpu_s:.1f}"
        )


def _run(context: StageContext, cells: range) -> tuple[float, float]:
    """Processor seconds of cutting the ground of cells, and of all that follows."""
    cutting = scoring = 0.0
    for cell in cells:
        started = time.process_time()
        ground = render.cell_ground(context, cell)
        cut = time.process_time()
        if ground is not None:
            suns = render.suns_of(context.config.render, context.grid.centre_deg(cell)[0])
            render.shortlist(context, ground, suns)
        cutting += cut - started
        scoring += time.process_time() - cut
    return cutting, scoring
