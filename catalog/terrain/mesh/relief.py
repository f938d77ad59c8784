"""The coarse relief of a whole body that is given as a mesh."""

import numpy as np

from catalog.geometry.latlon import latlon_from_xyz
from catalog.terrain.mesh.terrain import MeshTerrain
from catalog.terrain.relief import GlobalRelief

RAYS_ASIDE = 4  # a side of a cell, whose mean stands for it
MOST_ROWS = 1440


def relief_of_mesh(terrain: MeshTerrain) -> GlobalRelief:
    """Means and tops of radii, as far out as the surface reaches, in cells half as wide as faces.

    On a flat face the radius is greatest at a corner or where a cell ends: tops are the greatest of
    the cell's rays and vertices, low by the rise of a face over an eighth of a cell at most.
    """
    radius = terrain.body.radius_m
    rows = min(MOST_ROWS, int(np.ceil(2.0 * np.pi * radius / terrain.posting_m)))
    step = np.pi / (rows * RAYS_ASIDE)
    lat = np.pi / 2.0 - (np.arange(rows * RAYS_ASIDE) + 0.5) * step
    lon = -np.pi + (np.arange(2 * rows * RAYS_ASIDE) + 0.5) * step
    means = np.empty((rows, 2 * rows), np.float32)
    tops = np.empty((rows, 2 * rows), np.float32)
    for row in range(rows):
        part = slice(row * RAYS_ASIDE, (row + 1) * RAYS_ASIDE)
        heights = terrain.heights(lat[part, None], lon[None, :], terrain.posting_m)
        cells = heights.reshape(RAYS_ASIDE, 2 * rows, RAYS_ASIDE)
        means[row], tops[row] = cells.mean(axis=(0, 2)), cells.max(axis=(0, 2))
    vertex_lat, vertex_lon, out = latlon_from_xyz(terrain.rays.corners.reshape(-1, 3))
    at = np.minimum(((np.pi / 2.0 - vertex_lat) * rows / np.pi).astype(np.int64), rows - 1)
    along = ((vertex_lon + np.pi) * rows / np.pi).astype(np.int64) % (2 * rows)
    np.maximum.at(tops, (at, along), (out - radius).astype(np.float32))
    return GlobalRelief(means, np.maximum(tops, means), radius, terrain.name)
