"""Where the nodes of a map grid fall in a raster, against each node worked out by itself."""

import numpy as np
import pytest

from catalog.bodies.body import load_body
from catalog.config import resource
from catalog.geometry.projection import Stereographic
from catalog.terrain.dem.source import DemSettings, DemSource
from catalog.terrain.sampling.map_nodes import STEPS, locate_grid, locate_points


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    dem = DemSettings(path=str(resource("data/moon_gld100_4ppd.tif")))
    return DemSource.open(dem, tmp_path_factory.mktemp("base"), load_body("moon")).georeference


@pytest.mark.parametrize("size", [*range(2, 5 * STEPS[0] + 3), 80, 81, 330, 401])
@pytest.mark.parametrize("lat_deg", [-44.0, 70.0, 89.5])
def test_nodes_of_grids_of_any_size_are_where_their_points_are(place, size, lat_deg):
    """Within a hundredth of a posting; the last nodes of 8 n + 1 need a row more to interpolate."""
    projection = Stereographic(np.radians(lat_deg), np.radians(179.9), 1_737_400.0)
    posting = 948.0
    offsets = (np.arange(size) - (size - 1) / 2.0) * posting
    lat, lon = projection.latlon(*np.meshgrid(offsets, -offsets))
    alone = locate_points(place, lat.ravel(), lon.ravel())
    made = locate_grid(place, projection, posting, size)
    node = posting / (1_737_400.0 * place.row_angle)  # rows in a posting
    turn = (made.col - alone.col + place.period / 2.0) % place.period - place.period / 2.0
    assert np.abs(made.row - alone.row).max() < 0.01 * node
    assert np.abs(turn / alone.column_scale).max() < 0.01 * node
    np.testing.assert_allclose(made.column_scale, alone.column_scale, rtol=0.01)
