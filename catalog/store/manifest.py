"""What a catalog says about itself: the `optnav_meta` table, one key and value a row.

The row `checksum` is the SHA-256 of all other rows but `seal`, in the order of their keys, each
written as key, newline, value, newline (UTF-8).
"""

import hashlib
import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from typing import Any

from catalog.errors import DataError
from catalog.store.seal import OPEN_SEAL, SEAL

FORMAT = "optnav catalog"
FORMAT_VERSION = 2  # that this program reads up to
# A catalog without a relief is written as format 1, to the byte as before there were reliefs.
PLAIN_VERSION, RELIEF_VERSION = 1, 2
PROJECTION = "oblique stereographic on the sphere of radius_m, centred on the point, k0 = 1"
CHECKSUM = "checksum"


@dataclass(frozen=True)
class ReliefMeta:
    """What a catalog says of the relief of the whole body that it carries.

    rows    of cells; there are twice as many columns
    source  the terrain models that it was made from
    digest  of its tiles (see `catalog.store.relief`)
    """

    rows: int
    source: str
    digest: str


@dataclass(frozen=True)
class CatalogMeta:
    """What all points of a catalog share.

    radius_m       the body's reference sphere: heights are above it, projections on it
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
    seal           of the file that it was read from (see `catalog.store.seal`); "" for none
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
    seal: str = field(default="", compare=False)


def content_text(meta: CatalogMeta) -> str:
    """The part of the manifest that the content digest covers, as canonical JSON."""
    content = {
        "body": meta.body,
        "radius_m": round(float(meta.radius_m), 3),
        "cell_deg": round(float(meta.cell_deg), 9),
        "levels": meta.levels,
        "size": meta.size,
        "posting_m": round(float(meta.posting_m), 6),
        "height_step_m": round(float(meta.height_step_m), 9),
        "projection": PROJECTION,
        "point_sources": list(meta.point_sources),
        "count": meta.count,
    }
    if meta.relief is not None:
        content["relief"] = asdict(meta.relief)
    return json.dumps(content, sort_keys=True, ensure_ascii=False, separators=(",", ":"))


def rows_from_meta(meta: CatalogMeta) -> dict[str, str]:
    """Rows of the meta table, sorted by key, the checksum among them."""
    rows = {
        "format": FORMAT,
        "format_version": str(meta.format_version),
        "body": meta.body,
        "radius_m": repr(round(float(meta.radius_m), 3)),
        "cell_deg": repr(round(float(meta.cell_deg), 9)),
        "levels": str(meta.levels),
        "size": str(meta.size),
        "posting_m": repr(round(float(meta.posting_m), 6)),
        "height_step_m": repr(round(float(meta.height_step_m), 9)),
        "projection": PROJECTION,
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
    rows = dict(sorted(rows.items()))
    return {**rows, CHECKSUM: _checksum(rows), SEAL: OPEN_SEAL}


def _checksum(texts: Mapping[str, str]) -> str:
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
    if version.isdigit() and int(version) > FORMAT_VERSION:
        raise DataError(
            f"{where}: is of catalog format {version}; this optnav reads up to {FORMAT_VERSION}; "
            "install a newer optnav"
        )
    if not _checksum_fits(texts):
        raise DataError(
            f"{where}: the manifest (table optnav_meta) does not fit its checksum; the catalog is "
            "damaged or was edited: restore it or build it again"
        )
    try:
        return CatalogMeta(
            body=texts["body"],
            radius_m=float(texts["radius_m"]),
            cell_deg=float(texts["cell_deg"]),
            levels=int(texts["levels"]),
            size=int(texts["size"]),
            posting_m=float(texts["posting_m"]),
            height_step_m=float(texts["height_step_m"]),
            sources=json.loads(texts["sources"]),
            config=texts["config"],
            software=texts["software"],
            created_utc=texts["created_utc"],
            point_sources=tuple(json.loads(texts["point_sources"])),
            count=int(texts["count"]),
            usable=int(texts["usable"]),
            digest=texts["digest"],
            relief=_relief(texts["relief"]) if "relief" in texts else None,
            seal=texts.get(SEAL, ""),
            format_version=int(version),
        )
    except (KeyError, ValueError) as error:
        raise DataError(f"{where}: the manifest (table optnav_meta) lacks {error}") from None


def _relief(text: str) -> ReliefMeta:
    found = json.loads(text)
    return ReliefMeta(int(found["rows"]), str(found["source"]), str(found["digest"]))


def _checksum_fits(rows: Mapping[str, str]) -> bool:
    return rows.get(CHECKSUM) == _checksum(rows)
