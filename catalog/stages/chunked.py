"""Stages whose work is cut into chunks: each result file is made once and stays."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

from catalog.progress import Stage
from catalog.stages.account import StageAccount, Usage, metered
from catalog.stages.records import encode_records
from catalog.stages.workers import Workers
from catalog.stages.workspace import Workspace


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
        records: list[Any] = []
        for position in range(count):
            part = self.records(position)
            if part is None:
                return None
            records.extend(part)
        return records

    def make(
        self,
        function: Callable[[Any, Any], Sequence[Any]],
        context: Any,
        chunks: Sequence[Sequence[Any]],
        workers: Workers,
        account: StageAccount,
        shown: Stage,
    ) -> Iterator[int]:
        """Run the chunks that have no result yet; yields each position as its file is there.

        function(context, chunk) -> records of `type_`; it must be importable by a worker. First
        come the results of earlier runs, then the others in any order.
        """
        missing = [p for p in range(len(chunks)) if not self.workspace.whole(self.name(p))]
        found = sorted(set(range(len(chunks))).difference(missing))
        account.kept = len(found)
        shown.keep(sum(len(chunks[position]) for position in found))
        yield from found
        work = [chunks[position] for position in missing]
        for at, (data, usage) in workers.run(partial(_encoded, function), context, work):
            self.workspace.put(self.name(missing[at]), data)
            account.done += 1
            account.add(usage)
            shown.advance(len(work[at]))
            yield missing[at]


def _encoded(
    function: Callable[[Any, Any], Sequence[Any]], context: Any, chunk: Sequence[Any]
) -> tuple[bytes, Usage]:
    return metered(lambda: encode_records(function(context, chunk)))
