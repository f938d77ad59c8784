"""Which control points a camera should see: in front, whole inside the frame, lit, not edge-on."""

from dataclasses import dataclass

import numpy as np

from catalog.arrays import BoolArray, FloatArray, IndexArray
from catalog.geometry.latlon import latlon_from_xyz
from optnav_cli.estimation.models.points import Pose, ProjectingCamera


@dataclass(frozen=True)
class ViewLimits:
    """When a control point counts as visible.

    sun_min_deg, sun_max_deg  Sun elevation at the point
    emission_max_deg          angle between the local vertical and the camera
    """

    sun_min_deg: float = 5.0
    sun_max_deg: float = 60.0
    emission_max_deg: float = 70.0


@dataclass(frozen=True)
class View:
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


def expected_in_view(
    points_m: FloatArray,
    half_width_m: FloatArray,
    camera: ProjectingCamera,
    frame_size_px: tuple[int, int],
    pose: Pose,
    sun_body: FloatArray,
    limits: ViewLimits,
    skyline_deg: FloatArray | None = None,
    verticals: FloatArray | None = None,
    beyond_px: FloatArray | None = None,
) -> View:
    """Choose the control points that a frame should show whole.

    points_m      (n, 3)  body-fixed
    half_width_m  (n,)    half the side of the square that must lie inside the frame
    frame_size_px (width, height)
    sun_body      (3,)    unit vector to the Sun
    skyline_deg   (n, azimuths) terrain skyline by azimuth from north; a camera below it sees
                  nothing of the point
    verticals     (n, 3) unit normals at the points; None: radial, as on a sphere
    beyond_px     (n,) how far out of the frame a point may lie of which a part is enough
    """
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
    if skyline_deg is not None and len(index):
        index = index[_above_skyline(verticals[index], to_camera[index], skyline_deg[index])]
    if len(index) == 0:
        return _empty_view()
    turn = pose.camera_from_body.as_matrix()
    centres = (points_m[index] - pose.position_m) @ turn.T
    pixels, by_point = camera.project_with_jacobian(centres)
    east, north = _horizontals(verticals[index])
    ground = np.stack([east @ turn.T, north @ turn.T], axis=-1)
    jacobian = by_point @ ground
    with np.errstate(invalid="ignore"):
        metres_per_pixel = 1.0 / np.sqrt(np.abs(np.linalg.det(jacobian)))
    room = np.zeros(len(index)) if beyond_px is None else beyond_px[index]
    inside = _inside(pixels, frame_size_px, room) & np.isfinite(metres_per_pixel)
    for sx in (-1.0, 1.0):
        for sy in (-1.0, 1.0):
            offset = half_width_m[index, None] * (sx * east + sy * north)
            corner, _ = camera.project_with_jacobian(centres + offset @ turn.T)
            inside &= _inside(corner, frame_size_px, room)
    chosen = index[inside]
    return View(
        chosen,
        pixels[inside],
        metres_per_pixel[inside],
        np.degrees(np.arcsin(np.clip(sin_sun[chosen], -1.0, 1.0))),
        np.degrees(np.arccos(np.clip(cos_emission[chosen], -1.0, 1.0))),
    )


def _empty_view() -> View:
    none = np.empty(0)
    return View(np.empty(0, dtype=np.intp), np.empty((0, 2)), none, none, none)


def _inside(pixels: FloatArray, frame_size_px: tuple[int, int], room_px: FloatArray) -> BoolArray:
    room = room_px[:, None]
    width, height = frame_size_px
    with np.errstate(invalid="ignore"):
        inside = (pixels > -0.5 - room) & (pixels < np.array([width - 0.5, height - 0.5]) + room)
    return np.asarray(inside.all(axis=1))


def _horizontals(verticals: FloatArray) -> tuple[FloatArray, FloatArray]:
    """East and north unit vectors (n, 3) of verticals (n, 3)."""
    lat, lon, _ = latlon_from_xyz(verticals)
    zero = np.zeros_like(lat)
    east = np.stack([-np.sin(lon), np.cos(lon), zero], axis=1)
    north = np.stack([-np.sin(lat) * np.cos(lon), -np.sin(lat) * np.sin(lon), np.cos(lat)], axis=1)
    return east, north


def _above_skyline(up: FloatArray, to_camera: FloatArray, skyline_deg: FloatArray) -> BoolArray:
    east, north = _horizontals(up)
    distance = np.linalg.norm(to_camera, axis=1)
    elevation = np.degrees(np.arcsin(np.einsum("ni,ni->n", up, to_camera) / distance))
    azimuth = np.degrees(
        np.arctan2(np.einsum("ni,ni->n", east, to_camera), np.einsum("ni,ni->n", north, to_camera))
    )
    bins = skyline_deg.shape[1]
    nearest = np.rint(azimuth / (360.0 / bins)).astype(int) % bins
    return np.asarray(elevation > skyline_deg[np.arange(len(up)), nearest])
