"""Picture folders of the shipped scenarios, made once and shared by the studies.

What a picture shows does not depend on what the navigator is told, so one folder of pictures
serves exact attitudes, those of a star sensor and flights without a prior.
"""

import os
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from catalog.config import resource
from catalog.geometry.rotations import ARCSEC
from catalog.progress import Progress
from optnav_cli.frames.folder import read_folder, write_folder
from optnav_cli.runs.simulate_folder import simulate_folder
from optnav_cli.simulation.run import scenario_copy
from optnav_cli.simulation.scenario import fewer_pictures, load_scenario

GLOBE = "shared:moon/moon_gld100_32ppd.tif"  # the ground of shipped scenarios
STAR_SENSOR_ARCSEC = 10.0
SEED = 10


def shipped_pictures(output: Path, name: str, frames: int | None, progress: Progress) -> Path:
    """The picture folder of a shipped scenario; made unless the same one is there.

    output  the study's folder;  frames  pictures of the scenario, its own number when None
    """
    scenario = load_scenario(resource(f"configs/scenarios/{name}.toml"))
    if frames is not None:
        scenario = fewer_pictures(scenario, frames)
    place = output / "pictures" / name
    place.parent.mkdir(exist_ok=True)
    mark = place / "scenario.json"
    if not (mark.is_file() and mark.read_bytes() == scenario_copy(scenario)):
        simulate_folder(scenario, place, progress)
    return place


def with_star_sensor(pictures: Path, *, priors: bool = True) -> Path:
    """The same pictures, told attitudes that are off as a star sensor's are.

    priors  False: and told no position
    """
    sigma = STAR_SENSOR_ARCSEC * ARCSEC
    word = f"{STAR_SENSOR_ARCSEC:g}arcsec"
    place = pictures.with_name(f"{pictures.name}-{word}" + ("" if priors else "-noprior"))
    folder = read_folder(pictures)
    rng = np.random.default_rng(SEED)
    frames = []
    for frame in folder.frames:
        turn = Rotation.from_rotvec(rng.normal(0.0, sigma, 3))
        attitude = None if frame.camera_from_body is None else turn * frame.camera_from_body
        told = replace(frame, camera_from_body=attitude, attitude_sigma_rad=sigma)
        if not priors:
            told = replace(told, position_m=None, position_sigma_m=None)
        frames.append(told)
    write_folder(place, folder.settings, folder.cameras.values(), frames, beside=pictures)
    for name in [*(frame.file for frame in frames), "truth.csv"]:
        link = place / name
        link.unlink(missing_ok=True)
        os.link(pictures / name, link)
    return place
