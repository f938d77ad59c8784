"""Recognition trials of a place of the catalog: the ground that is seen, the Suns, the rate."""

from collections.abc import Iterator, Sequence
from functools import lru_cache

import numpy as np

from catalog.arrays import Float32Array
from catalog.control_point import Patch
from catalog.correlation.filters import blur_nodes
from catalog.geometry.projection import MapProjection, Stereographic
from catalog.pipeline.context import StageContext
from catalog.rendering.sun_samples import sun_samples
from catalog.selection.trial import (
    FINER,
    Gate,
    Level,
    Outcome,
    Search,
    compute_truth_size,
    draw_circumstances,
    run_trial,
)
from catalog.terrain.synthetic.relief import SyntheticRelief

TRIAL_LEVELS = 2  # the search starts one level above the finest
# Relief below the posting is drawn once for so many grounds and shared by places: the relief of
# one place says nothing of another's, and drawing it costs more than the trials.
GROUNDS = 8
SUN_AZIMUTHS = 4
MAX_RELIEF = 0.4  # of the radius: the posting below which relief is added; craters have twice it


def run_trials(
    context: StageContext,
    patches: Sequence[Patch],
    lat_deg: float,
    lon_deg: float,
    *,
    seed: Sequence[int],
    relief_seed: int,
    trials: int,
) -> Iterator[Outcome]:
    """Independent recognition trials of a place under the circumstances that [check] sets, in turn.

    There is one for each of evenly spaced Sun elevations.

    patches      of the place, finest first
    seed         of what is drawn for each trial; relief_seed of the ground beyond the DEM's
    """
    settings = context.config.check
    search = Search(template_nodes=min(settings.template_nodes, context.size))
    projection = context.projection(lat_deg, lon_deg)
    levels = _cut_levels(context, projection, patches, search, relief_seed)
    # coarser patches beyond the trial's levels throw shadows in
    outer = [*patches[TRIAL_LEVELS:], *context.make_outer_patches(projection)]
    suns = sun_samples(
        projection.lat,
        trials,
        SUN_AZIMUTHS,
        max_declination=np.radians(context.config.render.sun_declination_deg),
        lowest=np.radians(settings.sun_min_deg),
        highest=np.radians(settings.sun_max_deg),
    ).reshape(trials, SUN_AZIMUTHS, 3)
    for number in range(trials):
        circumstances = draw_circumstances(
            np.random.default_rng([*seed, number]),
            suns[number],
            levels[0].posting_m,
            max_scale=settings.scale_error,
            max_roll_deg=settings.roll_deg,
            max_off_nadir_deg=settings.off_nadir_deg,
            snr=(settings.snr_min, settings.snr_max),
        )
        yield run_trial(
            levels,
            circumstances,
            [*seed, number, 1],
            projection.radius_m,
            search,
            Gate(settings.min_score, settings.rival_ratio),
            outer=[(patch.heights_m, patch.posting_m) for patch in outer],
        )


def _cut_levels(
    context: StageContext,
    projection: MapProjection,
    patches: Sequence[Patch],
    search: Search,
    ground: int,
) -> list[Level]:
    """Cut the seen ground and the catalog's reference of a place, finest level first.

    patches  of the place, finest first; the relief that is added is below their posting, or below
             the terrain's own where they are finer than that
    ground   which relief
    """
    terrain, slope_deg = context.mosaic, context.config.check.relief_slope_deg
    # a model coarser than that shows so little that finer relief tells it from the truth as well
    coarsest = MAX_RELIEF * terrain.body.radius_m
    known = min(max(patches[0].posting_m, terrain.posting_m), coarsest)
    smallest = patches[0].posting_m / FINER
    levels = []
    for patch in patches[:TRIAL_LEVELS]:
        # the first of a search finds the way only: as recognised from a quarter of the nodes
        finer = FINER if patch is patches[0] else 1
        size, posting = compute_truth_size(search, finer), patch.posting_m / finer
        beyond = known, smallest, size, terrain.body.radius_m, slope_deg
        truth = terrain.local_grid(projection, posting, size)
        truth = truth + _draw_relief(ground % GROUNDS, posting, *beyond)
        # as navigation does, which knows the posting of shape models only
        blur = blur_nodes(patch.posting_m, terrain.posting_m) if terrain.in_planes else 0.0
        levels.append(Level(patch.heights_m, truth, patch.posting_m, blur, finer))
    return levels


@lru_cache(maxsize=64)
def _draw_relief(
    ground: int,
    posting_m: float,
    dem_posting_m: float,
    smallest_m: float,
    size: int,
    radius_m: float,
    slope_deg: float,
) -> Float32Array:
    """Relief below a DEM's posting on a map grid of `posting_m`, ready to be added."""
    detail = SyntheticRelief(
        ground, dem_posting_m, radius_m, smallest_m=smallest_m, rms_slope_deg=slope_deg
    )
    relief = detail.sample_local(Stereographic(0.0, 0.0, radius_m), posting_m, size)
    relief.setflags(write=False)
    return relief
