"""Names and docstrings of the code: verbs for functions, contents for variables, plain openings.

A room is a folder of a package. Rooms that are not yet clean have a count that may only fall.
"""

import ast
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

CHECKOUT = Path(__file__).parents[1]


def _list_words(text: str) -> frozenset[str]:
    return frozenset(text.split())


PREPOSITIONS = _list_words(
    "about above across after against along among around at before behind below beneath beside "
    "between beyond by down for from in inside into near of off on onto out outside over past "
    "per through to toward under until up upon via with within without"
)
# `to_text`, `from_file` and `with_albedo` are idioms of Python; alone they say nothing.
IDIOMS = frozenset(("to", "from", "with"))
IRREGULAR = _list_words(
    "begun bent bound brought built chosen cut done drawn fallen felt flown found given gone "
    "held hidden kept known laid led left lit lost made met put seen sent shown shrunk spread "
    "stood swept taken told torn worn written"
)
# Verbs and nouns that end like participles, and `cut` and `put`, which are verbs as well.
NO_PARTICIPLES = _list_words(
    "bearing bring cut embed exceed feed feeding heading need posting proceed put rendering "
    "ring sampling seed setting shading shed spacing speed spread string timing warning"
)
VAGUE = frozenset(("found", "one", "place", "whole", "rest", "own", "away", "alike", "told"))
OPENINGS = ("Of ", "As ", "The same", "What ", "By ", "How ")


def _find_room(path: Path) -> str:
    parts = path.relative_to(CHECKOUT).parts
    return "/".join(parts[:2]) if len(parts) > 2 else parts[0]


TREES = [
    (_find_room(path), ast.parse(path.read_text(encoding="utf-8")))
    for package in ("catalog", "optnav_cli")
    for path in sorted((CHECKOUT / package).rglob("*.py"))
]
ROOMS = sorted({room for room, _ in TREES})


def _is_property(function: ast.FunctionDef) -> bool:
    names = (getattr(d, "id", getattr(d, "attr", "")) for d in function.decorator_list)
    return bool({"property", "cached_property"} & set(names))


def find_unclear_functions(tree: ast.AST) -> Iterator[str]:
    """Find functions whose name begins with a participle or a preposition; not properties."""
    for node in ast.walk(tree):
        if isinstance(node, ast.FunctionDef) and not _is_property(node):
            first, *others = node.name.strip("_").split("_")
            participle = first.endswith(("ed", "ing")) or first in IRREGULAR
            preposition = first in PREPOSITIONS and not (first in IDIOMS and others)
            if preposition or (participle and first not in NO_PARTICIPLES):
                yield node.name


def find_vague_variables(tree: ast.AST) -> Iterator[str]:
    """Find variables that are named by their history instead of their content."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store) and node.id in VAGUE:
            yield node.id


def find_hanging_docstrings(tree: ast.AST) -> Iterator[str]:
    """Find docstrings that do not stand alone without the name above them."""
    for node in ast.walk(tree):
        if not isinstance(node, ast.FunctionDef | ast.ClassDef):
            continue
        if (ast.get_docstring(node) or "").startswith(OPENINGS):
            yield node.name


# Counts that may only fall: lower one with each name that becomes clear, and drop it at 0.
FUNCTIONS: dict[str, int] = {
    "catalog": 1,
    "catalog/geometry": 1,
    "catalog/pipeline": 1,
    "catalog/rendering": 1,
    "catalog/store": 5,
    "catalog/terrain": 9,
    "optnav_cli": 1,
    "optnav_cli/control_points": 2,
    "optnav_cli/dynamics": 20,
    "optnav_cli/estimation": 12,
    "optnav_cli/evaluation": 2,
    "optnav_cli/navigate": 1,
    "optnav_cli/orbit": 82,
    "optnav_cli/simulation": 41,
}
VARIABLES: dict[str, int] = {
    "optnav_cli/control_points": 2,
    "optnav_cli/hazard": 1,
}
DOCSTRINGS: dict[str, int] = {
    "optnav_cli/commands": 1,
}


@pytest.mark.parametrize(
    ("find", "allowed"),
    [
        (find_unclear_functions, FUNCTIONS),
        (find_vague_variables, VARIABLES),
        (find_hanging_docstrings, DOCSTRINGS),
    ],
)
def test_names_of_rooms_are_clear(
    find: Callable[[ast.AST], Iterator[str]], allowed: dict[str, int]
) -> None:
    names = {room: Counter[str]() for room in ROOMS}
    for room, tree in TREES:
        names[room].update(find(tree))
    worse = {r: dict(n) for r, n in names.items() if n.total() > allowed.get(r, 0)}
    assert worse == {}
    assert set(allowed) <= set(ROOMS)


def test_the_checks_find_what_they_are_for() -> None:
    source = (
        "def _flown(): found = 1\n"
        "def beside(): pass\n"
        "def to(): pass\n"
        "def to_text(): pass\n"
        "def read_speed():\n    'Of a craft.'\n"
        "@property\ndef solved(self): pass\n"
    )
    tree = ast.parse(source)
    assert list(find_unclear_functions(tree)) == ["_flown", "beside", "to"]
    assert list(find_vague_variables(tree)) == ["found"]
    assert list(find_hanging_docstrings(tree)) == ["read_speed"]
