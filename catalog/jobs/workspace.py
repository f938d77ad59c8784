"""The work folder of a build: what is done stays done, whatever happens to the process.

Each stage keeps its results in a folder named after the stage and a key, the hash of all that its
results depend on. Changed settings make another key, so nothing stale is ever read. A result file
appears by rename, complete, or not at all.
"""

import hashlib
import os
import shutil
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import msgspec

from catalog.errors import OutputError
from catalog.files import PARTIAL, locked, put_file
from catalog.jobs.records import DamagedRecordsError, are_whole, decode_records

MARK = "optnav-workspace.json"
LOCK = "lock"
FORMAT = 1
KEY_CHARACTERS = 16


class _Mark(msgspec.Struct):
    made_by: str
    format: int


def stage_key(*parts: Any) -> str:
    """Key of all that a stage's results depend on; parts are anything that msgspec can encode."""
    plain = msgspec.json.encode(msgspec.to_builtins(parts), order="deterministic")
    return hashlib.sha256(plain).hexdigest()[:KEY_CHARACTERS]


class Workspace:
    """A work folder. Raises OutputError when it is another thing or cannot be written."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._made_now = not folder.exists()
        try:
            if folder.exists() and not folder.is_dir():
                raise OutputError(f"{folder}: is a file; name a folder to work in")
            if folder.is_dir() and any(folder.iterdir()) and not (folder / MARK).is_file():
                raise OutputError(
                    f"{folder}: is not empty and not a work folder of optnav; "
                    "name another folder, it is made when missing"
                )
            folder.mkdir(parents=True, exist_ok=True)
            self._settle_format()
        except OSError as error:
            raise _unwritable(folder, error) from None

    def _settle_format(self) -> None:
        mark = self.folder / MARK
        if mark.is_file():
            try:
                found = msgspec.json.decode(mark.read_bytes(), type=_Mark)
            except msgspec.MsgspecError:
                found = _Mark("", 0)
            if found.format == FORMAT:
                return
            raise OutputError(
                f"{self.folder}: was made by another version of optnav (format {found.format}, "
                f"wanted {FORMAT}); remove it or name another work folder"
            )
        self.put(MARK, msgspec.json.encode(_Mark("optnav", FORMAT)))

    @contextmanager
    def locked(self) -> Iterator[None]:
        """Hold the folder for this process. Raises OutputError when another one works in it."""
        path = self.folder / LOCK
        with ExitStack() as held:
            try:
                handle = held.enter_context(locked(path))
            except BlockingIOError:
                owner = path.read_text(encoding="ascii", errors="replace").strip() or "unknown"
                raise OutputError(
                    f"{self.folder}: process {owner} works in it; "
                    "wait for it or name another work folder"
                ) from None
            except OSError as error:
                raise _unwritable(self.folder, error) from None
            os.ftruncate(handle, 0)
            os.pwrite(handle, f"{os.getpid()}\n".encode("ascii"), 0)
            self._clear_remains()
            try:
                yield
            except BaseException:
                self._leave_no_trace()
                raise

    def _clear_remains(self) -> None:
        """Remove what killed processes were writing."""
        for path in self.folder.rglob(f"*{PARTIAL}"):
            if path.is_file():
                path.unlink(missing_ok=True)

    def _leave_no_trace(self) -> None:
        """Remove a folder that this run made and that holds no result: results lie in folders."""
        if self._made_now and not any(path.is_dir() for path in self.folder.iterdir()):
            shutil.rmtree(self.folder, ignore_errors=True)

    def path(self, *names: str) -> Path:
        """A place in the folder."""
        return self.folder.joinpath(*names)

    def put(self, name: str, data: bytes) -> None:
        """Write a file so that it is there whole or not at all, also after a loss of power."""
        try:
            put_file(self.folder / name, data)
        except OSError as error:
            raise _unwritable(self.folder, error) from None

    def get(self, name: str) -> bytes | None:
        """The bytes of a file, None where there is none."""
        try:
            return (self.folder / name).read_bytes()
        except FileNotFoundError:
            return None

    def whole(self, name: str) -> bool:
        """Whether a result file is there, undamaged; a damaged one is removed."""
        data = self.get(name)
        if data is None or are_whole(data):
            return data is not None
        (self.folder / name).unlink(missing_ok=True)
        return False

    def records(self, name: str, type_: type[Any]) -> list[Any] | None:
        """The records of a result file; None, and the file gone, where it is missing or damaged."""
        data = self.get(name)
        if data is None:
            return None
        try:
            return decode_records(data, type_)
        except DamagedRecordsError:
            (self.folder / name).unlink(missing_ok=True)
            return None

    def keep_only(self, stage: str, keys: set[str]) -> None:
        """Remove the folders of a stage with other keys: results of settings that are no more."""
        for path in sorted(self.folder.glob(f"{stage}-*")):
            if path.is_dir() and path.name.removeprefix(f"{stage}-") not in keys:
                shutil.rmtree(path, ignore_errors=True)


def _unwritable(folder: Path, error: OSError) -> OutputError:
    return OutputError(
        f"{folder}: cannot be written ({error.strerror or error}); "
        "free space, change its permissions or name another work folder"
    )
