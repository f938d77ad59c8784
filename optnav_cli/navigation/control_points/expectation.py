"""Which control points a frame should show at a pose, and why it may show none."""

from dataclasses import dataclass, replace

import numpy as np

from catalog.arrays import FloatArray
from catalog.correlation.similarity import Matcher
from optnav_cli.camera.camera import Camera
from optnav_cli.estimation.resection import Pose
from optnav_cli.matching.picture_pyramid import PicturePyramid
from optnav_cli.matching.search_plan import finest_level, template_nodes
from optnav_cli.matching.visibility import View, ViewLimits, expected_in_view
from optnav_cli.navigation.control_points.field import ControlPointField
from optnav_cli.navigation.observation import Observation
from optnav_cli.navigation.settings import NavigateSettings
from optnav_cli.reasons import Reason, ReasonCode

# A point may lie so far beyond the frame, share of its template's side, if a part is enough.
BEYOND_SHARE = 0.3


@dataclass(frozen=True, eq=False)
class FrameContext:
    """What stays the same while a frame is navigated; `picture` is the observation's."""

    observation: Observation
    picture: PicturePyramid
    points: ControlPointField
    settings: NavigateSettings
    matcher: Matcher

    @property
    def camera(self) -> Camera:
        """The frame's camera."""
        return self.observation.camera

    @property
    def sun_body(self) -> FloatArray:
        """(3,) unit vector to the Sun, body frame."""
        return self.observation.sun_body

    def finest_level(self, postings_m: FloatArray, metres_per_pixel: float) -> int:
        """The finest of some levels worth matching at a ground sample distance."""
        share = self.settings.match.finest_posting_per_gsd
        return finest_level(postings_m, metres_per_pixel, share)

    def template_nodes(self, posting_m: float, metres_per_pixel: float, known_m: float) -> int:
        """Side of the template at a level's posting, nodes.

        known_m  posting of the terrain model. A frame may cut what is cut from a coarser model: a
                 smaller template would hold too little that is known.
        """
        if posting_m < known_m:
            return self.settings.match.template_nodes
        width_m = metres_per_pixel * min(self.camera.width_px, self.camera.height_px)
        return template_nodes(posting_m, width_m, self.settings.match.template_nodes)


def expected(frame: FrameContext, pose: Pose, whole: bool) -> View:
    """Points expected in the frame, whole with their finest template or with their centre only.

    Of templates that the frame may cut a part is enough; it may be without the centre.
    """
    points, camera, view = frame.points, frame.camera, frame.settings.view
    near = points.near(pose.position_m, view.emission_max_deg)
    distances = np.linalg.norm(points.xyz_m[near] - pose.position_m, axis=1)
    samples = np.maximum(distances / camera.focal_length_px, 1e-3)
    half, beyond = np.zeros(len(near)), np.zeros(len(near))
    # far fewer distinct answers than points: steps of a tenth are finer than any level needs
    steps = np.floor(np.log(samples) / np.log(1.1))
    for number, layer in enumerate(points.layers):
        own = points.layer_of[near] == number
        for step in np.unique(steps[own]):
            these = own & (steps == step)
            sample = float(1.1 ** (step + 0.5))
            posting = float(layer.postings_m[frame.finest_level(layer.postings_m, sample)])
            side = frame.template_nodes(posting, sample, layer.known_m) * posting
            if posting < layer.known_m:
                beyond[these] = BEYOND_SHARE * side / samples[these]
            elif whole:
                half[these] = side / 2.0
    seen = expected_in_view(
        points.xyz_m[near],
        half,
        camera,
        (camera.width_px, camera.height_px),
        pose,
        frame.sun_body,
        ViewLimits(view.sun_min_deg, view.sun_max_deg, view.emission_max_deg),
        points.skyline_deg[near],
        points.verticals[near],
        beyond,
    )
    return replace(seen, index=near[seen.index])


def why_nothing_in_view(frame: FrameContext, pose: Pose) -> Reason:
    """Say which condition emptied the view."""
    points, camera, sun_body = frame.points, frame.camera, frame.sun_body
    settings = frame.settings
    sun = np.degrees(np.arcsin(np.clip(points.verticals @ sun_body, -1.0, 1.0)))
    height = float(np.linalg.norm(pose.position_m)) - points.radius_m
    if height <= 0.0:
        return Reason(ReasonCode.INSIDE_BODY, "the prior position is inside the body")
    seen = expected_in_view(
        points.xyz_m,
        np.zeros(len(points)),
        camera,
        (camera.width_px, camera.height_px),
        pose,
        pose.position_m / np.linalg.norm(pose.position_m),
        ViewLimits(-90.0, 90.0, settings.view.emission_max_deg),
        verticals=points.verticals,
    )
    if len(seen) == 0:
        return Reason(
            ReasonCode.NO_POINTS_IN_VIEW,
            "no control point of the catalog in the frame at the prior pose",
        )
    lit = sun[seen.index]
    if ((lit >= settings.view.sun_min_deg) & (lit <= settings.view.sun_max_deg)).any():
        return Reason(
            ReasonCode.POINTS_HIDDEN,
            f"the {len(seen)} control points in the frame stand in the shadow of the terrain "
            "about them, or the frame cuts the ground that is compared",
        )
    return Reason(
        ReasonCode.POINTS_UNLIT,
        f"none of the {len(seen)} control points in the frame is lit well: Sun elevation "
        f"{lit.min():.1f} to {lit.max():.1f} deg, wanted {settings.view.sun_min_deg:.0f} to "
        f"{settings.view.sun_max_deg:.0f}",
    )


def select_evenly(view: View, most: int) -> View:
    """At most `most` points, evenly over the frame: each next is the farthest from all so far."""
    if len(view) <= most:
        return view
    chosen = [int(np.argmin(np.linalg.norm(view.pixels - view.pixels.mean(axis=0), axis=1)))]
    gap = np.linalg.norm(view.pixels - view.pixels[chosen[0]], axis=1)
    while len(chosen) < most:
        nearest = int(np.argmax(gap))
        chosen.append(nearest)
        gap = np.minimum(gap, np.linalg.norm(view.pixels - view.pixels[nearest], axis=1))
    keep = np.sort(np.array(chosen))
    return View(
        view.index[keep],
        view.pixels[keep],
        view.metres_per_pixel[keep],
        view.sun_elevation_deg[keep],
        view.emission_deg[keep],
    )
