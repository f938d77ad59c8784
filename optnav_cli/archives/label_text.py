"""Read the text of archive labels: PDS3 (Object Description Language), VICAR and PDS4 (XML).

Source: PDS Standards Reference 3.8, chapter 12 (ODL 2.1). Read beyond it, as archives write them:
keywords without a value, texts without quotes, comments over several lines, a unit after a
sequence. Comments count outside of quotes only, and what follows END is no label.
"""

import re
from collections import Counter, deque
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import NamedTuple
from xml.etree import ElementTree

from catalog.errors import DataError

# One token; a text or a unit without its end, and a bracket, are matched by their first letter.
_TOKEN = re.compile(
    r"(?P<space>[\s\0]+)|(?P<comment>/\*)"
    r"|\"(?P<text>[^\"]*)\"|'(?P<symbol>[^']*)'|<(?P<unit>[^<>\n]*)>"
    r"|(?P<word>(?:[^\s\0=(){},<>\"'/]|/(?!\*))(?:[^\s\0=(){},<>\"/]|/(?!\*))*)|(?P<mark>.)"
)
_OPENING, _CLOSING = ("OBJECT", "GROUP", "BEGIN_OBJECT", "BEGIN_GROUP"), ("END_OBJECT", "END_GROUP")
_HEAD = re.compile(r"(CCSD|NJPL)\w{8,}")  # a standard formatted data unit's, without a value
MAX_LABEL = 1 << 20
BEGINNING = b"LBLSIZE="
_PAIR = re.compile(
    r"\s*([A-Za-z][A-Za-z0-9_]*)\s*=\s*(\((?:'(?:[^']|'')*+'|[^')])*+\)|'(?:[^']|'')*+'|[^\s,()']+)"
)
_ELEMENT = re.compile(r"\s*('(?:[^']|'')*+'|[^\s,']+)\s*(?:,|$)")
MAX_DEPTH = 64  # of elements in elements
_INDEX = re.compile(r"\[\d+\]")
_CONDITION = re.compile(r"\[([^\]=]+)=([^\]]*)\]")
_SEGMENT = re.compile(r"/(?![^\[]*\])")  # a slash outside of conditions


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


class Pair(NamedTuple):
    """A keyword with its values and the group that it is in, "" for that of the system."""

    group: str
    key: str
    texts: tuple[str, ...]


def read_pairs(path: Path) -> list[Pair]:
    """Read the keywords of a label in their order. Raises DataError for a damaged label."""
    try:
        with path.open("rb") as file:
            head = file.read(MAX_LABEL)
            size = re.match(rb"LBLSIZE=\s*(\d{1,7})\s", head)
            if size is None:
                raise DataError(f"{path}: is no VICAR picture: LBLSIZE is no number")
            pairs = list(_parse_pairs(path, head[: int(size[1])]))
            end = _find_second_label(path, pairs, int(size[1]))
            if end is not None:
                file.seek(end)
                again = re.match(rb"LBLSIZE=\s*(\d{1,7})\s", tail := file.read(MAX_LABEL))
                if again is None:
                    raise DataError(f"{path}: its second label is missing: the file is cut short")
                pairs += _parse_pairs(path, tail[: int(again[1])])
    except OSError as error:
        raise DataError(f"{path}: cannot be read ({error.strerror})") from None
    return pairs


def _parse_pairs(path: Path, raw: bytes) -> Iterator[Pair]:
    text = raw.decode("latin-1").rstrip("\0 \r\n\t")
    start, group = 0, ""
    while start < len(text):
        match = _PAIR.match(text, start)
        if match is None:
            raise DataError(
                f"{path}: is a damaged VICAR label: '{text[start : start + 40].strip()}' is no "
                "KEYWORD=VALUE"
            )
        key, value, start = match[1].upper(), match[2], match.end()
        texts = tuple(
            map(_strip_quotes, _ELEMENT.findall(value[1:-1]) if value[0] == "(" else [value])
        )
        if key in ("PROPERTY", "TASK"):
            group = texts[0].upper() if texts else ""
        else:
            yield Pair(group, key, texts)


def _strip_quotes(text: str) -> str:
    inner = text[1:-1].replace("''", "'") if text[:1] == "'" else text
    return inner.strip()


def _find_second_label(path: Path, pairs: list[Pair], label_bytes: int) -> int | None:
    """Where the label behind the picture begins; None where there is none."""
    stated = {pair.key: pair.texts[0] for pair in reversed(pairs) if pair.texts and not pair.group}
    if stated.get("EOL", "0") != "1":
        return None
    try:
        record, before, lines, bands = (int(stated[key]) for key in ("RECSIZE", "NLB", "N2", "N3"))
    except (KeyError, ValueError):
        raise DataError(f"{path}: is a damaged VICAR label: RECSIZE, NLB, N2 or N3") from None
    if min(record, before, lines, bands) < 0 or max(record, before, lines, bands) > 10**9:
        raise DataError(f"{path}: is a damaged VICAR label: RECSIZE, NLB, N2 or N3")
    return label_bytes + record * (before + lines * bands)


def read_elements(path: Path, text: str) -> Iterator[tuple[str, str, str]]:
    """Read path, text and unit of every element that holds no other, those near the root first.

    Of siblings of one name the second and later ones have their number in the path, as "A/B[2]/c".
    Raises DataError for damaged XML, and for XML that refers to other texts.
    """
    if "<!DOCTYPE" in text or "<!ENTITY" in text:
        raise DataError(f"{path}: is no plain PDS4 label")
    try:
        root = ElementTree.fromstring(text.encode("utf-8"))
    except ElementTree.ParseError as error:
        raise DataError(f"{path}: is a damaged PDS4 label ({error})") from None
    waiting = deque([(root, _strip_namespace(root), 0)])
    while waiting:
        element, name, depth = waiting.popleft()
        if depth > MAX_DEPTH:
            raise DataError(f"{path}: is no PDS4 label: elements in elements, too deep")
        if len(element) == 0:
            yield name, (element.text or "").strip(), element.get("unit", "").strip()
        seen: Counter[str] = Counter()
        for child in element:
            tag = _strip_namespace(child)
            seen[tag] += 1
            index = f"[{seen[tag]}]" if seen[tag] > 1 else ""
            waiting.append((child, f"{name}/{tag}{index}", depth + 1))


def _strip_namespace(element: ElementTree.Element) -> str:
    return element.tag.rpartition("}")[2] if isinstance(element.tag, str) else "comment"


def find_elements(values: Mapping[str, tuple[str, ...]], key: str) -> list[str]:
    """Find the paths that end as `key` does, as "Vector[Frame/name=J2000]/x".

    A condition in brackets holds where the element has one in it of this path and text.
    """
    ends, last = _CONDITION.sub("", key), _SEGMENT.split(_CONDITION.sub("", key))[-1]
    return [
        name
        for name in values
        if last in name
        and f"/{_INDEX.sub('', name)}".endswith(f"/{ends}")
        and _has_conditions(values, name, key)
    ]


def _has_conditions(values: Mapping[str, tuple[str, ...]], name: str, key: str) -> bool:
    segments, wanted = name.split("/"), _SEGMENT.split(key)
    for number, segment in enumerate(wanted):
        base = "/".join(segments[: len(segments) - len(wanted) + number + 1])
        for inner, text in _CONDITION.findall(segment):
            stated = values.get(f"{base}/{inner}", ("",))[0]
            if stated.upper() != text.strip().upper():
                return False
    return True
