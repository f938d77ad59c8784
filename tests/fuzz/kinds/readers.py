"""The readers alone, without a command around them: the inputs of other kinds, many a second."""

import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from catalog.bodies.body import load_body
from catalog.bodies.ephemeris import AnalyticEphemeris
from catalog.bodies.kernels import KernelSet
from catalog.errors import OptnavError
from catalog.terrain.dem.source import DemSource
from optnav_cli.archives.frame import FrameMaker, load_table
from optnav_cli.archives.isis_cube import read_cube_pose
from optnav_cli.archives.pixels import read_sources
from optnav_cli.camera.camera_file import load_camera
from optnav_cli.frames.picture import load_picture
from optnav_cli.orbit.fit.oem_reader import read_oem
from tests.fuzz.cases import DATA, OK, Case, Place, kind
from tests.fuzz.kinds import kernels, labels, map_words, orbits, pictures

READ = frozenset({OK, DATA})
MOON = load_body("moon")


def _case(case: Case, codes: frozenset[int], read: Callable[[], object]) -> Case:
    """The inputs of a case, read by `read` in place of its command."""

    def action() -> int:
        try:
            read()
        except OptnavError as error:
            sys.stderr.write(f"optnav: {error}\n")
            return error.exit_code
        return OK

    return replace(
        case, args=("reader",), codes=codes, output=None, writes=frozenset(), action=action
    )


def _read_label() -> None:
    maker = FrameMaker(load_table(Path("t.toml")), "made", AnalyticEphemeris(MOON))
    for source in read_sources(Path("a.lbl")):
        if source.label is not None:
            maker.make_from_label(source.label, "a.img")


@kind("reader-label", 1.0)
def damaged_label(place: Place) -> Case:
    """A label, its table or its camera is damaged."""
    return _case(labels.damaged_label(place), READ, _read_label)


@kind("reader-units", 3.0)
def label_in_units(place: Place) -> Case:
    """A label whose number has another unit: converted or refused, as is right."""
    case = labels.label_in_units(place)
    return _case(case, case.codes, _read_label)


@kind("reader-words", 3.0)
def label_in_words(place: Place) -> Case:
    """A label in the ways that its language leaves open, with a right or a wrong time."""
    case = labels.label_in_words(place)
    return _case(case, case.codes, _read_label)


@kind("reader-cube", 2.0)
def damaged_cube(place: Place) -> Case:
    """An ISIS cube whose label, tables or picture are damaged."""
    return _case(labels.damaged_cube(place), READ, lambda: read_cube_pose("a.cub"))


@kind("reader-oem", 3.0)
def oem(place: Place) -> Case:
    """An OEM that is damaged, or with a keyword changed, added or away."""
    data, note = orbits.changed_oem(place)
    place.write("prior.oem", data)
    case = Case((), READ, note=note)
    return _case(case, READ, lambda: read_oem(Path("prior.oem"), MOON))


def _read_map(path: Path) -> None:
    source = DemSource.open_alone(path, MOON)
    try:
        source.check_window(source.read_window(0, 0, *source.shape))
    finally:
        source.close()


@kind("reader-map-masks", 0.4)
def masks(place: Place) -> Case:
    """Heights with a hole, stated in every way that there is, or in none."""
    return _case(map_words.masks(place), READ, lambda: _read_map(Path("map.tif")))


@kind("reader-map-labels", 0.3)
def map_labels(place: Place) -> Case:
    """ISIS and PDS3 labels of maps with keywords of all kinds of values."""
    case = map_words.labels(place)
    return _case(case, READ, lambda: _read_map(Path(case.args[2])))


def _read_picture(folder: Path) -> None:
    (file,) = (folder / "cameras").glob("*.toml")
    load_picture(folder / "frame_0000.png", load_camera(file))


@kind("reader-fits", 3.0)
def fits(place: Place) -> Case:
    """A FITS picture of odd cards, perhaps in an extension, damaged."""
    return _case(pictures.fits(place), READ, lambda: _read_picture(Path("pictures")))


@kind("reader-masks", 1.0)
def picture_masks(place: Place) -> Case:
    """Pixels of a picture without a value, stated in every way that there is."""
    return _case(pictures.masked(place), READ, lambda: _read_picture(Path("pictures")))


@kind("reader-keys", 1.0)
def picture_keys(place: Place) -> Case:
    """Keys of the camera file for reading pictures, right and wrong ones."""
    return _case(pictures.keys(place), READ, lambda: _read_picture(Path("pictures")))


@kind("reader-kernels", 1.0)
def craft_kernels(place: Place) -> Case:
    """A clock, frames, attitudes and an orbit of a craft, one of them damaged."""
    case = kernels.craft_kernels(place)
    paths = [Path(f"made.{end}") for end in ("tls", "tsc", "tf", "bc", "bsp")]

    def read() -> None:
        KernelSet(paths).has_frame("MADE_CAMERA")

    return _case(case, READ, read)
