"""An orbit as the prior of frames that state no position: `optnav navigate --orbit`."""

import logging
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from catalog.bodies.body import Body
from catalog.errors import DataError
from optnav_cli.fix import PositionPrior
from optnav_cli.frames.frames import Frame
from optnav_cli.frames.run_settings import RUN_TOML
from optnav_cli.orbit.fit.folder import ORBIT_CSV, ORBIT_TOML, read_orbit, stated_turn
from optnav_cli.orbit.fit.predict import OrbitPath

SOURCE = "orbit"  # what solution.csv calls the prior

log = logging.getLogger(__name__)


def orbit_inputs(folder: Path) -> list[Path]:
    """The files of an orbit's folder that priors are made from."""
    return [folder / name for name in (ORBIT_TOML, ORBIT_CSV, RUN_TOML)]


def with_orbit(frames: Sequence[Frame], body: Body, folder: Path) -> list[Frame]:
    """Frames, those with a time and without a position with the prior to which an orbit leads.

    Raises DataError for a folder that holds no orbit about the body.
    """
    orbit = read_orbit(folder)
    if orbit.body.name != body.name:
        raise DataError(
            f"{folder}: is an orbit about {orbit.body.name}; the pictures show {body.name}: name "
            "an orbit about it"
        )
    path = OrbitPath(orbit)
    open_s = [f.tdb_s for f in frames if f.position_m is None and f.tdb_s is not None]
    if not open_s:
        log.info("%s: each frame states its position, so the orbit is not used", folder)
    prediction = path.rows(np.unique(open_s))
    if prediction.meeting:
        log.warning("%s: %s; later frames have no prior", folder, prediction.meeting)
    rows, priors = prediction.rows, {}
    for time, state, spread in zip(rows.times, rows.states, rows.covariances, strict=True):
        turn = stated_turn(orbit.ephemeris, float(time))
        covariance = turn @ spread[:3, :3] @ turn.T
        frame = body.catalog_frame  # that of files, which catalogs may lie beside
        priors[float(time)] = PositionPrior(
            frame.transform_to_catalog(turn @ state[:3]),
            frame.transform_covariance_to_catalog(covariance),
            SOURCE,
        )
    return [
        frame
        if frame.position_m is not None or frame.tdb_s is None
        else replace(frame, predicted=priors.get(frame.tdb_s))
        for frame in frames
    ]
