"""The made parts of the Markdown files: tables of figures, of columns, of commands, of configs.

`python -m tests.golden.documents` (or `make docs`) writes them between the lines
`<!-- made: PART -->` and `<!-- end -->`. A test fails when one is out of date.
"""

import json
import re
from collections import Counter
from collections.abc import Callable, Iterable
from itertools import groupby
from pathlib import Path

from catalog.tables import CsvColumn, CsvTable
from optnav_cli.frames import orbit_tables
from optnav_cli.frames import tables as csv_columns
from optnav_cli.main import COMMANDS
from tests.golden.headlines import HEADLINES
from tests.studies.registry import STUDIES
from tests.studies.stored import read_report, read_stored

CHECKOUT = Path(__file__).resolve().parents[2]
CONFIGS = CHECKOUT / "configs"
BENCHES = CHECKOUT / "tests" / "bench" / "figures"
CAPTIONS = Path(__file__).with_name("captions.json")
# A sentence, and where its figures stand: study, table, row, columns.
ACCURACY = {
    "A real Apollo 15 picture: {} of {} control points used, residual {} px ({} m).": (
        "apollo 0 0 used predicted residual_px residual_m"
    ),
    "Over ground that is off as the Moon is from GLD100: control points, narrow camera at 200 km, "
    "prior off by 3 km: {} of {} frames, {} m horizontal, {} m height, NEES {}.": (
        "navigation_real 0 0 solved frames horizontal_rms_m height_rms_m nees"
    ),
    "The same ground, the limb alone, fisheye at 100 km: {} of {} frames, {} m horizontal, "
    "{} m height, NEES {}.": ("horizon_real 0 1 solved frames terrain_ssp_m terrain_height_m nees"),
    "The same ground, a descent from 6.5 to 2 km over a 118 m model: {} of {} frames, {} m "
    "horizontal per component, {} m height, NEES {}.": (
        "descent_moon 0 1 solved frames horizontal_a_component_m height_m nees"
    ),
    "The same descent over a right model: {} m, {} m, NEES {}.": (
        "descent 0 1 horizontal_a_component_m height_m nees"
    ),
    "Over a model that lacks only relief below its posting: no prior at all, fisheye at 200 km: "
    "{} m horizontal, {} m height.": "autonomous 0 1 horizontal_rms_m height_rms_m",
    "The same, the limb alone from 100 000 km: range {}, direction {}.": (
        "horizon 1 3 range_with_relief direction"
    ),
    "The same, the limb of Phobos at 100 km: {} m across the line of sight, {} % of range.": (
        "phobos 0 3 across_rms_m range_share"
    ),
    "Landing pads by shading, {} % of the ground above 7°, Sun at 20°: {} % of pads, "
    "expected {} %; with albedo of 6 %: {} %, {} %.": (
        "hazard 0 2 area_7 pads_7 expected; 0 8 pads_7 expected"
    ),
}
DOCUMENTS = sorted(
    path
    for pattern in ("*.md", "*/*.md", "*/*/*.md", "*/*/*/*.md")
    for path in CHECKOUT.glob(pattern)
    if not path.relative_to(CHECKOUT).as_posix().startswith(("build/", "dist/", "."))
)
# Tables of optnav_cli/TABLES.md in their order, and the files that they describe.
TABLES = {
    "frames": "frames.csv",
    "truth": "truth.csv",
    "picked_points": "points.csv",
    "solution": "solution.csv",
    "solution_spheroid": "solution.csv of a spheroid",
    "solution_lens": "solution.csv with estimated lenses",
    "matches": "matches.csv",
    "landmarks": "landmarks.csv",
    "evaluation": "evaluation.csv",
    "attitudes": "attitudes.csv",
    "cylinder": "cylinder.csv",
    "heights": "heights.csv",
    "ortho": "ortho.csv",
    "pads": "pads.csv",
    "carried_pads": "carried_pads.csv",
    "rocks": "rocks.csv",
    "calibration_residuals": "residuals.csv of a calibration",
    "orbit": "orbit.csv",
    "orbit_residuals": "residuals.csv of an orbit",
    "disturbances": "disturbances.csv",
    "orbit_errors": "orbit_errors.csv",
    "zenith": "zenith.csv",
    "zenith_residuals": "zenith_residuals.csv",
    "picture_times": "times.csv",
    "qso": "qso.csv",
    "qso_passes": "passes.csv",
    "qso_paths": "paths.csv",
    "landing": "landing.csv",
    "landing_impulse": "impulse.csv",
    "landing_path": "path.csv",
    "delivery_stages": "stages.csv",
    "delivery_boxes": "boxes.csv",
    "delivery_arrivals": "arrivals.csv",
}
# Commands that the page of `optnav build` shows.
BUILD_STAGES = ("ingest", "render", "select", "check", "write")
COMMAND_PAGES = {
    "demo": "#try-it",
    "build": "catalog/README.md#build",
    "catalog": "catalog/README.md#look-at-a-catalog",
    "import": "optnav_cli/archives/README.md",
    "simulate": "optnav_cli/simulation/README.md",
    "navigate": "optnav_cli/navigate/README.md",
    "adjust": "optnav_cli/calibration/README.md#adjust-runs-together",
    "calibrate": "optnav_cli/calibration/README.md",
    "stars": "optnav_cli/stars/README.md",
    "stereo": "optnav_cli/stereo/README.md",
    "cylinder": "optnav_cli/cylinder/README.md",
    "orbit": "optnav_cli/orbit/README.md",
    "slopes": "optnav_cli/hazard/README.md#slopes",
    "hazard": "optnav_cli/hazard/README.md",
    "evaluate": "optnav_cli/evaluation/README.md",
    "export": "optnav_cli/output/README.md#gis-layers",
    "report": "optnav_cli/output/README.md",
    "config": "configs/README.md",
}
MAX_NAMES = 6  # of merged columns that are all written out
UNIT_IN_NAME = re.compile(r"_(?:k?m|m2|px|deg|arcsec|s|m_s|m_s2|percent)$")
# The axis in what a column holds, as ", x" or " along R"; columns that differ in it share a row.
AXIS = re.compile(
    r"(?:,| along| about the camera's) (?:[A-Za-z]|[a-z]{2}|eta|time of the pericentre)(?=$|[;:])"
)
# Headline rows of the benches; their other rows stand in tests/bench/figures alone.
BENCH_ROWS = {
    "bench": (
        "a frame with 19 control points by ncc, attitude free",
        "a frame of 2048² by the limb over relief",
        "200 frames with priors by one worker, by two",
        "hapke shading with shadows",
        "catalog of 41252 points: nearest, row of a point, patches of a point",
        "a day of an orbit at 100 km with its transition, 288 outputs: field of degree 50",
        "stars of a picture of 1024²: spots and identification",
        "hazard map and pads of a picture of 2048² from 500 m, by shading",
    ),
    "bench_global": (
        "build from 118 m, two cores",
        "two workers against one",
        "peak memory at 118 m and at 948 m: a worker",
        "catalog with patches of 80 and 96 nodes, from 118 m",
        "usable points of the real Moon",
    ),
}
RANGE = re.compile(r" \([^()]* to [^()]*, \d+ runs\)")  # of repeated runs, behind their median
PART = re.compile(r"(<!-- made: (\w+)((?: [\w.-]+)*) -->\n).*?(?=<!-- end -->)", re.DOTALL)


def bench(name: str) -> str:
    """Render the headline rows of a bench's stored figures, and the run that they are from."""
    report = read_report(BENCHES / f"{name}.json")
    (table,) = report.tables
    rows = {str(row[0]): [RANGE.sub("", str(cell)) for cell in row[:3]] for row in table.rows}
    lines = [f"| {' | '.join(rows[what])} |" for what in BENCH_ROWS[name]]
    head = f"| {' | '.join(column.title for column in table.columns[:3])} |"
    run = f"From `make {name.replace('_', '-')}` at commit {report.commit}, {report.date}."
    rendered = "\n".join([head, "|---|---|---|", *lines])
    return "\n\n".join([rendered, *report.notes[:1], run])


def accuracy() -> str:
    """A few figures of the studies, for the first page."""
    # what was asked for stands behind a figure in brackets
    return "\n".join(
        f"- {text.format(*(cell.partition(' (')[0] for cell in pick_cells(place)))}"
        for text, place in ACCURACY.items()
    )


def headlines() -> str:
    """A row per study: its question and its decisive figures."""
    lines = ["| study | question | figures |", "|---|---|---|"]
    questions = {study.name: study.question for study in STUDIES}
    for name, texts in HEADLINES.items():
        figures = "; ".join(text.format(*pick_cells(place)) for text, place in texts.items())
        lines.append(f"| `{name}` | {questions[name]} | {figures} |")
    return "\n".join(lines)


def pick_cells(places: str) -> list[str]:
    """Pick cells of stored tables, as shown, by "result table row column column; table row ...".

    places  the result is named once; table and row are counted from 0
    """
    name, _, places = places.partition(" ")
    tables = read_stored(name).tables
    cells = []
    for place in places.split(";"):
        number, row, *names = place.split()
        table = tables[int(number)]
        shown = {c.name: c.shown(cell) for c, cell in zip(table.columns, table.rows[int(row)])}
        cells += [shown[column] for column in names]
    return cells


def caption(name: str) -> str:
    """What a picture of the documents shows, with its figures, as `make golden` wrote it."""
    captions: dict[str, str] = json.loads(CAPTIONS.read_text(encoding="utf-8"))
    return captions[name]


def commands() -> str:
    """Every command with a link to its page and its short help, without the build's stages."""
    lines = ["| | |", "|---|---|"]
    for name, entry in COMMANDS.items():
        if name not in BUILD_STAGES:
            lines.append(f"| [`optnav {name}`]({COMMAND_PAGES[name]}) | {entry.text} |")
    return "\n".join(lines)


def configs(folder: str) -> str:
    """List the names of the shipped configs of a folder."""
    return ", ".join(f"`{path.stem}`" for path in sorted((CONFIGS / folder).glob("*.toml")))


def tables() -> str:
    """Render the columns of every CSV file; those common to several files once."""
    csv_tables = {title: _csv_table(name) for name, title in TABLES.items()}
    counts = Counter(
        identity for table in csv_tables.values() for identity in set(map(_identity, table.columns))
    )
    # of a name that holds different things, what it holds most often is the common one
    commonest = {name: (name, *rest) for (name, *rest), _ in reversed(counts.most_common())}
    columns = [column for table in csv_tables.values() for column in table.columns]
    listed = {_identity(column): column for column in columns if counts[_identity(column)] > 1}
    common = {
        identity: column
        for identity, column in listed.items()
        if commonest[column.name] == identity
    }
    parts = [f"## Common columns\n\n{_column_lines(common.values(), optional=False)}"]
    for title, table in csv_tables.items():
        own = [column for column in table.columns if _identity(column) not in common]
        shown = _column_lines(own) if own else f"Common columns: {_list_names(table.columns)}."
        parts.append(f"## {title}\n\n{shown}")
    return "\n\n".join(parts)


def _list_names(columns: Iterable[CsvColumn]) -> str:
    groups = groupby(columns, key=lambda column: _identity(column)[1:])
    return ", ".join(_join_names([column.name for column in group]) for _, group in groups)


def _csv_table(name: str) -> CsvTable:
    place = csv_columns if hasattr(csv_columns, name.upper()) else orbit_tables
    table: CsvTable = getattr(place, name.upper())
    return table


def _identity(column: CsvColumn) -> tuple[str, str, str]:
    """Return what makes columns of two files one: name, unit or kind, and what it holds."""
    unit = column.unit if column.kind == "number" else column.kind
    return column.name, unit, AXIS.sub("", column.meaning)


def _column_lines(columns: Iterable[CsvColumn], optional: bool = True) -> str:
    """Render columns as a Markdown list; neighbours that differ in the axis alone share a line.

    optional  whether a question mark tells columns with empty cells
    """

    def meaning(column: CsvColumn) -> tuple[str, str]:
        _, unit, holds = _identity(column)
        shown = "" if column.kind == "number" and UNIT_IN_NAME.search(column.name) else unit
        return f"{shown}{'?' if column.empty and optional else ''}", holds

    lines = []
    for (unit, holds), group in groupby(columns, key=meaning):
        names = _join_names([column.name for column in group])
        lines.append(f"- {names}{' ' if unit.strip('?') else ''}{unit}: {holds}")
    return "\n".join(lines)


def _join_names(names: list[str]) -> str:
    """Write names with their common beginning and end once, as `cov_{xx,xy}_m2`."""
    if len(names) > MAX_NAMES:
        return f"`{names[0]}` ... {len(names)} columns ... `{names[-1]}`"
    if len(names) == 1:
        return f"`{names[0]}`"
    start = _find_common_start(names)
    end = _find_common_start([name[len(start) :][::-1] for name in names])[::-1]
    middles = [name[len(start) : len(name) - len(end)] for name in names]
    return f"`{start}{{{','.join(middles)}}}{end}`"


def _find_common_start(texts: list[str]) -> str:
    length = 0
    while len({text[: length + 1] for text in texts}) == 1 and length < len(texts[0]):
        length += 1
    return texts[0][:length]


PARTS: dict[str, Callable[..., str]] = {
    part.__name__: part
    for part in (
        headlines,
        bench,
        accuracy,
        caption,
        commands,
        configs,
        tables,
    )
}


def current(text: str) -> str:
    """A document with its made parts as they should be."""

    def made(part: re.Match[str]) -> str:
        return f"{part[1]}\n{PARTS[part[2]](*part[3].split())}\n\n"

    return PART.sub(made, text)


def outdated() -> list[Path]:
    """The documents whose made parts are not what they should be."""
    texts = {path: path.read_text(encoding="utf-8") for path in DOCUMENTS}
    return [path for path, text in texts.items() if current(text) != text]


def main() -> None:
    """Write the made parts anew, and name the files that changed."""
    for path in outdated():
        path.write_text(current(path.read_text(encoding="utf-8")), encoding="utf-8")
        print(path.relative_to(CHECKOUT))


if __name__ == "__main__":
    main()
