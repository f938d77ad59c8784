"""`optnav adjust`: the frames of runs in one least squares, with what is common to them."""

from pathlib import Path

import click

from optnav_cli.console import tell
from optnav_cli.options import OptnavCommand, output_option
from optnav_cli.parameters import PATH, Number

SOLVABLE = ("body_rotation", "origin", "scale", "boresight", "focal")


class SolveOption(click.ParamType):  # type: ignore[type-arg] # generic since 8.4 only
    """Names of what is common to frames, with commas between them; "none" for nothing."""

    name = "WHAT,..."

    def convert(
        self, value: object, param: click.Parameter | None, ctx: click.Context | None
    ) -> tuple[str, ...]:
        if isinstance(value, tuple):
            return value
        names = tuple(name.strip() for name in str(value).split(","))
        if names == ("none",):
            return ()
        for name in names:
            if name not in SOLVABLE:
                self.fail(f"{name!r} is none of {', '.join(SOLVABLE)}, or 'none'", param, ctx)
        return names


@click.command(
    "adjust",
    cls=OptnavCommand,
    short_help="Adjust the frames of runs together, and what is common.",
)
@click.argument("runs", nargs=-1, required=True, type=PATH)
@click.option(
    "--solve",
    type=SolveOption(),
    default="body_rotation,origin,scale,boresight",
    show_default=True,
    help="What is common to the frames: rotation of the body frame, origin and scale of the "
    "catalog, boresight and focal length (focal) of each camera; or none.",
)
@click.option(
    "--position-sigma-m",
    type=Number(0.001, 1e9),
    help="What stated positions scatter by, a component, where frames.csv states more: sigmas for "
    "a search hold what all frames have in common, too.",
)
@click.option(
    "--attitude-sigma-arcsec",
    type=Number(1e-3, 648_000.0),
    help="The same of stated attitudes, an axis.",
)
@output_option("Folder for the adjusted run; an earlier one in it is replaced.")
def command(
    runs: tuple[Path, ...], solve: tuple[str, ...], output: Path, **scatter: float | None
) -> None:
    """Adjust all frames of RUNS, which `optnav navigate` solved, in one least squares.

    The positions and attitudes of frames.csv count with their sigmas, matches with what the runs
    state of their positions. Prints what is common to the frames with its sigmas, and names what
    they do not tell apart. OUTPUT gets solution.csv and matches.csv of the adjusted poses,
    common.json and common.csv, and run.toml, the body's file and cameras/ as found: in a picture
    folder they make `optnav navigate` use them.

    \b
    Example:
      optnav adjust run -o adjusted
      optnav adjust run --position-sigma-m 60 --attitude-sigma-arcsec 60 -o adjusted
      optnav adjust run-1 run-2 --solve body_rotation,boresight -o adjusted
    """
    from optnav_cli.estimation.models.common import Common
    from optnav_cli.runs.adjust_runs import LabelScatter, adjust_runs

    kinds = [kind for kind in Common if kind.value in solve]
    found = adjust_runs(runs, output, kinds, LabelScatter(**scatter))
    tell(found.lines())
    click.echo(output)
