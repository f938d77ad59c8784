"""What a stopped command leaves: its finished pieces, in a work folder beside the output."""

import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from catalog.errors import DataError
from catalog.files import check_folder
from catalog.jobs.workspace import Workspace
from catalog.places import beside, claimed
from optnav_cli.output.manifest import hash_files, read_manifest

MAX_NAME_BYTES = 255


@contextmanager
def unfinished(output: Path, kind: str) -> Iterator[Workspace]:
    """The work folder OUTPUT.work of an output folder, which no other process writes meanwhile.

    It is gone when the body ends well; a stopped command leaves it, and the next one goes on.
    Raises OutputError for a place where the output cannot be.
    """
    check_folder(output, kind)  # before any work is done for a place that cannot be used
    with claimed(output):
        name = f"{output.name}.work"
        long = len(os.fsencode(name)) > MAX_NAME_BYTES
        workspace = Workspace(beside(output, "work") if long else output.with_name(name))
        with workspace.locked():
            yield workspace
            shutil.rmtree(workspace.folder, ignore_errors=True)


def is_finished(output: Path, key: str) -> bool:
    """Whether an output folder was made by work of this key, and its files are as they were."""
    try:
        manifest = read_manifest(output)
    except DataError:
        return False
    files = manifest.get("outputs_sha256")
    if manifest.get("key") != key or not isinstance(files, dict):
        return False
    return hash_files(output, files) == files
