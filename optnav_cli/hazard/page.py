"""The page about a hazard folder: its pictures with their pads, and what is known of each pad."""

from collections.abc import Iterator
from pathlib import Path

from markupsafe import Markup

from catalog.errors import DataError
from catalog.inputs import MEGABYTE, read_input
from catalog.tables import CsvRow
from optnav_cli.frames.tables import PADS, ROCKS
from optnav_cli.hazard.rocks import ROCKS_FILE
from optnav_cli.hazard.settings import PADS_FILE
from optnav_cli.output.manifest import read_manifest
from optnav_cli.output.wording import format_json
from optnav_cli.report import page as html

OVERVIEW = "hazard.png"
MAX_PICTURES = 40
HEADER = (
    *("file", "square", "x, y, px", "lat, lon, °", "> 7°, %", "> 15°, %", "shadow, %"),
    *("slope, °", "why not"),
)


def make_hazard_page(folder: Path) -> str:
    """Make the page. Raises DataError for a folder that lacks its tables."""
    manifest = read_manifest(folder)
    rows = PADS.rows(folder / PADS_FILE)
    chosen = [row for row in rows if row["x_px"]]
    shares = (row.number("expected_dangerous_share") for row in chosen)
    expected = [share for share in shares if share is not None]
    files = list(dict.fromkeys(row["file"] for row in rows))
    numbers = [
        (str(len(files)), "pictures"),
        (f"{len(chosen)} of {sum(bool(row['square_row']) for row in rows)}", "squares have a pad"),
    ]
    if expected:
        mean = sum(expected) / len(expected)
        numbers.append((f"{100.0 * mean:.1f} %", "of the pads are expected above 7°"))
    if (folder / ROCKS_FILE).is_file():  # folders of earlier versions have none
        rocks = sum(bool(row["height_m"]) for row in ROCKS.rows(folder / ROCKS_FILE))
        numbers.append((str(rocks), "rocks"))
    table = html.table(HEADER, [_format_row(row) for row in rows], text_columns=2)
    sections = [
        html.section("Result", html.tiles(numbers)),
        html.section("Maps", *_show_pictures(folder)),
        html.section("Pads", html.folded(f"{len(rows)} squares", table)),
        html.section("How it was made", html.format_listing(format_json(manifest))),
    ]
    words = f"{len(chosen)} pads on the ground of {len(files)} pictures"
    return html.build_page("Hazard map", words, sections)


def _format_row(row: CsvRow) -> tuple[str, ...]:
    def format_number(name: str, form: str, scale: float = 1.0) -> str:
        value = row.number(name)
        return "" if value is None else format(scale * value, form)

    def format_percent(name: str) -> str:
        return format_number(name, ".1f", 100.0)

    def format_pair(first: str, second: str, form: str) -> str:
        return f"{format_number(first, form)}, {format_number(second, form)}" if row[first] else ""

    return (
        row["file"],
        f"{row['square_row']}, {row['square_col']}" if row["square_row"] else "",
        format_pair("x_px", "y_px", ".0f"),
        format_pair("lat_deg", "lon_deg", ".5f"),
        format_percent("expected_dangerous_share"),
        format_percent("expected_critical_share"),
        format_percent("shadow_share"),
        format_number("mean_slope_deg", ".1f"),
        row["reason"],
    )


def _show_pictures(folder: Path) -> Iterator[Markup]:
    """Show the overviews of the first frames; a frame without a map has none."""
    paths = sorted(folder.glob(f"*/{OVERVIEW}")) or [folder / OVERVIEW]
    for path in paths[:MAX_PICTURES]:
        try:
            data = read_input(path, "picture", "make the folder again", limit=64 * MEGABYTE)
        except DataError:
            continue
        name = path.parent.name if path.parent != folder else "picture, risk and slopes"
        yield html.figure(html.image(html.encode_uri(data, "png"), name), name)
    if len(paths) > MAX_PICTURES:
        yield html.paragraph(f"{len(paths) - MAX_PICTURES} more are in the folder.")
