"""Content hashes of input files, kept in the work folder by size and time of change."""

import hashlib
from collections.abc import Iterable
from pathlib import Path

import msgspec

from catalog.errors import DataError
from catalog.files import PIECE, hash_file
from catalog.jobs.workspace import Workspace
from catalog.progress import Progress

HASHES = "dem-hashes.json"


def _known_hashes(workspace: Workspace) -> dict[str, str]:
    data = workspace.get(HASHES)
    try:
        return msgspec.json.decode(data, type=dict[str, str]) if data else {}
    except msgspec.MsgspecError:
        return {}


def content_hash(files: Iterable[Path], workspace: Workspace, progress: Progress) -> str:
    """SHA-256 over files, one after the other; one of the same size and date is not read again.

    Raises DataError for a file that cannot be read.
    """
    known = _known_hashes(workspace)
    whole = hashlib.sha256()
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
        whole.update(bytes.fromhex(known[name]))
    workspace.put(HASHES, msgspec.json.encode(known))
    return whole.hexdigest()
