"""Differences of two catalogs as a table: every point that differs, one row each."""

import csv
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from catalog.control_point import Flag
from catalog.errors import OutputError
from catalog.store.compare import CERTIFICATE, Comparison, Side
from catalog.store.features import reasons_text
from catalog.store.partial import replacing
from catalog.store.records import Record

FIRST_COLUMNS = ("id", "change", "moved_m", "radius_change_m", "height_max_m", "height_rms_m")
LISTS = ("uniqueness", "shadow_limit_deg")  # told by their largest difference


def write_table(found: Comparison, path: Path) -> int:
    """Write every point that differs to a CSV file, in the order of ids; returns their number.

    Raises OutputError for a
    place that cannot be written or an existing file that is no such table.
    """
    start = ",".join(FIRST_COLUMNS)

    def ours(old: Path) -> bool:
        with old.open("rb") as file:
            return file.read(len(start)) == start.encode()

    rows = sorted(_rows(found), key=lambda row: int(str(row["id"])))
    names = [*FIRST_COLUMNS, "nodes_in_one_only"]
    for name in ("lat_deg", "lon_deg", "usable", "reasons", "source", *CERTIFICATE):
        names += [f"{name}_change"] if name in LISTS else [f"{name}_first", f"{name}_second"]
    with replacing(path, ours) as partial:
        try:
            with partial.open("w", encoding="utf-8", newline="") as file:
                table = csv.DictWriter(file, names, restval="", lineterminator="\n")
                table.writeheader()
                table.writerows(rows)
        except OSError as error:
            raise OutputError(f"{path}: cannot be written: {error.strerror}") from error
    return len(rows)


def _rows(found: Comparison) -> Iterator[dict[str, object]]:
    for suffix, side in (("first", found.first), ("second", found.second)):
        for record in side.only:
            row: dict[str, object] = {"id": int(record["id"]), "change": f"only in {suffix}"}
            yield row | _columns(side, record, suffix)
    lists = {name: found.field_change(name) for name in LISTS}
    for number, (before, after) in enumerate(zip(found.before, found.after)):
        row = {
            "id": int(before["id"]),
            "change": "differs",
            "moved_m": f"{found.moved_m[number]:.3f}",
            "radius_change_m": _text(float(after["radius_m"] - before["radius_m"]), ".3f"),
            "height_max_m": _text(float(found.height_max_m[number]), ".3f"),
            "height_rms_m": _text(float(found.height_rms_m[number]), ".3f"),
            "nodes_in_one_only": int(found.holes[number]),
        }
        row |= {f"{name}_change": _text(float(lists[name][number]), ".4g") for name in LISTS}
        yield (
            row | _columns(found.first, before, "first") | _columns(found.second, after, "second")
        )


def _columns(side: Side, record: Record, suffix: str) -> dict[str, object]:
    """What one catalog says about a point."""
    columns: dict[str, object] = {
        "usable": int(record["usable"]),
        "reasons": reasons_text(Flag(int(record["flags"]))),
        "source": side.meta.point_sources[int(record["source"])],
    }
    for name in ("lat_deg", "lon_deg", *CERTIFICATE):
        if name not in LISTS:
            columns[name] = _text(float(record[name]), ".10g")
    return {f"{name}_{suffix}": value for name, value in columns.items()}


def _text(value: float, form: str) -> str:
    """A number, empty for unknown."""
    return format(value, form) if np.isfinite(value) else ""
