"""A small disc drawn as the edge model expects it, to take out what one dimension leaves.

A profile across the limb is fitted as if the limb were straight and lit alike along it. On a disc
of less than some sixty pixels' radius bend and light change within a profile. The same fit to the
same pixels of a drawn disc, whose limb is where the cone says, shows by how much it errs.
"""

from dataclasses import replace

import cv2
import numpy as np

from catalog.arrays import FloatArray, IntArray
from optnav_cli.camera.camera import Camera
from optnav_cli.measurements.bright_body import Levels
from optnav_cli.measurements.edge_light import three_laws
from optnav_cli.measurements.edge_profile import EdgeShape, Profiles, locate_edges
from optnav_cli.measurements.limb_cone import Cone, stretched_rays

LARGEST_RADIUS_PX = 60.0  # beyond it the straight limb's error is below 0.01 px
FINE = 4  # sub-pixels a side
MARGIN_PX = 12
PIXEL_VARIANCE = 1.0 / 12.0  # of a pixel's own width, which `blur_px` includes


def edge_bias_px(
    profiles: Profiles,
    places: IntArray,
    camera: Camera,
    cone: Cone,
    sun_camera: FloatArray,
    shape: EdgeShape,
    levels: Levels,
) -> FloatArray:
    """Depth (n,) at which profiles on a drawn disc find its limb, which lies at depth 0.

    places (n, m, 2) pixels of the profiles;  sun_camera (3,) unit vector to the Sun.
    """
    corner = places.reshape(-1, 2).min(axis=0) - MARGIN_PX
    size = places.reshape(-1, 2).max(axis=0) + MARGIN_PX - corner + 1
    drawn = draw_disc(camera, cone, sun_camera, shape, corner, size)
    x, y = places[..., 0] - corner[0], places[..., 1] - corner[1]
    lit = drawn[drawn > 0.2 * drawn.max()]
    values = levels.sky + drawn[y, x] * ((levels.bright - levels.sky) / float(np.median(lit)))
    return locate_edges(replace(profiles, values=values), shape, levels, np.inf).depth


def draw_disc(
    camera: Camera,
    cone: Cone,
    sun_camera: FloatArray,
    shape: EdgeShape,
    corner: IntArray,
    size: IntArray,
) -> FloatArray:
    """Brightness (height, width), any unit, of the body about a cone, blurred, over pixels.

    corner, size  x, y of the first pixel; width and height
    """
    x = corner[0] + (np.arange(FINE * size[0]) + 0.5) / FINE - 0.5
    y = corner[1] + (np.arange(FINE * size[1]) + 0.5) / FINE - 0.5
    pixels = np.stack(np.meshgrid(x, y), axis=-1)
    rays = stretched_rays(camera, pixels, cone.stretch)
    depth = cone.depth(rays)
    turn = stretched_rays(
        camera, np.array([[x.mean(), y.mean()], [x.mean() + 1.0, y.mean()]]), cone.stretch
    )
    rad_per_fine = float(np.linalg.norm(turn[1] - turn[0])) / FINE
    covered = np.clip(0.5 + depth / rad_per_fine, 0.0, 1.0)
    near = covered > 0.0
    rays, depth = rays[near], depth[near]
    # the middle of what of a cut sub-pixel is covered stands for it
    off = cone.angle - np.maximum(depth, 0.1 * rad_per_fine)
    sine = np.sin(off) / np.sin(cone.angle)
    cosine = np.sqrt(1.0 - sine**2)
    outward = rays - (rays @ cone.axis)[:, None] * cone.axis
    side = outward - (outward * rays).sum(axis=1, keepdims=True) * rays
    side /= np.maximum(np.linalg.norm(side, axis=1, keepdims=True), 1e-15)
    normal = (sine[:, None] * side - cosine[:, None] * rays) @ cone.stretch
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    seen = np.linalg.solve(cone.stretch, rays.T).T
    seen /= np.linalg.norm(seen, axis=1, keepdims=True)
    mu0, mu, cos_phase = normal @ sun_camera, -(normal * seen).sum(axis=1), -(seen @ sun_camera)
    second, third = shape.mixture
    laws = three_laws(mu0, mu, cos_phase, -float(cone.axis_camera() @ sun_camera))
    mixed = (1.0 - second - third) * laws[0] + second * laws[1] + third * laws[2]
    light = np.where(mu0 > 0.0, mixed, 0.0)
    fine = np.zeros(covered.shape)
    fine[near] = light * covered[near]
    blur = np.sqrt(max(shape.blur_px**2 - PIXEL_VARIANCE, 0.05)) * FINE
    blurred = cv2.GaussianBlur(fine, (0, 0), blur)
    whole = cv2.resize(blurred, (int(size[0]), int(size[1])), interpolation=cv2.INTER_AREA)
    return np.asarray(whole, dtype=np.float64)
