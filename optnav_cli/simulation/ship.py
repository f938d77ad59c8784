"""What the ship adds to its pictures: parts of itself in view, stray sunlight."""

import cv2
import numpy as np

from catalog.arrays import Float32Array, FloatArray
from optnav_cli.camera.camera import Camera
from optnav_cli.simulation.nuisance_settings import GlareSettings, StructureSettings
from optnav_cli.simulation.shot import Shot

FINER = 4  # sub-pixels a side that outlines are drawn on
UNEVEN = 0.2  # how much the brightness of a part varies over it, of its mean
UNEVEN_PX = 160.0  # the distance over which it does


def structure_cover(
    parts: tuple[StructureSettings, ...], camera: Camera, seed: int
) -> tuple[Float32Array, Float32Array]:
    """Which share of each pixel parts of the ship cover, and their brightness: (rows, cols) each.

    Brightness is a share of the bright ground's, uneven as a lit surface is, by the seed. Of parts
    that overlap the later one lies in front.
    """
    rows, cols = camera.shape
    cover, brightness = np.zeros((rows, cols), np.float32), np.zeros((rows, cols), np.float32)
    for number, part in enumerate(parts):
        if part.camera not in ("", camera.name):
            continue
        # pixel centres are whole numbers; the drawn grid begins at the picture's corner
        corners = np.round((np.array(part.outline_px) + 0.5) * FINER).astype(np.int32)
        drawn = np.zeros((rows * FINER, cols * FINER), np.uint8)
        if part.width_px > 0.0:
            width = max(1, round(part.width_px * FINER))
            cv2.polylines(drawn, [corners], isClosed=False, color=1, thickness=width)
        else:
            cv2.fillPoly(drawn, [corners], color=1)
        share = drawn.reshape(rows, FINER, cols, FINER).mean(axis=(1, 3), dtype=np.float32)
        rng = np.random.default_rng([seed, number])
        coarse = rng.normal(
            size=(max(3, int(rows / UNEVEN_PX) + 2), max(3, int(cols / UNEVEN_PX) + 2))
        )
        uneven = cv2.resize(coarse.astype(np.float32), (cols, rows), interpolation=cv2.INTER_CUBIC)
        own = np.maximum(part.brightness * (1.0 + UNEVEN * uneven), 0.0)
        brightness = np.where(share > 0.0, own, brightness).astype(np.float32)
        cover = np.maximum(cover, share)
    return cover, brightness


def glare_veil(shot: Shot, rays_camera: FloatArray, settings: GlareSettings) -> Float32Array:
    """Stray light (rows, cols) as a share of the bright ground.

    rays_camera  (rows, cols, 3) unit rays of the pixels' middles; NaN where the camera sees nothing
    """
    sun = shot.camera_from_body.apply(shot.sun_body)
    angle = np.degrees(np.arccos(np.clip(rays_camera @ sun, -1.0, 1.0)))
    nearest = float(np.nanmin(angle))
    veil = settings.strength * np.exp(-(angle - nearest) / settings.falloff_deg)
    return np.asarray(np.nan_to_num(veil), dtype=np.float32)
