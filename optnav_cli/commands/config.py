"""`optnav config`: what ships with optnav, and configurations to start from."""

import re
from collections.abc import Iterator
from itertools import takewhile
from pathlib import Path
from typing import NamedTuple

import click

from optnav_cli.options import LazyGroup, json_option, output_option


class ShippedKind(NamedTuple):
    """Files of one kind that ship with optnav.

    files   their places among the resources, as a pattern beside one of them
    name    how a config or command line names one, NAME being the file's own name
    use     what takes it
    """

    files: tuple[str, str]
    name: str
    use: str


KINDS = {
    "cameras": ShippedKind(
        ("configs/cameras/unk.toml", "*.toml"),
        "NAME",
        'a scenario: camera = { name = "NAME" }; a copy goes into cameras/ of a picture folder',
    ),
    "bodies": ShippedKind(
        ("configs/bodies/moon.toml", "*.toml"),
        "NAME",
        'run.toml and scenarios: body = "NAME"; a build config: [body] name = "NAME"; '
        "optnav build dem.tif --body NAME",
    ),
    "scenarios": ShippedKind(
        ("configs/scenarios/demo.toml", "*.toml"),
        "bundled:NAME",
        "optnav simulate bundled:NAME -o pictures",
    ),
    "catalogs": ShippedKind(
        ("configs/catalogs/tycho.toml", "*.toml"),
        "bundled:NAME",
        "optnav build bundled:NAME -o catalog.gpkg",
    ),
    "orbits": ShippedKind(
        ("configs/orbits/qso_55km.toml", "*.toml"),
        "bundled:NAME",
        "optnav orbit KIND bundled:NAME -o FOLDER, KIND being the beginning of the name",
    ),
    "imports": ShippedKind(
        ("configs/imports/near_msi.toml", "*.toml"),
        "NAME",
        "optnav import FILES --table NAME -o pictures, where its labels are not recognised",
    ),
    "data": ShippedKind(
        ("data/phobos_thomas.tab", "*.t[ai][bf]"),
        "bundled:NAME",
        'a build config, as [[dem]] (.tif) or [[mesh]] (.tab): path = "bundled:NAME"; a gravity '
        'field: [forces] field = "bundled:NAME"',
    ),
}


TEMPLATES = (
    "build",
    "scenario",
    "navigate",
    "hazard",
    "calibrate",
    "orbit",
    "qso",
    "landing",
    "delivery",
)
FOLDERS = ("folder", "points")  # examples to begin with, which `template` copies


@click.group(cls=LazyGroup, short_help="What ships with optnav; configurations to start from.")
def command() -> None:
    """What ships with optnav, and configurations to start from.

    \b
    Examples:
      optnav config list
      optnav config template build > moon.toml
    """


@command.command("list", short_help="What ships with optnav, and how it is named.")
@click.argument("kind", type=click.Choice([*KINDS]), required=False)
@json_option
def list_shipped(kind: str | None, as_json: bool) -> None:
    """List the cameras, bodies, scenarios, catalogs, orbits, import tables and data that ship.

    Each with its name, as configs and command lines take it, and what it is. KIND shows one kind.

    \b
    Example:
      optnav config list
      optnav config list cameras
    """
    from optnav_cli.output.wording import align_table, format_json

    shipped = {name: [*_list_files(name)] for name in ([kind] if kind else KINDS)}
    if as_json:
        click.echo(format_json(shipped))
        return
    lines = []
    for name, entries in shipped.items():
        lines += [f"{name}: {KINDS[name].use}"]
        rows = [(f"  {entry['name']}", entry["description"]) for entry in entries]
        lines += [*align_table(rows, left=(0, 1)), ""]
    click.echo("\n".join(lines[:-1]))


@command.command(short_help="Print a commented configuration, or make a picture folder.")
@click.argument(
    "kind",
    type=click.Choice([*TEMPLATES, *FOLDERS]),
)
@output_option("The picture folder; it must not be there, or be empty.", required=False)
def template(kind: str, output: Path | None) -> None:
    """Print a valid, commented configuration with all settings and their defaults.

    KIND is build (a catalog), scenario (pictures to simulate), navigate, hazard, calibrate, orbit,
    qso, landing or delivery; or folder: a picture folder with an example picture, whose files say
    what they hold, which -o names; or points: one with picked points.

    \b
    Example:
      optnav config template build > moon.toml
      optnav config template folder -o pictures
      optnav config template points -o picked
    """
    from catalog.config import resource
    from catalog.errors import UsageError

    if (kind in FOLDERS) != (output is not None):
        wanted = "name it with -o" if kind in FOLDERS else "leave -o out and send it on with >"
        raise UsageError(f"optnav config template {kind}: {wanted}")
    if output is None:
        click.echo(resource(f"configs/templates/{kind}.toml").read_text(encoding="utf-8"), nl=False)
        return
    from optnav_cli.simulation.job import write_template_folder

    write_template_folder(output, kind)
    click.echo(output)


def _list_files(kind: str) -> Iterator[dict[str, str]]:
    """Name, description, use and path of each file of a kind, by name."""
    from catalog.config import resource

    (beside, pattern), name, use = KINDS[kind]
    for path in sorted(resource(beside).parent.glob(pattern)):
        if path.suffix == ".toml":
            stem, description = path.stem, read_first_sentence(path)
            if '"shared:' in path.read_text(encoding="utf-8"):
                description += " Needs OPTNAV_SHARED_DATA."
        else:
            stem, description = path.name, _read_data_description(path)
        yield {
            "name": name.replace("NAME", stem),
            "description": description,
            "use": use.replace("NAME", stem),
            "path": str(path),
        }


def read_first_sentence(path: Path) -> str:
    """Return the description of a config: the first sentence of the comment at its head."""
    lines = path.read_text(encoding="utf-8").splitlines()
    comment = [line.lstrip("# ") for line in takewhile(lambda line: line.startswith("#"), lines)]
    return re.split(r"(?<=\w)\. |: |; ", " ".join(comment))[0].rstrip(".") + "."


def _read_data_description(path: Path) -> str:
    """Return the description of a data file: its line in the README beside it."""
    text = path.with_name("README.md").read_text(encoding="utf-8")
    match = re.search(rf"^\| `{re.escape(path.name)}` \| (.*?) \|", text, re.MULTILINE)
    return match[1] if match else ""
