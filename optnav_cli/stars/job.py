"""A folder of star pictures: every row of frames.csv becomes a row of attitudes.csv."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from catalog.bodies.body import Body, load_body
from catalog.bodies.epochs import utc_to_tdb_s
from catalog.bodies.stars import BrightStars, load_bright_stars, read_star_catalog
from catalog.errors import DataError, NoSolutionError
from catalog.files import hash_file
from catalog.geometry.rotations import ARCSEC, quaternion_from_rotation
from catalog.progress import Progress
from catalog.tables import CsvRow
from optnav_cli.camera.camera import Camera
from optnav_cli.frames.folder import read_cameras
from optnav_cli.frames.frames import MAX_DISTANCE_M
from optnav_cli.frames.picture import load_frame_picture
from optnav_cli.frames.run_settings import RUN_TOML, read_run_settings
from optnav_cli.frames.tables import ATTITUDES, POSITION, QUATERNION, STAR_FRAMES
from optnav_cli.output.canvas import encode_picture
from optnav_cli.output.manifest import hash_files, output_folder
from optnav_cli.output.overlay import overlay_path
from optnav_cli.output.run_folder import CAMERAS, FRAMES, OVERLAYS
from optnav_cli.stars.identify import StarFix, StarIdentifier
from optnav_cli.stars.page import ATTITUDES_CSV, STARS_KIND, draw_stars
from optnav_cli.stars.sky import SkyView
from optnav_cli.stars.spots import StarSpots, find_spots

STAGE = "stars"
DEFAULT_BODY = "earth"  # where a craft flies whose folder has no run.toml


@dataclass(frozen=True, eq=False)
class StarRow:
    """One picture: its attitude, or why it has none."""

    file: str
    utc: str
    spots: StarSpots | None
    fix: StarFix | None
    view: SkyView | None
    reason: str

    @property
    def solved(self) -> bool:
        """Whether it has an attitude."""
        return self.fix is not None

    @property
    def sigmas_arcsec(self) -> list[float]:
        """1 sigma about the camera's x, y and z."""
        if self.fix is None or self.view is None:
            return []
        variances = np.diag(self.fix.covariance) + self.view.variances
        return [float(v) for v in np.sqrt(variances) / ARCSEC]

    def cells(self) -> dict[str, object]:
        """Return the cells of attitudes.csv."""
        cells: dict[str, object] = {
            "file": self.file,
            "utc": self.utc,
            "status": "solved" if self.solved else "unsolved",
            "reason": self.reason,
            "n_spots": None if self.spots is None else len(self.spots),
        }
        fix = self.fix
        if fix is not None:
            cells |= zip(QUATERNION, quaternion_from_rotation(fix.camera_from_sky), strict=True)
            names = [f"sigma_{axis}_arcsec" for axis in "xyz"]
            cells |= zip(names, self.sigmas_arcsec, strict=True)
            cells |= {"n_matched": len(fix.stars), "n_used": int(fix.used.sum())}
            cells |= {"residual_rms_px": fix.residual_rms_px, "chance": fix.chance}
            cells["focal_scale"] = fix.focal_scale
        return cells

    def describe(self) -> str:
        """Describe the row in a line for people."""
        if self.fix is None:
            return f"{self.file}: unsolved: {self.reason}"
        x, y, z = self.sigmas_arcsec
        return (
            f"{self.file}: {int(self.fix.used.sum())} stars, rms {self.fix.residual_rms_px:.2f} "
            f'px, sigma {max(x, y):.1f}" across, {z:.1f}" about the axis'
        )


def solve_star_folder(
    folder: Path,
    output: Path,
    progress: Progress,
    catalogue: Path | None = None,
    epoch: float | None = None,
) -> list[StarRow]:
    """Find the attitudes of all pictures of a folder and write OUTPUT with attitudes.csv.

    catalogue, epoch  stars of the user's own, see `read_star_catalog`; None for those that ship

    Raises ConfigError or DataError for a folder that cannot be used, NothingToDoError, after the
    output is written, when no picture gives an attitude.
    """
    with output_folder(output, STARS_KIND, "stars", [folder], STAGE) as out:
        body = _read_body(folder)
        stars = load_bright_stars() if catalogue is None else read_star_catalog(catalogue, epoch)
        cameras, table = read_cameras(folder / CAMERAS), STAR_FRAMES.rows(folder / FRAMES)
        _check_files(folder / FRAMES, table)
        rows: list[StarRow] = []
        overlays = out.path / OVERLAYS
        overlays.mkdir()
        with progress.stage(STAGE, len(table), "picture") as bar:
            for row in table:
                rows.append(_solve_row(folder, row, cameras, (body, stars), overlays))
                bar.advance()
        ATTITUDES.write(out.path / ATTITUDES_CSV, (row.cells() for row in rows))
        files = [row.file for row in rows]
        out.options = _describe_catalogue(catalogue, epoch)
        out.inputs = {"folder": folder, "files_sha256": hash_files(folder, [*files, FRAMES])}
        solved = sum(row.solved for row in rows)
        out.results = {"pictures": len(rows), "solved": solved}
        if not solved:
            out.failure = (
                f"{output}: none of {len(rows)} pictures has an attitude; the first says: "
                f"{rows[0].reason}"
            )
    return rows


def list_result_lines(rows: Sequence[StarRow]) -> list[str]:
    """List the result: a line per picture, at most thirty."""
    solved = sum(row.solved for row in rows)
    return [f"solved {solved} of {len(rows)}", *(row.describe() for row in rows[:30])]


def _read_body(folder: Path) -> Body:
    path = folder / RUN_TOML
    return read_run_settings(path)[1] if path.exists() else load_body(DEFAULT_BODY)


def _describe_catalogue(catalogue: Path | None, epoch: float | None) -> dict[str, object]:
    """Describe the user's own catalogue for the manifest."""
    if catalogue is None:
        return {}
    return {"catalogue": catalogue, "catalogue_sha256": hash_file(catalogue), "epoch": epoch}


def _check_files(path: Path, table: Sequence[CsvRow]) -> None:
    """Raise DataError for a row without a picture's name, or a name twice."""
    seen: set[str] = set()
    for row in table:
        file = row["file"]
        if not file or file in seen:
            problem = f"'{file}' stands twice" if file else "names no picture in column 'file'"
            raise DataError(f"{row.where}: {problem}; give each picture one row of {path.name}")
        seen.add(file)


def _solve_row(
    folder: Path,
    row: CsvRow,
    cameras: dict[str, Camera],
    sky: tuple[Body, BrightStars],
    overlays: Path,
) -> StarRow:
    file, utc, spots = row["file"], row["utc"], None
    body, stars = sky
    try:
        if row.problem:
            raise DataError(row.problem)
        camera = cameras.get(row["camera"])
        if camera is None:
            known = ", ".join(sorted(cameras))
            raise DataError(f"camera '{row['camera']}' has no file in cameras/; there are {known}")
        position = row.vector(POSITION)
        if position is not None and np.abs(position).max() > MAX_DISTANCE_M:
            raise DataError(f"the position lies farther off than {MAX_DISTANCE_M:g} m")
        distance = None if position is None else float(np.linalg.norm(position))
        view = SkyView(body, utc_to_tdb_s(utc) if utc else None, distance, stars)
        picture = load_frame_picture(folder, file, camera)
    except DataError as error:
        return StarRow(file, utc, None, None, None, str(error))
    fix, reason = None, ""
    try:
        spots = find_spots(picture.values, picture.saturation)
        fix = StarIdentifier(camera, view.compute_directions(), stars).identify(spots)
        if not utc:
            reason = 'no time: the stars are those of J2025, aberration (20") is in the sigmas'
    except NoSolutionError as error:
        reason = str(error)
    reason = "; ".join(filter(None, [reason, *picture.remarks]))
    solved_row = StarRow(file, utc, spots, fix, view, reason)
    drawn = draw_stars(picture.values, spots, fix, solved_row.describe(), stars)
    overlay_path(overlays, file).write_bytes(encode_picture(drawn, ".png"))
    return solved_row
