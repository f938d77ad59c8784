"""Orbits: fits of changed runs, settings and gravity fields; what is made of changed folders."""

import re

from optnav_cli.orbit.fit.oem_reader import KEYWORDS, METHODS, STRUCTURE, TIME_SYSTEMS
from optnav_cli.orbit.fit.settings import OrbitFitSettings
from tests.fuzz.cases import DATA, NOTHING, OPEN, USAGE, Case, Place, kind
from tests.fuzz.damage import damaged
from tests.fuzz.kinds.configs import ConfigKind
from tests.fuzz.kinds.tables import changed

TIMES = (
    "2022-03-08T12:00:00Z", "2022-03-08T06:00:00Z", "2022-03-08T09:00:00Z", "2022-03-09", "", "soon", "9999-12-31T23:59:59Z",
    "1959-01-01T00:00:00Z", "2022-03-08T12:00:60Z", "2016-12-31T23:59:60Z", "2022-03-08T12:00:00+01:00", "nan", "1e9",
)  # fmt: skip
STEPS = ("60", "600", "0", "-1", "1e-3", "1e-9", "1e7", "1e300", "nan", "inf", "x", "")
SETTINGS = ConfigKind(OrbitFitSettings, "orbit.toml", "orbit.toml")
OEM_VALUES = (
    "", "X", "7", "1e9", "-1", "MOON", "MOON BARYCENTER", "ITRF", "TOD", "RTN", "TNW", "LVLH", "UT1", "LAGRANGE 9", "PROPAGATE",
    "2022-067T06:00:00", "2022-03-08T06:00:00.5", "2022-366T00:00:00", "9999-12-31T23:59:59", "\u00e9", *METHODS, *TIME_SYSTEMS,
)  # fmt: skip
FIT = ("-q", "orbit", "fit", "flown", "--config", "orbit.toml")


@kind("orbit-fit", 1.0)
def fit(place: Place) -> Case:
    """A fit of a run with a changed table, or with other settings."""
    place.take("flown", "orbit.toml")
    if place.rng.random() < 0.6:
        data, note = changed(place.material("flown/solution.csv"), place.rng)
        place.write("flown/solution.csv", data)
        codes = OPEN
    else:
        text, codes, note = SETTINGS.text(place)
        place.write("orbit.toml", text)
        codes = codes | {DATA, NOTHING, USAGE}
    return Case((*FIT, "-o", "new"), codes, "new", note=note)


@kind("orbit-field", 1.0)
def field(place: Place) -> Case:
    """A fit in a damaged gravity field of one of three formats."""
    place.take("flown")
    name = place.rng.choice(("field.tab", "field.gfc", "field.cof"))
    data, note = damaged(place.material(name), place.rng)
    place.write(name, data)
    place.write("orbit.toml", f'[forces]\ndegree = 3\nfield = "{name}"\n')
    return Case((*FIT, "-o", "new"), OPEN, "new", note=f"{name}: {note}")


@kind("orbit-folder", 1.5)
def folder(place: Place) -> Case:
    """A prediction, an export, times or a navigation by the folder of a damaged orbit."""
    place.take("orbit")
    name = place.rng.choice(("orbit.toml", "orbit.toml", "orbit.csv", "orbit.csv", "run.toml"))
    change = changed if name.endswith(".csv") and place.rng.random() < 0.5 else damaged
    data, note = change(place.material(f"orbit/{name}"), place.rng)
    place.write(f"orbit/{name}", data)
    way = place.rng.choice(("predict", "export", "time", "navigate"))
    note = f"{way}, {name}: {note}"
    codes = OPEN | {USAGE}  # an arc that reaches farther holds the time
    if way == "predict":
        ending = place.rng.choice(("csv", "oem"))
        args = ("-q", "orbit", "predict", "orbit", "--to", TIMES[0], "--step", "900")
        return Case((*args, "-o", f"new.{ending}"), codes, f"new.{ending}", note=note)
    if way == "export":
        ending = place.rng.choice(("csv", "oem", "bsp"))
        args = ("-q", "orbit", "export", "orbit", "-o", f"new.{ending}")
        return Case(args, codes, f"new.{ending}", note=note)
    if way == "time":
        place.take("flown")
        args = ("-q", "orbit", "time", "flown", "--orbit", "orbit", "-o", "new.csv")
        return Case(args, codes, "new.csv", frozenset({0, NOTHING}), note=note)
    place.take("near", "moon.gpkg")
    args = ("-q", "navigate", "near", "--catalog", "moon.gpkg", "--orbit", "orbit", "-o", "new")
    return Case(args, codes, "new", frozenset({0, NOTHING}), note=note)


@kind("orbit-oem", 1.5)
def oem(place: Place) -> Case:
    """A fit with a damaged OEM as its prior, or with a keyword of it changed, added or away."""
    place.take("flown")
    data, note = changed_oem(place)
    place.write("prior.oem", data)
    sigmas = "position_sigma_m = 1000\nvelocity_sigma_m_s = 1\n" * (place.rng.random() < 0.3)
    place.write("orbit.toml", f'[forces]\ndegree = 2\n[[prior]]\noem = "prior.oem"\n{sigmas}')
    return Case((*FIT, "-o", "new"), OPEN, "new", note=note)


def changed_oem(place: Place) -> tuple[bytes, str]:
    """An OEM that is damaged or has a keyword changed, and what was done."""
    data = place.material("orbit/orbit.oem")
    if place.rng.random() < 0.4:
        return damaged(data, place.rng)
    return _keyword_changed(data, place)


def _keyword_changed(data: bytes, place: Place) -> tuple[bytes, str]:
    lines = data.decode("utf-8").splitlines()
    key = place.rng.choice((*KEYWORDS, *STRUCTURE, "UNHEARD_OF"))
    line = f"{key} = {place.rng.choice(OEM_VALUES)}" if key not in STRUCTURE else key
    at = [k for k, old in enumerate(lines) if re.match(rf"{key}\b", old)]
    if at and place.rng.random() < 0.7:
        lines[place.rng.choice(at)] = line if place.rng.random() < 0.8 else ""
    else:
        heads = [k for k, old in enumerate(lines) if re.match("[A-Z]", old)]
        lines.insert(place.rng.choice(heads), line)
    return "\n".join(lines).encode(), line


@kind("orbit-predict", 0.7)
def predict(place: Place) -> Case:
    """A prediction to another time by another step."""
    place.take("orbit")
    to, step = place.rng.choice(TIMES), place.rng.choice(STEPS)
    args = ("-q", "orbit", "predict", "orbit", "--to", to, "--step", step, "-o", "new.oem")
    return Case(args, OPEN | {USAGE}, "new.oem", note=f"{to}, {step}")


@kind("orbit-zenith", 1.0)
def zenith(place: Place) -> Case:
    """A fit of changed zenith distances."""
    change = changed if place.rng.random() < 0.5 else damaged
    data, note = change(place.material("zenith.csv"), place.rng)
    place.write("zenith.csv", data)
    place.write("orbit.toml", "[forces]\ndegree = 2\n")
    args = ("-q", "orbit", "fit", "zenith.csv", "--config", "orbit.toml", "-o", "new")
    return Case(args, OPEN | {USAGE}, "new", note=note)
