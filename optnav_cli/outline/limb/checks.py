"""Reasons why a picture's limb cannot be used, each in words."""

import numpy as np

from catalog.arrays import BoolArray, Float32Array, FloatArray
from catalog.errors import NoSolutionError
from catalog.geometry.vectors import perpendicular_basis, unit
from optnav_cli.camera.camera import Camera
from optnav_cli.frames.segmentation import Blobs, Levels
from optnav_cli.outline.limb.candidates import BORDER_PX, MIN_BLOB_PIXELS, Candidates
from optnav_cli.outline.limb.cone import Cone, PixelRays, compute_stretched_rays, find_cone
from optnav_cli.reasons import ReasonCode, format_distinct

MIN_BODY_PIXELS = 100  # lit; less is a disc for the brightness centre
MAX_SATURATED = 1.0 / 3.0  # of the lit pixels
MIN_ARC_DEG = 30.0
MIN_SEEN_SHARE = 0.55  # of the lit limb inside the picture
MIN_SHARPNESS = 0.52  # in the middle of the points; a limb that darkens as Lambert's has 0.55
AZIMUTHS = 180
GRID_PX = 8


def check_blobs(picture: Float32Array, blobs: Blobs, levels: Levels, saturation: float) -> None:
    """Raise NoSolutionError for stars alone, a disc too small, no sky, a picture burnt out."""
    largest = int(blobs.area[0]) if len(blobs) else 0
    if largest < MIN_BODY_PIXELS:
        many = f"{len(blobs)} lit spots" if len(blobs) > 1 else "one lit spot"
        raise NoSolutionError(
            f"no limb: {many}, the largest of {largest} pixels: stars or a disc too small; "
            "a disc that small is for the brightness centre",
            ReasonCode.SMALL_DISC,
        )
    lit = int(blobs.area[blobs.area >= MIN_BLOB_PIXELS].sum())
    # A picture lit to 97 % shows no sky.
    if lit > 0.97 * np.count_nonzero(np.isfinite(picture)):
        raise NoSolutionError(
            f"no limb in view: the body fills the picture ({100.0 * lit / picture.size:.0f} % lit)",
            ReasonCode.NO_SKY,
        )
    share = float(np.count_nonzero(picture >= saturation)) / lit
    if share > MAX_SATURATED:
        raise NoSolutionError(
            f"saturated: {100.0 * share:.0f} % of the lit pixels are at full scale, "
            f"{saturation:g} counts, which hides where the edge is; expose shorter, or state the "
            "sensor's full scale in the camera file (saturation_counts) if it is another",
            ReasonCode.SATURATED,
        )


def compute_azimuths(cone: Cone, rays: FloatArray) -> FloatArray:
    """Compute azimuths (n,) of unit rays about a cone's axis, rad."""
    u, v = perpendicular_basis(cone.axis)
    return np.arctan2(rays @ v, rays @ u)


def measure_arc_deg(cone: Cone, rays: FloatArray, step_px: float, rad_per_px: float) -> float:
    """Measure the azimuth that rays (n, 3) on a cone cover, deg; gaps to step_px or 4 deg count."""
    if len(rays) < 2:
        return 0.0
    ordered = np.sort(compute_azimuths(cone, rays))
    gaps = np.diff(ordered, append=ordered[0] + 2.0 * np.pi)
    bridge = max(np.radians(4.0), step_px * rad_per_px / np.sin(cone.angle))
    return float(np.degrees(gaps[gaps <= bridge].sum()))


def check_arc(arc: float, n_points: int) -> None:
    """Raises NoSolutionError for an arc of limb that says nothing about the body's centre."""
    if arc < MIN_ARC_DEG:
        seen, wanted = format_distinct(arc, MIN_ARC_DEG, 0)
        raise NoSolutionError(
            f"only {seen} deg of lit limb in view ({n_points} points); "
            f"at least {wanted} deg are needed to tell a limb from other edges",
            ReasonCode.SHORT_ARC,
        )


def check_sharp(sharpness: FloatArray) -> None:
    """Raises NoSolutionError when the edge on the Sun's side is as soft as a terminator.

    sharpness (n,) of the limb's points, see `sharpness` of the candidates
    """
    middle = float(np.nanmedian(sharpness)) if np.isfinite(sharpness).any() else 0.0
    if middle < MIN_SHARPNESS:
        raise NoSolutionError(
            f"no lit limb where the Sun claims it: the edge there gains {100.0 * middle:.0f} % of "
            "its brightness at once, as a terminator does; the Sun is not where attitude and time "
            "put it, or only the terminator is in view",
            ReasonCode.WRONG_LIGHT,
        )


def check_hidden(
    picture: Float32Array,
    camera: Camera,
    cone: Cone,
    rays: FloatArray,
    sun_camera: FloatArray | None,
) -> None:
    """Raises NoSolutionError when half of the lit limb inside the picture was not found.

    Where the picture has no values, none of it can be.

    Something covers it, or the cone or the Sun is wrong.
    """
    if sun_camera is None:
        return
    angle = np.arange(AZIMUTHS) * (2.0 * np.pi / AZIMUTHS)
    u, v = perpendicular_basis(cone.axis)
    outward = np.cos(angle)[:, None] * u + np.sin(angle)[:, None] * v
    curve = np.cos(cone.angle) * cone.axis + np.sin(cone.angle) * outward
    normal = (np.cos(cone.angle) * outward - np.sin(cone.angle) * cone.axis) @ cone.stretch
    # A cosine of incidence above 0.25: no cusp, no long shadow.
    expected = unit(normal) @ sun_camera > 0.25
    pixels = camera.project(np.linalg.solve(cone.stretch, curve.T).T)
    with np.errstate(invalid="ignore"):
        expected &= camera.contains(pixels, 4.0 * BORDER_PX)
    at = np.rint(pixels[expected]).astype(np.int64)
    expected[expected] = np.isfinite(picture[at[:, 1], at[:, 0]])
    azimuth = compute_azimuths(cone, rays) % (2.0 * np.pi)
    cell = np.rint(azimuth / (2.0 * np.pi / AZIMUTHS)).astype(np.int64)
    seen = np.zeros(AZIMUTHS, dtype=bool)
    # a small disc has fewer points than cells: each stands for its neighbours too
    reach = max(1, int(np.ceil(0.75 * AZIMUTHS / max(len(rays), 1))))
    for shift in range(-reach, reach + 1):
        seen[(cell + shift) % AZIMUTHS] = True
    # Fewer azimuths say nothing about what hides the others.
    if expected.sum() < 15:
        return
    share = float((seen & expected).sum() / expected.sum())
    if share < MIN_SEEN_SHARE:
        raise NoSolutionError(
            f"only {100.0 * share:.0f} % of the lit limb that should be in the picture is seen: "
            "something covers the rest, or the Sun is not where attitude and time put it",
            ReasonCode.COVERED_LIMB,
        )


def check_others(
    picture: Float32Array,
    camera: Camera,
    candidates: Candidates,
    where: PixelRays,
    cone: Cone,
    levels: Levels,
    relief: float,
) -> None:
    """Raises NoSolutionError for a second body, or for more light outside the limb than a rod's.

    where  the candidates' rays in the cone's space
    """
    beyond = _is_beyond(cone, where, relief)
    outside = candidates.subset(beyond)
    if len(outside) >= 30:
        _check_second(camera, outside, where.subset(beyond), cone, relief)
    rows, cols = np.mgrid[0 : picture.shape[0] : GRID_PX, 0 : picture.shape[1] : GRID_PX]
    lit = picture[::GRID_PX, ::GRID_PX] > levels.threshold
    pixels = np.stack([cols[lit], rows[lit]], axis=1).astype(np.float64)
    depth = cone.measure_depth(compute_stretched_rays(camera, pixels, cone.stretch))
    n_out = int((depth < -(0.002 + relief) * np.tan(cone.angle)).sum())
    n_in = max(int((depth > 0.0).sum()), 1)
    # With 30 % as much lit ground outside as inside the limb belongs to something else.
    if n_out > 0.3 * n_in:
        raise NoSolutionError(
            f"no limb that bounds the lit ground: the best one leaves {n_out * GRID_PX**2} lit "
            f"pixels outside and {n_in * GRID_PX**2} inside; structure in view, or only ground",
            ReasonCode.NO_LIMB,
        )


def count_beyond(cone: Cone, where: PixelRays, relief: float) -> int:
    """Number of candidates, with their rays in the cone's space, that lie outside of the limb."""
    return int(_is_beyond(cone, where, relief).sum())


def _is_beyond(cone: Cone, where: PixelRays, relief: float) -> BoolArray:
    pixel = np.linalg.norm(where.by_x, axis=1)
    beyond: BoolArray = cone.measure_depth(where.rays) < -(
        10.0 * pixel + relief * np.tan(cone.angle)
    )
    return beyond


def _check_second(
    camera: Camera, outside: Candidates, where: PixelRays, cone: Cone, relief: float
) -> None:
    second = find_cone(where, outside.gradient, cone.stretch, relief)
    if second is None:
        return
    other, agrees = second
    if agrees.sum() < 20 or other.angle > 1.0:
        return
    apart = float(np.arccos(np.clip(cone.axis @ other.axis, -1.0, 1.0)))
    # A body with relief above 3 % of its radius has lobes that look like another one.
    if relief > 0.03 and apart < cone.angle + other.angle:
        return
    arc = measure_arc_deg(other, where.rays[agrees], 3.0, float(np.linalg.norm(where.by_x[0])))
    inside = other.measure_depth(where.rays) > -3.0 * np.linalg.norm(where.by_x, axis=1)
    # Half of a lit area's rim lies on a circle of its own.
    if arc > 90.0 and agrees.sum() > 0.5 * inside.sum():
        x, y = camera.project(other.axis_camera())
        raise NoSolutionError(
            f"two bodies in the picture: a second limb about ({x:.0f}, {y:.0f}); "
            "which is the one to navigate by cannot be decided",
            ReasonCode.SEVERAL_BODIES,
        )
