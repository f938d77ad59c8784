"""`optnav study photometry`: what a simple brightness law costs against Hapke's, by emission."""

import click

from optnav_cli.console import ConsoleProgress, pass_progress


@click.command(short_help="What a simple brightness law costs against Hapke's.")
@pass_progress
def command(progress: ConsoleProgress) -> None:
    """Draw real ground by Hapke's law and by the simple ones, and compare what a matcher sees.

    Shows, by emission angle, the correlation of the pictures and how far the law alone moves the
    peak of a template.

    \b
    Example:
      optnav study photometry
    """
    from optnav_cli.studies.photometry import format_table, run

    click.echo(format_table(run(progress)))
