"""Ground of a small body: its shape model, refined and roughened, seen whole or from near by."""

from functools import lru_cache
from pathlib import Path

import numpy as np

from catalog.arrays import Float32Array, FloatArray
from catalog.bodies.body import Body
from catalog.cache import Cache
from catalog.errors import ConfigError
from catalog.rendering.mesh_scene import MeshScene
from catalog.terrain.mesh.file import MeshSettings
from catalog.terrain.mesh.rays import MeshRays
from catalog.terrain.mesh.refine import FINEST_FACES, add_detail, refine_shape
from catalog.terrain.mesh.shape import load_shape
from optnav_cli.camera.camera import Camera
from optnav_cli.simulation.exposure import CAMERAS, Exposure, corner_rays
from optnav_cli.simulation.sections import DetailSettings, relief_below

LIMB_SAMPLES = 8  # rays a side of a pixel at the limb: its share of sky is right to 0.01
MAX_SAMPLES = 32  # rays a side of any pixel: for a body that is smaller than that many faces
MARGIN_PX = 2.0  # about the ball that holds the body


class MeshGround:
    """The meshes of a scenario, one a seed; the last one asked for is kept.

    Raises ConfigError or DataError for a shape model that cannot be used.
    """

    def __init__(self, shape: MeshSettings, detail: DetailSettings, body: Body) -> None:
        self._detail, self._radius_m = detail, body.radius_m
        model = load_shape(shape, Path.cwd(), body)
        smallest = detail.smallest_m
        # halved until there are about two edges to the finest relief
        halvings = max(0, round(float(np.log2(2.0 * model.posting_m / smallest))))
        if len(model.faces) * 4**halvings > FINEST_FACES:
            raise ConfigError(
                f"[detail] smallest_m is {smallest:g}, for which the {len(model.faces)} faces of "
                f"{Path(shape.path).name} would become {len(model.faces) * 4**halvings}; "
                f"up to {FINEST_FACES} are possible: raise it"
            )
        self._model_posting_m = model.posting_m
        self._shape = refine_shape(model, halvings)
        self.posting_m = self._shape.posting_m
        self._meshes: Cache[int | None, MeshRays] = Cache(1)
        self._corners = lru_cache(maxsize=CAMERAS)(corner_rays)

    def mesh(self, seed: int | None) -> MeshRays:
        """The mesh of a seed, with its relief; without any for None. The last one is kept."""
        return self._meshes.get(seed, lambda: self._made(seed))

    def _made(self, seed: int | None) -> MeshRays:
        shape, posting = self._shape, self._model_posting_m
        if seed is not None:
            shape = add_detail(shape, relief_below(self._detail, seed, posting, self._radius_m))
        return MeshRays(shape.vertices[shape.faces])

    def radiance(self, camera: Camera, exposure: Exposure) -> Float32Array:
        """Mean radiance factor over each pixel (height, width) of a picture, sky 0."""
        ground = self.mesh(exposure.ground_seed)
        out = np.zeros(camera.shape, np.float32)
        rays = self._corners(camera)
        box = _box(camera, rays, exposure, ground.reach_m)
        if box is None:
            return out
        rows, cols = box
        pixel_m = float(np.linalg.norm(exposure.position_m)) * camera.angular_resolution
        # so many rays that none stands for more ground than a face
        aside = int(np.clip(np.ceil(pixel_m / self.posting_m), 1, MAX_SAMPLES))
        corners = rays[rows.start : rows.stop + 1, cols.start : cols.stop + 1]
        fine_rays = _between(corners, aside) @ exposure.camera_from_body.as_matrix()
        scene = MeshScene(ground, exposure.sun_body)
        fine = scene.picture(exposure.position_m, fine_rays, samples=-(-LIMB_SAMPLES // aside))
        shape = rows.stop - rows.start, aside, cols.stop - cols.start, aside
        out[rows, cols] = fine.reshape(shape).mean(axis=(1, 3))
        return out


def _box(
    camera: Camera, corners: FloatArray, exposure: Exposure, reach_m: float
) -> tuple[slice, slice] | None:
    """Rows and columns of the pixels that may show the body; None for none."""
    distance = float(np.linalg.norm(exposure.position_m))
    centre = exposure.camera_from_body.apply(-exposure.position_m / distance)
    angle = np.arcsin(reach_m / distance) + MARGIN_PX * camera.angular_resolution
    near = corners @ centre > np.cos(angle)  # NaN, where the lens sees nothing, is not
    if not near.any():
        return None
    spans = []
    for axis in (1, 0):
        at = np.flatnonzero(near.any(axis=axis))
        last = near.shape[1 - axis] - 1
        spans.append(slice(max(int(at[0]) - 1, 0), min(int(at[-1]) + 1, last)))
    return spans[0], spans[1]


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
