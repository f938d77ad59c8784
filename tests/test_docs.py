"""What people read agrees with what there is."""

import itertools
import os
import re
import shlex
import subprocess
import tomllib
from collections.abc import Iterator
from pathlib import Path

import click
import pytest

import catalog
from catalog.pipeline.config import load_build_config
from optnav_cli.frames.folder import read_folder
from optnav_cli.main import cli
from tests.golden import documents
from tests.studies.__main__ import studies

CHECKOUT = Path(__file__).resolve().parents[1]
TEXTS = {
    path.relative_to(CHECKOUT).as_posix(): path.read_text(encoding="utf-8")
    for path in documents.DOCUMENTS
}
README = TEXTS["README.md"]
BLOCK = re.compile(r"^```(\w*)\n(.*?)^```", re.MULTILINE | re.DOTALL)
TEXT = {".py", ".toml", ".md", ".lock", ".csv", ".json", ".geojson", ".txt", ".cfg", ".html", ""}


def commands(
    group: click.Group, words: tuple[str, ...] = ()
) -> Iterator[tuple[str, click.Command]]:
    """Every command below a group with its full words: "catalog nearest"."""
    context = click.Context(group)
    for name in group.list_commands(context):
        command = group.get_command(context, name)
        assert command is not None
        yield " ".join((*words, name)), command
        if isinstance(command, click.Group):
            yield from commands(command, (*words, name))


COMMANDS = dict(commands(cli))
STUDIES = studies.commands


def example_of(words: str, command: click.Command) -> str:
    """What a command's help shows under "Example:" or "Examples:"."""
    text = command.get_help(click.Context(command, info_name=f"optnav {words}"))
    return (re.split(r"Examples?:\n", text)[1:] or [""])[0].partition("\nOptions:")[0]


@pytest.mark.parametrize("words", COMMANDS)
def test_every_command_has_help_with_an_example_of_itself(words: str) -> None:
    example = example_of(words, COMMANDS[words])
    assert f"optnav {words} " in example.replace("\n", " ") + " "


@pytest.mark.parametrize("words", COMMANDS)
def test_every_option_says_what_it_is_for(words: str) -> None:
    for parameter in COMMANDS[words].params:
        if isinstance(parameter, click.Option):
            assert parameter.help, f"optnav {words} {parameter.opts[-1]} has no help"


@pytest.mark.parametrize("words", [w for w in COMMANDS if w not in ("catalog", "config")])
def test_every_command_has_a_line_in_a_readme(words: str) -> None:
    assert any(re.search(rf"optnav {re.escape(words)}\b", text) for text in TEXTS.values())


def test_examples_use_only_options_that_exist() -> None:
    texts = [code for text in TEXTS.values() for _, code in BLOCK.findall(text)]
    texts += [example_of(words, command) for words, command in COMMANDS.items()]
    lines = re.findall(r"^\s*(optnav [^:\n]*)$", "\n".join(texts), re.MULTILINE)
    assert len(lines) > 30
    for line in lines:
        words = shlex.split(line.partition("#")[0])[1:]
        known = {opt for parameter in cli.params for opt in (*parameter.opts, "--help", "-h")}
        group: click.Command = cli
        while words and isinstance(group, click.Group):
            if words[0].startswith("-"):
                assert words[0] in known, f"{line}: there is no {words[0]}"
                takes_value = words[0] == "--log-file"
                words = words[2 if takes_value else 1 :]
                continue
            command = group.get_command(click.Context(group), words[0])
            assert command is not None, f"{line}: there is no command {words[0]!r}"
            group, words = command, words[1:]
        known = {opt for parameter in group.params for opt in parameter.opts}
        for word in words:
            if re.match(r"--?[a-z]", word):
                assert word in known | {"--help", "-h"}, f"{line}: there is no {word}"


def test_the_readme_s_commands_run_one_after_the_other_in_one_folder() -> None:
    """What a command reads is there before, and none writes over another's output."""
    there = {"moon.toml", "pictures", "truth.csv"}  # the reader's own
    lines = re.findall(r"^optnav .* -o .*$|(?<=`)optnav [^`]* -o [^`]*(?=`)", README, re.MULTILINE)
    assert len(lines) > 20
    for line in lines:
        words = shlex.split(line)[1:]
        if "dem.tif" in words or words[-1] == "pictures":
            continue  # other ways to what is there
        command = max((name for name in COMMANDS if line.startswith(f"optnav {name} ")), key=len)
        first = words[len(command.split())]
        options = itertools.pairwise(words)
        read = [word for name, word in options if name in ("--catalog", "--truth")]
        read += [first] if command != "config template" else []
        for name in read:
            assert name.startswith("bundled:") or name.partition("/")[0] in there, line
        output = words[words.index("-o") + 1]
        assert output not in there, line
        there.add(output)


@pytest.mark.parametrize("words", STUDIES)
def test_every_study_has_help_with_an_example_of_itself(words: str) -> None:
    text = STUDIES[words].get_help(click.Context(STUDIES[words], info_name=words))
    assert f"python -m tests.studies {words}" in text.partition("Example:")[2]


def test_makes_of_the_readmes_exist() -> None:
    targets = set(re.findall(r"^([a-z%-]+):", (CHECKOUT / "Makefile").read_text(), re.MULTILINE))
    named = {
        name
        for text in TEXTS.values()
        for name in re.findall(r"(?:`|^)make ([a-z]+(?:-[a-z]+)*)\b(?!-)", text, re.MULTILINE)
    }
    studies = {name for name in named if name.startswith("study-")}
    assert named - studies <= targets
    assert {"demo", "test", "bench", "docs"} <= named
    for name in studies:
        assert name.removeprefix("study-") in STUDIES


def anchors(text: str) -> set[str]:
    """What a link may name within a document: its headings."""
    headings = re.findall(r"^#+ (.*)$", text, re.MULTILINE)
    return {re.sub(r"[^\w -]", "", heading.lower()).replace(" ", "-") for heading in headings}


@pytest.mark.parametrize("name", TEXTS)
def test_pictures_and_files_that_a_readme_names_are_there(name: str) -> None:
    for target, heading in re.findall(r"\]\((?!https?:)([^)#]*)#?([^)]*)\)", TEXTS[name]):
        path = (CHECKOUT / name).parent / target if target else CHECKOUT / name
        assert path.exists(), f"{name} names {target}"
        if heading:
            assert heading in anchors(path.read_text(encoding="utf-8")), f"{target}#{heading}"


@pytest.mark.parametrize("name", TEXTS)
def test_files_of_the_code_that_a_readme_names_are_there(name: str) -> None:
    """As `terrain/dem/source.py`, from the README's own folder or from the top."""
    for target in re.findall(r"`((?:[\w.]+/)+\w+\.py)`", TEXTS[name]):
        places = (CHECKOUT, (CHECKOUT / name).parent)
        assert any((place / target).exists() for place in places), f"{name} names {target}"


def test_the_made_parts_of_the_readmes_are_up_to_date() -> None:
    assert documents.outdated() == [], "run `make docs`"


def test_the_readme_is_short_and_its_files_can_be_used(tmp_path: Path) -> None:
    """Terrain, camera and frames of one's own stand in the first 80 lines, as files that load."""
    assert len(README.encode("utf-8")) <= 14_000
    top = "\n".join(README.splitlines()[:80])
    build, run, camera = (code for kind, code in BLOCK.findall(top) if kind == "toml")
    (frames,) = (code for kind, code in BLOCK.findall(top) if kind == "csv")
    (tmp_path / "cameras").mkdir()
    names = ("moon.toml", "run.toml", "cameras/nav.toml", "frames.csv")
    for file, text in zip(names, (build, run, camera, frames)):
        (tmp_path / file).write_text(text, encoding="utf-8")
    assert load_build_config(tmp_path / "moon.toml").dem[0].path.startswith("bundled:")
    first, second = read_folder(tmp_path).frames
    assert (first.problem, second.problem) == (None, None)
    assert first.position_m is not None
    assert second.position_m is None


def test_the_text_of_the_package_needs_no_other_file() -> None:
    """A package index shows it alone: links in it would lead nowhere."""
    project = tomllib.loads((CHECKOUT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    assert project["readme"]["content-type"] == "text/markdown"
    assert not re.search(r"\]\((?!https?:)", project["readme"]["text"])
    for words in re.findall(r"^optnav (\w+)", project["readme"]["text"], re.MULTILINE):
        assert words in COMMANDS


def files() -> Iterator[Path]:
    """The files of the project: those that git knows, or all when this is not a checkout."""
    try:
        listed = subprocess.run(
            ["git", "ls-files", "-z"], cwd=CHECKOUT, capture_output=True, text=True, check=True
        )
        names = [name for name in listed.stdout.split("\0") if name]
    except (OSError, subprocess.CalledProcessError):
        pytest.skip("needs git to know which files belong to the project")
    yield from (CHECKOUT / name for name in names if (CHECKOUT / name).is_file())


def test_no_file_names_a_place_on_somebodys_machine() -> None:
    # /dev and /etc are everywhere; a temporary folder in a text is a leftover of somebody's session
    place = re.compile(r"(?<![\w.:/~-])/(?:home|root|Users|work|opt|tmp|mnt|srv)/\w")
    found = [
        f"{path.relative_to(CHECKOUT)}:{number}"
        for path in files()
        if path.suffix in TEXT
        for number, line in enumerate(path.read_text(encoding="utf-8").splitlines(), start=1)
        if place.search(line)
    ]
    assert found == []


def test_the_changelog_is_sorted_by_version_and_kind() -> None:
    text = (CHECKOUT / "CHANGELOG.md").read_text(encoding="utf-8")
    versions = re.findall(r"^## (\d+)\.(\d+)\.(\d+)", text, re.MULTILINE)
    assert ".".join(versions[0]) == catalog.__version__
    assert versions == sorted(set(versions), reverse=True)
    for part in text.split("\n## ")[1:]:
        kinds = re.findall(r"^### (.+)$", part, re.MULTILINE)
        assert kinds == [kind for kind in ("Added", "Changed", "Fixed") if kind in kinds]
        assert "\n- " not in part.partition("\n### ")[0]  # each line stands under a kind


def test_the_lock_has_hashes_and_no_addresses() -> None:
    text = (CHECKOUT / "requirements.lock").read_text(encoding="utf-8")
    assert "://" not in text
    assert not re.search(r"^\s*--(?!hash)", text, re.MULTILINE)
    pins = re.findall(r"^[a-z][\w.-]*==", text, re.MULTILINE)
    assert len(pins) > 30
    assert text.count("--hash=sha256:") >= len(pins)


def test_ci_runs_what_the_readme_names() -> None:
    text = (CHECKOUT / ".ci" / "run").read_text(encoding="utf-8")
    assert text.rstrip().endswith("make test")
    assert os.access(CHECKOUT / ".ci" / "run", os.X_OK)
