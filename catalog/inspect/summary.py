"""What a catalog holds, as a document for programs and in a few lines for people."""

from collections.abc import Callable
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from catalog.arrays import FloatArray
from catalog.control_point import ComparisonShift, ControlPoint, Flag
from catalog.errors import DataError, NothingToDoError
from catalog.geometry.latlon import body_from_local
from catalog.store.manifest import CatalogMeta
from catalog.store.reader import Catalog
from catalog.terrain.error_model import REFERENCE_SLOPE, TerrainErrorModel

if TYPE_CHECKING:
    from catalog.store.verify import Verification

MAX_CELLS_AWAY = 2.0  # sides of a cell
Document = dict[str, Any]  # plain values by name, units in the names


def count_rejected(catalog: Catalog) -> dict[str, int]:
    """Count the unusable points with each flag; a point may have several."""
    flags = catalog.records["flags"][~catalog.usable]
    counts = {flag.label: int(np.count_nonzero(flags & int(flag))) for flag in Flag}
    return {reason: number for reason, number in counts.items() if number}


def measure_extent(catalog: Catalog) -> Document | None:
    """The box that holds the points, None without any; west > east across ±180°."""
    if len(catalog) == 0:
        return None
    lon = np.sort(catalog.lon_deg)
    gaps = np.append(lon[1:], lon[0] + 360.0) - lon
    widest = int(np.argmax(gaps))
    # the points fill everything but the widest gap between two neighbours
    west, east = float(lon[(widest + 1) % len(lon)]), float(lon[widest])
    return {
        "west_deg": west,
        "south_deg": float(catalog.lat_deg.min()),
        "east_deg": east,
        "north_deg": float(catalog.lat_deg.max()),
    }


def catalog_document(catalog: Catalog) -> Document:
    """Describe a catalog by plain values, with units in their names."""
    meta = catalog.meta
    usable = int(np.count_nonzero(catalog.usable))
    return {
        "catalog": str(catalog.path),
        "format": meta.format_version,
        "body": meta.body,
        "radius_m": meta.radius_m,
        "planes": _describe_planes(meta),
        "cell_deg": meta.cell_deg,
        "cells_on_body": catalog.grid.total,
        "points": len(catalog),
        "usable": usable,
        "rejected": len(catalog) - usable,
        "rejected_by_reason": count_rejected(catalog),
        "extent": measure_extent(catalog),
        "levels": meta.levels,
        "size_nodes": meta.size,
        "posting_m": [meta.posting_m * 2**level for level in range(meta.levels)],
        "height_step_m": meta.height_step_m,
        "recognition_rate_usable": _summarise_values(
            catalog.records["recognition_rate"][catalog.usable]
        ),
        "localisation_nodes_usable": _summarise_values(
            catalog.records["localisation_nodes"][catalog.usable]
        ),
        "relief": _describe_relief(meta),
        "terrain_errors": {
            name: {"error_m": e.error_m, "resolution_km": e.resolution_km, "source": e.source}
            | {"of_gld100": e.against_gld100, "template_sigma_m": _compute_template_sigmas(e, meta)}
            for name, e in meta.terrain_errors.items()
        },
        "photometry": meta.ground.describe(),
        "comparison": _summarise_comparison(catalog),
        "software": meta.software,
        "created_utc": meta.created_utc,
        "size_bytes": catalog.path.stat().st_size,
        "sources": dict(meta.sources),
        "digest": meta.digest,
    }


def describe(document: Document) -> dict[str, str]:
    """Name and value of everything that `optnav catalog info` prints, in its order."""
    lines: dict[str, str] = {}
    for name, value in document.items():
        if name in _WORDS:
            lines |= _WORDS[name](value)
        elif isinstance(value, list):
            lines[name] = ", ".join(f"{number:.6g}" for number in value)
        else:
            lines[name] = f"{value:.12g}" if isinstance(value, float) else str(value)
    return lines


def _describe_planes(meta: CatalogMeta) -> Document | None:
    """Describe the ellipsoid of tangent-plane patches and the posting of the shape model."""
    if meta.planes is None:
        return None
    posting = meta.planes.model_posting_m
    return {
        "radii_m": list(meta.planes.radii_m),
        "model_posting_m": posting,
        "oversampled": meta.posting_m < posting,
    }


def _describe_relief(meta: CatalogMeta) -> Document | None:
    """Cells, their size on the ground and the origin of the relief of the whole body."""
    if meta.relief is None:
        return None
    rows = meta.relief.rows
    side = float(np.pi) * meta.radius_m / rows
    return {"rows": rows, "columns": 2 * rows, "cell_m": side, "source": meta.relief.source}


def _summarise_values(values: FloatArray) -> Document | None:
    known = values[np.isfinite(values)]
    if known.size == 0:
        return None
    # as np.percentile, which takes 20 ms to load
    places = np.array([0.1, 0.5, 0.9]) * (known.size - 1)
    low, middle, high = np.interp(places, np.arange(known.size), np.sort(known)).tolist()
    return {"median": middle, "percentile_10": low, "percentile_90": high}


def _format_planes(planes: Document | None) -> dict[str, str]:
    if planes is None:
        return {}
    radii = ", ".join(f"{radius:.12g}" for radius in planes["radii_m"])
    finer = ", finer patches are oversampled" if planes["oversampled"] else ""
    return {
        "patches": f"in planes that touch the ellipsoid of {radii} m",
        "model_posting_m": f"{planes['model_posting_m']:.6g}{finer}",
    }


def _format_spread(spread: Document | None) -> str:
    words = "median {median:.3f}, 10 % below {percentile_10:.3f}, 90 % below {percentile_90:.3f}"
    return words.format(**spread) if spread else "unknown"


def _format_extent(extent: Document) -> str:
    words = "west {west_deg:.4f}, south {south_deg:.4f}, east {east_deg:.4f}, north {north_deg:.4f}"
    return words.format(**extent)


def _format_relief(relief: Document | None) -> str:
    words = "{rows} x {columns} cells of {cell_m:.6g} m, from {source}"
    return words.format(**relief) if relief else "none"


def _compute_template_sigmas(error: TerrainErrorModel, meta: CatalogMeta) -> list[float]:
    """Compute the position sigma of a full patch of each level on highlands, m per axis."""
    sides = (meta.size * meta.posting_m * 2**level for level in range(meta.levels))
    return [error.point_sigma_m(side, REFERENCE_SLOPE).shift_m for side in sides]


def _summarise_comparison(catalog: Catalog) -> Document | None:
    """Summarise how far the comparison model moves the points."""
    meta = catalog.meta.comparison
    if meta is None:
        return None
    shifts = [(s.east_m, s.north_m) for s in catalog.shifts.values()]
    known = np.array([shift for shift in shifts if np.isfinite(shift).all()]).reshape(-1, 2)
    middle = np.median(known, axis=0) if len(known) else np.full(2, np.nan)
    about = known - middle
    return {
        "sources": dict(meta.sources),
        "max_shift_m": meta.max_shift_m,
        "points_on_it": len(shifts),
        "points_found": len(known),
        "median_e_m": float(middle[0]),
        "median_n_m": float(middle[1]),
        "rms_about_median_m": float(np.sqrt(np.square(about).mean())) if len(known) else np.nan,
    }


def _format_comparison(comparison: Document | None) -> dict[str, str]:
    if comparison is None:
        return {}
    words = (
        "{points_found} of {points_on_it} points found, {median_e_m:+.3g} m east, "
        "{median_n_m:+.3g} m north (median), {rms_about_median_m:.3g} m rms an axis about that"
    )
    return {f"comparison with {', '.join(comparison['sources'])}": words.format(**comparison)}


def _format_error(error: Document) -> str:
    words = "{error_m:.6g} m over 2 km, resolution {resolution_km:.6g} km, both together "
    words += "{of_gld100:.2g} of GLD100's; places of templates to "
    sigmas = ", ".join(f"{sigma:.3g}" for sigma in error["template_sigma_m"])
    return words.format(**error) + f"{sigmas} m by level, finest first; {error['source']}"


def _format_errors(errors: Document) -> dict[str, str]:
    if not errors:
        return {"terrain_errors": "none stated: what points have wrong in common as over GLD100"}
    return {f"error of {name}": _format_error(error) for name, error in errors.items()}


# entries of the document that are more than a value, as lines for people
_WORDS: dict[str, Callable[[Any], dict[str, str]]] = {
    "planes": _format_planes,
    "rejected_by_reason": lambda counts: {
        f"rejected_{why.replace(' ', '_')}": str(count) for why, count in counts.items()
    },
    "extent": lambda extent: {"extent_deg": _format_extent(extent)} if extent else {},
    "recognition_rate_usable": lambda s: {"recognition_rate_usable": _format_spread(s)},
    "localisation_nodes_usable": lambda s: {"localisation_nodes_usable": _format_spread(s)},
    "size_nodes": lambda size: {"size": str(size)},
    "relief": lambda relief: {"relief": _format_relief(relief)},
    "comparison": _format_comparison,
    "terrain_errors": _format_errors,
    "sources": lambda sources: {f"source {name}": text for name, text in sources.items()},
}


def verification_document(verification: "Verification") -> Document:
    """Return the result of `verify` as plain values."""
    return {
        "catalog": str(verification.path),
        "sound": verification.sound,
        "problems": [{"place": p.where, "what": p.what} for p in verification.problems],
        "points": verification.points,
        "patches": verification.patches,
        "digest": verification.computed or None,
        "stated_digest": verification.stated or None,
        "seal": verification.seal and verification.seal.name.lower(),
    }


def point_document(point: ControlPoint) -> Document:
    """Describe a control point by plain values, with units in their names."""
    x, y, z = (float(v) for v in point.xyz_m)
    reasons = point.flags.label
    return {
        "id": point.id,
        "lat_deg": point.lat_deg,
        "lon_deg": point.lon_deg,
        "radius_m": point.radius_m,
        "x_m": x,
        "y_m": y,
        "z_m": z,
        "usable": point.usable,
        "reasons": reasons.split(", ") if reasons else [],
        "recognition_rate": point.recognition_rate,
        "trials": point.trials,
        "localisation_nodes": point.localisation_nodes,
        "hessian_eigenvalue": point.hessian_eigenvalue,
        "uniqueness": list(point.uniqueness),
        "shadow_limit_deg": list(point.shadow_limit_deg),
        "source": point.source,
        **shift_document(point.comparison),
    }


def shift_document(shift: ComparisonShift | None) -> Document:
    """Where a comparison model has a point; None where it is not known."""
    known = shift is not None and np.isfinite(shift.distance_m)
    return {
        "comparison_e_m": shift.east_m if shift is not None and known else None,
        "comparison_n_m": shift.north_m if shift is not None and known else None,
        "comparison_score": shift.score if shift is not None else None,
    }


def describe_point(values: Document) -> dict[str, str]:
    """Name and value of what is known about a point, in the order of printing."""
    return {
        "id": str(values["id"]),
        "lat_deg": f"{values['lat_deg']:.7f}",
        "lon_deg": f"{values['lon_deg']:.7f}",
        "radius_m": f"{values['radius_m']:.3f}",
        "xyz_m": " ".join(f"{values[name]:.2f}" for name in ("x_m", "y_m", "z_m")),
        "usable": "yes" if values["usable"] else "no",
        "reasons": ", ".join(values["reasons"]) or "none",
        "recognition_rate": f"{values['recognition_rate']:.4g} ({values['trials']} trials)",
        "localisation_nodes": f"{values['localisation_nodes']:.4g}",
        "hessian_eigenvalue": f"{values['hessian_eigenvalue']:.6g}",
        "uniqueness": " ".join(f"{margin:.4g}" for margin in values["uniqueness"]),
        "shadow_limit_deg": " ".join(f"{limit:.4g}" for limit in values["shadow_limit_deg"]),
        "source": values["source"],
    } | _format_shift(values)


def _format_shift(values: Document) -> dict[str, str]:
    if values["comparison_e_m"] is None:
        return {}
    words = (
        "{comparison_e_m:+.4g} m east, {comparison_n_m:+.4g} m north, score {comparison_score:.2f}"
    )
    return {"comparison": words.format(**values)}


class NearPoint(NamedTuple):
    """A point seen from a place: how far along the reference sphere, in which direction."""

    point: ControlPoint
    distance_m: float
    azimuth_deg: float


def find_nearest_points(
    catalog: Catalog, lat_deg: float, lon_deg: float, count: int = 1, only_usable: bool = False
) -> list[NearPoint]:
    """The points nearest to a place, the nearest first; fewer where the catalog has no more.

    Raises DataError for a catalog without points, NothingToDoError for one without usable ones.
    """
    if len(catalog) == 0:
        raise DataError(f"{catalog.path}: holds no control point")
    rows = np.flatnonzero(catalog.usable) if only_usable else np.arange(len(catalog))
    if not rows.size:
        raise NothingToDoError(
            f"{catalog.path}: none of its {len(catalog)} control points is usable; leave --usable "
            "out to find one of the others"
        )
    axes = body_from_local(*np.radians([lat_deg, lon_deg]))
    east, north, up = (catalog.direction[rows] @ axes).T
    # half the chord keeps its digits at small angles; of equals, the lowest id
    chord = np.hypot(np.hypot(east, north), 1.0 - up)
    order = np.lexsort((rows, chord))[:count]
    angles = 2.0 * np.arcsin(np.minimum(chord[order] / 2.0, 1.0))
    azimuths = np.degrees(np.arctan2(east[order], north[order])) % 360.0
    points = (catalog.point(int(catalog.ids[row])) for row in rows[order])
    distances = (angles * catalog.meta.radius_m).tolist()
    return [NearPoint(*fields) for fields in zip(points, distances, azimuths.tolist())]


def is_covered(catalog: Catalog, near: NearPoint) -> bool:
    """Whether a place belongs to the ground of a catalog, whose nearest point to it is given.

    The diagonal of a cell is 1.4 of its sides, next to a pole 1.8; a point of the next cell serves
    a cell without its own.
    """
    side = float(np.radians(catalog.meta.cell_deg)) * catalog.meta.radius_m
    return near.distance_m <= MAX_CELLS_AWAY * side
