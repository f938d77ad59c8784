"""The words of all commands: options that go anywhere, hostile numbers, endings, completion."""

import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import click
import pytest

from optnav_cli.main import cli, run
from optnav_cli.options import LazyGroup, OptnavCommand, OutputOption

CHECKOUT = Path(__file__).resolve().parents[2]
HOSTILE = (
    "nan", "inf", "-inf", "-1", "1e400", "1e23", str(10**23), "9" * 5000, "0x10", "", " ",
)  # fmt: skip


def commands(
    group: click.Group = cli, names: tuple[str, ...] = ()
) -> Iterator[tuple[tuple[str, ...], click.Command]]:
    """Every command with the words that call it."""
    context = click.Context(group)
    for name in group.list_commands(context):
        command = group.get_command(context, name)
        assert command is not None
        if isinstance(command, click.Group):
            yield from commands(command, (*names, name))
        else:
            yield (*names, name), command


COMMANDS = dict(commands())


def numbers() -> Iterator[tuple[tuple[str, ...], click.Option | click.Argument]]:
    for names, command in COMMANDS.items():
        for param in command.params:
            types = param.type.types if isinstance(param.type, click.Tuple) else [param.type]
            if any(kind.name.startswith(("int", "float")) for kind in types):
                yield names, param


NUMBERS = [*numbers()]


def words_with(names: tuple[str, ...], param: click.Parameter, value: str) -> list[str]:
    """A command line in which nothing is wrong but perhaps this value."""
    words = [*names]
    given: list[str] = []
    for other in COMMANDS[names].params:
        fine = "1" if "float" in other.type.name else "x"
        if isinstance(other.type, click.Choice):
            fine = str(other.type.choices[0])
        values = [value] if other is param else [fine]
        if isinstance(other, click.Argument):
            given += values * max(other.nargs, 1) if other is param or other.required else []
        elif other is param:
            words += [other.opts[0], *values * other.nargs]
        elif other.required or (names == ("report",) and "-o" in other.opts):
            words += [other.opts[0], f"x{[*getattr(other, 'endings', ()), '.json'][0]}"]
    if names == ("calibrate",) and param.name != "catalogs":
        words += ["--catalog", "x"]  # else it asks for one, or for the spacing of a grid
    if names == ("export",) and param.name in ("dem", "dem_sigma_m", "posting_m", "pictures"):
        words[words.index("x.gpkg")] = "x"  # a folder of maps
        words += ["--ortho", *([] if param.name == "dem" else ["--dem", "x"])]
    return [*words, *given]


@pytest.mark.parametrize("names", COMMANDS, ids=" ".join)
def test_each_command_takes_the_options_that_go_anywhere(names: tuple[str, ...]) -> None:
    command = COMMANDS[names]
    assert isinstance(command, OptnavCommand)
    with click.Context(command) as context:
        options = {name for param in command.get_params(context) for name in param.opts}
    assert {"-q", "--quiet", "-v", "--verbose", "--log-file"} <= options


def test_groups_take_them_too() -> None:
    for name in ("catalog", "config"):
        assert isinstance(cli.get_command(click.Context(cli), name), LazyGroup)


@pytest.mark.parametrize(
    "words",
    ["-q catalog info missing", "catalog -q info missing", "catalog info -q missing",
     "catalog info missing --quiet", "-q catalog -q info missing -q"],
)  # fmt: skip
def test_quiet_and_the_log_file_go_anywhere(
    words: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    log = tmp_path / "log"
    for place in range(len(words.split()) + 1):
        line = words.split()
        line[place:place] = ["--log-file", str(log)]
        assert run(line) == 3
    assert log.read_text().count("missing: there is no such file") == len(words.split()) + 1
    assert run([*words.split(), "-v"]) == 2
    assert "--quiet and --verbose exclude each other" in capsys.readouterr().err


@pytest.mark.parametrize("value", HOSTILE)
@pytest.mark.parametrize(
    ("names", "param"), NUMBERS, ids=[f"{' '.join(names)} {p.name}" for names, p in NUMBERS]
)
def test_a_number_that_cannot_be_is_a_wrong_command_line(
    names: tuple[str, ...],
    param: click.Parameter,
    value: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    if (
        (param.name in ("lat", "lon") and value == "-1")
        or (param.name == "nodata" and value in ("-1", "1e23", str(10**23)))
        or (isinstance(param, click.Argument) and value == "-inf")
    ):
        pytest.skip("is a place, a stored value, or an option that is not there")
    monkeypatch.chdir(tmp_path)
    assert run(words_with(names, param, value)) == 2
    out, err = capsys.readouterr()
    assert (out, len(err.splitlines())) == ("", 1)
    name = param.opts[0] if isinstance(param, click.Option) else param.make_metavar(
        click.Context(COMMANDS[names])
    ).strip("[]")  # fmt: skip
    assert err.startswith("optnav: invalid value for ")
    assert name in err
    assert err.endswith(f"(see `optnav {' '.join(names)} --help`)\n")
    assert not [*tmp_path.iterdir()]


INPUTS = [
    (names, param)
    for names, command in COMMANDS.items()
    for param in command.params
    if isinstance(param.type, click.Path) and not isinstance(param, OutputOption)
]


@pytest.mark.parametrize("kind", ["loop", "below a loop", "pipe", "device", "link to nothing"])
@pytest.mark.parametrize(
    ("names", "param"), INPUTS, ids=[f"{' '.join(names)} {p.name}" for names, p in INPUTS]
)
def test_an_input_that_is_no_file_is_refused_at_once(
    names: tuple[str, ...],
    param: click.Parameter,
    kind: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """A pipe would be waited for, /dev/zero read without end."""
    monkeypatch.chdir(tmp_path)
    os.mkfifo("pipe")
    Path("loop").symlink_to("loop")
    Path("link").symlink_to("nothing")
    places = {"loop": "loop", "below a loop": "loop/x", "pipe": "pipe", "device": "/dev/zero"}
    before = sorted(os.listdir())
    assert run(words_with(names, param, places.get(kind, "link"))) == 3
    out, err = capsys.readouterr()
    assert out == ""
    assert err.splitlines()[-1].startswith("optnav: ")
    assert sorted(os.listdir()) == before


OUTPUTS = [
    (names, param)
    for names, command in COMMANDS.items()
    for param in command.params
    if isinstance(param, OutputOption) and param.endings
]


@pytest.mark.parametrize(
    ("names", "param"), OUTPUTS, ids=[f"{' '.join(names)} {p.name}" for names, p in OUTPUTS]
)
@pytest.mark.parametrize("ending", [".pdf", ".xlsx", ".gpkg.bak"])
def test_an_ending_that_is_not_written_is_a_wrong_command_line(
    names: tuple[str, ...],
    param: OutputOption,
    ending: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    assert run([*words_with(names, param, f"x{ending}")]) == 2
    said = capsys.readouterr().err
    assert f"'x{ending}' does not end in " in said
    assert all(wanted in said for wanted in param.endings)
    assert not [*tmp_path.iterdir()]


def test_every_file_that_a_command_writes_has_its_endings() -> None:
    """Folders have none: these options name folders."""
    folders = {
        (names, param.name)
        for names, command in COMMANDS.items()
        for param in command.params
        if isinstance(param, OutputOption) and not param.endings
    }
    stages = {"build", "ingest", "render", "select", "check", "write"}
    orbits = {"fit", "qso", "landing", "delivery"}
    makers = {
        *("simulate", "navigate", "demo", "import", "adjust"),
        *("stereo", "stars", "hazard", "calibrate", "cylinder"),
    }
    assert folders == (
        {((name,), "work") for name in stages}
        | {((name,), "output") for name in makers}
        | {(("orbit", name), "output") for name in orbits}
        | {(("config", "template"), "output")}
    )
    for command in COMMANDS.values():  # and no command names an output in another way
        for param in command.params:
            assert isinstance(param, OutputOption) or "-o" not in param.opts


def completed(words: str, shell: str = "bash") -> list[str]:
    """What completion offers for the last of some words."""
    done = subprocess.run(
        [sys.executable, "-m", "optnav_cli.main"], cwd=CHECKOUT, capture_output=True, text=True,
        env={
            **os.environ, "_OPTNAV_COMPLETE": f"{shell}_complete", "COMP_WORDS": words,
            "COMP_CWORD": str(len(words.split(" ")) - 1),
        },
    )  # fmt: skip
    assert (done.returncode, done.stderr) == (0, "")
    return [line.partition(",")[2] for line in done.stdout.splitlines()]


def test_completion_offers_commands_options_and_choices() -> None:
    assert completed("optnav ca") == ["catalog", "calibrate"]
    assert completed("optnav catalog n") == ["nearest"]
    assert {"--workers", "--work", "--quiet"} <= set(completed("optnav build --"))
    assert completed("optnav navigate --matcher ") == ["ncc", "surf"]
    assert completed("optnav catlog n") == ["navigate"]  # a misspelt word is passed over


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_each_shell_gets_a_script(shell: str) -> None:
    done = subprocess.run(
        [sys.executable, "-m", "optnav_cli.main"], cwd=CHECKOUT, capture_output=True, text=True,
        env={**os.environ, "_OPTNAV_COMPLETE": f"{shell}_source"},
    )  # fmt: skip
    assert done.returncode == 0
    assert f"_OPTNAV_COMPLETE={shell}_complete" in done.stdout


def test_bash_itself_completes(tmp_path: Path) -> None:
    command = tmp_path / "optnav"
    command.write_text(f'#!/bin/sh\nexec {sys.executable} -m optnav_cli.main "$@"\n')
    command.chmod(0o755)
    script = (
        'eval "$(_OPTNAV_COMPLETE=bash_source optnav)"; '
        "COMP_WORDS=(optnav catalog ver); COMP_CWORD=2; _optnav_completion optnav; "
        'echo "${COMPREPLY[@]}"; complete -p optnav'
    )
    path = f"{tmp_path}{os.pathsep}{os.environ['PATH']}"
    done = subprocess.run(
        ["bash", "-c", script], capture_output=True, text=True, cwd=CHECKOUT,
        env=os.environ | {"PATH": path},
    )  # fmt: skip
    assert done.stdout.split("\n")[0] == "verify", done.stderr
    assert "-F _optnav_completion optnav" in done.stdout


def test_an_unknown_shell_is_told() -> None:
    done = subprocess.run(
        [sys.executable, "-m", "optnav_cli.main"], cwd=CHECKOUT, capture_output=True, text=True,
        env={**os.environ, "_OPTNAV_COMPLETE": "tcsh_source"},
    )  # fmt: skip
    assert done.returncode == 2
    assert "SHELL one of bash, zsh, fish" in done.stderr


def test_a_former_name_of_a_choice_is_taken_with_a_remark(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    line = ["cylinder", str(tmp_path / "none"), "-o", str(tmp_path / "run"), "--formula"]
    assert [run([*line, "printed"]), run([*line, "seed"]), run([*line, "sown"])] == [3, 3, 2]
    said = capsys.readouterr().err
    assert (
        said.count("'seed' is called 'printed' now; the old name goes with the next version") == 1
    )
