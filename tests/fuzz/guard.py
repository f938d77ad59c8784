"""What a command must not do in a case: use the network, write elsewhere, fill the memory."""

import errno
import os
import resource
import socket
import sys
import threading
from pathlib import Path
from typing import Any

MEMORY_BYTES = 8_000_000_000  # of addresses: numba, embree and OpenBLAS reserve much of it
CASE_BYTES = 1_000_000_000  # by which the largest resident size may grow in one case
WRITING = os.O_WRONLY | os.O_RDWR | os.O_CREAT | os.O_TRUNC | os.O_APPEND
# Events of Python's audit hooks whose first argument is a path that is changed.
CHANGING = (
    "os.mkdir",
    "os.remove",
    "os.rmdir",
    "os.truncate",
    "os.chmod",
    "os.chown",
    "shutil.rmtree",
)
TWO_PATHS = ("os.rename", "os.link", "os.symlink")
# may be opened for writing, never replaced
STREAMS = ("/dev/null", "/dev/full", "/dev/stdout", "/dev/stderr", "/dev/tty")
CACHES = ("__pycache__", ".nbi", ".nbc", ".numba")


class Trap:
    """A server that takes every connection, counts it and hangs up.

    Cases name its address, and the proxies that C libraries heed lead to it, so that any use of the
    network by them arrives here.
    """

    def __init__(self) -> None:
        self._socket = socket.create_server(("127.0.0.1", 0))
        self.port: int = self._socket.getsockname()[1]
        self.url = f"http://127.0.0.1:{self.port}/"
        self.count = 0
        threading.Thread(target=self._serve, daemon=True).start()
        for name in ("http_proxy", "https_proxy", "ftp_proxy", "all_proxy"):
            os.environ[name] = os.environ[name.upper()] = self.url
        os.environ["GDAL_HTTP_PROXY"] = os.environ["GDAL_HTTPS_PROXY"] = self.url

    def _serve(self) -> None:
        while True:
            connection, _ = self._socket.accept()
            self.count += 1
            connection.close()


class EscapeError(PermissionError):
    """Raised in place of a change outside the case's folder, so that nothing real is harmed."""


class Guard:
    """Watches what Python does between `start` and `stop`, and stops changes elsewhere.

    A command under test may do anything, and may run as root: one that replaces a device must fail
    here, not on the machine.
    """

    def __init__(self, temporary: Path) -> None:
        self._folder, self._temporary = "", str(temporary.resolve())
        self._seen: list[str] = []
        self._watching = False
        sys.addaudithook(self._hook)

    def start(self, folder: Path) -> None:
        """Watch from now on; what is written has to lie in the folder."""
        self._folder = str(folder.resolve())
        self._seen = []
        self._watching = True

    def stop(self) -> list[str]:
        """What was seen that should not be."""
        self._watching = False
        return self._seen

    def _hook(self, event: str, args: tuple[Any, ...]) -> None:
        if not self._watching:
            return
        if event in ("socket.connect", "socket.sendto"):
            if isinstance(args[1], tuple):  # a UNIX socket's address is a name
                self._seen.append(f"network: {event} {args[1]}")
        elif event in ("socket.getaddrinfo", "socket.gethostbyname", "urllib.Request"):
            self._seen.append(f"network: {event} {args[0]}")
        elif event == "open" and isinstance(args[2], int):
            # a handle, or nothing: without O_CREAT none is made of a name that is not there
            known = isinstance(args[0], int) or (args[2] & os.O_CREAT or os.path.lexists(args[0]))
            if args[2] & WRITING and known and not isinstance(args[0], int):
                self._written(args[0], "open")
        elif event in CHANGING:
            if not (event == "os.mkdir" and os.path.isdir(args[0])):  # then it makes none
                self._written(args[0], event)
        elif event in TWO_PATHS:
            self._written(args[0] if event == "os.rename" else args[1], event)
            self._written(args[1], event)
        elif event == "sqlite3.connect":
            self._database(args[0])

    def _database(self, name: Any) -> None:
        text = os.fsdecode(name)
        if text not in ("", ":memory:") and "mode=ro" not in text and "immutable" not in text:
            self._written(text.removeprefix("file:").partition("?")[0], "sqlite3.connect")

    def _written(self, name: Any, event: str) -> None:
        if isinstance(name, int):
            return
        path = os.path.abspath(os.fsdecode(name))
        # what a link leads to counts, unless the link itself is what is changed
        if event == "os.mkdir" and path == self._folder:  # by a way that leads back, as a/../b
            return
        opened = event in ("open", "sqlite3.connect")
        real = os.path.realpath(path if opened else os.path.dirname(path))
        inside = real.startswith((self._folder, self._temporary))
        if inside or any(part in path for part in CACHES):
            return
        if event == "open" and real in STREAMS:
            return
        self._seen.append(f"escape: {event} {path}")
        raise EscapeError(errno.EPERM, "outside of the case's folder", path)


def limit_memory() -> None:
    """Refuse the process more addresses than any case needs."""
    resource.setrlimit(resource.RLIMIT_AS, (MEMORY_BYTES, MEMORY_BYTES))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))


def largest_bytes() -> int:
    """The largest resident size of this process so far."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
