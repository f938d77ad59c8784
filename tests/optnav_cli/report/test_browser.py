"""Pages about catalogs in a real browser: maps are drawn where they should be, all is quiet."""

import cv2
import numpy as np
import pytest

from optnav_cli.pages import write_report
from tests.optnav_cli.report.browser import Browser
from tests.optnav_cli.report.pages import a_catalog

SIZES = {"regional": {}, "global": {"lat": (-90.0, 90.0), "lon": (-180.0, 180.0), "step_deg": 5.0}}
COLOURFUL = 60  # distance of the largest from the least channel


@pytest.fixture(scope="module")
def browser(tmp_path_factory):
    browser = Browser(tmp_path_factory.mktemp("profile"))
    yield browser
    browser.close()


@pytest.fixture(scope="module", params=SIZES)
def page(request, tmp_path_factory):
    folder = tmp_path_factory.mktemp(request.param)
    count = 1700 if request.param == "global" else 60
    write_report(a_catalog(folder / "c.gpkg", count, **SIZES[request.param]), folder / "r.html")
    return folder / "r.html"


def parts(browser, selector):
    """The drawn pieces of the page that match, by their label."""
    drawn = browser.picture()
    return [
        (label, drawn[top:bottom, left:right])
        for label, (left, top, right, bottom) in browser.boxes(selector)
    ]


def colourful(piece):
    return np.ptp(piece.astype(np.int64), axis=2) > COLOURFUL


def test_all_maps_histograms_and_patches_are_drawn_and_nothing_complains(browser, page):
    browser.open(page)
    drawings = parts(browser, "svg")
    maps = [(label, piece) for label, piece in drawings if label.startswith("Map of")]
    whole = any("Mollweide" in label for label, _ in maps)
    assert len(maps) == (15 if whole else 5)
    for label, piece in maps:
        height, width = piece.shape[:2]
        middle = piece[height // 4 : -height // 4, width // 4 : -width // 4]
        # cells of many values in the middle of each map, clear paper in a round map's corner
        assert len(np.unique(middle.reshape(-1, 3), axis=0)) > 30, label
        if "usable" not in label:
            # 60 of some 500 cells of the region have a point
            assert colourful(middle).mean() > (0.9 if whole else 0.05), label
        if whole:
            assert np.array_equal(piece[3, 3], piece[3, -4]), label
            assert not colourful(piece[:4, :4]).any(), label
    histograms = [piece for label, piece in drawings if label.startswith("Histogram")]
    assert len(histograms) == 4
    assert all(colourful(piece).mean() > 0.03 for piece in histograms)
    patches = parts(browser, ".patches img")
    assert len(patches) == 14
    assert all(piece.std() > 15.0 for _, piece in patches)
    assert browser.complaints == []


def test_the_ground_under_the_usable_points_of_the_moon_is_shaded(browser, page):
    browser.open(page)
    piece = next(p for label, p in parts(browser, "svg") if "usable control points" in label)
    height, width = piece.shape[:2]
    gray = cv2.cvtColor(piece, cv2.COLOR_BGR2GRAY)[height // 3 : -height // 3]
    if "global" in str(page):
        assert gray[:, width // 3 : -width // 3].std() > 8.0
    else:  # patches 7.6 km wide leave most of 15 km wide cells open: dots on paper
        assert colourful(piece).sum() > 60 * 20


@pytest.mark.parametrize("width", [340, 700, 1800])
def test_the_page_fits_windows_from_a_telephone_s_to_a_wide_one(browser, page, width):
    browser.open(page, width=width)
    assert browser.ask("document.documentElement.scrollWidth") <= width
    outside = [
        label for label, (left, _, right, _) in browser.boxes("svg, img")
        if left < 0 or right > width or right - left < 60
    ]  # fmt: skip
    assert outside == []
    assert browser.complaints == []


def test_in_the_dark_paper_and_ink_change_places_and_maps_stay(browser, page):
    browser.open(page)
    light = dict(parts(browser, "svg"))
    browser.open(page, dark=True)
    dark = dict(parts(browser, "svg"))
    corner = browser.picture()[2, 2].astype(int)
    assert corner.max() < 60
    label = next(label for label in light if label.startswith("Map of Localisation"))
    same = (light[label] == dark[label]).all(axis=2)
    cells = colourful(light[label])
    assert same[cells].mean() > 0.9
