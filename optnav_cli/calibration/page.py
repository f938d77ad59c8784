"""The page about a calibration: the numbers, what is not told apart, residuals before and after."""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from markupsafe import Markup

from catalog.arrays import FloatArray
from catalog.errors import DataError
from catalog.inputs import read_input
from optnav_cli.frames.tables import CALIBRATION_RESIDUALS
from optnav_cli.output.manifest import read_manifest
from optnav_cli.report import page as html
from optnav_cli.report.svg import HALF, Plot, PlotAxis

CALIBRATION_JSON, RESIDUALS_CSV = "calibration.json", "residuals.csv"
WORDS = {"centre": "principal point", "focal": "focal length"}
MAX_DOTS = 4000
REACH = 3.5  # of the residuals' rms that a plot shows


def is_calibration(folder: Path) -> bool:
    """Whether a folder is one that `optnav calibrate` wrote."""
    return (folder / CALIBRATION_JSON).is_file()


def build_calibration_page(folder: Path) -> str:
    """Build the page about a calibration. Raises DataError for a damaged one."""
    try:
        document = json.loads(read_input(folder / CALIBRATION_JSON))
        numbers = _list_numbers(document["numbers"])
        sigma, counts = document["residual_rms_px"], (document["matches_used"], document["matches"])
        words = (
            f"By {counts[0]} of {counts[1]} matches in {document['frames']} frames. Residuals, rms "
            f"a coordinate: {sigma['before']:.2f} px as stated, {sigma['after']:.2f} px after, "
            f"{document['sigma_px']:.2f} px stated."
        )
        notes = [f"{note[:1].upper()}{note[1:]}." for note in document["notes"]]
        correlations = _list_correlations(document["numbers"], np.array(document["correlations"]))
    except (ValueError, LookupError, TypeError, AttributeError, RecursionError) as error:
        raise DataError(
            f"{folder / CALIBRATION_JSON}: is damaged ({error}); run `optnav calibrate` again"
        ) from error
    sections = [
        html.section("Numbers of the cameras", numbers, html.paragraph(words)),
        html.section("What is not told apart", *map(html.paragraph, notes or ["Nothing."])),
        html.section("Correlations", correlations),
        html.section("Residuals", *_plot_residuals(folder)),
        html.section("Made from", html.format_listing(read_manifest(folder))),
    ]
    subtitle = "Lens, mounting and clock by control points."
    return html.build_page(f"Calibration {folder.resolve().name}", subtitle, sections)


def _format_label(row: Mapping[str, Any]) -> str:
    return f"{WORDS.get(row['name'], row['name'])} {row['axis']}".strip()


def _list_numbers(rows: Sequence[Mapping[str, Any]]) -> Markup:
    header = ("number", "camera", "value", "change", "sigma", "unit", "told apart")
    table = [
        (
            _format_label(row),
            str(row["camera"]),
            f"{row['value']:.7g}",
            f"{row['change']:.4g}",
            f"{row['sigma']:.2g}",
            str(row["unit"]),
            "yes" if row["told_apart"] and row["observed"] else "no",
        )
        for row in rows
    ]
    return html.table(header, table, text_columns=2)


def _list_correlations(rows: Sequence[Mapping[str, Any]], values: FloatArray) -> Markup:
    header = ("", *(_format_label(row) for row in rows))
    table = [
        (_format_label(row), *(f"{value:z.2f}" for value in line))
        for row, line in zip(rows, values, strict=True)
    ]
    return html.table(header, table)


def _plot_residuals(folder: Path) -> list[Markup]:
    """Plot clouds of the residuals of the matches kept, before and after."""
    rows = [r for r in CALIBRATION_RESIDUALS.rows(folder / RESIDUALS_CSV) if r.number("weight")]
    drawn = []
    for name, words in (("before", "as stated"), ("after", "after the calibration")):
        vectors = [r.vector((f"{name}_x_px", f"{name}_y_px")) for r in rows]
        values = np.array([value for value in vectors if value is not None])
        if not len(values):
            continue
        middle = values.mean(axis=0)
        rms = float(np.sqrt(np.mean((values - middle) ** 2)))
        reach = float(np.abs(middle).max()) + REACH * max(rms, 1e-3)
        axes = (PlotAxis((-reach, reach), f"{axis}, px") for axis in "xy")
        plot = Plot(*axes, width=HALF, height=420, equal=True)
        few = values[:: -(-len(values) // MAX_DOTS)]
        plot.dots(few[:, 0], few[:, 1], "s1", 1.8)
        title = f"Residuals {words}, px"
        drawn.append(html.figure(plot.svg(title), f"Residuals of {len(values)} matches {words}"))
    return [html.side_by_side("pair", drawn)] if drawn else []
