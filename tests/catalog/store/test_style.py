"""Styles for QGIS, which is not here: well-formed, complete, and where QGIS looks for them."""

import sqlite3
from contextlib import closing
from pathlib import Path
from xml.etree import ElementTree

import pytest

from catalog.inspect.export import export
from catalog.store.geopackage import BLUE, GREEN, RED, Rule, format_style
from catalog.store.reader import Catalog
from catalog.store.writer import Written

pyogrio = pytest.importorskip("pyogrio", reason="needs pyogrio to read vector layers")


def test_every_rule_has_a_symbol_of_its_own() -> None:
    text = format_style(
        Rule("a <b>", '"usable" AND "name" <> \'x\'', "circle", GREEN, 2.0),
        Rule("the rest", "ELSE", "cross2", RED, 2.0),
        Rule("way", "", "line", BLUE, 0.5),
        Rule("area", "", "fill", BLUE, 0.3),
    )
    root = ElementTree.fromstring(text)
    rules = root.findall("renderer-v2/rules/rule")
    assert [rule.get("filter") for rule in rules] == [
        '"usable" AND "name" <> \'x\'', "ELSE", None, None,
    ]  # fmt: skip
    assert rules[0].get("label") == "a <b>"
    symbols = {s.get("name"): s for s in root.findall("renderer-v2/symbols/symbol")}
    assert [symbols[rule.get("symbol")].get("type") for rule in rules] == [
        "marker", "marker", "line", "fill",
    ]  # fmt: skip
    for symbol in symbols.values():
        options = {o.get("name"): o.get("value") for o in symbol.findall("layer/Option/Option")}
        # the way in which versions before 3.26 read the same
        assert options == {p.get("k"): p.get("v") for p in symbol.findall("layer/prop")}


def default_style(path: Path, layer: str) -> ElementTree.Element:
    """What QGIS takes for a layer: it asks for these very columns."""
    with closing(sqlite3.connect(path)) as db:
        ((text,),) = db.execute(
            "SELECT styleQML FROM layer_styles WHERE f_table_catalog = '' AND f_table_schema = '' "
            "AND f_table_name = ? AND f_geometry_column = 'geom' AND useAsDefault",
            (layer,),
        ).fetchall()
    return ElementTree.fromstring(text)


def test_catalogs_and_exported_layers_tell_usable_points_apart(
    written: Written, tmp_path: Path
) -> None:
    with Catalog.open(written.path) as catalog:
        export(catalog, tmp_path / "points.gpkg")
    for path in (written.path, tmp_path / "points.gpkg"):
        root = default_style(path, "control_points")
        assert [rule.get("filter") for rule in root.iter("rule")] == ['"usable"', "ELSE"]
        shapes = [option.get("value") for option in root.iter("Option")
                  if option.get("name") in ("name", "color")]  # fmt: skip
        assert len(set(shapes)) == 4
        # GDAL reads the table as QGIS does, and the layer with it
        assert "layer_styles" in pyogrio.list_layers(path)[:, 0]
        assert pyogrio.raw.read(path, layer="layer_styles")[3][2].tolist() == ["control_points"]
