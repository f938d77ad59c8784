"""The bench of a global catalog: `make bench-global DIR=FOLDER`, or its parts by name.

    python -m tests.bench.global_moon FOLDER                        everything: about an hour
    python -m tests.bench.global_moon FOLDER --strip-deg 7.2        1/50 of the cells, scaled up
    python -m tests.bench.global_moon FOLDER --ppd 64 --parts ground hillshade build
    python -m tests.bench.global_moon FOLDER --parts catalog

The made raster stays in the folder and is used again. Builds are `optnav build` as a user runs it,
from nothing, after the kernels are compiled; catalogs and work folders of the last run stay too.
"""

import argparse
import os
import sys
from pathlib import Path

from tests.bench.global_moon import builds
from tests.bench.global_moon.parts import PARTS, Bench
from tests.bench.global_moon.place import MODEL, MODEL_PPD, lacking_room, model_path

BUILDS = ("full", "one", "two", "nodes96", "model")


def parse(words: list[str]) -> argparse.Namespace:
    """The command line. Raises SystemExit(2) for wrong usage."""
    parser = argparse.ArgumentParser(
        prog="python -m tests.bench.global_moon",
        description="Build a catalog of the whole Moon from a raster of full size; print figures.",
    )
    parser.add_argument("folder", type=Path, help="where to work; 19 GB are wanted at full size")
    parser.add_argument(
        "--ppd", type=int, default=256, help="pixels a degree of the raster: 64, 96, ... 256"
    )
    parser.add_argument(
        "--strip-deg", type=float, default=360.0,
        help="build only so many degrees of longitude, pole to pole; 7.2 is 1/50",
    )  # fmt: skip
    parser.add_argument("--parts", nargs="+", choices=PARTS, default=list(PARTS), metavar="PART",
                        help=f"some of: {', '.join(PARTS)}")  # fmt: skip
    given = parser.parse_args(words)
    if given.ppd < 2 * MODEL_PPD or given.ppd % MODEL_PPD:
        parser.error(f"--ppd {given.ppd}: wanted a multiple of {MODEL_PPD}, 64 or more")
    if not 0.0 < given.strip_deg <= 360.0:
        parser.error(f"--strip-deg {given.strip_deg:g}: wanted more than 0 and at most 360")
    return given


def main(words: list[str]) -> int:
    """Run the parts; 0 also when the bench cannot run here and says why."""
    options = parse(words)
    os.environ["OPTNAV_BENCH"] = "full"  # of the parts' own processes: each best of several
    folder: Path = options.folder.resolve()
    if folder.is_file():
        print(f"bench-global: {folder}: is a file; name a folder", file=sys.stderr)
        return 2
    folder.mkdir(parents=True, exist_ok=True)
    model = model_path()
    if model is None:
        print(
            f"bench-global: skipped: needs the shared data file {MODEL}; "
            "OPTNAV_SHARED_DATA names its folder"
        )
        return 0
    replaced = [path for name in BUILDS for path in builds.results(folder, name)]
    lacking = lacking_room(folder, options.ppd, replaced)
    if lacking is not None:
        print(f"bench-global: skipped: {lacking}")
        return 0
    bench = Bench(folder, model, options.ppd, options.strip_deg)
    if "ground" not in options.parts and not bench.raster.is_file():
        options.parts.insert(0, "ground")
    for name, part in PARTS.items():
        if name in options.parts:
            part(bench)
            sys.stdout.flush()
    return 0


if __name__ == "__main__":
    raise SystemExit(main(sys.argv[1:]))
