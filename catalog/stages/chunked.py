"""Stages whose work is cut into chunks: each result file is made once and stays."""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, TypeVar

import msgspec

from catalog.progress import Progress
from catalog.stages.records import encode_records
from catalog.stages.workers import Workers
from catalog.stages.workspace import Workspace

T = TypeVar("T")


def chunk_name(stage: str, key: str, position: int) -> str:
    """The result file of a chunk."""
    return f"{stage}-{key}/chunk-{position:05d}.bin"


def run_chunks(
    workspace: Workspace,
    stage: str,
    key: str,
    function: Callable[[Any, Any], Sequence[msgspec.Struct]],
    type_: type[Any],
    context: Any,
    chunks: Sequence[Sequence[Any]],
    workers: Workers,
    progress: Progress,
) -> tuple[int, int]:
    """Run the chunks that have no result yet; returns how many were done now and were found done.

    function(context, chunk) -> records of `type_`; it must be importable by a worker.
    """
    missing = [
        position
        for position in range(len(chunks))
        if workspace.records(chunk_name(stage, key, position), type_) is None
    ]
    kept = len(chunks) - len(missing)
    with progress.stage(stage, total=sum(map(len, chunks)), unit="cell") as shown:
        shown.advance(sum(map(len, chunks)) - sum(len(chunks[p]) for p in missing))
        work = [chunks[position] for position in missing]
        for at, data in workers.run(partial(_encoded, function), context, work):
            workspace.put(chunk_name(stage, key, missing[at]), data)
            shown.advance(len(work[at]))
    return len(missing), kept


def read_chunks(
    workspace: Workspace, stage: str, key: str, count: int, type_: type[Any]
) -> list[Any] | None:
    """All records of a stage, chunk after chunk; None where a chunk is missing or damaged."""
    records: list[Any] = []
    for position in range(count):
        part = workspace.records(chunk_name(stage, key, position), type_)
        if part is None:
            return None
        records.extend(part)
    return records


def _encoded(
    function: Callable[[Any, Any], Sequence[msgspec.Struct]], context: Any, chunk: Sequence[Any]
) -> bytes:
    return encode_records(function(context, chunk))
