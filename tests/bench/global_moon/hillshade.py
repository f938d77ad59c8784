"""One pass of GDAL's hillshade over a raster: the yardstick of the figures."""

import subprocess
from pathlib import Path

from tests.bench import hillshade
from tests.bench.global_moon.clock import Used, run

OPTIONS = ("-co", "TILED=YES", "-co", "BIGTIFF=YES")  # bytes, tiled, not compressed


def one_pass(raster: Path, folder: Path) -> Used:
    """Time of one pass, written into a folder and removed. Raises SystemExit when it fails."""
    output = folder / "bench_hillshade.tif"
    try:
        return run(hillshade.command(raster, output, *OPTIONS), stdout=subprocess.DEVNULL)
    finally:
        output.unlink(missing_ok=True)
