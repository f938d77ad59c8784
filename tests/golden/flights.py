"""The two flights of the documents, an approach and an orbit, and the map of their catalog.

Both are flown over the 948 m model of the whole Moon, which OPTNAV_SHARED_DATA holds, with points
in cells of 3 degrees; some ten minutes of two cores.
"""

from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np

from catalog.arrays import ByteArray
from catalog.config import resource
from catalog.store.reader import Catalog
from optnav_cli.evaluation.files import EVALUATION_CSV, read_error_rows
from optnav_cli.main import cli
from optnav_cli.navigate.page import read_evaluation
from optnav_cli.output.run_folder import read_run
from optnav_cli.report.catalog_maps import (
    POINT_COLOURS,
    find_first_reasons,
    list_legend_entries,
    list_panels,
)
from optnav_cli.report.page import format_count
from optnav_cli.report.relief import GRAY, find_relief
from optnav_cli.report.views import blend, parse_colour
from tests.golden import sketch

MOON = """[body]
name = "moon"

[[dem]]
path = "shared:moon/moon_gld100_32ppd.tif"

[grid]
cell_deg = 3.0
"""
# Scenario, what of it is shortened, what its caption begins with.
FLIGHTS = {
    "transfer": (
        "transfer",
        {"frames = 60": "frames = 8"},
        "From 100 000 km to 100 km: 8 of the 60 moments of the scenario `transfer`, two cameras.",
    ),
    "orbit": (
        "orbit_400km",
        {"frames = 118": "frames = 14", "spacing_s = 150.0": "spacing_s = 600.0"},
        "Two hours in an orbit at 400 km, day and night: 14 of the 118 moments of the scenario "
        "`orbit_400km`, 10 minutes apart, two cameras.",
    ),
}
WIDTH, GAP_PX, ROW_PX = 980, 12, 22
TINT, STRONG_TINT = 0.41, 0.80  # of the colours over the relief, as on the page of a catalog
PAPER, INK = (255, 255, 255), (48, 35, 27)


def moon_catalog(work: Path) -> Path:
    """The catalog, built or as it stands in `work`."""
    config, catalog = work / "moon.toml", work / "moon.gpkg"
    config.write_text(MOON, encoding="utf-8")
    optnav("build", str(config), "-o", str(catalog))
    return catalog


def fly(work: Path, catalog: Path, readme: Path) -> Iterator[tuple[Path, str]]:
    """Fly, evaluate and draw; each picture with its caption."""
    for name, (scenario, changes, words) in FLIGHTS.items():
        text = resource(f"configs/scenarios/{scenario}.toml").read_text(encoding="utf-8")
        for old, new in changes.items():
            if f"\n{old}\n" not in text:
                raise ValueError(f"{scenario}.toml has no line '{old}' any more")
            text = text.replace(f"\n{old}\n", f"\n{new}\n")
        (work / f"{scenario}.toml").write_text(text, encoding="utf-8")
        pictures, run = work / f"{name}-pictures", work / name
        optnav("simulate", str(work / f"{scenario}.toml"), "-o", str(pictures))
        optnav("navigate", str(pictures), "--catalog", str(catalog), "-o", str(run))
        optnav("evaluate", str(run), "--truth", str(pictures / "truth.csv"))
        path = readme / f"{name}.svg"
        optnav("report", str(run), "-o", str(path))
        yield path, f"{words} {_outcome(run)}"


def _outcome(run: Path) -> str:
    """How many frames are solved, how well, and why the others are not."""
    figures, _ = read_evaluation(run)
    if figures is None:
        raise ValueError(f"{run}: was not evaluated")
    known = [row for row in read_error_rows(run / EVALUATION_CSV) if row.error_rnb_m is not None]
    worst = max(float(np.abs(r.error_rnb_m / r.sigma_rnb_m).max()) for r in known)
    codes = Counter(s.reason_code.value for s in read_run(run).solutions if not s.solved)
    why = "; ".join(f"{number} × `{code}`" for code, number in codes.most_common())
    others = f" Unsolved: {why}." if why else ""
    return (
        f"{figures['solved']} of {figures['frames']} frames are solved, NEES "
        f"{figures['normalised_error_squared']:.2f}; the largest error is {worst:.1f} of its "
        f"sigmas.{others}"
    )


def optnav(*arguments: str) -> None:
    """A command of optnav."""
    cli.main(list(arguments), standalone_mode=False)


def usable_map(path: Path) -> tuple[ByteArray, str]:
    """The Moon and its polar caps with usable points and why others are not; its caption."""
    with Catalog.open(path) as catalog:
        kinds = find_first_reasons(catalog)
        colours = np.array(
            [parse_colour(POINT_COLOURS[kind]) for kind in kinds.tolist()], np.float64
        )
        share = np.where(kinds == 0, TINT, STRONG_TINT)[:, None]
        drawn = []
        for panel in list_panels(catalog):
            ground = find_relief(catalog, panel.lat_deg, panel.lon_deg)
            if ground is None:
                raise ValueError(f"{path}: has no relief to draw")
            gray, known, _ = ground
            shade = np.repeat(gray[..., None], 3, axis=2).astype(np.float64)
            tinted = share[panel.rows] * colours[panel.rows] + (1.0 - share[panel.rows]) * shade
            shade = np.where((panel.rows >= 0)[..., None], tinted, shade)
            drawn.append(np.where(known[..., None], shade, PAPER).astype(np.uint8))
        caps = [_fitted(picture, (WIDTH - GAP_PX) // 2) for picture in drawn[1:]]
        caps = [caps[0], np.full((len(caps[0]), GAP_PX, 3), PAPER, np.uint8), *caps[1:]]
        rows = [_fitted(drawn[0], WIDTH), np.hstack(caps)]
        shares = [TINT] + [STRONG_TINT] * (len(POINT_COLOURS) - 1)
        looks = [blend(c, s, GRAY) for c, s in zip(POINT_COLOURS, shares, strict=True)]
        entries = list_legend_entries(kinds, looks)
        strip = np.full((ROW_PX * -(-len(entries) // 2) + 12, WIDTH, 3), PAPER, np.uint8)
        for number, (colour, words) in enumerate(entries):
            row, column = divmod(number, 2)
            x, y = 14 + column * WIDTH // 2, ROW_PX * (row + 1)
            sketch.dot(strip, (x, y - 5), 5.0, parse_colour(colour))
            plain = words.replace("\N{NARROW NO-BREAK SPACE}", " ")  # the font has nothing else
            cv2.putText(strip, plain, (x + 14, y), sketch.FONT, 0.45, INK, 1, cv2.LINE_AA)
        usable = int(catalog.usable.sum())
        caption = (
            f"A catalog of the whole Moon from the 948 m model, cells of "
            f"{catalog.meta.cell_deg:g}°: {format_count(usable)} of "
            f"{format_count(len(catalog))} points usable; "
            "above in equal area, below the polar caps. Others have the colour of the first check "
            "that they failed."
        )
    return np.vstack([*rows, strip]), caption


def _fitted(picture: ByteArray, width: int) -> ByteArray:
    height = round(picture.shape[0] * width / picture.shape[1])
    return np.asarray(cv2.resize(picture, (width, height), interpolation=cv2.INTER_AREA), np.uint8)
