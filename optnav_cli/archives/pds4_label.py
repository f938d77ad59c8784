"""Read the elements of PDS4 labels: XML, by the paths of their names without namespaces."""

import re
from collections import Counter, deque
from collections.abc import Iterator, Mapping
from pathlib import Path
from xml.etree import ElementTree

from catalog.errors import DataError

MAX_DEPTH = 64  # of elements in elements
_INDEX = re.compile(r"\[\d+\]")
_CONDITION = re.compile(r"\[([^\]=]+)=([^\]]*)\]")
_SEGMENT = re.compile(r"/(?![^\[]*\])")  # a slash outside of conditions


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
