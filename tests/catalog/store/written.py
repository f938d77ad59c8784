"""Catalogs from points with plain patches, as the stage `write` makes them."""

from collections.abc import Iterable, Sequence
from pathlib import Path

from catalog.control_point import ControlPoint, Patch
from catalog.store.manifest import CatalogMeta
from catalog.store.patches import prepare_point
from catalog.store.writer import Written, write_catalog


def write_points(
    path: str | Path,
    meta: CatalogMeta,
    points: Iterable[tuple[ControlPoint, Sequence[Patch]]],
) -> Written:
    """A catalog of points and their patches, all of the height step that the catalog states."""
    steps = (meta.height_step_m,)
    prepared = (prepare_point(point, patches, steps * len(patches)) for point, patches in points)
    return write_catalog(path, meta, prepared)
