"""Which page is wanted, and writing it."""

from pathlib import Path

from catalog.errors import DataError
from catalog.store.reader import Catalog
from optnav_cli.output.replace import replacing_file, starts_with
from optnav_cli.output.report.catalog_page import catalog_page
from optnav_cli.output.report.page import BEGINNING
from optnav_cli.output.report.run_page import run_page


def write_report(source: Path, output: Path) -> None:
    """Write the page about a run folder or a catalog file; an older report there is replaced.

    Raises DataError for a source that is neither, OutputError for a place that cannot be used.
    """
    if source.is_dir():
        text = run_page(source)
    elif source.is_file():
        with Catalog.open(source) as catalog:
            text = catalog_page(catalog)
    else:
        raise DataError(f"{source}: there is no such run or catalog; check the path")
    with replacing_file(output, starts_with(BEGINNING.encode())) as path:
        path.write_text(text, encoding="utf-8")
