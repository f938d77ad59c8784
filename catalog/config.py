"""TOML files read into typed settings, and the files that travel with the package.

A setting that nobody reads is a mistake that nobody sees, so unknown keys are refused, with the
nearest right one named. Numbers must be finite.
"""

import difflib
import math
import re
import tomllib
from collections.abc import Iterator
from importlib.resources import files
from pathlib import Path
from typing import Annotated, Any, TypeVar

import msgspec
from msgspec import inspect

from catalog.errors import ConfigError
from catalog.inputs import MAX_CONFIG_BYTES, read_input

T = TypeVar("T")

# Types of settings. No body, camera or picture has what lies beyond their bounds; squares and
# ratios of numbers within them do not overflow.
Positive = Annotated[float, msgspec.Meta(gt=0.0, le=1e12)]
NotNegative = Annotated[float, msgspec.Meta(ge=0.0, le=1e12)]
Turn = Annotated[float, msgspec.Meta(ge=-3600.0, le=3600.0)]  # deg
Count = Annotated[int, msgspec.Meta(ge=1, le=100_000)]
Slope = Annotated[float, msgspec.Meta(ge=0.0, le=80.0)]  # deg
Seconds = Annotated[float, msgspec.Meta(ge=1e-3, le=1e9)]

MIN_SIZE, MAX_SIZE = 1e-30, 1e18  # of a number that is not 0, whatever it is
MAX_WHOLE = 2**53  # beyond it a whole number has no exact float
MAX_DEPTH = 20

BUNDLED = "bundled:"  # a name that begins so is that of a file that ships with optnav

_KINDS = {
    "str": "text",
    "int": "a whole number",
    "float": "a number",
    "bool": "true or false",
    "array": "a list",
    "object": "a section",
    "null": "nothing",
    "datetime": "a date and time",
}
_EXPECTED = re.compile(r"Expected `([^`]+)`(?: (.*?))?(?:, got (`?[\w ]+`?))?$")
_STEP = re.compile(r"\.([^.\[]+)|\[(\d+|\.\.\.)\]")


def load_toml(path: str | Path, type_: type[T]) -> T:
    """Read a TOML file into a msgspec.Struct type.

    Raises ConfigError, naming file, section and key, for a file that cannot be read, is not TOML
    or does not fit the type.
    """
    return parse_toml(read_toml_text(Path(path)), type_, path)


def read_toml_text(path: Path) -> str:
    """The text of a TOML file. Raises ConfigError for a file that cannot be read as text."""
    raw = read_input(path, error=ConfigError, limit=MAX_CONFIG_BYTES)
    try:
        return raw.decode("utf-8-sig").replace("\r\n", "\n")
    except UnicodeDecodeError as error:
        line = raw.count(b"\n", 0, error.start) + 1
        raise ConfigError(
            f"{path}: line {line} is not UTF-8 text; wanted a TOML file, saved as UTF-8"
        ) from None


def parse_toml(text: str, type_: type[T], where: str | Path) -> T:
    """Read TOML text into a msgspec.Struct type; `where` names its origin in messages.

    Raises ConfigError.
    """
    try:
        data = tomllib.loads(text.replace("\r\n", "\n"))
    except RecursionError:
        raise ConfigError(f"{where}: not valid TOML: lists in lists, too deep to read") from None
    except ValueError as error:  # of a number with thousands of digits, too
        raise ConfigError(f"{where}: not valid TOML: {error}") from None
    info = inspect.type_info(type_)
    for steps, problem in _find_invalid_values(data, ()):
        raise ConfigError(f"{where}: {_format_location(steps)} {problem}")
    for problem in _find_unknown_keys(info, data, (), info):
        raise ConfigError(f"{where}: {problem}")
    try:
        return msgspec.convert(data, type_)
    except msgspec.ValidationError as error:
        raise ConfigError(f"{where}: {_explain(str(error), info, data)}") from None


def resource(name: str) -> Path:
    """Path of a shipped file, such as "configs/bodies/moon.toml" or "data/moon_gld100_4ppd.tif".

    In a checkout configs/ lies beside the package, in an installed wheel inside it.
    Raises ConfigError, naming the neighbours that exist, when there is no such file.
    """
    if "\0" in name:
        raise ConfigError(f"optnav ships no file {name!r}; no name of a file has a null byte")
    package = Path(str(files("catalog")))
    for base in (package, package.parent):
        path = base / name
        # only data/ and configs/ are shipped: a name must not climb out of them
        inside = any(path.resolve().is_relative_to(base / top) for top in ("data", "configs"))
        if inside and path.is_file():
            return path
    wanted = Path(name)
    folders = (package / wanted.parent, package.parent / wanted.parent)
    shipped = wanted.parts[:1] in (("data",), ("configs",)) and ".." not in wanted.parts
    there = sorted(p.name for f in folders if shipped for p in f.glob("*" + wanted.suffix))
    known = f"it has {', '.join(there)}" if there else "the installation may be incomplete"
    raise ConfigError(f"optnav ships no file {name!r}; {known}")


def resolve_config(path: Path, kind: str) -> Path:
    """A config file as people name it: "bundled:demo" is one that ships with optnav, of a kind.

    Raises ConfigError, naming those that ship, for another one.
    """
    if not str(path).startswith(BUNDLED):
        return path
    return resource(f"configs/{kind}/{str(path).removeprefix(BUNDLED).removesuffix('.toml')}.toml")


def nearest_name(name: str, known: list[str]) -> str | None:
    """The known name that was most likely meant, or None when none is near."""
    close = difflib.get_close_matches(name, known, n=1, cutoff=0.6)
    if close:
        return close[0]
    # a unit left out or a beginning typed: 'edge_sigma' for 'edge_sigma_px'
    longer = [k for k in known if len(name) > 2 and (k.startswith(name) or name.startswith(k))]
    return longer[0] if longer else None


Steps = tuple[str | int, ...]


def _find_unknown_keys(
    info: inspect.Type, value: Any, steps: Steps, root: inspect.Type
) -> Iterator[str]:
    """Say of each key in the data that the types do not have where it stands and what is near."""
    if isinstance(info, inspect.UnionType):
        parts = [part for part in info.types if _is_container(part, value)]
        if len(parts) == 1:
            yield from _find_unknown_keys(parts[0], value, steps, root)
    elif isinstance(info, inspect.StructType) and isinstance(value, dict):
        fields = {field.encode_name: field.type for field in info.fields}
        for key, child in value.items():
            if key in fields:
                yield from _find_unknown_keys(fields[key], child, (*steps, key), root)
            elif key != info.tag_field:
                yield _explain_unknown_key(key, child, list(fields), steps, root)
    elif isinstance(info, inspect.DictType) and isinstance(value, dict):
        for key, child in value.items():
            yield from _find_unknown_keys(info.value_type, child, (*steps, key), root)
    elif isinstance(info, inspect.ListType | inspect.VarTupleType) and isinstance(value, list):
        for number, child in enumerate(value):
            yield from _find_unknown_keys(info.item_type, child, (*steps, number), root)


def _is_container(info: inspect.Type, value: Any) -> bool:
    if isinstance(value, list):
        return isinstance(info, inspect.ListType | inspect.VarTupleType)
    if isinstance(info, inspect.StructType) and isinstance(value, dict):
        return info.tag_field is None or value.get(info.tag_field) == info.tag
    return isinstance(info, inspect.DictType) and isinstance(value, dict)


def _explain_unknown_key(
    key: str, value: Any, known: list[str], steps: Steps, root: inspect.Type
) -> str:
    kind = "section" if isinstance(value, dict) else "setting"
    shown = f"[{key}]" if kind == "section" and not steps else repr(key)
    message = f"{_format_section(steps) or 'it'} has no {kind} {shown}"
    near = nearest_name(key, known)
    if near:
        meant = f"[{near}]" if shown.startswith("[") else repr(near)
        return f"{message}; did you mean {meant}?"
    elsewhere = [known_steps for known_steps in _list_settings(root, ()) if known_steps[-1] == key]
    if elsewhere:
        home = _format_section(elsewhere[0][:-1]) or "the top of the file"
        return f"{message}; it belongs to {home}"
    return f"{message}; it knows {', '.join(sorted(known))}"


def _list_settings(info: inspect.Type, steps: Steps) -> Iterator[Steps]:
    """Every setting of the types that one could write into the file."""
    if isinstance(info, inspect.UnionType):
        for part in info.types:
            yield from _list_settings(part, steps)
    elif isinstance(info, inspect.ListType | inspect.VarTupleType):
        yield from _list_settings(info.item_type, (*steps, 0))
    elif isinstance(info, inspect.StructType):
        for field in info.fields:
            yield (*steps, field.encode_name)
            yield from _list_settings(field.type, (*steps, field.encode_name))


def _find_invalid_values(value: Any, steps: Steps) -> Iterator[tuple[Steps, str]]:
    """Yield path and fault of values that no setting can have: not finite, too large, too deep."""
    if isinstance(value, float) and not math.isfinite(value):
        yield steps, "must be a finite number"
    elif isinstance(value, float) and value and not MIN_SIZE <= abs(value) <= MAX_SIZE:
        yield steps, f"is {value:g}; wanted 0 or a size from {MIN_SIZE:g} to {MAX_SIZE:g}"
    elif isinstance(value, int) and abs(value) > MAX_WHOLE:
        yield steps, f"must be a whole number of at most {MAX_WHOLE}"
    elif len(steps) > MAX_DEPTH:
        yield steps[:3], f"holds more than {MAX_DEPTH} lists or sections in each other"
    elif isinstance(value, dict):
        for key, child in value.items():
            yield from _find_invalid_values(child, (*steps, key))
    elif isinstance(value, list):
        for number, child in enumerate(value):
            yield from _find_invalid_values(child, (*steps, number))


def _format_section(steps: Steps) -> str:
    """The heading of a section as TOML writes it; "" at the top of the file."""
    if not steps:
        return ""
    names = ".".join(str(step) for step in steps if isinstance(step, str))
    if isinstance(steps[-1], int):
        return f"[[{names}]] number {steps[-1] + 1}"
    return f"[{names}]"


def _format_location(steps: Steps) -> str:
    """Section and setting of a value: "[grid] cell_deg", "[camera] principal_point_px, item 2"."""
    if steps and isinstance(steps[-1], int):
        return f"{_format_location(steps[:-1])}, item {steps[-1] + 1}"
    return f"{_format_section(steps[:-1])} {steps[-1] if steps else 'the file'}".lstrip()


def _explain(message: str, info: inspect.Type, data: Any) -> str:
    """Put msgspec's finding into the words of the file's author."""
    text, _, path = message.partition(" - at `")
    steps = tuple(
        name or (int(number) if number.isdigit() else "*")
        for name, number in _STEP.findall(path.removesuffix("`"))
    )
    missing = re.match(r"Object missing required field `(.+)`", text)
    if missing:
        return _explain_missing(missing[1], info, steps)
    value = _find_value(data, steps)
    shown_value = (
        "" if value is None or isinstance(value, dict | list) else f" = {_format_value(value)}"
    )
    subject = f"{_format_location(steps)}{shown_value}"
    expected = _EXPECTED.match(text)
    if expected and expected[1] == "array" and isinstance(value, dict):
        name = _format_section(steps)
        return f"{name} is one section; wanted a list of them: write [{name}] for each"
    if expected:
        kinds = [_KINDS.get(kind, kind) for kind in expected[1].split(" | ") if kind != "null"]
        wanted = " or ".join(kinds) + (f" {expected[2]}" if expected[2] else "")
        word = expected[3]  # what msgspec says it got: a kind in backquotes, or how many items
        known = "" if shown_value or not word else _KINDS.get(word.strip("`"), f"{word} long")
        got = f"; it is {known}" if known else ""
        return f"{subject}: must be {wanted}{got}"
    if text.startswith("Invalid enum value"):
        choices = sorted(str(choice) for choice in _list_choices(_find_type(info, steps)))
        near = nearest_name(str(value), choices)
        hint = f"; did you mean {near!r}?" if near else ""
        return f"{subject}: must be one of {', '.join(choices)}{hint}"
    if isinstance(_find_type(info, steps), inspect.StructType):
        subject = _format_section(steps)
    return f"{subject}: {text}" if subject else text


def _explain_missing(key: str, info: inspect.Type, steps: Steps) -> str:
    type_ = _find_type(info, (*steps, key))
    if isinstance(type_, inspect.StructType):
        return f"it has no section {_format_section((*steps, key))}; add it"
    if isinstance(_find_type(info, (*steps, key, 0)), inspect.StructType):
        return f"it has no section [{_format_section((*steps, key))}]; add at least one"
    return f"{_format_section(steps)} needs the setting {key!r}; add it".lstrip()


def _find_type(info: inspect.Type, steps: Steps) -> inspect.Type | None:
    if isinstance(info, inspect.UnionType):
        candidates = (_find_type(part, steps) for part in info.types)
        return next((type_ for type_ in candidates if type_ is not None), None)
    if not steps:
        return None if isinstance(info, inspect.NoneType) else info
    if isinstance(info, inspect.StructType):
        fields = {field.encode_name: field.type for field in info.fields}
        return _find_type(fields[str(steps[0])], steps[1:]) if str(steps[0]) in fields else None
    if isinstance(info, inspect.ListType | inspect.VarTupleType):
        return _find_type(info.item_type, steps[1:])
    if isinstance(info, inspect.DictType):
        return _find_type(info.value_type, steps[1:])
    return None


def _list_choices(type_: inspect.Type | None) -> list[Any]:
    if isinstance(type_, inspect.EnumType):
        return [member.value for member in type_.cls]
    return list(type_.values) if isinstance(type_, inspect.LiteralType) else []


def _find_value(data: Any, steps: Steps) -> Any:
    for step in steps:
        in_list = isinstance(data, list) and isinstance(step, int) and step < len(data)
        if not in_list and not (isinstance(data, dict) and step in data):
            return None
        data = data[step]
    return data


def _format_value(value: Any) -> str:
    """A value as TOML writes it."""
    if isinstance(value, bool):
        return "true" if value else "false"
    return f'"{value}"' if isinstance(value, str) else str(value)
