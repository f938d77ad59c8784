"""A click group that imports a command's module only when that command is called.

`optnav --help` must answer at once, and numba, rasterio and scipy take a second to import.
"""

import difflib
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from importlib import import_module
from typing import Any

import click


@dataclass(frozen=True)
class Entry:
    """Where a command lives: in `module`, named `attribute`; `text` is its short help."""

    module: str
    text: str
    attribute: str = "command"


class LazyGroup(click.Group):
    """A group whose commands come from a table; the table is asked for once, when it is needed."""

    def __init__(
        self, *args: Any, table: Callable[[], Mapping[str, Entry]] = dict, **kwargs: Any
    ) -> None:
        super().__init__(*args, **kwargs)
        self._table = table

    @property
    def table(self) -> Mapping[str, Entry]:
        """The entries by command name, in the order in which help lists them."""
        return self._table()

    def list_commands(self, ctx: click.Context) -> list[str]:
        return [*self.table, *super().list_commands(ctx)]

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        entry = self.table.get(cmd_name)
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
        if near and near[0] != name and not name.startswith("-"):
            ctx.fail(f"there is no command {name!r}; did you mean {near[0]!r}?")
        return super().resolve_command(ctx, args)

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """List the commands from the table alone, without importing one of them."""
        rows = [(name, entry.text) for name, entry in self.table.items()]
        for name in super().list_commands(ctx):
            rows.append((name, self.commands[name].get_short_help_str(limit=200)))
        if rows:
            with formatter.section("Commands"):
                formatter.write_dl(rows)
