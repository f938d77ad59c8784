"""What two manifests tell apart: content, and what does not count as content."""

import tomllib
from collections.abc import Iterator, Mapping
from typing import NamedTuple

from catalog.store.manifest import CatalogMeta, ReliefMeta

CONTENT = ("body", "radius_m", "cell_deg", "levels", "size", "posting_m", "height_step_m")
OF_THE_MOMENT = ("software", "created_utc")
NOTHING = "none"


class Change(NamedTuple):
    """A setting that differs; "none" where one catalog has none."""

    name: str
    first: str
    second: str


def content_changes(first: CatalogMeta, second: CatalogMeta) -> tuple[Change, ...]:
    """Settings that differ and are part of the content digest."""
    one, other = (
        {name: str(getattr(meta, name)) for name in CONTENT}
        | {"point_sources": ", ".join(meta.point_sources)}
        | ({"relief": _relief(meta.relief)} if meta.relief is not None else {})
        | ({"planes": str(meta.planes.rounded())} if meta.planes is not None else {})
        for meta in (first, second)
    )
    return tuple(_changes(one, other))


def provenance_changes(first: CatalogMeta, second: CatalogMeta) -> tuple[Change, ...]:
    """What else differs: program, time, hashes of terrain models, values of the build config."""
    one, other = (
        {name: str(getattr(meta, name)) for name in OF_THE_MOMENT}
        | {f"source {name}": text for name, text in meta.sources.items()}
        | _config_values(meta.config)
        for meta in (first, second)
    )
    return tuple(_changes(one, other))


def _relief(relief: ReliefMeta) -> str:
    return f"{relief.rows} rows of {relief.source} ({relief.digest[:12]})"


def _changes(one: Mapping[str, str], other: Mapping[str, str]) -> Iterator[Change]:
    for name in [*one, *(name for name in other if name not in one)]:
        change = Change(name, one.get(name, NOTHING), other.get(name, NOTHING))
        if change.first != change.second:
            yield change


def _config_values(text: str) -> dict[str, str]:
    """Values of a config under names as "config check.trials"; one line where it is no TOML."""
    try:
        return dict(_flat("config", tomllib.loads(text)))
    except tomllib.TOMLDecodeError:
        return {"config": " ".join(text.split())}


def _flat(name: str, value: object) -> Iterator[tuple[str, str]]:
    if isinstance(value, dict):
        separator = " " if name == "config" else "."
        for key, inner in value.items():
            yield from _flat(f"{name}{separator}{key}", inner)
    elif isinstance(value, list) and any(isinstance(inner, dict) for inner in value):
        for number, inner in enumerate(value, start=1):
            yield from _flat(f"{name}[{number}]", inner)
    else:
        yield name, str(value)
