"""The navigation figures: simulated flights over richer ground, navigated, against the truth.

Every row flies a shipped scenario (other ground seeds, places, Suns and headings a pass), builds
the catalog of the bundled 118 m terrain at the row's cell size, navigates every picture from a
prior 3 km off, and adds the errors up. The rows with a star sensor reuse the pictures and tell
the navigator attitudes that are off by 10 arc seconds an axis.
"""

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from catalog.build import build
from catalog.config import resource
from catalog.errors import NothingToDoError
from catalog.progress import Progress
from optnav_cli.evaluation.evaluation import Evaluation, pool
from optnav_cli.evaluation.figures import Figures
from optnav_cli.evaluation.files import evaluate_run, summary_of
from optnav_cli.navigation.settings import NavigateSettings
from optnav_cli.runs.navigate_folder import navigate_folder
from optnav_cli.studies.pictures import STAR_SENSOR_ARCSEC, shipped_pictures, with_star_sensor

# What 10 arc seconds of attitude cost on the ground, both axes: 1.41 x 10" = 0.069 m a kilometre.
STAR_SENSOR_M_PER_KM = 0.07


@dataclass(frozen=True)
class Row:
    """One line of the table: scenarios pooled, the catalog's cell, and the figures to reach."""

    name: str
    scenarios: tuple[str, ...]
    cell_deg: float
    horizontal_m: float
    height_m: float


ROWS = (
    Row("unk 200 km, 1° cells", ("unk_200km",), 1.0, 30.0, 150.0),
    Row("unk 200 km, 0.5° cells", ("unk_200km",), 0.5, 20.0, 80.0),
    Row("unk 400 km, 1° cells", ("unk_400km",), 1.0, 20.0, 50.0),
    Row("shnk 100-400 km, 1° cells", ("shnk_100km", "shnk_200km", "shnk_400km"), 1.0, 25.0, 25.0),
)


@dataclass(frozen=True)
class RowResult:
    """A row's figures; `limit_m` is what the horizontal error may be."""

    row: Row
    star_sensor: bool
    evaluation: Evaluation
    figures: Figures
    limit_m: float


def run(
    output: Path, progress: Progress, frames: int | None = None, rows: str = ""
) -> list[RowResult]:
    """Fly, navigate and evaluate every row; pictures that are there already are used again.

    output  folder for catalogs, pictures, runs and figures.json
    frames  pictures of a scenario, its own number when None
    rows    only rows whose name contains this
    """
    output.mkdir(parents=True, exist_ok=True)
    results = []
    for row in (r for r in ROWS if rows in r.name):
        catalog = _catalog(output, row.cell_deg, progress)
        for star_sensor in (False, True):
            parts = []
            for name in row.scenarios:
                pictures = shipped_pictures(output, name, frames, progress)
                if star_sensor:
                    pictures = with_star_sensor(pictures)
                place = output / "runs" / f"{pictures.name}-{row.cell_deg:g}deg"
                place.parent.mkdir(exist_ok=True)
                navigate_folder(pictures, [catalog], NavigateSettings(), "ncc", place, progress)
                parts.append(evaluate_run(place, pictures / "truth.csv"))
            evaluation = pool(parts)
            limit = _limit(row, evaluation) if star_sensor else row.horizontal_m
            results.append(RowResult(row, star_sensor, evaluation, evaluation.figures(), limit))
            _write(output / "figures.json", results)
    if not results:
        raise NothingToDoError(f"no row of the study is called '{rows}'")
    return results


def _limit(row: Row, evaluation: Evaluation) -> float:
    """A row's horizontal limit with what the star sensor adds in quadrature at its heights."""
    heights_km = np.array([frame.height_m for frame in evaluation.frames]) / 1e3
    extra = float(np.mean((STAR_SENSOR_M_PER_KM * heights_km) ** 2))
    return float(np.sqrt(row.horizontal_m**2 + extra))


def format_results(results: list[RowResult]) -> str:
    """The table in text, one line a row, and the counts over all rows."""
    lines = [
        f"{'case':<32}{'frames':>8}{'horizontal':>18}{'height':>16}{'NEES':>7}{'in 3σ':>7}"
        f"{'used':>8}{'wrong':>10}"
    ]
    for result in results:
        f = result.figures
        name = result.row.name + (", 10″" if result.star_sensor else "")
        lines.append(
            f"{name:<32}{f.solved:>4}/{f.frames:<3}"
            f"{f.horizontal_rms_m:>8.1f} (≤ {result.limit_m:.0f}) m"
            f"{f.height_rms_m:>7.1f} (≤ {result.row.height_m:.0f}) m"
            f"{f.nees:>7.2f}{min(f.inside_3_sigma) * 100:>6.0f}%"
            f"{100.0 * f.n_used / f.n_predicted:>7.2f}%{f.n_wrong:>4}/{f.n_checked}"
        )
    wrong = sum(r.figures.n_wrong for r in results)
    checked = sum(r.figures.n_checked for r in results)
    used = sum(r.figures.n_used for r in results)
    predicted = sum(r.figures.n_predicted for r in results)
    lines.append(f"recognised {used} of {predicted} ({100.0 * used / predicted:.2f} %)")
    lines.append(f"wrong matches kept {wrong} of {checked} ({100.0 * wrong / checked:.3f} %)")
    lines.append("relative to the terrain model's own frame; GLD100 itself is about 50 m from LOLA")
    return "\n".join(lines)


def _catalog(output: Path, cell_deg: float, progress: Progress) -> Path:
    """The catalog of the bundled Tycho terrain at a cell size."""
    config = output / f"tycho-{cell_deg:g}deg.toml"
    text = resource("configs/catalogs/tycho.toml").read_text(encoding="utf-8")
    text += f"\n[grid]\ncell_deg = {cell_deg}\n"
    # left alone when it is right, so that rows can run side by side in one folder
    if not (config.is_file() and config.read_text(encoding="utf-8") == text):
        config.write_text(text, encoding="utf-8")
    catalog = config.with_suffix(".gpkg")
    build.run(config, output=catalog, progress=progress)
    return catalog


def _write(path: Path, results: list[RowResult]) -> None:
    content = [
        {
            "case": result.row.name,
            "attitude_sigma_arcsec": STAR_SENSOR_ARCSEC if result.star_sensor else 0.0,
            "horizontal_limit_m": result.limit_m,
            "height_limit_m": result.row.height_m,
            **summary_of(result.evaluation),
        }
        for result in results
    ]
    path.write_text(json.dumps(content, indent=2) + "\n", encoding="utf-8")
