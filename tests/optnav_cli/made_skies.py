"""Pictures of the sky, drawn by other means than the simulator's: Gaussian spots, noise, faults."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from catalog.arrays import Float32Array, FloatArray
from catalog.bodies.body import load_body
from catalog.bodies.ephemeris import compute_velocity_inertial
from catalog.bodies.epochs import utc_to_tdb_s
from catalog.bodies.stars import apply_aberration, load_bright_stars
from optnav_cli.camera.camera import Camera
from optnav_cli.camera.camera_file import camera_toml
from optnav_cli.stars.spots import StarSpots

UTC = "2024-06-01T10:00:00Z"
CAMERA = Camera("sky", "pinhole", 512, 512, 1300.0, (255.5, 255.5))  # 22 degrees
NOISE, SKY = 4.0, 100.0


def turned(ra_deg: float, dec_deg: float, roll_deg: float) -> Rotation:
    """camera_from_inertial of a boresight at a place of the sky."""
    angles = [90.0 + ra_deg, 90.0 - dec_deg, roll_deg]
    return Rotation.from_euler("ZXZ", angles, degrees=True).inv()


def sky_directions(utc: str = UTC) -> FloatArray:
    """The stars as seen from the Earth's motion."""
    time = utc_to_tdb_s(utc)
    return apply_aberration(
        load_bright_stars().propagate(time), compute_velocity_inertial(load_body("earth"), time)
    )


def drawn_sky(
    turn: Rotation,
    camera: Camera = CAMERA,
    *,
    seed: int = 0,
    trail_px: float = 0.0,
    blur_px: float = 0.7,
    faintest: float = 6.0,
) -> Float32Array:
    """Counts (h, w) of the stars that a camera sees, with noise; stars of V 6 just stand out."""
    rng = np.random.default_rng(seed)
    pixels = camera.project(turn.apply(sky_directions()))
    light = 400.0 * 10.0 ** (-0.4 * (load_bright_stars().magnitudes - 5.5))
    inside = np.isfinite(pixels).all(axis=1) & (load_bright_stars().magnitudes < faintest)
    inside[inside] &= camera.contains(pixels[inside], -5.0)
    picture = rng.normal(SKY, NOISE, camera.shape)
    rows, cols = np.mgrid[: camera.height_px, : camera.width_px]
    steps = np.linspace(-0.5, 0.5, max(1, round(2 * trail_px))) * trail_px
    for (x, y), flux in zip(pixels[inside], light[inside], strict=True):
        for step in steps:
            near = (abs(cols - x - step) < 6) & (abs(rows - y) < 6)
            square = (cols[near] - x - step) ** 2 + (rows[near] - y) ** 2
            spot = np.exp(-0.5 * square / blur_px**2) / (2.0 * np.pi * blur_px**2)
            picture[near] += flux / len(steps) * spot
    return np.clip(picture, 0.0, 65535.0).astype(np.float32)


def add_body(
    picture: Float32Array,
    centre: tuple[int, int] = (150, 330),
    radius: int = 90,
    glare: float = 150.0,
) -> Float32Array:
    """The same with a lit body, saturated, and its glare."""
    rows, cols = np.mgrid[: picture.shape[0], : picture.shape[1]]
    away = np.hypot(cols - centre[0], rows - centre[1])
    out: FloatArray = picture + glare * np.exp(-np.maximum(away - radius, 0.0) / 60.0)
    lit = cv2.circle(np.zeros(picture.shape, np.uint8), centre, radius, 1, -1) > 0
    out[lit] = 60_000.0
    return out.astype(np.float32)


def spots_of(
    turn: Rotation, camera: Camera, rng: np.random.Generator, faintest: float, false: int
) -> StarSpots:
    """Spots as a detector gives them: 0.15 px of noise, false ones among them."""
    stars = load_bright_stars()
    pixels = camera.project(turn.apply(stars.propagate(None)))
    seen = np.flatnonzero(np.isfinite(pixels).all(axis=1) & (stars.magnitudes < faintest))
    seen = seen[camera.contains(pixels[seen])][:56]
    size = np.array([camera.width_px - 1, camera.height_px - 1])
    places = np.vstack([pixels[seen], rng.uniform(0.0, 1.0, (false, 2)) * size])
    places += rng.normal(0.0, 0.15, places.shape)
    magnitudes = np.append(stars.magnitudes[seen], rng.uniform(0.0, faintest, false))
    order = np.argsort(magnitudes + rng.normal(0.0, 0.2, len(magnitudes)))
    light = 10.0 ** (-0.4 * magnitudes[order])
    return StarSpots(places[order], light, np.full(len(order), 0.15), 0, 0, 0.0)


def sky_folder(
    place: Path, pictures: Mapping[str, Float32Array], rows: Sequence[str] | None = None
) -> Path:
    """A folder of pictures by name, with the camera and frames.csv without attitudes."""
    (place / "cameras").mkdir(parents=True)
    (place / "cameras/sky.toml").write_text(camera_toml(CAMERA))
    for name, picture in pictures.items():
        cv2.imwrite(str(place / name), np.clip(picture, 0, 65535).astype(np.uint16))
    rows = rows or [f"{name},{UTC},sky" for name in pictures]
    (place / "frames.csv").write_text("\n".join(["file,utc,camera", *rows]) + "\n")
    return place
