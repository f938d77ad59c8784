"""`make golden`: the frozen values and the README's pictures made anew. Look at the difference.

The pictures come from the demo, the Apollo study, a fisheye frame over the demo's ground and the
catalog of Phobos, some minutes in all; what they leave stands in build/golden. The curves come from
their studies, ten minutes in all.
"""

from pathlib import Path

import click

from catalog.arrays import ByteArray
from catalog.config import resource
from optnav_cli.console import ConsoleProgress
from optnav_cli.main import cli
from optnav_cli.runs.frame_worker import RunInputs
from optnav_cli.runs.navigate_folder import navigate_folder
from optnav_cli.runs.simulate_folder import simulate_folder
from optnav_cli.studies import apollo
from tests.golden import pictures, sketch, values

HERE = Path(__file__).resolve().parent
README = HERE / "readme"
DEMO_FRAME, APOLLO_FRAME = "frame_0001.png", "AS15-M-0297_SML.png"
CENTRAL_PEAK_DEG = (-43.3, -11.2)
CURVES = ("arc", "resection", "matching")  # studies


@click.command(help=__doc__)
@click.option("--values/--no-values", "freeze", default=True, help="Make the frozen values.")
@click.option("--pictures/--no-pictures", "draw", default=True, help="Make the README's pictures.")
@click.option("--curves/--no-curves", "plot", default=True, help="Make the README's curves.")
@click.option(
    "--work",
    type=click.Path(path_type=Path),
    default=HERE.parents[1] / "build" / "golden",
    help="Folder for what the pictures are made from.",
)
def main(freeze: bool, draw: bool, plot: bool, work: Path) -> None:
    """See the head of this file."""
    if freeze:
        values.freeze()
        click.echo(values.PLACE)
    if draw:
        for name, picture in _pictures(work).items():
            path = README / f"{name}.png"
            sketch.write(picture, path)
            click.echo(f"{path}  {path.stat().st_size / 1e3:.0f} kB")
    for name in CURVES if plot else ():
        path = README / f"{name}.svg"
        cli.main(["study", name, "-o", str(path)], standalone_mode=False)
        click.echo(f"{path}  {path.stat().st_size / 1e3:.0f} kB")


def _pictures(work: Path) -> dict[str, ByteArray]:
    from optnav_cli.commands.demo import command as demo

    progress = ConsoleProgress()
    place = work / "demo"
    demo.main(["-o", str(place)], standalone_mode=False, obj=progress)
    tycho = place / "tycho.gpkg"
    seen, run = work / "fisheye", work / "fisheye-run"
    simulate_folder(HERE / "fisheye.toml", seen, progress)
    navigate_folder(RunInputs(seen, [tycho]), run, progress)
    apollo.run(work / "apollo", progress)
    flown = work / "apollo" / "run-ncc"
    config = resource("configs/catalogs/tycho.toml")
    phobos = work / "phobos.gpkg"
    build = ["build", str(resource("configs/catalogs/phobos.toml")), "-o", str(phobos)]
    cli.main(build, standalone_mode=False)
    return {
        "opening": pictures.opening(run, seen, tycho),
        "catalog": pictures.catalog_map(tycho, config, work),
        "phobos": pictures.body_sides(phobos),
        "point": pictures.point_levels(tycho, *CENTRAL_PEAK_DEG),
        "frame": pictures.frame_overlay(place / "run", place / "pictures", DEMO_FRAME, tycho),
        "apollo": pictures.frame_overlay(flown, work / "apollo" / "pictures", APOLLO_FRAME, None),
    }


if __name__ == "__main__":
    main()
