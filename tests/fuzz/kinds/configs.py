"""Config files of every type: every declared key, with values that fit it and values that do not."""

import math
import re
import tomllib
from collections.abc import Iterator
from itertools import pairwise
from typing import Any

from msgspec import inspect

from catalog.bodies.body import BodyFile
from catalog.pipeline.config import BuildConfig
from optnav_cli.camera.camera_file import CameraFileSettings
from optnav_cli.control_points.settings import NavigateSettings
from optnav_cli.frames.run_settings import RunSettings
from optnav_cli.simulation.descent import Descent
from optnav_cli.simulation.inertial_path import Approach, InertialPath
from optnav_cli.simulation.passes import Portraits, Scenario
from optnav_cli.simulation.stereo_path import StereoScenario
from tests.fuzz.cases import DATA, NOTHING, OK, OPEN, REFUSED, Case, Place, kind
from tests.fuzz.damage import damaged
from tests.fuzz.materials import BOX

Steps = tuple[str | int, ...]
RIGHT = frozenset({OK, NOTHING})


class Literal(str):
    """TOML text that stands in a file as it is."""


FOREVER = Literal("9" * 5000)
NUMBERS = [
    Literal(text)
    for text in (
        "0", "0.0", "-0.0", "-1", "-1.0", "1", "1e308", "-1e308", "1e-320", "1e17", "-1e17", "1e6", "0.5",
        "9223372036854775807", "-9223372036854775808", "9223372036854775808", "65536", "4096", "1e5", "89.999",
        "90.0", "180.0", "360.0", "-180.0", "1e-9", "2147483648", "1_000", "0x7f", "3.0",
    )
]  # fmt: skip
NOT_FINITE = [Literal(text) for text in ("nan", "inf", "-inf", "+nan")]
OTHERS = {
    "text": ["", "x", "nan", "0", "true", "é" * 40],
    "list": [[], [1], [[]], ["a"], [1.0] * 50, [[1.0, 2.0], [3.0]]],
    "table": [{}, {"a": 1}, {"path": "dem.tif"}],
    "date": [Literal("2026-01-01"), Literal("2026-01-01T00:00:00Z"), Literal("12:00:00")],
    "bool": [True, False],
}
TEXTS = [
    "", " ", "a" * 300, "a/" * 3000 + "a", "../../../../etc/passwd", "/etc/passwd", "/dev/zero", ".", "..", "/",
    "nul\\u0000", "line\\nbreak", "\\u202e", "é.tif", "bundled:", "bundled:../../pyproject.toml", "bundled:nothing.tif",
    "shared:", "shared:../x", "shared:nothing.tif", "http://127.0.0.1:9/x.tif", "/vsicurl/http://127.0.0.1:9/x.tif",
    "/vsizip/x.zip/y.tif", "GTIFF_DIR:1:dem.tif", "WMS:http://127.0.0.1:9/", "%s%n", "~", "$HOME", "-o", "dem.tif ",
    "moon", "Moon", "phobos", "mars", "earth", "hapke", "lambert", "west", "m", "km", "2026-01-01T00:00:00Z",
    "2026-13-01T00:00:00Z", "0000-00-00", "9999-12-31T23:59:60Z", "1e9", "IAU_2015:30100", "EPSG:4326", "EPSG:999999",
    "+proj=longlat +R=1 +no_defs", "+proj=longlat +R=nan", "+proj=utm +zone=33", "http://127.0.0.1:9/crs", "+init=x",
    "moon.gpkg", "cam.toml", "body.toml", "globe.tif", "body.obj", "unk", "camera_from_body", "camera_from_inertial",
]  # fmt: skip


def toml_text(data: dict[str, Any]) -> str:
    """A TOML document; tables inside are written inline."""
    return "".join(f"{_key(key)} = {_value(value)}\n" for key, value in data.items())


def _key(key: str) -> str:
    return key if re.fullmatch(r"[A-Za-z0-9_-]+", key) else f'"{key}"'


def _value(value: Any) -> str:
    if isinstance(value, Literal):
        return str(value)
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, str):
        return f'"{value}"'
    if isinstance(value, dict):
        return "{" + ", ".join(f"{_key(k)} = {_value(v)}" for k, v in value.items()) + "}"
    if isinstance(value, list):
        return "[" + ", ".join(map(_value, value)) + "]"
    return repr(value)


def leaves(info: inspect.Type, steps: Steps = ()) -> Iterator[tuple[Steps, inspect.Type]]:
    """Every setting of a type that holds a plain value, by its place."""
    if isinstance(info, inspect.UnionType):
        for part in info.types:
            if not isinstance(part, inspect.NoneType):
                yield from leaves(part, steps)
    elif isinstance(info, inspect.StructType):
        for field in info.fields:
            yield from leaves(field.type, (*steps, field.encode_name))
    elif isinstance(info, inspect.TupleType):
        for number, item in enumerate(info.item_types):
            yield from leaves(item, (*steps, number))
    elif isinstance(info, inspect.ListType | inspect.VarTupleType):
        yield from leaves(info.item_type, (*steps, 0))
    else:
        yield steps, info


def sections(info: inspect.Type, steps: Steps = ()) -> Iterator[tuple[Steps, inspect.StructType]]:
    """Every table of a type, by its place."""
    if isinstance(info, inspect.UnionType):
        for part in info.types:
            yield from sections(part, steps)
    elif isinstance(info, inspect.StructType):
        yield steps, info
        for field in info.fields:
            yield from sections(field.type, (*steps, field.encode_name))
    elif isinstance(info, inspect.ListType | inspect.VarTupleType):
        yield from sections(info.item_type, (*steps, 0))


def put(data: Any, steps: Steps, value: Any) -> bool:
    """Set a value at a place, making tables on the way; False where something else stands there."""
    for step, after in pairwise(steps):
        empty: Any = [] if isinstance(after, int) else {}
        if isinstance(step, int):
            if not isinstance(data, list):
                return False
            if len(data) <= step:
                data.append(empty)
            data = data[step]
        else:
            if not isinstance(data, dict):
                return False
            data = data.setdefault(step, empty)
    last = steps[-1]
    if isinstance(last, int) and isinstance(data, list):
        if last < len(data):
            data[last] = value
        else:
            data.append(value)
        return True
    if isinstance(last, str) and isinstance(data, dict):
        data[last] = value
        return True
    return False


# Settings that say how much is to be done: a lawful hundred thousand takes hours and is no fault.
AMOUNTS = ("frames", "passes", "trials", "places", "candidates", "hot_pixels", "seeds", "pairs")
# Without these the defaults hold: cells of a degree, relief down to 30 m, 200 landings, and so
# minutes or hours of work.
SPARING = ("grid", "cell_deg", "detail", "seeds", "trials")


class ConfigKind:
    """Cases of one type of config: a whole one, what it is read by, and where it lies."""

    def __init__(self, type_: type, base: str, target: str) -> None:
        self.info = inspect.type_info(type_)
        self.base, self.target = base, target
        self.leaves = list(leaves(self.info))
        self.sections = list(sections(self.info))

    def text(self, place: Place) -> tuple[str | bytes, frozenset[int], str]:
        """A file's content, the exit codes that are right for it, and what was done."""
        rng = place.rng
        data = tomllib.loads(place.material(self.base).decode())
        ways = [self._wrong_type] * 5 + [self._number] * 6 + [self._not_finite] * 3
        ways += [self._text] * 3 + [self._unknown, self._missing, self._whole]
        if rng.random() < 0.2:
            return self._raw(place, data)
        return rng.choice(ways)(place, data)

    def _leaf(self, place: Place, *kinds: type) -> tuple[Steps, inspect.Type]:
        fitting = [leaf for leaf in self.leaves if isinstance(leaf[1], kinds)]
        return place.rng.choice(fitting or self.leaves)

    def _changed(
        self, data: dict[str, Any], steps: Steps, value: Any, codes: frozenset[int]
    ) -> tuple[str, frozenset[int], str]:
        if not put(data, steps, value):
            return toml_text(data), RIGHT, "untouched: the place is taken"
        shown = _value(value)
        return toml_text(data), codes, f"{'.'.join(map(str, steps))} = {shown[:80]}"

    def _wrong_type(self, place: Place, data: dict[str, Any]) -> tuple[str, frozenset[int], str]:
        steps, info = place.rng.choice(self.leaves)
        fits = {
            inspect.FloatType: (), inspect.IntType: (), inspect.BoolType: ("bool",),
            inspect.StrType: ("text",), inspect.LiteralType: ("text",),
        }.get(type(info), ())  # fmt: skip
        name = place.rng.choice([name for name in OTHERS if name not in fits])
        return self._changed(data, steps, place.rng.choice(OTHERS[name]), REFUSED)

    def _number(self, place: Place, data: dict[str, Any]) -> tuple[str, frozenset[int], str]:
        steps, info = self._leaf(place, inspect.FloatType, inspect.IntType)
        if not isinstance(info, inspect.FloatType | inspect.IntType):
            return self._changed(data, steps, place.rng.choice(NUMBERS), REFUSED)
        value = FOREVER if place.rng.random() < 0.05 else place.rng.choice(NUMBERS)
        if (
            steps[-1] in AMOUNTS
            and value is not FOREVER
            and 50 < float(int(value, 0) if "x" in value else value) < 1e6
        ):
            value = Literal("2")
        return self._changed(data, steps, value, self._codes_of(info, value))

    def _codes_of(self, info: inspect.Type, value: Literal) -> frozenset[int]:
        number = tomllib.loads(f"a = {value}")["a"] if value is not FOREVER else math.inf
        if value is FOREVER:
            return REFUSED
        if isinstance(info, inspect.IntType) and isinstance(number, float):
            # msgspec takes 3.0 for a whole number
            return OPEN if number.is_integer() else REFUSED
        if isinstance(info, inspect.FloatType | inspect.IntType):
            low = (info.ge is not None and number < info.ge) or (
                info.gt is not None and number <= info.gt
            )
            high = (info.le is not None and number > info.le) or (
                info.lt is not None and number >= info.lt
            )
            return REFUSED if low or high else OPEN
        return OPEN

    def _not_finite(self, place: Place, data: dict[str, Any]) -> tuple[str, frozenset[int], str]:
        steps, _ = self._leaf(place, inspect.FloatType, inspect.IntType)
        return self._changed(data, steps, place.rng.choice(NOT_FINITE), REFUSED)

    def _text(self, place: Place, data: dict[str, Any]) -> tuple[str, frozenset[int], str]:
        steps, info = self._leaf(place, inspect.StrType, inspect.LiteralType)
        value = place.rng.choice(TEXTS)
        if isinstance(info, inspect.LiteralType):
            return self._changed(data, steps, value, OPEN if value in info.values else REFUSED)
        if isinstance(info, inspect.StrType):
            value = value.replace("127.0.0.1:9/", place.url.removeprefix("http://"))
            return self._changed(data, steps, value, OPEN)
        return self._changed(data, steps, value, REFUSED)

    def _unknown(self, place: Place, data: dict[str, Any]) -> tuple[str, frozenset[int], str]:
        steps, info = place.rng.choice(self.sections)
        known = [field.encode_name for field in info.fields]
        name = place.rng.choice(["x", "", "__class__", "é", f"{known[0]}_", known[-1][:-1] or "y"])
        if name in known:
            name = "x"
        return self._changed(data, (*steps, name), place.rng.choice([1, {}, "t"]), REFUSED)

    def _missing(self, place: Place, data: dict[str, Any]) -> tuple[str, frozenset[int], str]:
        at, info = place.rng.choice([s for s in self.sections if _table(data, s[0])])
        table = _table(data, at) or {}
        name = place.rng.choice([key for key in sorted(table) if key not in SPARING] or ["seed"])
        if name not in table:
            return self._whole(place, data)
        del table[name]
        required = {field.encode_name for field in info.fields if field.required}
        codes = REFUSED if name in required else OPEN
        return toml_text(data), codes, f"without {'.'.join(map(str, (*at, name)))}"

    def _whole(self, place: Place, data: dict[str, Any]) -> tuple[str, frozenset[int], str]:
        return toml_text(data), RIGHT, ""

    def _raw(self, place: Place, data: dict[str, Any]) -> tuple[str | bytes, frozenset[int], str]:
        """Damage to the text as such."""
        rng, text = place.rng, toml_text(data)
        first = next(iter(data))
        ways: list[tuple[str | bytes, frozenset[int], str]] = [
            (b"\xef\xbb\xbf" + text.encode(), RIGHT, "with a byte-order mark"),
            (text.replace("\n", "\r\n"), RIGHT, "with CRLF"),
            (text.encode("utf-16"), REFUSED, "in UTF-16"),
            (f"# {'é' * 9}\n{text}".encode("latin-1"), REFUSED, "in Latin-1"),
            (text + "\x00\n", REFUSED, "with NUL"),
            (text + f"{_key(first)} = 1\n", REFUSED, f"{first} twice"),
            (text + "x = " + "[" * 3000 + "]" * 3000 + "\n", REFUSED, "3000 nested lists"),
            (
                text + "x = " + "{a = " * 2000 + "1" + "}" * 2000 + "\n",
                REFUSED,
                "2000 nested tables",
            ),
            (text + "[" + ".".join(["a"] * 3000) + "]\n", REFUSED, "a table 3000 deep"),
            (text + "x = 1" + "0" * 5000 + "\n", REFUSED, "5000 digits"),
            (text + 'x = "' + "a" * 1_000_000 + '"\n', REFUSED, "a text of a million letters"),
            (text + "= 1\n", REFUSED, "a line without a key"),
            ("", OPEN, "empty"),
            ("# nothing\n" * 3, OPEN, "comments alone"),
            (text + "\n# " + "c" * 300_000 + "\n", RIGHT, "a long comment"),
        ]
        if rng.random() < 0.4:
            data_, note = damaged(text.encode(), rng)
            return data_, OPEN, note
        return rng.choice(ways)


def _table(data: Any, steps: Steps) -> dict[str, Any] | None:
    """The table at a place that has something in it; None for none."""
    for step in steps:
        if (isinstance(data, dict) and step in data) or (
            isinstance(data, list) and isinstance(step, int) and step < len(data)
        ):
            data = data[step]
        else:
            return None
    return data if isinstance(data, dict) and data else None


BUILD = ConfigKind(BuildConfig, "moon.toml", "moon.toml")
MESH_BUILD = ConfigKind(BuildConfig, "mesh.toml", "mesh.toml")
RELIEF_BUILD = ConfigKind(BuildConfig, "relief.toml", "relief.toml")
BODY = ConfigKind(BodyFile, "body.toml", "body.toml")
CAMERA = ConfigKind(CameraFileSettings, "cam.toml", "pictures/cameras/cam.toml")
RUN = ConfigKind(RunSettings, "pictures/run.toml", "pictures/run.toml")
NAVIGATE = ConfigKind(NavigateSettings, "navigate.toml", "navigate.toml")
SCENARIOS = {
    "passes": ConfigKind(Scenario, "passes.toml", "passes.toml"),
    "flight": ConfigKind(InertialPath, "flight.toml", "flight.toml"),
    "transfer": ConfigKind(InertialPath, "transfer.toml", "transfer.toml"),
    "portraits": ConfigKind(Portraits, "portraits.toml", "portraits.toml"),
    "approach": ConfigKind(Approach, "approach.toml", "approach.toml"),
    "stereo": ConfigKind(StereoScenario, "stereo.toml", "stereo.toml"),
    "descent": ConfigKind(Descent, "descent.toml", "descent.toml"),
}


def _with(place: Place, config: ConfigKind) -> tuple[frozenset[int], str]:
    text, codes, note = config.text(place)
    place.write(config.target, text)
    return codes, note


@kind("config-build", 8.0)
def build(place: Place) -> Case:
    """A build of one cell by a changed config."""
    place.take("dem.tif")
    codes, note = _with(place, BUILD)
    return _build(place, "moon.toml", BOX, codes, note)


@kind("config-build-relief", 0.7)
def build_relief(place: Place) -> Case:
    """A build with a relief by a changed config."""
    place.take("dem.tif", "globe.tif")
    codes, note = _with(place, RELIEF_BUILD)
    return _build(place, "relief.toml", BOX, codes, note)


@kind("config-build-mesh", 0.6)
def build_mesh(place: Place) -> Case:
    """A build of a small body by a changed config."""
    place.take("body.obj", "body.toml")
    codes, note = _with(place, MESH_BUILD)
    return _build(place, "mesh.toml", "0,0,15,14", codes, note)


@kind("config-body", 1.0)
def body(place: Place) -> Case:
    """A build or a simulation with a changed body file."""
    place.take("body.obj", "mesh.toml", "portraits.toml", "cam.toml")
    codes, note = _with(place, BODY)
    if place.rng.random() < 0.5:
        return _build(place, "mesh.toml", "0,0,15,14", codes, note)
    return Case(("-q", "simulate", "portraits.toml", "-o", "new"), codes, "new", note=note)


def _build(place: Place, config: str, box: str, codes: frozenset[int], note: str) -> Case:
    args = ("-q", "build", config, "-o", "new.gpkg", "--workers", "1", "--bbox", box)
    done = frozenset({OK, NOTHING})
    leaves_ = ("new.gpkg.work",)
    return Case(args, codes, "new.gpkg", done, leaves_, note=note)


@kind("config-camera", 2.0)
def camera(place: Place) -> Case:
    """Navigation with a changed camera file."""
    place.take("pictures", "moon.gpkg")
    return _navigate(*_with(place, CAMERA))


@kind("config-run", 3.0)
def run_toml(place: Place) -> Case:
    """Navigation with a changed run.toml."""
    place.take("pictures", "moon.gpkg")
    return _navigate(*_with(place, RUN))


@kind("config-navigate", 2.5)
def navigate(place: Place) -> Case:
    """Navigation with changed settings."""
    place.take("pictures", "moon.gpkg")
    return _navigate(*_with(place, NAVIGATE), "--config", "navigate.toml")


def _navigate(codes: frozenset[int], note: str, *more: str) -> Case:
    args = ("-q", "navigate", "pictures", "--catalog", "moon.gpkg", *more, "-o", "new")
    return Case(args, codes, "new", frozenset({OK, NOTHING}), note=note)


SCENARIO_WEIGHTS = {
    "passes": 0.8,
    "flight": 0.8,
    "transfer": 0.5,
    "portraits": 2.0,
    "approach": 1.5,
    "stereo": 0.7,
    "descent": 0.7,
}


def _scenario(name: str) -> None:
    @kind(f"config-{name}", SCENARIO_WEIGHTS[name])
    def simulate(place: Place) -> Case:
        place.take("cam.toml", "shtk.toml", "dem.tif", "globe.tif", "body.obj", "body.toml")
        codes, note = _with(place, SCENARIOS[name])
        args = ("-q", "simulate", f"{name}.toml", "-o", "new")
        return Case(args, codes & {OK, DATA}, "new", note=note)


for _name in SCENARIOS:
    _scenario(_name)
