"""The bench's folder: what lies where in it, and whether the disk has room for it."""

import os
import shutil
from collections.abc import Iterable
from pathlib import Path

CHECKOUT = Path(__file__).resolve().parents[3]
MODEL = "moon/moon_gld100_32ppd.tif"  # of the shared data
MODEL_PPD = 32

RASTER_BYTES = 2.0  # a pixel: int16, not compressed
# What the building takes beside the raster, a pixel of it: overviews as if nothing were won by
# compression. The hillshade takes 1 and is gone before.
OVERVIEW_BYTES = 4.0 / 3.0
# Catalogs, of the full raster and of the model, at the size that the figures allow; results of the
# stages; builds of a strip; the model at 474 m.
OTHER_BYTES = 5e9


def model_path() -> Path | None:
    """The 32 px/deg model of the whole Moon; None where the shared data do not lie."""
    folder = os.environ.get("OPTNAV_SHARED_DATA")
    path = (Path(folder) if folder else CHECKOUT.parent / "shared" / "data") / MODEL
    return path if path.is_file() else None


def raster_path(folder: Path, ppd: int) -> Path:
    """The made raster of so many pixels a degree."""
    return folder / f"moon_{ppd}ppd.tif"


def lacking_room(folder: Path, ppd: int, replaced: Iterable[Path]) -> str | None:
    """A word about what is missing on the folder's disk; None when there is room.

    replaced  results of an earlier run, which this one removes
    """
    pixels = 180.0 * 360.0 * ppd**2
    raster = raster_path(folder, ppd)
    there = raster.stat().st_size if raster.is_file() else 0
    wanted = max(0.0, RASTER_BYTES * pixels - there) + OVERVIEW_BYTES * pixels + OTHER_BYTES
    free = shutil.disk_usage(folder).free + sum(map(size_of, replaced))
    if free >= wanted:
        return None
    return (
        f"{folder}: the disk has {free / 1e9:.1f} GB free, and {wanted / 1e9:.1f} GB are wanted "
        f"(raster {RASTER_BYTES * pixels / 1e9:.1f} GB, overviews and catalogs); "
        "name a folder on another disk"
    )


def size_of(path: Path) -> int:
    """Bytes of a file, or of all files in a folder; 0 for what is not there."""
    if path.is_dir():
        return sum(file.stat().st_size for file in path.rglob("*") if file.is_file())
    return path.stat().st_size if path.is_file() else 0
