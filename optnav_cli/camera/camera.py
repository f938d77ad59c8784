"""A camera: the size of its picture and the lens that takes directions to pixels.

Camera frame: x right, y down, z along the boresight. Pixels (x, y), centre of the first at (0, 0).
"""

import math
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from typing import Annotated, Any, Literal

import msgspec
import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from catalog.arrays import BoolArray, FloatArray
from catalog.geometry.rotations import ARCSEC
from optnav_cli.camera import lens

MAX_ENTRIES = 65536
Number = Annotated[float, msgspec.Meta(ge=-1e9, le=1e9)]
Model = Literal["pinhole", "equidistant", "kannala_brandt"]
LineOrder = Literal["top_first", "bottom_first"]
Distortion = Literal["none", "brown", "opencv"]

PIXEL_SIGMA_PX = math.sqrt(1.0 / 12.0)  # of the square that a pixel is


class Coding(msgspec.Struct, frozen=True, forbid_unknown_fields=True, omit_defaults=True):
    """Relation between stored counts and light.

    curve   "linear": as light;  "square": light grows by the square of the counts;  "gamma": by
            their power `gamma`;  "table": as `counts` and `linear` say, straight lines between
    """

    curve: Literal["linear", "square", "gamma", "table"]
    gamma: Annotated[float, msgspec.Meta(ge=0.1, le=10.0)] | None = None
    counts: tuple[Number, ...] = ()
    linear: tuple[Number, ...] = ()

    def find_problem(self) -> str:
        """Describe what is wrong with the settings, with the remedy; empty for nothing."""
        if (self.gamma is None) == (self.curve == "gamma"):
            return 'gamma belongs to curve = "gamma", and that wants it'
        if self.curve != "table":
            return 'counts and linear belong to curve = "table"' if self.counts else ""
        if not 2 <= len(self.counts) == len(self.linear) <= MAX_ENTRIES:
            return (
                f"the table has {len(self.counts)} counts and {len(self.linear)} linear values; "
                f"wanted as many of both, 2 to {MAX_ENTRIES}"
            )
        if min(np.diff(self.counts).min(), np.diff(self.linear).min()) <= 0.0:
            return "counts and linear of the table must rise from entry to entry"
        return ""

    def decode(self, values: NDArray[Any], full: float) -> FloatArray:
        """Counts linear in light of counts as stored, any shape.

        full  coded counts that are the same decoded; of a power
        """
        if self.curve == "table":
            decoded: FloatArray = np.interp(values, self.counts, self.linear)
            return decoded
        power = self.gamma or (1.0 if self.curve == "linear" else 2.0)
        share = np.maximum(np.asarray(values, np.float64), 0.0) / full
        powered: FloatArray = full * share**power
        return powered

    def format_toml(self) -> str:
        """The section of a camera file."""
        lines = ["", "[coding]", f'curve = "{self.curve}"']
        if self.gamma is not None:
            lines.append(f"gamma = {self.gamma!r}")
        for key in ("counts", "linear"):
            if numbers := getattr(self, key):
                lines.append(f"{key} = {[float(number) for number in numbers]}")
        return "\n".join(lines) + "\n"


@dataclass(frozen=True)
class Camera:
    """Interior orientation of a camera.

    focal_length_px         along x, and along y where focal_length_y_px is None: square pixels
    principal_point_px      (x, y) where the boresight meets the picture
    coefficients            distortion "brown": k1 k2 p1 p2 k3 (OpenCV's forward model); "opencv":
                            its 4, 5, 8, 12 or 14 terms k1 k2 p1 p2 k3 k4 k5 k6 s1 s2 s3 s4 tau_x
                            tau_y; model "kannala_brandt": k1 k2 k3 k4; else empty
    image_circle_radius_px  about the principal point, along x; pixels beyond it see nothing
    pixel_pitch_um          width of a pixel, where known; only written back to files
    boresight_arcsec        turn of the camera from what attitudes of files state, about its x, y
                            and z (rotation vector): camera = turned * stated
    psf_sigma_px            blur by the optics, without the pixel's own width, as calibrated;
                            psf_error_px  its 1-sigma error. Both None where not known
    boresight_sigma_arcsec  how well its mounting is known, 1 sigma an axis: an error that stated
                            attitudes of all its frames have in common
    focal_length_error      how far the focal length may be off, 1 sigma, relative
    principal_point_error_px  the same of the principal point, a coordinate
    saturation_counts       counts of its pictures from which on a pixel is full; None: not stated
    valid_area_px           left, top, right, bottom pixel that belong to the picture; those beyond
                            have no value; None for all
    valid_mask              path of a picture that is 0 where a pixel has no value
    channel                 of colour pictures; None: luminance, with a remark
    exif_orientation        whether pictures are turned as their EXIF tag says; None: not stated
    line_order              which row of a file is the uppermost of the picture
    extension               number or name of the picture in FITS files; empty: the first
    coding                  of counts that are not linear in light
    """

    name: str
    model: Model
    width_px: int
    height_px: int
    focal_length_px: float
    principal_point_px: tuple[float, float]
    distortion: Distortion = "none"
    coefficients: tuple[float, ...] = ()
    image_circle_radius_px: float | None = None
    pixel_pitch_um: float | None = None
    psf_sigma_px: float | None = None
    psf_error_px: float | None = None
    focal_length_y_px: float | None = None
    boresight_sigma_arcsec: float = 0.0
    boresight_arcsec: tuple[float, float, float] | None = None
    focal_length_error: float = 0.0
    principal_point_error_px: float = 0.0
    saturation_counts: float | None = None
    valid_area_px: tuple[int, int, int, int] | None = None
    valid_mask: str | None = None
    channel: Literal["red", "green", "blue", "luminance"] | None = None
    exif_orientation: Literal["apply", "ignore"] | None = None
    line_order: LineOrder = "top_first"
    extension: str = ""
    coding: Coding | None = None

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns of a picture."""
        return self.height_px, self.width_px

    @property
    def aspect(self) -> float:
        """Focal length along y by that along x: the width of a pixel by its height."""
        return (
            1.0 if self.focal_length_y_px is None else self.focal_length_y_px / self.focal_length_px
        )

    @property
    def coarse_focal_px(self) -> float:
        """The shorter focal length, px: along the longer side of a pixel that is not square."""
        return self.focal_length_px * min(self.aspect, 1.0)

    @property
    def angular_resolution(self) -> float:
        """Angle of one pixel at the principal point, its longer side, rad."""
        return 1.0 / self.coarse_focal_px

    @property
    def boresight_sigma_rad(self) -> float:
        """Error of the mounting, common to all frames of the camera, 1 sigma an axis."""
        return self.boresight_sigma_arcsec * ARCSEC

    @property
    def known_blur_px(self) -> tuple[float, float] | None:
        """Sigma of the blur as calibrated, with the pixel's own width, and its 1-sigma error."""
        if self.psf_sigma_px is None or self.psf_error_px is None:
            return None
        blur_px = math.hypot(self.psf_sigma_px, PIXEL_SIGMA_PX)
        # an optics much sharper than the pixel hardly widens it, however badly it is known
        return blur_px, self.psf_error_px * max(self.psf_sigma_px, self.psf_error_px) / blur_px

    def with_focal_factor(self, factor: float) -> "Camera":
        """Return the camera with its focal lengths multiplied."""
        x_px, y_px = self.focal_length_px * factor, self.focal_length_y_px
        y_px = None if y_px is None else y_px * factor
        return replace(self, focal_length_px=x_px, focal_length_y_px=y_px)

    def with_lens(self, factor: float, shift_px: ArrayLike, k1: float) -> "Camera":
        """Return the camera with focal lengths scaled, principal point moved (2,), k1 added to."""
        x_px, y_px = np.asarray(shift_px, dtype=np.float64)
        return _change_lens(self, float(factor), float(x_px), float(y_px), float(k1))

    @property
    def boresight(self) -> Rotation:
        """The camera's turn from what attitudes of files state."""
        return Rotation.from_rotvec(np.array(self.boresight_arcsec or (0.0, 0.0, 0.0)) * ARCSEC)

    def apply_boresight(self, stated: Rotation) -> Rotation:
        """The camera's attitude where files state this one."""
        return stated if self.boresight_arcsec is None else self.boresight * stated

    def remove_boresight(self, attitude: Rotation) -> Rotation:
        """Return the attitude that files state for this attitude of the camera."""
        return attitude if self.boresight_arcsec is None else self.boresight.inv() * attitude

    @cached_property
    def _lens(self) -> tuple[int, FloatArray]:
        parameters = np.zeros(lens.PARAMETERS)
        parameters[:3] = self.focal_length_px, *self.principal_point_px
        first, more, tilts = self.coefficients[:5], self.coefficients[5:12], self.coefficients[12:]
        parameters[3 : 3 + len(first)] = first
        parameters[lens.ASPECT] = self.aspect
        if self.model == "pinhole":
            parameters[lens.TERMS : lens.TERMS + len(more)] = more
            tilt = _compute_tilt(*tilts) if tilts else np.eye(3)
            parameters[lens.TILT : lens.TILT + 9] = tilt.ravel()
            parameters[lens.LEVEL :] = np.linalg.inv(tilt).ravel()
            model = lens.OPENCV if any(more) or any(tilts) else lens.PINHOLE
            parameters[lens.LIMIT] = lens.find_pinhole_limit(parameters)
        else:
            terms = self.coefficients or (0.0, 0.0, 0.0, 0.0)
            model, parameters[lens.LIMIT] = lens.FISHEYE, lens.find_fisheye_limit(terms)
        circle = self.image_circle_radius_px
        parameters[lens.CIRCLE] = math.inf if circle is None else circle
        return model, parameters

    def project(self, points_camera: ArrayLike) -> FloatArray:
        """Pixels (..., 2) of points or directions (..., 3) in the camera frame, any length.

        NaN where the lens images nothing: behind a pinhole, beyond the fold of its distortion or
        the image circle. Pixels outside the picture are returned: see `contains`.
        """
        if self._lens[0] == lens.OPENCV:
            return self.project_with_jacobian(points_camera)[0]
        points, shape = _flatten_rows(points_camera, 3)
        pixels = np.empty((len(points), 2))
        lens.project_points(*self._lens, points, pixels)
        return pixels.reshape(*shape, 2)

    def project_from_body(
        self, points_body: ArrayLike, position: ArrayLike, camera_from_body: ArrayLike
    ) -> FloatArray:
        """Pixels (..., 2) of body-fixed points in one pass, for whole grids.

        points_body (..., 3) and position (3,)  m, body frame;  camera_from_body (3, 3)
        """
        if self._lens[0] == lens.OPENCV:
            offsets = np.asarray(points_body, dtype=np.float64) - np.asarray(position)
            return self.project(offsets @ np.asarray(camera_from_body).T)
        points, shape = _flatten_rows(points_body, 3)
        pixels = np.empty((len(points), 2))
        lens.project_body_points(
            *self._lens,
            points,
            np.ascontiguousarray(position, dtype=np.float64),
            np.ascontiguousarray(camera_from_body, dtype=np.float64),
            pixels,
        )
        return pixels.reshape(*shape, 2)

    def project_with_jacobian(self, points_camera: ArrayLike) -> tuple[FloatArray, FloatArray]:
        """Pixels (..., 2) and derivatives (..., 2, 3) by the points (..., 3), camera frame."""
        points, shape = _flatten_rows(points_camera, 3)
        pixels, jacobians = np.empty((len(points), 2)), np.empty((len(points), 2, 3))
        model, parameters = self._lens
        if model == lens.OPENCV:
            lens.project_opencv(parameters, points, pixels, jacobians)
        else:
            lens.project_with_derivatives(model, parameters, points, pixels, jacobians)
        return pixels.reshape(*shape, 2), jacobians.reshape(*shape, 2, 3)

    def unproject(self, pixels: ArrayLike) -> FloatArray:
        """Unit rays (..., 3), camera frame, of pixels (..., 2); NaN where no ray leads there."""
        rows, shape = _flatten_rows(pixels, 2)
        rays = np.empty((len(rows), 3))
        lens.invert_pixels(*self._lens, rows, rays)
        return rays.reshape(*shape, 3)

    def border(self, along: int) -> FloatArray:
        """Pixels (4 * along, 2) around the frame from corner to corner.

        A fisheye's lie on its image circle where that is nearer: no light falls beyond it.
        """
        side = np.linspace(0.0, 1.0, along, endpoint=False)
        zero, ones = np.zeros_like(side), np.ones_like(side)
        x = np.concatenate([side, ones, 1.0 - side, zero]) * self.width_px - 0.5
        y = np.concatenate([zero, side, ones, 1.0 - side]) * self.height_px - 0.5
        middle = np.array(self.principal_point_px)
        out = np.column_stack([x, y]) - middle
        most = 0.999 * (self.image_circle_radius_px or np.inf)
        reach = np.linalg.norm(out / (1.0, self.aspect), axis=1, keepdims=True)
        pixels: FloatArray = middle + out * np.minimum(most / reach, 1.0)
        return pixels

    def radius_px(self, pixels: ArrayLike) -> FloatArray:
        """Distances (...) of pixels (..., 2) from the principal point, in widths of a pixel."""
        out = np.asarray(pixels, dtype=np.float64) - np.array(self.principal_point_px)
        radius: FloatArray = np.linalg.norm(out / (1.0, self.aspect), axis=-1)
        return radius

    def contains(self, pixels: ArrayLike, margin_px: float = 0.0) -> BoolArray:
        """Whether pixels (..., 2) lie in the picture, at least margin_px inside its edge."""
        x, y = np.moveaxis(np.asarray(pixels, dtype=np.float64), -1, 0)
        low = margin_px - 0.5
        inside: BoolArray = (x >= low) & (x <= self.width_px - 1 - low)
        inside &= (y >= low) & (y <= self.height_px - 1 - low)
        return inside


def _flatten_rows(values: ArrayLike, width: int) -> tuple[FloatArray, tuple[int, ...]]:
    array = np.asarray(values, dtype=np.float64)
    if array.shape[-1:] != (width,):
        raise ValueError(f"expected an array (..., {width}), got {array.shape}")
    return np.ascontiguousarray(array).reshape(-1, width), array.shape[:-1]


# where the fold of a distortion lies takes 10 ms to find, and all frames of a step have one lens
@lru_cache(maxsize=64)
def _change_lens(camera: Camera, factor: float, x_px: float, y_px: float, k1: float) -> Camera:
    x0_px, y0_px = camera.principal_point_px
    moved = camera.with_focal_factor(factor)
    moved = replace(moved, principal_point_px=(x0_px + x_px, y0_px + y_px))
    if k1 == 0.0:
        return moved
    first, *others = camera.coefficients or (0.0,) * (5 if camera.model == "pinhole" else 4)
    if moved.model == "pinhole" and moved.distortion == "none":
        moved = replace(moved, distortion="brown")
    elif moved.model == "equidistant":  # the fisheye without terms
        moved = replace(moved, model="kannala_brandt")
    return replace(moved, coefficients=(first + k1, *others))


def _compute_tilt(tau_x: float, tau_y: float) -> FloatArray:
    """Return the map (3, 3) of the picture plane for a sensor turned about x, then about y, rad.

    As OpenCV defines its tilted sensor.
    """
    cx, sx, cy, sy = math.cos(tau_x), math.sin(tau_x), math.cos(tau_y), math.sin(tau_y)
    about_x = np.array([[1.0, 0.0, 0.0], [0.0, cx, sx], [0.0, -sx, cx]])
    about_y = np.array([[cy, 0.0, -sy], [0.0, 1.0, 0.0], [sy, 0.0, cy]])
    turned = about_y @ about_x
    onto = np.array(
        [[turned[2, 2], 0.0, -turned[0, 2]], [0.0, turned[2, 2], -turned[1, 2]], [0.0, 0.0, 1.0]]
    )
    moved: FloatArray = onto @ turned
    return moved
