"""Read the keywords of VICAR labels: KEYWORD=VALUE at both ends of a picture.

Source: JPL, VICAR File Format (R. Deen). The label is LBLSIZE bytes long; where EOL is 1 it goes on
behind the last record. PROPERTY='NAME' and TASK='NAME' begin the groups of a property and of a
program that wrote to it.
"""

import re
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from catalog.errors import DataError

MAX_LABEL = 1 << 20
BEGINNING = b"LBLSIZE="
_PAIR = re.compile(
    r"\s*([A-Za-z][A-Za-z0-9_]*)\s*=\s*(\((?:'(?:[^']|'')*+'|[^')])*+\)|'(?:[^']|'')*+'|[^\s,()']+)"
)
_ELEMENT = re.compile(r"\s*('(?:[^']|'')*+'|[^\s,']+)\s*(?:,|$)")


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
