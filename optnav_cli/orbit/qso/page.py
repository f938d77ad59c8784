"""The page about quasi-satellite orbits: their rings in the turning frame, and their passes."""

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
from markupsafe import Markup

from catalog.arrays import FloatArray
from catalog.bodies.body import Body, load_body
from catalog.errors import ConfigError, DataError
from catalog.tables import CsvRow
from optnav_cli.frames.orbit_tables import QSO, QSO_PASSES, QSO_PATHS
from optnav_cli.orbit.qso.settings import PASSES_CSV, PATHS_CSV, QSO_CSV
from optnav_cli.output.manifest import read_manifest
from optnav_cli.output.wording import format_json
from optnav_cli.report import page as html
from optnav_cli.report.sheet import LegendEntry, Panel, draw_sheet
from optnav_cli.report.svg import HALF, Plot, PlotAxis, find_span

MAX_DRAWN = 4  # orbits whose rings are drawn
SERIES = ("s1", "s2", "s3", "s5", "s4")
REACH = 1.45  # of the largest distance of an orbit: what a ring's plot shows
SQUARE = 450  # px, height of a plot as wide as HALF whose axes are equal
# Kinds of paths.csv, what they are, and the column that says how far their passes differ.
RINGS = (
    ("theory", "usual drift", "theory_spread_km"),
    ("orbit", "least drift", "spread_km"),
)
HEADER = (
    *("orbit", "distance, km", "start, UTC", "anomaly, °", "differs, km", "ring, km"),
    *("rate − 1", "slowest", "quickest", "theory", "passes", "why not"),
)


def qso_page(folder: Path) -> str:
    """The page. Raises DataError for a folder that lacks its tables or whose tables are damaged."""
    manifest = read_manifest(folder)
    rows = QSO.rows(folder / QSO_CSV)
    solved_rows = [row for row in rows if row["status"] == "solved"]
    paths = _paths(folder)
    numbers = [(f"{len(solved_rows)} of {len(rows)}", "starts have an orbit")]
    spreads = [value for row in solved_rows if (value := row.number("spread_km")) is not None]
    if spreads:
        numbers.append((f"{max(spreads):.2f} km", "is the largest difference of a pass"))
    sections = [
        html.section("Result", html.tiles(numbers)),
        html.section("Rings", *_rings(solved_rows, paths, _moon(manifest))),
        html.section("Passes of the longitude", *_passes(folder, solved_rows)),
        html.section("Orbits", html.table(HEADER, [_cells(row) for row in rows])),
        html.section("How it was made", html.format_listing(format_json(manifest))),
    ]
    words = f"{len(solved_rows)} orbits that pass one longitude always at the same distance"
    return html.build_page("Quasi-satellite orbits", words, sections)


def qso_sheet(folder: Path) -> str:
    """The rings of the first orbit as a picture that stands alone. Raises DataError."""
    rows = [row for row in QSO.rows(folder / QSO_CSV) if row["status"] == "solved"]
    if not rows:
        raise DataError(f"{folder}: no orbit was found, so there is nothing to draw")
    row, paths, body = rows[0], _paths(folder), _moon(read_manifest(folder))
    panels = [
        Panel(
            f"{what}: {_size(row, name)}",
            ring_plot(path, row.number("radius_km") or 1.0, body),
            what,
        )
        for kind, what, name in RINGS
        if (path := paths.get((row["orbit"], kind))) is not None
    ]
    title = f"A quasi-satellite orbit of {body.name.capitalize()}, {row['distance_km']} km over "
    title += f"{row['longitude_deg']}° E, in the frame that turns with it"
    legend = [LegendEntry("s1 thin", "path", ""), LegendEntry("s2", "start", "diamond", False)]
    return draw_sheet(title, legend, [panels])


def ring_plot(path: FloatArray, radius_km: float, body: Body) -> Plot:
    """The ring of a path (n, 3), km, in the turning frame, with the moon in its middle."""
    reach = REACH * radius_km
    plot = Plot(
        PlotAxis((-reach, reach), "x, away from the planet, km"),
        PlotAxis((-reach, reach), "y, along the moon's motion, km"),
        width=HALF,
        height=SQUARE,
        equal=True,
    )
    turn = np.linspace(0.0, 2.0 * np.pi, 73)
    x, y = (radius / 1e3 for radius in body.radii_m[:2])
    plot.area(x * np.cos(turn), y * np.sin(turn), "muted")
    plot.line(path[:, 0], path[:, 1], "s1 thin")
    plot.marks(path[:1, 0], path[:1, 1], "s2", "diamond", 5.0)
    return plot


def _rings(
    rows: Sequence[CsvRow], paths: dict[tuple[str, str], FloatArray], body: Body
) -> Iterator[Markup]:
    """Draw the first orbits: with the theory's velocity (usual drift) and with the least drift."""
    keys = {"k2": "start"}
    for row in rows[:MAX_DRAWN]:
        number, radius = row["orbit"], row.number("radius_km") or 1.0
        pair = [
            ring_plot(paths[number, kind], radius, body).svg(f"Orbit {number}, {what}")
            for kind, what, _ in RINGS
            if (number, kind) in paths
        ]
        words = (
            f"Orbit {number}, {row['distance_km']} km over {row['longitude_deg']}° E, in the frame "
            f"that turns with the moon: with the velocity of the averaged theory "
            f"({_size(row, 'theory_spread_km')}), and with the least drift "
            f"({_size(row, 'spread_km')})."
        )
        yield html.figure(html.side_by_side("pair", pair), words, keys)
    if len(rows) > MAX_DRAWN:
        yield html.paragraph(f"{len(rows) - MAX_DRAWN} more are in paths.csv.")


def _size(row: CsvRow, name: str) -> str:
    value = row.number(name)
    return "which is not kept" if value is None else f"passes differ by {value:.2f} km"


def _passes(folder: Path, rows: Sequence[CsvRow]) -> Iterator[Markup]:
    """Distance less the one asked for, and the rate, over the passes."""
    asked = {row["orbit"]: row.number("distance_km") or 0.0 for row in rows[: len(SERIES)]}
    series: dict[str, list[tuple[float, float, float]]] = {name: [] for name in asked}
    for row in QSO_PASSES.rows(folder / PASSES_CSV):
        if row["orbit"] in series:
            off = (row.number("distance_km") or 0.0) - asked[row["orbit"]]
            rate = row.number("rate")
            series[row["orbit"]].append(
                (row.number("pass") or 0.0, off, np.nan if rate is None else rate)
            )
    if not series:
        return
    curves = {name: np.array(points).reshape(-1, 3) for name, points in series.items()}
    every = np.concatenate([*curves.values()])
    plots = []
    for column, label in ((1, "distance less that asked for, km"), (2, "rate − 1")):
        axes = (
            PlotAxis(find_span(every[:, 0], 0.03), "pass"),
            PlotAxis(find_span(every[:, column]), label),
        )
        plot = Plot(*axes, width=HALF, height=300)
        for kind, curve in zip(SERIES, curves.values(), strict=False):
            plot.line(curve[:, 0], curve[:, column], kind)
            plot.marks(curve[:, 0], curve[:, column], kind, "circle")
        plots.append(plot.svg(f"{label} over the passes"))
    keys = {
        f"k{kind[1]}": f"{asked[name]:g} km" for kind, name in zip(SERIES, curves, strict=False)
    }
    words = "Distance at the passes of the longitude, and how much quicker each revolution is."
    yield html.figure(html.side_by_side("pair", plots), words, keys)


def _cells(row: CsvRow) -> tuple[str, ...]:
    def shown(name: str, form: str) -> str:
        value = row.number(name)
        return "" if value is None else format(value, form)

    rates = (shown(name, ".3f") for name in ("rate", "rate_min", "rate_max", "theory_rate"))
    return (
        *(row["orbit"], shown("distance_km", "g"), row["utc"], shown("anomaly_deg", ".0f")),
        *(shown("spread_km", ".2f"), shown("ring_km", ".2f"), *rates),
        *(row["passes"], row["reason"]),
    )


def _paths(folder: Path) -> dict[tuple[str, str], FloatArray]:
    """Paths (n, 3), km, by number of the orbit and kind."""
    by_orbit: dict[tuple[str, str], list[list[float]]] = {}
    for row in QSO_PATHS.rows(folder / PATHS_CSV):
        axes = [row.number(name) or 0.0 for name in ("x_km", "y_km", "z_km")]
        by_orbit.setdefault((row["orbit"], row["kind"]), []).append(axes)
    return {key: np.array(points) for key, points in by_orbit.items()}


def _moon(manifest: dict[str, object]) -> Body:
    """The moon that the manifest names. Raises DataError."""
    try:
        options, inputs = manifest["options"], manifest["inputs"]
        name = options["qso"]["body"]  # type: ignore[index]
        return load_body(str(name), Path(inputs["settings"]).parent)  # type: ignore[index]
    except (LookupError, TypeError, ConfigError) as error:
        raise DataError(f"the manifest names no body ({error}); make the folder again") from None
