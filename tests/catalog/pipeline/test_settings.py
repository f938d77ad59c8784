"""A build config is taken whole or refused with its file, section and key."""

import pytest

from catalog.errors import ConfigError
from catalog.pipeline.config import load_build_config

BODY = '[body]\nname = "phobos"\n'
MESH = '[[mesh]]\npath = "a.obj"\nunits = "km"\n'
LEAST = '[body]\nname = "moon"\n[[dem]]\npath = "dem.tif"\n'


def config_of(tmp_path, text):
    path = tmp_path / "build.toml"
    path.write_text(text)
    return load_build_config(path)


def test_body_and_one_dem_are_enough(tmp_path):
    config = config_of(tmp_path, LEAST)
    assert config.grid.cell_deg == 1.0
    assert (config.pyramid.levels, config.pyramid.size, config.pyramid.posting_m) == (5, 80, None)


def test_a_dem_section_takes_all_its_keys(tmp_path):
    more = (
        'priority = 2\nheights = "radius"\nscale = 0.5\noffset = 10\nnodata = -1\nunits = "km"\n'
        'longitude = "west"\ncrs = "IAU_2015:30100"\n'
    )
    (dem,) = config_of(tmp_path, LEAST + more).dem
    assert (dem.priority, dem.heights, dem.scale, dem.offset) == (2, "radius", 0.5, 10.0)
    assert (dem.nodata, dem.units, dem.longitude, dem.crs) == (-1.0, "km", "west", "IAU_2015:30100")


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ('[body]\nname = "moon"\n', ["no [[dem]], [[mesh]] or [[image]]"]),
        (LEAST + '[[mesh]]\npath = "a.obj"\nunits = "km"\n', ["[[mesh]] beside terrain models"]),
        (BODY + MESH + MESH, ["2 sections [[mesh]]"]),
        (BODY + '[[mesh]]\npath = "a.obj"\n', ["[[mesh]] number 1 needs the setting 'units'"]),
        (BODY + '[[mesh]]\npath = "a.obj"\nunits = "mi"\n', ["units", "km, m"]),
        (BODY + '[[mesh]]\npath = ""\nunits = "m"\n', ["[[mesh]] number 1 path"]),
        ('[body]\nname = "moon"\ndem = []\n', ["[body]", "dem"]),
        (LEAST + "pirority = 2\n", ["pirority", "priority"]),
        (LEAST + "priority = 0\n", ["priority = 0"]),
        (LEAST + "error_m = 0.0\n", ["error_m = 0.0", "> 0"]),
        (LEAST + "error_m = -28.0\n", ["error_m = -28", "> 0"]),
        (LEAST + "error_m = nan\n", ["error_m", "finite"]),
        (LEAST + "resolution_km = 1.6\n", ["resolution_km without error_m"]),
        (LEAST + 'product = "gdl100"\n', ["[[dem]] dem.tif", "'gdl100'", "'gld100'"]),
        (LEAST + 'product = "mesh"\n', ["'mesh'", "gld100, lola_118m"]),
        (LEAST + 'product = "gld100"\nerror_m = 3.0\n', ["product beside error_m"]),
        (BODY + MESH + "error_m = 0\n", ["[[mesh]] number 1 error_m"]),
        (LEAST + '[relief]\ndem = {path = "a.tif", error_m = 3.0}\n', ["[relief.dem]", "error_m"]),
        (LEAST + "scale = 0.0\n", ["scale is 0"]),
        (LEAST + "[check]\nsnr_min = 360.0\n", ["[check] snr_min is 360", "snr_max, 50"]),
        (LEAST + "[render]\nsun_max_deg = 1.0\n", ["[render] sun_min_deg is 8"]),
        (LEAST + "[write]\nheight_step_m = 1e308\n", ["height_step_m is 1e+308"]),
        (LEAST + 'heights = "depth"\n', ["heights"]),
        (LEAST + "[grid]\ncell_deg = 0\n", ["[grid] cell_deg is 0"]),
        (LEAST + "[grid]\ncell_deg = nan\n", ["[grid]", "cell_deg", "finite"]),
        (LEAST + "[grid]\ncell_degrees = 1\n", ["cell_degrees", "cell_deg"]),
        (LEAST + '[grid]\ncell_deg = "one"\n', ["[grid]", "cell_deg"]),
        (LEAST + "[pyramid]\nlevels = 0\n", ["[pyramid] levels is 0"]),
        (LEAST + "[pyramid]\nsize = 81\n", ["[pyramid] size is 81", "even"]),
        (LEAST + "[pyramid]\nposting_m = -5\n", ["[pyramid] posting_m = -5"]),
        (LEAST + "[rendering]\n", ["rendering", "render"]),
    ],
)
def test_a_wrong_config_says_where_and_what(tmp_path, text, words):
    with pytest.raises(ConfigError) as caught:
        config_of(tmp_path, text)
    for word in ["build.toml", *words]:
        assert word in str(caught.value)
