"""Optical navigation for Python users: everything that they need, from one module.

An example that a test runs stands in optnav_cli/README.md. The calls do what the commands of the
same names do. All errors that a user can mend are an `OptnavError`.
"""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import TypedDict, Unpack

import numpy as np

from catalog.api import Catalog, ControlPoint, OptnavError, Patch, build_catalog, open_catalog
from catalog.bodies.body import load_body
from catalog.bodies.ephemeris import AnalyticEphemeris
from catalog.bodies.epochs import utc_to_tdb_s
from catalog.correlation.ncc import match_ncc
from catalog.errors import UsageError
from catalog.geometry.rotations import ARCSEC, rotation_from_quaternion
from catalog.progress import Progress, SilentProgress
from optnav_cli.camera.camera import Camera
from optnav_cli.camera.camera_file import load_camera as load_camera_file
from optnav_cli.camera.camera_file import preset_camera
from optnav_cli.control_points.settings import NavigateSettings, load_settings
from optnav_cli.evaluation.evaluation import Evaluation
from optnav_cli.evaluation.files import evaluate_run
from optnav_cli.fix import Fix, Method, NoFix, Solution
from optnav_cli.frames.frames import Frame
from optnav_cli.frames.picture import load_picture
from optnav_cli.navigate.answers import NavigationInputs
from optnav_cli.navigate.autonomous import Navigator
from optnav_cli.navigate.inputs import choose_relief, open_catalogs, open_field
from optnav_cli.navigate.job import navigate_folder as navigate_pictures
from optnav_cli.navigate.worker import RunInputs
from optnav_cli.pages import write_report
from optnav_cli.reasons import Reason, ReasonCode
from optnav_cli.simulation.job import simulate_folder

__all__ = [
    "Camera",
    "Catalog",
    "ControlPoint",
    "Evaluation",
    "Fix",
    "Method",
    "NavigateSettings",
    "NoFix",
    "OptnavError",
    "Patch",
    "PictureKnowledge",
    "Reason",
    "ReasonCode",
    "Solution",
    "build_catalog",
    "evaluate",
    "load_camera",
    "load_settings",
    "navigate_folder",
    "navigate_picture",
    "open_catalog",
    "report",
    "simulate",
]


def load_camera(name: str | Path) -> Camera:
    """A camera file, or a camera that ships with optnav by its name. Raises ConfigError."""
    path = Path(name)
    return load_camera_file(path) if path.suffix == ".toml" else preset_camera(str(name))


class PictureKnowledge(TypedDict, total=False):
    """Optional knowledge of a picture besides its camera, time and attitude.

    attitude_sigma_arcsec  error of the attitude, 1 sigma an axis; 0: exact, as without it; None: a
                           first guess only
    position_m             (3,) prior position of the camera, body-fixed, m; without it by the limb
    position_sigma_m       its error, 1 sigma a component
    body                   path of the body's file, where it is none that ships with optnav
    """

    attitude_sigma_arcsec: float | None
    position_m: Sequence[float] | None
    position_sigma_m: float | None
    body: str | Path | None


def navigate_picture(
    picture: str | Path,
    camera: Camera,
    catalogs: Sequence[str | Path],
    *,
    utc: str,
    camera_from_body: Sequence[float],
    **known: Unpack[PictureKnowledge],
) -> Solution:
    """Find where a camera was when it took a picture of the body that the catalogs are of.

    picture           a gray picture of the camera's size
    catalogs          catalog files of one body; the first has priority
    utc               time of the picture, as 2026-01-01T00:00:00Z; gives the Sun, by theory
    camera_from_body  quaternion, scalar first, of the rotation that takes body-fixed vectors to the
                      camera's axes: x right, y down, z into the picture
    known             see `PictureKnowledge`

    Returns the fix or, in its place, the reason why there is none.
    Raises DataError for a file that cannot be used, ConfigError for a body's, UsageError for a
    prior without its error and for no catalog.
    """
    if unknown := known.keys() - PictureKnowledge.__annotations__:
        raise TypeError(f"navigate_picture takes no {', '.join(sorted(unknown))}")
    position_m, position_sigma_m = known.get("position_m"), known.get("position_sigma_m")
    if (position_m is None) != (position_sigma_m is None):
        raise UsageError("position_m and position_sigma_m belong together: give both or none")
    if not catalogs:
        raise UsageError("name a catalog: it says which body the picture shows")
    picture, tdb_s = Path(picture), utc_to_tdb_s(utc)
    sigma_rad, attitude_sigma_arcsec = None, known.get("attitude_sigma_arcsec", 0.0)
    if attitude_sigma_arcsec is not None:
        sigma_rad = math.hypot(attitude_sigma_arcsec, camera.boresight_sigma_arcsec) * ARCSEC
    with open_catalogs([Path(path) for path in catalogs]) as opened:
        body = load_body(str(known.get("body") or opened[0].meta.body))
        motion = AnalyticEphemeris(body)
        points = open_field(opened, body)
        relief = choose_relief(opened, None, body)
        inputs = NavigationInputs(points, motion, relief, NavigateSettings(), match_ncc)
        frame = Frame(
            file=picture.name,
            utc=utc,
            camera=camera.name,
            tdb_s=tdb_s,
            camera_from_body=rotation_from_quaternion(*camera_from_body),
            attitude_sigma_rad=sigma_rad,
            position_m=None if position_m is None else np.array(position_m, dtype=np.float64),
            position_sigma_m=position_sigma_m,
            sun_body=motion.sun_body(tdb_s),
        )
        return Navigator(inputs).solve(frame, camera, load_picture(picture, camera))


def navigate_folder(
    pictures: str | Path,
    catalogs: Sequence[str | Path],
    run: str | Path,
    *,
    settings: NavigateSettings | None = None,
    relief: str | Path | None = None,
    orbit: str | Path | None = None,
    progress: Progress | None = None,
) -> list[Solution]:
    """Navigate all pictures of a folder and write a run folder, as `optnav navigate` does.

    settings  of the search and the solution, as `load_settings` reads them; the defaults if None
    relief    a terrain model of the whole body for the horizon; else what a catalog carries
    orbit     folder of a fitted orbit: the prior of pictures that have none
    Raises NothingToDoError, after the run is written, where no picture was solved; another
    OptnavError where folder or catalogs cannot be used at all.
    """
    given = RunInputs(
        Path(pictures),
        [Path(path) for path in catalogs],
        settings or NavigateSettings(),
        relief=None if relief is None else Path(relief),
        orbit=None if orbit is None else Path(orbit),
    )
    return navigate_pictures(given, Path(run), progress or SilentProgress())


def simulate(
    scenario: str | Path, pictures: str | Path, *, progress: Progress | None = None
) -> None:
    """Make the pictures of a scenario file, with truth.csv beside them. Raises an OptnavError."""
    simulate_folder(Path(scenario), Path(pictures), progress or SilentProgress())


def evaluate(run: str | Path, truth: str | Path) -> Evaluation:
    """Compare a run folder with a truth.csv; `figures()` of the result adds all frames up.

    Raises DataError for a folder that is no run and for a truth of other frames.
    """
    return evaluate_run(Path(run), Path(truth))


def report(source: str | Path, output: str | Path) -> None:
    """Write the page about a run folder or a catalog (HTML), or a run's errors alone (SVG).

    Raises DataError for another source, OutputError for a place that cannot be used.
    """
    write_report(Path(source), Path(output))
