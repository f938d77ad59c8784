"""`optnav study`: the experiments behind the figures, each a file study_NAME.py beside this one."""

import ast
from collections.abc import Mapping
from functools import cache
from pathlib import Path

import click

from optnav_cli.options import Entry, LazyGroup

PREFIX = "study_"


@cache
def studies() -> Mapping[str, Entry]:
    """The studies that are there; the first line of a file's docstring is its short help.

    The files are parsed, not imported: listing them must not load what they compute with.
    """
    found = {}
    for path in sorted(Path(__file__).parent.glob(f"{PREFIX}*.py")):
        text = ast.get_docstring(ast.parse(path.read_text(encoding="utf-8"))) or path.stem
        name = path.stem.removeprefix(PREFIX).replace("_", "-")
        line = text.splitlines()[0].rpartition("`: ")[2]
        found[name] = Entry(f"optnav_cli.commands.{path.stem}", line[:1].upper() + line[1:])
    return found


@click.group(cls=LazyGroup, table=studies)
def command() -> None:
    """Run one of the experiments behind the figures of the README.

    Studies repeat trials with fixed seeds and take minutes to hours.

    \b
    Example:
      optnav study resection
    """
