"""Reading a catalog: all points at once, patches one point at a time."""

import logging
import math
import sqlite3
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import cached_property, partial
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

import numpy as np

from catalog.arrays import BoolArray, FloatArray, IntArray, RecordArray
from catalog.control_point import ComparisonShift, ControlPoint, Patch, Pyramid
from catalog.errors import DATABASE_ERRORS, DataError
from catalog.geometry.cells import CellGrid
from catalog.geometry.latlon import wrap_longitude_deg, xyz_from_latlon
from catalog.store.codec import decode
from catalog.store.connection import connect, read_meta
from catalog.store.geopackage import define_srs
from catalog.store.manifest import CatalogMeta
from catalog.store.patches import StoredPatch, check_patch, patch_from_row, stored_patch_from_row
from catalog.store.records import (
    Record,
    compute_checksum,
    find_impossible,
    point_from_record,
    read_shifts,
    record_from_row,
    record_type,
)
from catalog.store.schema import (
    HEIGHT_LAYER,
    IMAGE_LAYER,
    PATCH_COLUMNS,
    PATCHES,
    POINTS,
    RECORDS,
    compute_patch_key,
    select_points,
)

# What compiled code needs is imported where it is asked for: half the time of `catalog info` would
# go into loading the compiler.
if TYPE_CHECKING:
    from catalog.store.index import CellIndex
    from catalog.terrain.relief.relief import GlobalRelief

log = logging.getLogger(__name__)

SELECT_PATCHES = (
    f"SELECT {', '.join(PATCH_COLUMNS)} FROM {PATCHES} WHERE id BETWEEN ? AND ? ORDER BY id"
)

T = TypeVar("T")
Report = Callable[[str, object], None]  # called with what is damaged: place, what is wrong


class Catalog:
    """An open catalog; all arrays are in the order of ascending ids.

    path, meta        where it is and its manifest
    records           (n,) the points as stored, see `catalog.store.records`
    ids               (n,) cell numbers
    lat_deg, lon_deg, radius_m  (n,) places
    usable            (n,) bool

    A catalog can be sent to another process: it opens the file again there.
    """

    def __init__(self, path: Path, db: sqlite3.Connection, meta: CatalogMeta, records: RecordArray):
        self.path = path
        self.meta = meta
        self.grid = CellGrid(meta.cell_deg)
        self.records = records
        self.ids: IntArray = records["id"].astype(np.int64)
        places = (records[name].astype(np.float64) for name in ("lat_deg", "lon_deg", "radius_m"))
        self.lat_deg, self.lon_deg, self.radius_m = places
        self.usable: BoolArray = records["usable"] != 0
        self._db = db

    @classmethod
    def open(cls, path: str | Path, *, strict: bool = False) -> "Catalog":
        """Open a catalog file.

        Raises DataError for a file that is missing, cut short, of a newer format, no catalog, or
        so damaged that its points cannot be listed. A damaged list of points is replaced by the
        feature layer and a damaged point of this left out, with warnings; strict: DataError.
        """
        path = Path(path)
        db = connect(path)
        try:
            meta = read_meta(db, path)
            warn = partial(log.warning, "%s: %s: %s", path)
            records = read_records(db, meta, _refuse if strict else warn)
        except DataError as error:
            db.close()
            where = "" if str(error).startswith(str(path)) else f"{path}: "
            raise DataError(f"{where}{error}") from None
        return cls(path, db, meta, records)

    def __reduce__(self) -> tuple[object, ...]:
        return Catalog.open, (self.path,)

    def __enter__(self) -> "Catalog":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def __len__(self) -> int:
        return len(self.ids)

    def close(self) -> None:
        """Close the file; points already read stay."""
        self._db.close()

    @property
    def digest(self) -> str:
        """The content digest that the writer stated; `verify` tells whether it is true."""
        return self.meta.digest

    @cached_property
    def direction(self) -> FloatArray:
        """(n, 3) body-fixed unit vectors of the points."""
        return xyz_from_latlon(np.radians(self.lat_deg), np.radians(self.lon_deg), 1.0)

    @cached_property
    def xyz_m(self) -> FloatArray:
        """(n, 3) body-fixed places of the points, m."""
        return self.direction * self.radius_m[:, None]

    @cached_property
    def _index(self) -> "CellIndex":
        from catalog.store.index import CellIndex

        return CellIndex(self.grid, self.ids, self.direction)

    def relief(self) -> "GlobalRelief | None":
        """The relief of the whole body that the catalog carries, None for none; read once.

        Raises DataError when a part of it is missing or damaged.
        """
        return self._relief

    @cached_property
    def _relief(self) -> "GlobalRelief | None":
        from catalog.store.relief import read_relief

        try:
            return read_relief(self._db, self.meta)
        except DataError as error:
            raise DataError(
                f"{self.path}: {error}; run `optnav catalog verify`, restore it or build it again"
            ) from None

    def find_row(self, point_id: int) -> int:
        """Row of a point in the arrays. Raises DataError for an id that is not there."""
        row = int(self.ids.searchsorted(point_id))
        if row >= len(self.ids) or self.ids[row] != point_id:
            raise DataError(
                f"{self.path}: has no control point {point_id}; `optnav catalog nearest` finds one"
            )
        return row

    def point(self, point_id: int) -> ControlPoint:
        """A point with its certificate. Raises DataError for an id that is not there."""
        stored = self._point(self.records[self.find_row(point_id)])
        return replace(stored, comparison=self.shifts.get(point_id)) if self.shifts else stored

    def _point(self, record: Record) -> ControlPoint:
        point = point_from_record(record, self.meta.point_sources)
        return point if self.meta.planes is None else self.meta.planes.add_vertical(point)

    @cached_property
    def shifts(self) -> dict[int, ComparisonShift]:
        """Where the comparison model has points, by id; empty without one, or where damaged."""
        if self.meta.comparison is None:
            return {}
        try:
            return read_shifts(self._db, self.meta.comparison.digest)
        except DataError as error:
            log.warning("%s: %s; left out; run `optnav catalog verify`", self.path, error)
            return {}

    def points(self) -> Iterator[ControlPoint]:
        """All points in the order of their ids."""
        for record in self.records:
            yield self._point(record)

    def nearest(self, lat_deg: float, lon_deg: float) -> int:
        """Id of the point at the least angle from a place; of equals, the lowest.

        lat_deg in [-90, 90], lon_deg of any turn. Raises ValueError for a place that is none and
        DataError for a catalog without points.
        """
        if not (abs(lat_deg) <= 90.0 and math.isfinite(lon_deg)):
            raise ValueError(f"latitude {lat_deg}, longitude {lon_deg}: not a place")
        lon = (lon_deg + 180.0) % 360.0 - 180.0
        row = self._index.find_nearest_row(lat_deg, lon if lon < 180.0 else -180.0)
        if row < 0:
            raise DataError(f"{self.path}: holds no control point")
        return int(self.ids[row])

    def within(self, lat_deg: float, lon_deg: float, radius_deg: float) -> IntArray:
        """Ids of all points within an angle of a place, ascending."""
        lon = float(wrap_longitude_deg(lon_deg))
        centre = xyz_from_latlon(math.radians(lat_deg), math.radians(lon), 1.0)
        # chords keep their digits at small angles, where cosines do not
        chord = np.linalg.norm(self.direction - centre, axis=1)
        limit = 2.0 * math.sin(math.radians(min(max(radius_deg, 0.0), 180.0)) / 2.0)
        near: IntArray = self.ids[chord <= limit]
        return near

    def patches(self, point_id: int) -> tuple[Patch, ...]:
        """The grids of a point, finest first; empty for a point kept without any.

        Raises DataError when one is missing or damaged: then the point must not be used.
        """
        patches = self._read_patches(point_id, patch_from_row)
        if self.meta.image is None:
            return patches
        shown = self._read_patches(point_id, stored_patch_from_row, IMAGE_LAYER)
        return tuple(
            replace(patch, brightness=decode(image.encoded))
            for patch, image in zip(patches, shown, strict=True)
        )

    def stored_patches(self, point_id: int) -> tuple[StoredPatch, ...]:
        """The patches of a point as they are stored, their checksums checked.

        Raises DataError when one is missing or damaged.
        """
        return self._read_patches(point_id, stored_patch_from_row)

    def _read_patches(
        self, point_id: int, read: Callable[..., T], layer: int = HEIGHT_LAYER
    ) -> tuple[T, ...]:
        stored = int(self.records["levels"][self.find_row(point_id)])
        first = compute_patch_key(point_id, layer, 0)
        try:
            rows = self._db.execute(SELECT_PATCHES, (first, first + 15)).fetchall()
            if len(rows) != stored:
                raise DataError(f"{len(rows)} levels of {stored} are there")
            for level, row in enumerate(rows):
                check_patch(row, level, self.meta)
            which = () if layer == HEIGHT_LAYER else (layer,)
            return tuple(read(row, point_id, level, *which) for level, row in enumerate(rows))
        except (*DATABASE_ERRORS, DataError) as error:
            raise DataError(
                f"{self.path}: control point {point_id} is damaged: {error}; run "
                "`optnav catalog verify`"
            ) from None

    def pyramid(self, point_id: int) -> Pyramid:
        """A point together with its patches. Raises DataError as `patches` does."""
        return Pyramid(self.point(point_id), self.patches(point_id))


def read_packed_records(db: sqlite3.Connection, meta: CatalogMeta) -> RecordArray:
    """The points from the packed table. Raises DataError when it is damaged."""
    layout = record_type(meta.levels)
    parts: list[bytes] = []
    read = 0
    try:
        rows = db.execute(f"SELECT id, count, checksum, data FROM {RECORDS} ORDER BY id")
        for number, (key, count, stored, data) in enumerate(rows):
            intact = key == number and isinstance(data, bytes) and stored == compute_checksum(data)
            if not intact or len(data) != count * layout.itemsize:
                raise DataError(f"row {number} does not fit its checksum")
            parts.append(data)
            read += count
            if read > meta.count:
                break
    except (*DATABASE_ERRORS, TypeError) as error:
        raise DataError(f"cannot be read: {error}") from None
    if read != meta.count:
        raise DataError(f"holds {read} points, or more, of {meta.count}")
    return np.frombuffer(b"".join(parts), dtype=layout)


def read_feature_records(db: sqlite3.Connection, meta: CatalogMeta, report: Report) -> RecordArray:
    """The points whose row in the feature layer is whole; the others are reported.

    Raises DataError when the table cannot be read or no point of it is whole.
    """
    srs_id = define_srs(meta.body, meta.radius_m)[0]
    good: dict[int, Record] = {}
    try:
        for row in db.execute(f"{select_points(meta)} ORDER BY id"):
            try:
                record = record_from_row(row, meta.levels, meta.point_sources, srs_id)
            except DataError as error:
                report(f"{POINTS} {row[0]}", f"left out: {error}")
                continue
            good[int(record["id"])] = record
    except DATABASE_ERRORS as error:
        raise DataError(f"the catalog is damaged: {error}; restore it or build it again") from None
    if meta.count and not good:
        raise DataError("the catalog is damaged: no control point is whole; build it again")
    return np.array([good[key] for key in sorted(good)], dtype=record_type(meta.levels))


def read_records(db: sqlite3.Connection, meta: CatalogMeta, report: Report) -> RecordArray:
    """The points in the order of their ids; damage is reported.

    Raises DataError when they cannot be listed at all.
    """
    try:
        records = read_packed_records(db, meta)
    except DataError as error:
        report(RECORDS, f"{error}; reading the feature layer instead")
        records = read_feature_records(db, meta, report)
    if (np.diff(records["id"]) <= 0).any():
        raise DataError("the catalog is damaged: its points are not in order; build it again")
    sources = len(meta.point_sources)
    wrong = find_impossible(records, CellGrid(meta.cell_deg), meta.levels, sources, meta.radius_m)
    if meta.planes is not None and meta.planes.verticals_deg:
        known = np.isin(records["id"], list(meta.planes.verticals_deg))
        for row in np.flatnonzero(~known).tolist():
            wrong.setdefault(row, "the manifest has no vertical of it")
    for row, reason in wrong.items():
        report(f"{POINTS} {records['id'][row]}", f"left out: {reason}")
    return np.delete(records, list(wrong)) if wrong else records


def _refuse(place: str, what: object) -> None:
    raise DataError(f"{place}: {what}")
