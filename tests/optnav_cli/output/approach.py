"""A made-up approach from 100 000 km: methods change with the height, some frames are unsolved."""

import numpy as np
from scipy.spatial.transform import Rotation

from catalog.bodies.body import load_body
from catalog.bodies.epochs import utc_from_tdb_s, utc_to_tdb_s
from catalog.geometry.latlon import xyz_from_latlon
from catalog.geometry.rotations import quaternion_from_rotation, rnb_axes
from optnav_cli.camera.camera import Camera
from optnav_cli.camera.camera_file import camera_toml
from optnav_cli.frames.run_settings import FileAttitude
from optnav_cli.output.tables import write_solutions
from optnav_cli.reasons import ReasonCode
from tests.optnav_cli.rows import solved, unsolved

RADIUS_M = 1737400.0
CAMERAS = (
    Camera("unk", "pinhole", 2048, 2048, 4184.0, (1023.5, 1023.5)),
    Camera("shnk", "equidistant", 2048, 2048, 653.0, (1023.5, 1023.5)),
)
START = "2026-08-17T05:23:10Z"
HEADER = "file,utc,x_m,y_m,z_m,qw,qx,qy,qz"


def method_of(height_m, camera):
    """What solves a frame, and its sigmas along R and across, m."""
    if camera == "shnk":
        if height_m > 20e6:
            return "brightness_centre", 0.08 * height_m, 2e-3 * height_m
        if height_m > 1e6:
            return "horizon_sphere", 0.02 * height_m, 1e-3 * height_m
        return "control_points", 60.0, 40.0
    if height_m > 5e6:
        return "horizon", 1e-3 * height_m, 3e-5 * height_m
    return "control_points", 2e-4 * height_m, 2e-5 * height_m


def write_approach(folder, count=24, seed=0, scale=1.0):
    """Write a run of two cameras and its truth.csv; every sixth frame of `shnk` is unsolved.

    Returns by file: height (m), method or None, and planted errors (3,) in R, N, B.
    """
    folder.mkdir(parents=True)
    rng = np.random.default_rng(seed)
    frames = FileAttitude("camera_from_body", load_body("moon"))
    heights = np.geomspace(1e8, 1e5, count)
    solutions, truth, rows, planted = [], [HEADER], ["file,utc,camera"], {}
    times = utc_to_tdb_s(START) + np.cumsum(
        600.0 * ((RADIUS_M + heights) / RADIUS_M) ** 1.5 * 24 / count
    )
    angles = np.radians(0.7) * np.arange(count)
    for index, height in enumerate(heights):
        position = xyz_from_latlon(0.1, angles[index], RADIUS_M + height)
        ahead, behind = min(index + 1, count - 1), max(index - 1, 0)
        chord = xyz_from_latlon(0.1, angles[ahead], RADIUS_M + heights[ahead]) - xyz_from_latlon(
            0.1, angles[behind], RADIUS_M + heights[behind]
        )
        axes = rnb_axes(position, chord)
        attitude = Rotation.from_matrix(np.stack([-axes[2], -axes[1], -axes[0]]))
        utc = utc_from_tdb_s(times[index])
        for camera in CAMERAS:
            file = f"{camera.name}_{index:03d}.png"
            quaternion = quaternion_from_rotation(attitude)
            numbers = [*(f"{v:.4f}" for v in position), *(f"{v:.15f}" for v in quaternion)]
            truth.append(",".join([file, utc, *numbers]))
            rows.append(f"{file},{utc},{camera.name}")
            if camera.name == "shnk" and index % 6 == 5:
                code = ReasonCode.NO_LIMB if index < 12 else ReasonCode.CUT_DISC
                solutions.append(unsolved(file, utc, code.meaning, code))
                planted[file] = (height, None, None)
                continue
            method, along, across = method_of(height, camera.name)
            sigma = np.array([along, across, across])
            error = rng.normal(size=3) * sigma * scale
            solutions.append(
                solved(
                    file, utc, method, position + axes.T @ error,
                    axes.T @ np.diag(sigma**2) @ axes, attitude, 0.0,
                )
            )  # fmt: skip
            planted[file] = (height, method, error)
    (folder / "run.toml").write_text('body = "moon"\nattitude = "camera_from_body"\n')
    (folder / "frames.csv").write_text("\n".join(rows) + "\n")
    (folder / "cameras").mkdir()
    for camera in CAMERAS:
        (folder / "cameras" / f"{camera.name}.toml").write_text(camera_toml(camera))
    write_solutions(folder / "solution.csv", solutions, frames)
    (folder / "truth.csv").write_text("\n".join(truth) + "\n")
    return planted
