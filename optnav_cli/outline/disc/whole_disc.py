"""Navigation by the whole disc of a sphere of some five to twenty-five pixels' radius.

Ours: such a disc has a limb, but too few pixels about it for its profiles. All its pixels are
fitted at once (`fit_disc`), which is several times as good as the limb alone, and the covariance is
honest.
"""

import numpy as np

from catalog.arrays import FloatArray
from catalog.bodies.body import Body
from catalog.errors import NoSolutionError
from optnav_cli.camera.camera import Camera
from optnav_cli.fix import Evidence, Fix, Method, OutlineMarks
from optnav_cli.frames.picture import Picture
from optnav_cli.outline.disc.brightness_centre import make_disc_fix
from optnav_cli.outline.disc.fit import ABOUT_PX, fit_disc, rad_per_px
from optnav_cli.outline.disc.moments import MAX_SMALL_DISC_PX
from optnav_cli.outline.disc.size import load_disc_sizes
from optnav_cli.outline.limb.detection import LimbPoints
from optnav_cli.outline.neighbour import CameraView
from optnav_cli.reasons import ReasonCode

# Of 100 drawn discs the misfit was 0.7-1.1 under their own Sun, and over 1.25 or without a solution
# under one turned by 45 or 180 deg about the line of sight from a phase of 15 deg on. Ground of two
# kinds may cost as much, so that only the larger one refuses.
TRUSTED_MISFIT, MAX_MISFIT = 1.2, 3.0
STEP_PX = 0.01


def is_for(limb: LimbPoints, camera: Camera) -> bool:
    """Whether a disc is small enough, and whole in the picture with its surroundings."""
    radius_px = limb.cone_angle / rad_per_px(camera, limb.cone_axis_camera)
    margin = radius_px + ABOUT_PX + 2.0
    pixel = camera.project(limb.cone_axis_camera)
    return radius_px < MAX_SMALL_DISC_PX and bool(camera.contains(pixel, margin))


def navigate(picture: Picture, view: CameraView, body: Body, limb: LimbPoints) -> Fix | None:
    """The camera's position from a small disc whose limb was found.

    Returns None where the light leaves a doubt about a sphere under this Sun: the limb is better.
    Raises NoSolutionError for a disc whose light is not that of a sphere under this Sun.
    """
    camera, sun = view.camera, view.camera_from_body.apply(view.sun_body)
    per_px = rad_per_px(camera, limb.cone_axis_camera)
    fit = fit_disc(
        picture.values, camera, limb.cone_axis_camera, limb.cone_angle, sun, picture.saturation
    )
    if fit.misfit > MAX_MISFIT:
        raise NoSolutionError(
            f"the disc's light is {fit.misfit:.1f} times as far from that of a sphere under the "
            "Sun of attitude and time as noise explains: one of these is wrong, or another body",
            ReasonCode.WRONG_LIGHT,
        )
    if fit.misfit > TRUSTED_MISFIT:
        return None

    def place(state: FloatArray) -> FloatArray:
        ray = camera.unproject(state[:2])
        position: FloatArray = -ray * body.radius_m / np.sin(state[2] * per_px)
        return position

    state = np.append(fit.centre_px, fit.radius_px)
    steps = STEP_PX * np.eye(3)
    change = np.stack([place(state + s) - place(state - s) for s in steps], axis=1) / (2 * STEP_PX)
    position = place(state)
    lit = 0.5 * (1.0 + float(position @ sun) / float(np.linalg.norm(position)))
    # the figure moves the fitted centre and radius; shadows on its ground do more as the lit share
    # shrinks
    sizes = load_disc_sizes()
    shape_px = sizes.figure * fit.radius_px / max(lit, 0.1)
    spread = fit.covariance + (shape_px**2 + sizes.drawing_px**2) * np.eye(3)
    covariance = change @ spread @ change.T
    marks = OutlineMarks(limb.pixels, limb.inward, np.zeros(len(limb)))
    evidence = Evidence(n_limb=len(limb), arc_deg=limb.arc_deg, outline=marks)
    text = f"disc of {2.0 * fit.radius_px:.1f} px fitted whole"
    return make_disc_fix(Method.HORIZON_SPHERE, view, position, covariance, evidence, text)
