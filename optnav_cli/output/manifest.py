"""manifest.json: what an output was made from, by which versions; the mark of optnav's outputs.

And what a stopped command leaves: its finished pieces, in a work folder beside the output.
"""

import importlib.metadata
import json
import os
import platform
import shutil
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from datetime import UTC, datetime
from functools import cache
from pathlib import Path
from typing import Any

from catalog.errors import DataError, NothingToDoError
from catalog.files import (
    MADE_BY,
    MANIFEST,
    MAX_MANIFEST_BYTES,
    check_folder,
    hash_file,
    replace_folder,
    write_work_file,
)
from catalog.inputs import read_input
from catalog.jobs.workspace import LIBRARIES as OF_THE_CATALOG
from catalog.jobs.workspace import Workspace
from catalog.places import check_apart, hidden_sibling, lock_output
from catalog.progress import log_stage

FORMAT = 1
LIBRARIES = (*OF_THE_CATALOG, "msgspec", "mcap", "pyerfa")
MAX_NAME_BYTES = 255


def hash_files(folder: Path, names: Iterable[str]) -> dict[str, str | None]:
    """SHA-256 of each named file of a folder, None for one that cannot be read, in name order."""
    hashes: dict[str, str | None] = {}
    for name in sorted(set(names)):
        try:
            path = folder / name
            hashes[name] = hash_file(path) if path.is_file() else None
        except (DataError, OSError, ValueError):  # ValueError: a name that no file can have
            hashes[name] = None
    return hashes


def list_versions() -> dict[str, str]:
    """List versions of optnav, of Python and of the libraries that its numbers depend on."""
    versions_by_name = {"optnav": _read_version("optnav"), "python": platform.python_version()}
    versions_by_name.update({name: _read_version(name) for name in LIBRARIES})
    return versions_by_name


def write_manifest(
    folder: Path,
    kind: str,
    *,
    command: str,
    options: Mapping[str, Any],
    inputs: Mapping[str, Any],
    started: datetime,
    results: Mapping[str, Any] | None = None,
    key: str = "",
) -> None:
    """Write folder/manifest.json; the same but for its two times when the inputs are the same.

    kind     "run" or "pictures": what the folder is
    command  the subcommand's name; options its settings, as plain JSON values or paths
    inputs   what went in: paths with hashes and digests, as the command collected them
    started  when the command began, with its time zone
    results  a few figures of the outcome
    key      hash of all that the output depends on; with it the manifest lists the files
    """
    manifest = {
        "made_by": MADE_BY,
        "kind": kind,
        "format": FORMAT,
        "command": command,
        "options": dict(options),
        "inputs": dict(inputs),
        "results": dict(results or {}),
        "versions": list_versions(),
        "started_utc": _format_utc(started),
        "finished_utc": _format_utc(datetime.now(UTC)),
    }
    if key:
        paths = (path for path in folder.rglob("*") if path.is_file())
        names = [path.relative_to(folder).as_posix() for path in paths]
        manifest |= {"key": key, "outputs_sha256": hash_files(folder, names)}
    text = json.dumps(
        manifest, indent=2, ensure_ascii=False, allow_nan=False, default=_convert_plain
    )
    # not every name of a file is text: what is none is written as "?"
    write_work_file(folder / MANIFEST, f"{text}\n".encode("utf-8", "replace"))


@dataclass
class OutputFolder:
    """An output folder while it is filled: `path`, and what its manifest will say.

    options  settings of the command, plain JSON values or paths
    inputs   what went in: paths with hashes and digests;  results  a few figures of the outcome
    failure  why the folder, though written, answers nothing; raised once it is in place
    """

    path: Path
    options: dict[str, Any] = field(default_factory=dict)
    inputs: dict[str, Any] = field(default_factory=dict)
    results: dict[str, Any] = field(default_factory=dict)
    failure: str = ""


@contextmanager
def output_folder(
    output: Path, kind: str, command: str, sources: Iterable[Path], stage: str
) -> Iterator[OutputFolder]:
    """Give an output folder to fill; it takes its place, with its manifest, when all went well.

    output   where it shall be: free, empty, or an older output of this kind, which it replaces
    sources  files and folders that are read: the output must not replace them
    stage    the name of the work in the log
    Raises OutputError for a place that cannot be used, NothingToDoError with `failure`.
    """
    started = datetime.now(UTC)
    check_apart(output, sources)
    with log_stage(stage), replace_folder(output, kind) as path:
        out = OutputFolder(path)
        yield out
        write_manifest(
            path,
            kind,
            command=command,
            options=out.options,
            inputs=out.inputs,
            started=started,
            results=out.results,
        )
    if out.failure:
        raise NothingToDoError(out.failure)


def read_manifest(folder: Path) -> dict[str, Any]:
    """Read the manifest of an output. Raises DataError when there is none or it is damaged."""
    path = folder / MANIFEST
    data = read_input(path, "manifest", "name an output of optnav", limit=MAX_MANIFEST_BYTES)
    try:
        manifest = json.loads(data)
    except (ValueError, RecursionError) as error:
        raise DataError(f"{path}: is damaged ({error}); make the output again") from error
    if not isinstance(manifest, dict) or manifest.get("made_by") != MADE_BY:
        raise DataError(f"{path}: was not written by optnav; name an output of optnav")
    return manifest


@cache  # finding it takes 1 ms a library
def _read_version(name: str) -> str:
    try:
        return importlib.metadata.version(name)
    except importlib.metadata.PackageNotFoundError:
        return "not installed"


def _format_utc(time: datetime) -> str:
    return time.astimezone(UTC).strftime("%Y-%m-%dT%H:%M:%SZ")


def _convert_plain(value: object) -> object:
    if isinstance(value, Path):
        return str(value)
    raise TypeError(f"{value!r} has no place in a manifest")


@contextmanager
def open_workspace(output: Path, kind: str) -> Iterator[Workspace]:
    """Open the work folder OUTPUT.work of an output folder, locked against other processes.

    It is gone when the body ends well; a stopped command leaves it, and the next one goes on.
    Raises OutputError for a place where the output cannot be.
    """
    check_folder(output, kind)  # before any work is done for a place that cannot be used
    with lock_output(output):
        name = f"{output.name}.work"
        long = len(os.fsencode(name)) > MAX_NAME_BYTES
        workspace = Workspace(hidden_sibling(output, "work") if long else output.with_name(name))
        with workspace.lock():
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
