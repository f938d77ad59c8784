"""A real picture: Apollo 15 metric frame AS15-M-0297 navigated with a catalog of the ground below.

The picture's pose in its ISIS cube is a first guess, 1-2 km off; position and attitude are solved.
"""

from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from catalog.config import resource
from catalog.geometry.rotations import rnb_axes
from catalog.pipeline import build
from catalog.places import make_folder
from catalog.progress import Progress
from optnav_cli.archives.isis_cube import read_cube_pose
from optnav_cli.archives.job import ImportOptions, import_folder
from optnav_cli.navigate.job import navigate_folder
from optnav_cli.navigate.worker import RunInputs
from optnav_cli.output.run_folder import read_run
from tests.studies.tables import Cell, StudyReport, StudyTable, columns

PICTURE = "data/apollo15/AS15-M-0297_SML.png"
CUBE = "data/apollo15/AS15-M-0297_crop.cub"


def run(output: Path, progress: Progress, matcher: str = "ncc") -> tuple[Cell, ...]:
    """Build the catalog, make the picture folder, navigate it; all files go into `output`.

    Returns the table's only row: the residual is the rms of a coordinate.
    """
    make_folder(output)
    catalog = output / "farside.gpkg"
    pictures, place = output / "pictures", output / f"run-{matcher}"
    build.run(resource("configs/catalogs/farside.toml"), output=catalog, progress=progress)
    picture, cube = resource(PICTURE), resource(CUBE)
    (label,) = import_folder([cube], pictures, ImportOptions(pictures=(picture,))).frames
    navigate_folder(RunInputs(pictures, [catalog], matcher=matcher), place, progress)
    found = read_run(place)
    solution = found.solutions[0]
    if (
        solution.position_m is None
        or solution.covariance_m2 is None
        or solution.camera_from_body is None
        or label.position_m is None
        or label.camera_from_body is None
    ):
        raise ValueError(f"{place}: the frame is not solved: {solution.reason}")
    axes = rnb_axes(solution.position_m, read_cube_pose(cube).velocity_m_s)
    turn: Rotation = solution.camera_from_body * label.camera_from_body.inv()
    used = [m for m in found.matches if m.used]
    distances = [np.linalg.norm(m.cp_position_m - solution.position_m) for m in used]
    residual_px = solution.residual_rms_px or 0.0
    focal_px = found.cameras[picture.name].focal_length_px
    errors = (
        [residual_px, residual_px * float(np.mean(distances)) / focal_px],
        axes @ (solution.position_m - label.position_m),
        np.sqrt(np.diag(axes @ solution.covariance_m2 @ axes.T)),
        np.degrees(turn.as_rotvec()),
    )
    counts = (solution.n_used or 0, solution.n_predicted or 0)
    return (matcher, *counts, *map(float, np.concatenate(errors)))


COLUMNS = columns(
    "matcher; used = control points used; predicted; residual_px = residual a coordinate [px] .3f; "
    "residual_m = residual on the ground [m] .0f; "
    + "".join(f"correction_{a.lower()}_m = position less label, {a} [m] +.0f; " for a in "RNB")
    + "".join(f"sigma, {a} [m] .0f; " for a in "RNB")
    + "; ".join(f"turn_{a}_deg = attitude from label, {a} [°] +.3f" for a in "xyz")
)


def report(row: tuple[Cell, ...]) -> StudyReport:
    """The figures of the frame; camera axes x, y, z."""
    title = "AS15-M-0297 over GLD100 at 474 m, attitude free"
    return StudyReport((StudyTable(title, COLUMNS, (row,)),))
