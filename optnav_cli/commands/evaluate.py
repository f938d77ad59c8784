"""`optnav evaluate`: a run's positions against the truth."""

from pathlib import Path

import click

from optnav_cli.options import path_argument

LIMIT = click.FloatRange(min=0.0, min_open=True)


@click.command(short_help="Compare a run's positions with the truth.")
@path_argument("run")
@click.option(
    "--truth",
    type=click.Path(path_type=Path),
    required=True,
    help="The truth.csv beside the simulated pictures.",
)
@click.option(
    "--max-horizontal-m", type=LIMIT, help="Exit code 5 if the rms along and across is larger."
)
@click.option("--max-height-m", type=LIMIT, help="Exit code 5 if the rms of the height is larger.")
def command(
    run: Path, truth: Path, max_horizontal_m: float | None, max_height_m: float | None
) -> None:
    """Compare the positions of RUN with the truth.

    Prints a table of errors along the radius (R), the motion (N) and across (B), and writes
    evaluation.json and evaluation.csv into RUN. Ends with exit code 5 when a limit is passed.

    \b
    Example:
      optnav evaluate run --truth pictures/truth.csv --max-horizontal-m 30
    """
    from optnav_cli.evaluation.figures import check_limits
    from optnav_cli.evaluation.files import evaluate_run, format_table, write_evaluation

    evaluation = evaluate_run(run, truth)
    click.echo(format_table(evaluation))
    write_evaluation(evaluation, run)
    check_limits(evaluation.figures(), max_horizontal_m, max_height_m)
