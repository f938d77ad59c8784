"""What a catalog says about itself: the `optnav_meta` table, one key and value a row.

The row `checksum` is the SHA-256 of all other rows but `seal`, in the order of their keys, each
written as key, newline, value, newline (UTF-8).
"""

import hashlib
import json
import re
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, field, replace
from typing import Any

import msgspec
import numpy as np

from catalog.arrays import FloatArray, IntArray
from catalog.bodies.body import NAME
from catalog.control_point import ControlPoint
from catalog.errors import DataError
from catalog.geometry.ellipsoid import compute_normals, find_foot
from catalog.geometry.latlon import xyz_from_latlon
from catalog.geometry.projection import FLAT_RADIUS_M, MapProjection
from catalog.photometry.sets import PhotometricSet, load_sets
from catalog.terrain.error_model import TerrainErrorModel

FORMAT = "optnav catalog"
FORMAT_VERSION = 6  # this program reads up to it; written where points have brightness
OWN_PLANES_VERSION = 5  # written where points have verticals of their own
PLAIN_VERSION = 4  # written else
PROJECTION = "oblique stereographic on the sphere of radius_m, centred on the point, k0 = 1"
PLANES = (
    "the plane that touches the ellipsoid of semi-axes radii_m below the point: x east, y north, "
    "heights along its normal, which goes through the point"
)
OWN_PLANES = (
    "the plane through the point whose normal `verticals_deg` of `planes` gives: x east, y north, "
    "heights along the normal, 0 at the point"
)
CHECKSUM = "checksum"
SEAL = "seal"  # of all bytes of the file, see `catalog.store.connection`
COUNTER_DIGITS, HASH_DIGITS = 8, 64
OPEN_SEAL = "0" * COUNTER_DIGITS + ":" + "0" * HASH_DIGITS
PLAIN_ROWS: dict[type, tuple[str, ...]] = {
    str: ("body", "config", "software", "created_utc", "digest"),
    int: ("levels", "size", "count", "usable"),
    float: ("radius_m", "cell_deg", "posting_m", "height_step_m"),
}
# What the numbers can be: memory and searches are bounded by them. Builds stay well within.
LIMITS: dict[str, tuple[float, float]] = {
    "radius_m": (1.0, 1e9),
    "cell_deg": (0.02, 90.0),
    "posting_m": (1e-6, 1e9),
    "height_step_m": (1e-9, 1e6),
    "levels": (1, 16),
    "size": (2, 2048),
    "count": (0, 50_000_000),
    "usable": (0, 50_000_000),
}
MAX_RELIEF_ROWS = 2880


@dataclass(frozen=True)
class ReliefMeta:
    """Manifest entry of the relief of the full body.

    rows    of cells; there are twice as many columns
    source  the terrain models that it was made from
    digest  of its tiles (see `catalog.store.relief`)
    """

    rows: int
    source: str
    digest: str


@dataclass(frozen=True)
class PlanesMeta:
    """Manifest entry of patches that lie in tangent planes, as those of small bodies do.

    radii_m          semi-axes, along body x, y, z, of the ellipsoid that the planes touch
    model_posting_m  distance of the shape model's vertices: finer patches are oversampled
    verticals_deg    by a point's id, latitude and longitude of the normal of its plane, where
                     planes are those of the ground at each point; empty: they touch the ellipsoid
    """

    radii_m: tuple[float, float, float]
    model_posting_m: float
    verticals_deg: Mapping[int, tuple[float, float]] = field(default_factory=dict)

    def round_values(self) -> dict[str, Any]:
        """Return the entry as it is written."""
        radii_m = [round(float(radius), 3) for radius in self.radii_m]
        values = {"radii_m": radii_m, "model_posting_m": round(float(self.model_posting_m), 3)}
        if not self.verticals_deg:
            return values
        verticals = {str(number): list(two) for number, two in sorted(self.verticals_deg.items())}
        return values | {"verticals_deg": verticals}

    def add_vertical(self, point: ControlPoint) -> ControlPoint:
        """A point with the normal of its plane, where that is its own."""
        return replace(point, vertical_deg=self.verticals_deg.get(point.id))

    def compute_verticals(self, ids: IntArray, xyz_m: FloatArray) -> FloatArray:
        """Unit normals (n, 3) of the planes of points; their places (n, 3) m."""
        if self.verticals_deg:
            lat, lon = np.radians([self.verticals_deg[number] for number in ids.tolist()]).T
            return xyz_from_latlon(lat, lon, 1.0)
        return compute_normals(find_foot(xyz_m, self.radii_m), self.radii_m)


@dataclass(frozen=True)
class ComparisonMeta:
    """Manifest entry of the second terrain model that the points were compared with.

    sources      of the second model: name -> hash
    max_shift_m  beyond which points were flagged; None without a limit
    digest       of the shifts (see `catalog.store.records`)
    """

    sources: Mapping[str, str]
    max_shift_m: float | None
    digest: str = ""


@dataclass(frozen=True)
class ImageMeta:
    """Manifest entry of the image whose brightness templates are.

    error_m  1 sigma per axis of its places, common to a region; 0 where none is stated
    """

    name: str
    sha256: str
    error_m: float = 0.0


@dataclass(frozen=True)
class CatalogMeta:
    """Properties common to all points of a catalog.

    radius_m       the body's reference sphere: heights are above it, projections on it, unless
                   patches lie in planes
    cell_deg       step of the grid of cells (see `catalog.geometry.cells`); ids are cell numbers
    levels, size   grids a point, nodes a side
    posting_m      node distance of level 0; level l has posting_m * 2**l
    height_step_m  wanted quantisation step of the finest heights; a patch states its own
    sources        DEM name -> its hash or description
    config         the build config's text
    software       program and version
    created_utc    ISO time; no part of the content digest
    point_sources  which texts the points' `source` takes, in the order of first use
    count, usable, digest  filled in by the writer
    relief         of the whole body; None without one
    planes         where patches lie in tangent planes; None on the sphere
    terrain_errors  of the sources whose error was stated, by name; no part of the content digest
    comparison     with a second terrain model; no part of the content digest
    photometry     Hapke's parameters that it was built with; None in older catalogs, which were
                   built with the Moon's; no part of the content digest
    image          whose brightness templates are; None: they are rendered from heights
    seal           of the file that it was read from (see `catalog.store.connection`); "" for none
    """

    body: str
    radius_m: float
    cell_deg: float
    levels: int
    size: int
    posting_m: float
    height_step_m: float
    sources: Mapping[str, str] = field(default_factory=dict)
    config: str = ""
    software: str = ""
    created_utc: str = ""
    point_sources: tuple[str, ...] = ()
    count: int = 0
    usable: int = 0
    digest: str = ""
    format_version: int = PLAIN_VERSION
    relief: ReliefMeta | None = None
    planes: PlanesMeta | None = None
    terrain_errors: Mapping[str, TerrainErrorModel] = field(default_factory=dict)
    comparison: ComparisonMeta | None = None
    photometry: PhotometricSet | None = None
    image: ImageMeta | None = None
    seal: str = field(default="", compare=False)

    def projection(self, point: ControlPoint) -> MapProjection:
        """The map projection of a point's patches."""
        if self.planes is not None:
            return point.tangent_plane(self.planes.radii_m)
        return point.projection(self.radius_m)

    def find_error(self, point_source: str) -> TerrainErrorModel | None:
        """The stated error of the terrain model that counts most at points of a source."""
        named = (n for n in self.terrain_errors if f"{point_source} + ".startswith(f"{n} + "))
        return self.terrain_errors.get(max(named, key=len, default=""))

    @property
    def ground(self) -> PhotometricSet:
        """The photometric set that the points are to be drawn by."""
        return self.photometry or load_sets("moon")[0]

    @property
    def map_radius_m(self) -> float:
        """Radius under the patches' maps, for what renders them: a plane's is beyond measure."""
        return self.radius_m if self.planes is None else FLAT_RADIUS_M


def format_content(meta: CatalogMeta) -> str:
    """The part of the manifest that the content digest covers, as canonical JSON."""
    content: dict[str, object] = {
        "body": meta.body,
        **_round_numbers(meta),
        "projection": _describe_projection(meta),
        "point_sources": list(meta.point_sources),
        "count": meta.count,
    }
    if meta.relief is not None:
        content["relief"] = asdict(meta.relief)
    if meta.planes is not None:
        content["planes"] = meta.planes.round_values()
    if meta.image is not None:
        content["image"] = meta.image.name
    return json.dumps(content, sort_keys=True, ensure_ascii=False, separators=(",", ":"))


def rows_from_meta(meta: CatalogMeta) -> dict[str, str]:
    """Rows of the meta table, sorted by key, the checksum among them."""
    rows = {
        "format": FORMAT,
        "format_version": str(meta.format_version),
        "body": meta.body,
        **{name: repr(number) for name, number in _round_numbers(meta).items()},
        "projection": _describe_projection(meta),
        "sources": json.dumps(dict(meta.sources), sort_keys=True, ensure_ascii=False),
        "point_sources": json.dumps(list(meta.point_sources), ensure_ascii=False),
        "config": meta.config,
        "software": meta.software,
        "created_utc": meta.created_utc,
        "count": str(meta.count),
        "usable": str(meta.usable),
        "digest": meta.digest,
    }
    if meta.relief is not None:
        relief = asdict(meta.relief)
        rows["relief"] = json.dumps(relief, sort_keys=True, ensure_ascii=False)
    if meta.planes is not None:
        rows["planes"] = json.dumps(meta.planes.round_values(), sort_keys=True)
        if meta.planes.verticals_deg:
            rows["format_version"] = str(OWN_PLANES_VERSION)
    if meta.image is not None:
        rows["image"] = json.dumps(asdict(meta.image), sort_keys=True, ensure_ascii=False)
        rows["format_version"] = str(FORMAT_VERSION)
    if meta.terrain_errors:
        rows["terrain_errors"] = msgspec.json.encode(meta.terrain_errors, order="sorted").decode()
    if meta.photometry is not None:
        rows["photometry"] = msgspec.json.encode(meta.photometry, order="sorted").decode()
    if meta.comparison is not None:
        rows["comparison"] = msgspec.json.encode(meta.comparison, order="sorted").decode()
    rows = dict(sorted(rows.items()))
    return {**rows, CHECKSUM: _hash_rows(rows), SEAL: OPEN_SEAL}


def _describe_projection(meta: CatalogMeta) -> str:
    if meta.planes is None:
        return PROJECTION
    return OWN_PLANES if meta.planes.verticals_deg else PLANES


def _round_numbers(meta: CatalogMeta) -> dict[str, float | int]:
    """Numbers of the manifest as they are written."""
    decimals = {"radius_m": 3, "cell_deg": 9, "posting_m": 6, "height_step_m": 9}
    rounded = {name: round(float(getattr(meta, name)), at) for name, at in decimals.items()}
    return {**rounded, "levels": int(meta.levels), "size": int(meta.size)}


def _hash_rows(texts: Mapping[str, str]) -> str:
    rows = sorted((k, v) for k, v in texts.items() if k not in (CHECKSUM, SEAL))
    text = "".join(f"{key}\n{value}\n" for key, value in rows)
    return hashlib.sha256(text.encode("utf-8", "surrogatepass")).hexdigest()


def meta_from_rows(rows: Mapping[Any, Any], where: str) -> CatalogMeta:
    """Read the meta table's rows back.

    Raises DataError for another format, a newer version, or rows that do not fit their checksum.
    """
    if rows.get("format") != FORMAT:
        raise DataError(f"{where}: is not an optnav catalog, or its manifest is damaged")
    texts = {str(key): str(value) for key, value in rows.items()}
    version = texts.get("format_version", "")
    # a newer format may sum its manifest up in another way, so its number is read first
    if re.fullmatch("[0-9]{1,9}", version) and int(version) > FORMAT_VERSION:
        raise DataError(
            f"{where}: is of catalog format {version}; this optnav reads up to {FORMAT_VERSION}; "
            "install a newer optnav"
        )
    if texts.get(CHECKSUM) != _hash_rows(texts):
        raise DataError(
            f"{where}: the manifest (table optnav_meta) does not fit its checksum; the catalog is "
            "damaged or was edited: restore it or build it again"
        )
    decode = msgspec.json.decode
    try:
        plain: dict[str, Any] = {
            name: kind(texts[name]) for kind, names in PLAIN_ROWS.items() for name in names
        }
        meta = CatalogMeta(
            **plain,
            sources=decode(texts["sources"], type=dict[str, str]),
            point_sources=decode(texts["point_sources"], type=tuple[str, ...]),
            relief=decode(texts.get("relief", "null"), type=ReliefMeta | None),
            planes=decode(texts.get("planes", "null"), type=PlanesMeta | None),
            terrain_errors=decode(
                texts.get("terrain_errors", "{}"), type=dict[str, TerrainErrorModel]
            ),
            comparison=decode(texts.get("comparison", "null"), type=ComparisonMeta | None),
            photometry=decode(texts.get("photometry", "null"), type=PhotometricSet | None),
            image=decode(texts.get("image", "null"), type=ImageMeta | None),
            seal=texts.get(SEAL, ""),
            format_version=int(version),
        )
    except (KeyError, ValueError, msgspec.MsgspecError) as error:
        raise DataError(f"{where}: the manifest (table optnav_meta) lacks {error}") from None
    for name, value in _find_out_of_range(meta):
        raise DataError(
            f"{where}: the manifest (table optnav_meta) says {name} = {value}, which no catalog "
            "has; it was edited: restore it or build it again"
        )
    return meta


def _find_out_of_range(meta: CatalogMeta) -> Iterator[tuple[str, object]]:
    """Name and value of what is beyond what the format can hold: sizes bound memory."""
    numbers: list[tuple[str, float, float, float]] = [
        (name, getattr(meta, name), *limits) for name, limits in LIMITS.items()
    ]
    if meta.planes is not None:
        radii = meta.planes.radii_m
        numbers += [("planes radii_m", radius, *LIMITS["radius_m"]) for radius in radii]
        numbers.append(("model_posting_m", meta.planes.model_posting_m, *LIMITS["posting_m"]))
        for lat, lon in meta.planes.verticals_deg.values():
            numbers += [("verticals_deg", lat, -90.0, 90.0), ("verticals_deg", lon, -180.0, 180.0)]
    if meta.relief is not None:
        numbers.append(("relief rows", meta.relief.rows, 1, MAX_RELIEF_ROWS))
    yield from ((name, n) for name, n, lowest, highest in numbers if not lowest <= n <= highest)
    if meta.usable > meta.count:
        yield "usable", meta.usable
    if not NAME.fullmatch(meta.body):
        yield "body", repr(meta.body[:80])
