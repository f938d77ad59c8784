"""One picture on the ground to its risk map and pads, by the chosen method.

A prior slope map adds the tilt of the ground, which brightness hides. Shading measures the slope
along the Sun nearly exactly, that across it far worse, and neither for waves longer than the
picture. A coarser map of slopes from orbit has the mean slope of each of its pixels, though not its
direction. Over the width of such a pixel the slope across the Sun is taken from both, by their
errors, so that the slope becomes the prior's; what is finer is shading's.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path

import msgspec
import numpy as np

from catalog.arrays import Float32Array
from catalog.bodies.body import Body
from catalog.errors import ConfigError, DataError
from catalog.geometry.grid import sample_bicubic
from catalog.rasters import TERRAIN, handle_read_errors, open_raster
from catalog.terrain.dem.file import read_georeference
from catalog.terrain.dem.georeference import Georeference
from catalog.terrain.dem.label import read_map_label
from catalog.terrain.dem.source import DemSource
from catalog.terrain.dem.validity import Validity
from catalog.terrain.slopes import BASE_M, DANGEROUS_DEG, summarise_slopes
from optnav_cli.hazard.ground_view import PictureOnGround, average_boxes
from optnav_cli.hazard.pads import (
    Pad,
    RiskMap,
    add_refusals,
    add_rocks,
    choose_pads,
    map_variance,
    rate_slopes,
)
from optnav_cli.hazard.registration import sample_ground
from optnav_cli.hazard.rocks import RockSurvey, survey_rocks
from optnav_cli.hazard.settings import HazardModel, HazardSettings, load_hazard_model
from optnav_cli.hazard.shading import (
    ShadedSlopes,
    compute_width_m,
    map_slopes,
    rate_danger,
)

MAX_PIXELS = 400_000_000
MAX_SLOPE_DEG = 90.0
SMALLEST = 1e-4  # tangent: flatter ground has no direction


@dataclass(frozen=True, eq=False)
class PriorSlopes:
    """A slope map, deg, NaN for no data, and where it lies."""

    path: Path
    degrees: Float32Array
    georeference: Georeference
    posting_m: float

    def sample_view(self, view: PictureOnGround) -> Float32Array:
        """Sample the map's slopes (rows, cols), deg, at the cells of a view; NaN outside.

        Raises DataError for a view without a place on the body, or ground that the map lacks.
        """
        if view.projection is None:
            raise DataError(
                f"{self.path}: a slope map needs a place on the body; give a folder whose "
                "frames have positions, not a single picture"
            )
        rows, cols = view.brightness.shape
        x, y = np.meshgrid(view.xy_m(0.0, np.arange(cols))[0], view.xy_m(np.arange(rows), 0.0)[1])
        col, row = self.georeference.pixel_from_latlon(*view.projection.latlon(x, y))
        if self.georeference.wraps:
            col = np.mod(col, self.degrees.shape[1])
        outside = ~(np.isfinite(row) & np.isfinite(col))
        row[outside] = col[outside] = -10.0
        sampled = sample_bicubic(self.degrees, row, col)
        # Less than 5 % of the view is no overlap.
        if np.isfinite(sampled).mean() < 0.05:
            raise DataError(
                f"{self.path}: does not cover the ground that the picture shows; name a map that "
                "overlaps it"
            )
        return np.clip(sampled, 0.0, MAX_SLOPE_DEG)


def read_slopes(path: Path, body: Body) -> PriorSlopes:
    """Read a slope map as `optnav slopes` writes it: degrees in the first band.

    Raises DataError for a file that is no such map.
    """
    with open_raster(path, TERRAIN, "check --slopes") as dataset, handle_read_errors(path):
        rows, cols = dataset.shape
        if rows * cols > MAX_PIXELS:
            raise DataError(
                f"{path}: has {rows} x {cols} pixels; wanted up to {MAX_PIXELS}: cut it with "
                "gdal_translate -projwin"
            )
        remedy = "give it one with gdal_edit.py -a_srs"
        georeference = read_georeference(path, None, None, body, dataset, remedy)
        stored = dataset.read(1, masked=True)
        degrees = stored.astype(np.float32).filled(np.nan)
        validity = Validity.read(dataset, special=read_map_label(path, dataset).special)
        degrees[~validity.valid(dataset, stored.data)] = np.nan
    known = degrees[np.isfinite(degrees)]
    if not known.size:
        raise DataError(f"{path}: holds no slope; name another map")
    low, high = float(known.min()), float(known.max())
    if low < 0.0 or high > MAX_SLOPE_DEG:
        raise DataError(
            f"{path}: its values run from {low:g} to {high:g}; wanted slopes in degrees, 0..90, "
            "not in percent"
        )
    return PriorSlopes(path, degrees, georeference, georeference.row_angle * body.radius_m)


def measure_prior(path: Path, body: Body, nodata: float | None) -> PriorSlopes:
    """Measure the slopes of a terrain model, on a base of two of its postings or 3 m."""
    source = DemSource.open_alone(path, body, nodata)
    try:
        _, degrees = summarise_slopes(source, BASE_M)
        return PriorSlopes(path, degrees, source.georeference, source.posting_m)
    finally:
        source.close()


def combine_slopes(
    view: PictureOnGround,
    slopes: ShadedSlopes,
    prior_deg: Float32Array,
    posting_m: float,
    model: HazardModel,
) -> ShadedSlopes:
    """Combine slopes with the prior's means over each of its pixels; unchanged where it is NaN.

    prior_deg  (rows, cols) at the cells of the view
    """
    cells = 2 * max(1, round(0.5 * posting_m / view.cell_m)) + 1
    known = np.isfinite(prior_deg)
    prior = np.tan(np.radians(np.where(known, prior_deg, 0.0)))
    along, over = average_boxes(slopes.toward, cells), average_boxes(slopes.across, cells)
    shading_variance, prior_variance = model.tilt_sigma_deg**2, model.prior_sigma_deg**2
    weight = shading_variance / (shading_variance + prior_variance)
    # brightness tells the slope along the Sun far better than that across it
    wanted = np.sqrt(np.maximum(prior * prior - along * along, 0.0))
    change = weight * (wanted - np.abs(over))
    across = slopes.across + np.where(known, change * np.where(over < 0.0, -1.0, 1.0), 0.0)
    across = across.astype(np.float32)
    toward = slopes.toward
    return rate_danger(view, toward, across, slopes.shadow, model)


def find_too_steep(
    prior_deg: Float32Array, cells: int, model: HazardModel
) -> tuple[Float32Array, Float32Array]:
    """Find mean prior slopes (deg) of pads, NaN where unknown, and 1 where a pad is refused.

    Refused is what the prior, with its error, has above the dangerous slope.
    """
    known = np.isfinite(prior_deg).astype(np.float32)
    filled = np.where(known > 0, prior_deg, 0.0).astype(np.float32)
    cells += 1 - cells % 2
    total, share = average_boxes(filled, cells), average_boxes(known, cells)
    means = np.divide(total, share, out=np.full_like(total, math.nan), where=share > 0.5)
    limit = DANGEROUS_DEG - model.prior_sigma_deg
    steep = np.where(np.isfinite(means), means > limit, False).astype(np.float32)
    return means, steep


@dataclass(frozen=True, eq=False)
class HazardMap:
    """Risk and pads of the ground that a picture shows.

    slopes   None by the method of variance
    width_m  of the widest picture that the slopes are from
    survey   of the rocks
    """

    view: PictureOnGround
    risk: RiskMap
    pads: list[Pad]
    slopes: ShadedSlopes | None
    width_m: float = 0.0
    survey: RockSurvey = field(default_factory=RockSurvey)

    @property
    def found(self) -> int:
        """Number of squares with a pad."""
        return sum(pad.cell is not None for pad in self.pads)


def check_settings(settings: HazardSettings) -> None:
    """Raise ConfigError for a square that no pad fits into."""
    if settings.square_m < settings.pad_m:
        raise ConfigError(
            f"a square of {settings.square_m:g} m (--square-m) is under the pad of "
            f"{settings.pad_m:g} m (--pad-m); wanted room for it"
        )


def map_hazard(
    view: PictureOnGround,
    settings: HazardSettings,
    prior: PriorSlopes | None = None,
    earlier: HazardMap | None = None,
    look: Callable[[float], PictureOnGround] | None = None,
) -> HazardMap:
    """Map the risk of a view and choose its pads.

    earlier  map of an earlier frame of a descent whose slopes are combined with the view's
    look     makes the view in cells of another size, m, for rocks; None: these are not looked for

    Raises NoSolutionError with the reason why there is no map, DataError for a prior that does not
    overlap it.
    """
    model = msgspec.structs.replace(
        load_hazard_model(), shadow=settings.shadow, max_shadow=settings.max_shadow
    )
    before = None if prior is None else prior.sample_view(view)
    width_m = compute_width_m(view)
    if settings.method == "variance":
        risk, slopes = map_variance(view, settings.pad_m, model), None
    else:
        slopes = map_slopes(view, model, settings.law)
        # The prior goes into each frame once: combined slopes are nearer than it already.
        if prior is not None and before is not None:
            slopes = combine_slopes(view, slopes, before, prior.posting_m, model)
        if earlier is not None and earlier.slopes is not None:
            width_m = max(width_m, earlier.width_m)
            slopes = carry_slopes(earlier, view, slopes, width_m, model)
        risk = rate_slopes(view, slopes, settings.pad_m, model)
    if before is not None:
        risk = _refuse_by_prior(risk, before, model)
    survey = RockSurvey((), "no rocks looked for")
    if look is not None:
        survey = survey_rocks(view, look, settings, model)
    if not survey.reason:
        risk = add_rocks(risk, view, *survey.mark_cells(view))
    pads = choose_pads(view, risk, settings.square_m)
    return HazardMap(view, risk, pads, slopes, width_m, survey)


def _refuse_by_prior(risk: RiskMap, prior_deg: Float32Array, model: HazardModel) -> RiskMap:
    """Refuse pads whose prior slope is too steep, and add the prior slopes of all pads."""
    means, steep = find_too_steep(prior_deg, risk.cells, model)
    at_pads = risk.find_middles(prior_deg.shape)
    known = add_refusals(risk, {"too steep by --slopes": steep[at_pads] > 0})
    shares = {**risk.shares, "prior_slope_deg": means[at_pads]}
    return replace(known, shares=shares)


def carry_slopes(
    earlier: HazardMap,
    view: PictureOnGround,
    slopes: ShadedSlopes,
    width_m: float,
    model: HazardModel,
) -> ShadedSlopes:
    """Combine the slopes of a view with an earlier frame's, weighted by their variances.

    A wider picture tells the long waves, a nearer one the short ones. Both maps have the same Sun,
    whose azimuth differs between them by less than the angle that the craft moves over the body.
    """
    if earlier.slopes is None:
        return slopes
    rows, cols = view.brightness.shape
    x, y = np.meshgrid(view.xy_m(0.0, np.arange(cols))[0], view.xy_m(np.arange(rows), 0.0)[1])
    toward, across, sigma = (
        sample_ground(part, earlier.view.valid, earlier.view, x, y, view)
        for part in (earlier.slopes.toward, earlier.slopes.across, earlier.slopes.sigma)
    )
    known = np.isfinite(toward) & np.isfinite(across) & np.isfinite(sigma)
    ours, theirs = slopes.sigma**2, np.where(known, sigma, np.float32(1.0)) ** 2
    weight = np.where(known, ours / (ours + theirs), np.float32(0.0)).astype(np.float32)
    mixed = [
        (now + weight * (np.where(known, before, now) - now)).astype(np.float32)
        for now, before in ((slopes.toward, toward), (slopes.across, across))
    ]
    return rate_danger(view, mixed[0], mixed[1], slopes.shadow, model, width_m)
