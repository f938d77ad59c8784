"""Options and arguments that several commands share, and groups that load commands when asked."""

import difflib
import math
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any, TypeVar

import click

from catalog.jobs import MAX_WORKERS

PATH = click.Path(path_type=Path)
POINT_ID = click.IntRange(0, 2**31 - 1)  # a catalog has fewer cells
F = TypeVar("F", bound=Callable[..., Any])
BoundingBox = tuple[float, float, float, float]

IN_FILES = f"{__name__}.in_files"  # in a context's meta: whether the result goes to files

_NEGATIVE = re.compile(r"-\.?\d")


class OutputOption(click.Option):
    """An option that names where a result goes; of a file, with the endings that are written.

    endings  as ".html"; "" where a name without one will do
    """

    def __init__(self, *args: Any, endings: Sequence[str] = (), **kwargs: Any) -> None:
        super().__init__(*args, **{"type": PATH, **kwargs})
        self.endings = endings

    def type_cast_value(self, ctx: click.Context, value: Any) -> Any:
        """The place. Raises BadParameter for another ending than is written."""
        path = super().type_cast_value(ctx, value)
        if path is not None and self.endings and path.suffix.lower() not in self.endings:
            *others, last = filter(None, self.endings)
            wanted = f"{', '.join(others)} or {last}" if others else last
            raise click.BadParameter(f"{str(path)!r} does not end in {wanted}", ctx, self)
        return path


class RenamedChoice(click.Choice):  # type: ignore[type-arg] # generic since 8.2 only
    """Words to choose from, of which some had other names before: those are taken with a remark.

    former  old names with the new ones
    """

    def __init__(self, choices: Sequence[str], former: Mapping[str, str]) -> None:
        super().__init__(choices)
        self.former = former

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """The chosen word. Raises BadParameter for another one."""
        new = self.former.get(value)
        if new is not None:
            click.echo(
                f"optnav: '{value}' is called '{new}' now; the old name goes with the next version",
                err=True,
            )
        return super().convert(new or value, param, ctx)


class Number(click.FloatRange):
    """A finite number within bounds."""

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> float:
        number: float = super().convert(value, param, ctx)
        if not math.isfinite(number):  # a range lets NaN pass
            self.fail(f"{value} is not a finite number", param, ctx)
        return number


class SolvedLimit(click.ParamType):  # type: ignore[type-arg] # generic since 8.4 only
    """A number of frames, or a share of them: 10, 0.9 or 90%."""

    name = "N|SHARE|N%"

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> int | float:
        text = str(value).strip()
        try:
            if text.isdecimal():
                return int(text)
            share = float(text.removesuffix("%")) / (100.0 if text.endswith("%") else 1.0)
        except ValueError:
            share = -1.0
        if not 0.0 <= share <= 1.0:
            self.fail(
                f"{text!r} is no number of frames, nor a share such as 0.9 or 90%", param, ctx
            )
        return share


def _store_shared(ctx: click.Context, param: click.Parameter, value: Any) -> None:
    """Keep what a shared option says for the whole command line; the last one said counts."""
    if value:
        ctx.meta[f"{__name__}.{param.name}"] = value
    if ctx.meta.get(f"{__name__}.quiet") and ctx.meta.get(f"{__name__}.verbose"):
        raise click.UsageError("--quiet and --verbose exclude each other; give one", ctx)


def _make_shared_option(*names: str, **more: Any) -> click.Option:
    return click.Option(names, expose_value=False, callback=_store_shared, **more)


SHARED_OPTIONS = (
    _make_shared_option("-q", "--quiet", is_flag=True, help="Show warnings and errors only."),
    _make_shared_option("-v", "--verbose", is_flag=True, help="Show details."),
    _make_shared_option(
        "--log-file",
        type=PATH,
        help="Also write all messages to this file, one JSON object a line.",
    ),
)


class SharingCommand(click.Command):
    """A command or group that takes the shared options, which may stand anywhere."""

    def get_params(self, ctx: click.Context) -> list[click.Parameter]:
        return [*super().get_params(ctx), *SHARED_OPTIONS]


class OptnavCommand(SharingCommand):
    """A command that does something: messages go where the shared options say."""

    def invoke(self, ctx: click.Context) -> Any:
        from optnav_cli.console import ConsoleProgress, set_up_logging

        names = ("quiet", "verbose", "log_file")
        said = {name: ctx.meta.get(f"{__name__}.{name}") for name in names}
        set_up_logging(
            quiet=bool(said["quiet"]), verbose=bool(said["verbose"]), log_file=said["log_file"]
        )
        ctx.obj = ConsoleProgress(quiet=bool(said["quiet"]))
        places = (p for p in self.params if isinstance(p, OutputOption) and p.name)
        ctx.meta[IN_FILES] = any(ctx.params.get(option.name or "") for option in places)
        return super().invoke(ctx)


class NumberArguments(OptnavCommand):
    """A command whose arguments may be negative numbers, written without a `--` before them."""

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        # Only then: otherwise a misspelt option would no longer be called one.
        ctx.ignore_unknown_options = any(_NEGATIVE.match(arg) for arg in args)
        return super().parse_args(ctx, args)


class BoundingBoxType(click.ParamType):  # type: ignore[type-arg] # generic since 8.4 only
    """west,south,east,north in degrees; west > east crosses ±180°."""

    name = "W,S,E,N"

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> BoundingBox:
        if isinstance(value, tuple):
            return value
        try:
            west, south, east, north = (float(part) for part in str(value).split(","))
        except ValueError:
            self.fail(f"{value!r} is not four numbers W,S,E,N, such as -17,-48,-5,-38", param, ctx)
        if not all(-180.0 <= lon <= 360.0 for lon in (west, east)):
            self.fail(f"{value!r}: longitudes must be within -180..360", param, ctx)
        if not -90.0 <= south < north <= 90.0:
            self.fail(f"{value!r}: needs -90 <= south < north <= 90", param, ctx)
        if west == east:
            self.fail(f"{value!r}: west and east are the same", param, ctx)
        return west, south, east, north


def _make_angle_check(
    low: int, high: int
) -> Callable[[click.Context, click.Parameter, float], float]:
    """A callback that refuses an angle outside low..high degrees."""

    def checked(ctx: click.Context, param: click.Parameter, value: float) -> float:
        if not low <= value <= high:
            raise click.BadParameter(f"{value} is not within {low}..{high} degrees", ctx, param)
        return value

    return checked


latitude, longitude = _make_angle_check(-90, 90), _make_angle_check(-180, 360)


def path_argument(name: str) -> Callable[[F], F]:
    """A path given as an argument; whether it exists is checked where it is opened."""
    return click.argument(name, type=PATH)


def output_option(
    text: str, endings: Sequence[str] = (), *, required: bool = True
) -> Callable[[F], F]:
    """`-o PATH`: where the result goes, to a folder or a file with one of the endings."""
    return click.option(
        "-o", "--output", cls=OutputOption, endings=endings, required=required, help=text
    )


json_option = click.option(
    "--json", "as_json", is_flag=True, help="Print one JSON document instead, for programs."
)


def _make_workers_option(what: str) -> Callable[[F], F]:
    text = f"{what} to work with; all cores by default."
    return click.option("--workers", type=click.IntRange(1, MAX_WORKERS), help=text)


workers_option, threads_option = _make_workers_option("Processes"), _make_workers_option("Threads")


def scheduler_option(files: str, note: str = "") -> Callable[[F], F]:
    """`--scheduler ADDRESS`: work elsewhere, where these files must be."""
    text = f"Work on the workers of this dask scheduler; they must see {files} under the same paths"
    return click.option("--scheduler", metavar="tcp://HOST:PORT", help=f"{text}.{note}")


bbox_option = click.option(
    "--bbox",
    type=BoundingBoxType(),
    help="Only cells whose middle lies in this box (degrees); W > E crosses ±180°.",
)
matcher_option = click.option(
    "--matcher",
    type=click.Choice(["ncc", "surf"]),
    default="ncc",
    show_default=True,
    help="How a control point is recognised.",
)


def work_option(*, required: bool) -> Callable[[F], F]:
    """`--work DIR`: the workspace of a build, from which a stopped one goes on."""
    return click.option(
        "--work",
        cls=OutputOption,
        required=required,
        help="Folder for what the stages hand on; a stopped run goes on from it."
        + ("" if required else " By default OUTPUT.work."),
    )


@dataclass(frozen=True)
class Entry:
    """Where a command lives: in `module`, named `attribute`; `text` is its short help."""

    module: str
    text: str
    attribute: str = "command"


class LazyGroup(SharingCommand, click.Group):
    """A group whose commands come from a table by name, in the order in which help lists them."""

    command_class = OptnavCommand

    def __init__(
        self, *args: Any, table: Callable[[], Mapping[str, Entry]] = dict, **kwargs: Any
    ) -> None:
        super().__init__(*args, **kwargs)
        self._table = table

    def list_commands(self, ctx: click.Context) -> list[str]:
        return [*self._table(), *super().list_commands(ctx)]

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        entry = self._table().get(cmd_name)
        if entry is None:
            return super().get_command(ctx, cmd_name)
        command = getattr(import_module(entry.module), entry.attribute)
        if not isinstance(command, click.Command):
            raise TypeError(f"{entry.module}.{entry.attribute} is not a click command")
        command.short_help = entry.text
        return command

    def resolve_command(
        self, ctx: click.Context, args: list[str]
    ) -> tuple[str | None, click.Command | None, list[str]]:
        name = args[0] if args else ""
        near = difflib.get_close_matches(name, self.list_commands(ctx), n=1)
        if near and near[0] != name and not name.startswith("-") and not ctx.resilient_parsing:
            ctx.fail(f"there is no command {name!r}; did you mean {near[0]!r}?")
        return super().resolve_command(ctx, args)

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """List the commands from the table alone, without importing one of them."""
        rows = [(name, entry.text) for name, entry in self._table().items()]
        for name in super().list_commands(ctx):
            rows.append((name, self.commands[name].get_short_help_str(limit=200)))
        if rows:
            with formatter.section("Commands"):
                formatter.write_dl(rows)
