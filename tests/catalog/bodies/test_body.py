"""Body constants."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from catalog.bodies.body import load_body, read_body
from catalog.config import resource
from catalog.errors import ConfigError

BODIES = resource("configs/bodies/moon.toml").parent


def test_the_moon_has_its_published_size_and_mass() -> None:
    moon = load_body("moon")
    assert moon.radius_m == 1737400.0
    assert moon.gm_m3_s2 == pytest.approx(4.9028e12, rel=1e-5)
    # the highest and lowest places that LOLA found
    lowest, highest = moon.plausible_heights_m
    assert lowest < -9200.0
    assert highest > 10800.0


@pytest.mark.parametrize("name", [path.stem for path in sorted(BODIES.glob("*.toml"))])
def test_every_shipped_body_loads_under_its_own_name(name: str) -> None:
    body = load_body(name)
    assert body.name == name
    # the ellipsoid itself lies inside the plausible heights
    lowest, highest = body.plausible_heights_m
    assert lowest < min(body.radii_m) - body.radius_m
    assert max(body.radii_m) - body.radius_m < highest


@pytest.mark.parametrize(
    ("name", "number"),
    [("mercury", 199), ("eros", 2000433), ("vesta", 2000004), ("itokawa", 2025143),
     ("67p", 1000012), ("mars", 499), ("phobos", 401), ("venus", 299), ("jupiter", 599),
     ("io", 501), ("europa", 502), ("ganymede", 503), ("callisto", 504), ("mimas", 601),
     ("enceladus", 602), ("tethys", 603), ("dione", 604), ("rhea", 605), ("titan", 606),
     ("hyperion", 607), ("iapetus", 608), ("ariel", 701), ("umbriel", 702), ("titania", 703),
     ("oberon", 704), ("miranda", 705), ("triton", 801), ("pluto", 999), ("charon", 901),
     ("deimos", 402), ("saturn", 699), ("uranus", 799), ("neptune", 899), ("ida", 2431010)],
)  # fmt: skip
def test_sizes_and_masses_are_those_of_the_constants_kernels(
    name: str, number: int, shared_data: Callable[[str], Path]
) -> None:
    """GM of Itokawa and 67P are not in the kernels."""
    spice = pytest.importorskip("spiceypy", reason="needs spiceypy")
    paths = [str(shared_data(f"spice/{file}")) for file in ("pck00011.tpc", "gm_de440.tpc")]
    spice.furnsh(paths)
    try:
        body = load_body(name)
        np.testing.assert_allclose(body.radii_m, spice.bodvcd(number, "RADII", 3)[1] * 1e3)
        if spice.bodfnd(number, "GM"):
            gm = spice.bodvcd(number, "GM", 1)[1][0]
            assert body.gm_m3_s2 == pytest.approx(gm * 1e9, rel=1e-9)
    finally:
        for path in paths:
            spice.unload(path)


def test_a_misspelt_body_is_answered_with_the_nearest() -> None:
    with pytest.raises(ConfigError, match=r"no body 'mon'; did you mean 'moon'\?"):
        load_body("mon")
    with pytest.raises(ConfigError, match="no body 'xyzzy'; there are 67p, ariel, bennu, callisto"):
        load_body("xyzzy")


def test_a_body_name_may_be_the_path_of_a_file(tmp_path: Path) -> None:
    path = edited(tmp_path, 'name = "earth"', 'name = "terra"')
    assert load_body(str(path)).name == "terra"
    assert load_body("earth.toml", tmp_path) == load_body("./earth.toml", tmp_path)
    assert load_body(f"../{tmp_path.name}/earth.toml", tmp_path).name == "terra"


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("../bodies/moon", r"bodies/moon: there is no such file"),
        ("moon.toml", r"moon.toml: there is no such file"),
        ("", "no body"),
    ],
)
def test_a_path_without_a_body_file_is_refused(tmp_path: Path, name: str, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        load_body(name, tmp_path)


def edited(tmp_path: Path, old: str, new: str) -> Path:
    source = Path(__file__).parents[3] / "configs/bodies/earth.toml"
    text = source.read_text()
    assert old in text
    path = tmp_path / "earth.toml"
    path.write_text(text.replace(old, new))
    return path


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("radius_km = 6371.0088", "radius_km = -1.0", "radius_km = -1.0: must be"),
        ("radius_km = 6371.0088", "radius_km = 1e17", "radius_km = 1e.17: must be"),
        ("radius_km = 6371.0088", "radius_km = 5e5", "radii_km is"),
        ('name = "earth"', 'name = "/"', "plain name"),
        ("[-27.0, 16.0]", "[-27.0, 1e300]", "plausible_heights_km"),
        ("[-27.0, 16.0]", "[16.0, -27.0]", "plausible_heights_km"),
        ("[-27.0, 16.0]", "[-7000.0, 16.0]", "plausible_heights_km"),
        ("radius_km =", "radius =", "radius_km"),
        ('sun = "earth"', 'sun = "pluto"', "sun"),
    ],
)
def test_a_wrong_body_file_is_refused(tmp_path: Path, old: str, new: str, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        read_body(edited(tmp_path, old, new))


def test_an_orbit_that_serves_in_no_year_is_refused(tmp_path: Path) -> None:
    text = (BODIES / "eros.toml").read_text()
    path = tmp_path / "eros.toml"
    path.write_text(text.replace("[1991.0, 2006.0]", "[2006.0, 1991.0]"))
    with pytest.raises(ConfigError, match=r"\[sun\] years is \[2006.0, 1991.0\]; wanted"):
        read_body(path)
