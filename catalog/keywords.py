"""The rule of all readers: what a file says about its numbers is used, or the file is refused.

Unit, scale, no-data, mask, datum, direction, axes, time system, interpolation, row order,
orientation, coding: none of these is read past. Each reader has a table `KEYWORDS` of the keywords
of its format with one of four fates:

used      the reader applies the value, or checks it and refuses what it cannot apply
refused   the file is refused with the keyword, its value and the remedy
reported  the value cannot change a number here, but people should know it: one remark
harmless  the value changes no number that is read

`tests/test_keywords.py` lists all tables, so that a new reader or keyword has to be decided.
"""

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Literal, NamedTuple

from catalog.errors import DataError

MAX_SHOWN = 40  # letters of a value that a message quotes


class Keyword(NamedTuple):
    """A keyword's fate, and why: the remedy of a refusal, else what is done with the value.

    allowed  values (upper case) that say nothing unusual and are passed; of refused and reported
             keywords
    """

    fate: Literal["used", "refused", "reported", "harmless"]
    why: str
    allowed: tuple[str, ...] = ()


Keywords = Mapping[str, Keyword]


def check_keywords(path: Path, stated: Iterable[tuple[str, str]], keywords: Keywords) -> list[str]:
    """Check what a file states against a reader's table; return the remarks to show.

    stated    keywords with their values as text, as the file writes them; a keyword that is not in
              the table is passed over
    Raises DataError with keyword, value and remedy for the first one that is refused.
    """
    remarks = []
    for name, value in stated:
        keyword = keywords.get(name)
        if keyword is None or value.strip().upper() in keyword.allowed:
            continue
        shown = f"{name} = {value.strip()[:MAX_SHOWN]}"
        if keyword.fate == "refused":
            raise DataError(f"{path}: states {shown}; {keyword.why}")
        if keyword.fate == "reported":
            remarks.append(f"{path.name} states {shown}: {keyword.why}")
    return remarks
