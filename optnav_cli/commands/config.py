"""`optnav config`: configurations to start from."""

import click


@click.group()
def command() -> None:
    """Configurations to start from.

    \b
    Example:
      optnav config template build > moon.toml
    """


@command.command(short_help="Print a valid, commented configuration.")
@click.argument("kind", type=click.Choice(["build", "scenario", "navigate"]))
def template(kind: str) -> None:
    """Print a valid, commented configuration with all settings and their defaults.

    KIND is build (a catalog), scenario (pictures to simulate) or navigate.

    \b
    Example:
      optnav config template build > moon.toml
    """
    from catalog.config import resource

    click.echo(resource(f"configs/templates/{kind}.toml").read_text(encoding="utf-8"), nl=False)
