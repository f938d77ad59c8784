"""The fit of the sizes of errors: known ones are found again, and what it writes is their file."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner

from catalog.config import load_toml, read_toml_text, resource
from catalog.correlation.ncc import match_ncc
from catalog.errors import NothingToDoError, OutputError
from catalog.geometry.latlon import body_from_local, xyz_from_latlon
from catalog.progress import SilentProgress
from optnav_cli.control_points import error_model
from optnav_cli.control_points.error_model import (
    FILE,
    MatchedPoints,
    PointErrorSizes,
    correlate_ground,
    load_error_sizes,
)
from optnav_cli.control_points.settings import NavigateSettings
from optnav_cli.control_points.solve import MatchedFrame
from optnav_cli.estimation.models.points import Sightings
from optnav_cli.estimation.resection import errors_of_scatter
from optnav_cli.frames.folder import Observation
from optnav_cli.frames.picture import Picture
from optnav_cli.frames.truth import Truth
from tests.studies import fit
from tests.studies.__main__ import studies

ENU = body_from_local(-0.75, -0.2)
FOOT = xyz_from_latlon(-0.75, -0.2, 1_737_400.0)
HEIGHT_M, PIXEL_M, POINTS, FRAMES = 400e3, 95.0, 16, 30
# What differs from the shipped sizes: a point's own, and common to a frame.
KNOWN = {"own.warped_m": 2.0, "sunward.unexplained_m": 4.0, "common.sunward_nodes": 2.5}
LEAST_DROP = 2.0  # of the logarithm of the likelihood: seven times less likely
# Frames are added until here: by chance one of 22,000 sequences of any length gives this drop to a
# wrong size (Ville's inequality).
AMPLE_DROP = 10.0
# The sizes as they were last fitted and scored. Who fits them again writes the new ones here.
CALIBRATED = {
    "own": "level_nodes 0.005 fixed_m 1 shadow_m 0.15 height_nodes 0.015 skipped_share 0.014 "
    "warped_m 15 warped_low_sun 1.5",
    "common": "height_nodes 0.003 sunward_nodes 0.009 shift_nodes 0.006 shadow_m 0.85 shift_m 0.5 "
    "unexplained_m 5.5 stretch_m 1.1 shift_px 0.0045 stretch_px 0.005 keystone_px 0.004 "
    "scatter_shift 0.064 scatter_stretch 0.1",
    "curved": "stretch_nodes 0.1 keystone_nodes 0.07 finest_stretch_nodes 0.02 "
    "finest_keystone_nodes 0.08",
    "hidden": "own 0.12 rise 0.009 shift 0.004 stretch 0.018 keystone 0.012",
    "sunward": "bias_m 0.9 unexplained_m 15 high_sun 1.5 left 0.5",
    "albedo": "shift_nodes 0.12",
    "terrain": "shift 0.25 height 1 right 0.2 explained 0.1",
}
SIZES = {
    f"{section}.{name}": float(value)
    for section, text in CALIBRATED.items()
    for name, value in zip(text.split()[::2], text.split()[1::2], strict=True)
}


def frame(
    rng, sizes, stated_px=0.05, hidden_m=0.0, stated_terrain=False, levels=(1, 2, 4), right=None
):
    """A frame from the zenith whose points are missed as these sizes say.

    right      score of points of a model that is stated to be right
    stated_px  of the peaks;  hidden_m  posting of a shape model coarser than the patches
    stated_terrain  the terrain model's errors are stated, the picture resolves more than levels,
                    albedo was fitted
    levels  postings that are matched, of the finest
    """
    east, north = rng.uniform(-60e3, 60e3, (2, POINTS))
    places = FOOT + np.column_stack([east, north]) @ ENU[:, :2].T
    pixels = 512.0 + np.column_stack([east, -north]) / PIXEL_M
    by_ground = np.tile(np.stack([ENU[:, 0], -ENU[:, 1]]) / PIXEL_M, (POINTS, 1, 1))
    # what rises moves away from the middle
    by_ground += (pixels - 512.0)[:, :, None] / HEIGHT_M * ENU[:, 2]
    finest = np.full(POINTS, 118.45)
    elevation, azimuth = np.radians(rng.uniform(15.0, 45.0)), rng.uniform(0.0, 2.0 * np.pi)
    flat = np.cos(elevation)
    sun = ENU @ [flat * np.sin(azimuth), flat * np.cos(azimuth), np.sin(elevation)]
    points = MatchedPoints(
        points_m=places,
        pixel_per_metre=by_ground,
        scores=rng.uniform(0.4, 0.95, POINTS) if right is None else np.full(POINTS, right),
        sun_elevation_deg=np.full(POINTS, np.degrees(elevation)),
        postings_m=finest * rng.choice(levels, POINTS),
        finest_postings_m=finest,
        unresolved_posting_m=np.full(POINTS, hidden_m),
        skipped_m=np.full(POINTS, 300.0 * stated_terrain),
        sizes_m=np.full(POINTS, 9.5e3),
        terrain_sigmas_m=np.full((POINTS, 2), 20.0) if stated_terrain else None,
        terrain_errors=None if right is None else np.zeros(POINTS),
        albedo_postings_m=np.full(POINTS, 474.0) if stated_terrain else None,
    )
    stated = np.tile(stated_px**2 * np.eye(2), (POINTS, 1, 1))
    own = stated + error_model.compute_point_covariances_px2(points, sizes)
    seen = Sightings(places, pixels, own)
    scatter = errors_of_scatter(seen, 1.0, *error_model.compute_scatter_shares(points, sizes))
    common = error_model.compute_common_errors_px(points, sun, sizes)
    together = np.concatenate([scatter, common], axis=2)
    correlation = correlate_ground(places, points.sizes_m)
    alike = np.linalg.cholesky(correlation) @ rng.normal(size=(POINTS, 2))
    missed = np.einsum("nij,nj->ni", np.linalg.cholesky(own), alike)
    missed += together @ rng.normal(size=together.shape[2])
    missed += error_model.compute_bias_px(points, sun, sizes)
    measured = Sightings(places, pixels + missed, stated)
    return fit.TrueFrame("made", MatchedFrame(measured, points, correlation, sun), pixels)


@pytest.fixture(scope="session")
def known():
    """Sizes, and frames that are missed by them."""
    sizes = fit.scaled(load_error_sizes(), KNOWN)
    rng = np.random.default_rng(7)
    return sizes, [frame(rng, sizes) for _ in range(FRAMES)]


@pytest.fixture
def look(rough_world, field_of):
    """Matches a picture of rough ground from a pose that is off by so much, m."""
    pose, sun = rough_world.pose(100e3), rough_world.sun(30.0, 65.0)
    taken = Picture(rough_world.picture(pose, sun, noise_seed=4), 255.0)
    turn = pose.camera_from_body
    seen = Observation("a.png", "", 0.0, rough_world.camera, taken, turn, 0.0, sun)

    def matched(off_m, keep=slice(None)):
        inputs = SimpleNamespace(
            points=field_of(rough_world, keep), settings=NavigateSettings(), matcher=match_ncc
        )
        truth = Truth("a.png", "", 0.0, pose.position_m + off_m, turn)
        return fit.of_frame(inputs, seen, truth, "rough")

    return matched


def test_matches_from_the_true_pose_are_missed_by_little(look):
    found = look(np.zeros(3))
    missed = found.matched.sightings.pixels - found.pixels
    assert len(missed) > 5
    assert np.sqrt((missed**2).mean()) < 0.3
    assert len(fit.subset(found, np.arange(len(missed)) < 3).pixels) == 3


def test_frames_with_wrong_matches_or_few_points_are_left_out(look):
    assert look(np.array([0.0, 0.0, 0.0]), keep=slice(2)) is None
    assert look(np.array([2e3, -2e3, 0.0])) is None


@pytest.mark.calibration
def test_sizes_that_frames_were_made_with_are_found_again(known):
    sizes, frames = known
    found, wanted = fit.numbers(fit.fitted(frames, load_error_sizes())), fit.numbers(sizes)
    for name in KNOWN:
        assert 1 / 1.5 < found[name] / wanted[name] < 1.5, name


@pytest.mark.calibration
def test_half_and_twice_a_size_that_matters_are_less_likely(known):
    sizes, frames = known
    drops = fit.drops(frames, sizes)
    for name in KNOWN:
        assert min(drops[name]) > LEAST_DROP, name
    # nothing here is behind a blur
    assert drops["hidden.rise"] == (0.0, 0.0)


@pytest.mark.calibration
def test_positions_are_off_by_what_the_right_sizes_say(known):
    sizes, frames = known
    nees = np.mean([fit.position_nees(one, sizes) for one in frames])
    assert 0.6 < nees < 1.5
    assert np.mean([fit.position_nees(one, load_error_sizes()) for one in frames]) > 1.5 * nees


@pytest.mark.calibration
@pytest.mark.parametrize("name", SIZES)
def test_a_shipped_size_of_half_or_twice_the_calibrated_one_is_seen(name):
    """Frames missed by little but this error tell its size, and it is the one that ships."""
    others = dict.fromkeys(SIZES.keys() - {name}, 1e-5)
    if name in ("sunward.high_sun", "sunward.left"):  # of the bias
        del others["sunward.unexplained_m"]
    if name == "own.warped_low_sun":
        del others["own.warped_m"]
    if name in ("terrain.right", "terrain.explained"):
        del others["common.shift_m"]
        others.pop("terrain.explained", None)
    # shares of the scatter of 16 points are seen when they are ten times as large
    shipped = fit.scaled(load_error_sizes(), others | {name: 10.0 if "scatter" in name else 1.0})
    calibrated = fit.scaled(shipped, {name: SIZES[name] / fit.numbers(load_error_sizes())[name]})
    rng = np.random.default_rng(31)
    # the scatter is that of the peaks; the smallest sizes move points by 0.00002 px
    noise_px = 0.5 if "scatter" in name else 1e-7
    kinds: list[dict[str, Any]] = [{"hidden_m": 300.0}]
    if not name.startswith("hidden"):
        kinds += [{"stated_terrain": True}, {"levels": [1]}, {"right": 0.99}, {"right": 0.92}]
    factors = [fit.scaled(shipped, {name: factor}) for factor in (0.5, 1, 2)]
    found, rounds = np.zeros(3), 0
    while rounds < 40 and min(found[1] - found[[0, 2]]) < AMPLE_DROP:
        frames = [frame(rng, calibrated, noise_px, **kind) for kind in kinds]
        found += [fit.log_likelihood(frames, sizes) for sizes in factors]
        rounds += 1
    assert min(found[1] - found[[0, 2]]) > LEAST_DROP


def test_a_file_with_other_sizes_loads_and_keeps_its_comments(tmp_path):
    sizes = fit.scaled(load_error_sizes(), {"own.warped_m": 2.0, "common.shift_px": 0.5})
    text = fit.with_sizes(read_toml_text(resource(FILE)), sizes)
    (tmp_path / "sizes.toml").write_text(text, encoding="utf-8")
    found = load_toml(tmp_path / "sizes.toml", PointErrorSizes)
    assert (found.own.warped_m, found.common.shift_px) == (30.0, pytest.approx(0.0022, rel=0.05))
    assert found.common.height_nodes == load_error_sizes().common.height_nodes
    assert text.startswith(fit.BEGINNING.decode())
    lines = zip(text.splitlines(), read_toml_text(resource(FILE)).splitlines(), strict=True)
    changed = [line.split() for line, was in lines if line != was]
    assert [words[:3] for words in changed] == [
        ["warped_m", "=", "30"],
        ["shift_px", "=", "0.0022"],
    ]
    assert all(words[3] == "#" for words in changed)


def test_an_output_that_is_no_file_of_sizes_stays_and_is_refused(tmp_path):
    place = tmp_path / "mine.toml"
    place.write_text("mine\n", encoding="utf-8")
    with pytest.raises(OutputError, match=r"mine\.toml: exists and was not made by optnav"):
        fit.run(SilentProgress(), "control_points", tmp_path / "study", output=place)
    assert place.read_text(encoding="utf-8") == "mine\n"
    assert not (tmp_path / "study").exists()


def test_scenarios_without_one_to_fit_with_are_refused(tmp_path):
    with pytest.raises(NothingToDoError, match="'farside'"):
        fit.run(SilentProgress(), "control_points", tmp_path, rows="farside")


def test_another_model_is_wrong_usage(tmp_path):
    command = ["fit", "discs", "--folder", str(tmp_path / "study")]
    said = CliRunner().invoke(studies, command)
    assert said.exit_code == 2
    assert "control_points" in said.output
    assert not (tmp_path / "study").exists()
