"""One pass of `gdaldem hillshade` over a raster: the yardstick of the figures."""

import shutil
import subprocess
from pathlib import Path

from tests.bench.global_moon.clock import Used, run

OPTIONS = ("-co", "TILED=YES", "-co", "BIGTIFF=YES")  # bytes, tiled, not compressed


def command(raster: Path, output: Path) -> list[str]:
    """The command that is timed."""
    return ["gdaldem", "hillshade", "-q", *OPTIONS, str(raster), str(output)]


def one_pass(raster: Path, folder: Path) -> Used | None:
    """Time of one pass, written into a folder and removed; None without gdaldem.

    Raises SystemExit when it fails.
    """
    if shutil.which("gdaldem") is None:
        return None
    output = folder / "bench_hillshade.tif"
    try:
        return run(command(raster, output), stdout=subprocess.DEVNULL)
    finally:
        output.unlink(missing_ok=True)
