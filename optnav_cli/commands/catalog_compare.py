"""`optnav catalog compare`: what differs between two catalogs."""

from pathlib import Path

import click

from catalog.progress import Progress
from optnav_cli.console import ConsoleProgress, announce_compilation, pass_progress
from optnav_cli.options import output_option, path_argument


@click.command(short_help="What differs between two catalogs.")
@path_argument("first")
@path_argument("second")
@output_option("A table (CSV) of every point that differs.", required=False)
@pass_progress
def command(progress: ConsoleProgress, first: Path, second: Path, output: Path | None) -> None:
    """Compare the content of the catalogs FIRST and SECOND.

    Ends with exit code 0 when both have the same content and with 5 when it differs: in settings,
    points, places, usability, heights or certificates. The greatest differences of each kind are
    printed. Time, program, config and hashes of terrain models are shown, but are no content.

    \b
    Examples:
      optnav catalog compare release.gpkg moon.gpkg
      optnav catalog compare release.gpkg moon.gpkg -o differences.csv
    """
    announce_compilation()
    compare_and_tell(first, second, progress, output)


def compare_and_tell(
    first: Path, second: Path, progress: Progress, table: Path | None = None
) -> None:
    """Print what differs. Raises DifferenceError when the content does."""
    from catalog.errors import DifferenceError
    from catalog.store.compare import compare
    from catalog.store.difference_table import write_table
    from catalog.store.differences import lines, summary

    found = compare(first, second, progress)
    for line in lines(found):
        click.echo(line)
    if table is not None:
        click.echo(f"table: {table}: {write_table(found, table)} points")
    if not found.same:
        raise DifferenceError(f"{second}: differs from {first}: {summary(found)}")
    click.echo("content: the same")


def require_reference(reference: Path, output: Path) -> None:
    """Refuse a catalog to compare with that is damaged, or is the one to be written."""
    from catalog.errors import UsageError
    from catalog.store.compare import require_whole

    require_whole(reference)
    if output.exists() and output.samefile(reference):
        raise UsageError(
            f"--check {reference}: is the catalog that -o replaces; write the new one to another "
            "place, or keep a copy of the old one"
        )
