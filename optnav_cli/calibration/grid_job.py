"""Pictures of a grid of dots to a calibration: the camera file, its errors, what stays open."""

import logging
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from catalog.arrays import FloatArray
from catalog.errors import DataError, NoSolutionError, NothingToDoError
from catalog.files import hash_file
from catalog.progress import Progress
from optnav_cli.calibration.dots import GridDots, Pattern, find_grid
from optnav_cli.calibration.grid_calibration import (
    GridCalibration,
    GridDistance,
    GridView,
    calibrate_by_grids,
)
from optnav_cli.calibration.job import CALIBRATION_JSON, KIND, RESIDUALS_CSV, STAGE
from optnav_cli.calibration.model import find_inseparable, find_tied_pairs
from optnav_cli.camera.camera import Camera
from optnav_cli.camera.camera_file import write_camera
from optnav_cli.estimation.models.common import Common
from optnav_cli.frames.picture import load_picture
from optnav_cli.frames.tables import CALIBRATION_RESIDUALS
from optnav_cli.output.manifest import output_folder
from optnav_cli.output.run_folder import CAMERAS
from optnav_cli.output.wording import align_table, format_json

UNSEEN_SHARE = 0.9  # of its prior's sigma: a number of which the pictures tell hardly anything
WEAK_FOCAL = 0.003  # relative error of a focal length that people should know of
TIED = 0.9  # correlation of focal length and distance
MAX_DISTANCE_MISFIT = 4.0  # sigmas

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class GridInputs:
    """Pictures of a grid, and what is said of them.

    spacing_mm  from dot to dot, from corner to corner, of an asymmetric grid from row to row
    size        columns and rows, None where they are to be found
    pattern     by OpenCV's name; None for dots, of either kind
    name        of the camera;  distance  of the grid in the first picture, where it was measured
    """

    pictures: tuple[Path, ...]
    spacing_mm: float
    size: tuple[int, int] | None = None
    name: str = "grid"
    distance: GridDistance | None = None
    pattern: Pattern | None = None


@dataclass(frozen=True, eq=False)
class GridResult:
    """A calibration by grids, the pictures that it rests on, and the others with their reasons."""

    calibration: GridCalibration
    files: tuple[str, ...]
    dots: tuple[GridDots, ...]
    skipped: tuple[str, ...]

    @property
    def notes(self) -> list[str]:
        """Notes on what the pictures hardly observe."""
        calibration, notes = self.calibration, [f"left out: {reason}" for reason in self.skipped]
        sigmas = np.sqrt(np.diag(calibration.covariance))
        for number, sigma in zip(calibration.numbers, sigmas, strict=True):
            if sigma > UNSEEN_SHARE * number.prior_sigma:
                notes.append(f"{number.label} is not observed: it stays about where it began")
        if len(self.files) == 1 and abs(calibration.focal_distance) > TIED:
            notes.append(
                "one picture hardly tells the focal length from the distance of the grid "
                f"(correlation {abs(calibration.focal_distance):.3f}, "
                f"tilt {calibration.tilts_deg[0]:.0f} deg)"
            )
        if calibration.focal_error > WEAK_FOCAL:
            notes.append(
                f"the focal length is known to {100.0 * calibration.focal_error:.1f} % only: "
                "tilt the grid by 20 to 40 deg and take several pictures"
            )
        focal = {calibration.camera.name: calibration.camera.focal_length_px}
        for group in find_inseparable(calibration.numbers, calibration.covariance):
            notes.append(f"{group.describe().split(':')[0]}: take pictures with the grid turned")
        pairs = find_tied_pairs(calibration.numbers, calibration.covariance, focal)
        return notes + [pair.describe() for pair in pairs]

    def rows(self) -> list[dict[str, object]]:
        """Build a row per number of the lens, like those of calibrations in flight."""
        calibration, camera = self.calibration, self.calibration.camera
        sigmas = np.sqrt(np.diag(calibration.covariance))
        together = {
            index
            for group in find_inseparable(calibration.numbers, calibration.covariance)
            for index in group.places
        }
        rows: list[dict[str, object]] = []
        for index, number in enumerate(calibration.numbers):
            value, per, zero, unit = _describe_number(number.kind, number.axis, camera)
            rows.append(
                {
                    "name": number.kind.value,
                    "axis": number.axis,
                    "camera": camera.name,
                    "value": value,
                    "change": value - zero,
                    "sigma": per * float(sigmas[index]),
                    "prior_sigma": per * number.prior_sigma,
                    "unit": unit,
                    "observed": bool(sigmas[index] <= UNSEEN_SHARE * number.prior_sigma),
                    "told_apart": index not in together,
                }
            )
        return rows

    def document(self) -> dict[str, object]:
        """Build calibration.json."""
        calibration = self.calibration
        sigmas = np.sqrt(np.diag(calibration.covariance))
        dots = sum(len(part) for part in calibration.after)
        return {
            "numbers": self.rows(),
            "correlations": calibration.covariance / np.outer(sigmas, sigmas),
            "not_told_apart": [],
            "notes": self.notes,
            "frames": len(self.files),
            "matches": dots,
            "matches_used": dots,
            "sigma_px": calibration.sigma_px,
            "residual_rms_px": {
                "before": _compute_rms(calibration.before),
                "after": _compute_rms(calibration.after),
            },
            "grids": [
                {"file": name, "columns": dot.size[0], "rows": dot.size[1]}
                | {"distance_mm": float(distance), "tilt_deg": float(tilt)}
                for name, dot, distance, tilt in zip(
                    self.files,
                    self.dots,
                    calibration.distances_mm,
                    calibration.tilts_deg,
                    strict=True,
                )
            ],
        }

    def lines(self) -> list[str]:
        """List the result for people."""
        calibration = self.calibration
        table = [("", "value", "sigma", "")]
        for row in self.rows():
            label = f"{row['name']} {row['axis']}".strip()
            table.append((label, f"{row['value']:.7g}", f"{row['sigma']:.2g}", str(row["unit"])))
        grids: list[tuple[str, ...]] = [("picture", "dots", "distance, mm", "tilt, deg")]
        for name, dot, distance, tilt in zip(
            self.files, self.dots, calibration.distances_mm, calibration.tilts_deg, strict=True
        ):
            size = f"{dot.size[0]} x {dot.size[1]}"
            grids.append((name, size, f"{distance:.1f}", f"{tilt:.1f}"))
        return [
            *align_table(table, left=(0, 3)),
            *align_table(grids, left=(0,)),
            f"residuals, rms a coordinate: {_compute_rms(calibration.after):.3f} px",
            *self.notes,
        ]


def calibrate_grid(
    given: GridInputs, output: Path, kinds: Sequence[Common], progress: Progress
) -> GridResult:
    """Calibrate a camera by pictures of a grid, and write the calibration.

    Raises DataError for pictures that cannot be read, differ in size, or contradict the stated
    distance; NothingToDoError where none shows a grid, NoSolutionError where they leave the focal
    length open.
    """
    with output_folder(output, KIND, "calibrate", given.pictures, STAGE) as out:
        files, dots, skipped, blank = [], [], [], None
        with progress.stage(STAGE, len(given.pictures), "picture") as bar:
            for path in given.pictures:
                picture = load_picture(path, blank)
                values = np.nan_to_num(picture.values, nan=0.0)
                for remark in picture.remarks:
                    _log.warning("%s", remark)
                height, width = values.shape
                blank = blank or Camera(
                    given.name, "pinhole", width, height, max(width, height), (0.0, 0.0)
                )
                try:
                    dots.append(find_grid(values, given.size, given.pattern))
                    files.append(path.name)
                except NoSolutionError as error:
                    skipped.append(f"{path.name}: {error}")
                    _log.warning("%s: %s", path, error)
                bar.advance()
        if not dots or blank is None:
            raise NothingToDoError(f"no picture shows a grid; {skipped[0]}")
        views = [GridView(dot.pixels, dot.places) for dot in dots]
        # the distance is that of the first picture named: of another one it says nothing
        distance = given.distance if files[0] == given.pictures[0].name else None
        calibration = calibrate_by_grids(blank, views, given.spacing_mm, kinds, distance)
        _check_distance(calibration, blank, views, given, kinds)
        result = GridResult(calibration, tuple(files), tuple(dots), tuple(skipped))
        _write(out.path, result)
        out.options = {
            "solve": [kind.value for kind in kinds],
            "grid_spacing_mm": given.spacing_mm,
            "grid": given.size,
            "pattern": given.pattern,
            "distance_mm": given.distance.value_mm if given.distance else None,
        }
        hashed = [{"path": path, "sha256": hash_file(path)} for path in given.pictures]
        out.inputs = {"pictures": hashed}
        out.results = {"frames": len(files), "matches": sum(len(dot.pixels) for dot in dots)}
    return result


def _check_distance(
    calibration: GridCalibration,
    blank: Camera,
    views: Sequence[GridView],
    given: GridInputs,
    kinds: Sequence[Common],
) -> None:
    """Raise DataError where the tilt of the grids tells another distance than the one measured."""
    misfit = calibration.distance_misfit
    if misfit is None or abs(misfit) <= MAX_DISTANCE_MISFIT or given.distance is None:
        return
    alone = calibrate_by_grids(blank, views, given.spacing_mm, kinds)
    share = given.distance.value_mm / float(alone.distances_mm[0])
    raise DataError(
        f"{given.pictures[0]}: --distance-mm is {given.distance.value_mm:g}, but the tilted grid "
        f"stands {alone.distances_mm[0]:.1f} mm away if its dots are {given.spacing_mm:g} mm apart "
        f"({abs(misfit):.0f} sigmas); measure again: at that distance they are "
        f"{share * given.spacing_mm:.4g} mm apart"
    )


def _compute_rms(parts: Sequence[FloatArray]) -> float:
    return float(np.sqrt(np.mean(np.concatenate(parts) ** 2)))


def _describe_number(kind: Common, axis: str, camera: Camera) -> tuple[float, float, float, str]:
    """Return a number's value, its unit per that of the state, where it began, its unit's name.

    A focal length begins at the longer side, as nothing is known of it.
    """
    if kind == Common.FOCAL:
        focal = camera.focal_length_px
        return focal, focal, float(max(camera.shape)), "px"
    if kind == Common.CENTRE:
        number = "xy".index(axis)
        side = (camera.width_px, camera.height_px)[number]
        return camera.principal_point_px[number], 1.0, 0.5 * (side - 1.0), "px"
    return camera.coefficients[["k1", "k2"].index(axis)], 1.0, 0.0, ""


def _write(place: Path, result: GridResult) -> None:
    """Write the folder but for its manifest."""
    calibration, camera = result.calibration, result.calibration.camera
    (place / CAMERAS).mkdir()
    write_camera(place / CAMERAS, camera)
    (place / CALIBRATION_JSON).write_text(format_json(result.document()) + "\n", encoding="utf-8")
    cells: list[dict[str, object]] = []
    for name, dots, before, after in zip(
        result.files, result.dots, calibration.before, calibration.after, strict=True
    ):
        for number, (x, y) in enumerate(dots.pixels):
            cells_of_dot: dict[str, object] = {"file": name, "camera": camera.name, "id": number}
            cells_of_dot |= {"measured_x_px": x, "measured_y_px": y, "weight": 1.0}
            cells_of_dot |= {"before_x_px": before[number, 0], "before_y_px": before[number, 1]}
            cells_of_dot |= {"after_x_px": after[number, 0], "after_y_px": after[number, 1]}
            cells.append(cells_of_dot)
    CALIBRATION_RESIDUALS.write(place / RESIDUALS_CSV, cells)
