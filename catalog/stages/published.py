"""Knowing the catalog again that an earlier run wrote, so that it is not written twice.

The work folder remembers what a catalog was made from and the seal of its file, a hash of all its
bytes. A file that is as it was then stays; one that is damaged, or that a GIS wrote to, does not.
"""

from contextlib import closing
from pathlib import Path

import msgspec

from catalog.errors import DataError
from catalog.stages.workspace import Workspace
from catalog.store.connection import connect, live_log, read_meta
from catalog.store.manifest import CatalogMeta
from catalog.store.seal import SealState, seal_state
from catalog.store.writer import Written

FILE = "written.json"


class _Memory(msgspec.Struct, frozen=True):
    key: str
    seal: str


def remember(workspace: Workspace, key: str, path: Path) -> None:
    """Note that the catalog at a path was made from what the key stands for."""
    meta = _meta(path)
    if meta is not None:
        workspace.put(FILE, msgspec.json.encode(_Memory(key, meta.seal)))


def find(workspace: Workspace, key: str, path: Path) -> Written | None:
    """The catalog at a path, if it is the remembered one of this key and whole to the last byte."""
    data = workspace.get(FILE)
    try:
        memory = msgspec.json.decode(data, type=_Memory) if data else None
    except msgspec.MsgspecError:
        memory = None
    meta = _meta(path) if memory is not None and memory.key == key else None
    if memory is None or meta is None or meta.seal != memory.seal or live_log(path):
        return None
    if seal_state(path, meta.seal) is not SealState.WHOLE:
        return None
    return Written(path, meta.count, meta.usable, meta.digest, path.stat().st_size)


def _meta(path: Path) -> CatalogMeta | None:
    try:
        with closing(connect(path)) as db:
            return read_meta(db, path)
    except DataError:
        return None
