"""Read the statements of PDS3 labels: the Object Description Language.

Source: PDS Standards Reference 3.8, chapter 12 (ODL 2.1). Read beyond it, as archives write them:
keywords without a value, texts without quotes, comments over several lines, a unit after a
sequence. Comments count outside of quotes only, and what follows END is no label.
"""

import re
from collections.abc import Iterator
from typing import NamedTuple

# One token; a text or a unit without its end, and a bracket, are matched by their first letter.
_TOKEN = re.compile(
    r"(?P<space>[\s\0]+)|(?P<comment>/\*)"
    r"|\"(?P<text>[^\"]*)\"|'(?P<symbol>[^']*)'|<(?P<unit>[^<>\n]*)>"
    r"|(?P<word>(?:[^\s\0=(){},<>\"'/]|/(?!\*))(?:[^\s\0=(){},<>\"/]|/(?!\*))*)|(?P<mark>.)"
)
_OPENING, _CLOSING = ("OBJECT", "GROUP", "BEGIN_OBJECT", "BEGIN_GROUP"), ("END_OBJECT", "END_GROUP")
_HEAD = re.compile(r"(CCSD|NJPL)\w{8,}")  # a standard formatted data unit's, without a value


class OdlError(ValueError):
    """A text that is not in the language; the message begins with its line."""


class Statement(NamedTuple):
    """A keyword with its values, sequences and sets flattened.

    blocks  names of the objects and groups about it, outermost first
    key     in upper case, with the caret of a pointer and the namespace
    texts   without quotes, runs of blanks and line ends being one blank; none: an empty value
    units   as they stand in <>, one a text; "" where none is stated
    """

    blocks: tuple[str, ...]
    key: str
    texts: tuple[str, ...]
    units: tuple[str, ...]


class _Token(NamedTuple):
    kind: str
    text: str
    line: int  # on which it ends


def read_statements(text: str) -> list[Statement]:
    """Read the statements of a label up to END. Raises OdlError for what is none."""
    return list(_Reader(text.replace("\r\n", "\n").replace("\r", "\n")).statements())


def _split_tokens(text: str) -> Iterator[_Token]:
    start, line, last_comment_end = 0, 1, text.rfind("*/")
    while start < len(text):
        match = _TOKEN.match(text, start)
        if match is None:  # the pattern takes every letter
            return
        kind, end = match.lastgroup or "mark", match.end()
        if kind == "comment":  # one without an end takes the rest of its line
            closed = last_comment_end >= end
            end = text.index("*/", end) + 2 if closed else (text + "\n").index("\n", end)
        elif kind == "mark" and match[0] in "\"'<":
            raise OdlError(f"line {line}: {match[0]} has no end; close the text or unit")
        line += text.count("\n", start, end)
        if kind not in ("space", "comment"):
            yield _Token(kind, match[kind], line)
        start = end


class _Reader:
    """Reads statement by statement, two tokens ahead."""

    def __init__(self, text: str) -> None:
        self._source = _split_tokens(text)
        self._next, self._second = self._read(), self._read()

    def _read(self) -> _Token:
        return next(self._source, _Token("end", "", 0))

    def _take(self) -> _Token:
        token, self._next, self._second = self._next, self._second, self._read()
        return token

    def _is_assignment(self) -> bool:
        """Whether the next token is a keyword with its equals sign."""
        return self._next.kind == "word" and self._second[:2] == ("mark", "=")

    def statements(self) -> Iterator[Statement]:
        blocks: list[str] = []
        while self._next.kind != "end":
            is_assignment, token = self._is_assignment(), self._take()
            key = token.text.upper()
            if not is_assignment:
                if key == "END" and token.kind == "word":
                    return
                if key in _CLOSING:
                    blocks = blocks[:-1]
                elif not _HEAD.fullmatch(key):
                    raise OdlError(
                        f"line {token.line}: '{token.text[:40]}' is no statement; wanted KEYWORD = "
                        "VALUE, or END after the last one"
                    )
                continue
            texts, units = self._read_values(token)
            if key in _OPENING:
                blocks = [*blocks, texts[0].upper() if texts else ""]
            elif key in _CLOSING:
                blocks = blocks[:-1]
            else:
                yield Statement(tuple(blocks), key, texts, units)

    def _read_values(self, key: _Token) -> tuple[tuple[str, ...], tuple[str, ...]]:
        """The values after a keyword, and their units."""
        self._take()  # the equals sign
        first = self._next
        is_closing = first.kind == "word" and first.text.upper() in ("END", *_CLOSING)
        if first.kind == "end" or self._is_assignment() or (is_closing and first.line > key.line):
            return (), ()
        if first[:2] in (("mark", "("), ("mark", "{")):
            elements = self._read_sequence()
        else:
            elements = [self._read_scalar(first)]
        return tuple(text for text, _ in elements), tuple(unit for _, unit in elements)

    def _read_scalar(self, first: _Token) -> tuple[str, str]:
        """A text or words to the end of their line, and the unit."""
        words: list[str] = []
        unit = ""
        line = first.line
        while self._next.kind in ("word", "text", "symbol", "unit"):
            is_more = self._next.kind == "unit" or first.kind == "word"
            if words and (not is_more or self._next.line > line or self._is_assignment()):
                break
            token = self._take()
            line = token.line
            if token.kind == "unit":
                unit = token.text.strip()
            else:
                words.append(token.text)
        if not words:
            raise OdlError(f"line {first.line}: '{first.text[:40]}' is no value")
        return " ".join(" ".join(words).split()), unit

    def _read_sequence(self) -> list[tuple[str, str]]:
        """The elements of a sequence or set, those of sequences in it included."""
        sequence, line = _Sequence(), self._next.line
        while True:
            token = self._take()
            if token.kind == "end" or token[:2] == ("mark", "="):
                raise OdlError(f"line {line}: a sequence or set has no end; close its bracket")
            sequence.take(token)
            if token.kind == "mark" and token.text in ")}":
                unit = self._take().text.strip() if self._next.kind == "unit" else ""
                if sequence.close(unit):
                    return sequence.elements


class _Sequence:
    """Collects the elements of sequences in one another."""

    def __init__(self) -> None:
        self.elements: list[tuple[str, str]] = []
        self._starts: list[int] = []  # of the open ones, as indices of their first elements
        self._words: list[str] = []
        self._unit = ""
        self._before = ""  # the mark before the element: "(", "," or ")"

    def take(self, token: _Token) -> None:
        """Take one token: a part of an element, or a mark."""
        if token.kind == "unit":
            self._unit = token.text.strip()
        elif token.kind in ("word", "text", "symbol"):
            self._words.append(token.text)
        elif token.kind == "mark":
            if token.text in "({":
                self._starts.append(len(self.elements))
            elif self._words or self._before == "," or (token.text, self._before) == (",", "("):
                self.elements.append((" ".join(" ".join(self._words).split()), self._unit))
            self._words, self._unit = [], ""
            self._before = token.text.replace("{", "(").replace("}", ")")

    def close(self, unit: str) -> bool:
        """Close the innermost sequence, whose unit holds where elements state none of their own.

        Returns whether it was the outermost one.
        """
        start = self._starts.pop()
        self.elements[start:] = [(text, stated or unit) for text, stated in self.elements[start:]]
        return not self._starts
