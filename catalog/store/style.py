"""How QGIS draws a layer: a style as QML, with a symbol for each of some rules."""

from typing import Literal, NamedTuple
from xml.etree import ElementTree
from xml.etree.ElementTree import Element, SubElement

Colour = tuple[int, int, int]
Shape = Literal["circle", "cross2", "triangle", "line", "fill"]

GREEN, RED, BLUE, GRAY = (46, 125, 50), (198, 40, 40), (21, 101, 192), (97, 97, 97)
_SYMBOLS = {"line": ("line", "SimpleLine"), "fill": ("fill", "SimpleFill")}
_MARKER = ("marker", "SimpleMarker")


class Rule(NamedTuple):
    """Which features are drawn how.

    label   for the legend
    filter  an expression of QGIS; "ELSE": those that no other rule takes; "": all
    shape   of a point; or a line, or an area that shows what lies below
    size    of a point, or width of a line, mm
    """

    label: str
    filter: str
    shape: Shape
    colour: Colour
    size: float


def style_qml(*rules: Rule) -> str:
    """The style of a layer whose features are drawn by the first rule that they fit."""
    root = Element("qgis", version="3.22.0", styleCategories="Symbology")
    renderer = SubElement(root, "renderer-v2", type="RuleRenderer", symbollevels="0")
    listed = SubElement(renderer, "rules", key="root")
    symbols = SubElement(renderer, "symbols")
    for number, rule in enumerate(rules):
        which = {"filter": rule.filter} if rule.filter else {}
        names = {"key": f"rule{number}", "symbol": str(number), "label": rule.label}
        SubElement(listed, "rule", names | which)
        kind, drawn_by = _SYMBOLS.get(rule.shape, _MARKER)
        symbol = SubElement(symbols, "symbol", name=str(number), type=kind, alpha="1")
        layer = SubElement(symbol, "layer", {"class": drawn_by, "enabled": "1", "pass": "0"})
        options = SubElement(layer, "Option", type="Map")
        for name, value in _options(rule).items():
            SubElement(options, "Option", name=name, type="QString", value=value)
            SubElement(layer, "prop", k=name, v=value)  # what QGIS read before 3.26
    ElementTree.indent(root)
    return f"<!DOCTYPE qgis>\n{ElementTree.tostring(root, encoding='unicode')}\n"


def _options(rule: Rule) -> dict[str, str]:
    """The settings of a symbol's layer as QGIS names them."""
    colour, size = ",".join(map(str, (*rule.colour, 255))), f"{rule.size:g}"
    if rule.shape == "line":
        return {"line_color": colour, "line_width": size, "line_width_unit": "MM"}
    if rule.shape == "fill":
        inside = ",".join(map(str, (*rule.colour, 40)))
        edge = {"outline_color": colour, "outline_width": size, "outline_width_unit": "MM"}
        return {"color": inside, "style": "solid", "outline_style": "solid"} | edge
    edge = {"outline_color": colour, "outline_style": "solid", "outline_width": "0.4"}
    return {"name": rule.shape, "color": colour, "size": size, "size_unit": "MM"} | edge
