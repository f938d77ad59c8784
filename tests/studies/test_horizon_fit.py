"""The fit of the sizes of limbs' errors: from limbs whose errors are drawn by known sizes."""

import numpy as np
import pytest

from catalog.config import read_toml_text, resource
from catalog.errors import ConfigError, NothingToDoError
from catalog.progress import SilentProgress
from optnav_cli.outline.limb.limb_rays import (
    FILE,
    HorizonSizes,
    LimbRays,
    load_horizon_sizes,
    make_limb_rays,
)
from tests.optnav_cli.outline.limb.limbs import CAMERA, attitude, grounds, limb_points, place
from tests.studies import fit, horizon_fit, likelihood
from tests.studies.horizon_fit import (
    SeenLimb,
    TrueLimb,
    fitted,
    numbers,
    of_limb,
    position_nees,
    scaled,
)

POINTS = 600


def limb(seed: int, sizes: HorizonSizes, case: str = "a", own_px: float = 0.05) -> TrueLimb:
    """A limb all around a nadir, 600 km off, under a Sun of 5-60 deg, its errors by some sizes.

    own_px  what the edge model states of each edge
    """
    rng = np.random.default_rng(seed)
    azimuths = np.sort(rng.uniform(-np.pi, np.pi, POINTS))
    angle = np.full(POINTS, 7e-4)
    out = np.stack([np.cos(azimuths), np.sin(azimuths), np.full(POINTS, -0.3)], axis=1)
    rays = LimbRays(out, angle, np.full(POINTS, own_px), 1e-4, 0.01, np.arange(POINTS))
    sine = np.sin(np.radians(rng.uniform(5.0, 60.0, POINTS)))
    one = TrueLimb(case, np.zeros(POINTS), rays, azimuths, sine, 6e5, 0.5)
    own, shared = one.errors(sizes)
    missed = np.sqrt(own) * rng.normal(size=POINTS) + shared @ rng.normal(size=shared.shape[1])
    return TrueLimb(case, missed, rays, azimuths, sine, 6e5, 0.5)


def test_sizes_that_limbs_were_drawn_by_are_found() -> None:
    true = scaled(load_horizon_sizes(), {"light.noise_px": 2.0, "light.sector_px": 2.0})
    found = numbers(fitted([limb(seed, true) for seed in range(6)], load_horizon_sizes()))
    assert found["light.noise_px"] == pytest.approx(0.1, rel=0.2)
    assert found["light.sector_px"] == pytest.approx(0.026, rel=0.5)


def test_larger_sizes_give_a_fix_of_the_same_limb_less_nees() -> None:
    position = place(2e5, 1)
    turned = attitude(position)
    rays = make_limb_rays(limb_points(position, turned), CAMERA, turned)
    up = position / np.linalg.norm(position)
    seen = of_limb("moon", SeenLimb(rays, position, up, grounds()[1]))
    wide = scaled(load_horizon_sizes(), dict.fromkeys(horizon_fit.NAMES, 4.0))
    shipped = position_nees(seen, load_horizon_sizes())
    assert 0.0 < shipped < 4.0
    assert position_nees(seen, wide) < 0.5 * shipped


def test_the_report_scores_the_limbs_that_were_held_back() -> None:
    sizes = load_horizon_sizes()
    result = horizon_fit.HorizonFitResult(
        sizes, sizes, [limb(1, sizes)], [limb(2, sizes, "real"), limb(3, sizes, "real")]
    )
    tables = fit.report(result).tables
    assert tables[0].column("size") == list(horizon_fit.NAMES)
    assert tables[1].column("scenario") == ["a", "real"]
    assert tables[1].column("frames") == [1, 2]


def test_new_sizes_are_written_among_the_old_text() -> None:
    old = numbers(load_horizon_sizes())
    text = likelihood.with_numbers(
        read_toml_text(resource(FILE)), old, old | {"crest.noise_m": 54.0}
    )
    changed = [
        (before, after)
        for before, after in zip(read_toml_text(resource(FILE)).splitlines(), text.splitlines())
        if before != after
    ]
    assert len(changed) == 1
    assert changed[0][1].startswith("noise_m = 54 ")
    assert changed[0][1].endswith(changed[0][0].partition("#")[2])


def test_rough_ground_that_limbs_were_drawn_by_is_found() -> None:
    """Twice the shipped size: edges of 0.12 to 0.4 px, neighbours wrong alike."""
    true = scaled(load_horizon_sizes(), {"light.rough_share": 2.0})
    limbs = [limb(seed, true, own_px=0.12 + 0.04 * seed) for seed in range(8)]
    names = horizon_fit.ROUGH_NAMES
    found = numbers(fitted(limbs, load_horizon_sizes(), names), names)
    assert list(found) == names
    wanted = numbers(true, names)
    assert found["light.rough_share"] == pytest.approx(wanted["light.rough_share"], rel=0.25)
    assert found["light.rough_px"] == pytest.approx(wanted["light.rough_px"], rel=0.4)


def test_nothing_is_made_without_the_ground_or_for_rows_of_another_name(
    tmp_path, monkeypatch
) -> None:
    monkeypatch.delenv("OPTNAV_SHARED_DATA", raising=False)
    with pytest.raises(ConfigError, match="OPTNAV_SHARED_DATA"):
        fit.run(SilentProgress(), "horizon", tmp_path / "out")
    assert not (tmp_path / "out").exists()
    monkeypatch.setenv("OPTNAV_SHARED_DATA", str(tmp_path))
    (tmp_path / "moon").mkdir()
    (tmp_path / "moon" / "moon_gld100_32ppd.tif").touch()
    with pytest.raises(NothingToDoError, match="'none'"):
        fit.run(SilentProgress(), "horizon", tmp_path / "out", rows="none")
