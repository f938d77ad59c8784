"""What a long piece of work tells about how far it is; who shows it is decided elsewhere."""

import logging
import time
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from typing import Protocol

log = logging.getLogger(__name__)


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


@contextmanager
def log_stage(name: str) -> Iterator[None]:
    """Log one event when a stage of a command ends: its name, its seconds and how it ended."""
    started, status = time.monotonic(), "failed"
    try:
        yield
        status = "done"
    finally:
        seconds = round(time.monotonic() - started, 3)
        event = {"stage": name, "status": status, "seconds": seconds}
        log.debug("stage %s: %s, %s s", name, status, seconds, extra=event)
