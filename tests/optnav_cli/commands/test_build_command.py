"""`optnav build` of terrain models that stand in place of a config."""

from pathlib import Path

import pytest

from catalog.config import resource
from catalog.store.reader import Catalog
from optnav_cli.main import run

BOX = ["--bbox", "-12,-44,-10,-42", "--workers", "1"]
TYCHO = "bundled:tycho_gld100_256ppd.tif"


def test_a_raster_alone_builds_as_a_config_that_names_it(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    config = tmp_path / "moon.toml"
    config.write_text(f'[body]\nname = "moon"\n[[dem]]\npath = "{TYCHO}"\n')
    assert run(["-q", "build", TYCHO, "-o", str(tmp_path / "a.gpkg"), *BOX]) == 0
    assert run(["-q", "build", str(config), "-o", str(tmp_path / "b.gpkg"), *BOX]) == 0
    with Catalog.open(tmp_path / "a.gpkg") as a, Catalog.open(tmp_path / "b.gpkg") as b:
        assert a.digest == b.digest
        assert TYCHO in a.meta.config
    assert "2 control points" in capsys.readouterr().out


def test_a_body_is_named_for_rasters_and_refused_beside_a_config(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    place = str(tmp_path / "x.gpkg")
    config = str(resource("configs/catalogs/tycho.toml"))
    assert run(["build", config, "--body", "moon", "-o", place]) == 2
    assert "[body] name" in capsys.readouterr().err
    assert run(["build", TYCHO, "--body", "mon", "-o", place]) == 3
    assert "did you mean 'moon'" in capsys.readouterr().err
    assert run(["build", TYCHO, config, "-o", place]) == 2
    assert "one config, or terrain models" in capsys.readouterr().err
    assert run(["build", "shape.obj", "-o", place]) == 2
    assert "[[mesh]]" in capsys.readouterr().err
    assert run(["build", TYCHO, "--body", "phobos", "-o", place]) == 3  # heights of another body
    assert not Path(place).exists()
