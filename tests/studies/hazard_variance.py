"""Fit the bounds of a pad's mean brightness, which the variance criterion refuses pads beyond.

The source names the bounds without their values, but says in how many squares of rough ground it
found a pad. The upper bound is the one that leaves as many, on the fields that all numbers of the
hazard map are fitted on; the lower one is then the one with the least danger under both Suns.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import msgspec
import numpy as np

from catalog.arrays import Float32Array
from optnav_cli.hazard.ground_view import PictureOnGround
from optnav_cli.hazard.pads import PadBrightness, choose_pads, measure_brightness, rate_brightness
from optnav_cli.hazard.settings import HazardModel

DARKEST = (0.8, 0.85, 0.9, 0.95)  # mean of a pad over the most frequent brightness
BRIGHTEST = (0.94, 0.96, 0.98, 1.0, 1.02, 1.04, 1.06, 1.08, 1.1, 1.12, 1.14)
FOUND_SUN_DEG, FOUND = 5.0, 0.5  # the source's share of squares with a pad: half, of 38 % ground
FITTED_SUNS = (20.0, 5.0)
PAD_M, SQUARE_M = 20.0, 200.0


@dataclass(frozen=True, eq=False)
class FittedField:
    """Pads of one field under one Sun: their brightness, and the share above 7 deg by cell.

    area  the share of the field above 7 deg
    """

    kind: str
    sun_deg: float
    view: PictureOnGround
    brightness: PadBrightness
    dangerous: Float32Array
    area: float


def make_fitted_field(
    kind: str,
    sun_deg: float,
    view: PictureOnGround,
    dangerous: Float32Array,
    area: float,
    model: HazardModel,
) -> FittedField:
    """Measure the pads of a field."""
    measured = measure_brightness(view, PAD_M, model)
    return FittedField(kind, sun_deg, view, measured, dangerous, area)


def set_bounds(model: HazardModel, bounds: tuple[float, float]) -> HazardModel:
    """Set the least and largest mean."""
    given = {"darkest": bounds[0], "brightest": bounds[1]}
    numbers = msgspec.structs.replace(model.variance, **given)
    return msgspec.structs.replace(model, variance=numbers)


def judge_bounds(fields: list[FittedField], model: HazardModel) -> tuple[float, float]:
    """Judge bounds on fields.

    Returns the share above 7 deg of the chosen pads over that of their ground, the mean of all
    kinds of ground and Suns, and the share of rough squares with a pad. Infinite without any pad.
    """
    shares: dict[tuple[str, float], list[float]] = {}
    areas: dict[tuple[str, float], list[float]] = {}
    squares = found = 0
    for field in fields:
        risk = rate_brightness(field.brightness, model)
        pads = choose_pads(field.view, risk, SQUARE_M)
        cells = [pad.cell for pad in pads if pad.cell is not None]
        shares.setdefault((field.kind, field.sun_deg), []).extend(
            float(field.dangerous[round(row), round(col)]) for row, col in cells
        )
        areas.setdefault((field.kind, field.sun_deg), []).append(field.area)
        if field.kind == "rough":
            squares, found = squares + len(pads), found + len(cells)
    ratios = [
        float(np.mean(on) / np.mean(areas[kind])) if on else np.inf for kind, on in shares.items()
    ]
    return float(np.mean(ratios)), found / max(squares, 1)


def fit_bounds(fields: list[FittedField], model: HazardModel) -> HazardModel:
    """Fit the upper bound by the source's share of squares, and the lower one by the danger."""
    low = [f for f in fields if f.sun_deg == FOUND_SUN_DEG and f.kind == "rough"]

    def miss(brightest: float) -> float:
        return abs(judge_bounds(low, set_bounds(model, (DARKEST[0], brightest)))[1] - FOUND)

    brightest = min(BRIGHTEST, key=miss)
    return min(
        (set_bounds(model, (darkest, brightest)) for darkest in DARKEST),
        key=lambda tried: judge_bounds(fields, tried)[0],
    )


def list_lines(model: HazardModel) -> Iterator[str]:
    """List the fitted lines as they stand in configs/models/hazard.toml."""
    for name in ("darkest", "brightest"):
        yield f"{name} = {getattr(model.variance, name):g}"
