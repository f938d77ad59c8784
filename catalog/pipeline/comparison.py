"""Comparison: how far a second terrain model of the same ground moves each control point.

Both models are cut to the same map grid about the point, rendered under the same Suns as seen from
straight above, and the catalog's picture is sought in the other one as navigation seeks it. What it
moves by is an error of one of the models, or of both: the ground has one place. Suns of several
azimuths are taken together, because ridges along the light show nothing across it. Only shadows
within the grid are cast; few come from farther.
"""

import logging
import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from catalog.arrays import Float32Array, FloatArray
from catalog.control_point import ComparisonShift, ControlPoint, Flag
from catalog.correlation.ncc import match_ncc
from catalog.errors import ConfigError, DataError
from catalog.geometry.cells import CellGrid
from catalog.geometry.latlon import latlon_from_xyz
from catalog.geometry.projection import MapProjection, Stereographic
from catalog.photometry.laws import find_law
from catalog.pipeline.context import StageContext
from catalog.rendering.map_view import render_map

log = logging.getLogger(__name__)

MARGIN_NODES = 8  # that only the high-pass sees
SEARCH_NODES = 16
PASSES = 2
# 25 deg high and from all sides, whether it occurs there or not: what a smoother model moves away
# from one Sun, by up to 30 m at nodes of 474 m, the opposite one moves back.
_LEVEL, _HIGH = math.cos(math.radians(25.0)), math.sin(math.radians(25.0))
SUNS = ((0.0, _LEVEL, _HIGH), (_LEVEL, 0.0, _HIGH), (0.0, -_LEVEL, _HIGH), (-_LEVEL, 0.0, _HIGH))
MIN_KNOWN_SHARE = 0.9  # of the nodes of either grid
MIN_FITTING = 0.5  # share of the points on common ground; with less, the model is another one's
ROUNDING = 1.01  # of postings that are the same but for the projection


def find_level(context: StageContext) -> int:
    """The finest level that the comparison model is fine enough for; -1 for none."""
    if context.comparison is None:
        return -1
    known = context.comparison.posting_m / ROUNDING
    return next((k for k, posting in enumerate(context.postings_m) if posting >= known), -1)


def check_comparison(context: StageContext, where: str, cells: Sequence[int]) -> None:
    """Refuse a comparison model that shows nothing of the ground of a build's cells.

    Raises ConfigError for one coarser than all levels, DataError for one without common ground.
    """
    model = context.comparison
    if model is None:
        return
    names = ", ".join(model.names)
    if find_level(context) < 0:
        raise ConfigError(
            f"{where}: the comparison model {names} has {model.posting_m:.6g} m between nodes, the "
            f"coarsest level {context.postings_m[-1]:.6g} m; wanted a finer model, or more "
            "[pyramid] levels"
        )
    grid: CellGrid = context.grid
    places = np.radians([grid.centre_deg(cell) for cell in cells])
    if not model.covers(places[:, 0], places[:, 1], context.postings_m[-1]).any():
        raise DataError(
            f"{where}: the comparison model {names} shows none of the {len(cells)} cells that are "
            f"built ({model.extent}, W,S,E,N); give one of the same ground, or check its crs"
        )


def add_comparison(context: StageContext, point: ControlPoint) -> ControlPoint:
    """A point with its shift in the comparison model; flagged where that is over the limit."""
    shift = measure_shift(context, point.lat_deg, point.lon_deg)
    limit = context.config.comparison.max_shift_m
    if shift is None or limit is None or not shift.distance_m > limit:
        return replace(point, comparison=shift)
    flags = point.flags | Flag.DISPLACED
    return replace(point, comparison=shift, flags=flags, usable=False)


def measure_shift(context: StageContext, lat_deg: float, lon_deg: float) -> ComparisonShift | None:
    """Where the comparison model has the ground of a place; None where it has no ground at all.

    NaN where nothing within the search looks like it.
    """
    model, level = context.comparison, find_level(context)
    if model is None:
        return None
    posting = context.postings_m[level]
    projection = context.projection(lat_deg, lon_deg)
    template = min(context.config.check.template_nodes, context.size) + 2 * MARGIN_NODES
    reference = context.mosaic.local_grid(projection, posting, template)
    total = ComparisonShift(0.0, 0.0, level, 0.0)
    # Sought again about the place that was found: a peak between two nodes is drawn to one of them.
    for _ in range(PASSES):
        about = _move_projection(projection, total)
        other = model.local_grid(about, posting, template + 2 * SEARCH_NODES)
        if min(np.isfinite(reference).mean(), np.isfinite(other).mean()) < MIN_KNOWN_SHARE:
            return None
        shift, score = _match(context, reference, other, posting, projection)
        east, north = (np.array([total.east_m, total.north_m]) + shift).tolist()
        total = ComparisonShift(east, north, level, score)
        if not np.isfinite(shift).all():
            break
    return total


def _move_projection(projection: MapProjection, shift: ComparisonShift) -> Stereographic:
    """The map projection centred on a place of another one's map."""
    centre = projection.points(np.array(shift.east_m), np.array(shift.north_m), 0.0)
    lat, lon, _ = (float(value) for value in latlon_from_xyz(centre))
    return Stereographic(lat, lon, projection.radius_m)


def _match(
    context: StageContext,
    own: Float32Array,
    other: Float32Array,
    posting_m: float,
    projection: MapProjection,
) -> tuple[FloatArray, float]:
    """East and north (2,), m, of the ground of a grid in a wider one, NaN for none; and the score.

    Weighted over the Suns by what each peak shows.
    """
    settings, scores = context.config.check, []
    weights, weighted = np.zeros((2, 2)), np.zeros(2)
    for sun in SUNS:
        shown, sought = (
            render_map(
                grid, posting_m, sun, radius_m=projection.radius_m, law=find_law("lunar_lambert")
            )
            for grid in (other, own)
        )
        match = match_ncc(sought, shown, MARGIN_NODES)
        rival = match.runner_up > settings.rival_ratio * match.score
        if match.score < settings.min_score or rival or not np.isfinite(match.covariance).all():
            continue
        weight = np.linalg.inv(match.covariance)
        weights += weight
        weighted += weight @ np.array([match.dx, -match.dy])
        scores.append(match.score)
    if not scores:
        return np.full(2, np.nan), 0.0
    shift = np.linalg.solve(weights, weighted) * posting_m
    return shift.astype(np.float64), float(np.mean(scores))


def report_fit(context: StageContext, points: Sequence[ControlPoint]) -> None:
    """Say how well a comparison model fits, and warn of one that hardly does."""
    model = context.comparison
    shifts = [point.comparison for point in points if point.comparison is not None]
    if model is None:
        return
    names = ", ".join(model.names)
    fitting = np.array([(s.east_m, s.north_m) for s in shifts if math.isfinite(s.east_m)])
    if len(fitting) < MIN_FITTING * max(len(shifts), 1):
        reach_km = SEARCH_NODES * context.postings_m[find_level(context)] / 1e3
        log.warning(
            "%s: %d of %d control points on its ground are found in it: it is shifted by more than"
            " %.3g km, or is no model of this ground; check its crs and longitude",
            *(names, len(fitting), len(shifts), reach_km),
        )
    elif len(fitting):
        east, north = np.median(fitting, axis=0)
        rms = np.sqrt(np.square(fitting - (east, north)).mean())
        log.info(
            "%s: moves %d of %d control points by %+.3g m east, %+.3g m north (median), and each "
            "by %.3g m rms an axis about that",
            *(names, len(fitting), len(points), east, north, rms),
        )
