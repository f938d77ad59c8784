"""A picture laid on the ground: brightness in square cells of about a metre, with its light.

Local vectors are x along the cells' columns, y against their rows, z up. With a pose the cells lie
on a stereographic map about the middle of the view, north up; without one the camera looks straight
down on a plane, and y is the picture's upper edge.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from catalog.arrays import BoolArray, Float32Array, FloatArray
from catalog.errors import NoSolutionError
from catalog.geometry.ellipsoid import distance_to_sphere
from catalog.geometry.latlon import latlon_from_xyz
from catalog.geometry.projection import Stereographic
from catalog.geometry.vectors import unit
from optnav_cli.camera.camera import Camera
from optnav_cli.frames.picture import Picture

CELL_M = 1.0  # wanted; the picture is averaged over the whole number of pixels that comes nearest
MIN_PAD_CELLS = 3
LATTICE = 16  # cells between places that are projected; a bilinear surface between them
MAX_CELLS = 16_000_000
MAX_SLANT_DEG = 60.0  # off the vertical: relief hides what lies behind it
MIN_SUN_DEG, MAX_SUN_DEG = 0.5, 60.0
MAX_SATURATED = 0.02

Heights = Callable[[FloatArray, FloatArray], FloatArray]  # of latitudes and longitudes, rad


@dataclass(frozen=True, eq=False)
class PictureOnGround:
    """A picture on the ground.

    brightness  (rows, cols) of the cells, less the detector's dark level
    valid       (rows, cols) whether the picture shows the cell
    cell_m      side of a cell
    sun         (3,) unit vector to the Sun at the middle
    camera_m    (3,) the camera's place from the middle's foot
    projection  of the cells' map; None without a pose
    lattice_px  (2, m, n) x and y in the picture of every LATTICE-th cell; see `pixels`
    """

    brightness: Float32Array
    valid: BoolArray
    cell_m: float
    sun: FloatArray
    camera_m: FloatArray
    projection: Stereographic | None
    lattice_px: FloatArray

    @property
    def placed(self) -> Stereographic:
        """Return the projection. Raises ValueError for a view without a place on the body."""
        if self.projection is None:
            raise ValueError("the view needs a place on the body")
        return self.projection

    @property
    def sun_elevation_deg(self) -> float:
        return _compute_elevation_deg(self.sun)

    @property
    def pixel_m(self) -> float:
        """Side of a pixel of the picture on the ground at the middle, m."""
        middle = np.array(self.lattice_px.shape[1:]) // 2
        i, j = (max(1, int(at)) for at in middle)
        step = self.lattice_px[:, i, j] - self.lattice_px[:, i, j - 1]
        across = float(np.linalg.norm(step)) / LATTICE  # pixels of a cell
        return self.cell_m / across if across > 0.0 else self.cell_m

    @property
    def sun_azimuth(self) -> float:
        """Azimuth of the Sun, rad, clockwise from against the rows (north on a map)."""
        return math.atan2(self.sun[0], self.sun[1])

    def xy_m(self, row: ArrayLike, col: ArrayLike) -> tuple[FloatArray, FloatArray]:
        """Return x and y, m, of (fractional) cells from the middle."""
        rows, cols = self.brightness.shape
        x = (np.asarray(col, dtype=np.float64) - 0.5 * (cols - 1)) * self.cell_m
        y = (0.5 * (rows - 1) - np.asarray(row, dtype=np.float64)) * self.cell_m
        return x, y

    def find_pixel(self, row: float, col: float) -> tuple[float, float]:
        """Return the picture's x and y, px, of a (fractional) cell."""
        x, y = (_interpolate(part, np.array([row]), np.array([col])) for part in self.lattice_px)
        return float(x[0, 0]), float(y[0, 0])

    @cached_property
    def affine(self) -> tuple[float, float, float, float, float, float]:
        """From the corner of the first cell, as rasters have it: a, b, c, d, e, f."""
        rows, cols = self.brightness.shape
        half_x, half_y = 0.5 * cols * self.cell_m, 0.5 * rows * self.cell_m
        return self.cell_m, 0.0, -half_x, 0.0, -self.cell_m, half_y


def look_down(
    picture: Picture,
    camera: Camera,
    height_m: float,
    sun_elevation_deg: float,
    azimuth_deg: float,
    cell_m: float = CELL_M,
) -> PictureOnGround:
    """Map the view of a camera that looks straight down on level ground.

    azimuth_deg  of the Sun, clockwise from the picture's upper edge
    cell_m       wanted side of a cell; it is a whole number of pixels
    Raises NoSolutionError with the reason why nothing can be told from such a picture.
    """
    e, a = math.radians(sun_elevation_deg), math.radians(azimuth_deg)
    sun = np.array([math.cos(e) * math.sin(a), math.cos(e) * math.cos(a), math.sin(e)])
    rays = _compute_border_rays(camera) * (1.0, -1.0, -1.0)
    at = -height_m / rays[:, 2]
    places = at[:, None] * rays[:, :2]
    middle = 0.5 * (places.max(axis=0) + places.min(axis=0))

    def project(east: FloatArray, north: FloatArray) -> FloatArray:
        down = np.full(east.shape, height_m)
        return camera.project(np.stack([east + middle[0], -(north + middle[1]), down], axis=-1))

    return _sample_ground(
        _GroundSampling(picture, camera, project, places - middle, None),
        height_m * camera.angular_resolution,
        sun,
        np.array([-middle[0], -middle[1], height_m]),
        cell_m,
    )


@dataclass(frozen=True, eq=False)
class KnownPose:
    """Where a camera was, and the light.

    position_m  (3,), camera_from_body, sun_body (3,): body frame
    radius_m    of the body's sphere
    """

    position_m: FloatArray
    camera_from_body: Rotation
    sun_body: FloatArray
    radius_m: float


def look_from(
    picture: Picture,
    camera: Camera,
    pose: KnownPose,
    heights: Heights | float,
    cell_m: float = CELL_M,
) -> PictureOnGround:
    """Map the view of a camera whose pose is known.

    heights  of the ground above the sphere, m, by latitudes and longitudes; NaN where not known. Or
             one height for all of it
    cell_m   wanted side of a cell; it is a whole number of pixels
    Raises NoSolutionError with the reason why nothing can be told from such a picture.
    """
    position, axes = pose.position_m, pose.camera_from_body.as_matrix()
    rays = _compute_border_rays(camera) @ axes
    _check_slant(-rays @ unit(position))
    ground = heights if callable(heights) else lambda lat, lon: np.full(np.shape(lat), heights)
    middle, level = _find_middle(pose, axes[2], ground)
    height_m = float(np.linalg.norm(position)) - pose.radius_m - level
    hits = distance_to_sphere(position, rays, pose.radius_m + level)
    if not np.isfinite(hits).all():
        raise NoSolutionError("the picture shows the sky; wanted one of ground alone", "sky")
    x, y = middle.xy_from_xyz(position + hits[:, None] * rays)
    centre = 0.5 * (x.max() + x.min()), 0.5 * (y.max() + y.min())
    lat, lon = middle.latlon(*map(np.asarray, centre))
    projection = Stereographic(float(lat), float(lon), pose.radius_m)
    border = np.stack(projection.xy_from_xyz(position + hits[:, None] * rays), axis=-1)

    def project(east: FloatArray, north: FloatArray) -> FloatArray:
        above = ground(*projection.latlon(east, north))
        above = np.where(np.isfinite(above), above, level)
        points = projection.points(east, north, above)
        return camera.project_from_body(points, position, axes)

    foot = projection.points(0.0, 0.0, level)
    local = projection.body_from_local
    slanted = math.sqrt(float(np.linalg.norm(position - foot)) * height_m)  # of both axes
    return _sample_ground(
        _GroundSampling(picture, camera, project, border, projection),
        slanted * camera.angular_resolution,
        pose.sun_body @ local,
        (position - foot) @ local,
        cell_m,
    )


@dataclass(frozen=True, eq=False)
class _GroundSampling:
    """A picture, the projection of the ground into it, and its outline (n, 2) on the ground."""

    picture: Picture
    camera: Camera
    project: Callable[[FloatArray, FloatArray], FloatArray]
    border_m: FloatArray
    projection: Stereographic | None


def _compute_border_rays(camera: Camera) -> FloatArray:
    """Compute rays (n, 3), camera frame, around the frame."""
    # 64 points along each side of the frame bound the view.
    rays = camera.unproject(camera.border(64))
    if not np.isfinite(rays).all():
        raise NoSolutionError("the camera's corners see nothing; wanted a full frame", "no_rays")
    _check_slant(rays[:, 2]) if camera.model != "pinhole" else None
    return rays


def _check_slant(cosines: FloatArray) -> None:
    if cosines.min() < math.cos(math.radians(MAX_SLANT_DEG)):
        raise NoSolutionError(
            f"the picture looks at ground over {MAX_SLANT_DEG:g} deg off the vertical, or at the "
            "sky; wanted a steeper view",
            "slanted",
        )


def _find_middle(
    pose: KnownPose, boresight: FloatArray, heights: Heights
) -> tuple[Stereographic, float]:
    """Find where the boresight meets the ground: a map about that point, and the height there."""
    at = pose.position_m
    below = np.ravel(heights(*(np.atleast_1d(angle) for angle in latlon_from_xyz(at)[:2])))[0]
    level = float(below) if np.isfinite(below) else 0.0
    for _ in range(5):
        reach = distance_to_sphere(pose.position_m, boresight[None], pose.radius_m + level)
        if not np.isfinite(reach[0]):
            raise NoSolutionError(
                "the camera is not above the ground that it looks at; check its position and the "
                "heights of the ground",
                "below_ground",
            )
        at = pose.position_m + reach[0] * boresight
        lat, lon, _ = latlon_from_xyz(at)
        level = float(np.ravel(heights(np.atleast_1d(lat), np.atleast_1d(lon)))[0])
        if not np.isfinite(level):
            raise NoSolutionError(
                "there are no heights of the ground that the picture shows; name a model of it, or "
                "--height-m",
                "no_ground",
            )
    return Stereographic(float(lat), float(lon), pose.radius_m), level


def _sample_ground(
    laying: _GroundSampling, gsd_m: float, sun: FloatArray, camera_m: FloatArray, cell_m: float
) -> PictureOnGround:
    """Sample the picture at cells; pixels are averaged to about a cell before."""
    _check_sun(sun)
    binned = max(1, round(cell_m / gsd_m))
    cell = gsd_m * binned
    width, height = np.ptp(laying.border_m, axis=0) / cell
    rows, cols = int(height + 1e-6), int(width + 1e-6)
    if rows * cols > MAX_CELLS:
        raise NoSolutionError(
            f"the picture shows {width * cell:.0f} x {height * cell:.0f} m; {MAX_CELLS} cells of "
            f"{cell:.2f} m are possible: take one from less height",
            "too_high",
        )
    if min(rows, cols) < MIN_PAD_CELLS:
        raise NoSolutionError(
            f"the picture shows {width * cell:.3g} x {height * cell:.3g} m, under "
            f"{MIN_PAD_CELLS} cells of {cell:.3g} m",
            "too_small",
        )
    values = _bin_picture(laying.picture, binned)
    at_rows, at_cols = _place_lattice(rows), _place_lattice(cols)
    east = (at_cols - 0.5 * (cols - 1)) * cell
    north = (0.5 * (rows - 1) - at_rows) * cell
    pixels = np.moveaxis(laying.project(*np.meshgrid(east, north)), -1, 0)
    places = [
        (
            (_interpolate(part, np.arange(float(rows)), np.arange(float(cols))) + 0.5) / binned
            - 0.5
        ).astype(np.float32)
        for part in pixels
    ]
    gaps = np.isnan(values)
    level = np.float32(np.nanmedian(values)) if gaps.any() else np.float32(0.0)
    sampled = _remap(np.where(gaps, level, values), places)
    high, wide = values.shape
    valid = (places[0] >= -0.5) & (places[0] <= wide - 0.5)
    valid &= (places[1] >= -0.5) & (places[1] <= high - 0.5)
    if gaps.any():  # pixels without a value, and all that is interpolated with them
        valid &= _remap(gaps.astype(np.float32), places) <= 0.0
    return PictureOnGround(sampled, valid, cell, sun, camera_m, laying.projection, pixels)


def _place_lattice(size: int) -> FloatArray:
    """Return the cells that are projected: every LATTICE-th, the last beyond the border."""
    return LATTICE * np.arange((size - 1) // LATTICE + 2, dtype=np.float64)


def _interpolate(lattice: FloatArray, rows: FloatArray, cols: FloatArray) -> FloatArray:
    """Interpolate values (len(rows), len(cols)) at cells, bilinear between lattice nodes."""
    weights = []
    for at, many in ((rows, lattice.shape[0]), (cols, lattice.shape[1])):
        places = np.asarray(at, dtype=np.float64) / LATTICE
        near = np.clip(places.astype(np.int64), 0, many - 2)
        row = np.zeros((near.size, many))
        row[np.arange(near.size), near] = 1.0 - (places - near)
        row[np.arange(near.size), near + 1] = places - near
        weights.append(row)
    values: FloatArray = weights[0] @ lattice @ weights[1].T
    return values


def _bin_picture(picture: Picture, many: int) -> Float32Array:
    """Average squares of pixels and subtract the dark level.

    The few pixels that are saturated stay what they are: slopes that face the Sun, and dangerous.
    """
    values = picture.values
    rows, cols = (size // many * many for size in values.shape)
    values = values[:rows, :cols]
    if picture.saturation is not None:
        share = float((values >= picture.saturation).sum() / max(np.isfinite(values).sum(), 1))
        if share > MAX_SATURATED:
            raise NoSolutionError(
                f"{share:.1%} of the picture is saturated; wanted up to {MAX_SATURATED:.0%}: "
                "expose it less",
                "saturated",
            )
    if many > 1:
        size = cols // many, rows // many
        values = resize_grid(values, size)
    sample = values[::3, ::3]
    low, high = np.nanquantile(sample, [0.002, 0.99])
    # A level below 10 % of the bright one is the detector's, not the ground's.
    dark = low if 0.0 < low < 0.1 * high else 0.0
    return np.subtract(values, np.float32(dark))


def _remap(values: Float32Array, places: list[Float32Array]) -> Float32Array:
    remapped = cv2.remap(
        values, places[0], places[1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
    )
    return remapped.astype(np.float32, copy=False)


def resize_grid(values: Float32Array, size: tuple[int, int]) -> Float32Array:
    """Resize a grid to (columns, rows): means where these are fewer."""
    fewer = size[0] < values.shape[1]
    how = cv2.INTER_AREA if fewer else cv2.INTER_LINEAR
    return cv2.resize(values, size, interpolation=how).astype(np.float32, copy=False)


def average_boxes(values: Float32Array, cells: int, outside: float | None = None) -> Float32Array:
    """Average squares of an odd number of cells; outside counts as the border's value, or 0."""
    border = cv2.BORDER_REPLICATE if outside is None else cv2.BORDER_CONSTANT
    means = cv2.boxFilter(values, -1, (cells, cells), borderType=border)
    return means.astype(np.float32, copy=False)


def _compute_elevation_deg(sun: FloatArray) -> float:
    return math.degrees(math.atan2(sun[2], math.hypot(sun[0], sun[1])))


def _check_sun(sun: FloatArray) -> None:
    elevation = _compute_elevation_deg(sun)
    if elevation < MIN_SUN_DEG:
        raise NoSolutionError(
            f"it is night there: the Sun stands at {elevation:.1f} deg; wanted "
            f"{MIN_SUN_DEG:g}..{MAX_SUN_DEG:g} deg",
            "night",
        )
    if elevation > MAX_SUN_DEG:
        raise NoSolutionError(
            f"the Sun stands at {elevation:.1f} deg; above {MAX_SUN_DEG:g} deg brightness tells no "
            "slopes",
            "high_sun",
        )
