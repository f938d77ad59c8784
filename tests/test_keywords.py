"""What becomes of the keywords of each format: a table a reader, all of them listed here.

A reader that is new, or a keyword that a reader begins to know, has to be entered, so that nothing
that changes a number's meaning is read past.
"""

import importlib
from pathlib import Path

import pytest

from catalog.errors import DataError
from catalog.keywords import Keyword, Keywords, check_keywords

# Modules with a table KEYWORDS. A test of each reader feeds it a file with every refused keyword.
READERS: tuple[str, ...] = (
    "catalog.bodies.daf",
    "catalog.bodies.stars",
    "catalog.terrain.dem.label",
    "optnav_cli.frames.fits_picture",
    "optnav_cli.archives.isis_lens",
    "optnav_cli.archives.label_geometry",
    "optnav_cli.archives.pixels",
    "optnav_cli.frames.picture_tags",
    "optnav_cli.orbit.fit.oem_reader",
)


def tables() -> dict[str, Keywords]:
    return {name: importlib.import_module(name).KEYWORDS for name in READERS}


def test_every_module_with_a_keyword_table_is_listed() -> None:
    checkout = Path(__file__).resolve().parents[1]
    having = {
        ".".join(path.relative_to(checkout).with_suffix("").parts)
        for package in ("catalog", "optnav_cli")
        for path in (checkout / package).rglob("*.py")
        if any(line.startswith("KEYWORDS") for line in path.read_text("utf-8").splitlines())
    }
    assert having == set(READERS)


@pytest.mark.parametrize("name", READERS)
def test_every_keyword_says_why(name: str) -> None:
    for keyword, entry in tables()[name].items():
        assert entry.why, f"{name}: {keyword}"
        assert not (entry.allowed and entry.fate in ("used", "harmless")), f"{name}: {keyword}"


def test_a_refused_keyword_is_named_with_value_and_remedy() -> None:
    table = {"SPIN": Keyword("refused", "unwind it", allowed=("0",))}
    assert check_keywords(Path("a.lbl"), [("SPIN", " 0 ")], table) == []
    with pytest.raises(DataError, match=r"a\.lbl: states SPIN = 3; unwind it"):
        check_keywords(Path("a.lbl"), [("SPIN", "3")], table)


def test_a_reported_keyword_makes_a_remark() -> None:
    table = {"NOTE": Keyword("reported", "no number depends on it"), "X": Keyword("used", "read")}
    remarks = check_keywords(Path("d/a.lbl"), [("NOTE", "old"), ("X", "1"), ("Y", "2")], table)
    assert remarks == ["a.lbl states NOTE = old: no number depends on it"]
