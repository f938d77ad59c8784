"""Pictures of a body without a terrain model of a region: limb, full disc, any place below."""

import numpy as np

from catalog.arrays import Float32Array, FloatArray
from catalog.rendering.rays.scene import Scene
from optnav_cli.camera.camera import Camera
from optnav_cli.simulation.globe_heights import GlobeHeights
from optnav_cli.simulation.globe_terrain import (
    CENTRES,
    LEVEL_POSTINGS,
    MAX_LEVEL,
    MAX_NODES,
    NODES_A_PIXEL,
    GlobeTerrain,
    View,
    fixed_centre,
    level_frame,
)
from optnav_cli.simulation.shot import Exposure

PROBE_PX = 32  # distance of the rays that find out which ground a picture shows
ROUND = np.radians(2.0)  # boxes are widened to multiples of it, so that neighbours share them
MARGIN = np.radians(1.0)  # relief and what lies between the probing rays
LIMB_SAMPLES = 8  # rays a side of a pixel at the limb: its share of sky is right to 0.01


class GlobeRenderer:
    """Pictures by one camera; `grounds` has the terrain of each seed."""

    def __init__(
        self, heights: GlobeHeights, grounds: dict[int | None, GlobeTerrain], camera: Camera
    ) -> None:
        self._heights, self._grounds, self._camera = heights, grounds, camera
        # rays through the corners of the pixels; sub-pixel rays lie between them
        x, y = np.meshgrid(np.arange(camera.width_px + 1), np.arange(camera.height_px + 1))
        self._corners = camera.unproject(np.stack([x, y], axis=-1) - 0.5)

    def radiance(self, shot: Exposure) -> Float32Array:
        """Mean radiance factor over each pixel (height, width) of a shot, sky 0."""
        body_from_camera = shot.camera_from_body.inv().as_matrix()
        view = self._view(shot.position_m, body_from_camera)
        if view is None:
            return np.zeros(self._camera.shape, np.float32)
        ground = self._grounds[shot.ground_seed]
        grid_from_body, fine, wide = ground.window(view, shot.sun_body)
        scene = Scene(fine, wide, grid_from_body @ shot.sun_body)
        rays = self._corners @ (grid_from_body @ body_from_camera).T
        return scene.picture(grid_from_body @ shot.position_m, rays, limb_samples=LIMB_SAMPLES)

    def _view(self, position: FloatArray, body_from_camera: FloatArray) -> View | None:
        """The ground that a picture shows, None when it shows only sky."""
        rows, cols = self._camera.shape
        r = np.unique(np.append(np.arange(0, rows, PROBE_PX), rows))
        c = np.unique(np.append(np.arange(0, cols, PROBE_PX), cols))
        rays = (self._corners[r][:, c] @ body_from_camera.T).reshape(-1, 3)
        distance = float(np.linalg.norm(position))
        seen = _seen(self._heights, position, rays, PROBE_PX * self._camera.angular_resolution)
        if seen is None:
            return None
        radius = self._heights.radius_m
        horizon = np.sqrt(max(distance**2 - radius**2, 1e6))
        wanted = horizon * self._camera.angular_resolution / NODES_A_PIXEL
        centre = fixed_centre(seen.mean(axis=0))
        box = _box(seen @ level_frame(centre).T)
        there = next(iter(self._grounds.values())).postings()
        if box is None:
            centre = fixed_centre(position)
            nodes = 2.0 * np.pi * np.radians(102.0)
            posting = _posting(there, wanted)
        else:
            posting = _posting(there[:LEVEL_POSTINGS], wanted)
            nodes = (box[2] - box[0]) * (box[3] - box[1])
        while nodes * (radius / posting) ** 2 > MAX_NODES:
            posting *= 2.0
        return View(tuple(centre.tolist()), box, posting)


def _posting(there: FloatArray, wanted_m: float) -> float:
    """The coarsest of postings (n,), finest first, not above the wanted one, else the finest."""
    fine_enough = there[there <= wanted_m]
    return float(fine_enough[-1] if fine_enough.size else there[0])


def _seen(
    heights: GlobeHeights, position: FloatArray, rays: FloatArray, apart: float
) -> FloatArray | None:
    """Directions (n, 3) from the body's centre to ground that rays may meet, None for none.

    A ray can meet ground between the spheres of the highest and the lowest height.
    """
    rays = rays[np.isfinite(rays).all(axis=1)]
    top, floor = heights.radius_m + heights.highest_m, heights.radius_m + heights.lowest_m
    along = rays @ position
    square = float(position @ position)
    clear = along**2 - square + top**2
    # between two probing rays that miss, a third may graze the body
    nearest = np.sqrt(np.maximum(square - along**2, 0.0)) - top
    close = (along < 0.0) & (nearest < apart * np.sqrt(square))
    inside = close | (square < top**2)
    if not inside.any():
        return None
    rays, along, clear = rays[inside], along[inside], np.maximum(clear[inside], 0.0)
    start = np.maximum(-along - np.sqrt(clear), 0.0)
    end = np.maximum(-along + np.sqrt(clear), 0.0)
    below = along**2 - square + floor**2
    ends = (below > 0.0) & (along < 0.0)
    end[ends] = -along[ends] - np.sqrt(below[ends])
    points = [position + s[:, None] * rays for s in (start, 0.5 * (start + end), end)]
    found = np.concatenate(points)
    return np.asarray(found / np.linalg.norm(found, axis=1)[:, None])


def _box(seen: FloatArray) -> tuple[float, float, float, float] | None:
    """The rounded box around directions in a level frame, None when it would reach too far."""
    lat = np.arcsin(np.clip(seen[:, 2], -1.0, 1.0))
    lon = np.arctan2(seen[:, 1], seen[:, 0])
    edges = np.array([lon.min(), lat.min(), lon.max(), lat.max()]) + MARGIN * np.array(
        [-1.0, -1.0, 1.0, 1.0]
    )
    if np.abs(edges).max() + 0.5 * CENTRES > MAX_LEVEL:
        return None
    low, high = np.floor(edges[:2] / ROUND) * ROUND, np.ceil(edges[2:] / ROUND) * ROUND
    return float(low[0]), float(low[1]), float(high[0]), float(high[1])
