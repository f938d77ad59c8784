"""Limb points made without pictures: the skyline of a finer ground, put into a camera."""

from functools import cache

import numpy as np
from scipy.spatial.transform import Rotation

from catalog.bodies.body import load_body
from catalog.terrain.relief.relief import GlobalRelief
from catalog.terrain.skyline.limb import LimbRelief, make_nadir_axes
from optnav_cli.camera.camera_file import preset_camera
from optnav_cli.outline.limb.detection import LimbPoints

MOON = load_body("moon")
CAMERA = preset_camera("shnk")
ROWS = 720  # of the truth: 7.6 km; navigators know half as many


@cache
def grounds() -> tuple[GlobalRelief, GlobalRelief]:
    """A made Moon with hills like the real one's, and the coarse relief of it."""
    rng = np.random.default_rng(11)
    lat = np.pi * (0.5 - (np.arange(ROWS) + 0.5) / ROWS)[:, None]
    lon = np.pi * ((np.arange(2 * ROWS) + 0.5) / ROWS - 1.0)[None, :]
    x, y, z = np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat) + 0.0 * lon
    heights = np.zeros((ROWS, 2 * ROWS))
    for wave in (2.0, 4.0, 8.0, 16.0, 32.0, 64.0, 128.0, 256.0):
        for _ in range(4):
            a = rng.normal(size=3)
            a *= wave / np.linalg.norm(a)
            heights += (
                3000.0 / wave**0.75 * np.sin(a[0] * x + a[1] * y + a[2] * z + rng.uniform(0.0, 6.0))
            )
    fine = heights.astype(np.float32)
    blocks = fine.reshape(ROWS // 2, 2, ROWS, 2)
    coarse = GlobalRelief(blocks.mean(axis=(1, 3)), blocks.max(axis=(1, 3)), MOON.radius_m, "made")
    return GlobalRelief(fine, fine, MOON.radius_m, "made"), coarse


def place(height_m, seed):
    direction = np.random.default_rng(seed).normal(size=3)
    return (MOON.radius_m + height_m) * direction / np.linalg.norm(direction)


def attitude(position, roll=0.4, tilt=0.03) -> Rotation:
    """camera_from_body of a camera that looks down, nearly."""
    axes = make_nadir_axes(position)
    down = Rotation.from_matrix(np.stack([axes[0], -axes[1], -axes[2]]))
    return Rotation.from_euler("zx", [roll, tilt]) * down


def limb_points(
    position, camera_from_body, *, arc_deg=360.0, noise_px=0.08, relief=None, seed=1, camera=CAMERA
) -> LimbPoints:
    """What a perfect finder would see of the skyline of a ground, with noise."""
    ground = LimbRelief(grounds()[0] if relief is None else relief, 0.0)
    axes = make_nadir_axes(position)
    azimuths = np.radians(np.linspace(-0.5 * arc_deg, 0.5 * arc_deg, 1500, endpoint=False))
    rng = np.random.default_rng(seed)
    line = ground.skyline(position, axes, azimuths)
    across = np.cos(azimuths)[:, None] * axes[0] + np.sin(azimuths)[:, None] * axes[1]

    def pixels(off_nadir):
        rays = np.sin(off_nadir)[:, None] * across - np.cos(off_nadir)[:, None] * axes[2]
        return camera.project(camera_from_body.apply(rays))

    edge, inner = pixels(line.off_nadir), pixels(line.off_nadir - 1e-4)
    inward = (inner - edge) / np.linalg.norm(inner - edge, axis=1)[:, None]
    edge = edge + rng.normal(0.0, noise_px, (len(edge), 1)) * inward
    seen = camera.contains(edge)
    return LimbPoints(
        pixels=edge[seen],
        sigma_px=np.full(int(seen.sum()), noise_px),
        inward=inward[seen],
        common_sigma_px=0.02,
        blur_px=0.1,
        cone_axis_camera=camera_from_body.apply(-axes[2]),
        cone_angle=float(line.off_nadir.mean()),
        arc_deg=arc_deg,
        lit_pixels=10**6,
        cut_by_frame=False,
    )
