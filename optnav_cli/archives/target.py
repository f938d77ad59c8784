"""The body that a label's target names."""

import re
from collections.abc import Sequence

MIN_CUT = 8  # letters of a target's name that is cut
MIN_WITHIN = 4  # of a name inside a word, as in "433eros": "io" is in "dione"


def find_target_body(target: str, names: Sequence[str]) -> str:
    """The body that a label's target names, or nothing.

    target  lower case: "101955 bennu", "67p/churyumov-gerasimenko", and cut to eight letters by
            some archives, "enceladu"
    """
    words = re.findall(r"[a-z0-9]+", target)
    for name in names:
        if name in words:
            return name
    for name in names:
        if any(len(word) >= MIN_CUT and name.startswith(word) for word in words):
            return name
    within = [name for name in names if name in target and len(name) >= MIN_WITHIN]
    return max(within, key=len, default="")
