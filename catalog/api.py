"""The world for Python users: build a catalog of control points, open it, ask it.

    from catalog import api

    if __name__ == "__main__":
        report = api.build_catalog("moon.toml", "moon.gpkg")
        with api.open_catalog("moon.gpkg") as catalog:
            point = catalog.point(catalog.nearest(-43.3, -11.2))
            heights_m = catalog.patches(point.id)[0].heights_m

All errors that a user can mend are an `OptnavError`.
"""

from pathlib import Path

from catalog.control_point import ControlPoint, Flag, Patch
from catalog.errors import OptnavError
from catalog.pipeline.build import BuildReport, run
from catalog.pipeline.ingest import Bbox
from catalog.progress import Progress
from catalog.store.reader import Catalog
from catalog.store.verify import Verification, verify

__all__ = [
    "BuildReport",
    "Catalog",
    "ControlPoint",
    "Flag",
    "OptnavError",
    "Patch",
    "Verification",
    "build_catalog",
    "open_catalog",
    "verify_catalog",
]


def build_catalog(
    config: str | Path,
    output: str | Path,
    *,
    bbox: Bbox | None = None,
    workers: int | None = None,
    progress: Progress | None = None,
) -> BuildReport:
    """Build a catalog, or go on with a build that was stopped.

    config    a build config, as `optnav config template build` prints it
    output    the catalog file; what is done is kept in OUTPUT.work beside it
    bbox      west, south, east, north (deg): only cells whose middle lies inside
    workers   processes; 1 works in this one, None takes all cores. Workers import the main script
              again, so guard its calls with `if __name__ == "__main__":` unless this is 1
    progress  shows how far it is; nothing is shown without it
    Raises NothingToDoError, though the catalog is written, where no point of it is usable;
    another OptnavError for a config, terrain model or place that cannot be used.
    """
    return run(Path(config), output=Path(output), workers=workers, bbox=bbox, progress=progress)


def open_catalog(path: str | Path) -> Catalog:
    """Open a catalog to read; close it, or use it in a `with` statement.

    `ids`, `lat_deg`, `lon_deg`, `radius_m` and `usable` are arrays over all points; `nearest` and
    `within` find points by place; `point` gives one with its certificate, `patches` its heights,
    `relief` the coarse ground of the whole body.
    Raises DataError for a file that is no whole catalog.
    """
    return Catalog.open(path)


def verify_catalog(path: str | Path) -> Verification:
    """Read all of a catalog and check every checksum. Raises DataError for no catalog at all."""
    return verify(path)
