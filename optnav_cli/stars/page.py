"""A run of `optnav stars` as a page: attitudes with their sigmas, and the pictures with names."""

from collections.abc import Sequence
from pathlib import Path

from markupsafe import Markup

from catalog.tables import CsvRow
from optnav_cli.frames.tables import ATTITUDES
from optnav_cli.output.manifest import read_manifest
from optnav_cli.output.run_folder import OVERLAYS
from optnav_cli.report import page as html
from optnav_cli.report.pictures import list_overlays

STARS_KIND, ATTITUDES_CSV = "stars", "attitudes.csv"
HEADER = ("file", "UTC", "stars", "of spots", "rms, px", "σ across, ″", "σ about, ″", "chance")


def build_stars_page(folder: Path) -> str:
    """Build the page of a run. Raises DataError for a folder that lacks its table."""
    manifest = read_manifest(folder)
    rows = ATTITUDES.rows(folder / ATTITUDES_CSV)
    solved = [row for row in rows if row["status"] == "solved"]
    tiles = [(f"{len(solved)} of {len(rows)}", "pictures have an attitude")]
    if solved:
        stars = sum(row.number("n_used") or 0 for row in solved) / len(solved)
        tiles.append((f"{stars:.0f}", "stars a picture"))
        worst = max(row.number("sigma_x_arcsec") or 0.0 for row in solved)
        tiles.append((f"{worst:.1f}″", "sigma across the line of sight, at most"))
    lost = [(row["file"], row["utc"], row["reason"]) for row in rows if row["status"] != "solved"]
    shown, damaged = list_overlays(folder / OVERLAYS, [row["file"] for row in rows])
    words = "Green: stars, with names; blue: other spots; yellow: residuals. A click enlarges."
    notes = [html.paragraph(damaged, "note")] if damaged else []
    sections = [
        html.section("Result", html.tiles(tiles)),
        html.section("Pictures", html.anchor("pictures"), html.paragraph(words), *notes, shown),
        html.section("Attitudes", html.table(HEADER, [_format_cells(row) for row in solved], 2)),
        _list_unsolved(lost),
        html.section("Made from", html.folded("manifest.json", html.format_listing(manifest))),
    ]
    subtitle = f"{len(rows)} pictures, {len(solved)} solved. Attitudes are camera_from_inertial."
    return html.build_page(f"Stars: run {folder.resolve().name}", subtitle, filter(None, sections))


def _list_unsolved(rows: Sequence[tuple[str, str, str]]) -> Markup:
    if not rows:
        return Markup()
    return html.section("Without an attitude", html.table(("file", "UTC", "reason"), rows, 3))


def _format_cells(row: CsvRow) -> tuple[str, ...]:
    def format_value(name: str, form: str) -> str:
        value = row.number(name)
        return "" if value is None else format(value, form)

    return (
        *(row["file"], row["utc"], format_value("n_used", ".0f"), format_value("n_spots", ".0f")),
        *(format_value("residual_rms_px", ".3f"), format_value("sigma_x_arcsec", ".2f")),
        *(format_value("sigma_z_arcsec", ".2f"), format_value("chance", ".0e")),
    )
