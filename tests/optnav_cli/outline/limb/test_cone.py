"""The first cone through limb candidates, found among ridges and shadows."""

import numpy as np

from optnav_cli.camera.camera_file import preset_camera
from optnav_cli.outline.limb.cone import compute_pixel_rays, find_cone

ANGLE = np.radians(76.4)  # the Moon from 50 km
RELIEF = 0.002


def test_no_flat_cone_outvotes_a_low_orbit_s_limb() -> None:
    """Flat cones tolerate any relief: without a bound they win one draw in some."""
    camera = preset_camera("shnk")
    rng = np.random.default_rng(4)
    azimuth = rng.uniform(0.0, 2.0 * np.pi, 4000)
    # two thirds are limb, rough by the relief; the others ridges that rise alike within 20 deg
    off = ANGLE + np.where(
        np.arange(4000) < 2700, rng.normal(0.0, 0.006, 4000), -rng.uniform(0.0, 0.35, 4000)
    )
    outward = np.stack([np.cos(azimuth), np.sin(azimuth)], axis=1)
    rays = np.column_stack([np.sin(off)[:, None] * outward, np.cos(off)])
    where = compute_pixel_rays(camera, camera.project(rays), np.eye(3))
    for seed in range(12):
        found = find_cone(where, -outward, np.eye(3), RELIEF, seed)
        assert found is not None
        assert abs(found[0].angle - ANGLE) < np.radians(1.0)
