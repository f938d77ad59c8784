"""Which control points a frame should show at a pose, and why it may show none.

A point is expected when it lies in front of the camera and whole inside the frame, is lit, is not
seen edge-on and is not hidden behind the terrain about it.
"""

from dataclasses import dataclass, fields, replace
from itertools import product

import msgspec
import numpy as np

from catalog.arrays import BoolArray, FloatArray, IndexArray
from catalog.correlation.similarity import Matcher
from catalog.geometry.latlon import latlon_from_xyz
from optnav_cli.camera.camera import Camera
from optnav_cli.control_points.field import ControlPointField
from optnav_cli.control_points.picture_pyramid import PicturePyramid
from optnav_cli.control_points.search_plan import choose_template_nodes, find_finest_level
from optnav_cli.control_points.settings import NavigateSettings, ViewSettings
from optnav_cli.estimation.models.points import Pose
from optnav_cli.frames.folder import Observation
from optnav_cli.reasons import Reason, ReasonCode, format_distinct


@dataclass(frozen=True, eq=False)
class FrameContext:
    """Constant inputs of a frame's navigation; `picture` is the observation's."""

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

    def find_finest_level(self, postings_m: FloatArray, metres_per_pixel: float) -> int:
        """Find the finest level worth matching at a ground sample distance."""
        share = self.settings.match.finest_posting_per_gsd
        return find_finest_level(postings_m, metres_per_pixel, share)

    def choose_template_nodes(
        self, posting_m: float, metres_per_pixel: float, known_m: float
    ) -> int:
        """Choose the side of the template at a level's posting, nodes.

        known_m  posting of the terrain model. A frame may cut what is cut from a coarser model: a
                 smaller template would hold too little that is known.
        """
        if posting_m < known_m:
            return self.settings.match.template_nodes
        width_m = metres_per_pixel * min(self.camera.width_px, self.camera.height_px)
        return choose_template_nodes(posting_m, width_m, self.settings.match.template_nodes)


@dataclass(frozen=True, eq=False)
class CandidatePoints:
    """Control points that a frame may show, one entry each.

    points_m      (n, 3)  body-fixed
    half_width_m  (n,)    half the side of the square that must lie inside the frame
    skyline_deg   (n, azimuths) terrain skyline by azimuth from north; a camera below it sees
                  nothing of the point
    verticals     (n, 3) unit normals at the points; None: radial, as on a sphere
    beyond_px     (n,) how far out of the frame a point may lie of which a part is enough
    """

    points_m: FloatArray
    half_width_m: FloatArray
    skyline_deg: FloatArray | None = None
    verticals: FloatArray | None = None
    beyond_px: FloatArray | None = None


@dataclass(frozen=True, eq=False)
class ExpectedPoints:
    """The control points expected in a frame, one entry each.

    index              places in the arrays that were asked about
    pixels             (n, 2) where the points should be
    metres_per_pixel   (n,) geometric mean ground sample distance at the point
    sun_elevation_deg  (n,)
    emission_deg       (n,)
    """

    index: IndexArray
    pixels: FloatArray
    metres_per_pixel: FloatArray
    sun_elevation_deg: FloatArray
    emission_deg: FloatArray

    def __len__(self) -> int:
        return len(self.index)


def find_expected(frame: FrameContext, pose: Pose, whole: bool) -> ExpectedPoints:
    """Find points expected in the frame, whole with their finest template or centre only.

    Of templates that the frame may cut a part is enough; it may be without the centre.
    """
    points, camera, limits = frame.points, frame.camera, frame.settings.view
    if points.image_error_m is not None:  # only relief fades under a high Sun
        limits = msgspec.structs.replace(limits, sun_max_deg=90.0)
    near = points.near(pose.position_m, limits.emission_max_deg)
    distances = np.linalg.norm(points.xyz_m[near] - pose.position_m, axis=1)
    samples = np.maximum(distances / camera.coarse_focal_px, 1e-3)
    half, beyond = np.zeros(len(near)), np.zeros(len(near))
    # far fewer distinct answers than points: steps of a tenth are finer than any level needs
    steps = np.floor(np.log(samples) / np.log(1.1))
    for number, layer in enumerate(points.layers):
        of_layer = points.layer_of[near] == number
        for step in np.unique(steps[of_layer]):
            these = of_layer & (steps == step)
            sample = float(1.1 ** (step + 0.5))
            posting = float(layer.postings_m[frame.find_finest_level(layer.postings_m, sample)])
            side = frame.choose_template_nodes(posting, sample, layer.known_m) * posting
            if posting < layer.known_m:
                # Where a part is enough a point may lie 30 % of its template's side beyond the
                # frame.
                beyond[these] = 0.3 * side / samples[these]
            elif whole:
                half[these] = side / 2.0
    candidates = CandidatePoints(
        points.xyz_m[near], half, points.skyline_deg[near], points.verticals[near], beyond
    )
    seen = find_in_view(candidates, camera, pose, frame.sun_body, limits)
    return replace(seen, index=near[seen.index])


def find_in_view(
    candidates: CandidatePoints,
    camera: Camera,
    pose: Pose,
    sun_body: FloatArray,
    limits: ViewSettings,
) -> ExpectedPoints:
    """Find the candidates that a frame should show whole; sun_body (3,) unit vector, body frame."""
    points_m, verticals = candidates.points_m, candidates.verticals
    if verticals is None:
        verticals = points_m / np.linalg.norm(points_m, axis=1, keepdims=True)
    to_camera = pose.position_m - points_m
    distance = np.linalg.norm(to_camera, axis=1)
    cos_emission = np.einsum("ni,ni->n", verticals, to_camera) / distance
    sin_sun = verticals @ sun_body
    limits_ok = (
        (cos_emission > np.cos(np.radians(limits.emission_max_deg)))
        & (sin_sun > np.sin(np.radians(limits.sun_min_deg)))
        # 90 degrees is no limit, and a sine of the zenith may be a rounding above 1
        & (sin_sun <= np.sin(np.radians(limits.sun_max_deg)) + 1e-12)
    )
    index = np.flatnonzero(limits_ok)
    skyline_deg = candidates.skyline_deg
    if skyline_deg is not None and len(index):
        index = index[_is_above_skyline(verticals[index], to_camera[index], skyline_deg[index])]
    if len(index) == 0:
        none = np.empty(0)
        return ExpectedPoints(np.empty(0, dtype=np.intp), np.empty((0, 2)), none, none, none)
    camera_from_body = pose.turn
    centres = (points_m[index] - pose.position_m) @ camera_from_body.T
    pixels, by_point = camera.project_with_jacobian(centres)
    east, north = _compute_horizontals(verticals[index])
    ground = np.stack([east @ camera_from_body.T, north @ camera_from_body.T], axis=-1)
    jacobian = by_point @ ground
    with np.errstate(invalid="ignore"):
        metres_per_pixel = 1.0 / np.sqrt(np.abs(np.linalg.det(jacobian)))
    beyond = candidates.beyond_px
    room = np.zeros(len(index)) if beyond is None else beyond[index]
    inside = _is_inside(pixels, camera, room) & np.isfinite(metres_per_pixel)
    for sx, sy in product((-1.0, 1.0), repeat=2):
        offset = candidates.half_width_m[index, None] * (sx * east + sy * north)
        corner, _ = camera.project_with_jacobian(centres + offset @ camera_from_body.T)
        inside &= _is_inside(corner, camera, room)
    chosen = index[inside]
    sun_deg = np.degrees(np.arcsin(np.clip(sin_sun[chosen], -1.0, 1.0)))
    emission_deg = np.degrees(np.arccos(np.clip(cos_emission[chosen], -1.0, 1.0)))
    return ExpectedPoints(chosen, pixels[inside], metres_per_pixel[inside], sun_deg, emission_deg)


def select_evenly(view: ExpectedPoints, count: int) -> ExpectedPoints:
    """Select up to `count` points evenly: each next is the farthest from all so far."""
    if len(view) <= count:
        return view
    chosen = [int(np.argmin(np.linalg.norm(view.pixels - view.pixels.mean(axis=0), axis=1)))]
    gap = np.full(len(view), np.inf)
    while len(chosen) < count:
        last = view.pixels[chosen[-1]]
        gap = np.minimum(gap, np.linalg.norm(view.pixels - last, axis=1))
        chosen.append(int(np.argmax(gap)))
    keep = np.sort(np.array(chosen))
    return ExpectedPoints(*(getattr(view, column.name)[keep] for column in fields(view)))


def explain_empty_view(frame: FrameContext, pose: Pose) -> Reason:
    """Explain which condition leaves no point in view."""
    points, limits = frame.points, frame.settings.view
    distance = float(np.linalg.norm(pose.position_m))
    if distance <= points.radius_m:
        return Reason(ReasonCode.INSIDE_BODY, "the prior position is inside the body")
    any_light = ViewSettings(-90.0, 90.0, limits.emission_max_deg)
    candidates = CandidatePoints(points.xyz_m, np.zeros(len(points)), verticals=points.verticals)
    seen = find_in_view(candidates, frame.camera, pose, pose.position_m / distance, any_light)
    if len(seen) == 0:
        text = "no control point of the catalog in the frame at the prior pose"
        return Reason(ReasonCode.NO_POINTS_IN_VIEW, text)
    sun_sines = points.verticals[seen.index] @ frame.sun_body
    lit = np.degrees(np.arcsin(np.clip(sun_sines, -1.0, 1.0)))
    if ((lit >= limits.sun_min_deg) & (lit <= limits.sun_max_deg)).any():
        return Reason(
            ReasonCode.POINTS_HIDDEN,
            f"the {len(seen)} control points in the frame stand in the shadow of the terrain "
            "about them, or the frame cuts the ground that is compared",
        )
    lowest, most = format_distinct(float(lit.min()), limits.sun_max_deg, 1)
    highest, least = format_distinct(float(lit.max()), limits.sun_min_deg, 1)
    return Reason(
        ReasonCode.POINTS_UNLIT,
        f"none of the {len(seen)} control points in the frame is lit well: Sun elevation "
        f"{lowest} to {highest} deg, wanted {least} to {most}",
    )


def _is_inside(pixels: FloatArray, camera: Camera, room_px: FloatArray) -> BoolArray:
    room, size = room_px[:, None], np.array([camera.width_px, camera.height_px])
    with np.errstate(invalid="ignore"):
        inside: BoolArray = (pixels > -0.5 - room) & (pixels < size - 0.5 + room)
    return inside[:, 0] & inside[:, 1]


def _compute_horizontals(verticals: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Compute east and north unit vectors (n, 3) of verticals (n, 3)."""
    lat, lon, _ = latlon_from_xyz(verticals)
    east = np.stack([-np.sin(lon), np.cos(lon), np.zeros_like(lat)], axis=1)
    north = np.stack([-np.sin(lat) * np.cos(lon), -np.sin(lat) * np.sin(lon), np.cos(lat)], axis=1)
    return east, north


def _is_above_skyline(up: FloatArray, to_camera: FloatArray, skyline_deg: FloatArray) -> BoolArray:
    east, north = _compute_horizontals(up)
    distance = np.linalg.norm(to_camera, axis=1)
    sine = np.einsum("ni,ni->n", up, to_camera) / distance
    elevation = np.degrees(np.arcsin(np.clip(sine, -1.0, 1.0)))  # rounding, right below the camera
    x, y = (np.einsum("ni,ni->n", axis, to_camera) for axis in (north, east))
    azimuth = np.degrees(np.arctan2(y, x))
    bins = skyline_deg.shape[1]
    nearest = np.rint(azimuth / (360.0 / bins)).astype(int) % bins
    above: BoolArray = elevation > skyline_deg[np.arange(len(up)), nearest]
    return above
