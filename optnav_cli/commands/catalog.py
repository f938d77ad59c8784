"""`optnav catalog`: look at, compare, verify and export a catalog."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from catalog.errors import DataError
from catalog.progress import Progress
from optnav_cli.console import ConsoleProgress, pass_progress, report_compilation
from optnav_cli.options import (
    POINT_ID,
    LazyGroup,
    NumberArguments,
    json_option,
    latitude,
    longitude,
    output_option,
    path_argument,
)

if TYPE_CHECKING:
    from catalog.store.verify import Verification


@click.group(cls=LazyGroup, short_help="Look at, compare, verify, export.")
def command() -> None:
    """Look at, compare, verify and export a catalog.

    \b
    Examples:
      optnav catalog info tycho.gpkg
      optnav catalog nearest tycho.gpkg -43.3 -11.2
    """


def print_answer(document: Mapping[str, Any], lines: Mapping[str, str], as_json: bool) -> None:
    """Print a document for programs, or its lines for people."""
    from optnav_cli.output.wording import format_json

    words = "\n".join(f"{key}: {value}" for key, value in lines.items())
    click.echo(format_json(document) if as_json else words)


@command.command("info", short_help="What a catalog holds.")
@path_argument("catalog")
@json_option
def print_info(catalog: Path, as_json: bool) -> None:
    """Print what CATALOG holds, a `key: value` a line, its content digest among them.

    The digest is the one that the catalog states; `optnav catalog verify` tells whether it is true.

    \b
    Example:
      optnav catalog info tycho.gpkg
      optnav catalog info tycho.gpkg --json
    """
    from catalog.inspect.summary import catalog_document, describe
    from catalog.store.reader import Catalog

    with Catalog.open(catalog) as opened:
        document = catalog_document(opened)
    print_answer(document, describe(document), as_json)


@command.command("nearest", cls=NumberArguments, short_help="The control point nearest to a place.")
@path_argument("catalog")
@click.argument("lat", type=float, callback=latitude)
@click.argument("lon", type=float, callback=longitude)
@click.option("--usable", is_flag=True, help="Only points that navigation uses.")
@click.option(
    "--count", type=click.IntRange(1, 10**6), default=1, show_default=True, help="How many points."
)
@json_option
def print_nearest(
    catalog: Path, lat: float, lon: float, usable: bool, count: int, as_json: bool
) -> None:
    """Print the control point of CATALOG nearest to LAT LON (degrees, east positive).

    With it come its distance along the surface and its azimuth there, from north by east. A note
    says so when the catalog does not cover the place. With --count more points, a line each.

    \b
    Example:
      optnav catalog nearest tycho.gpkg -43.3 -11.2
      optnav catalog nearest tycho.gpkg -43.3 -11.2 --usable --count 5
    """
    from catalog.inspect.summary import (
        describe_point,
        find_nearest_points,
        is_covered,
        point_document,
    )
    from catalog.store.reader import Catalog
    from optnav_cli.output.wording import format_json, format_length

    with Catalog.open(catalog) as opened:
        near_points = find_nearest_points(opened, lat, lon, count, usable)
        covered, cell_deg = is_covered(opened, near_points[0]), opened.meta.cell_deg
    documents = [
        point_document(near.point)
        | {"distance_m": near.distance_m, "azimuth_deg": near.azimuth_deg}
        for near in near_points
    ]
    if as_json:
        query = {"catalog": catalog, "lat_deg": lat, "lon_deg": lon, "covered": covered}
        click.echo(format_json(query | {"points": documents}))
        return
    if count == 1:
        (near,) = near_points
        distance = {"distance_km": f"{near.distance_m / 1e3:.3f}"}
        words = describe_point(documents[0]) | distance | {"azimuth_deg": f"{near.azimuth_deg:.1f}"}
        lines = [f"{key}: {value}" for key, value in words.items()]
    else:
        lines = _format_near_points(documents)
    if not covered:
        which = "usable point" if usable else "point"
        lines.append(
            f"note: the catalog does not cover this place: its nearest {which} is "
            f"{format_length(near_points[0].distance_m)} away, its cells are {cell_deg:g} deg wide"
        )
    click.echo("\n".join(lines))


def _format_near_points(documents: Sequence[Mapping[str, Any]]) -> list[str]:
    """A table of points near a place, the nearest first."""
    from optnav_cli.output.wording import align_table, choose_length_unit

    unit = choose_length_unit(documents[-1]["distance_m"])
    distance = f"distance, {unit.name}"
    rows = [("id", "lat_deg", "lon_deg", distance, "azimuth_deg", "usable", "reasons")]
    for point in documents:
        cells = f"{point['lat_deg']:.5f}", f"{point['lon_deg']:.5f}", unit.text(point["distance_m"])
        use = "yes" if point["usable"] else "no"
        reasons = ", ".join(point["reasons"])
        rows.append((str(point["id"]), *cells, f"{point['azimuth_deg']:.1f}", use, reasons))
    return align_table(rows, left=(5, 6))


@command.command(
    "show", cls=NumberArguments, short_help="A picture of a control point, or of a small body."
)
@path_argument("catalog")
@click.argument("point_id", metavar="[ID]", type=POINT_ID, required=False)
@output_option(
    "The picture (PNG); CATALOG-ID.png or CATALOG.png in this folder by default.",
    (".png",),
    required=False,
)
@json_option
def show_point(catalog: Path, point_id: int | None, output: Path | None, as_json: bool) -> None:
    """Print what CATALOG says about control point ID and draw its levels.

    In the picture: heights by colour with relief shading, and below them the brightness by Hapke
    with cast shadows, finest level left.

    Without an ID a small body whose shape the catalog carries is drawn from its six sides, with
    all points, usable or why not.

    \b
    Example:
      optnav catalog show tycho.gpkg 6420 -o point.png
      optnav catalog show phobos.gpkg -o phobos.png
    """
    from catalog.inspect.draw import check_png_place, draw_pyramid, write_png
    from catalog.inspect.summary import describe_point, point_document
    from catalog.photometry.laws import find_law
    from catalog.store.reader import Catalog

    report_compilation()
    path = output or Path(f"{catalog.stem}{'' if point_id is None else f'-{point_id}'}.png")
    check_png_place(path)
    document: dict[str, Any] = {}
    with Catalog.open(catalog) as opened:
        if point_id is None:
            from optnav_cli.report.body_sides import draw_sides_picture

            write_png(draw_sides_picture(opened), path)
        else:
            pyramid = opened.pyramid(point_id)
            document = point_document(pyramid.point)
            law = find_law("hapke", opened.meta.ground.surface)
            write_png(draw_pyramid(pyramid, opened.meta.map_radius_m, law), path)
    picture = {"picture": str(path)}
    lines = describe_point(document) if document else {}
    print_answer({"catalog": str(catalog)} | document | picture, lines | picture, as_json)


@command.command("compare", short_help="What differs between two catalogs.")
@path_argument("first")
@path_argument("second")
@output_option("A table (CSV) of every point that differs.", (".csv", ""), required=False)
@json_option
@pass_progress
def compare_catalogs(
    progress: ConsoleProgress, first: Path, second: Path, output: Path | None, as_json: bool
) -> None:
    """Compare the content of the catalogs FIRST and SECOND.

    Ends with exit code 0 when both have the same content and with 5 when it differs: in settings,
    points, places, usability, heights or certificates. The greatest differences of each kind are
    printed. Time, program, config and hashes of terrain models are shown, but are no content.

    \b
    Examples:
      optnav catalog compare release.gpkg moon.gpkg
      optnav catalog compare release.gpkg moon.gpkg -o differences.csv
    """
    report_compilation()
    report_comparison(first, second, progress, output, as_json)


def report_comparison(
    first: Path, second: Path, progress: Progress, table: Path | None = None, as_json: bool = False
) -> None:
    """Print what differs. Raises DifferenceError when the content does."""
    from catalog.errors import DifferenceError
    from catalog.files import check_file
    from catalog.inspect import differences
    from catalog.inspect.compare import compare
    from optnav_cli.output.wording import format_json

    if table is not None:
        check_file(table, differences.is_table)
    comparison = compare(first, second, progress)
    more = (
        []
        if table is None
        else [f"table: {table}: {differences.write_table(comparison, table)} points"]
    )
    more += ["content: the same"] if comparison.same else []
    if as_json:
        click.echo(format_json(differences.comparison_document(comparison)))
    else:
        click.echo("\n".join([*differences.format_lines(comparison), *more]))
    if not comparison.same:
        raise DifferenceError(
            f"{second}: differs from {first}: {differences.summarise(comparison)}"
        )


def require_reference(reference: Path, output: Path) -> None:
    """Refuse a catalog to compare with that is damaged, or is the one to be written."""
    from catalog.errors import UsageError
    from catalog.inspect.compare import require_whole

    require_whole(reference)
    if output.exists() and output.samefile(reference):
        raise UsageError(
            f"--check {reference}: is the catalog that -o replaces; write the new one to another "
            "place, or keep a copy of the old one"
        )


SHOWN = 50


@command.command("verify", short_help="Read everything and check every checksum.")
@path_argument("catalog")
@json_option
@pass_progress
def verify_catalog(progress: ConsoleProgress, catalog: Path, as_json: bool) -> None:
    """Read all of CATALOG, check every checksum and compute its content digest anew.

    Prints what is damaged, by table, point and level, and ends with exit code 3 if anything is. A
    catalog that a GIS program wrote its styles to is whole as long as its own content is.

    \b
    Example:
      optnav catalog verify tycho.gpkg
      optnav catalog verify tycho.gpkg --json
    """
    from catalog.inspect.summary import verification_document
    from catalog.store.verify import Verification, verify
    from optnav_cli.output.wording import format_json

    report_compilation()
    try:
        verification = verify(catalog, progress)
    except DataError as error:
        if as_json:  # a document whatever the file is
            verification = Verification(catalog)
            verification.add("file", error)
            click.echo(format_json(verification_document(verification)))
        raise
    if as_json:
        click.echo(format_json(verification_document(verification)))
    else:
        click.echo("\n".join(_format_verification(verification)))
    if not verification.sound:
        raise DataError(
            f"{catalog}: is damaged ({len(verification.problems)} findings); restore it or build "
            "it again"
        )


def _format_verification(verification: "Verification") -> list[str]:
    lines = [f"damaged: {problem}" for problem in verification.problems[:SHOWN]]
    if len(verification.problems) > SHOWN:
        lines.append(f"damaged: and {len(verification.problems) - SHOWN} more")
    lines += [f"points: {verification.points}", f"patches: {verification.patches}"]
    lines.append(f"digest: {verification.computed or 'unknown'}")
    return lines if verification.seal is None else [*lines, f"file: {verification.seal.value}"]


@command.command(
    "export", short_help="Write the points or the relief as a layer, a patch as a raster or solid."
)
@path_argument("catalog")
@output_option(
    "The layer: a name ending in .geojson, .csv or .gpkg; .tif for the relief; with --point, .tif, "
    ".obj or .glb for a patch.",
    (".geojson", ".json", ".csv", ".gpkg", ".tif", ".tiff", ".obj", ".glb"),
)
@click.option("--point", "point_id", type=POINT_ID, metavar="ID", help="The point of the patch.")
@click.option(
    "--level",
    type=click.IntRange(0, 64),
    default=0,
    show_default=True,
    help="The patch's level, 0 the finest.",
)
def export_catalog(catalog: Path, output: Path, point_id: int | None, level: int) -> None:
    """Write the points of CATALOG with their attributes as a layer, on the body's own sphere.

    A CSV gets a .prj and a .csvt file beside it, so that GIS programs know places and types.
    A .tif gets the relief of the whole body that CATALOG carries: its mean heights and its tops.

    With --point, a .tif gets the heights of a patch in its own map projection, a pixel a node, and
    a .obj or .glb its ground as a closed solid, metres from the point.

    \b
    Example:
      optnav catalog export tycho.gpkg -o points.geojson
      optnav catalog export tycho.gpkg -o relief.tif
      optnav catalog export tycho.gpkg --point 6420 -o patch.tif
      optnav catalog export tycho.gpkg --point 6420 --level 2 -o patch.glb
    """
    from catalog.errors import UsageError
    from catalog.inspect import export as layers
    from catalog.store.reader import Catalog

    ending = output.suffix.lower()
    if point_id is not None and ending not in (*layers.RASTER_ENDINGS, *layers.PATCH_ENDINGS):
        raise UsageError(
            f"{output}: a patch of --point is written as .tif, .obj or .glb; choose one of these "
            "endings, or leave --point out for a layer of all points"
        )
    with Catalog.open(catalog) as opened:
        if ending in layers.RASTER_ENDINGS and point_id is not None:
            side = layers.export_patch_heights(opened, point_id, level, output)
            click.echo(f"{output}: {side} x {side} nodes")
        elif ending in layers.RASTER_ENDINGS:
            rows = layers.export_relief(opened, output)
            click.echo(f"{output}: {rows} x {2 * rows} cells")
        elif ending in layers.PATCH_ENDINGS:
            if point_id is None:
                raise UsageError(f"{output}: a solid is of one patch; name its point with --point")
            triangles = layers.export_patch(opened, point_id, level, output)
            click.echo(f"{output}: {triangles} triangles")
        else:
            click.echo(f"{output}: {layers.export(opened, output)} points")
