"""`make golden`: the frozen values, the READMEs' pictures and their captions anew.

Look at the difference. The pictures come from the demo, the Apollo study, a fisheye frame over the
demo's ground and the catalog of Phobos, some minutes in all; the curves from their studies, ten
minutes; the flights are made over a catalog of the whole Moon, ten minutes and the large terrain in
the folder OPTNAV_SHARED_DATA. What they leave stands in build/golden. Captions go to
captions.json and from there, with the stored figures of the studies, into the READMEs.
"""

import json
from pathlib import Path

import click

from catalog.arrays import ByteArray
from catalog.config import resource
from optnav_cli.console import ConsoleProgress
from optnav_cli.main import cli
from optnav_cli.navigate.job import navigate_folder
from optnav_cli.navigate.worker import RunInputs
from optnav_cli.simulation.job import simulate_folder
from tests.golden import (
    documents,
    flights,
    orbits,
    picked_stars_cylinder,
    pictures,
    sketch,
    values,
)
from tests.studies import apollo
from tests.studies.__main__ import studies
from tests.studies.stored import FIGURES

HERE = Path(__file__).resolve().parent
README = HERE / "readme"
DEMO_FRAME, APOLLO_FRAME = "frame_0001.png", "AS15-M-0297_SML.png"
CENTRAL_PEAK_DEG = (-43.3, -11.2)
APOLLO_FIGURES = FIGURES / "apollo.json"
HAZARD = (2, 5.0, 200.0)  # seed of the ground, elevation of the Sun, side of squares
CURVES = ("arc", "resection", "matching")  # studies


@click.command(help=__doc__)
@click.option("--values/--no-values", "freeze", default=True, help="Make the frozen values.")
@click.option("--pictures/--no-pictures", "draw", default=True, help="Make the README's pictures.")
@click.option("--curves/--no-curves", "plot", default=True, help="Make the README's curves.")
@click.option("--flights/--no-flights", "flown", default=True, help="Make the flights' pictures.")
@click.option("--designs/--no-designs", "designed", default=True, help="Orbits' pictures.")
@click.option("--fit/--no-fit", "fitted", default=True, help="The picture of an orbit's fit.")
@click.option("--others/--no-others", "others", default=True, help="Points, stars, cylinder.")
@click.option("--hazard/--no-hazard", "landed", default=True, help="Make the hazard map.")
@click.option(
    "--work",
    type=click.Path(path_type=Path),
    default=HERE.parents[1] / "build" / "golden",
    help="Folder for what the pictures are made from.",
)
def main(
    freeze: bool,
    draw: bool,
    plot: bool,
    flown: bool,
    designed: bool,
    fitted: bool,
    others: bool,
    landed: bool,
    work: Path,
) -> None:
    """See the head of this file."""
    if freeze:
        values.freeze()
        click.echo(values.PLACE)
    captions = {}
    work.mkdir(parents=True, exist_ok=True)
    if draw:
        for name, (picture, caption) in _pictures(work).items():
            path, captions[name] = README / f"{name}.png", caption
            sketch.write(picture, path)
            _told(path)
    for name in CURVES if plot else ():
        path = README / f"{name}.svg"
        studies.main([name, "-o", str(path)], standalone_mode=False)
        _told(path)
    if flown:
        moon = flights.moon_catalog(work)
        picture, captions["report"] = flights.usable_map(moon)
        sketch.write(picture, README / "report.jpg")
        _told(README / "report.jpg")
        for path, captions_of in flights.fly(work, moon, README):
            captions[path.stem] = captions_of
            _told(path)
    made = [*(orbits.designs(work, README) if designed else ())]
    made += [orbits.through_fixes(work, README)] if fitted else []
    made += [*(picked_stars_cylinder.drawn(work, README) if others else ())]
    for path, caption in made:
        captions[path.stem] = caption
        _told(path)
    if landed:
        picture, captions["hazard"] = pictures.hazard_map(*HAZARD)
        sketch.write(picture, README / "hazard.png")
        _told(README / "hazard.png")
    if captions:
        known = json.loads(documents.CAPTIONS.read_text(encoding="utf-8")) | captions
        text = json.dumps(known, indent=2, ensure_ascii=False, sort_keys=True)
        documents.CAPTIONS.write_text(text + "\n", encoding="utf-8")
        documents.main()


def _told(path: Path) -> None:
    click.echo(f"{path}  {path.stat().st_size / 1e3:.0f} kB")


def _pictures(work: Path) -> dict[str, tuple[ByteArray, str]]:
    """Pictures with their captions, by name."""
    from optnav_cli.commands.demo import command as demo

    progress = ConsoleProgress()
    place = work / "demo"
    demo.main(["-o", str(place)], standalone_mode=False, obj=progress)
    tycho = place / "tycho.gpkg"
    seen, run = work / "fisheye", work / "fisheye-run"
    simulate_folder(HERE / "fisheye.toml", seen, progress)
    navigate_folder(RunInputs(seen, [tycho]), run, progress)
    result = apollo.run(work / "apollo", progress)
    apollo.report(result).signed("apollo", {"matcher": "ncc"}).write(APOLLO_FIGURES)
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
        "frame": pictures.frame_overlay(
            place / "run", place / "pictures", DEMO_FRAME, tycho, "A simulated frame over Tycho"
        ),
        "apollo": pictures.frame_overlay(
            flown,
            work / "apollo" / "pictures",
            APOLLO_FRAME,
            None,
            "Apollo 15 metric frame AS15-M-0297 of 1971, over the far side of the Moon",
        ),
    }


if __name__ == "__main__":
    main()
