"""A frame over the coast: solved within its sigmas; wrong ground and cloud are refused."""

import csv
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from catalog.errors import DataError
from catalog.progress import SilentProgress
from catalog.store.reader import Catalog
from catalog.store.verify import verify
from optnav_cli.camera.camera_file import preset_camera
from optnav_cli.navigate.inputs import open_field
from tests.studies import kmss
from tests.studies.coast_ground import SEA, CoastGround

CAMERA = replace(
    preset_camera("kmss"), width_px=620, height_px=500, principal_point_px=(309.5, 249.5)
)
BUILD = "[check]\nplaces = 1\ntrials = 2\n[render]\ncandidates = 2\n"


@pytest.fixture(scope="module")
def region(tmp_path_factory):
    place = tmp_path_factory.mktemp("kmss")
    return kmss.make_region(921, place, (110e3, 110e3), SilentProgress(), 0.4, BUILD)


@pytest.fixture(scope="module")
def route(region, tmp_path_factory) -> Path:
    """One frame of another season without clouds."""
    folder = tmp_path_factory.mktemp("route") / "pictures"
    how = {"frames": 1, "season": 5, "cover": 0.0, "seed": 92105}
    kmss.write_route(region, folder, camera=CAMERA, **how)
    return folder


def test_a_frame_of_another_season_is_solved_within_its_sigmas(region, route, tmp_path):
    assert verify(region.catalog).sound
    (error,) = kmss.solve_route(region, route, tmp_path / "run")
    assert error.error_rnb_m is not None, error.solution.reason
    assert error.nees < 3.0 * 6.0
    assert np.hypot(*error.error_rnb_m[1:]) < 150.0
    with (tmp_path / "run/matches.csv").open() as file:
        used = [row for row in csv.DictReader(file) if row["used"] == "1"]
    assert len(used) >= 3


@pytest.mark.parametrize("kind", ["other ground", "cloud", "snow", "mirrored"])
def test_what_does_not_show_the_ground_of_the_catalog_is_never_solved_wrong(
    kind, region, route, tmp_path
):
    """Other ground, mirrored ground and cloud are refused; snow may be solved, but not wrong."""
    folder = tmp_path / "pictures"
    how = {"frames": 1, "season": 5, "seed": 92105, "camera": CAMERA}
    shape = region.ground.kind.shape
    shown = region
    if kind == "other ground":
        shown = replace(region, ground=CoastGround.draw(922, shape, kmss.POSTING_M / kmss.FINER))
    kmss.write_route(shown, folder, cover=1.0 if kind == "cloud" else 0.0, **how)
    picture = folder / "frame_00.png"
    counts = cv2.imread(str(picture), cv2.IMREAD_GRAYSCALE)
    if kind == "snow":  # all land alike, water as dark as before
        land = counts > np.percentile(counts, 1) + 12
        noise = np.random.default_rng(3).normal(0.0, 2.0, counts.shape)
        cv2.imwrite(str(picture), np.where(land, 200.0 + noise, counts).astype(np.uint8))
    if kind == "mirrored":
        cv2.imwrite(str(picture), counts[:, ::-1])
    (error,) = kmss.solve_route(region, folder, tmp_path / "run")
    if error.error_rnb_m is None:
        assert error.solution.reason
    else:
        assert kind == "snow"
        assert error.nees < 3.0 * 9.0


def test_a_catalog_of_an_image_beside_one_of_relief_is_refused(region):
    with Catalog.open(region.catalog) as image:
        plain = Catalog.open(region.catalog)
        plain.meta = replace(plain.meta, image=None)
        with pytest.raises(DataError, match="name catalogs of one kind"):
            open_field([image, plain], kmss.EARTH)


def test_seasons_keep_borders_and_change_fields(region):
    ground = region.ground
    first, second = ground.show(0), ground.show(5)
    land = ground.kind != SEA
    assert abs(np.corrcoef(first[land], second[land])[0, 1]) < 0.9
    assert first[~land].max() < first[land].mean()
