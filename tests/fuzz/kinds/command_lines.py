"""Command lines: every option of every command, as click declares them, with wrong words."""

from functools import cache

import click

from optnav_cli.main import cli
from tests.fuzz.cases import DATA, OK, USAGE, Case, Place, kind
from tests.fuzz.kinds.commands import COMMANDS, OUT

WRONG = frozenset({USAGE})
NOT_NUMBERS = [
    "",
    "x",
    "1e",
    "--",
    "0x10",
    "1,0",
    "½",
    "1e23e",
    "one",
    " ",
    "1 2",
    "nan nan",
    "９x",
]
LARGE = [
    "-1",
    "0",
    "1e23",
    "99999999999999999999999",
    "-99999999999999999999",
    "1.5",
    "nan",
    "inf",
    "-inf",
    "1e400",
    "9" * 5000,
]
WORDS = [
    "",
    "x",
    "-",
    "--",
    "-x",
    "--x",
    "--no-such-option",
    "-é",
    "--=",
    "-o",
    "-qv",
    "--help=1",
    "--quiet=1",
    "@x",
    "\udcff",
]


@cache
def commands() -> dict[tuple[str, ...], click.Command]:
    """Every command without subcommands, by its words."""
    found: dict[tuple[str, ...], click.Command] = {}

    def walk(command: click.Command, words: tuple[str, ...]) -> None:
        if isinstance(command, click.Group):
            context = click.Context(command)
            for name in command.list_commands(context):
                inner = command.get_command(context, name)
                if inner is not None:
                    walk(inner, (*words, name))
        else:
            found[words] = command

    walk(cli, ())
    return found


def _options(command: click.Command) -> list[click.Option]:
    return [param for param in command.params if isinstance(param, click.Option)]


@kind("line-option", 16.0)
def options(place: Place) -> Case:
    """An option of any command with a value that it cannot take; nothing else is there."""
    rng = place.rng
    words, command = rng.choice(sorted(commands().items(), key=lambda item: item[0]))
    choices = [option for option in _options(command) if not option.is_flag]
    if not choices:
        return Case((*words, "--no-such-option"), WRONG, note="an unknown option")
    option = rng.choice(choices)
    name = rng.choice(option.opts)
    if rng.random() < 0.2:
        return Case((*words, *_arguments(command), name), WRONG, note=f"{name} without a value")
    kind_ = option.type
    wrong: list[str] = []
    if isinstance(kind_, click.Choice):
        wrong = ["", "x", "NCC ", "é", "ncc,surf"]
    elif isinstance(kind_, click.types.IntParamType | click.types.FloatParamType):
        wrong = [*NOT_NUMBERS]
        if isinstance(kind_, click.IntRange | click.FloatRange):
            wrong += _outside(kind_)
        if isinstance(kind_, click.types.IntParamType):
            wrong += ["1.5", "nan", "inf", "1e23", "1e400"]
        else:
            wrong += ["nan"]
    elif kind_.name == "W,S,E,N":
        wrong = [
            "",
            "1,2,3",
            "1,2,3,4,5",
            "a,b,c,d",
            "nan,nan,nan,nan",
            "0,0,0,1",
            "0,90,1,-90",
            "-inf,0,inf,1",
            "1e9,0,1,1",
        ]
    if not wrong:
        return Case((*words, name, "x", "--no-such-option"), WRONG, note="an unknown option")
    value = rng.choice(wrong)
    joined = rng.random() < 0.5 and name.startswith("--")
    given = [f"{name}={value}"] if joined else [name, value]
    args = (*words, *given, *_arguments(command))
    return Case(args, WRONG, note=f"{name} = {value[:30]!r}")


def _outside(kind_: click.IntRange | click.FloatRange) -> list[str]:
    found = []
    if kind_.min is not None:
        found += [
            str(kind_.min - 1),
            "-1e300" if isinstance(kind_, click.FloatRange) else "-" + "9" * 30,
        ]
        found += [str(kind_.min)] if kind_.min_open else []
    if kind_.max is not None:
        found += [str(kind_.max + 1)]
    return found


def _arguments(command: click.Command) -> list[str]:
    return ["1" if param.type.name in ("float", "integer") else "nothing" for param in command.params
            if isinstance(param, click.Argument) and param.required]  # fmt: skip


@kind("line-words", 14.0)
def words(place: Place) -> Case:
    """A command that works, with a word too much, too few, or misspelt."""
    rng = place.rng
    name = rng.choice(sorted(COMMANDS))
    command = COMMANDS[name]
    args = list(command.with_output(f"new{command.ending}"))
    way = rng.randrange(7)
    if way == 0:  # an option that nothing knows
        args.insert(
            rng.randrange(1, len(args) + 1) if name not in ("help", "version") else 0, "--no-such"
        )
        note = "with --no-such"
        if args[:1] == ["config"] or "-o" in args:
            # it may stand where a value is wanted, and then is one
            at = args.index("--no-such")
            if at and args[at - 1].startswith("-"):
                args[at - 1 : at + 1] = ["--no-such"]
        codes = WRONG
    elif way == 1:
        args[0] = rng.choice(
            ["bild", "", "catlog", "é", "BUILD", "build ", "x" * 9999, "\udcff", "-", "info"]
        )
        codes, note = WRONG, f"first word {args[0][:20]!r}"
    elif way == 2 and len(args) > 1 and name not in ("help", "version", "template"):
        args = args[: rng.randrange(1, 2 if args[0] != "catalog" else 3)]
        codes, note = WRONG, "cut short"
    elif way == 3:
        args = (
            ["-q", "-v", *args]
            if args[0] not in ("--help", "--version")
            else ["--help", "--nothing"]
        )
        codes, note = frozenset({USAGE}) if args[0] == "-q" else frozenset({OK, USAGE}), "-q and -v"
    elif way == 4 and name not in ("help", "version"):
        args = [*args[: 2 if args[0] in ("catalog", "config") else 1], rng.choice(["--help", "-h"])]
        codes, note = frozenset({OK}), "its help"
    elif way == 5 and name not in ("help", "version"):
        # a word more than it takes; of nearest and show a number is one
        args = [*args, "word", rng.choice(WORDS)]
        codes, note = WRONG, "words too many"
    else:
        args = [rng.choice(WORDS)]
        codes, note = frozenset({OK, USAGE}), f"{args[0]!r} alone"
    return Case(tuple(args), codes, note=f"{name}: {note}")


@kind("line-inputs", 9.0)
def inputs(place: Place) -> Case:
    """A command that works, one of whose inputs is not there, or is something else."""
    rng = place.rng
    name = rng.choice([name for name, command in COMMANDS.items() if command.takes])
    command = COMMANDS[name]
    command.take(place)
    args = list(command.with_output(f"new{command.ending}"))
    named = [i for i, arg in enumerate(args) if (place.folder / arg).exists()]
    which = rng.choice(named)
    other = rng.choice(
        ["nothing", "", ".", "/", "a" * 300, "a/" * 3000, "/dev/zero", "/dev/null", "/proc/self/mem", "/etc/passwd", "\udcff\udce9",
         f"{place.url}x.gpkg", f"/vsicurl/{place.url}x.gpkg", "pipe", "loop", "empty", "é/ü", "file:moon.gpkg?mode=rw", ":memory:"]
    )  # fmt: skip
    (place.folder / "loop").symlink_to("loop")
    place.write("empty", b"")
    if other == "pipe":
        import os

        os.mkfifo(place.folder / "pipe")
    note = f"{name}: {other[:40]!r} for {args[which]}"
    args[which] = other
    codes = frozenset({USAGE, DATA}) if other in ("", ".", "/") else frozenset({DATA})
    leaves = ("new.gpkg.work",) if name.startswith("build") else ()
    return Case(("-q", *args), codes, leaves=leaves, note=note)


@kind("line-numbers", 6.0)
def numbers(place: Place) -> Case:
    """Numbers as arguments, far off and strange."""
    rng = place.rng
    place.take("moon.gpkg")
    value, other = rng.choice(LARGE), rng.choice([*LARGE, "10", "-90", "360", "1e-300", "-0"])
    if rng.random() < 0.5:
        args: tuple[str, ...] = ("catalog", "nearest", "moon.gpkg", value, other)
        right = _is_within(value, -90, 90) and _is_within(other, -180, 360)
        return Case(("-q", *args), frozenset({OK if right else USAGE}), note="nearest")
    option = rng.choice(["--point", "--level", ""])
    if option:
        point = value if option == "--point" else "27858"
        level = value if option == "--level" else "0"
        args = (
            "catalog",
            "export",
            "moon.gpkg",
            "--point",
            point,
            "--level",
            level,
            "-o",
            "new.glb",
        )
    else:
        args = ("catalog", "show", "moon.gpkg", value, "-o", "new.png")
    codes = frozenset({USAGE, DATA}) if _is_whole(value) else WRONG
    if option == "--level" and value == "0":
        codes = frozenset({OK})
    return Case(("-q", *args), codes, args[-1], note=f"{option or 'show'} {value[:30]}")


def _is_within(text: str, low: float, high: float) -> bool:
    return low <= float(text) <= high


def _is_whole(text: str) -> bool:
    return text.lstrip("-").isdigit() and len(text) < 4000


@kind("line-streams", 0.03)
def streams(place: Place) -> Case:
    """A command as a process of its own whose stdout is closed or full."""
    rng = place.rng
    name = rng.choice(("info", "verify", "export-csv", "report-svg", "evaluate", "template"))
    command = COMMANDS[name]
    command.take(place)
    stream = rng.choice(("closed", "full"))
    output = None if command.ending is None else f"new{command.ending}"
    args = ("-q", *command.with_output(output or OUT))
    evaluation = ("run/evaluation.json", "run/evaluation.csv")
    codes = frozenset({OK}) if stream == "closed" else frozenset({OK, DATA})
    return Case(args, codes, output, codes, evaluation, note=f"{name}: {stream}", streams=stream)
