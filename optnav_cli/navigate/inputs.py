"""Inputs of a run: the points of its catalogs, the body's relief, an orbit as prior of frames."""

import logging
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np

from catalog.bodies.body import Body
from catalog.errors import DataError, UsageError
from catalog.store.reader import Catalog
from catalog.terrain.relief.relief import GlobalRelief
from catalog.terrain.relief.sums import load_relief
from optnav_cli.control_points.field import ControlPointField, PointLayer
from optnav_cli.fix import PositionPrior
from optnav_cli.frames.frames import Frame
from optnav_cli.frames.run_settings import RUN_TOML
from optnav_cli.orbit.fit.folder import ORBIT_CSV, ORBIT_TOML, read_orbit, stated_turn
from optnav_cli.orbit.fit.predict import OrbitPath


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
    """Open the usable control points of catalogs, the first given before others; None without.

    Raises DataError for a catalog of another body or without usable points, and for one of an image
    beside one of relief: their errors follow other laws.
    """
    layers = [_make_layer(catalog, body) for catalog in catalogs]
    shown = [layer.name for layer in layers if layer.image_error_m is not None]
    if 0 < len(shown) < len(layers):
        raise DataError(
            f"{shown[0]}: is a catalog of an image, others given are of relief; name catalogs of "
            "one kind"
        )
    return ControlPointField(layers) if layers else None


def open_ground(catalogs: Sequence[Catalog], body: Body) -> ControlPointField | None:
    """Open all points that have patches: ground to cut windows from."""
    layers = [_make_layer(catalog, body, all_points=True) for catalog in catalogs]
    return ControlPointField(layers) if layers else None


def choose_relief(
    catalogs: Sequence[Catalog], named: Path | None, body: Body
) -> GlobalRelief | None:
    """Choose the body's relief: the named terrain model, else the finest that a catalog carries.

    None where there is none. Raises DataError for a damaged one or a model of a part of the body.
    """
    if named is not None:
        return load_relief(str(named), body)
    carried = [relief for c in catalogs if (relief := c.relief()) is not None]
    return min(carried, key=lambda relief: relief.posting_m, default=None)


def _make_layer(catalog: Catalog, body: Body, *, all_points: bool = False) -> PointLayer:
    meta, usable = catalog.meta, catalog.usable
    if all_points:
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
        body,
        meta.ground,
        None if meta.image is None else meta.image.error_m,
    )


SOURCE = "orbit"  # what solution.csv calls the prior

log = logging.getLogger(__name__)


def list_orbit_files(folder: Path) -> list[Path]:
    """List the files of an orbit's folder that priors are made from."""
    return [folder / name for name in (ORBIT_TOML, ORBIT_CSV, RUN_TOML)]


def add_orbit_priors(frames: Sequence[Frame], body: Body, folder: Path) -> list[Frame]:
    """Add the priors that an orbit predicts to frames with a time and without a position.

    Raises DataError for a folder that holds no orbit about the body.
    """
    orbit = read_orbit(folder)
    if orbit.body.name != body.name:
        raise DataError(
            f"{folder}: is an orbit about {orbit.body.name}; the pictures show {body.name}: name "
            "an orbit about it"
        )
    path = OrbitPath(orbit)
    open_s = [f.tdb_s for f in frames if f.position_m is None and f.tdb_s is not None]
    if not open_s:
        log.info("%s: each frame states its position, so the orbit is not used", folder)
    prediction = path.rows(np.unique(open_s))
    if prediction.meeting:
        log.warning("%s: %s; later frames have no prior", folder, prediction.meeting)
    rows, priors = prediction.rows, {}
    for time, state, spread in zip(rows.times, rows.states, rows.covariances, strict=True):
        turn = stated_turn(orbit.ephemeris, float(time))
        covariance = turn @ spread[:3, :3] @ turn.T
        frame = body.catalog_frame  # that of files, which catalogs may lie beside
        priors[float(time)] = PositionPrior(
            frame.transform_to_catalog(turn @ state[:3]),
            frame.transform_covariance_to_catalog(covariance),
            SOURCE,
        )
    return [
        frame
        if frame.position_m is not None or frame.tdb_s is None
        else replace(frame, predicted=priors.get(frame.tdb_s))
        for frame in frames
    ]
