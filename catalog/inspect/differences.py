"""Differences of two catalogs in words, for people and the logs of pipelines."""

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np

from catalog.arrays import BoolArray, FloatArray, IndexArray
from catalog.control_point import Flag
from catalog.files import make_prefix_test, replace_file
from catalog.inspect.compare import CERTIFICATE, LISTS, SCORES, ComparedCatalog, Comparison
from catalog.inspect.summary import Document
from catalog.store.records import Record
from catalog.tables import CsvColumn, CsvTable

SHOWN = 10  # lines a kind; the table (`difference_table`) has all


def summarise(comparison: Comparison) -> str:
    """Summarise the differences in one line; "" without any."""
    words = {
        "only_in_first": f"points only in {comparison.first.path.name}",
        "only_in_second": f"points only in {comparison.second.path.name}",
        "usable": "usable or no longer",
    }
    return ", ".join(
        f"{words.get(what, what.replace('_', ' '))}: {number}"
        for what, number in count_differences(comparison).items()
        if number
    )


def count_differences(comparison: Comparison) -> dict[str, int]:
    """Count the settings that differ, and the points by kind of difference."""
    moved, usable = comparison.moved_m > 0.0, comparison.mark_changed("usable")
    reasons = comparison.mark_changed("flags") & ~usable
    certificate = np.any([comparison.mark_changed(name) for name in CERTIFICATE], axis=0)
    return {
        "settings": len(comparison.settings),
        "only_in_first": len(comparison.first.only),
        "only_in_second": len(comparison.second.only),
        "moved": int(moved.sum()),
        "usable": int(usable.sum()),
        "other_reasons": int(reasons.sum()),
        "other_radius_in_place": int((comparison.mark_changed("radius_m") & ~moved).sum()),
        "other_heights_in_place": int((comparison.patches & ~moved).sum()),
        "other_certificate": int(certificate.sum()),
        "other_terrain_model": int(comparison.mark_changed("source").sum()),
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
        "counts": count_differences(comparison),
        "settings": [change._asdict() for change in comparison.settings],
        "not_content": [change._asdict() for change in comparison.provenance],
        "relief": comparison.relief and comparison.relief._asdict(),
        "points": [dict.fromkeys(DIFFERENCES.names) | row for row in _sort_rows(comparison)],
    }


def format_lines(comparison: Comparison) -> Iterator[str]:
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
        yield from _describe_unshared(side)
    yield from _describe_moves(comparison)
    yield from _describe_use(comparison)
    yield from _describe_heights(comparison)
    yield from _describe_certificates(comparison)


def _describe_unshared(side: ComparedCatalog) -> Iterator[str]:
    if len(side.only):
        yield f"only in {side.path}: {_format_count(len(side.only))}"
        yield from _list_first(
            list(side.only), lambda r: f"{r['id']}: at {r['lat_deg']:.5f}, {r['lon_deg']:.5f}"
        )


def _describe_moves(comparison: Comparison) -> Iterator[str]:
    moved = comparison.moved_m[comparison.moved_m > 0.0]
    if len(moved):
        spread = f"median {np.median(moved):.3f} m, max {moved.max():.3f} m"
        yield f"moved: {_format_count(len(moved))}, {spread}"
        yield from _list_greatest(
            comparison, comparison.moved_m > 0.0, "{:.3f} m", comparison.moved_m
        )
    radius = comparison.after["radius_m"] - comparison.before["radius_m"]
    still = comparison.mark_changed("radius_m") & (comparison.moved_m == 0.0)
    if still.any():
        changes = _summarise_changes(radius[still])
        yield f"radius of points in place: {_format_count(still.sum())}, {changes} m"
        yield from _list_greatest(comparison, still, "{:+.3f} m", radius)


def _describe_use(comparison: Comparison) -> Iterator[str]:
    before, after = comparison.before["usable"] != 0, comparison.after["usable"] != 0
    for name, chosen in (
        ("no longer usable", before & ~after),
        ("newly usable", after & ~before),
        ("other reasons", comparison.mark_changed("flags") & (before == after)),
    ):
        yield from _describe_pairs(
            name, comparison, chosen, lambda _, record: _describe_state(record)
        )
    yield from _describe_pairs(
        "other terrain model", comparison, comparison.mark_changed("source"), _find_source
    )


def _describe_pairs(
    name: str,
    comparison: Comparison,
    chosen: BoolArray,
    text: Callable[[ComparedCatalog, Record], str],
) -> Iterator[str]:
    """A line with the number of chosen points, and what each is in both catalogs."""
    rows = np.flatnonzero(chosen)
    if rows.size:
        yield f"{name}: {_format_count(rows.size)}"
        yield from _list_first(
            rows,
            lambda row: (
                f"{comparison.ids[row]}: {text(comparison.first, comparison.before[row])} -> "
                f"{text(comparison.second, comparison.after[row])}"
            ),
        )


def _describe_heights(comparison: Comparison) -> Iterator[str]:
    changed = comparison.patches & (comparison.moved_m == 0.0)
    if not changed.any():
        return
    largest = comparison.height_max_m[changed]
    known = np.isfinite(largest)
    text = f"heights of points in place: {_format_count(changed.sum())}"
    if known.any():
        squares = np.square(comparison.height_rms_m[changed][known])
        text += f", max {largest[known].max():.3f} m, rms {np.sqrt(squares.mean()):.3f} m"
    if not known.all():
        text += f", {np.count_nonzero(~known)} of another shape or without common nodes"
    if comparison.holes[changed].any():
        text += f", {comparison.holes[changed].sum()} nodes with a height in one only"
    yield text
    sizes = comparison.height_max_m, comparison.height_rms_m
    yield from _list_greatest(comparison, changed, "max {:.3f} m, rms {:.3f} m", *sizes)


def _describe_certificates(comparison: Comparison) -> Iterator[str]:
    for name in CERTIFICATE:
        chosen = comparison.mark_changed(name)
        if chosen.any():
            change = comparison.measure_change(name)
            yield f"{name}: {_format_count(chosen.sum())}, {_summarise_changes(change[chosen])}"
            yield from _list_greatest(comparison, chosen, "by {:.4g}", change)


def _summarise_changes(changes: FloatArray) -> str:
    """The median and the largest of some changes, those from or to unknown aside."""
    sizes = np.abs(changes[np.isfinite(changes)])
    unknown = len(changes) - len(sizes)
    parts = [f"median {np.median(sizes):.4g}, max {sizes.max():.4g}"] if len(sizes) else []
    return ", ".join(parts + ([f"{unknown} known in one only"] if unknown else []))


def _list_greatest(
    comparison: Comparison, chosen: BoolArray, form: str, *sizes: FloatArray
) -> Iterator[str]:
    """Lines of the chosen points with the largest of the first sizes."""
    rows = np.flatnonzero(chosen)
    known = np.nan_to_num(np.abs(sizes[0][rows]), nan=np.inf)
    rows = rows[np.argsort(-known, kind="stable")]
    form = f"{{}}: {form}"
    yield from _list_first(
        rows, lambda row: form.format(*(a[row] for a in (comparison.ids, *sizes)))
    )


def _format_count(number: int | np.integer[Any]) -> str:
    return f"{number} point" if number == 1 else f"{number} points"


def _list_first(items: Sequence[Any] | IndexArray, text: Callable[[Any], str]) -> Iterator[str]:
    yield from (f"  {text(item)}" for item in items[:SHOWN])
    if len(items) > SHOWN:
        yield f"  and {len(items) - SHOWN} more"


def _describe_state(record: Record) -> str:
    reasons = Flag(int(record["flags"])).label
    state = "usable" if record["usable"] else "not usable"
    return f"{state} ({reasons})" if reasons else state


def _find_source(side: ComparedCatalog, record: Record) -> str:
    return side.meta.point_sources[int(record["source"])] or "none"


def _make_column_pair(
    name: str, meaning: str, kind: Literal["text", "number"], form: str
) -> list[CsvColumn]:
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
        *_make_column_pair("lat_deg", "latitude", "number", ".10g"),
        *_make_column_pair("lon_deg", "longitude", "number", ".10g"),
        *_make_column_pair("usable", "1 for a usable point", "text", ""),
        *_make_column_pair("reasons", "why it is not usable", "text", ""),
        *_make_column_pair("source", "terrain model", "text", ""),
        *(column for name in SCORES for column in _make_column_pair(name, name, "number", ".10g")),
        *(
            CsvColumn(f"{name}_change", f"largest change of {name}", form=".4g", empty=True)
            for name in LISTS
        ),
    )
)


is_table = make_prefix_test(",".join(DIFFERENCES.names[:6]).encode())


def write_table(comparison: Comparison, path: Path) -> int:
    """Write every point that differs to a CSV file, in the order of ids; returns their number.

    Raises OutputError for a place that cannot be written or an existing file that is no such table.
    """
    with replace_file(path, is_table) as new:
        return DIFFERENCES.write(new, _sort_rows(comparison))


def _sort_rows(comparison: Comparison) -> list[Document]:
    return sorted(_make_rows(comparison), key=lambda row: int(row["id"]))


def _make_rows(comparison: Comparison) -> Iterator[Document]:
    for suffix, side in (("first", comparison.first), ("second", comparison.second)):
        for record in side.only:
            row: Document = {"id": int(record["id"]), "change": f"only in {suffix}"}
            yield row | _collect_columns(side, record, suffix)
    lists = {name: comparison.measure_change(name) for name in LISTS}
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
        row |= _collect_columns(comparison.first, before, "first")
        yield row | _collect_columns(comparison.second, after, "second")


def _collect_columns(side: ComparedCatalog, record: Record, suffix: str) -> Document:
    """Return the columns of the table that describe a point in one catalog."""
    columns: Document = {
        "usable": int(record["usable"]),
        "reasons": Flag(int(record["flags"])).label,
        "source": side.meta.point_sources[int(record["source"])],
    }
    columns |= {name: float(record[name]) for name in ("lat_deg", "lon_deg", *SCORES)}
    return {f"{name}_{suffix}": value for name, value in columns.items()}
