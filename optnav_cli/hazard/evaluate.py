"""Pads of a hazard folder against a terrain model that is taken for the truth."""

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from catalog.arrays import Float32Array
from catalog.bodies.body import load_body
from catalog.errors import DataError, DifferenceError, NothingToDoError
from catalog.files import make_prefix_test, replace_file
from catalog.geometry.projection import Stereographic
from catalog.progress import log_stage
from catalog.tables import CsvRow
from catalog.terrain.dem.source import DemSource
from catalog.terrain.slopes import (
    BASE_M,
    CRITICAL_DEG,
    DANGEROUS_DEG,
    compute_slope_components,
    convert_to_degrees,
)
from optnav_cli.frames.tables import JUDGED_PADS, PADS
from optnav_cli.hazard.settings import PADS_FILE
from optnav_cli.output.manifest import read_manifest
from optnav_cli.output.wording import align_table, format_json

JUDGED_M = 2.0  # posting that finer models are averaged to: dangerous slopes are defined on it
MARGIN = 3  # nodes around a pad, for the base of its slopes
EVALUATION_JSON, EVALUATION_CSV = "evaluation.json", "evaluation.csv"


@dataclass(frozen=True)
class JudgedPad:
    """A pad judged by the truth; shares of its area."""

    file: str
    square_row: int
    square_col: int
    lat_deg: float
    lon_deg: float
    expected_dangerous_share: float | None
    dangerous_share: float
    critical_share: float
    rms_slope_deg: float


@dataclass(frozen=True)
class PadFigures:
    """Means over the pads that the truth covers.

    squares   of all frames;  pads  chosen in them;  judged  those that the truth covers
    """

    squares: int
    pads: int
    judged: int
    dangerous_share: float
    worst_pad_share: float
    expected_dangerous_share: float | None
    critical_share: float
    rms_slope_deg: float

    def to_text(self) -> str:
        """Format as a table for people."""
        expected = self.expected_dangerous_share
        rows = [
            ("squares", f"{self.squares}"),
            ("pads", f"{self.pads}, {self.judged} of them judged"),
            (f"above {DANGEROUS_DEG:g} deg", f"{self.dangerous_share:.1%}"),
            ("expected", "-" if expected is None else f"{expected:.1%}"),
            ("worst pad", f"{self.worst_pad_share:.1%}"),
            (f"above {CRITICAL_DEG:g} deg", f"{self.critical_share:.2%}"),
            ("rms slope", f"{self.rms_slope_deg:.2f} deg"),
        ]
        return "\n".join(align_table(rows, left=(0, 1)))

    def check(self, max_dangerous_share: float | None) -> None:
        """Raise DifferenceError for a mean share above a limit."""
        if max_dangerous_share is not None and self.dangerous_share > max_dangerous_share:
            raise DifferenceError(
                f"{self.dangerous_share:.2%} of the pads lie above {DANGEROUS_DEG:g} deg; the "
                f"limit is {max_dangerous_share:.2%}"
            )


def evaluate_pads(folder: Path, truth: Path) -> tuple[PadFigures, list[JudgedPad]]:
    """Judge the pads of a hazard folder by the slopes of a terrain model.

    Raises DataError for files that cannot be used, NothingToDoError where no pad can be judged.
    """
    with log_stage("evaluate"):
        manifest = read_manifest(folder)
        rows = PADS.rows(folder / PADS_FILE)
        chosen = [row for row in rows if row["x_px"]]
        if not chosen:
            raise NothingToDoError(f"{folder}: no square has a pad; nothing to compare")
        body, pad_m = _read_facts(folder, manifest)
        placed = [row for row in chosen if row["lat_deg"]]
        if not placed:
            raise DataError(
                f"{folder / PADS_FILE}: its pads have no places on the body; map a folder whose "
                "frames have poses"
            )
        source = DemSource.open_alone(truth, load_body(body))
        try:
            judged = [pad for row in placed if (pad := _judge_pad(row, source, pad_m)) is not None]
        finally:
            source.close()
    if not judged:
        raise NothingToDoError(
            f"{truth}: covers none of the {len(placed)} pads of {folder}; name a model of their "
            "ground"
        )
    return _summarise(len(rows), len(chosen), judged), judged


def write_pad_evaluation(folder: Path, figures: PadFigures, pads: Sequence[JudgedPad]) -> None:
    """Write evaluation.json and evaluation.csv beside the pads."""
    with replace_file(folder / EVALUATION_JSON, make_prefix_test(b"{")) as path:
        path.write_text(format_json(asdict(figures)) + "\n", encoding="utf-8")
    header = ",".join(JUDGED_PADS.names).encode()
    with replace_file(folder / EVALUATION_CSV, make_prefix_test(header)) as path:
        JUDGED_PADS.write(path, [asdict(pad) for pad in pads])


def _read_facts(folder: Path, manifest: dict[str, Any]) -> tuple[str, float]:
    """Read the body and the side of a pad from the manifest."""
    options, inputs = manifest.get("options"), manifest.get("inputs")
    body = inputs.get("body") if isinstance(inputs, dict) else None
    pad_m = options.get("pad_m") if isinstance(options, dict) else None
    if not isinstance(pad_m, float | int) or not 0.0 < pad_m < 1e6:
        raise DataError(f"{folder}: its manifest names no side of pads; make the folder again")
    if not isinstance(body, str):
        raise DataError(
            f"{folder}: its pads have no places on a body; map a folder whose frames have poses"
        )
    return body, float(pad_m)


def _judge_pad(row: CsvRow, source: DemSource, pad_m: float) -> JudgedPad | None:
    """Judge a pad by the truth; None where that has holes or ends."""
    lat, lon = row.number("lat_deg") or 0.0, row.number("lon_deg") or 0.0
    slopes = measure_pad_slopes(source, lat, lon, pad_m)
    if not np.isfinite(slopes).all():
        return None
    return JudgedPad(
        row["file"],
        row.count("square_row") or 0,
        row.count("square_col") or 0,
        lat,
        lon,
        row.number("expected_dangerous_share"),
        float((slopes > DANGEROUS_DEG).mean()),
        float((slopes > CRITICAL_DEG).mean()),
        math.sqrt(float((slopes.astype(np.float64) ** 2).mean())),
    )


def measure_pad_slopes(
    source: DemSource, lat_deg: float, lon_deg: float, pad_m: float
) -> Float32Array:
    """Measure slopes (n, n), deg, on a pad about a point, NaN where the model has none.

    A model finer than JUDGED_M is averaged to it; of a coarser one its own posting counts.
    """
    step = max(JUDGED_M, source.posting_m)
    inner = max(1, round(pad_m / step))
    nodes = inner + 2 * MARGIN
    parts = max(1, round(step / source.posting_m))
    at = (np.arange(nodes * parts) - 0.5 * (nodes * parts - 1)) * step / parts
    projection = Stereographic(math.radians(lat_deg), math.radians(lon_deg), source.body.radius_m)
    fine = source.heights_at(*projection.latlon(*np.meshgrid(at, -at)))
    heights = fine.reshape(nodes, parts, nodes, parts).mean(axis=(1, 3), dtype=np.float64)
    slopes = convert_to_degrees(
        compute_slope_components(heights.astype(np.float32), step, step, BASE_M)
    )
    return slopes[MARGIN:-MARGIN, MARGIN:-MARGIN]


def _summarise(squares: int, pads: int, judged: Sequence[JudgedPad]) -> PadFigures:
    def average(values: Sequence[float]) -> float:
        return float(np.mean(values))

    shares = (pad.expected_dangerous_share for pad in judged)
    expected = [share for share in shares if share is not None]
    return PadFigures(
        squares,
        pads,
        len(judged),
        average([pad.dangerous_share for pad in judged]),
        max(pad.dangerous_share for pad in judged),
        average(expected) if expected else None,
        average([pad.critical_share for pad in judged]),
        math.sqrt(average([pad.rms_slope_deg**2 for pad in judged])),
    )
