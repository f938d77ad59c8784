"""What differs between two catalogs: settings, points, heights and certificates.

Points are compared by their ids, the numbers of their cells. Heights are compared as they are
stored, and unpacked only where that differs; one point's patches are held at a time. Every patch of
both files is read with its checksum: a damaged catalog is reported and never called the same.
"""

import hashlib
import json
import math
import tomllib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from catalog.arrays import BoolArray, FloatArray, IntArray, RecordArray
from catalog.errors import DataError
from catalog.progress import Progress, SilentProgress, Stage
from catalog.store.codec import decode, decode_counts
from catalog.store.manifest import CatalogMeta
from catalog.store.patches import StoredPatch
from catalog.store.reader import Catalog

CONTENT = ("body", "radius_m", "cell_deg", "levels", "size", "posting_m", "height_step_m")
OF_THE_MOMENT = ("software", "created_utc")
NOTHING = "none"
SCORES = ("localisation_nodes", "hessian_eigenvalue", "recognition_rate", "trials")
LISTS = ("uniqueness", "shadow_limit_deg")  # shown by their largest difference
CERTIFICATE = SCORES + LISTS


class Change(NamedTuple):
    """A setting that differs; "none" where one catalog has none."""

    name: str
    first: str
    second: str


@dataclass(frozen=True)
class ComparedCatalog:
    """One of the two catalogs."""

    path: Path
    meta: CatalogMeta
    only: RecordArray  # points whose id the other one has not


class ReliefChange(NamedTuple):
    """Difference of two reliefs with the same number of rows.

    cells        whose mean or top is another
    mean_max_m, mean_rms_m, top_max_m  differences of all cells' means and tops
    """

    cells: int
    mean_max_m: float
    mean_rms_m: float
    top_max_m: float


@dataclass(frozen=True)
class Comparison:
    """Differences of two catalogs; arrays in the order of ascending ids, one entry a shared point
    that differs in anything.

    settings      content of the manifest that differs
    provenance    what else the manifests tell apart: no content
    comparable    whether ids mean the same cells; else no point is compared
    before, after (n,) the points in the first and in the second catalog
    moved_m       (n,) distance on the reference sphere
    patches       (n,) bool: stored heights differ
    height_max_m, height_rms_m  (n,) largest and rms difference of heights over all levels; NaN
                  where the point has moved, or its patches have another shape
    holes         (n,) nodes with a height in one of the two only
    relief        differences of the reliefs; None where they are the same, or where one has none or
                  other cells (then `settings` says so)
    """

    first: ComparedCatalog
    second: ComparedCatalog
    settings: tuple[Change, ...]
    provenance: tuple[Change, ...]
    comparable: bool
    before: RecordArray
    after: RecordArray
    moved_m: FloatArray
    patches: BoolArray
    height_max_m: FloatArray
    height_rms_m: FloatArray
    holes: IntArray
    relief: ReliefChange | None

    @property
    def same(self) -> bool:
        """Whether both have the same content."""
        return self.first.meta.digest == self.second.meta.digest

    @property
    def ids(self) -> IntArray:
        """(n,) ids of shared points that differ."""
        return self.before["id"].astype(np.int64)

    def mark_changed(self, name: str) -> BoolArray:
        """(n,) where a field of the records differs."""
        if name == "source":
            before, after = self.first.meta, self.second.meta
            return np.not_equal(
                _list_sources(before, self.before), _list_sources(after, self.after)
            )
        return _mark_differences(self.before[name], self.after[name])

    def measure_change(self, name: str) -> FloatArray:
        """(n,) largest difference of a field's numbers, absolute; inf from or to unknown."""
        a, b = _align_columns(self.before[name], self.after[name])
        change = np.where(np.isnan(a) & np.isnan(b), 0.0, np.abs(a - b))
        largest: FloatArray = np.where(np.isnan(change), np.inf, change).max(axis=1, initial=0.0)
        return largest


def compare(first: str | Path, second: str | Path, progress: Progress | None = None) -> Comparison:
    """Compare the content of two catalog files.

    Raises DataError for one that is missing, damaged or no catalog.
    """
    with (
        Catalog.open(first, strict=True) as a,
        Catalog.open(second, strict=True) as b,
        (progress or SilentProgress()).stage("compare", len(a) + len(b), "point") as stage,
    ):
        comparison = _compare(a, b, stage)
    alone = len(comparison.first.only) + len(comparison.second.only)
    differs = bool(comparison.settings or alone or len(comparison.ids) or comparison.relief)
    # equal digests of different contents, or different ones of equal: one of the two is not true
    if comparison.same == differs:
        raise DataError(
            f"{first}, {second}: a digest that they state is not that of the content; "
            "run `optnav catalog verify` on both"
        )
    return comparison


def require_whole(path: str | Path) -> None:
    """Raise DataError unless all that `compare` reads of a catalog is there and undamaged."""
    with Catalog.open(path, strict=True) as catalog:
        for number in catalog.ids.tolist():
            catalog.stored_patches(number)
        catalog.relief()


def _collect_content(meta: CatalogMeta) -> dict[str, str]:
    """Settings that are part of the content digest."""
    values = {name: str(getattr(meta, name)) for name in CONTENT}
    values["point_sources"] = ", ".join(meta.point_sources)
    if meta.relief is not None:
        relief = meta.relief
        values["relief"] = f"{relief.rows} rows of {relief.source} ({relief.digest[:12]})"
    if meta.planes is not None:
        planes = meta.planes.round_values()
        verticals_text = json.dumps(planes.pop("verticals_deg", {}), sort_keys=True)
        digest = f", verticals {hashlib.sha256(verticals_text.encode()).hexdigest()[:12]}"
        values["planes"] = f"{planes}{digest if meta.planes.verticals_deg else ''}"
    return values


def _collect_provenance(meta: CatalogMeta) -> dict[str, str]:
    """Collect what is no content: program, time, terrain hashes, values of the build config."""
    values = {name: str(getattr(meta, name)) for name in OF_THE_MOMENT}
    sources = {f"source {name}": text for name, text in meta.sources.items()}
    errors = {f"error of {n}": f"{e.error_m:g} m" for n, e in meta.terrain_errors.items()}
    return values | sources | errors | _parse_config(meta.config)


def _list_changes(one: Mapping[str, str], other: Mapping[str, str]) -> tuple[Change, ...]:
    names = [*one, *(name for name in other if name not in one)]
    changes = (Change(name, one.get(name, NOTHING), other.get(name, NOTHING)) for name in names)
    return tuple(change for change in changes if change.first != change.second)


def _parse_config(text: str) -> dict[str, str]:
    """Values of a config under names as "config check.trials"; one line where it is no TOML."""
    try:
        return dict(_flatten_value("config", tomllib.loads(text)))
    except (ValueError, RecursionError):
        return {"config": " ".join(text.split())}


def _flatten_value(name: str, value: object) -> Iterator[tuple[str, str]]:
    if isinstance(value, dict):
        separator = " " if name == "config" else "."
        for key, inner in value.items():
            yield from _flatten_value(f"{name}{separator}{key}", inner)
    elif isinstance(value, list) and any(isinstance(inner, dict) for inner in value):
        for number, inner in enumerate(value, start=1):
            yield from _flatten_value(f"{name}[{number}]", inner)
    else:
        yield name, str(value)


def _compare(a: Catalog, b: Catalog, stage: Stage) -> Comparison:
    settings = _list_changes(_collect_content(a.meta), _collect_content(b.meta))
    comparable = not {"body", "radius_m", "cell_deg"} & {change.name for change in settings}
    shared, rows_a, rows_b = np.intersect1d(
        a.ids, b.ids if comparable else b.ids[:0], assume_unique=True, return_indices=True
    )
    before, after = a.records[rows_a], b.records[rows_b]
    # twice the sine of half the angle, which keeps its digits at small ones
    chord = np.linalg.norm(a.direction[rows_a] - b.direction[rows_b], axis=1)
    moved_m = 2.0 * np.arcsin(np.minimum(chord / 2.0, 1.0)) * a.meta.radius_m
    patches = np.zeros(len(shared), dtype=np.bool_)
    holes = np.zeros(len(shared), dtype=np.int64)
    height_max, height_rms = np.zeros(len(shared)), np.zeros(len(shared))
    for row, number in enumerate(shared.tolist()):
        before_patches, after_patches = a.stored_patches(number), b.stored_patches(number)
        if not _is_same_content(before_patches, after_patches):
            patches[row] = True
            height_max[row], height_rms[row], holes[row] = (
                _compare_heights(before_patches, after_patches)
                if moved_m[row] == 0.0
                else (np.nan, np.nan, 0)
            )
        stage.advance(2)
    changed = patches | (_list_sources(a.meta, before) != _list_sources(b.meta, after))
    for name in ("lat_deg", "lon_deg", "radius_m", "flags", "usable", *CERTIFICATE):
        changed |= _mark_differences(before[name], after[name])
    return Comparison(
        _collect_unshared(a, shared, comparable, stage),
        _collect_unshared(b, shared, comparable, stage),
        settings,
        _list_changes(_collect_provenance(a.meta), _collect_provenance(b.meta)),
        comparable,
        before[changed],
        after[changed],
        moved_m[changed],
        patches[changed],
        height_max[changed],
        height_rms[changed],
        holes[changed],
        _compare_reliefs(a, b),
    )


def _compare_reliefs(a: Catalog, b: Catalog) -> ReliefChange | None:
    """Both reliefs are read, so that a damaged one is reported."""
    before, after = a.relief(), b.relief()
    if before is None or after is None or before.heights.shape != after.heights.shape:
        return None
    means, max_heights = before.heights - after.heights, before.max_heights - after.max_heights
    cells = int(np.count_nonzero((means != 0.0) | (max_heights != 0.0)))
    if cells == 0:
        return None
    rms = float(np.sqrt(np.square(means, dtype=np.float64).mean()))
    return ReliefChange(cells, float(np.abs(means).max()), rms, float(np.abs(max_heights).max()))


def _collect_unshared(
    catalog: Catalog, shared: IntArray, comparable: bool, stage: Stage
) -> ComparedCatalog:
    """Select what only one catalog has; its patches are read to check that they are intact."""
    alone = ~np.isin(catalog.ids, shared)
    for number in catalog.ids[alone].tolist():
        catalog.stored_patches(number)
        stage.advance()
    only = catalog.records[alone] if comparable else catalog.records[:0]
    return ComparedCatalog(catalog.path, catalog.meta, only)


def _is_same_content(one: tuple[StoredPatch, ...], other: tuple[StoredPatch, ...]) -> bool:
    if one == other:
        return True
    # another release of the compressor may pack the same counts in another way
    return [patch.header for patch in one] == [patch.header for patch in other] and all(
        np.array_equal(
            decode_counts(p.encoded.data, p.encoded.size),
            decode_counts(q.encoded.data, q.encoded.size),
        )
        for p, q in zip(one, other)
    )


def _compare_heights(
    one: tuple[StoredPatch, ...], other: tuple[StoredPatch, ...]
) -> tuple[float, float, int]:
    """Largest and rms difference (m; NaN when no node can be compared), nodes known in one only."""
    largest, squares, nodes, holes = 0.0, 0.0, 0, 0
    for p, q in zip(one, other):
        if (p.posting_m, p.encoded.size) != (q.posting_m, q.encoded.size):
            continue
        a, b = decode(p.encoded).astype(np.float64), decode(q.encoded).astype(np.float64)
        holes += int(np.count_nonzero(np.isnan(a) != np.isnan(b)))
        difference = a - b
        known = np.isfinite(difference)
        largest = max(largest, float(np.abs(difference[known]).max(initial=0.0)))
        squares += float(np.square(difference[known]).sum())
        nodes += int(np.count_nonzero(known))
    if nodes == 0:
        return np.nan, np.nan, holes
    return largest, float(np.sqrt(squares / nodes)), holes


def _list_sources(meta: CatalogMeta, records: RecordArray) -> NDArray[np.str_]:
    """(n,) the texts that the points' `source` stands for."""
    return np.take(np.array([*meta.point_sources, ""], dtype=np.str_), records["source"])


def _align_columns(one: NDArray[np.generic], other: NDArray[np.generic]) -> list[FloatArray]:
    """(n, levels) numbers of two columns, as many as both have: levels may differ."""
    both = [a.astype(np.float64).reshape(len(a), math.prod(a.shape[1:])) for a in (one, other)]
    return [values[:, : min(a.shape[1] for a in both)] for values in both]


def _mark_differences(one: NDArray[np.generic], other: NDArray[np.generic]) -> BoolArray:
    """(n,) where two columns of numbers, or of lists of them, differ; unknown equals unknown."""
    a, b = _align_columns(one, other)
    different: BoolArray = ((a != b) & ~(np.isnan(a) & np.isnan(b))).any(axis=1)
    return different
