"""A made-up run over the Tycho region with known errors, for the tests of what reads runs."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from catalog.bodies.body import load_body
from catalog.bodies.epochs import utc_from_tdb_s, utc_to_tdb_s
from catalog.geometry.latlon import xyz_from_latlon
from catalog.geometry.rotations import quaternion_from_rotation, rnb_axes
from optnav_cli.camera.camera import Camera
from optnav_cli.camera.camera_file import camera_toml
from optnav_cli.fix import MatchRow
from optnav_cli.frames.run_settings import FileAttitude
from optnav_cli.output.tables import write_matches, write_solutions
from optnav_cli.reasons import ReasonCode
from tests.optnav_cli.rows import solved, unsolved

CAMERA = Camera("unk", "pinhole", 512, 512, 1046.0, (255.5, 255.5))
RADIUS_M = 1737400.0
SIGMA_RNB_M = np.array([60.0, 20.0, 15.0])
START = "2023-08-17T05:23:10Z"
HEADER = "file,utc,x_m,y_m,z_m,qw,qx,qy,qz"


def orbit(count, seed=0, step_s=20.0):
    """True places on a circle 200 km up, flown north to south: (utc, position, axes R N B)."""
    lat = np.radians(-41.0) - 0.85e-3 * step_s * np.arange(count)  # 1.65 km/s over the ground
    lon = np.radians(-11.0) + 0.05 * np.random.default_rng(seed).normal()
    t0 = utc_to_tdb_s(START) + 7000.0 * seed
    for index, angle in enumerate(lat):
        position = xyz_from_latlon(angle, lon, RADIUS_M + 200e3)
        south = xyz_from_latlon(angle - np.pi / 2.0, lon, 1.0)
        yield utc_from_tdb_s(t0 + step_s * index), position, rnb_axes(position, south)


def nadir(axes):
    """camera_from_body of a camera looking down, its picture's top forward."""
    r, n, b = axes
    return Rotation.from_matrix(np.stack([-b, -n, -r]))


def write_run(folder, count=40, seed=0, scale=1.0, unsolved_from=None, attitude="camera_from_body"):
    """Write a run folder and its truth.csv; errors are drawn from `scale` times the stated sigma.

    Returns the (count, 3) planted errors in R, N, B.
    """
    folder.mkdir(parents=True, exist_ok=True)
    rng = np.random.default_rng(seed + 100)
    frames = FileAttitude(attitude, load_body("moon"))
    errors = rng.normal(size=(count, 3)) * SIGMA_RNB_M * scale
    solutions, matches, truth, frame_rows = [], [], [HEADER], ["file,utc,camera"]
    for index, (utc, position, axes) in enumerate(orbit(count, seed)):
        file = f"frame_{index:04d}.png"
        camera_from_body = nadir(axes)
        quaternion = quaternion_from_rotation(frames.convert_for_file(camera_from_body, utc))
        numbers = [*(f"{v:.4f}" for v in position), *(f"{v:.15f}" for v in quaternion)]
        truth.append(",".join([file, utc, *numbers]))
        frame_rows.append(f"{file},{utc},unk")
        matches += _matches(rng, file, position, camera_from_body)
        if unsolved_from is not None and index >= unsolved_from:
            solutions.append(unsolved(file, utc, "fewer than two control points matched"))
            continue
        solutions.append(
            solved(
                file, utc, "control_points", position + axes.T @ errors[index],
                axes.T @ np.diag(SIGMA_RNB_M**2) @ axes,
                Rotation.from_rotvec([1e-5, 0.0, 0.0]) * camera_from_body, 1e-5,
                n_predicted=10, n_matched=9, n_used=8, residual_rms_px=0.25,
            )
        )  # fmt: skip
    (folder / "run.toml").write_text(f'body = "moon"\nattitude = "{attitude}"\n')
    (folder / "frames.csv").write_text("\n".join(frame_rows) + "\n")
    (folder / "cameras").mkdir(exist_ok=True)
    (folder / "cameras" / "unk.toml").write_text(camera_toml(CAMERA))
    write_solutions(folder / "solution.csv", solutions, frames)
    write_matches(folder / "matches.csv", matches)
    (folder / "truth.csv").write_text("\n".join(truth) + "\n")
    return errors


def _matches(rng, file, position, camera_from_body):
    """Ten control points tried: 8 used, the first of them wrong by 5 px, one refused, one lost."""
    rows = []
    direction = position / np.linalg.norm(position)
    for number in range(10):
        place = direction + rng.uniform(-0.02, 0.02, 3)
        cp = place / np.linalg.norm(place) * (RADIUS_M + rng.normal() * 500.0)
        (pixel,) = CAMERA.project_from_body(cp[None], position, camera_from_body.as_matrix())
        residual = np.array([5.0, 0.0]) if number == 0 else rng.normal(size=2) * 0.25
        rows.append(
            MatchRow(
                file, 4000 + number, number % 3, cp, pixel,
                None if number == 9 else pixel + residual, 0.9 - 0.05 * number, 0.3, number < 8,
                "" if number < 8 else "score below the threshold", 20.0 + number,
                None if number == 9 else residual,
                reason_code=ReasonCode.NONE if number < 8 else ReasonCode.LOW_SCORE,
            )
        )  # fmt: skip
    return rows


@pytest.fixture
def make_run():
    """`write_run`, under a name that needs no import."""
    return write_run
