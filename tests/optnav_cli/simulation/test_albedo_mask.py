"""An albedo map's pixels without a value count nowhere: mask, alpha, no-data of few digits."""

import numpy as np
import pytest
import rasterio
from rasterio.enums import ColorInterp
from rasterio.transform import Affine

from catalog.bodies.body import load_body
from catalog.geometry.latlon import xyz_from_latlon
from optnav_cli.simulation.albedo import AlbedoMap
from optnav_cli.simulation.sections import AlbedoMapSettings

ROWS, COLS = 30, 60


@pytest.mark.parametrize("how", ["alpha", "mask", "nodata"])
def test_hidden_pixels_of_an_albedo_map_change_no_brightness(tmp_path, how):
    values = np.full((ROWS, COLS), 100.0, np.float32)
    values[:, : COLS // 2] = 50.0
    valid = np.ones(values.shape, bool)
    valid[20:, :] = False
    stored = np.where(valid, values, np.float32(-3.4028235e38 if how == "nodata" else 9000.0))
    affine = Affine(360.0 / COLS, 0.0, -180.0, 0.0, -180.0 / ROWS, 90.0)
    profile = {"driver": "GTiff", "height": ROWS, "width": COLS, "transform": affine}
    profile |= {"crs": "+proj=longlat +R=1737400 +no_defs", "dtype": "float32", "count": 1}
    if how == "nodata":
        profile["nodata"] = -3.4e38
    path = tmp_path / "albedo.tif"
    profile["count"] = 2 if how == "alpha" else 1
    with rasterio.open(path, "w", **profile) as file:
        file.write(stored, 1)
        if how == "alpha":
            file.write(valid.astype(np.float32), 2)
            file.colorinterp = ColorInterp.gray, ColorInterp.alpha
        elif how == "mask":
            file.write_mask(valid)
    made = AlbedoMap(AlbedoMapSettings(path=str(path), coding="linear"), load_body("moon"))
    lat, lon = np.radians([60.0, 60.0, -80.0]), np.radians([-90.0, 90.0, 0.0])
    brightness = made.at(xyz_from_latlon(lat, lon, 1.0))
    np.testing.assert_allclose(brightness, [50.0 / 75.0, 100.0 / 75.0, 1.0], rtol=1e-5)
