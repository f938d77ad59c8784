"""What lies around a command: its folder, its environment, its limits, files beside its inputs."""

import os
import resource
from collections.abc import Callable
from pathlib import Path

from optnav_cli.main import run
from tests.fuzz.cases import DATA, DIFFERS, NOTHING, OK, USAGE, Case, Place, kind
from tests.fuzz.kinds.commands import COMMANDS, Command

WRITERS = sorted(name for name, command in COMMANDS.items() if command.ending is not None)
READERS = sorted(name for name, command in COMMANDS.items() if command.takes)
ANY = frozenset({OK, USAGE, DATA, NOTHING, DIFFERS})


@kind("around-swap", 3.0)
def swaps(place: Place) -> Case:
    """A command that works, with an input of another kind in the place of one of its own."""
    rng = place.rng
    name = rng.choice(READERS)
    command = COMMANDS[name]
    command.take(place)
    args = list(command.with_output(f"new{command.ending}"))
    named = [i for i, arg in enumerate(args) if (place.folder / arg).exists()]
    other = rng.choice((
        "dem.tif", "pictures", "run", "moon.gpkg", "mesh.gpkg", "points.gpkg", "old.html", "old.csv", "body.obj", "moon.toml", "cam.toml",
        "navigate.toml", "run/solution.csv", "run/manifest.json", "run/run.mcap", "pictures/frame_0000.png", "kernels/moon.bsp", "moon.gpkg.work",
        "near", "limb", "near.run", "passes.toml", "mesh.toml", "pictures/truth.csv", "pictures/frames.csv",
    ))  # fmt: skip
    place.take(other)
    which = rng.choice(named)
    note = f"{name}: {other} for {args[which]}"
    args[which] = other
    output = None if command.ending is None else f"new{command.ending}"
    leaves = tuple(f"new{command.ending}{ending}" for ending in command.leaves)
    evaluation = (
        "run/evaluation.json",
        "run/evaluation.csv",
        "near.run/evaluation.json",
        "near.run/evaluation.csv",
    )
    writes = command.writes | {DIFFERS}
    return Case(("-q", *args), ANY, output, writes, leaves + evaluation, note=note)


@kind("around-limits", 1.5)
def limits(place: Place) -> Case:
    """A command that works, which may write so many bytes or open so many files only."""
    rng = place.rng
    command, args, output = _whole(place, rng.choice(WRITERS))
    if rng.random() < 0.7:
        most, which = (
            rng.choice((4096, 20_000, 100_000, 1_000_000)),
            resource.RLIMIT_FSIZE,
        )
    else:
        most, which = (
            len(os.listdir("/proc/self/fd")) + rng.choice((0, 1, 2, 4, 8)),
            resource.RLIMIT_NOFILE,
        )

    def limited() -> int:
        before = resource.getrlimit(which)
        resource.setrlimit(which, (most, before[1]))
        try:
            return run(args)
        finally:
            resource.setrlimit(which, before)

    note = f"{'bytes' if which == resource.RLIMIT_FSIZE else 'files'} up to {most}"
    # what is done of a run that stopped is kept
    leaves = tuple(f"{output}{ending}" for ending in {*command.leaves, ".work"})
    return Case(
        args,
        frozenset({OK, DATA, NOTHING}),
        output,
        command.writes,
        leaves,
        note=note,
        action=limited,
    )


@kind("around-folder", 0.7)
def folders(place: Place) -> Case:
    """A command whose working folder is gone."""
    _, args, _ = _whole(place, place.rng.choice(sorted(COMMANDS)))
    absolute = tuple(
        str(place.folder / arg) if (place.folder / arg).exists() else arg for arg in args
    )

    def homeless() -> int:
        gone = place.folder / "gone"
        gone.mkdir()
        os.chdir(gone)
        gone.rmdir()
        try:
            return run(absolute)
        finally:
            os.chdir(place.folder)

    leaves = ("run/evaluation.json", "run/evaluation.csv")
    return Case(
        absolute,
        frozenset({OK, DATA}),
        leaves=leaves,
        note="in a folder that is gone",
        action=homeless,
    )


@kind("around-environment", 1.0)
def environments(place: Place) -> Case:
    """A command that works, with strange variables of the environment."""
    rng = place.rng
    command, args, output = _whole(place, rng.choice(sorted(COMMANDS)))
    name = rng.choice(("OPTNAV_SHARED_DATA", "TMPDIR", "HOME", "COLUMNS", "LINES", "LANG", "LC_ALL", "GDAL_DATA", "PROJ_DATA", "GDAL_DRIVER_PATH",
                       "GDAL_SKIP", "PROJ_NETWORK", "GDAL_CONFIG_FILE", "SOURCE_DATE_EPOCH", "NO_COLOR", "PYTHONWARNINGS", "TZ", "CPL_DEBUG"))  # fmt: skip
    value = rng.choice(
        (
            "",
            "x",
            "-1",
            "0",
            "ON",
            "/nowhere",
            "/dev/null",
            str(place.folder),
            "\udcff",
            "é",
            "1" * 5000,
            place.url,
        )
    )

    def changed() -> int:
        before = os.environ.get(name)
        os.environ[name] = value
        try:
            return run(args)
        finally:
            os.environ.pop(name, None)  # one that is not UTF-8 is dropped by the reader of rasters
            if before is not None:
                os.environ[name] = before

    leaves = (
        "run/evaluation.json",
        "run/evaluation.csv",
        *(f"{output}{ending}" for ending in command.leaves),
    )
    return Case(
        args,
        command.codes,
        output,
        command.writes,
        leaves,
        note=f"{name} = {value[:40]!r}",
        action=changed,
    )


@kind("around-sidecar", 1.5)
def sidecars(place: Place) -> Case:
    """A catalog, raster or table with a strange file beside it that libraries look for."""
    rng = place.rng
    name = rng.choice(
        (
            "info",
            "verify",
            "nearest",
            "show",
            "export-csv",
            "build",
            "navigate",
            "simulate",
            "report",
        )
    )
    command, args, output = _whole(place, name)
    beside = {
        "build": ("dem.tif.aux.xml", "dem.tif.ovr", "dem.tif.msk", "dem.tfw", "dem.prj", "dem.tif.gmac", "dem.IMD"),
        "navigate": ("pictures/frame_0000.png.aux.xml", "pictures/frame_0000.pgw", "pictures/frame_0000.png.ovr", "moon.gpkg-wal"),
        "simulate": ("body.mtl", "body.obj.aux.xml", "material.mtl"),
        "report": ("run/evaluation.json", "run/scenario.json", "run/overlays/x.png"),
    }  # fmt: skip
    path = rng.choice(
        beside.get(
            name,
            (
                "moon.gpkg-wal",
                "moon.gpkg-journal",
                "moon.gpkg-shm",
                "moon.gpkg-wal",
                ".moon.gpkg.optnav-lock",
            ),
        )
    )
    contents: dict[str, Callable[[Path], object]] = {
        "noise": lambda place_: place_.write_bytes(rng.randbytes(rng.choice((1, 40, 5000)))),
        "nothing": lambda place_: place_.write_bytes(b""),
        "a folder": lambda place_: place_.mkdir(),
        "a pipe": lambda place_: os.mkfifo(place_),
        "a loop": lambda place_: place_.symlink_to(place_.name),
        "a VRT": lambda place_: place_.write_text(f"<VRTDataset><OverviewList/>{place.url}</VRTDataset>"),
        "metadata": lambda place_: place_.write_text(AUX.format(url=place.url)),
        "a journal": lambda place_: place_.write_bytes(b"\xd9\xd5\x05\xf9\x20\xa1\x63\xd7" + bytes(600)),
        "a log": lambda place_: place_.write_bytes(b"\x37\x7f\x06\x82\x00\x2d\xe2\x18" + bytes(4000)),
    }  # fmt: skip
    what = rng.choice(sorted(contents))
    target = place.folder / path
    if target.exists():
        target.unlink()
    contents[what](target)
    leaves = [path] + [f"{output}{ending}" for ending in command.leaves]
    if path.startswith("moon.gpkg-"):
        leaves += ["moon.gpkg-wal", "moon.gpkg-shm", "moon.gpkg-journal"]
    codes = frozenset({OK, DATA, NOTHING})
    return Case(args, codes, output, command.writes, tuple(leaves), note=f"{path}: {what}")


AUX = """<PAMDataset><SRS>{url}</SRS><GeoTransform>nan,0,0,0,0,0</GeoTransform>
<PAMRasterBand band="1"><NoDataValue>nan</NoDataValue><Scale>0</Scale><Offset>1e308</Offset><UnitType>mile</UnitType>
<ColorInterp>Palette</ColorInterp></PAMRasterBand></PAMDataset>"""


def _whole(place: Place, name: str) -> tuple[Command, tuple[str, ...], str | None]:
    """A command, its inputs put there, its line, and its output."""
    command = COMMANDS[name]
    command.take(place)
    output = None if command.ending is None else f"new{command.ending}"
    args = command.with_output(output or "")
    return command, args if name in ("help", "version") else ("-q", *args), output
