"""Run parts of the behaviour test (all by default) and print what differs from the reference.

With --freeze the results become the reference instead: for a change of behaviour that is meant.
"""

import shutil
import sys
import tempfile
import time
from pathlib import Path

import click

from tests.golden.behaviour.parts import (
    HERE,
    MERGED_ITERATIONS,
    PARTS,
    Tolerance,
    carry_out,
    differences,
)


@click.command(help=__doc__)
@click.argument("parts", nargs=-1, type=click.Choice(list(PARTS)))
@click.option("--freeze", is_flag=True, help="Make the results the reference.")
@click.option("--merged", is_flag=True, help="Allow 1 mm, for where two iterations became one.")
def main(parts: tuple[str, ...], freeze: bool, merged: bool) -> None:
    """See the head of this file."""
    failed = False
    for name in parts or PARTS:
        started = time.monotonic()
        with tempfile.TemporaryDirectory() as folder:
            carry_out(name, Path(folder))
            result = Path(folder) / "result"
            if freeze:
                shutil.copytree(result, HERE / name, dirs_exist_ok=True)
                lines = []
            else:
                tolerance = MERGED_ITERATIONS if merged else Tolerance()
                lines = differences(HERE / name, result, tolerance)
        failed |= bool(lines)
        word = "frozen" if freeze else f"{len(lines)} differences"
        click.echo(f"{name}: {word}, {time.monotonic() - started:.0f} s")
        for line in lines:
            click.echo(f"  {line}")
    sys.exit(5 if failed else 0)


if __name__ == "__main__":
    main()
