"""Differences of two catalogs in words, for people and the logs of pipelines."""

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np

from catalog.arrays import BoolArray, FloatArray, IndexArray
from catalog.control_point import Flag
from catalog.files import replacing_file, starts_with
from catalog.inspect.compare import CERTIFICATE, LISTS, SCORES, ComparedCatalog, Comparison
from catalog.inspect.summary import Document
from catalog.store.records import Record
from catalog.tables import CsvColumn, CsvTable

SHOWN = 10  # lines a kind; the table (`difference_table`) has all


def summary(comparison: Comparison) -> str:
    """Summarise the differences in one line; "" without any."""
    words = {
        "only_in_first": f"points only in {comparison.first.path.name}",
        "only_in_second": f"points only in {comparison.second.path.name}",
        "usable": "usable or no longer",
    }
    return ", ".join(
        f"{words.get(what, what.replace('_', ' '))}: {number}"
        for what, number in counts(comparison).items()
        if number
    )


def counts(comparison: Comparison) -> dict[str, int]:
    """Count the settings that differ, and the points by kind of difference."""
    moved, usable = comparison.moved_m > 0.0, comparison.field_changed("usable")
    reasons = comparison.field_changed("flags") & ~usable
    certificate = np.any([comparison.field_changed(name) for name in CERTIFICATE], axis=0)
    return {
        "settings": len(comparison.settings),
        "only_in_first": len(comparison.first.only),
        "only_in_second": len(comparison.second.only),
        "moved": int(moved.sum()),
        "usable": int(usable.sum()),
        "other_reasons": int(reasons.sum()),
        "other_radius_in_place": int((comparison.field_changed("radius_m") & ~moved).sum()),
        "other_heights_in_place": int((comparison.patches & ~moved).sum()),
        "other_certificate": int(certificate.sum()),
        "other_terrain_model": int(comparison.field_changed("source").sum()),
    }


def comparison_document(comparison: Comparison) -> Document:
    """The differences as plain values; each point that differs has the columns of the table."""
    sides = {"first": comparison.first, "second": comparison.second}
    return {
        "same": comparison.same,
        **{
            name: {
                "catalog": str(side.path),
                "points": side.meta.count,
                "usable": side.meta.usable,
                "digest": side.meta.digest,
            }
            for name, side in sides.items()
        },
        "comparable": comparison.comparable,
        "counts": counts(comparison),
        "settings": [change._asdict() for change in comparison.settings],
        "not_content": [change._asdict() for change in comparison.provenance],
        "relief": comparison.relief and comparison.relief._asdict(),
        "points": [dict.fromkeys(DIFFERENCES.names) | row for row in _sorted_rows(comparison)],
    }


def lines(comparison: Comparison) -> Iterator[str]:
    """The differences, a kind after the other, the greatest of each first."""
    for name, side in (("first", comparison.first), ("second", comparison.second)):
        meta = side.meta
        yield f"{name}: {side.path}: {meta.count} control points, {meta.usable} usable"
        yield f"{name}_digest: {meta.digest}"
    for change in comparison.provenance[:SHOWN]:
        yield f"not content: {change.name}: {change.first} -> {change.second}"
    if len(comparison.provenance) > SHOWN:
        yield f"not content: and {len(comparison.provenance) - SHOWN} more"
    for change in comparison.settings:
        yield f"setting: {change.name}: {change.first} -> {change.second}"
    if not comparison.comparable:
        yield "points: not compared: their ids are cells of other grids"
    if comparison.relief is not None:
        relief = comparison.relief
        yield (
            f"relief: {relief.cells} cells, means max {relief.mean_max_m:.3f} m, rms "
            f"{relief.mean_rms_m:.3f} m, tops max {relief.top_max_m:.3f} m"
        )
    for side in (comparison.first, comparison.second):
        yield from _alone(side)
    yield from _places(comparison)
    yield from _use(comparison)
    yield from _heights(comparison)
    yield from _certificates(comparison)


def _alone(side: ComparedCatalog) -> Iterator[str]:
    if len(side.only):
        yield f"only in {side.path}: {_points(len(side.only))}"
        yield from _shortened(
            list(side.only), lambda r: f"{r['id']}: at {r['lat_deg']:.5f}, {r['lon_deg']:.5f}"
        )


def _places(comparison: Comparison) -> Iterator[str]:
    moved = comparison.moved_m[comparison.moved_m > 0.0]
    if len(moved):
        spread = f"median {np.median(moved):.3f} m, max {moved.max():.3f} m"
        yield f"moved: {_points(len(moved))}, {spread}"
        yield from _greatest(comparison, comparison.moved_m > 0.0, "{:.3f} m", comparison.moved_m)
    radius = comparison.after["radius_m"] - comparison.before["radius_m"]
    still = comparison.field_changed("radius_m") & (comparison.moved_m == 0.0)
    if still.any():
        yield f"radius of points in place: {_points(still.sum())}, {_largest(radius[still])} m"
        yield from _greatest(comparison, still, "{:+.3f} m", radius)


def _use(comparison: Comparison) -> Iterator[str]:
    before, after = comparison.before["usable"] != 0, comparison.after["usable"] != 0
    for name, chosen in (
        ("no longer usable", before & ~after),
        ("newly usable", after & ~before),
        ("other reasons", comparison.field_changed("flags") & (before == after)),
    ):
        yield from _pairs(name, comparison, chosen, lambda _, record: _state(record))
    yield from _pairs(
        "other terrain model", comparison, comparison.field_changed("source"), _source
    )


def _pairs(
    name: str,
    comparison: Comparison,
    chosen: BoolArray,
    text: Callable[[ComparedCatalog, Record], str],
) -> Iterator[str]:
    """A line with the number of chosen points, and what each is in both catalogs."""
    rows = np.flatnonzero(chosen)
    if rows.size:
        yield f"{name}: {_points(rows.size)}"
        yield from _shortened(
            rows,
            lambda row: (
                f"{comparison.ids[row]}: {text(comparison.first, comparison.before[row])} -> "
                f"{text(comparison.second, comparison.after[row])}"
            ),
        )


def _heights(comparison: Comparison) -> Iterator[str]:
    changed = comparison.patches & (comparison.moved_m == 0.0)
    if not changed.any():
        return
    largest = comparison.height_max_m[changed]
    known = np.isfinite(largest)
    text = f"heights of points in place: {_points(changed.sum())}"
    if known.any():
        squares = np.square(comparison.height_rms_m[changed][known])
        text += f", max {largest[known].max():.3f} m, rms {np.sqrt(squares.mean()):.3f} m"
    if not known.all():
        text += f", {np.count_nonzero(~known)} of another shape or without common nodes"
    if comparison.holes[changed].any():
        text += f", {comparison.holes[changed].sum()} nodes with a height in one only"
    yield text
    sizes = comparison.height_max_m, comparison.height_rms_m
    yield from _greatest(comparison, changed, "max {:.3f} m, rms {:.3f} m", *sizes)


def _certificates(comparison: Comparison) -> Iterator[str]:
    for name in CERTIFICATE:
        chosen = comparison.field_changed(name)
        if chosen.any():
            change = comparison.field_change(name)
            yield f"{name}: {_points(chosen.sum())}, {_largest(change[chosen])}"
            yield from _greatest(comparison, chosen, "by {:.4g}", change)


def _largest(changes: FloatArray) -> str:
    """The median and the largest of some changes, those from or to unknown aside."""
    sizes = np.abs(changes[np.isfinite(changes)])
    unknown = len(changes) - len(sizes)
    parts = [f"median {np.median(sizes):.4g}, max {sizes.max():.4g}"] if len(sizes) else []
    return ", ".join(parts + ([f"{unknown} known in one only"] if unknown else []))


def _greatest(
    comparison: Comparison, chosen: BoolArray, form: str, *sizes: FloatArray
) -> Iterator[str]:
    """Lines of the chosen points with the largest of the first sizes."""
    rows = np.flatnonzero(chosen)
    known = np.nan_to_num(np.abs(sizes[0][rows]), nan=np.inf)
    rows = rows[np.argsort(-known, kind="stable")]
    form = f"{{}}: {form}"
    yield from _shortened(
        rows, lambda row: form.format(*(a[row] for a in (comparison.ids, *sizes)))
    )


def _points(number: int | np.integer[Any]) -> str:
    return f"{number} point" if number == 1 else f"{number} points"


def _shortened(items: Sequence[Any] | IndexArray, text: Callable[[Any], str]) -> Iterator[str]:
    yield from (f"  {text(item)}" for item in items[:SHOWN])
    if len(items) > SHOWN:
        yield f"  and {len(items) - SHOWN} more"


def _state(record: Record) -> str:
    reasons = Flag(int(record["flags"])).label
    state = "usable" if record["usable"] else "not usable"
    return f"{state} ({reasons})" if reasons else state


def _source(side: ComparedCatalog, record: Record) -> str:
    return side.meta.point_sources[int(record["source"])] or "none"


def _pair(name: str, meaning: str, kind: Literal["text", "number"], form: str) -> list[CsvColumn]:
    return [
        CsvColumn(f"{name}_{which}", f"{meaning} in the {which}", kind, form=form, empty=True)
        for which in ("first", "second")
    ]


DIFFERENCES = CsvTable(
    (
        CsvColumn("id", "the control point's id", "count"),
        CsvColumn("change", "differs, only in first or only in second", "text"),
        CsvColumn("moved_m", "how far its place moved", unit="m", form=".3f", empty=True),
        CsvColumn("radius_change_m", "second radius less first", unit="m", form=".3f", empty=True),
        CsvColumn("height_max_m", "largest change of a height", unit="m", form=".3f", empty=True),
        CsvColumn("height_rms_m", "rms change of its heights", unit="m", form=".3f", empty=True),
        CsvColumn("nodes_in_one_only", "nodes with a height in one only", "count", empty=True),
        *_pair("lat_deg", "latitude", "number", ".10g"),
        *_pair("lon_deg", "longitude", "number", ".10g"),
        *_pair("usable", "1 for a usable point", "text", ""),
        *_pair("reasons", "why it is not usable", "text", ""),
        *_pair("source", "terrain model", "text", ""),
        *(column for name in SCORES for column in _pair(name, name, "number", ".10g")),
        *(
            CsvColumn(f"{name}_change", f"largest change of {name}", form=".4g", empty=True)
            for name in LISTS
        ),
    )
)


is_table = starts_with(",".join(DIFFERENCES.names[:6]).encode())


def write_table(comparison: Comparison, path: Path) -> int:
    """Write every point that differs to a CSV file, in the order of ids; returns their number.

    Raises OutputError for a place that cannot be written or an existing file that is no such table.
    """
    with replacing_file(path, is_table) as new:
        return DIFFERENCES.write(new, _sorted_rows(comparison))


def _sorted_rows(comparison: Comparison) -> list[Document]:
    return sorted(_rows(comparison), key=lambda row: int(row["id"]))


def _rows(comparison: Comparison) -> Iterator[Document]:
    for suffix, side in (("first", comparison.first), ("second", comparison.second)):
        for record in side.only:
            row: Document = {"id": int(record["id"]), "change": f"only in {suffix}"}
            yield row | _columns(side, record, suffix)
    lists = {name: comparison.field_change(name) for name in LISTS}
    for number, (before, after) in enumerate(zip(comparison.before, comparison.after)):
        row = {
            "id": int(before["id"]),
            "change": "differs",
            "moved_m": float(comparison.moved_m[number]),
            "radius_change_m": float(after["radius_m"] - before["radius_m"]),
            "height_max_m": float(comparison.height_max_m[number]),
            "height_rms_m": float(comparison.height_rms_m[number]),
            "nodes_in_one_only": int(comparison.holes[number]),
        }
        row |= {f"{name}_change": float(lists[name][number]) for name in LISTS}
        row |= _columns(comparison.first, before, "first")
        yield row | _columns(comparison.second, after, "second")


def _columns(side: ComparedCatalog, record: Record, suffix: str) -> Document:
    """Return the columns of the table that describe a point in one catalog."""
    columns: Document = {
        "usable": int(record["usable"]),
        "reasons": Flag(int(record["flags"])).label,
        "source": side.meta.point_sources[int(record["source"])],
    }
    columns |= {name: float(record[name]) for name in ("lat_deg", "lon_deg", *SCORES)}
    return {f"{name}_{suffix}": value for name, value in columns.items()}
