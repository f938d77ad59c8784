"""A folder of pictures of a lit cylinder to cylinder.csv: distance, light angle and velocity."""

import logging
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from catalog.arrays import BoolArray, Float32Array, FloatArray
from catalog.errors import DataError, NoSolutionError
from catalog.progress import Progress
from optnav_cli.camera.camera import Camera
from optnav_cli.cylinder.fit import CylinderFit, fit_cylinder
from optnav_cli.cylinder.folder import CylinderFolder, CylinderRunSettings, read_cylinder_folder
from optnav_cli.cylinder.gamma import fit_coded_cylinder
from optnav_cli.cylinder.geometry import (
    CRESCENT_DEG,
    CylinderSize,
    IdealLens,
    compute_bearing,
    compute_half_width,
    compute_surface_distance,
    find_lit_edges,
    solve_printed_formulas,
)
from optnav_cli.cylinder.page import CYLINDER_CSV, CYLINDER_KIND, draw_cylinder_sheet
from optnav_cli.cylinder.profile import CylinderProfile, measure_printed_extent, measure_profile
from optnav_cli.cylinder.velocity import compute_velocity, place_series
from optnav_cli.frames.frames import Frame
from optnav_cli.frames.picture import load_frame_picture
from optnav_cli.frames.tables import CYLINDER
from optnav_cli.output.canvas import (
    Canvas,
    compute_shrink_factor,
    encode_picture,
    resize_picture,
    scale_to_eight_bits,
    shade_picture,
)
from optnav_cli.output.manifest import hash_files, output_folder
from optnav_cli.output.overlay import overlay_path
from optnav_cli.output.wording import align_table
from optnav_cli.reasons import ReasonCode

OUTLINE, TERMINATOR, LIMB = (255, 190, 60), (90, 240, 110), (60, 220, 255)
POINTS, MAX_PX = 64, 1200
STAGE = "cylinder"
Formula = Literal["fit", "printed"]
CRESCENT_PX, CRESCENT_SIGMA_DEG = 5.0, 3.0
MAX_SIGMA_DEG = 15.0  # beyond it the angle is no number to trust
MAX_CUT_SIGMA_DEG = 6.0  # where a limb is cut other angles may fit as well, 70 deg off
GLARE_SHARE = 0.002  # of the pixels at full scale
MAX_STEP_S = 60.0  # between pictures that a velocity is taken from

_log = logging.getLogger(__name__)


def draw_cylinder_overlay(
    picture: NDArray[np.generic],
    fit: CylinderFit | None,
    lens: IdealLens,
    size: CylinderSize,
    words: str,
) -> bytes:
    """Draw a PNG: the ends of the strip, its limbs, the terminator, and words below.

    picture  (rows, columns), with the lens' distortion taken out
    """
    factor = compute_shrink_factor(picture.shape[1], picture.shape[0], MAX_PX)
    canvas = Canvas(shade_picture(resize_picture(scale_to_eight_bits(picture), factor)), factor)
    if fit is not None:
        radius, distance = size.radius_m, fit.distance_m
        widest = 0.5 * math.pi - compute_half_width(radius, distance)
        psi = np.linspace(-widest, widest, POINTS)
        for end in (-0.5, 0.5):
            canvas.line(_project_line(psi, np.full(POINTS, end), fit, lens, size), OUTLINE, 1)
        ends = np.array([-0.5, 0.5])
        for side in (-widest, widest):
            canvas.line(_project_line(np.full(2, side), ends, fit, lens, size), LIMB, 1)
        edge = (abs(fit.theta) - 0.5 * math.pi) * math.copysign(1.0, fit.theta)
        if abs(edge) < widest:
            canvas.line(_project_line(np.full(2, edge), ends, fit, lens, size), TERMINATOR, 2)
    canvas.text("blue: strip, yellow: limbs, green: terminator", 8.0, 18.0, (230, 230, 230))
    canvas.text(words, 8.0, canvas.image.shape[0] - 8.0, (230, 230, 230))
    return encode_picture(canvas.image, ".png")


def _project_line(
    psi: FloatArray, heights: FloatArray, fit: CylinderFit, lens: IdealLens, size: CylinderSize
) -> FloatArray:
    """Project points at angles psi and shares of the strip's height, downwards: (n, 2)."""
    bearing = fit.bearing + compute_bearing(psi, size.radius_m, fit.distance_m)
    depth = compute_surface_distance(psi, size.radius_m, fit.distance_m) * np.cos(bearing)
    x = lens.centre_x_px + lens.focal_x_px * np.tan(bearing)
    y = fit.middle_row_px + lens.focal_y_px * size.height_m * heights / depth
    return np.stack([x, y], axis=1)


@dataclass(frozen=True)
class CylinderRow:
    """A row of cylinder.csv; d m, theta and bearing deg; velocity m/s towards the light, across.

    fit    of a solved row, from which velocities are taken
    gamma  of the counts and its sigma, of a solved row of a camera without a stated coding
    """

    frame: Frame
    zone: str = ""
    d_m: float | None = None
    d_sigma_m: float | None = None
    theta_deg: float | None = None
    theta_sigma_deg: float | None = None
    bearing_deg: float | None = None
    velocity: tuple[float, float, float] | None = None
    reason: str = ""
    fit: CylinderFit | None = None
    gamma: tuple[float, float] | None = None

    def cells(self) -> dict[str, object]:
        """Return the cells of cylinder.csv."""
        cells: dict[str, object] = {"file": self.frame.file, "utc": self.frame.utc}
        cells |= {"zone": self.zone, "reason": self.reason}
        cells["status"] = "unsolved" if self.d_m is None else "solved"
        for name in ("d_m", "d_sigma_m", "theta_deg", "theta_sigma_deg", "bearing_deg"):
            cells[name] = getattr(self, name)
        if self.velocity is not None:
            names = ("vx_m_s", "vy_m_s", "v_sigma_m_s")
            cells |= zip(names, self.velocity, strict=True)
        return cells


def measure_cylinder_folder(
    folder: Path, output: Path, formula: Formula, progress: Progress
) -> list[CylinderRow]:
    """Measure all pictures of a folder and write OUTPUT with cylinder.csv, plots and overlays.

    Raises ConfigError for a wrong run.toml or camera, DataError for a folder that cannot be used,
    NothingToDoError, after the output is written, when no picture gives a distance.
    """
    with output_folder(output, CYLINDER_KIND, "cylinder", [folder], STAGE) as out:
        read = read_cylinder_folder(folder)
        (out.path / "overlays").mkdir()
        rows = []
        with progress.stage(STAGE, len(read.frames), "picture") as bar:
            for frame in read.frames:
                rows.append(_measure(read, frame, formula, out.path))
                bar.advance()
        if formula == "fit":
            rows = add_velocities(rows)
        CYLINDER.write(out.path / CYLINDER_CSV, (row.cells() for row in rows))
        sheet = draw_cylinder_sheet(out.path, read.settings.radius_m)
        (out.path / "cylinder.svg").write_text(sheet, encoding="utf-8")
        out.options = {"formula": formula}
        out.inputs = {
            "folder": folder,
            "radius_m": read.settings.radius_m,
            "pictures_sha256": hash_files(folder, [f.file for f in read.frames]),
        }
        solved = sum(row.d_m is not None for row in rows)
        out.results = {"pictures": len(rows), "solved": solved}
        _remark_on_gamma(read, rows)
        if not solved:
            out.failure = f"{folder}: no picture gives a distance; the first says: {rows[0].reason}"
    return rows


def _remark_on_gamma(folder: CylinderFolder, rows: Sequence[CylinderRow]) -> None:
    """Report once per camera the gamma that was estimated for want of a stated coding."""
    for name in folder.cameras:
        gammas = [row.gamma for row in rows if row.gamma and row.frame.camera == name]
        if not gammas:
            continue
        gamma, sigma = np.median(np.array(gammas), axis=0)
        _log.warning(
            "camera %s states no [coding]: the gamma of its counts is an unknown of each picture, "
            "%.2f at a sigma of %.2f in the middle, and most of what sigmas hold; state it in the "
            'camera file for errors of a tenth ([coding] curve = "linear" for counts linear in '
            'light, or curve = "gamma", gamma = 2.2)',
            name, gamma, sigma,
        )  # fmt: skip


def _measure(folder: CylinderFolder, frame: Frame, formula: Formula, output: Path) -> CylinderRow:
    if frame.problem is not None:
        return CylinderRow(frame, reason=frame.problem)
    settings, camera = folder.settings, folder.cameras[frame.camera]
    size, lens = CylinderSize(settings.radius_m, settings.height_m), remove_distortion(camera)
    try:
        picture = load_frame_picture(folder.path, frame.file, camera)
    except DataError as error:
        return CylinderRow(frame, reason=str(error))
    values, fit = undistort(picture.values, camera), None
    gaps = np.isnan(values)
    values = np.where(gaps, np.nanmedian(values), values) if gaps.any() else values
    cut: Sequence[str] = ()
    try:
        profile = measure_profile(values, picture.saturation)
        _check_gaps(gaps, profile)
        cut = profile.cut
        if formula == "printed":
            height_px, width_px = measure_printed_extent(profile)
            angles = height_px / lens.focal_y_px, width_px / lens.focal_x_px
            d_m, theta = solve_printed_formulas(*angles, size)
            row = CylinderRow(frame, "", d_m, None, math.degrees(theta))
        elif {"top", "bottom"} & set(cut) and {"left", "right"} & set(cut):
            text = "neither its height nor its width is whole, which leaves the distance open"
            raise NoSolutionError(text, ReasonCode.OUTSIDE_FRAME)
        else:
            if camera.coding is None:
                coded = fit_coded_cylinder(values, picture.saturation, profile, lens, size)
                fit, gamma = coded.fit, (coded.gamma, coded.gamma_sigma)
            else:
                fit, gamma = fit_cylinder(profile, lens, size), None
            row = replace(_make_row(frame, fit, profile.cut, camera, settings), gamma=gamma)
            if picture.remarks:
                row = replace(row, reason=_join_reasons(row.reason, "; ".join(picture.remarks)))
            if row.zone == "cut" and _is_dazzled(values, picture.saturation):
                fit, row = None, _make_unsolved_row(frame, values, picture.saturation, row.reason)
    except NoSolutionError as error:
        row = _make_unsolved_row(
            frame, values, picture.saturation, _join_reasons(_describe_cut(cut), str(error))
        )
        if cut and not row.zone:
            row = replace(row, zone="cut")
    words = "unsolved" if row.d_m is None else f"d {row.d_m:.4f} m, theta {row.theta_deg:.2f} deg"
    drawn = draw_cylinder_overlay(values, fit, lens, size, f"{words} {row.zone}")
    overlay_path(output / "overlays", frame.file).write_bytes(drawn)
    return row


def _check_gaps(gaps: BoolArray, profile: CylinderProfile) -> None:
    """Raise NoSolutionError where pixels without a value (h, w) lie on the lit cylinder."""
    if gaps[profile.rows[0] : profile.rows[1]][:, profile.lit].any():
        raise NoSolutionError(
            "pixels of the lit cylinder have no value (masked, transparent, no-data, or outside "
            "valid_area_px)",
            ReasonCode.BAD_PICTURE,
        )


def _is_dazzled(values: Float32Array, saturation: float | None) -> bool:
    """Whether many pixels are at full scale, as where the source or its flare is in view."""
    return saturation is not None and float((values >= saturation).mean()) > GLARE_SHARE


def _make_unsolved_row(
    frame: Frame, values: Float32Array, saturation: float | None, reason: str
) -> CylinderRow:
    """Make the row of a picture without a number; full pixels mean that the source is in view."""
    full = _is_dazzled(values, saturation)
    if full:
        reason = f"the source of light or its flare is in view; {reason}"
    return CylinderRow(frame, "glare" if full else "", reason=reason)


def _make_row(
    frame: Frame,
    fit: CylinderFit,
    cut: Sequence[str],
    camera: Camera,
    settings: CylinderRunSettings,
) -> CylinderRow:
    sigma_m, _, sigma = (float(s) for s in np.sqrt(np.diag(fit.covariance)))
    zone = classify_zone(fit, cut, camera, settings)
    sigma_deg, reason = math.degrees(sigma), _describe_cut(cut)
    if sigma_deg > (MAX_CUT_SIGMA_DEG if cut else MAX_SIGMA_DEG):
        return CylinderRow(
            frame, zone, reason=_join_reasons("the angle of the light is open", reason)
        )
    return CylinderRow(
        frame,
        zone,
        fit.distance_m - settings.radius_m,
        sigma_m,
        math.degrees(fit.theta),
        sigma_deg,
        math.degrees(fit.bearing),
        reason=reason,
        fit=fit,
    )


def _describe_cut(cut: Sequence[str]) -> str:
    return f"the lit part touches the picture's {', '.join(cut)} edge" if cut else ""


def _join_reasons(*reasons: str) -> str:
    return "; ".join(reason for reason in reasons if reason)


def classify_zone(
    fit: CylinderFit, cut: Sequence[str], camera: Camera, settings: CylinderRunSettings
) -> str:
    """Classify where the camera stands to the light, in the words of cylinder.csv."""
    if cut:
        return "cut"
    lens, radius = remove_distortion(camera), settings.radius_m
    half_field = math.atan(0.5 * camera.width_px / lens.focal_x_px)
    source = math.radians(settings.light_half_width_deg)
    if abs(fit.theta) > math.pi - half_field - source:
        return "glare"
    if abs(fit.theta) <= compute_half_width(radius, fit.distance_m):
        return "full_face"
    left, right = find_lit_edges(fit.theta, radius, fit.distance_m)
    width = lens.focal_x_px * (math.tan(fit.bearing + right) - math.tan(fit.bearing + left))
    sigma_deg = math.degrees(math.sqrt(fit.covariance[2, 2]))
    thin = width < CRESCENT_PX or abs(fit.theta) > math.radians(CRESCENT_DEG)
    return "crescent" if thin or sigma_deg > CRESCENT_SIGMA_DEG else "ok"


def remove_distortion(camera: Camera) -> IdealLens:
    """Return the camera's lens without its distortion."""
    focal = camera.focal_length_px
    return IdealLens(focal, focal * camera.aspect, *camera.principal_point_px)


def undistort(values: Float32Array, camera: Camera) -> Float32Array:
    """Remove the distortion of the lens from a picture, by OpenCV."""
    if camera.distortion == "none":
        return values
    lens = remove_distortion(camera)
    matrix = np.array(
        [
            [lens.focal_x_px, 0.0, lens.centre_x_px],
            [0.0, lens.focal_y_px, lens.centre_y_px],
            [0.0, 0.0, 1.0],
        ]
    )
    return cv2.undistort(values, matrix, np.array(camera.coefficients)).astype(np.float32)


def add_velocities(rows: Sequence[CylinderRow]) -> list[CylinderRow]:
    """Add velocities by three neighbours in time: a line at their middle, or a parabola.

    The positions are those of the camera about the axis, with the cloth that fits all pictures: x
    towards the light, y where theta grows.
    """
    completed = list(rows)
    usable = [
        n for n, row in enumerate(rows) if row.fit is not None and row.frame.tdb_s is not None
    ]
    usable.sort(key=lambda n: rows[n].frame.tdb_s or 0.0)
    places = place_series([fit for n in usable if (fit := rows[n].fit) is not None])
    for k, number in enumerate(usable):
        first = min(max(k - 1, 0), len(usable) - 3)
        if first < 0:
            break
        times = np.array([rows[n].frame.tdb_s or 0.0 for n in usable[first : first + 3]])
        times = times - (rows[number].frame.tdb_s or 0.0)
        if np.diff(times).min() <= 0.0:
            text = "no speed: two pictures of three have one time"
            completed[number] = replace(
                rows[number], reason=_join_reasons(rows[number].reason, text)
            )
            continue
        if np.diff(times).max() > MAX_STEP_S:
            continue
        # the slope of the parabola through three points at the time of the row
        weights = np.linalg.inv(np.vander(times, 3, increasing=True))[1]
        velocity = compute_velocity(places[first : first + 3], weights)
        completed[number] = replace(rows[number], velocity=velocity)
    return completed


def list_result_lines(rows: Sequence[CylinderRow]) -> list[str]:
    """List the distances for people."""
    table: list[tuple[str, ...]] = [("picture", "zone", "d, m", "sigma", "theta, deg", "sigma", "")]
    for row in rows:
        numbers = (row.d_m, row.d_sigma_m, row.theta_deg, row.theta_sigma_deg)
        shown = (
            "" if number is None else f"{number:.{digits}f}"
            for number, digits in zip(numbers, (4, 4, 2, 2), strict=True)
        )
        table.append((row.frame.file, row.zone, *shown, row.reason))
    return align_table(table, left=(0, 1, 6))
