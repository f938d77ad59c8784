"""The language of PDS3 labels."""

import pytest

from optnav_cli.archives.label_text import OdlError, Statement, read_statements

LABEL = """CCSD3ZF0000100000001NJPL3IF0PDS200000001 = SFDU_LABEL
/* A comment = "over
   two lines" */
^IMAGE = ("A.IMG", 3 <BYTES>)
EMPTY =
NEXT = 1 /* one */ SECOND = -2.5E-3 <km>
NOTE = "calib/*.img of
        two lines"
SYMBOL = 'N/A'
MESS:ATT = 16#FF#
TIME = 2014-217T12:00:00.25Z
BARE = 67P CHURYUMOV <none>
NESTED = ((1 <m>, 2), {3, "a b"}, (4,,
  'c'
  , 5)) <km>
NOTHING = ( )
object = IMAGE
  LINES = 4
  GROUP = INNER
    LINES = 5
    LAST =
  END_GROUP = INNER
End_Object
END
not a label (
"""


def test_all_forms_of_statements_are_read() -> None:
    root = [
        ("CCSD3ZF0000100000001NJPL3IF0PDS200000001", ("SFDU_LABEL",), ("",)),
        ("^IMAGE", ("A.IMG", "3"), ("", "BYTES")),
        ("EMPTY", (), ()),
        ("NEXT", ("1",), ("",)),
        ("SECOND", ("-2.5E-3",), ("km",)),
        ("NOTE", ("calib/*.img of two lines",), ("",)),
        ("SYMBOL", ("N/A",), ("",)),
        ("MESS:ATT", ("16#FF#",), ("",)),
        ("TIME", ("2014-217T12:00:00.25Z",), ("",)),
        ("BARE", ("67P CHURYUMOV",), ("none",)),
        ("NESTED", ("1", "2", "3", "a b", "4", "", "c", "5"), ("m", *("km",) * 7)),
        ("NOTHING", (), ()),
    ]
    inside = [
        Statement(("IMAGE",), "LINES", ("4",), ("",)),
        Statement(("IMAGE", "INNER"), "LINES", ("5",), ("",)),
        Statement(("IMAGE", "INNER"), "LAST", (), ()),
    ]
    assert read_statements(LABEL) == [Statement((), *statement) for statement in root] + inside


@pytest.mark.parametrize("ending", ["\r\n", "\r", " \n", "\n\n"])
def test_line_endings_change_nothing(ending: str) -> None:
    assert read_statements(LABEL.replace("\n", ending)) == read_statements(LABEL)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('A = 1\nB = "x', 'line 2: " has no end'),
        ("A = 1\nB = 5 <km", "line 2: < has no end"),
        ("A = (1, 2\nB = 3", "line 1: a sequence or set has no end"),
        ("A = 1\nstray words\nB = 2", "line 2: 'stray' is no statement"),
        ("A = )", r"line 1: '\)' is no value"),
        ("A = <km>", "line 1: 'km' is no value"),
        ("A = 1, 2", "line 1: ',' is no statement"),
        ('"A" = 1', "line 1: 'A' is no statement"),
    ],
)
def test_what_is_no_statement_is_named_with_its_line(text: str, message: str) -> None:
    with pytest.raises(OdlError, match=message):
        read_statements(text)


def test_a_comment_without_an_end_takes_its_line() -> None:
    statements = read_statements("A = 1 /* left open\nB = 2\n")
    assert [(s.key, s.texts) for s in statements] == [("A", ("1",)), ("B", ("2",))]
