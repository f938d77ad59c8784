"""A dask scheduler at an address: whether one answers there, and quiet while it is used."""

import asyncio
import logging
import socket
from typing import Any
from urllib.parse import urlsplit

from catalog.errors import UsageError, WorkersError

log = logging.getLogger(__name__)

ANSWER_S = 5.0  # for a scheduler to answer
# What these would say on stderr is said in a message of our own.
NOISY = ("distributed", "tornado", "asyncio")


def check_address(address: str) -> None:
    """Raise UsageError unless this is tcp://HOST:PORT."""
    try:
        parts = urlsplit(address)
        good = parts.scheme == "tcp" and bool(parts.hostname) and bool(parts.port)
        good = good and address.lower() == f"tcp://{parts.netloc}".lower() and "@" not in address
    except ValueError:  # a port that is no number, or half an IPv6 address
        good = False
    if not good:
        raise UsageError(
            f"--scheduler {address!r}: wanted tcp://HOST:PORT, such as tcp://host:8786"
        )


def load_distributed() -> Any:
    """The package `distributed`. Raises UsageError where it is not installed."""
    try:
        import distributed
    except ModuleNotFoundError as error:
        raise UsageError(
            f"--scheduler needs the package {error.name!r}, which is not installed; "
            "install it with: pip install 'optnav[dist]'"
        ) from None
    return distributed


def unreachable(address: str, reason: str) -> WorkersError:
    """The error of a scheduler that does not answer."""
    return WorkersError(
        f"{address}: no scheduler can be reached ({reason}); "
        "check the address and that `dask scheduler` runs there"
    )


def find_scheduler(address: str) -> None:
    """Raise WorkersError unless a scheduler answers within ANSWER_S.

    Asked before there is a Client, which would wait for ever for what is no scheduler.
    """
    parts = urlsplit(address)
    try:
        # refused at once where a Client would go on trying
        socket.create_connection((parts.hostname, parts.port), timeout=ANSWER_S).close()
    except OSError as error:
        raise unreachable(address, (error.strerror or str(error)).lower()) from None
    task = asyncio.run(_identity_in_time(address))
    if task.cancelled() or isinstance(task.exception(), OSError):
        raise unreachable(address, f"no word within {ANSWER_S:.0f} s")
    # whatever else went wrong, it did on reading words that are no scheduler's
    if task.exception() is not None or task.result().get("type") != "Scheduler":
        raise unreachable(address, "what answers there is no scheduler")


async def _identity_in_time(address: str) -> "asyncio.Task[Any]":
    async def identity() -> Any:
        async with load_distributed().rpc(address, timeout=ANSWER_S) as scheduler:
            return await scheduler.identity()

    task = asyncio.ensure_future(identity())
    done, _ = await asyncio.wait({task}, timeout=ANSWER_S)
    if not done:
        task.cancel()
        await asyncio.wait({task}, timeout=1.0)
    return task


class Silence:
    """Keeps what dask logs off stderr, from `begin` to `end`; not in a run that tells details."""

    def __init__(self) -> None:
        self._levels: dict[str, int] = {}

    def begin(self) -> None:
        """Raise the levels of their loggers."""
        if log.isEnabledFor(logging.DEBUG) or self._levels:
            return
        known = [name for name in logging.root.manager.loggerDict if name.split(".")[0] in NOISY]
        for name in {*NOISY, *known}:
            logger = logging.getLogger(name)
            if name in NOISY or logger.level != logging.NOTSET:
                self._levels[name] = logger.level
                logger.setLevel(logging.CRITICAL + 1)

    def end(self) -> None:
        """Put the levels back."""
        for name, level in self._levels.items():
            logging.getLogger(name).setLevel(level)
        self._levels = {}
