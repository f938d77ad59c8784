"""Descents, hazard maps, slopes, stereo pairs and calibrations of changed folders and settings."""

from pathlib import Path
from typing import Any

from optnav_cli.calibration.model import CalibrateSettings
from optnav_cli.frames.run_settings import RunSettings
from optnav_cli.hazard.settings import HazardSettings
from tests.fuzz.cases import DATA, NOTHING, OK, OPEN, REFUSED, USAGE, Case, Place, kind
from tests.fuzz.damage import damaged
from tests.fuzz.kinds.configs import ConfigKind
from tests.fuzz.kinds.rasters import changed_tag
from tests.fuzz.kinds.tables import changed

NUMBERS = (
    "0", "-0.0", "-1", "1", "3", "4", "20", "60", "200", "1e-9", "1e-300", "1e9", "1e300", "nan", "inf", "-inf", "89.9",
    "90", "5", "61", "360", "-180", "x", "", "1e400", "0x10",
)  # fmt: skip
WRITTEN = frozenset({OK, NOTHING})
HAZARD = ("--height-m", "60", "--pad-m", "4", "--square-m", "8")
SUN = ("--sun-elevation-deg", "20", "--sun-azimuth-deg", "90")
PICTURE = "pair/frame_0000_left.png"
FOLDERS = {
    "pair": ConfigKind(RunSettings, "pair/run.toml", "pair/run.toml"),
    "fall": ConfigKind(RunSettings, "fall/run.toml", "fall/run.toml"),
}
SETTINGS = {
    "hazard": ConfigKind(HazardSettings, "hazard.toml", "settings.toml"),
    "calibrate": ConfigKind(CalibrateSettings, "calibrate.toml", "settings.toml"),
}


def _damaged_file(place: Place, name: str) -> str:
    data, note = damaged(place.material(name), place.rng)
    place.write(name, data)
    return f"{name}: {note}"


def _changed_folder(place: Place, folder: str) -> tuple[frozenset[int], str]:
    """A picture folder with a changed table, picture, camera or run.toml, or a whole one."""
    place.take(folder)
    what = place.rng.choice(("frames", "frames", "frames", "run", "run", "picture", "camera", ""))
    if what == "frames":
        data, note = changed(place.material(f"{folder}/frames.csv"), place.rng)
        place.write(f"{folder}/frames.csv", data)
        return OPEN, note
    if what == "run":
        text, codes, note = FOLDERS[folder].text(place)
        place.write(f"{folder}/run.toml", text)
        return codes | REFUSED | {NOTHING}, note
    ending = {"picture": "*.png", "camera": "cameras/*.toml"}.get(what)
    if ending is None:
        return WRITTEN, ""
    names = sorted((place.materials / folder).glob(ending))
    chosen: Path = place.rng.choice(names)
    return OPEN, _damaged_file(place, chosen.relative_to(place.materials).as_posix())


def _numbered(place: Place, options: tuple[str, ...]) -> tuple[tuple[str, ...], str]:
    """Options, the value of one of which is another number."""
    at = 2 * place.rng.randrange(len(options) // 2)
    value = place.rng.choice(NUMBERS)
    return (*options[: at + 1], value, *options[at + 2 :]), f"{options[at]} {value}"


@kind("landing-slopes", 0.8)
def slopes(place: Place) -> Case:
    """Slopes of a changed terrain model, or on another base."""
    options = ("--base-m", "3000")
    ending = place.rng.choice(("tif", "png"))
    if place.rng.random() < 0.3:
        place.take("dem.tif")
        options, note = _numbered(place, options)
    else:
        change = place.rng.choice((damaged, changed_tag, changed_tag))
        data, note = change(place.material("dem.tif"), place.rng)
        place.write("dem.tif", data)
    args = ("-q", "slopes", "dem.tif", *options, "-o", f"new.{ending}")
    return Case(args, OPEN | {USAGE}, f"new.{ending}", note=note)


@kind("landing-hazard-picture", 0.7)
def hazard_picture(place: Place) -> Case:
    """Hazards of one picture: damaged, or with other numbers."""
    place.take("shtk.toml")
    options = (*HAZARD, *SUN)
    if place.rng.random() < 0.5:
        place.take(PICTURE)
        options, note = _numbered(place, options)
    else:
        note = _damaged_file(place, PICTURE)
    method = place.rng.choice(("shading", "shading", "variance"))
    args = ("-q", "hazard", PICTURE, "--camera", "shtk.toml", "--method", method, *options)
    return Case((*args, "-o", "new"), OPEN | {USAGE}, "new", WRITTEN, note=note)


@kind("landing-hazard-folder", 1.0)
def hazard_folder(place: Place) -> Case:
    """Hazards of a changed folder, over a model, with a slope map or with other settings."""
    options: tuple[str, ...] = HAZARD
    codes = OPEN | {USAGE}
    way = place.rng.choice(("folder", "folder", "number", "dem", "slopes", "catalog", "settings"))
    if way == "folder":
        changes, note = _changed_folder(place, "pair")
        codes = changes | {USAGE}
    else:
        place.take("pair")
        note = way
    if way == "number":
        options, note = _numbered(place, options)
    elif way == "settings":
        place.take("dem.tif")
        text, codes, note = SETTINGS["hazard"].text(place)
        place.write("settings.toml", text)
        options = ("--height-m", "60", "--config", "settings.toml")
        codes = codes | {DATA, NOTHING}
    elif way != "folder":
        name = {"dem": "dem.tif", "slopes": "slopes.tif", "catalog": "moon.gpkg"}[way]
        note = _damaged_file(place, name)
        options = ("--pad-m", "4", "--square-m", "8", f"--{way}", name)
    return Case(("-q", "hazard", "pair", *options, "-o", "new"), codes, "new", WRITTEN, note=note)


@kind("landing-pads", 0.7)
def pads(place: Place) -> Case:
    """A report or an evaluation of a hazard folder with changed tables."""
    place.take("pads", "dem.tif")
    name = place.rng.choice(("pads/pads.csv", "pads/manifest.json", "dem.tif"))
    if name.endswith(".csv"):
        data, note = changed(place.material(name), place.rng)
        place.write(name, data)
    else:
        note = _damaged_file(place, name)
    if place.rng.random() < 0.5:
        files = ("pads/evaluation.json", "pads/evaluation.csv")
        args = ("-q", "evaluate", "pads", "--truth", "dem.tif")
        return Case(args, OPEN, leaves=files, note=note)
    return Case(("-q", "report", "pads", "-o", "new.html"), OPEN, "new.html", note=note)


@kind("landing-stereo", 0.7)
def stereo(place: Place) -> Case:
    """Heights of a changed folder of pairs."""
    codes, note = _changed_folder(place, "pair")
    return Case(("-q", "stereo", "pair", "-o", "new"), codes | {DATA}, "new", WRITTEN, note=note)


@kind("landing-descent", 1.0)
def descent(place: Place) -> Case:
    """A descent over a changed folder."""
    place.take("moon.gpkg")
    codes, note = _changed_folder(place, "fall")
    args = ("-q", "navigate", "fall", "--catalog", "moon.gpkg", "-o", "new")
    return Case(args, codes, "new", WRITTEN, note=note)


@kind("landing-calibrate", 1.0)
def calibrate(place: Place) -> Case:
    """A calibration by a changed folder, catalog or settings."""
    place.take("route", "moon.gpkg")
    more: tuple[str, ...] = ()
    codes: Any = OPEN
    way = place.rng.choice(("frames", "frames", "catalog", "settings", "solve"))
    if way == "frames":
        data, note = changed(place.material("route/frames.csv"), place.rng)
        place.write("route/frames.csv", data)
    elif way == "catalog":
        note = _damaged_file(place, "moon.gpkg")
    elif way == "settings":
        text, codes, note = SETTINGS["calibrate"].text(place)
        place.write("settings.toml", text)
        more, codes = ("--config", "settings.toml"), codes | {DATA, NOTHING}
    else:
        note = place.rng.choice(("focal", "clock,clock", "", "focal;centre", "x", "mounting,focal"))
        more, codes = ("--solve", note), OPEN | {USAGE}
    args = ("-q", "calibrate", "route", "--catalog", "moon.gpkg", *more, "--workers", "1")
    return Case((*args, "-o", "new"), codes, "new", leaves=("new.work",), note=note)
