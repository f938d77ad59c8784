"""Recognition trials of a place of the catalog: the ground that is seen, the Suns, the rate."""

from collections.abc import Iterator, Sequence
from functools import lru_cache

import numpy as np

from catalog.arrays import Float32Array
from catalog.control_point import Patch
from catalog.correlation.ncc import blur_nodes
from catalog.geometry.projection import MapProjection, Stereographic
from catalog.rendering.sun_samples import sun_samples
from catalog.selection.trial import (
    Gate,
    Level,
    Outcome,
    Search,
    draw_circumstances,
    run_trial,
    truth_size,
)
from catalog.selection.trial_picture import FINER
from catalog.terrain.synthetic.relief import SyntheticRelief
from catalog.terrain.terrain import Terrain

TRIAL_LEVELS = 2  # the search starts one level above the finest
# Relief below the posting is drawn once for so many grounds and shared by places: the relief of
# one place says nothing of another's, and drawing it costs more than the trials.
GROUNDS = 8
SUN_AZIMUTHS = 4


@lru_cache(maxsize=64)
def _relief(
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
    relief = detail.local(Stereographic(0.0, 0.0, radius_m), posting_m, size)
    relief.setflags(write=False)
    return relief


def trial_levels(
    mosaic: Terrain,
    projection: MapProjection,
    patches: Sequence[Patch],
    search: Search,
    slope_deg: float,
    ground: int,
) -> list[Level]:
    """What is seen and what is known of a place, finest first.

    patches    of the place, finest first; the relief that is added is below their posting, or
               below the terrain's own where they are finer than that
    slope_deg  rms slope of the random part of that relief
    ground     which relief
    """
    size = truth_size(search)
    known = max(patches[0].posting_m, mosaic.posting_m)
    smallest = patches[0].posting_m / FINER
    levels = []
    for patch in patches[:TRIAL_LEVELS]:
        posting = patch.posting_m / FINER
        truth = mosaic.local_grid(projection, posting, size)
        truth = truth + _relief(
            ground % GROUNDS, posting, known, smallest, size, mosaic.body.radius_m, slope_deg
        )
        # as navigation does: a catalog states the posting of shape models only
        blur = blur_nodes(patch.posting_m, mosaic.posting_m) if mosaic.in_planes else 0.0
        levels.append(Level(patch.heights_m, truth, patch.posting_m, blur))
    return levels


def run_trials(
    levels: Sequence[Level],
    outer: Sequence[Patch],
    radius_m: float,
    lat: float,
    seed: Sequence[int],
    *,
    trials: int,
    search: Search,
    gate: Gate,
    sun_range: tuple[float, float],
    max_declination: float,
    snr: tuple[float, float],
    max_scale: float,
    max_roll_deg: float,
    max_off_nadir_deg: float,
) -> Iterator[Outcome]:
    """Outcomes of independent trials, one for each of evenly spaced Sun elevations, in turn.

    outer      coarser patches beyond the trial's levels, which throw shadows in
    lat        rad; with max_declination (rad) it says which Suns can occur
    sun_range  lowest and highest elevation, rad
    """
    suns = sun_samples(
        lat,
        trials,
        SUN_AZIMUTHS,
        max_declination=max_declination,
        lowest=sun_range[0],
        highest=sun_range[1],
    ).reshape(trials, SUN_AZIMUTHS, 3)
    for number in range(trials):
        rng = np.random.default_rng([*seed, number])
        circumstances = draw_circumstances(
            rng,
            suns[number],
            levels[0].posting_m,
            max_scale=max_scale,
            max_roll_deg=max_roll_deg,
            max_off_nadir_deg=max_off_nadir_deg,
            snr=snr,
        )
        yield run_trial(
            levels,
            circumstances,
            [*seed, number, 1],
            radius_m,
            search,
            gate,
            outer=[(patch.heights_m, patch.posting_m) for patch in outer],
        )
