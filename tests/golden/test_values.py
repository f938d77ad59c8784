"""Renders and descriptors are what they were when they were last looked at."""

import json
import xml.etree.ElementTree as ET
from pathlib import Path

import cv2
import numpy as np
import pytest
from click.testing import CliRunner

from tests.golden.__main__ import CURVES, main
from tests.golden.documents import CAPTIONS, DOCUMENTS
from tests.golden.values import LAWS, NODES, SUNS, frozen, golden_values
from tests.studies.stored import read_stored

README = Path(__file__).with_name("readme")
ANEW = "if the change is meant, run `make golden` and look at what it changed"
RENDERS = [f"{law}_{sun}" for law in LAWS for sun in SUNS]


@pytest.fixture(scope="module")
def now():
    return golden_values()


@pytest.mark.parametrize("name", RENDERS)
def test_a_render_is_as_it_was(now, name):
    """Equal to 1e-4 of the brightness where both are lit, or to 3e-8.

    Renders are computed in single precision: the cosine of incidence has the rounding of a number
    near 1, 6e-8, and a brightness half of it. Hapke's law has transcendental functions from the
    platform's libm or the compiler's vector library: a few units in the last place, about 1e-6,
    and the roughness terms lose one more digit at grazing light. A change of a law or a slope is
    larger than 1e-4 by far. The border of a shadow may move by rounding: two of a thousand nodes
    may be lit in one alone.
    """
    then = frozen()[name]
    assert now[name].shape == then.shape == (NODES, NODES)
    differently_lit = (now[name] > 0.0) != (then > 0.0)
    assert differently_lit.mean() <= 0.002, f"{name}: shadows moved; {ANEW}"
    lit = (now[name] > 0.0) & (then > 0.0)
    error = np.maximum(np.abs(now[name][lit] - then[lit]) - 3e-8, 0.0)
    worst = (error / then[lit]).max()
    assert worst < 1e-4, f"{name}: {worst:.1e} of the brightness differs; {ANEW}"


def test_descriptors_are_as_they_were(now):
    """Equal to 2e-3 in numbers of a unit vector.

    Descriptors are sums of differences of a render, so a node that rounding moves out of shadow
    counts: one step from black to lit changes one of 64 sums of 64 nodes each by about 1e-3.
    """
    then = frozen()["surf"]
    worst = np.abs(now["surf"] - then).max()
    assert worst < 2e-3, f"descriptors differ by {worst:.1e}; {ANEW}"


def test_the_frozen_window_has_light_and_shadow():
    """A window without shadow, or black, would freeze nothing worth it."""
    held = frozen()
    for law in LAWS:
        assert 0.05 < (held[f"{law}_low"] == 0.0).mean() < 0.7
        assert held[f"{law}_high"].std() > 0.005


def test_descriptors_have_unit_length():
    np.testing.assert_allclose(np.linalg.norm(frozen()["surf"], axis=1), 1.0, atol=1e-6)


def test_the_pictures_of_the_readme_are_small_and_can_be_read():
    paths = sorted(README.glob("*.png"))
    assert {"opening", "catalog", "phobos", "point", "frame", "apollo"} <= {
        path.stem for path in paths
    }
    for path in paths:
        picture = cv2.imread(str(path))
        assert picture is not None, f"{path.name} cannot be read"
        assert picture.shape[1] <= 1000
        assert path.stat().st_size <= 500_000
        assert picture.std() > 20.0, f"{path.name} is nearly empty"


def test_the_curves_of_the_readme_are_small_drawings():
    paths = sorted(README.glob("*.svg"))
    assert {"arc", "resection", "matching", "transfer"} <= {path.stem for path in paths}
    for path in paths:
        assert path.stat().st_size <= 80_000
        root = ET.parse(path).getroot()
        # places that lines and marks are drawn through
        drawn = sum(
            len((element.get("points") or element.get("d") or "one").split())
            for shape in ("polyline", "path", "circle")
            for element in root.iter("{http://www.w3.org/2000/svg}" + shape)
        )
        assert drawn > 100, f"{path.name} is nearly empty"


def test_the_command_that_makes_them_anew_starts():
    nothing = [option.secondary_opts[0] for option in main.params if option.secondary_opts]
    result = CliRunner().invoke(main, nothing)
    assert (result.exit_code, result.output) == (0, "")


def test_every_picture_is_shown_in_a_readme():
    texts = "".join(path.read_text(encoding="utf-8") for path in DOCUMENTS)
    assert [p.name for p in README.iterdir() if f"readme/{p.name})" not in texts] == []


def test_every_picture_but_the_studies_curves_has_a_made_caption():
    texts = "".join(path.read_text(encoding="utf-8") for path in DOCUMENTS)
    captions = json.loads(CAPTIONS.read_text(encoding="utf-8"))
    assert set(captions) == {path.stem for path in README.iterdir()} - set(CURVES)
    for name, caption in captions.items():
        assert f"<!-- made: caption {name} -->\n\n{caption}\n" in texts
        assert len(caption) > 40


def test_the_orbit_s_picture_shows_errors_with_their_sigmas():
    """It once showed stated sigmas under a caption about errors."""
    labels = [
        element.get("aria-label")
        for name in ("orbit", "transfer")
        for element in ET.parse(README / f"{name}.svg").iter("{http://www.w3.org/2000/svg}svg")
    ]
    assert all("sigma" not in label for label in labels)
    assert sum(label.startswith("Error along") for label in labels) == 6


def test_the_caption_of_the_apollo_picture_has_the_figures_of_the_study():
    text = json.loads(CAPTIONS.read_text(encoding="utf-8"))["apollo"]
    table = read_stored("apollo").tables[0]
    (used,), (of,), (residual,) = map(table.column, ("used", "predicted", "residual_px"))
    assert f"{used} of {of} control points are used, residual {residual:.2f} px" in text
