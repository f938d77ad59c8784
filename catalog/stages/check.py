"""Check: certify the places of each cell and take the best one that passes."""

from collections.abc import Sequence
from typing import Annotated

import msgspec
import numpy as np

from catalog.control_point import SHADOW_AZIMUTHS, ControlPoint, Flag, Patch
from catalog.rendering.map_view import render_map
from catalog.rendering.sun_samples import sun_samples
from catalog.selection.shadow_limits import shadowed_share
from catalog.selection.trial import Gate, Outcome, Search
from catalog.selection.uniqueness import uniqueness_margin
from catalog.stages import render, select
from catalog.stages.context import StageContext
from catalog.stages.trials import TRIAL_LEVELS, run_trials, trial_levels
from catalog.terrain.skyline import skyline_limits_deg

Share = Annotated[float, msgspec.Meta(ge=0.0, le=1.0)]
Positive = Annotated[float, msgspec.Meta(gt=0.0)]
NotNegative = Annotated[float, msgspec.Meta(ge=0.0)]
Elevation = Annotated[float, msgspec.Meta(gt=0.0, lt=90.0)]

# Room on every side of the square that uniqueness describes, nodes of its level.
UNIQUENESS_ROOM = 8
UNIQUENESS_SUN = np.radians(25.0)
# What the level before leaves to search, nodes: rivals further away are out of reach.
FINE_SEARCH_NODES = 6.0
FATAL = Flag.NO_DATA | Flag.FLAT | Flag.NOT_UNIQUE | Flag.NOT_RECOGNISED | Flag.SHADOWED


class Settings(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """[check].

    places               of a cell that are tried at most
    max_localisation_px  predicted error above which a place is called flat
    search_km            where a rival may stand at the coarsest level
    min_margin           least uniqueness margin over all levels
    max_shadowed         share of Suns under which foreign shadows may reach the patch
    trials               recognition trials of a place
    min_recognition      share of them that must succeed
    good_recognition     share with which a place is taken without trying the cell's next one
    template_nodes       side of the square that is matched in a trial
    max_error_nodes      a match further from the truth has failed
    min_score, rival_ratio            gate of a match, as navigation has it
    sun_min_deg, sun_max_deg          Suns of the trials
    snr_min, snr_max, scale_error, roll_deg, off_nadir_deg  what the trials' pictures suffer from
    relief_slope_deg     rms slope of the random relief that the picture's ground has beyond the
                         DEM's; craters come on top
    """

    places: Annotated[int, msgspec.Meta(ge=1)] = 3
    max_localisation_px: Positive = 3.0
    search_km: Positive = 10.0
    min_margin: Share = 0.05
    max_shadowed: Share = 0.75
    trials: Annotated[int, msgspec.Meta(ge=1, le=1000)] = 5
    min_recognition: Share = 0.6
    good_recognition: Share = 0.8
    template_nodes: Annotated[int, msgspec.Meta(ge=16, le=256, multiple_of=2)] = 64
    max_error_nodes: Positive = 1.5
    min_score: Share = 0.5
    rival_ratio: Share = 0.9
    sun_min_deg: Elevation = 10.0
    sun_max_deg: Elevation = 45.0
    snr_min: Positive = 10.0
    snr_max: Positive = 50.0
    scale_error: Annotated[float, msgspec.Meta(ge=0.0, le=0.3)] = 0.1
    roll_deg: Annotated[float, msgspec.Meta(ge=0.0, le=20.0)] = 6.0
    off_nadir_deg: Annotated[float, msgspec.Meta(ge=0.0, le=60.0)] = 25.0
    relief_slope_deg: NotNegative = 3.0


class Record(msgspec.Struct, frozen=True):
    """A control point as far as it is known before it is written."""

    cell: int
    lat_deg: float
    lon_deg: float
    height_m: float
    localisation_px: float
    hessian_eigenvalue: float
    recognition_rate: float
    trials: int
    uniqueness: tuple[float, ...]
    shadow_limit_deg: tuple[float, ...]
    usable: bool
    flags: int
    source: str

    def point(self, context: StageContext) -> ControlPoint:
        """The control point of the record."""
        return ControlPoint(
            id=self.cell,
            lat_deg=self.lat_deg,
            lon_deg=self.lon_deg,
            radius_m=context.body.radius_m + self.height_m,
            localisation_px=self.localisation_px,
            hessian_eigenvalue=self.hessian_eigenvalue,
            recognition_rate=self.recognition_rate,
            trials=self.trials,
            uniqueness=self.uniqueness,
            shadow_limit_deg=self.shadow_limit_deg,
            usable=self.usable,
            flags=Flag(self.flags),
            source=self.source,
        )


def check_chunk(context: StageContext, records: Sequence[select.Record]) -> list[Record]:
    """The point of each cell with its certificate."""
    return [check_cell(context, record) for record in records]


def check_cell(context: StageContext, record: select.Record) -> Record:
    """The first place that passes well; else the one recognised most often, usable or not.

    Earlier places win ties: they have the smaller predicted error.
    """
    settings = context.config.check
    best: Record | None = None
    for number, place in enumerate(record.places[: settings.places]):
        found = _certificate(context, record, place, number)
        if found.usable and found.recognition_rate >= settings.good_recognition:
            return found
        if best is None or _merit(found) > _merit(best):
            best = found
    if best is None:
        raise ValueError(f"cell {record.cell}: no place to check")
    return best


def _merit(record: Record) -> tuple[bool, float]:
    return record.usable, record.recognition_rate


def _certificate(
    context: StageContext, record: select.Record, place: select.Place, number: int
) -> Record:
    settings = context.config.check
    lat, lon = np.radians(place.lat_deg), np.radians(place.lon_deg)
    patches = context.patches(place.lat_deg, place.lon_deg)
    fine = [np.isnan(patch.heights_m).mean() for patch in patches[: render.FINE_LEVELS]]
    flags = Flag.NONE
    if max(fine) > render.MAX_MISSING:
        flags |= Flag.NO_DATA
    if not place.localisation_px <= settings.max_localisation_px:
        flags |= Flag.FLAT
    if record.spacing < 1.0:
        flags |= Flag.CROWDED
    uniqueness = (0.0,) * context.levels
    limits = np.zeros(SHADOW_AZIMUTHS)
    successes = trials = 0
    if not flags & FATAL:  # a certificate costs: only places that may pass get one
        uniqueness = _uniqueness(context, patches, lat)
        limits = skyline_limits_deg(
            [(patch.heights_m, patch.posting_m) for patch in patches], 0, context.body.radius_m
        )
        if min(uniqueness) < settings.min_margin:
            flags |= Flag.NOT_UNIQUE
        if shadowed_share(limits, render.suns_of(context.config.render, place.lat_deg)) > (
            settings.max_shadowed
        ):
            flags |= Flag.SHADOWED
        successes, trials = _recognised(context, patches, record.cell, number, place)
        if successes < settings.min_recognition * trials - 1e-9:
            flags |= Flag.NOT_RECOGNISED
    index = int(context.mosaic.source_index(lat, lon))
    return Record(
        cell=record.cell,
        lat_deg=place.lat_deg,
        lon_deg=place.lon_deg,
        height_m=float(np.nan_to_num(context.mosaic.heights(lat, lon, context.posting_m))),
        localisation_px=place.localisation_px,
        hessian_eigenvalue=place.hessian_eigenvalue,
        recognition_rate=successes / trials if trials else 0.0,
        trials=trials,
        uniqueness=uniqueness,
        shadow_limit_deg=tuple(float(limit) for limit in limits),
        usable=not flags & FATAL and record.spacing > 0.0,
        flags=int(flags),
        source=context.mosaic.names[index] if index >= 0 else "",
    )


def _uniqueness(context: StageContext, patches: Sequence[Patch], lat: float) -> tuple[float, ...]:
    """Margins by level, worse of a morning and an afternoon Sun."""
    settings = context.config.check
    room = min(UNIQUENESS_ROOM, context.size // 4)
    suns = sun_samples(
        lat,
        1,
        2,
        max_declination=np.radians(context.config.render.sun_declination_deg),
        lowest=UNIQUENESS_SUN,
        highest=UNIQUENESS_SUN,
    )
    margins = []
    for level, patch in enumerate(patches):
        coarsest = level == len(patches) - 1
        reach = settings.search_km * 1e3 / patch.posting_m if coarsest else FINE_SEARCH_NODES
        margins.append(
            min(
                uniqueness_margin(
                    render_map(
                        patch.heights_m,
                        patch.posting_m,
                        sun,
                        radius_m=context.body.radius_m,
                        law="lommel_seeliger",
                    ),
                    context.size - 2 * room,
                    reach,
                )
                for sun in suns
            )
        )
    return tuple(margins)


def trials_at(
    context: StageContext,
    patches: Sequence[Patch],
    lat_deg: float,
    lon_deg: float,
    *,
    seed: Sequence[int],
    relief_seed: int,
    trials: int,
) -> list[Outcome]:
    """Recognition trials of a place under the circumstances that [check] sets.

    patches      of the place, finest first
    seed         of what is drawn for each trial; relief_seed of the ground beyond the DEM's
    """
    settings = context.config.check
    search = Search(template_nodes=min(settings.template_nodes, context.size))
    projection = context.projection(lat_deg, lon_deg)
    levels = trial_levels(
        context.mosaic, projection, patches, search, settings.relief_slope_deg, relief_seed
    )
    return run_trials(
        levels,
        patches[TRIAL_LEVELS:],
        context.body.radius_m,
        projection.lat,
        seed,
        trials=trials,
        search=search,
        gate=Gate(settings.min_score, settings.rival_ratio),
        sun_range=(np.radians(settings.sun_min_deg), np.radians(settings.sun_max_deg)),
        max_declination=np.radians(context.config.render.sun_declination_deg),
        snr=(settings.snr_min, settings.snr_max),
        max_scale=settings.scale_error,
        max_roll_deg=settings.roll_deg,
        max_off_nadir_deg=settings.off_nadir_deg,
    )


def _recognised(
    context: StageContext,
    patches: Sequence[Patch],
    cell: int,
    number: int,
    place: select.Place,
) -> tuple[int, int]:
    """Successful and all trials of a place; the seeds are the cell and the place's number."""
    settings = context.config.check
    outcomes = trials_at(
        context,
        patches,
        place.lat_deg,
        place.lon_deg,
        seed=[cell, number],
        relief_seed=cell,
        trials=settings.trials,
    )
    passed = sum(o.accepted and o.distance <= settings.max_error_nodes for o in outcomes)
    return passed, len(outcomes)
