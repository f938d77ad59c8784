"""Slopes from brightness: a plane, a cone, a step with its shadow, ground turned by 90 deg."""

import numpy as np
import pytest

from catalog.errors import NoSolutionError
from catalog.photometry.laws import find_law
from catalog.terrain.slopes import compute_slope_components, convert_to_degrees
from optnav_cli.hazard.pads import rate_slopes
from optnav_cli.hazard.settings import load_hazard_model
from optnav_cli.hazard.shading import map_slopes
from tests.optnav_cli.hazard.views import bumps, drawn, view_of

MODEL = load_hazard_model()
INNER = np.s_[20:-20, 20:-20]


def test_a_plane_is_level_whatever_its_tilt() -> None:
    """Brightness alone does not tell the tilt of all that a picture shows."""
    slopes = map_slopes(view_of(np.full((80, 100), 7.5, np.float32)), MODEL)
    assert np.abs(slopes.toward).max() < 2e-3
    assert np.abs(slopes.across).max() < 2e-3
    assert slopes.dangerous.max() < 0.1
    assert not slopes.shadow.any()


@pytest.mark.parametrize(("elevation_deg", "height_m"), [(8.0, 0.4), (20.0, 1.5), (40.0, 1.5)])
def test_brightness_of_hills_gives_both_components_of_their_slopes(
    elevation_deg: float, height_m: float
) -> None:
    heights = bumps(height_m=height_m)
    slopes = map_slopes(drawn(heights, elevation_deg, 90.0), MODEL)
    east, north = compute_slope_components(heights, 1.0, 1.0, 3.0)
    for found, true, least in ((slopes.toward, east, 0.97), (slopes.across, north, 0.85)):
        assert np.corrcoef(found[INNER].ravel(), true[INNER].ravel())[0, 1] > least
    scale = np.sum(slopes.toward[INNER] * east[INNER]) / np.sum(east[INNER] ** 2)
    assert scale == pytest.approx(1.0, abs=0.12)


def test_a_cone_slopes_alike_on_all_its_sides() -> None:
    y, x = np.mgrid[-80:80, -80:80] + 0.5
    reach = np.hypot(x, y)
    heights = np.maximum(6.0 - 0.15 * reach, 0.0).astype(np.float32)  # 8.5 deg, 40 m wide
    slopes = map_slopes(drawn(heights, 20.0, 60.0), MODEL)
    degrees = convert_to_degrees(np.stack([slopes.toward, slopes.across]))
    side = (reach > 10.0) & (reach < 32.0)
    around = [
        float(np.median(degrees[side & (np.abs(np.arctan2(y, x) - a) < 0.4)]))
        for a in np.radians([-120.0, -60.0, 0.0, 60.0, 120.0])
    ]
    assert np.median(around) == pytest.approx(8.5, abs=1.5)
    assert min(around) > 5.0
    assert np.median(degrees[reach > 60.0]) < 2.5


def test_the_shadow_of_a_step_makes_the_right_drop() -> None:
    """West of a step of 3 m under a Sun of 10 deg in the east lie 17 m of shadow."""
    heights = np.zeros((160, 160), np.float32)
    heights[:, 80:120] = 3.0
    heights[:, 120:] = np.linspace(3.0, 0.0, 40, dtype=np.float32)
    slopes = map_slopes(drawn(heights, 10.0, 90.0), MODEL)
    row = slopes.shadow[80]
    assert row[60:66].sum() + row[66:79].sum() == pytest.approx(17.0, abs=3.5)
    rise = float(slopes.toward[80, 55:90].sum())  # metres, toward the Sun
    assert rise == pytest.approx(3.0, abs=0.6)
    assert slopes.dangerous[80, 64:78].mean() > 0.5


@pytest.mark.parametrize("azimuth_deg", [0.0, 37.0, 130.0])
def test_the_risk_map_of_a_turned_picture_is_the_turned_map(azimuth_deg: float) -> None:
    heights = bumps(144)
    view = drawn(heights, 15.0, azimuth_deg)
    turned = view_of(np.ascontiguousarray(np.rot90(view.brightness)), 15.0, azimuth_deg - 90.0)
    risks = [rate_slopes(v, map_slopes(v, MODEL), 12.0, MODEL) for v in (view, turned)]
    codes = [risk.code.astype(int) for risk in risks]
    assert np.abs(np.rot90(codes[0]) - codes[1]).max() <= 1


def test_ground_that_the_picture_does_not_show_disturbs_nothing() -> None:
    """A picture that is turned against the map fills a diamond of it."""
    heights = bumps()
    whole = drawn(heights, 20.0, 45.0)
    y, x = np.mgrid[-80:80, -80:80] + 0.5
    shown = np.abs(x) + np.abs(y) < 78.0
    dark = np.where(shown, whole.brightness, np.float32(0.0))
    cut = map_slopes(view_of(dark, 20.0, 45.0, valid=shown), MODEL)
    true = compute_slope_components(heights, 1.0, 1.0, 3.0)
    inside = np.abs(x) + np.abs(y) < 60.0
    along = (true[0] + true[1]) * np.sqrt(0.5)
    aside = (true[1] - true[0]) * np.sqrt(0.5)
    assert np.corrcoef(cut.toward[inside], along[inside])[0, 1] > 0.95
    assert np.corrcoef(cut.across[inside], aside[inside])[0, 1] > 0.8


def test_an_oblique_view_is_brought_to_the_slopes_of_the_ground() -> None:
    """A camera 25 deg off the vertical, across the Sun, over hills."""
    heights = bumps()
    elevation, sun_azimuth = 20.0, 90.0
    e = np.radians(elevation)
    sun = np.array([np.cos(e), 0.0, np.sin(e)])
    slant = np.radians(25.0)
    to_camera = np.array([0.0, np.sin(slant), np.cos(slant)])
    east, north = compute_slope_components(heights, 1.0, 1.0, 2.0)
    normal = np.stack([-east, -north, np.ones_like(east)])
    normal /= np.linalg.norm(normal, axis=0)
    light = find_law("hapke")(
        np.tensordot(sun, normal, 1), np.tensordot(to_camera, normal, 1), float(sun @ to_camera)
    )
    light = np.nan_to_num(light, nan=float(np.nanmedian(light))).astype(np.float32)
    camera = tuple((1e6 * to_camera).tolist())
    view = view_of(light, elevation, sun_azimuth, camera=camera)  # type: ignore[arg-type]
    slopes = map_slopes(view, MODEL)
    assert np.corrcoef(slopes.toward[INNER].ravel(), east[INNER].ravel())[0, 1] > 0.97
    assert np.corrcoef(slopes.across[INNER].ravel(), north[INNER].ravel())[0, 1] > 0.85


def test_a_picture_without_light_is_refused() -> None:
    with pytest.raises(NoSolutionError, match="no light"):
        map_slopes(view_of(np.zeros((60, 60), np.float32)), MODEL)


def test_a_view_of_nothing_is_refused() -> None:
    nothing = np.zeros((60, 60), bool)
    with pytest.raises(NoSolutionError, match="no ground"):
        map_slopes(view_of(np.ones((60, 60), np.float32), valid=nothing), MODEL)
