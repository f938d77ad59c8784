"""The fitted numbers of positions from the horizon; FILE says what each is."""

from functools import cache

import msgspec

from catalog.config import Positive, load_toml, resource

FILE = "configs/models/horizon.toml"


class LightSizes(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """[light]: of edges."""

    noise_px: Positive
    sector_px: Positive
    sector_low_px: Positive
    sector_fall_deg: Positive
    rough_share: Positive
    rough_px: Positive


class CrestSizes(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """[crest]: of the skyline of a relief on a sphere."""

    top_share: Positive
    top_share_more: Positive
    posting_m: Positive
    noise_m: Positive
    sigma_m: Positive
    model_sector: Positive
    lift: Positive
    lift_sigma: Positive


class ShapeSizes(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """[shape]: of the silhouette of a shape, in its cells."""

    lift: Positive
    lift_sigma: Positive
    crest_noise: Positive
    sector_noise: Positive


class EllipsoidSizes(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """[ellipsoid]: of what relief does to the limb of a bare one."""

    mean_km: Positive
    heights_km: Positive
    angle_deg: tuple[float, ...]
    covariance_km2: tuple[float, ...]


class HorizonSizes(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """All numbers of FILE."""

    light: LightSizes
    crest: CrestSizes
    shape: ShapeSizes
    ellipsoid: EllipsoidSizes


@cache
def load_horizon_sizes() -> HorizonSizes:
    """The sizes that ship with optnav. Raises ConfigError for a wrong file."""
    return load_toml(resource(FILE), HorizonSizes)
