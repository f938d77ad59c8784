"""A real picture: Apollo 15 metric frame AS15-M-0297 navigated with a catalog of the ground below.

The picture's pose in its ISIS cube is a first guess, 1-2 km off; position and attitude are solved.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from catalog.arrays import FloatArray
from catalog.build import build
from catalog.config import resource
from catalog.geometry.rotations import rnb_axes
from catalog.progress import Progress
from optnav_cli.frames.isis_cube import apollo_frame, read_cube_pose, write_apollo_folder
from optnav_cli.navigation.settings import NavigateSettings
from optnav_cli.output.run_folder import read_run
from optnav_cli.runs.navigate_folder import navigate_folder
from optnav_cli.studies.tables import StudyReport, StudyTable, columns

PICTURE = "data/apollo15/AS15-M-0297_SML.png"
CUBE = "data/apollo15/AS15-M-0297_crop.cub"


@dataclass(frozen=True)
class ApolloResult:
    """What came of the real frame.

    correction_rnb_m, sigma_rnb_m  (3,) solved position less the cube's, R, N, B
    turn_deg                       (3,) solved attitude against the cube's, camera axes x, y, z
    residual_px, residual_m        rms a coordinate, in the picture and on the ground
    """

    predicted: int
    recognised: int
    residual_px: float
    residual_m: float
    correction_rnb_m: FloatArray
    sigma_rnb_m: FloatArray
    turn_deg: FloatArray
    matcher: str
    run: Path


def run(output: Path, progress: Progress, matcher: str = "ncc") -> ApolloResult:
    """Build the catalog, make the picture folder, navigate it; all files go into `output`."""
    output.mkdir(parents=True, exist_ok=True)
    catalog = output / "farside.gpkg"
    pictures, place = output / "pictures", output / f"run-{matcher}"
    build.run(resource("configs/catalogs/farside.toml"), output=catalog, progress=progress)
    picture, cube = resource(PICTURE), resource(CUBE)
    write_apollo_folder(picture, cube, pictures)
    navigate_folder(pictures, [catalog], NavigateSettings(), matcher, place, progress)
    return _result(place, cube, picture.name, matcher)


def _result(place: Path, cube: Path, picture: str, matcher: str) -> ApolloResult:
    found = read_run(place)
    solution = found.solutions[0]
    label = apollo_frame(cube, picture)
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
    camera = found.cameras[picture]
    used = [m for m in found.matches if m.used]
    distances = [np.linalg.norm(m.cp_position_m - solution.position_m) for m in used]
    residual = solution.residual_rms_px or 0.0
    return ApolloResult(
        predicted=solution.n_predicted or 0,
        recognised=solution.n_used or 0,
        residual_px=residual,
        residual_m=residual * float(np.mean(distances)) / camera.focal_length_px,
        correction_rnb_m=axes @ (solution.position_m - label.position_m),
        sigma_rnb_m=np.sqrt(np.diag(axes @ solution.covariance_m2 @ axes.T)),
        turn_deg=np.degrees(turn.as_rotvec()),
        matcher=matcher,
        run=place,
    )


COLUMNS = columns(
    "matcher; used = control points used; predicted; residual_px = residual a coordinate [px] .3f; "
    "residual_m = residual on the ground [m] .0f; "
    + "".join(f"correction_{a.lower()}_m = position less label, {a} [m] +.0f; " for a in "RNB")
    + "".join(f"sigma, {a} [m] .0f; " for a in "RNB")
    + "; ".join(f"turn_{a}_deg = attitude from label, {a} [°] +.3f" for a in "xyz")
)


def report(result: ApolloResult) -> StudyReport:
    """The figures of the frame; camera axes x, y, z."""
    counts = (result.matcher, result.recognised, result.predicted)
    solved = (result.correction_rnb_m, result.sigma_rnb_m, result.turn_deg)
    errors = np.concatenate([[result.residual_px, result.residual_m], *solved])
    title = "AS15-M-0297 over GLD100 at 474 m, attitude free"
    return StudyReport((StudyTable(title, COLUMNS, ((*counts, *map(float, errors)),)),))
