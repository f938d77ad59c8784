"""The frames of a run in order of time, by method and camera, ready to be drawn."""

from dataclasses import dataclass

import numpy as np

from catalog.arrays import FloatArray, IndexArray
from catalog.bodies.epochs import utc_to_tdb_s
from catalog.errors import DataError
from optnav_cli.output.error_rows import ErrorRow, read_error_rows, stated_rows
from optnav_cli.output.evaluation_files import EVALUATION_CSV
from optnav_cli.output.methods import method_rank
from optnav_cli.output.run_folder import RunFolder

SIGNS = {
    "brightness_centre": ("s3", "diamond"),
    "horizon_sphere": ("s5", "square"),
    "horizon": ("s2", "triangle"),
    "control_points": ("s1", "circle"),
}
OTHER_SIGN = ("muted", "down")
UNEVEN = 20.0  # gaps so many times the median one: frames are drawn by number, not by time
TIME_UNITS = ((600.0, 1.0, "minutes"), (100.0 * 60.0, 60.0, "hours"), (np.inf, 1440.0, "days"))


@dataclass(frozen=True, eq=False)
class Frames:
    """The frames of a run in order of time, with what is drawn of them.

    x         (n,) along the time axis
    error, sigma  (n, 3) along R, N, B, m; NaN where there is none
    """

    rows: list[ErrorRow]
    x: FloatArray
    x_label: str
    error: FloatArray
    sigma: FloatArray
    wide: frozenset[str]  # cameras that are not the narrowest of the run

    @property
    def compared(self) -> bool:
        """Whether there is a truth."""
        return bool(np.isfinite(self.error).any())

    @property
    def series(self) -> list[tuple[str, str]]:
        """Methods and cameras of the solved frames, from afar to near."""
        found = {(row.method, row.camera) for row in self.rows if row.solved}
        return sorted(found, key=lambda key: (*method_rank(key[0]), key[1]))

    def of(self, method: str, camera: str) -> IndexArray:
        """Places of a series' solved frames."""
        return np.array(
            [
                index
                for index, row in enumerate(self.rows)
                if row.solved and (row.method, row.camera) == (method, camera)
            ],
            dtype=np.intp,
        )

    def sign(self, method: str, camera: str) -> tuple[str, str]:
        """Series and shape of a method's marks, hollow for the wider cameras."""
        series, shape = SIGNS.get(method, OTHER_SIGN)
        return (f"{series} hollow" if camera in self.wide else series), shape

    @property
    def heights_km(self) -> FloatArray:
        """(n,) above the surface; NaN where it is not known, or not above it."""
        heights = np.array([row.height_m or np.nan for row in self.rows]) / 1e3
        return np.where(heights > 0.0, heights, np.nan)

    def stretches(self) -> list[tuple[str, IndexArray]]:
        """Series and places of frames that follow one another in a camera by the same method."""
        found = []
        for camera in sorted({row.camera for row in self.rows}):
            places = [i for i, row in enumerate(self.rows) if row.camera == camera]
            keys = [self.rows[i].method if self.rows[i].solved else None for i in places]
            start = 0
            for end in range(1, len(places) + 1):
                if end == len(places) or keys[end] != keys[start]:
                    method = keys[start]
                    if method is not None:
                        series, _ = SIGNS.get(method, OTHER_SIGN)
                        found.append((series, np.array(places[start:end], dtype=np.intp)))
                    start = end
        return found


def frames_of(run: RunFolder) -> Frames:
    """What is drawn of a run. Raises DataError for a damaged evaluation."""
    path = run.path / EVALUATION_CSV
    rows = read_error_rows(path) if path.exists() else stated_rows(run)
    rows, x, x_label = _in_time(rows)
    none = np.full(3, np.nan)
    error = np.array([none if row.error_rnb_m is None else row.error_rnb_m for row in rows])
    sigma = np.array([none if row.sigma_rnb_m is None else row.sigma_rnb_m for row in rows])
    widths = {camera.name: camera.angular_resolution for camera in run.cameras.values()}
    narrowest = min(widths.values(), default=0.0)
    wide = frozenset(name for name, width in widths.items() if width > narrowest)
    return Frames(rows, x, x_label, error, sigma, wide)


def _in_time(rows: list[ErrorRow]) -> tuple[list[ErrorRow], FloatArray, str]:
    """Rows and what they are drawn against: time, or the frame's number when gaps are uneven."""
    number = np.arange(1.0, len(rows) + 1.0)
    try:
        seconds = np.array([utc_to_tdb_s(row.utc) for row in rows])
    except DataError:
        return rows, number, "frame"
    order = np.argsort(seconds, kind="stable")
    rows, seconds = [rows[i] for i in order], seconds[order]
    gaps = np.diff(np.unique(seconds))
    if len(gaps) == 0 or gaps.max() > UNEVEN * np.median(gaps):
        return rows, number, "frame"
    minutes = (seconds - seconds[0]) / 60.0
    unit, name = next((u, name) for most, u, name in TIME_UNITS if minutes[-1] <= most)
    return rows, minutes / unit, f"{name} after {rows[0].utc}"
