"""Check: certify the places of each cell by trials, and take the best one that passes."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import cached_property, lru_cache

import numpy as np
from numpy.typing import ArrayLike

from catalog.arrays import Float32Array, FloatArray
from catalog.control_point import SHADOW_AZIMUTHS, ControlPoint, Flag, Patch
from catalog.correlation.filters import blur_nodes
from catalog.correlation.surf64 import MIN_SIDE
from catalog.geometry.projection import MapProjection, Stereographic
from catalog.photometry.laws import find_law
from catalog.pipeline import cell_map, render
from catalog.pipeline.comparison import add_comparison
from catalog.pipeline.context import StageContext
from catalog.pipeline.render import SelectedCell
from catalog.rasters import keep_gdal_settings
from catalog.rendering.map_view import render_map
from catalog.rendering.sun_samples import sun_samples
from catalog.selection.localisation import compute_uniqueness_margin
from catalog.selection.trial import (
    FINER,
    Gate,
    Level,
    Search,
    TrialOutcome,
    compute_truth_size,
    draw_circumstances,
    run_trial,
)
from catalog.store.patches import PreparedPoint, prepare_point
from catalog.terrain.skyline.local import compute_skyline_limits_deg
from catalog.terrain.synthetic.relief import SyntheticRelief

TRIAL_LEVELS = 2  # the search starts one level above the finest
# Relief below the posting is drawn once for so many grounds and shared by places: the relief of
# one place says nothing of another's, and drawing it costs more than the trials.
GROUNDS = 8
SUN_AZIMUTHS = 4
IMAGE_SCORE = 0.3
MAX_RELIEF = 0.4  # of the radius: the posting below which relief is added; craters have twice it
# Room on every side of the square that uniqueness describes, nodes of its level.
UNIQUENESS_ROOM = 8
UNIQUENESS_SUN = np.radians(25.0)
# What the level before leaves to search, nodes: rivals further away are out of reach.
FINE_SEARCH_NODES = 6.0
NOT_TRIED = Flag.NO_DATA | Flag.FLAT  # there is nothing to look at, or nothing to be seen
FATAL = NOT_TRIED | Flag.NOT_UNIQUE | Flag.NOT_RECOGNISED | Flag.SHADOWED


def run_trials(
    context: StageContext,
    patches: Sequence[Patch],
    lat_deg: float,
    lon_deg: float,
    *,
    seed: Sequence[int],
    relief_seed: int,
    trials: int,
) -> Iterator[TrialOutcome]:
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
    law = None if context.image else find_law("hapke", context.body.photometry.surface)
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
            # images of other seasons agree less than renders do: as navigation accepts them
            Gate(IMAGE_SCORE if context.image else settings.min_score, settings.rival_ratio),
            outer=[(patch.heights_m, patch.posting_m) for patch in outer],
            law=law,
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
        if context.image is not None and patch.brightness is not None:
            shown = context.image.local_grid(projection, posting, size)
            levels.append(Level(patch.brightness, shown, patch.posting_m, 0.0, finer))
            continue
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


class Certificate:
    """Findings about a candidate place; its trials run until their verdict is decided.

    successes, trials  of the recognition trials that were run
    uniqueness         margins by level, finest first
    shadow_limits_deg  (36,) by azimuth
    """

    def __init__(
        self, context: StageContext, record: SelectedCell, place: render.Place, number: int
    ) -> None:
        """Examine a place without trials; number: which of the cell's places, seeds its trials."""
        self.cell, self.place, self.spacing = record.cell, place, record.spacing
        self.settings = context.config.check
        self.successes = self.trials = 0
        self.uniqueness = (0.0,) * context.levels
        self.shadow_limits_deg = np.zeros(SHADOW_AZIMUTHS)
        self._context = context
        # elsewhere what overhangs has no height, so that much of it counts as holes
        self._fatal = FATAL | Flag.OVERHANG if context.mosaic.own_planes else FATAL
        self._projection = context.projection(place.lat_deg, place.lon_deg)
        self._seed = [record.cell, number]
        self._known = self._derive_flags()

    @cached_property
    def patches(self) -> tuple[Patch, ...]:
        """Patches of the place, finest first; cut only for places that are examined."""
        return self._context.patches(self.place.lat_deg, self.place.lon_deg)

    @cached_property
    def _beyond(self) -> tuple[Patch, ...]:
        """Ground beyond the coarsest patch that throws shadows in."""
        return self._context.make_outer_patches(self._projection)

    @cached_property
    def _outcomes(self) -> Iterator[TrialOutcome]:
        """Outcomes of the trials that are still to be run."""
        return run_trials(
            self._context,
            self.patches,
            self.place.lat_deg,
            self.place.lon_deg,
            seed=self._seed,
            relief_seed=self.cell,
            trials=self.settings.trials,
        )

    def _derive_flags(self) -> Flag:
        """Derive the flags known from the patches alone; sets the shadow limits."""
        settings, candidate, context = self.settings, self.place, self._context
        flags = Flag.NONE
        # of a whole raster no patch has a hole; a mesh may overhang
        if not (context.texture.covers_body and context.texture.has_graticules):
            fine = self.patches[: cell_map.FINE_LEVELS]
            if max(map(_measure_holes, fine)) > cell_map.MAX_MISSING:
                flags |= Flag.NO_DATA
        if not candidate.localisation_nodes <= settings.max_localisation_nodes:
            flags |= Flag.FLAT
        if self.spacing < 1.0:
            flags |= Flag.CROWDED
        if context.mosaic.overhangs(self._projection, context.posting_m, context.size):
            flags |= Flag.OVERHANG
        if flags & self._fatal:
            return flags
        self.shadow_limits_deg = compute_skyline_limits_deg(
            [(patch.heights_m, patch.posting_m) for patch in (*self.patches, *self._beyond)],
            0,
            self._projection.radius_m,
        )
        suns = cell_map.sample_suns(
            context.config.render, context.sun_latitude_deg(candidate.lat_deg, candidate.lon_deg)
        )
        shadowed = measure_shadowed_share(self.shadow_limits_deg, suns)
        if context.image is None and shadowed > settings.max_shadowed:
            flags |= Flag.SHADOWED
        return flags

    @property
    def flags(self) -> Flag:
        """Reasons so far."""
        failed = self.trials > 0 and self.successes < self._least
        return self._known | Flag.NOT_RECOGNISED if failed else self._known

    @property
    def usable(self) -> bool:
        """Whether the place passes, as far as it has been tried."""
        return not self.flags & self._fatal and self.spacing > 0.0

    @property
    def recognition_rate(self) -> float:
        """Share of the trials so far that succeeded, 0 without trials."""
        return self.successes / self.trials if self.trials else 0.0

    @property
    def merit(self) -> tuple[bool, int]:
        """Sort key by which the places of a cell are compared."""
        return self.usable, self.successes

    @property
    def passes_well(self) -> bool:
        """Whether no other place of the cell need be looked at."""
        return self.usable and self.successes >= self._enough

    @property
    def _least(self) -> float:
        """Successes that the place must have."""
        return self.settings.min_recognition * self.settings.trials - 1e-9

    @property
    def _enough(self) -> float:
        """Successes that more would add nothing to."""
        return max(self._least, self.settings.good_recognition * self.settings.trials - 1e-9, 1.0)

    def try_for(self, successes: int) -> None:
        """Run trials until they are enough, or so many successes or a pass are out of reach.

        A place that is out already meets none. Of one that passes, rivals are looked for: they are
        rarer than failures, so that trials come first.
        """
        if not self.flags & self._fatal:
            self._run(max(self._least, successes))
        if not self.flags & self._fatal:
            self._look_for_rivals()

    def finish(self) -> None:
        """Find out what is missing, also of a place that is out, if there is ground to see."""
        if not self._known & NOT_TRIED:
            self._run(self._least)
            self._look_for_rivals()

    def _look_for_rivals(self) -> None:
        self.uniqueness = _measure_uniqueness(self._context, self._projection, self.patches)
        if min(self.uniqueness) < self.settings.min_margin:
            self._known |= Flag.NOT_UNIQUE

    def _run(self, wanted: float) -> None:
        settings = self.settings
        while self.trials < settings.trials and self.successes < self._enough:
            if self.successes + settings.trials - self.trials < wanted:
                return
            outcome = next(self._outcomes)
            self.trials += 1
            self.successes += outcome.accepted and outcome.distance <= settings.max_error_nodes


def _measure_holes(patch: Patch) -> float:
    """Measure the share of a patch's nodes without ground or, where it has one, image."""
    holes = np.isnan(patch.heights_m)
    return float((holes if patch.brightness is None else holes | np.isnan(patch.brightness)).mean())


def check_chunk(context: StageContext, records: Sequence[SelectedCell]) -> list[ControlPoint]:
    """The point of each cell with its certificate, and its place in a comparison model."""
    with keep_gdal_settings():
        return [_make_point(context, check_cell(context, record)) for record in records]


def check_and_prepare_chunk(
    context: StageContext, records: Sequence[SelectedCell]
) -> tuple[list[ControlPoint], list[PreparedPoint]]:
    """Check cells as `check_chunk` does, and prepare their points for the file, sorted by id."""
    steps = context.config.write.steps_m(context.postings_m)
    points, prepared = [], []
    with keep_gdal_settings():
        for record in records:
            certificate = check_cell(context, record)
            points.append(_make_point(context, certificate))
            if math.isfinite(points[-1].radius_m):
                prepared.append(prepare_point(points[-1], certificate.patches, steps))
    return points, sorted(prepared, key=lambda one: one.point.id)


def check_cell(context: StageContext, record: SelectedCell) -> Certificate:
    """The first place that passes well; else the one recognised most often, usable or not.

    Earlier places win ties: they have the smaller predicted error. A place meets no more trials
    than it takes to see that it passes well, that it is out, or no better than one before it.
    """
    best: Certificate | None = None
    for number, candidate in enumerate(record.places[: context.config.check.places]):
        certificate = Certificate(context, record, candidate, number)
        certificate.try_for(best.successes + 1 if best is not None and best.usable else 0)
        if certificate.passes_well:
            return certificate
        if best is None or certificate.merit > best.merit:
            best = certificate
    if best is None:
        raise ValueError(f"cell {record.cell}: no place to check")
    if not best.usable:
        best.finish()
    return best


def measure_shadowed_share(limits_deg: ArrayLike, suns_local: FloatArray) -> float:
    """Share of the Suns whose elevation is below the skyline limit of their azimuth.

    limits_deg  (k,)    limit by azimuth, bins centred on 0, 360/k, ... degrees east of north
    suns_local  (n, 3)  unit vectors east, north, up
    """
    limits = np.asarray(limits_deg, dtype=np.float64)
    suns = np.asarray(suns_local, dtype=np.float64).reshape(-1, 3)
    azimuth = np.degrees(np.arctan2(suns[:, 0], suns[:, 1]))
    bins = np.rint(azimuth / (360.0 / limits.size)).astype(np.int64) % limits.size
    elevation = np.degrees(np.arcsin(np.clip(suns[:, 2], -1.0, 1.0)))
    return float((elevation < limits[bins]).mean())


def compute_described_side(size: int) -> int:
    """Side of the square that uniqueness describes in a patch of an even number of nodes a side."""
    return size - 2 * min(UNIQUENESS_ROOM, size // 4, (size - MIN_SIDE) // 2)


def _measure_uniqueness(
    context: StageContext, projection: MapProjection, patches: Sequence[Patch]
) -> tuple[float, ...]:
    """Margins by level, worse of a morning and an afternoon Sun."""
    settings = context.config.check
    suns = sun_samples(
        projection.lat,
        1,
        2,
        max_declination=np.radians(context.config.render.sun_declination_deg),
        lowest=UNIQUENESS_SUN,
        highest=UNIQUENESS_SUN,
    )
    side = compute_described_side(context.size)
    margins = []
    for patch in patches:
        coarsest = patch is patches[-1]
        reach = settings.search_km * 1e3 / patch.posting_m if coarsest else FINE_SEARCH_NODES
        ground, law = (patch.heights_m, patch.posting_m), find_law("lommel_seeliger")
        pictures = (
            [patch.brightness]
            if patch.brightness is not None
            else [render_map(*ground, sun, radius_m=projection.radius_m, law=law) for sun in suns]
        )
        margins.append(min(compute_uniqueness_margin(picture, side, reach) for picture in pictures))
    return tuple(margins)


def _make_point(context: StageContext, certificate: Certificate) -> ControlPoint:
    """With its certificate, and its place in a comparison model."""
    candidate, terrain = certificate.place, context.mosaic
    lat, lon = math.radians(candidate.lat_deg), math.radians(candidate.lon_deg)
    height_m = float(np.nan_to_num(terrain.heights(lat, lon, context.posting_m)))
    projection = context.projection(candidate.lat_deg, candidate.lon_deg)
    point = ControlPoint(
        id=certificate.cell,
        lat_deg=candidate.lat_deg,
        lon_deg=candidate.lon_deg,
        radius_m=context.body.radius_m + height_m,
        localisation_nodes=candidate.localisation_nodes,
        hessian_eigenvalue=candidate.hessian_eigenvalue,
        recognition_rate=certificate.recognition_rate,
        trials=certificate.trials,
        uniqueness=certificate.uniqueness,
        shadow_limit_deg=tuple(certificate.shadow_limits_deg.tolist()),
        usable=certificate.usable,
        flags=certificate.flags,
        source=terrain.provenance(projection, context.posting_m, context.size),
    )
    if terrain.own_planes:
        vertical = math.degrees(projection.lat), math.degrees(projection.lon)
        point = replace(point, vertical_deg=vertical)
    return add_comparison(context, point)
