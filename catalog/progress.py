"""What a long piece of work tells about how far it is; who shows it is decided elsewhere."""

from contextlib import AbstractContextManager, nullcontext
from typing import Protocol


class Stage(Protocol):
    """One counted piece of work that is under way."""

    def advance(self, n: int = 1, note: str = "") -> None:
        """Say that n more units are done; the note is shown beside the count."""

    def keep(self, n: int) -> None:
        """Say that n units were done before this run: they count, but not as speed."""


class Progress(Protocol):
    """Receives the stages of a run, one after the other.

    with progress.stage("render", total=len(cells), unit="cell") as stage:
        for cell in cells:
            ...
            stage.advance()
    """

    def stage(self, name: str, total: int, unit: str) -> AbstractContextManager[Stage]:
        """Open a stage of `total` units."""


class _SilentStage:
    def advance(self, n: int = 1, note: str = "") -> None: ...

    def keep(self, n: int) -> None: ...


class SilentProgress:
    """Shows nothing; for library callers, workers and tests."""

    def stage(self, name: str, total: int, unit: str) -> AbstractContextManager[Stage]:
        return nullcontext(_SilentStage())
