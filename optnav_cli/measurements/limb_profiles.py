"""The pixels across a limb, how deep they lie inside the cone's curve, and the light expected."""

import numpy as np

from catalog.arrays import Float32Array, FloatArray, IntArray
from optnav_cli.camera.camera import Camera
from optnav_cli.measurements.edge_light import laws_across_limb
from optnav_cli.measurements.edge_profile import Profiles
from optnav_cli.measurements.edge_scan import Candidates
from optnav_cli.measurements.limb_cone import Cone, PixelRays, distances, stretched_rays
from optnav_cli.measurements.limb_search import BORDER_PX, outward_normals

# Profiles reach this far to the dark and to the bright side of the crossing, px along the scan,
# and so deep inside, px and in radii of the limb's bend: further in the ground's pattern rules.
BEFORE_PX, AFTER_PX = 7, 8
DEEPEST_PX, DEEPEST_SHARE = 6.0, 0.35


def profiles_across(
    picture: Float32Array,
    camera: Camera,
    limb: Candidates,
    where: PixelRays,
    cone: Cone,
    sun_camera: FloatArray | None,
) -> tuple[Profiles, IntArray, FloatArray]:
    """Profiles across the limb, their pixels (n, m, 2), the bend (n,) of the curve, 1 / px."""
    height, width = picture.shape
    middle = np.rint(limb.pixels).astype(np.int64)
    steps = np.arange(-BEFORE_PX, AFTER_PX + 1)
    places = middle[:, None] + steps[:, None] * limb.scan.astype(np.int64)[:, None]
    x, y = places[..., 0], places[..., 1]
    inside = (x >= 0) & (x < width) & (y >= 0) & (y < height)
    values = picture[np.clip(y, 0, height - 1), np.clip(x, 0, width - 1)].astype(np.float64)

    distance, inward = distances(cone, where)
    along = np.stack([-inward[:, 1], inward[:, 0]], axis=1)
    slope = np.hypot(where.by_x @ cone.axis, where.by_y @ cone.axis)
    # of the ray, not of the cone: a small body's limb may lie a tenth of its radius off the curve
    sine = np.sqrt(np.maximum(1.0 - (where.rays @ cone.axis) ** 2, 1e-30))
    rad_per_px = np.asarray(slope / sine, dtype=np.float64)
    rays = stretched_rays(camera, places.astype(np.float64), cone.stretch)
    depth = cone.depth(rays) / rad_per_px[:, None]
    # two pixels along the curve's tangent the curve has bent away by 2^2 / 2 radius
    aside = stretched_rays(
        camera, limb.pixels + np.array([[[2.0]], [[-2.0]]]) * along, cone.stretch
    )
    bend = -0.5 * ((cone.depth(aside) / rad_per_px).mean(axis=0) - distance)
    deepest = np.minimum(DEEPEST_PX, np.maximum(DEEPEST_SHARE / np.maximum(bend, 1e-6), 2.5))
    usable = inside & (depth < distance[:, None] + deepest[:, None])
    usable &= camera.contains(places.astype(np.float64), BORDER_PX - 3)
    depth = np.where(usable, depth, np.nan)

    normal = outward_normals(where, inward, cone.stretch)
    back = np.linalg.solve(cone.stretch, where.rays.T).T
    ray = np.asarray(back / np.linalg.norm(back, axis=1, keepdims=True), dtype=np.float64)
    middle_phase = 1.0 if sun_camera is None else -float(cone.axis_camera() @ sun_camera)
    laws = laws_across_limb(normal, ray, sun_camera, cone.angle, rad_per_px, middle_phase)
    return Profiles(values, depth, distance, laws), places, np.asarray(bend)
