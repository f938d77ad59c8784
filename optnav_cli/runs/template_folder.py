"""A picture folder to start from: an example picture, and files that say what they hold."""

import shutil
from datetime import UTC, datetime
from pathlib import Path

from catalog.config import resource
from catalog.errors import OutputError
from catalog.files import replacing_folder
from optnav_cli.frames.tables import FRAMES
from optnav_cli.output.manifest import write_manifest

KIND = "folder template"


def write_template_folder(place: Path) -> None:
    """Copy the example folder that ships with optnav; its README lists the columns of frames.csv.

    Raises OutputError for a place that holds anything: somebody may have worked on it.
    """
    if place.is_dir() and any(place.iterdir()):
        raise OutputError(f"{place}: the folder is not empty; name another place")
    started = datetime.now(UTC)
    example = resource("data/picture_folder/run.toml").parent
    with replacing_folder(place, KIND) as new:
        shutil.copytree(example, new, dirs_exist_ok=True, copy_function=shutil.copyfile)
        readme = new / "README.md"
        text = readme.read_text(encoding="utf-8").replace("COLUMNS", FRAMES.markdown())
        readme.write_text(text, encoding="utf-8")
        write_manifest(new, KIND, command="config", options={}, inputs={}, started=started)
