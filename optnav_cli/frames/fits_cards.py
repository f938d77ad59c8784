"""Cards of FITS headers: keyword, value, comment.

Sources: FITS standard 4.0, 4.1 and 4.2.1.2 (CONTINUE: a text longer than its card); the registered
convention HIERARCH of ESO, whose keywords are words: HIERARCH ESO TEL ALT = 12.5 is ESO TEL ALT.
"""

import re
from collections.abc import Iterator

CARD = 80  # bytes
_HIERARCH = re.compile(r"HIERARCH +([^=/']*[^=/' ]) *=(.*)", re.DOTALL)
_QUOTED = re.compile(r"'((?:[^']|'')*)'")


def read_cards(header: bytes) -> Iterator[tuple[str, str, str]]:
    """Keyword, value as text without its quotes, and comment of the cards that have a value."""
    held: tuple[str, str, str] | None = None  # a text that a card more may continue
    for start in range(0, len(header), CARD):
        card = header[start : start + CARD].decode("latin-1")
        if card.startswith("CONTINUE  ") and held is not None and held[1].endswith("&"):
            text, comment, _ = _split_value(card[10:])
            held = held[0], held[1][:-1] + text, f"{held[2]} {comment}".strip()
            continue
        if held is not None:
            yield held[0], held[1].strip(), held[2]
            held = None
        long = _HIERARCH.fullmatch(card)
        if card[8:10] != "= " and long is None:
            continue
        key, after = (long[1], long[2]) if long is not None else (card[:8].strip(), card[10:])
        text, comment, is_text = _split_value(after)
        if is_text:
            held = " ".join(key.split()), text, comment
        else:
            yield " ".join(key.split()), text, comment
    if held is not None:
        yield held[0], held[1].strip(), held[2]


def _split_value(text: str) -> tuple[str, str, bool]:
    """Value and comment of the part of a card after the sign, and whether it is a quoted text."""
    text = text.strip()
    quoted = _QUOTED.match(text)
    if quoted is None:
        text, _, comment = text.partition("/")
        return text.strip(), comment.strip(), False
    comment = text[quoted.end() :].partition("/")[2].strip()
    # spaces before a text count, those after it do not (4.2.1.1)
    return quoted[1].replace("''", "'").rstrip(), comment, True
