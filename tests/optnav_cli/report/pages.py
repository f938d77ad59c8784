"""What the tests of reports share: a page taken apart, and catalogs made up."""

import re
from html.parser import HTMLParser

import cv2
import numpy as np

from catalog.control_point import ControlPoint, Flag, Patch
from catalog.geometry.cells import CellGrid
from catalog.store.manifest import CatalogMeta
from optnav_cli.pages import write_report
from tests.catalog.store.written import write_points

RADIUS_M = 1737400.0
VOID = {"meta", "link", "img", "br"}


class Page(HTMLParser):
    """Checks that tags close in order, and gathers text, images and outside references."""

    def __init__(self, text):
        super().__init__()
        self.open, self.words, self.references, self.counts = [], [], [], {}
        self.labels, self.headings = [], []
        self.feed(text)
        self.close()
        assert self.open == []

    def handle_starttag(self, tag, attributes):
        self.counts[tag] = self.counts.get(tag, 0) + 1
        self.references += [v for k, v in attributes if k in ("href", "src", "xlink:href")]
        named = dict(attributes)
        if tag == "img" or named.get("role") == "img":
            self.labels.append(named.get("alt") or named.get("aria-label"))
        if re.fullmatch("h[1-6]", tag):
            self.headings.append(int(tag[1]))
        if tag not in VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag, attributes):
        self.counts[tag] = self.counts.get(tag, 0) + 1
        self.references += [v for k, v in attributes if k in ("href", "src")]

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        self.words.append(data)

    @property
    def text(self):
        return " ".join(" ".join(self.words).split())


def report_of(source, tmp_path):
    """The report about a run or catalog, with what must be true of every one checked."""
    out = tmp_path / "report.html"
    write_report(source, out)
    text = out.read_text(encoding="utf-8")
    page = Page(text)
    assert [r for r in page.references if not r.startswith(("data:", "#"))] == []
    assert "<script" not in text
    assert "@import" not in text
    numbers = re.findall(r'\b(?:points|cx|cy|x|y|height|width)="([^"]*)"', text)
    assert not re.search("nan|inf", "".join(numbers))
    # people who cannot see a drawing get its description, and can jump by headings
    assert all(page.labels)
    assert page.headings[0] == 1
    assert max(np.diff(page.headings), default=0) <= 1
    ids = re.findall(r'\bid="([^"]*)"', text)
    assert len(ids) == len(set(ids))
    return page


def a_catalog(path, count=40, lat=(-48.0, -38.0), lon=(-17.0, -5.0), step_deg=0.5, usable=True,
              body="moon", radius_m=RADIUS_M, change=lambda point, number: point,
              levels=2, comparison=None):  # fmt: skip
    """A made-up catalog over a region; every fifth point is flat."""
    rng = np.random.default_rng(8)
    grid = CellGrid(step_deg)
    places = np.column_stack([rng.uniform(*lat, 6 * count), rng.uniform(*lon, 6 * count)])
    cells = np.asarray(grid.find_cells(places[:, 0], places[:, 1]))
    ids, first = np.unique(cells, return_index=True)
    pyramids = []
    for number, (cell, index) in enumerate(zip(ids[:count], first[:count], strict=True)):
        flat = number % 5 == 0 or not usable
        hills = cv2.GaussianBlur(rng.normal(size=(32, 32)).astype(np.float32), (0, 0), 3) * 900.0
        point = ControlPoint(
            id=int(cell),
            lat_deg=float(places[index, 0]),
            lon_deg=float(places[index, 1]),
            radius_m=radius_m,
            localisation_nodes=float(rng.uniform(0.1, 0.5)),
            hessian_eigenvalue=float(rng.uniform(0.1, 3.0)),
            recognition_rate=float(rng.integers(3, 6)) / 5.0,
            trials=5,
            uniqueness=tuple(0.3 + 0.1 * level for level in range(levels)),
            shadow_limit_deg=tuple(rng.uniform(0.0, 12.0, 36)),
            usable=not flat,
            flags=Flag.FLAT if flat else Flag.NONE,
            source="dem.tif",
        )
        patches = tuple(Patch(118.0 * 2**level, hills) for level in range(levels))
        pyramids.append((change(point, number), patches))
    meta = CatalogMeta(
        body, radius_m, step_deg, levels, 32, 118.0, 0.1, {"dem.tif": "<sha>"}, "[body]\n",
        "optnav 0", "", ("dem.tif",), comparison=comparison,
    )  # fmt: skip
    write_points(path, meta, pyramids)
    return path
