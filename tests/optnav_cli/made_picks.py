"""Pictures of a sphere or spheroid with points of known places, and folders of them."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from catalog.bodies.body import Body, load_body
from catalog.geometry.latlon import latlon_from_xyz
from optnav_cli.camera.camera import Camera
from optnav_cli.camera.camera_file import camera_toml
from optnav_cli.estimation.models.points import Pose
from optnav_cli.points.model import LensPrior, PickedSightings
from optnav_cli.points.resection import PickedResection

CAMERA = Camera("tele", "pinhole", 5616, 3744, 62_400.0, (2807.5, 1871.5))
WIDE = Camera("wide", "pinhole", 2000, 2000, 2500.0, (999.5, 999.5))


@dataclass(frozen=True, eq=False)
class PickedScene:
    """A camera over a body, and where it sees places (n, 3): pixels (n, 2)."""

    body: Body
    camera: Camera
    pose: Pose
    places_m: np.ndarray
    pixels: np.ndarray

    def problem(self, noise=(0.0, 0.0), seed=0, lens=(0.0, 0.0), sigma=(0.7, 10.0)):
        """What is solved, with noise (px, m) drawn."""
        rng = np.random.default_rng(seed)
        count = len(self.pixels)
        pixels = self.pixels + rng.normal(0.0, noise[0], self.pixels.shape)
        places = self.places_m + rng.normal(0.0, noise[1], self.places_m.shape)
        points = PickedSightings(places, pixels, np.full(count, sigma[0]), np.full(count, sigma[1]))
        prior = LensPrior(*lens, np.array(self.camera.principal_point_px))
        return PickedResection(self.camera, points, self.camera.unproject(pixels), prior)


def scene(
    seed=0,
    count=20,
    off_deg=37.0,
    height_m=420e3,
    camera=CAMERA,
    body="moon",
    relief_m=500.0,
) -> PickedScene:
    """Points spread over a picture that looks so far off the nadir."""
    rng, found = np.random.default_rng(seed), load_body(body)
    up = np.array([0.6, -0.48, 0.64])
    place = up * (found.radius_m + height_m)
    east = np.cross([0.0, 0.0, 1.0], up)
    east /= np.linalg.norm(east)
    azimuth, off = rng.uniform(0.0, 2.0 * np.pi), np.radians(off_deg)
    level = np.sin(azimuth) * east + np.cos(azimuth) * np.cross(up, east)
    axis = np.sin(off) * level - np.cos(off) * up
    right = np.cross(axis, -up)
    right /= np.linalg.norm(right)
    turn = Rotation.from_rotvec([0.0, 0.0, rng.uniform(-3.0, 3.0)])
    turn = turn * Rotation.from_matrix(np.array([right, np.cross(axis, right), axis]))
    side = np.array([camera.width_px, camera.height_px])
    if count == 4:
        pixels = np.array([(0.1, 0.1), (0.9, 0.1), (0.9, 0.9), (0.1, 0.9)]) * side
        pixels += rng.uniform(-0.03, 0.03, (4, 2)) * side
    else:
        pixels = rng.uniform(0.03, 0.97, (count, 2)) * side
    rays = camera.unproject(pixels) @ turn.as_matrix()
    radius = found.radius_m + rng.uniform(0.0, relief_m, count)
    along = rays @ place
    reach = -along - np.sqrt(along**2 - place @ place + radius**2)
    return PickedScene(found, camera, Pose(place, turn), place + rays * reach[:, None], pixels)


def rows_of(made: PickedScene, file="a.png", sigma=(0.7, 10.0)) -> list[list[object]]:
    """Rows of points.csv: planetocentric, above the sphere."""
    lat, lon, radius = latlon_from_xyz(made.places_m)
    cells = np.column_stack(
        [made.pixels, np.degrees(lat), np.degrees(lon), radius - made.body.radius_m]
    )
    return [[file, *row, *sigma, f"crater {n}"] for n, row in enumerate(cells.tolist(), 1)]


def write_picked(
    folder: Path, made: PickedScene, rows: list[list[object]], prior="", files=("a.png",), more=""
) -> Path:
    """A folder without pictures. prior: x_m,y_m,z_m,position_sigma_m of all frames."""
    (folder / "cameras").mkdir(parents=True, exist_ok=True)
    (folder / "cameras" / f"{made.camera.name}.toml").write_text(camera_toml(made.camera))
    stated = '[points]\nlatitude = "planetocentric"\nheight = "sphere"\n'  # as `rows_of` has them
    text = f'body = "{made.body.name}"\nattitude = "camera_from_body"\n{more or stated}'
    (folder / "run.toml").write_text(text)
    frames = ["file,utc,camera,x_m,y_m,z_m,position_sigma_m"]
    frames += [f"{file},2024-06-01T10:00:00Z,{made.camera.name},{prior or ',,,'}" for file in files]
    (folder / "frames.csv").write_text("\n".join(frames) + "\n")
    lines = ["file,x_px,y_px,lat_deg,lon_deg,height_m,sigma_px,sigma_m,name"]
    lines += [",".join(str(cell) for cell in row) for row in rows]
    (folder / "points.csv").write_text("\n".join(lines) + "\n")
    return folder
