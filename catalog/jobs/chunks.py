"""Stages whose work is cut into chunks: each result file is made once and stays."""

import multiprocessing
import os
import socket
from collections.abc import Callable, Generator, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

from catalog.jobs.usage import StageAccount, Usage, metered
from catalog.jobs.workers import Workers
from catalog.jobs.workspace import Workspace, encode_records
from catalog.progress import Stage


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

    def records(self, position: int) -> list[Any] | None:
        """The records of a chunk; None where they are missing or damaged."""
        return self.workspace.records(self.name(position), self.type_)

    def all_records(self, count: int) -> list[Any] | None:
        """The records of all chunks, one after the other; None where a chunk has none."""
        parts = [self.records(position) for position in range(count)]
        return None if None in parts else [record for part in parts if part for record in part]

    def make(
        self,
        function: Callable[[Any, Any], Sequence[Any]],
        context: Any,
        chunks: Sequence[Sequence[Any]],
        workers: Workers,
        account: StageAccount,
        shown: Stage,
    ) -> Generator[int]:
        """Run the chunks that have no result yet; yields each position as its file is there.

        function(context, chunk) -> records of `type_`; it must be importable by a worker. First
        come the results of earlier runs, then the others in any order.
        """
        missing = [p for p in range(len(chunks)) if not self.workspace.whole(self.name(p))]
        found = sorted(set(range(len(chunks))).difference(missing))
        account.kept = len(found)
        shown.keep(sum(len(chunks[position]) for position in found))
        yield from found
        work = [(self.name(position), chunks[position]) for position in missing]
        coordinator = socket.gethostname(), os.getpid()
        make_one = partial(_made, function, self.workspace, coordinator)
        for at, (data, usage) in workers.run(make_one, context, work):
            if data is not None:
                self.workspace.put(work[at][0], data)
            account.done += 1
            account.add(usage)
            shown.advance(len(work[at][1]))
            yield missing[at]


def _made(
    function: Callable[[Any, Any], Sequence[Any]],
    workspace: Workspace,
    coordinator: tuple[str, int],
    context: Any,
    work: tuple[str, Sequence[Any]],
) -> tuple[bytes | None, Usage]:
    """The result of a chunk as bytes, or None if its file is in the workspace already.

    A worker process of this machine puts the file itself and answers in a few hundred bytes, which
    a pipe takes whole or not at all. Killed within an answer longer than a page of 4 kB, it would
    leave the coordinator waiting for the rest for ever: other workers hold the same pipe open.
    A worker elsewhere answers with the bytes: its view of the folder may lag, or forbid writing.
    """
    name, chunk = work
    parent = multiprocessing.parent_process()
    here = parent is not None and (socket.gethostname(), parent.pid) == coordinator

    def make() -> bytes | None:
        data = encode_records(function(context, chunk))
        if not here:
            return data
        workspace.put(name, data)
        return None

    return metered(make)
