"""Pictures of a body whose truth is a mesh: its whole disc, its limb or its ground, in one way."""

import numpy as np

from catalog.arrays import Float32Array, FloatArray
from catalog.rendering.mesh_scene import MeshScene
from optnav_cli.camera.camera import Camera
from optnav_cli.simulation.shot import Exposure
from optnav_cli.simulation.truth_mesh import TruthMesh

LIMB_SAMPLES = 8  # rays a side of a pixel at the limb: its share of sky is right to 0.01
MAX_SAMPLES = 32  # rays a side of any pixel: for a body that is smaller than that many faces
MARGIN_PX = 2.0  # about the ball that holds the body


class MeshRenderer:
    """Pictures by one camera."""

    def __init__(self, truth: TruthMesh, camera: Camera) -> None:
        self._truth, self._camera = truth, camera
        # rays through the corners of the pixels; sub-pixel rays lie between them
        x, y = np.meshgrid(np.arange(camera.width_px + 1), np.arange(camera.height_px + 1))
        self._corners = camera.unproject(np.stack([x, y], axis=-1) - 0.5)

    def radiance(self, shot: Exposure) -> Float32Array:
        """Mean radiance factor over each pixel (height, width) of a shot, sky 0."""
        ground = self._truth.ground(shot.ground_seed)
        out = np.zeros(self._camera.shape, np.float32)
        box = self._box(shot, ground.reach_m)
        if box is None:
            return out
        rows, cols = box
        pixel_m = float(np.linalg.norm(shot.position_m)) * self._camera.angular_resolution
        # so many rays that none stands for more ground than a face
        aside = int(np.clip(np.ceil(pixel_m / self._truth.posting_m), 1, MAX_SAMPLES))
        corners = self._corners[rows.start : rows.stop + 1, cols.start : cols.stop + 1]
        rays = _between(corners, aside) @ shot.camera_from_body.as_matrix()
        scene = MeshScene(ground, shot.sun_body)
        fine = scene.picture(shot.position_m, rays, samples=-(-LIMB_SAMPLES // aside))
        shape = rows.stop - rows.start, aside, cols.stop - cols.start, aside
        out[rows, cols] = fine.reshape(shape).mean(axis=(1, 3))
        return out

    def _box(self, shot: Exposure, reach_m: float) -> tuple[slice, slice] | None:
        """Rows and columns of the pixels that may show the body; None for none."""
        distance = float(np.linalg.norm(shot.position_m))
        centre = shot.camera_from_body.apply(-shot.position_m / distance)
        angle = np.arcsin(reach_m / distance) + MARGIN_PX * self._camera.angular_resolution
        near = self._corners @ centre > np.cos(angle)  # NaN, where the lens sees nothing, is not
        if not near.any():
            return None
        found = []
        for axis in (1, 0):
            at = np.flatnonzero(near.any(axis=axis))
            last = near.shape[1 - axis] - 1
            found.append(slice(max(int(at[0]) - 1, 0), min(int(at[-1]) + 1, last)))
        return found[0], found[1]


def _between(corners: FloatArray, aside: int) -> FloatArray:
    """Corners (rows, cols, 3) with `aside` - 1 more between neighbours, straight lines apart."""
    if aside == 1:
        return corners
    for axis in (0, 1):
        steps = corners.shape[axis] - 1
        at = np.arange(steps * aside + 1) / aside
        low = np.minimum(at.astype(int), steps - 1)
        share = (at - low).reshape((-1, 1, 1) if axis == 0 else (1, -1, 1))
        first, second = np.take(corners, low, axis), np.take(corners, low + 1, axis)
        corners = first + share * (second - first)
    return corners
