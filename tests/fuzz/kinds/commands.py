"""Whole command lines that end with 0, one for each job, for kinds that change one thing of them."""

from dataclasses import dataclass

from tests.fuzz.cases import NOTHING, OK, Place

OUT = "{out}"
POINT = "27858"  # a control point of the material moon.gpkg
BOX = "10.4,20,11.3,21"


@dataclass(frozen=True)
class Command:
    """A command that works.

    args    with OUT where the output's name goes, if it has one
    takes   the materials that it reads
    ending  of the output's name: "" for a folder, None for no output
    older   the material that is an older output of it
    leaves  endings of what else it may leave beside the output
    """

    args: tuple[str, ...]
    takes: tuple[str, ...]
    ending: str | None = None
    older: str = ""
    leaves: tuple[str, ...] = ()
    codes: frozenset[int] = frozenset({OK})
    writes: frozenset[int] = frozenset({OK, NOTHING})

    def with_output(self, name: str) -> tuple[str, ...]:
        """The command line that writes to this name."""
        return tuple(name if arg == OUT else arg for arg in self.args)

    def take(self, place: Place) -> None:
        """Put what it reads into the case's folder."""
        place.take(*self.takes)


COMMANDS = {
    "build": Command(
        ("build", "moon.toml", "-o", OUT, "--workers", "1", "--bbox", BOX),
        ("moon.toml", "dem.tif"), ".gpkg", "moon.gpkg", (".work",),
    ),
    "build-mesh": Command(
        ("build", "mesh.toml", "-o", OUT, "--workers", "1", "--bbox", "0,0,15,14"),
        ("mesh.toml", "body.obj", "body.toml"), ".gpkg", "mesh.gpkg", (".work",),
    ),
    "simulate": Command(
        ("simulate", "portraits.toml", "-o", OUT),
        ("portraits.toml", "body.obj", "body.toml", "cam.toml"), "", "pictures",
    ),
    "navigate": Command(
        ("navigate", "pictures", "--catalog", "moon.gpkg", "-o", OUT), ("pictures", "moon.gpkg"), "", "run",
    ),
    "evaluate": Command(
        ("evaluate", "run", "--truth", "pictures/truth.csv"), ("run", "pictures"),
    ),
    "evaluate-json": Command(
        ("evaluate", "run", "--truth", "pictures/truth.csv", "--json", "--min-solved", "0%"),
        ("run", "pictures"),
    ),
    "export-run": Command(("export", "run", "-o", OUT), ("run",), ".gpkg", "run.gpkg"),
    "report": Command(("report", "run", "-o", OUT), ("run",), ".html", "old.html"),
    "report-svg": Command(("report", "run", "-o", OUT), ("run",), ".svg", "old.svg"),
    "info": Command(("catalog", "info", "moon.gpkg"), ("moon.gpkg",)),
    "nearest": Command(("catalog", "nearest", "moon.gpkg", "20.5", "-11"), ("moon.gpkg",)),
    "nearest-json": Command(
        ("catalog", "nearest", "moon.gpkg", "20.5", "-11", "--usable", "--count", "3", "--json"),
        ("moon.gpkg",),
    ),
    "info-json": Command(("catalog", "info", "moon.gpkg", "--json"), ("moon.gpkg",)),
    "verify-json": Command(("catalog", "verify", "moon.gpkg", "--json"), ("moon.gpkg",)),
    "verify": Command(("catalog", "verify", "moon.gpkg"), ("moon.gpkg",)),
    "compare": Command(
        ("catalog", "compare", "moon.gpkg", "moon.gpkg", "-o", OUT), ("moon.gpkg",), ".csv",
    ),
    "show": Command(
        ("catalog", "show", "moon.gpkg", POINT, "-o", OUT), ("moon.gpkg",), ".png", "old.png",
    ),
    "export-geojson": Command(
        ("catalog", "export", "moon.gpkg", "-o", OUT), ("moon.gpkg",), ".geojson", "old.geojson",
    ),
    "export-csv": Command(
        ("catalog", "export", "moon.gpkg", "-o", OUT), ("moon.gpkg",), ".csv", "old.csv",
    ),
    "export-gpkg": Command(
        ("catalog", "export", "moon.gpkg", "-o", OUT), ("moon.gpkg",), ".gpkg", "points.gpkg",
    ),
    "export-patch": Command(
        ("catalog", "export", "moon.gpkg", "--point", POINT, "-o", OUT), ("moon.gpkg",), ".tif",
        "patch.tif",
    ),
    "export-relief": Command(
        ("catalog", "export", "relief.gpkg", "-o", OUT), ("relief.gpkg",), ".tif", "old.tif",
    ),
    "export-glb": Command(
        ("catalog", "export", "moon.gpkg", "--point", POINT, "-o", OUT), ("moon.gpkg",), ".glb", "old.glb",
    ),
    "export-obj": Command(
        ("catalog", "export", "moon.gpkg", "--point", POINT, "-o", OUT), ("moon.gpkg",), ".obj", "old.obj",
    ),
    "template": Command(("config", "template", "build"), ()),
    "help": Command(("--help",), ()),
    "version": Command(("--version",), ()),
}  # fmt: skip
