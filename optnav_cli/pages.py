"""Which page is wanted, and writing it."""

from pathlib import Path

from catalog.errors import DataError
from catalog.files import check_file, is_made_by_optnav, make_prefix_test, replace_file
from catalog.progress import log_stage
from catalog.store.reader import Catalog
from optnav_cli.calibration.page import build_calibration_page, is_calibration
from optnav_cli.cylinder.page import CYLINDER_KIND, build_cylinder_page, draw_cylinder_sheet
from optnav_cli.hazard.page import make_hazard_page
from optnav_cli.hazard.settings import KIND as HAZARD
from optnav_cli.navigate.page import make_run_page
from optnav_cli.orbit.delivery.page import delivery_page, delivery_sheet
from optnav_cli.orbit.delivery.settings import DELIVERY_KIND
from optnav_cli.orbit.fit.page import orbit_page, orbit_sheet
from optnav_cli.orbit.fit.settings import KIND as ORBIT
from optnav_cli.orbit.landing.page import landing_page, landing_sheet
from optnav_cli.orbit.landing.settings import LANDING_KIND
from optnav_cli.orbit.qso.page import qso_page, qso_sheet
from optnav_cli.orbit.qso.settings import QSO_KIND
from optnav_cli.output.run_folder import read_run
from optnav_cli.points.plots import draw_picked_sheet, is_picked
from optnav_cli.report import page, sheet
from optnav_cli.report.catalog_page import build_catalog_page
from optnav_cli.report.error_plots import draw_error_sheet
from optnav_cli.stars.page import STARS_KIND, build_stars_page

# Pages and pictures of output folders, by the kind that their manifest states.
PAGES = {
    CYLINDER_KIND: build_cylinder_page,
    HAZARD: make_hazard_page,
    ORBIT: orbit_page,
    QSO_KIND: qso_page,
    LANDING_KIND: landing_page,
    DELIVERY_KIND: delivery_page,
    STARS_KIND: build_stars_page,
}
SHEETS = {
    CYLINDER_KIND: draw_cylinder_sheet,
    ORBIT: orbit_sheet,
    QSO_KIND: qso_sheet,
    LANDING_KIND: landing_sheet,
    DELIVERY_KIND: delivery_sheet,
}


def write_report(source: Path, output: Path) -> None:
    """Write the page about a run, hazard, calibration or orbit folder or a catalog.

    An older report there is replaced.

    An output that ends in .svg gets the errors of a run, or the first orbit, as a picture.
    Raises DataError for a source that is neither, OutputError for a place that cannot be used.
    """
    with log_stage("report"):
        _write(source, output)


def _write(source: Path, output: Path) -> None:
    svg = output.suffix.lower() == ".svg"
    check_file(output, make_prefix_test((sheet.BEGINNING if svg else page.BEGINNING).encode()))
    if svg:
        if not source.is_dir():
            raise DataError(
                f"{source}: only the errors of a run are drawn as SVG, and orbits; name an .html "
                "file"
            )
        for kind, draw in SHEETS.items():
            if is_made_by_optnav(source, kind):
                sheet.write_sheet(draw(source), output)
                return
        run = read_run(source)
        if not any(solution.solved for solution in run.solutions):
            raise DataError(f"{source}: no frame is solved, so there is nothing to draw")
        draw_run = draw_picked_sheet if is_picked(run) else draw_error_sheet
        sheet.write_sheet(draw_run(run), output)
        return
    if source.is_dir():
        made = (draw for kind, draw in PAGES.items() if is_made_by_optnav(source, kind))
        text = next(made, build_calibration_page if is_calibration(source) else make_run_page)(
            source
        )
    elif source.is_file():
        with Catalog.open(source) as catalog:
            text = build_catalog_page(catalog)
    else:
        raise DataError(f"{source}: there is no such run or catalog; check the path")
    with replace_file(output, make_prefix_test(page.BEGINNING.encode())) as path:
        path.write_text(text, encoding="utf-8")
