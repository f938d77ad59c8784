"""The radiance that a camera at a known place sees."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from catalog.arrays import Float32Array, FloatArray
from catalog.geometry.ellipsoid import distance_to_sphere
from catalog.rendering.rays.scene import Scene
from optnav_cli.camera.camera import Camera
from optnav_cli.simulation.shot import Exposure
from optnav_cli.simulation.truth_terrain import Box, TruthTerrain

PROBE_PX = 64  # distance of the rays that find out which ground a picture shows
NARROW = np.radians(60.0)  # wider cameras get all the fine ground there is
SHARED_NODES = 40_000_000  # a scene of several pictures holds no more than this
Index = slice | NDArray[Any]
ALL = slice(None)
WHOLE: Box = (-np.pi, -0.5 * np.pi, np.pi, 0.5 * np.pi)


class Renderer:
    """Pictures of one terrain by one camera, shot by shot in their order.

    Neighbouring shots of a pass that see nearly the same ground share one scene, so its terrain is
    made and its shadows are cast once. Which do follows from the shots alone.
    """

    def __init__(self, terrain: TruthTerrain, camera: Camera, flight: Sequence[Exposure]) -> None:
        self._terrain, self._camera = terrain, camera
        # rays through the corners of the pixels; sub-pixel rays lie between them
        x, y = np.meshgrid(np.arange(camera.width_px + 1), np.arange(camera.height_px + 1))
        self._corners = camera.unproject(np.stack([x, y], axis=-1) - 0.5)
        self._ground = self._plan(flight)
        self._scene: Scene | None = None
        self._scene_key: tuple[object, ...] = ()

    def radiance(self, shot: Exposure) -> Float32Array:
        """Mean radiance factor over each pixel (height, width), sky 0, of a shot of the flight."""
        factor, box = self._ground[shot.index]
        key = (shot.ground_seed, factor, box, shot.sun_body.tobytes())
        if self._scene is None or key != self._scene_key:
            self._scene = None  # let go of the old one before the new one is made
            fine = self._terrain.window(shot.ground_seed, factor, box)
            between = None
            if box != WHOLE:
                between = self._terrain.window(shot.ground_seed, 1, WHOLE)
            self._scene = Scene(fine, self._terrain.wide(shot.ground_seed), shot.sun_body, between)
            self._scene_key = key
        return self._scene.picture(shot.position_m, self._rays(shot))

    def _rays(self, shot: Exposure, rows: Index = ALL, cols: Index = ALL) -> FloatArray:
        """Rays through pixel corners, body frame."""
        rotation = shot.camera_from_body.inv().as_matrix()
        return np.asarray(self._corners[rows][:, cols] @ rotation.T)

    def _plan(self, flight: Sequence[Exposure]) -> dict[int, tuple[int, Box]]:
        """Fineness and box of the ground for each shot, by its index."""
        plan: dict[int, tuple[int, Box]] = {}
        group: list[Exposure] = []
        shared: Box = WHOLE
        for shot in flight:
            box, gsd = self._footprint(shot)
            factor = self._terrain.factor_for(gsd)
            last = group[-1] if group else None
            joined = _around(shared, box) if last else box
            if (
                last is None
                or last.pass_index != shot.pass_index
                or plan[last.index][0] != factor
                or self._terrain.nodes(factor, joined) > SHARED_NODES
            ):
                group, joined = [], box
            group.append(shot)
            shared = joined
            for member in group:
                plan[member.index] = (factor, shared)
        return plan

    def _footprint(self, shot: Exposure) -> tuple[Box, float]:
        """The box of ground that a picture shows, with a margin for relief, and its finest GSD."""
        body, position = self._terrain.body, shot.position_m
        radius = body.radius_m
        height = float(np.linalg.norm(position)) - radius
        gsd = max(height, 1.0) * self._camera.angular_resolution
        rows, cols = self._camera.shape
        r = np.unique(np.append(np.arange(0, rows, PROBE_PX), rows))
        c = np.unique(np.append(np.arange(0, cols, PROBE_PX), cols))
        rays = self._rays(shot, r, c)
        along = distance_to_sphere(position, rays, radius)
        cosine = rays.reshape(-1, 3) @ (-position / np.linalg.norm(position))
        if not np.isfinite(along).all() or np.nanmin(cosine) < np.cos(NARROW):
            return WHOLE, gsd
        points = position + along[..., None] * rays
        lat = np.arcsin(points[..., 2] / radius)
        middle = np.arctan2(position[1], position[0])
        lon = np.arctan2(points[..., 1], points[..., 0])
        lon = middle + np.mod(lon - middle + np.pi, 2.0 * np.pi) - np.pi
        # relief moves what a slanted ray meets; the tangent of the slant is at most this
        slant = np.tan(np.arccos(np.nanmin(cosine)))
        relief = max(abs(body.plausible_heights_m[0]), body.plausible_heights_m[1])
        margin = (relief * slant + 500.0) / radius
        wider = margin / np.cos(min(np.abs(lat).max() + margin, 1.5))
        return (
            float(lon.min() - wider), float(lat.min() - margin),
            float(lon.max() + wider), float(lat.max() + margin),
        ), gsd  # fmt: skip


def _around(a: Box, b: Box) -> Box:
    """The box around two; the second one is brought to the first one's turn of longitude."""
    turn = 2.0 * np.pi * round((a[0] + a[2] - b[0] - b[2]) / (4.0 * np.pi))
    west, east = min(a[0], b[0] + turn), max(a[2], b[2] + turn)
    return west, min(a[1], b[1]), east, max(a[3], b[3])
