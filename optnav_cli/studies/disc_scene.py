"""Drawn discs of a few pixels: a body with relief, far away, behind a blur and on a detector.

The light is blurred before it falls on the pixels, on a grid of finer pixels, so that a blur is the
one that a camera file states; pictures of the simulator are blurred pixel by pixel.
"""

import tempfile
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from catalog.arrays import Float32Array, FloatArray
from catalog.bodies.body import Body, load_body
from catalog.config import resource
from catalog.terrain.dem.source import DemSettings
from catalog.terrain.mesh.shape import load_shape
from catalog.terrain.mesh.terrain import MeshTerrain, relief_of_mesh
from catalog.terrain.relief.relief import GlobalRelief
from catalog.terrain.synthetic.relief import SyntheticRelief
from optnav_cli.camera.camera import Camera
from optnav_cli.camera.camera_file import preset_camera
from optnav_cli.frames.picture import Picture
from optnav_cli.simulation.globe_frame import GlobeRenderer
from optnav_cli.simulation.globe_heights import GlobeHeights, read_globe
from optnav_cli.simulation.globe_terrain import GlobeTerrain
from optnav_cli.simulation.mesh_frame import MeshRenderer
from optnav_cli.simulation.scenario import Portraits, load_scenario
from optnav_cli.simulation.sections import SensorSettings
from optnav_cli.simulation.sensor import expose
from optnav_cli.simulation.shot import Exposure
from optnav_cli.simulation.truth_mesh import TruthMesh

Shape = Literal["moon", "phobos"]

GLOBE = "data/moon_gld100_4ppd.tif"
PHOBOS = "configs/scenarios/phobos_disc.toml"
CAMERAS: dict[Shape, tuple[str, ...]] = {"moon": ("shnk", "unk"), "phobos": ("tsnn_shtk",)}
GROUNDS = (7301, 7302, 7303)  # seeds of relief that no other study and no scenario has
FINE = 5  # pixels a side that are drawn for one
SIDES_PX = (64, 128)  # of the part of a picture that is drawn; the larger one for discs over
SMALL_PX = 16.0
OFF_AXIS = 0.35  # the part's middle lies up to here from the picture's, in sides of the picture
PHASE_DEG = (0.0, 120.0)
PSF_PX = (0.5, 1.2)
PSF_ERROR_PX = 0.05  # of the calibration
SNR = (20.0, 100.0)
BITS = (8, 12)
FULL = {8: 255.0, 12: 65535.0}  # where their files saturate


@dataclass(frozen=True, eq=False)
class Disc:
    """A drawn disc with its truth.

    camera            of the part that is drawn, with its blur as calibrated
    position_m        (3,) body frame;  sun_body (3,) unit vector
    diameter_px       of the body's mean sphere
    """

    picture: Picture
    camera: Camera
    position_m: FloatArray
    camera_from_body: Rotation
    sun_body: FloatArray
    diameter_px: float
    phase_deg: float


class DiscScene:
    """Discs of one body; `relief` is what a navigator knows of its shape, None of a sphere."""

    def __init__(self, shape: Shape) -> None:
        self._shape: Shape = shape
        self.body = load_body(shape)
        self.relief: GlobalRelief | None = None
        if shape == "phobos":
            scenario = load_scenario(resource(PHOBOS))
            if not isinstance(scenario, Portraits):
                raise TypeError(f"{PHOBOS} is no scenario of a small body")
            self._ground = TruthMesh(scenario, self.body)
            self.relief = _relief(scenario, self.body)
        else:
            heights = read_globe(DemSettings(str(resource(GLOBE))), self.body)
            self._heights = GlobeHeights(heights, self.body.radius_m)
            self._grounds: dict[int | None, GlobeTerrain] = {
                seed: GlobeTerrain(self._heights, self._detail(seed)) for seed in GROUNDS
            }

    def _detail(self, seed: int) -> SyntheticRelief:
        posting = self._heights.posting_m
        return SyntheticRelief(seed, posting, self.body.radius_m, smallest_m=posting / 2.0,
                      rms_slope_deg=5.0, saturation=0.05)  # fmt: skip

    def draw(self, diameter_px: float, ground: int, rng: np.random.Generator) -> Disc:
        """A disc of this size over one of GROUNDS, all else drawn at random."""
        psf = rng.uniform(*PSF_PX)
        told = max(psf + rng.normal(0.0, PSF_ERROR_PX), 0.0)
        preset = preset_camera(str(rng.choice(CAMERAS[self._shape])))
        side = SIDES_PX[int(diameter_px > SMALL_PX)]
        camera = replace(_part(preset, side, rng), psf_sigma_px=told, psf_error_px=PSF_ERROR_PX)
        middle = camera.unproject(0.5 * (side - 1) + rng.uniform(-1.0, 1.0, 2))
        phase = rng.uniform(*np.radians(PHASE_DEG))
        up, aside = np.linalg.qr(rng.normal(size=(3, 2)))[0].T
        sun = np.cos(phase) * up + np.sin(phase) * aside
        radius = float(np.mean(self.body.radii_m))
        angle = 0.5 * diameter_px * _rad_per_px(camera, middle)
        position = radius / np.sin(angle) * up
        turn = Rotation.align_vectors(middle[None], -up[None])[0]
        turn = Rotation.from_rotvec(rng.uniform(0.0, 2.0 * np.pi) * middle) * turn
        shot = Exposure(0, 0, "", "", 0.0, position, turn, sun, None, turn, ground)
        radiance = self._radiance(camera, shot)
        blurred = cv2.GaussianBlur(radiance, (0, 0), psf * FINE)
        light = np.asarray(
            cv2.resize(blurred, (side, side), interpolation=cv2.INTER_AREA), dtype=np.float32
        )
        bits = int(rng.choice(BITS))
        sensor = SensorSettings(psf_sigma_px=0.0, snr=float(rng.uniform(*SNR)), bits=bits)
        counts = expose(light, sensor, rng).astype(np.float32)
        return Disc(
            Picture(counts, FULL[bits]), camera, position, turn, sun,
            diameter_px, float(np.degrees(phase)),
        )  # fmt: skip

    def _radiance(self, camera: Camera, shot: Exposure) -> Float32Array:
        """Radiance over fine pixels."""
        fine = _finer(camera)
        if self._shape == "phobos":
            return MeshRenderer(self._ground, fine).radiance(shot)
        return GlobeRenderer(self._heights, self._grounds, fine).radiance(shot)


def _relief(scenario: Portraits, body: Body) -> GlobalRelief:
    """The relief that a catalog of the scenario's shape model carries."""
    shape = load_shape(scenario.mesh, Path.cwd(), body)
    with tempfile.TemporaryDirectory() as folder:
        corners = Path(folder) / "corners.npy"
        np.save(corners, shape.vertices[shape.faces])
        return relief_of_mesh(MeshTerrain(body, corners, "shape model", shape.posting_m))


def _part(camera: Camera, side: int, rng: np.random.Generator) -> Camera:
    """A square part of a camera's picture, somewhere off the axis."""
    off = rng.uniform(-OFF_AXIS, OFF_AXIS, 2) * camera.width_px
    x, y = 0.5 * (side - 1) - off
    return replace(camera, width_px=side, height_px=side, principal_point_px=(float(x), float(y)))


def _finer(camera: Camera) -> Camera:
    x, y = (FINE * (value + 0.5) - 0.5 for value in camera.principal_point_px)
    return replace(
        camera, width_px=FINE * camera.width_px, height_px=FINE * camera.height_px,
        focal_length_px=FINE * camera.focal_length_px, principal_point_px=(x, y),
    )  # fmt: skip


def _rad_per_px(camera: Camera, towards: FloatArray) -> float:
    """Side of the square that a pixel sees there."""
    pixel = camera.project(towards)
    steps = camera.unproject(pixel + np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]]))
    return float(np.sqrt(np.linalg.norm(np.cross(steps[1] - steps[0], steps[2] - steps[0]))))
