"""One pass of `gdaldem hillshade` over a raster: the yardstick of the figures."""

import shutil
import subprocess
import time
from pathlib import Path

OPTIONS = ("-co", "TILED=YES", "-co", "BIGTIFF=YES")  # bytes, tiled, not compressed


def command(raster: Path, output: Path) -> list[str]:
    """The command that is timed."""
    return ["gdaldem", "hillshade", "-q", *OPTIONS, str(raster), str(output)]


def seconds(raster: Path) -> float | None:
    """Clock time of one pass, written beside the raster and removed; None without gdaldem."""
    if shutil.which("gdaldem") is None:
        return None
    output = raster.with_name("moon_hillshade.tif")
    try:
        started = time.monotonic()
        subprocess.run(command(raster, output), check=True)
        return time.monotonic() - started
    finally:
        output.unlink(missing_ok=True)
