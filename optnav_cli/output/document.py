"""JSON documents for programs: what `--json` prints, and the files of figures beside a run."""

import json
import math
from collections.abc import Iterable, Mapping
from pathlib import Path

import numpy as np


def json_text(document: Mapping[str, object]) -> str:
    """A document as JSON, indented, keys in their order.

    Numbers that do not exist (NaN, infinities) are null. The text is ASCII, so that it can be
    printed in any locale, whatever the names of files in it.
    """
    return json.dumps(_plain(document), indent=2, allow_nan=False)


def _plain(value: object) -> object:
    """A value as JSON knows it. Raises TypeError for what has no place in a document."""
    if isinstance(value, np.ndarray | np.generic):
        value = value.tolist()
    if value is None or isinstance(value, str | int):
        return value
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, Path):
        return str(value)
    if isinstance(value, Mapping):
        return {str(key): _plain(inner) for key, inner in value.items()}
    if isinstance(value, Iterable):
        return [_plain(inner) for inner in value]
    raise TypeError(f"{value!r} has no place in a document")
