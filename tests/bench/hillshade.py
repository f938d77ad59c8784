"""GDAL's hillshade, the yardstick of two benches.

The command `gdaldem` where it is installed, else the same function of the GDAL library that
rasterio brings: `python -m tests.bench.hillshade RASTER OUTPUT` is then as good as
`gdaldem hillshade -q RASTER OUTPUT`.
"""

import ctypes
import shutil
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path


def command(raster: Path, output: Path, *options: str) -> list[str]:
    """The command that makes a hillshade, with the options of gdaldem."""
    words = [str(raster), str(output), *options]
    if shutil.which("gdaldem") is not None:
        return ["gdaldem", "hillshade", "-q", *words]
    return [sys.executable, "-m", "tests.bench.hillshade", *words]


def make(raster: Path, output: Path) -> None:
    """Make a hillshade by the command gdaldem, or here by rasterio's GDAL."""
    words = command(raster, output)
    if words[0] == "gdaldem":
        subprocess.run(words, check=True)
    else:
        hillshade(words[3:])


def hillshade(words: Sequence[str]) -> None:
    """Make a hillshade by rasterio's own GDAL: raster, output, options as for the command."""
    gdal = _library()
    pointer = ctypes.c_void_p
    for function in (gdal.GDALOpen, gdal.GDALDEMProcessingOptionsNew, gdal.GDALDEMProcessing):
        function.restype = pointer
    gdal.GDALAllRegister()
    given = (ctypes.c_char_p * (len(words) - 1))(*(word.encode() for word in words[2:]), None)
    raster = pointer(gdal.GDALOpen(words[0].encode(), 0))
    options = pointer(gdal.GDALDEMProcessingOptionsNew(given, None))
    shaded = pointer(
        gdal.GDALDEMProcessing(words[1].encode(), raster, b"hillshade", None, options, None)
    )
    if not (raster and shaded):
        raise SystemExit(f"hillshade: {words[0]}: GDAL cannot shade it")
    gdal.GDALClose(shaded)
    gdal.GDALClose(raster)
    gdal.GDALDEMProcessingOptionsFree(options)


def _library() -> ctypes.CDLL:
    import rasterio  # loads the library and what that needs

    found = sorted((Path(rasterio.__file__).parents[1] / "rasterio.libs").glob("libgdal*"))
    if not found:
        raise SystemExit("hillshade: this rasterio brings no GDAL of its own; install gdaldem")
    return ctypes.CDLL(str(found[0]))


if __name__ == "__main__":
    hillshade(sys.argv[1:])
