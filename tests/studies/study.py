"""What a study is, and the options that several take."""

from dataclasses import dataclass
from importlib import import_module
from typing import Any

import click

from optnav_cli.options import Number, OutputOption

MANY = 10**6  # pictures, trials: more are a slip of the hand
MAX_SEED = 2**63 - 1
YEAR = Number(1500.0, 2500.0)


@dataclass(frozen=True)
class Study:
    """One experiment behind the figures of the documents.

    question  what it measures, in a line;  text  more of it, for its help
    example   of the command line after the name
    options   of the command; their names are those of the arguments of the module's `run`
    draws     whether -o names a file for a plot
    compiles  whether kernels run that numba may have to compile
    prints    a function of the module whose text goes to stdout instead of the tables
    """

    name: str
    question: str
    text: str
    example: str
    options: tuple[click.Parameter, ...] = ()
    draws: bool = False
    compiles: bool = True
    prints: str = ""

    def function(self, name: str) -> Any:
        """A function of the study's module."""
        return getattr(import_module(f"tests.studies.{self.name}"), name)


def option(names: str, type_: Any, default: Any, text: str, **more: Any) -> click.Option:
    """An option of a study."""
    more |= {"default": default, "show_default": default not in (None, "")}
    return click.Option(names.split(), type=type_, help=text, **more)


def trials(least: int, default: int, text: str) -> click.Option:
    """--trials: how many."""
    return option("--trials", click.IntRange(least, MANY), default, text)


def seed(text: str = "Of trials.") -> click.Option:
    """--seed: of what is drawn."""
    return option("--seed", click.IntRange(0, MAX_SEED), 1, text)


def output(default: str | None, text: str, *endings: str) -> click.Option:
    """-o: a file or folder."""
    names, shown = ("-o", "--output"), default is not None
    return OutputOption(names, endings=endings, default=default, show_default=shown, help=text)
