"""Kinds of command-line values that click does not have: output places, numbers that are finite."""

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import click

PATH = click.Path(path_type=Path)
POINT_ID = click.IntRange(0, 2**31 - 1)  # a catalog has fewer cells


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
