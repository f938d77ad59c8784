"""What a catalog holds, in a few lines."""

import numpy as np

from catalog.arrays import FloatArray
from catalog.control_point import ControlPoint, Flag
from catalog.geometry.latlon import angular_distance
from catalog.store.manifest import CatalogMeta
from catalog.store.reader import Catalog
from catalog.store.records import reasons_text


def rejected_by_reason(catalog: Catalog) -> dict[str, int]:
    """How many points that are not usable carry each flag; one may carry several."""
    flags = catalog.records["flags"][~catalog.usable]
    counts = {reasons_text(flag): int(np.count_nonzero(flags & int(flag))) for flag in Flag}
    return {reason: number for reason, number in counts.items() if number}


def extent_deg(catalog: Catalog) -> tuple[float, float, float, float] | None:
    """West, south, east, north of the points, None without any; west > east across ±180°."""
    if len(catalog) == 0:
        return None
    lon = np.sort(catalog.lon_deg)
    gaps = np.append(lon[1:], lon[0] + 360.0) - lon
    widest = int(np.argmax(gaps))
    # the points fill everything but the widest gap between two neighbours
    west, east = float(lon[(widest + 1) % len(lon)]), float(lon[widest])
    return west, float(catalog.lat_deg.min()), east, float(catalog.lat_deg.max())


def describe(catalog: Catalog) -> dict[str, str]:
    """Name and value of everything that `optnav catalog info` prints, in its order."""
    meta = catalog.meta
    postings = (f"{meta.posting_m * 2**level:.6g}" for level in range(meta.levels))
    rejected = rejected_by_reason(catalog)
    usable = int(np.count_nonzero(catalog.usable))
    lines = {
        "catalog": str(catalog.path),
        "format": f"{meta.format_version}",
        "body": meta.body,
        "radius_m": f"{meta.radius_m:.12g}",
        **_planes(meta),
        "cell_deg": f"{meta.cell_deg:.9g}",
        "cells_on_body": str(catalog.grid.total),
        "points": str(len(catalog)),
        "usable": str(usable),
        "rejected": str(len(catalog) - usable),
        **{f"rejected_{why.replace(' ', '_')}": str(number) for why, number in rejected.items()},
    }
    box = extent_deg(catalog)
    if box is not None:
        lines["extent_deg"] = "west {:.4f}, south {:.4f}, east {:.4f}, north {:.4f}".format(*box)
    lines |= {
        "levels": str(meta.levels),
        "size": str(meta.size),
        "posting_m": ", ".join(postings),
        "height_step_m": f"{meta.height_step_m:.9g}",
        "recognition_rate_usable": _median(catalog.records["recognition_rate"][catalog.usable]),
        "localisation_nodes_usable": _median(catalog.records["localisation_nodes"][catalog.usable]),
        "relief": _relief(catalog),
        "software": meta.software,
        "created_utc": meta.created_utc,
        "size_bytes": str(catalog.path.stat().st_size),
        **{f"source {name}": content for name, content in meta.sources.items()},
        "digest": meta.digest,
    }
    return lines


def _planes(meta: CatalogMeta) -> dict[str, str]:
    """What patches in tangent planes touch, and how fine the shape model under them is."""
    if meta.planes is None:
        return {}
    radii = ", ".join(f"{radius:.12g}" for radius in meta.planes.radii_m)
    posting = meta.planes.model_posting_m
    finer = ", finer patches are oversampled" if meta.posting_m < posting else ""
    return {
        "patches": f"in planes that touch the ellipsoid of {radii} m",
        "model_posting_m": f"{posting:.6g}{finer}",
    }


def _relief(catalog: Catalog) -> str:
    """Cells, their size on the ground and the origin of the relief of the whole body."""
    meta = catalog.meta
    if meta.relief is None:
        return "none"
    rows = meta.relief.rows
    side = np.pi * meta.radius_m / rows
    return f"{rows} x {2 * rows} cells of {side:.6g} m, from {meta.relief.source}"


def _median(values: FloatArray) -> str:
    known = values[np.isfinite(values)]
    if known.size == 0:
        return "unknown"
    low, middle, high = np.percentile(known, [10.0, 50.0, 90.0])
    return f"median {middle:.3f}, 10 % below {low:.3f}, 90 % below {high:.3f}"


def describe_point(point: ControlPoint) -> dict[str, str]:
    """Name and value of what is known about a point, in the order of printing."""
    x, y, z = point.xyz_m
    return {
        "id": str(point.id),
        "lat_deg": f"{point.lat_deg:.7f}",
        "lon_deg": f"{point.lon_deg:.7f}",
        "radius_m": f"{point.radius_m:.3f}",
        "xyz_m": f"{x:.2f} {y:.2f} {z:.2f}",
        "usable": "yes" if point.usable else "no",
        "reasons": reasons_text(point.flags) or "none",
        "recognition_rate": f"{point.recognition_rate:.4g} ({point.trials} trials)",
        "localisation_nodes": f"{point.localisation_nodes:.4g}",
        "hessian_eigenvalue": f"{point.hessian_eigenvalue:.6g}",
        "uniqueness": " ".join(f"{margin:.4g}" for margin in point.uniqueness),
        "shadow_limit_deg": " ".join(f"{limit:.4g}" for limit in point.shadow_limit_deg),
        "source": point.source,
    }


def distance_km(catalog: Catalog, point: ControlPoint, lat_deg: float, lon_deg: float) -> float:
    """Distance along the reference sphere from a place to a point."""
    angle = angular_distance(*np.radians([lat_deg, lon_deg, point.lat_deg, point.lon_deg]))
    return float(angle) * catalog.meta.radius_m / 1000.0
