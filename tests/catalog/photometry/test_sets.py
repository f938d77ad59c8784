"""Published sets of Hapke's parameters: their numbers against published albedos, and bad ones."""

from pathlib import Path

import numpy as np
import pytest

from catalog.bodies.body import load_body, read_body
from catalog.config import parse_toml
from catalog.errors import ConfigError
from catalog.photometry.hapke import reflectance
from catalog.photometry.laws import find_law
from catalog.photometry.sets import (
    LUNAR,
    BodyPhotometry,
    HapkeParameters,
    PhotometrySettings,
    load_sets,
)
from catalog.store.manifest import CatalogMeta, format_content, meta_from_rows, rows_from_meta

FOLDER = Path(__file__).resolve().parents[3] / "configs" / "photometry"
BODIES = sorted(path.stem for path in FOLDER.glob("*.toml"))
GOOD = "w = 0.3\nb = 0.2\nc = 0.3\nbs0 = 1.0\nhs = 0.05\ntheta_bar_deg = 20.0\n"

DISC_NODES = 200  # of the integral over a disc: right to 1e-6


def compute_geometric_albedo(surface: HapkeParameters) -> float:
    """Geometric albedo of a sphere: its light at zero phase over that of a white disc."""
    nodes, weights = np.polynomial.legendre.leggauss(DISC_NODES)
    mu = 0.5 * (nodes + 1.0)
    return float(weights @ (mu * reflectance(mu, mu, np.ones_like(mu), surface)))


def a_set(text: str):
    """The sets of a file with one set, "own"."""
    given = parse_toml(f'default = "own"\n[sets.own]\n{text}', BodyPhotometry, "own.toml")
    return given.name_sets("own", "own.toml")


@pytest.mark.parametrize("body", [body for body in BODIES if body != "moon"])
def test_a_sphere_of_a_set_is_as_bright_as_published(body):
    """Outside truth: published geometric albedos, within their published errors."""
    (ground,) = load_sets(body)
    published, sigma = ground.geometric_albedo
    assert compute_geometric_albedo(ground.surface) == pytest.approx(published, abs=sigma)


def test_maria_are_half_as_bright_as_highlands():
    """Clementine at 750 nm, i = g = 30 deg: 0.08 to 0.10 in maria, 0.16 to 0.20 in highlands."""
    average, *others = (
        find_law("hapke", ground.surface)(np.cos(np.radians(30.0)), 1.0, np.cos(np.radians(30.0)))
        for ground in load_sets("moon")
    )
    highland, mare = others
    assert mare < average < highland
    assert 0.4 < mare / highland < 0.65


def test_the_moons_default_is_the_set_of_the_laws():
    assert load_body("moon").photometry.name == "moon average"
    assert load_body("moon").photometry.surface == LUNAR == load_sets("moon")[0].surface


def test_every_set_names_its_source_and_body():
    for body in BODIES:
        assert load_body(body).describe_missing_photometry() is None
        for ground in load_sets(body):
            assert ground.body == body
            assert ground.source
            assert ground.name.startswith(f"{body} ")


def test_a_kind_of_terrain_can_be_chosen():
    moon = load_body("moon").choose_photometry(PhotometrySettings(set="mare"))
    assert moon.photometry.name == "moon mare"
    assert moon.choose_photometry(PhotometrySettings()) == moon
    with pytest.raises(ConfigError, match=r"set is 'maria'.*did you mean 'mare'"):
        moon.choose_photometry(PhotometrySettings(set="maria"))


def test_a_body_without_a_set_says_so_and_how_to_state_one(tmp_path):
    vesta = load_body("vesta")
    assert vesta.photometry.surface == LUNAR
    said = vesta.describe_missing_photometry()
    assert "no photometric set is known of the vesta" in said
    assert "[photometry.sets.NAME]" in said
    text = (FOLDER.parent / "bodies" / "vesta.toml").read_text()
    path = tmp_path / "mine.toml"
    path.write_text(f'{text}\n[photometry]\ndefault = "all"\n[photometry.sets.all]\n{GOOD}')
    mine = read_body(path)
    assert mine.describe_missing_photometry() is None
    assert mine.photometry.surface.w == 0.3
    assert mine.photometry.name == "vesta all"


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        (
            "w = 0.3",
            "w = 1.4",
            r"own.toml: \[photometry.sets.own\] w is 1.4; wanted 0.001 to 0.999",
        ),
        ("hs = 0.05", "hs = 0.0", r"hs is 0; wanted 0.0001 to 1"),
        ("theta_bar_deg = 20.0", "theta_bar_deg = 75.0", r"theta_bar_deg is 75; wanted 0 to 60"),
        ("b = 0.2", "b = 0.99", r"\[photometry.sets.own\] b is 0.99; wanted 0 to 0.95"),
        ("b = 0.2\nc = 0.3", "b = 0.9\nc = 1.4", r"c is 1.4 with b = 0.9: the phase function"),
        ("b = 0.2\n", "", "has no phase function; wanted g, or both b and c"),
        ("c = 0.3", "c = 0.3\ng = -0.2", "has no phase function"),
        ("w = 0.3", "w = 0.6\nporosity_factor = 2.0", "w times porosity_factor is 1.2"),
        ("w = 0.3", "w = 0.3\nphase_deg = [90.0, 10.0]", "the lowest and the highest"),
    ],
)
def test_numbers_that_no_ground_has_are_refused_by_name(old, new, said):
    assert old in GOOD
    with pytest.raises(ConfigError, match=said):
        a_set(GOOD.replace(old, new))


def test_one_lobe_is_two_of_which_one_is_all():
    backwards = a_set(GOOD.replace("b = 0.2\nc = 0.3", "g = -0.25"))[0].surface
    assert (backwards.b, backwards.c) == (0.25, 1.0)


def test_a_default_that_is_no_set_is_refused():
    given = parse_toml(f'default = "all"\n[sets.own]\n{GOOD}', BodyPhotometry, "own.toml")
    with pytest.raises(ConfigError, match="default is 'all'; wanted one of own"):
        given.name_sets("own", "own.toml")


def test_numbers_of_ones_own_stand_in_place_of_a_name():
    text = f"[numbers]\n{GOOD}"
    settings = parse_toml(text, PhotometrySettings, "build.toml")
    assert load_body("moon").choose_photometry(settings).photometry.name == "moon stated"
    both = parse_toml(f'set = "mare"\n{text}', PhotometrySettings, "build.toml")
    with pytest.raises(ConfigError, match="beside set; wanted one of the two"):
        load_body("moon").choose_photometry(both)


def test_phases_outside_the_published_range_are_counted():
    (ceres,) = load_sets("ceres")
    assert ceres.find_outside(np.array([10.0, 90.0, np.nan])) is None
    said = ceres.find_outside(np.array([3.0, 20.0, 110.0]))
    assert "2 of 3 frames have a phase, 3.0 to 110.0 deg" in said
    assert "'ceres average', 7 to 95 deg" in said
    (eros,) = load_sets("eros")
    assert eros.find_outside(np.array([170.0])) is None


def test_a_catalog_states_the_set_it_was_built_with():
    (phobos,) = load_sets("phobos")
    meta = CatalogMeta("phobos", 11100.0, 10.0, 2, 80, 50.0, 0.5, photometry=phobos)
    assert meta_from_rows(rows_from_meta(meta), "it").ground == phobos
    older = CatalogMeta("phobos", 11100.0, 10.0, 2, 80, 50.0, 0.5)
    assert "photometry" not in rows_from_meta(older)
    assert meta_from_rows(rows_from_meta(older), "it").ground.name == "moon average"
    assert format_content(meta) == format_content(older)
