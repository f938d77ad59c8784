"""The work folder of a build: what is done stays done, whatever happens to the process.

Each stage keeps its results in a folder named after the stage and a key, the hash of all that its
results depend on. Changed settings make another key, so nothing stale is ever read. A result file
appears by rename, complete, or not at all. It holds records: msgpack with numpy arrays, compressed
and guarded by a checksum. The work of a stage is cut into chunks, each with a result file.
"""

import hashlib
import multiprocessing
import os
import platform
import shutil
import socket
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from functools import cache, partial
from importlib.metadata import PackageNotFoundError, version
from importlib.resources import files
from pathlib import Path
from typing import Annotated, Any, TypeVar, get_origin

import msgspec
import numpy as np
import zstandard
from scipy.spatial.transform import Rotation

import catalog
from catalog.errors import DataError, OutputError
from catalog.files import PARTIAL, PIECE, decode_stored_json, hash_file, write_work_file
from catalog.jobs.usage import StageAccount, Usage, measure_usage
from catalog.jobs.workers import Workers
from catalog.places import lock_file
from catalog.progress import Progress, Stage

T = TypeVar("T")
Sha256 = Annotated[str, msgspec.Meta(pattern="^[0-9a-f]{64}$")]

MARK = "optnav-workspace.json"
LOCK = "lock"
HASHES = "dem-hashes.json"
FORMAT = 1
KEY_CHARACTERS = 16
MAGIC = b"optnav1\n"
HASH_BYTES = 16
# Another version of one of these may round or choose otherwise.
LIBRARIES = (
    "numpy",
    "scipy",
    "numba",
    "opencv-python-headless",
    "rasterio",
    "pyproj",
    "zstandard",
    "trimesh",
    "manifold3d",
    "embreex",
)


class DamagedRecordsError(ValueError):
    """Bytes that were cut short or changed."""


class _Mark(msgspec.Struct):
    made_by: str
    format: int


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
            raise _make_write_error(folder, error) from None

    def _settle_format(self) -> None:
        mark = self.folder / MARK
        if mark.is_file():
            stored = decode_stored_json(mark.read_bytes(), _Mark) or _Mark("", 0)
            if stored.format == FORMAT:
                return
            raise OutputError(
                f"{self.folder}: was made by another version of optnav (format {stored.format}, "
                f"wanted {FORMAT}); remove it or name another work folder"
            )
        self.put(MARK, msgspec.json.encode(_Mark("optnav", FORMAT)))

    @contextmanager
    def lock(self) -> Iterator[None]:
        """Hold the folder for this process. Raises OutputError when another one works in it."""
        path = self.folder / LOCK
        with ExitStack() as held:
            try:
                handle = held.enter_context(lock_file(path))
            except BlockingIOError:
                owner = path.read_text(encoding="ascii", errors="replace").strip() or "unknown"
                raise OutputError(
                    f"{self.folder}: process {owner} works in it; "
                    "wait for it or name another work folder"
                ) from None
            except OSError as error:
                raise _make_write_error(self.folder, error) from None
            os.ftruncate(handle, 0)
            os.pwrite(handle, f"{os.getpid()}\n".encode("ascii"), 0)
            for remains in self.folder.rglob(f"*{PARTIAL}"):  # of killed processes
                if remains.is_file():
                    remains.unlink(missing_ok=True)
            try:
                yield
            except BaseException:
                # results lie in folders: without one, what this run made holds none
                if self._made_now and not any(entry.is_dir() for entry in self.folder.iterdir()):
                    shutil.rmtree(self.folder, ignore_errors=True)
                raise

    def path(self, *names: str) -> Path:
        """A place in the folder."""
        return self.folder.joinpath(*names)

    def put(self, name: str, data: bytes) -> None:
        """Write a file so that it is there whole or not at all, also after a loss of power."""
        try:
            write_work_file(self.folder / name, data)
        except OSError as error:
            raise _make_write_error(self.folder, error) from None

    def get(self, name: str) -> bytes | None:
        """The bytes of a file, None where there is none."""
        try:
            return (self.folder / name).read_bytes()
        except FileNotFoundError:
            return None

    def is_intact(self, name: str) -> bool:
        """Whether a result file is there, undamaged; a damaged one is removed."""
        data = self.get(name)
        if data is None or is_intact(data):
            return data is not None
        (self.folder / name).unlink(missing_ok=True)
        return False

    def read_records(self, name: str, type_: type[Any]) -> list[Any] | None:
        """The records of a result file; None, and the file gone, where it is missing or damaged."""
        data = self.get(name)
        try:
            return None if data is None else decode_records(data, type_)
        except DamagedRecordsError:
            (self.folder / name).unlink(missing_ok=True)
            return None

    def keep_only(self, stage: str, keys: set[str]) -> None:
        """Remove the folders of a stage with other keys: results of settings that are no more."""
        for path in sorted(self.folder.glob(f"{stage}-*")):
            if path.is_dir() and path.name.removeprefix(f"{stage}-") not in keys:
                shutil.rmtree(path, ignore_errors=True)


def compute_stage_key(*parts: Any) -> str:
    """Key of all that a stage's results depend on; parts are anything that msgspec can encode."""
    plain = msgspec.json.encode(msgspec.to_builtins(parts), order="deterministic")
    return hashlib.sha256(plain).hexdigest()[:KEY_CHARACTERS]


@cache
def hash_package(name: str = "catalog") -> str:
    """Hash of a package's code: results of other code are not taken for ours.

    Read once: a process goes on with the code that it has loaded, whatever is installed meanwhile.
    """
    digest = hashlib.sha256(catalog.__version__.encode())
    package = Path(str(files(name)))
    for path in sorted(package.rglob("*.py")):
        digest.update(path.relative_to(package).as_posix().encode())
        digest.update(path.read_bytes())
    return digest.hexdigest()


@cache
def list_versions() -> tuple[tuple[str, str], ...]:
    """Name and version of what the same bytes need beside the code."""
    python = ".".join(platform.python_version_tuple()[:2])
    versions = [("python", python), ("processor", platform.machine())]
    for name in LIBRARIES:
        try:
            versions.append((name, version(name)))
        except PackageNotFoundError:  # built from source under another name: cannot be compared
            versions.append((name, "unknown"))
    return tuple(versions)


def hash_contents(files: Iterable[Path], workspace: Workspace, progress: Progress) -> str:
    """SHA-256 over files, one after the other; one of the same size and date is not read again.

    Raises DataError for a file that cannot be read.
    """
    known = decode_stored_json(workspace.get(HASHES) or b"", dict[str, Sha256]) or {}
    digest = hashlib.sha256()
    for path in files:
        try:
            state = path.stat()
            name = f"{path.resolve()} {state.st_size} {state.st_mtime_ns}"
            if name not in known:
                size = -(-state.st_size // PIECE)
                with progress.stage("checksum", total=size, unit="MB") as shown:
                    known[name] = hash_file(path, shown.advance)
        except OSError as error:
            raise DataError(
                f"{path}: cannot be read ({error.strerror or error}); check its permissions"
            ) from None
        digest.update(bytes.fromhex(known[name]))
    workspace.put(HASHES, msgspec.json.encode(known))
    return digest.hexdigest()


def encode_records(records: Sequence[Any]) -> bytes:
    """Structs or dataclasses as bytes; the same records give the same bytes."""
    payload = zstandard.ZstdCompressor(level=1).compress(pack(records))
    return MAGIC + hashlib.sha256(payload).digest()[:HASH_BYTES] + payload


def is_intact(data: bytes) -> bool:
    """Whether bytes of `encode_records` are as they were made."""
    head = len(MAGIC) + HASH_BYTES
    return data[:head] == MAGIC + hashlib.sha256(memoryview(data)[head:]).digest()[:HASH_BYTES]


def decode_records(data: bytes, type_: type[T]) -> list[T]:
    """The records of a type. Raises DamagedRecordsError."""
    if not is_intact(data):
        raise DamagedRecordsError("checksum differs")
    payload = memoryview(data)[len(MAGIC) + HASH_BYTES :]
    plain = zstandard.ZstdDecompressor().decompress(payload)
    try:
        return unpack(plain, list[type_])  # type: ignore[valid-type]
    except msgspec.MsgspecError as error:
        raise DamagedRecordsError(str(error)) from None


def pack(value: Any) -> bytes:
    """A struct or dataclass, with arrays and rotations in it, as bytes."""
    return msgspec.msgpack.encode(value, enc_hook=_encode_value)


def unpack(data: bytes, type_: type[T]) -> T:
    """Decode the bytes of `pack`; rotations are normalised again. Raises MsgspecError."""
    return msgspec.msgpack.decode(data, type=type_, dec_hook=_decode_value)


def _make_write_error(folder: Path, error: OSError) -> OutputError:
    return OutputError(
        f"{folder}: cannot be written ({error.strerror or error}); "
        "free space, change its permissions or name another work folder"
    )


def _encode_value(value: Any) -> Any:
    if isinstance(value, np.ndarray):
        return [value.dtype.str, list(value.shape), np.ascontiguousarray(value).tobytes()]
    if isinstance(value, np.generic):
        return value.item()
    if isinstance(value, Rotation):
        return value.as_quat().tolist()
    raise NotImplementedError(f"records cannot hold a {type(value).__name__}")


def _decode_value(type_: type, value: Any) -> Any:
    if type_ is np.ndarray or get_origin(type_) is np.ndarray:
        dtype, shape, data = value
        return np.frombuffer(data, dtype=np.dtype(dtype)).reshape(shape)
    if type_ == Rotation:
        return Rotation.from_quat(value)
    raise NotImplementedError(f"records cannot hold a {type_.__name__}")


@dataclass(frozen=True)
class ChunkResults:
    """The result files of a stage's chunks.

    key    hash of all that the results depend on
    type_  of the records in them
    """

    workspace: Workspace
    stage: str
    key: str
    type_: type[Any]

    def name(self, position: int) -> str:
        """The result file of a chunk."""
        return f"{self.stage}-{self.key}/chunk-{position:05d}.bin"

    def read(self, position: int) -> list[Any] | None:
        """The records of a chunk; None where they are missing or damaged."""
        return self.workspace.read_records(self.name(position), self.type_)

    def read_all(self, count: int) -> list[Any] | None:
        """The records of all chunks, one after the other; None where a chunk has none."""
        parts = [self.read(position) for position in range(count)]
        return None if None in parts else [record for part in parts if part for record in part]

    def make(
        self,
        function: Callable[[Any, Any], Sequence[Any]],
        context: Any,
        chunks: Sequence[Sequence[Any]],
        workers: Workers,
        account: StageAccount,
        shown: Stage,
        beside: "ChunkResults | None" = None,
    ) -> Generator[int]:
        """Run the chunks that have no result yet; yields each position as its file is there.

        function(context, chunk) -> records of `type_`; it must be importable by a worker. First
        come the results of earlier runs, then the others in any order.
        beside  of another stage, whose records the function makes on its way: it returns both
        """
        missing = [p for p in range(len(chunks)) if not self.workspace.is_intact(self.name(p))]
        kept = sorted(set(range(len(chunks))).difference(missing))
        account.kept = len(kept)
        shown.keep(sum(len(chunks[position]) for position in kept))
        yield from kept
        kinds = (self,) if beside is None else (self, beside)
        work = [([kind.name(p) for kind in kinds], chunks[p]) for p in missing]
        coordinator = socket.gethostname(), os.getpid()
        make_one = partial(_make_results, function, self.workspace, coordinator)
        for at, (data, usage) in workers.run(make_one, context, work):
            _write_results(self.workspace, work[at][0], data)
            account.done += 1
            account.add(usage)
            shown.advance(len(work[at][1]))
            yield missing[at]


def _write_results(workspace: Workspace, names: Sequence[str], data: Sequence[bytes]) -> None:
    """Write the files of a chunk, its own result first.

    Killed between them, only what it made on its way is missing, and the stage that wants that
    makes it; the other way round the whole chunk would be done again.
    """
    for name, content in zip(names, data, strict=False):
        workspace.put(name, content)


def _make_results(
    function: Callable[[Any, Any], Sequence[Any]],
    workspace: Workspace,
    coordinator: tuple[str, int],
    context: Any,
    work: tuple[Sequence[str], Sequence[Any]],
) -> tuple[list[bytes], Usage]:
    """The results of a chunk as bytes; none if their files are in the workspace already.

    A worker process of this machine puts the files itself and answers in a few hundred bytes, which
    a pipe takes whole or not at all. Killed within an answer longer than a page of 4 kB, it would
    leave the coordinator waiting for the rest for ever: other workers hold the same pipe open.
    A worker elsewhere answers with the bytes: its view of the folder may lag, or forbid writing.
    """
    names, chunk = work
    parent = multiprocessing.parent_process()
    here = parent is not None and (socket.gethostname(), parent.pid) == coordinator

    def make() -> list[bytes]:
        records = function(context, chunk)
        data = [encode_records(kind) for kind in (records if len(names) > 1 else [records])]
        if not here:
            return data
        _write_results(workspace, names, data)
        return []

    return measure_usage(make)
