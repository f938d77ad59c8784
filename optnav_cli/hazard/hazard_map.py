"""One picture on the ground to its risk map and pads, by the method that is asked for."""

from dataclasses import dataclass, replace

import msgspec
import numpy as np

from catalog.arrays import Float32Array
from catalog.errors import ConfigError
from optnav_cli.hazard.fusion import PriorSlopes, combine_slopes, find_too_steep
from optnav_cli.hazard.ground_view import PictureOnGround
from optnav_cli.hazard.model import HazardModel, load_hazard_model
from optnav_cli.hazard.pads import (
    Pad,
    RiskMap,
    add_refusals,
    choose_pads,
    map_variance,
    rate_slopes,
)
from optnav_cli.hazard.settings import HazardSettings
from optnav_cli.hazard.shading import ShadedSlopes, map_slopes


@dataclass(frozen=True, eq=False)
class HazardMap:
    """Risk and pads of the ground that a picture shows.

    slopes  None by the method of variance
    """

    view: PictureOnGround
    risk: RiskMap
    pads: list[Pad]
    slopes: ShadedSlopes | None

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
    view: PictureOnGround, settings: HazardSettings, prior: PriorSlopes | None = None
) -> HazardMap:
    """Map the risk of a view and choose its pads.

    Raises NoSolutionError with the reason why there is no map, DataError for a prior that does not
    overlap it.
    """
    model = msgspec.structs.replace(
        load_hazard_model(), shadow=settings.shadow, max_shadow=settings.max_shadow
    )
    before = None if prior is None else prior.sample_view(view)
    if settings.method == "variance":
        risk, slopes = map_variance(view, settings.pad_m, model), None
    else:
        slopes = map_slopes(view, model, settings.law)
        if prior is not None and before is not None:
            slopes = combine_slopes(view, slopes, before, prior.posting_m, model)
        risk = rate_slopes(view, slopes, settings.pad_m, model)
    if before is not None:
        risk = _refuse_by_prior(risk, before, model)
    return HazardMap(view, risk, choose_pads(view, risk, settings.square_m), slopes)


def _refuse_by_prior(risk: RiskMap, prior_deg: Float32Array, model: HazardModel) -> RiskMap:
    """Refuse pads whose prior slope is too steep, and add the prior slopes of all pads."""
    means, steep = find_too_steep(prior_deg, risk.cells, model)
    rows, cols = (
        np.minimum(np.rint(risk.origin + risk.step * np.arange(size)).astype(int), limit - 1)
        for size, limit in zip(risk.score.shape, prior_deg.shape)
    )
    at_pads = np.ix_(rows, cols)
    known = add_refusals(risk, {"too steep by --slopes": steep[at_pads] > 0})
    shares = {**risk.shares, "prior_slope_deg": means[at_pads]}
    return replace(known, shares=shares)
