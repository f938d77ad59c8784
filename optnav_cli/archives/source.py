"""What a file of an archive describes: one picture, or the pictures of a list of times."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from catalog.bodies.epochs import utc_to_tdb_s
from catalog.errors import DataError
from optnav_cli.archives.isis_cube import Label, read_cube_label
from optnav_cli.archives.label import ArchiveLabel, detect_format, read_label
from optnav_cli.frames.tables import TIMES


@dataclass(frozen=True, eq=False)
class ImportSource:
    """One picture: the file that describes it, and what was read of it.

    kind   a format of import tables
    label  of FITS and PDS;  cube  the label of an ISIS cube;  utc  of a row in a list of times
    file   the name of the picture, of a row;  where  "FILE, line N" of it
    """

    path: Path
    kind: str
    label: ArchiveLabel | None = None
    cube: Label | None = None
    utc: str = ""
    file: str = ""
    where: str = ""

    def text(self, key: str) -> str:
        """Return the label's value of a keyword, "" where it states none."""
        if self.label is not None:
            try:
                return self.label.text(key)
            except DataError:
                return ""
        if self.cube is not None:
            return str(self.cube.get("IsisCube", {}).get("Instrument", {}).get(key, ""))
        return ""


def read_sources(path: Path) -> Iterator[ImportSource]:
    """Read what a file describes: one picture, or those of a list of times. Raises DataError."""
    if path.suffix.lower() == ".csv":
        for row in TIMES.rows(path):
            yield ImportSource(path, "times", utc=row["utc"], file=row["file"], where=row.where)
        return
    kind = detect_format(path)
    if kind is not None:
        yield ImportSource(path, kind, label=read_label(path, kind))
        return
    try:
        cube = read_cube_label(path)
    except DataError:
        raise DataError(
            f"{path}: no label with a geometry in it; wanted an ISIS cube, a PDS label, a FITS "
            "file, a list of settings, or a .csv with the times of pictures"
        ) from None
    yield ImportSource(path, "isis", cube=cube)


def check_row_time(source: ImportSource) -> None:
    """Refuse a time of a list that is none, by its line and column. Raises DataError."""
    try:
        utc_to_tdb_s(source.utc, "utc")
    except DataError as error:
        raise DataError(f"{source.where}: {error}") from None
