"""Settings of a build at the ends of what is lawful: it builds, or one line says why not."""

import numpy as np
import pytest

from catalog.correlation.surf64 import compute_self_similarity_surface
from catalog.errors import ConfigError, DataError, NothingToDoError
from catalog.pipeline.build import run
from catalog.pipeline.check import compute_described_side
from catalog.pipeline.config import SIZES
from catalog.selection.localisation import compute_uniqueness_margin

CONFIG = '[body]\nname = "moon"\n[[dem]]\npath = "dem.tif"\n'
SMALLEST = "[pyramid]\nsize = 32\nlevels = 1\n"
QUICK = "[check]\ntrials = 2\nplaces = 1\n"
CORNERS = {
    "smallest patches": SMALLEST + QUICK,
    "smallest patches, windows and templates": SMALLEST
    + "[render]\nwindow_nodes = 16\n"
    + QUICK
    + "template_nodes = 16\n",
    "templates wider than patches": SMALLEST + QUICK + "template_nodes = 256\n",
    "windows wider than patches": SMALLEST + "[render]\nwindow_nodes = 256\n" + QUICK,
    "widest patches": "[pyramid]\nsize = 256\nlevels = 1\n" + QUICK,
    "more levels rendered than there are": SMALLEST + "[render]\nlevels = 10\n" + QUICK,
    "an odd window": SMALLEST + "[render]\nwindow_nodes = 17\n" + QUICK,
    "one candidate": SMALLEST
    + "[render]\ncandidates = 1\nseparation_cell = 1.0\ninset_cell = 0.499\n"
    + QUICK,
    "many candidates": SMALLEST
    + "[render]\ncandidates = 64\nseparation_cell = 1e-6\ninset_cell = 0.0\n"
    + QUICK,
    "grazing Suns": SMALLEST
    + "[render]\nsun_elevations = 1\nsun_min_deg = 0.01\nsun_max_deg = 0.01\n"
    + QUICK
    + "sun_min_deg = 0.01\nsun_max_deg = 0.01\n",
    "Suns overhead": SMALLEST
    + "[render]\nsun_min_deg = 89.99\nsun_max_deg = 89.99\n"
    + QUICK
    + "sun_min_deg = 89.99\nsun_max_deg = 89.99\n",
    "noise": SMALLEST + "[render]\nsnr = 1e-3\n" + QUICK + "snr_min = 1e-3\nsnr_max = 1e-3\n",
    "no noise": SMALLEST + "[render]\nsnr = 1e6\n" + QUICK + "snr_min = 1e6\nsnr_max = 1e6\n",
    "anything passes": SMALLEST
    + "[select]\npercentile = 0.0\nspacing_cell = 0.0\n"
    + QUICK
    + "min_margin = 0.0\nmax_shadowed = 1.0\nmin_recognition = 0.0\ngood_recognition = 0.0\n",
    "nothing passes": SMALLEST
    + "[select]\npercentile = 100.0\nspacing_cell = 1.0\n"
    + QUICK
    + "min_margin = 1.0\nmax_shadowed = 0.0\nmin_recognition = 1.0\ngood_recognition = 1.0\n",
    "a near search": SMALLEST + QUICK + "search_km = 1e-3\n",
    "a far search": SMALLEST + QUICK + "search_km = 1e3\n",
    "worst pictures": SMALLEST + QUICK + "scale_error = 0.3\nroll_deg = 20\noff_nadir_deg = 60\n",
    "coarse heights": SMALLEST + QUICK + "[write]\nheight_step_m = 1000.0\n",
    "huge cells": SMALLEST + QUICK + "[grid]\ncell_deg = 20.0\n",
    "levels wider than the body": "[pyramid]\nsize = 32\nlevels = 10\n" + QUICK,
}


@pytest.mark.parametrize("size", range(SIZES[0], SIZES[1] + 1, 2))
def test_a_square_can_be_described_in_patches_of_every_size(size):
    side = compute_described_side(size)
    brightness = np.random.default_rng(size).random((size, size)).astype(np.float32)
    surface = compute_self_similarity_surface(brightness, side)
    assert surface.shape == (size - side + 1,) * 2
    assert 0.0 <= compute_uniqueness_margin(brightness, side, 8.0) <= 1.0


def builds_or_says_why_not(folder, dems, settings):
    values, affine = dems.rough_region(192)
    dems.write(folder / "dem.tif", values, affine=affine)
    (folder / "moon.toml").write_text(CONFIG + settings)
    output = folder / "moon.gpkg"
    try:
        report = run(folder / "moon.toml", output=output, bbox=(19.5, 9.5, 20.5, 10.5), workers=1)
    except (ConfigError, DataError, NothingToDoError):
        return
    assert report.points > 0
    assert output.is_file()


@pytest.mark.parametrize("name", CORNERS)
def test_a_corner_of_the_settings_builds_or_says_why_not(tmp_path, dems, name):
    builds_or_says_why_not(tmp_path, dems, CORNERS[name])
