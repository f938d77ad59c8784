"""What a run navigates by: the points of its catalogs and the body's relief."""

from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path

import numpy as np

from catalog.bodies.body import Body
from catalog.errors import DataError, UsageError
from catalog.store.reader import Catalog
from catalog.terrain.relief.relief import GlobalRelief
from catalog.terrain.relief.sums import load_relief
from optnav_cli.control_points.field import ControlPointField, PointLayer


@contextmanager
def open_catalogs(paths: Sequence[Path]) -> Iterator[list[Catalog]]:
    """Open catalogs, and close them at the end.

    Raises UsageError for two of one file name, which matches.csv could not tell apart, and
    DataError for a file that is no whole catalog.
    """
    for name, count in Counter(path.name for path in paths).items():
        if count > 1:
            raise UsageError(
                f"--catalog names {count} files called '{name}'; give each catalog another name"
            )
    with ExitStack() as stack:
        yield [stack.enter_context(Catalog.open(path)) for path in paths]


def open_field(catalogs: Sequence[Catalog], body: Body) -> ControlPointField | None:
    """The usable control points of catalogs, the first given before the others; None without any.

    Raises DataError for a catalog of another body or without usable points.
    """
    layers = [_layer(catalog, body) for catalog in catalogs]
    return ControlPointField(layers) if layers else None


def open_ground(catalogs: Sequence[Catalog], body: Body) -> ControlPointField | None:
    """The same with all points that have patches: ground to cut windows from."""
    layers = [_layer(catalog, body, whole=True) for catalog in catalogs]
    return ControlPointField(layers) if layers else None


def whole_relief(
    catalogs: Sequence[Catalog], named: Path | None, body: Body
) -> GlobalRelief | None:
    """The body's relief for the horizon: of the named terrain model, else the finest carried one.

    None where there is none. Raises DataError for a damaged one or a model of a part of the body.
    """
    if named is not None:
        return load_relief(str(named), body)
    carried = [relief for c in catalogs if (relief := c.relief()) is not None]
    return min(carried, key=lambda relief: relief.posting_m, default=None)


def _layer(catalog: Catalog, body: Body, *, whole: bool = False) -> PointLayer:
    meta, usable = catalog.meta, catalog.usable
    if whole:
        usable = catalog.records["levels"] > 0
    if meta.body != body.name:
        raise DataError(
            f"{catalog.path}: is a catalog of {meta.body}; the pictures show {body.name}: "
            "name another catalog, or mend `body` in run.toml"
        )
    if not usable.any():
        raise DataError(
            f"{catalog.path}: none of its {len(catalog)} control points is usable; "
            "see `optnav catalog info`"
        )
    by_source = [meta.find_error(source) for source in meta.point_sources]
    stated = catalog.records["source"][usable] if any(by_source) else ()
    return PointLayer(
        catalog.path.name,
        catalog,
        catalog.grid,
        catalog.ids[usable],
        catalog.xyz_m[usable],
        catalog.records["shadow_limit_deg"][usable],
        np.array([meta.posting_m * 2.0**level for level in range(meta.levels)]),
        meta.radius_m,
        meta.planes,
        tuple(by_source[source] for source in stated),
    )
