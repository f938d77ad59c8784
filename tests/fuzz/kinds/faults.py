"""Faults made on purpose: what the harness itself has to notice. Never chosen for a run."""

import os
import signal
import socket
import tempfile
import time
from collections.abc import Callable

from tests.fuzz.cases import DATA, OK, Case, Place, kind


def _fault(name: str) -> Callable[[Callable[[Place], int]], None]:
    """Register a case that does this in place of a command that ends with 0 and writes nothing."""

    def register(act: Callable[[Place], int]) -> None:
        @kind(f"fault-{name}", 0.0)
        def make(place: Place) -> Case:
            place.write("input", b"whole")
            return Case((), frozenset({OK}), note=name, action=lambda: act(place))

    return register


@_fault("none")
def _none(place: Place) -> int:
    return OK


@_fault("code")
def _code(place: Place) -> int:
    print("optnav: input: is damaged; restore it")  # noqa: T201 -- as a command prints
    return DATA


@_fault("traceback")
def _traceback(place: Place) -> int:
    raise KeyError("a bug")


@_fault("signal")
def _signal(place: Place) -> int:
    os.kill(os.getpid(), signal.SIGSEGV)
    return OK


@_fault("hang")
def _hang(place: Place) -> int:
    time.sleep(1e6)
    return OK


@_fault("network")
def _network(place: Place) -> int:
    address = place.url.removeprefix("http://").rstrip("/").split(":")
    socket.create_connection((address[0], int(address[1]))).close()
    return OK


@_fault("litter")
def _litter(place: Place) -> int:
    place.write(".input.optnav-new-1", b"half")
    return OK


@_fault("changed")
def _changed(place: Place) -> int:
    place.write("input", b"other")
    return OK


@_fault("temporary")
def _temporary(place: Place) -> int:
    tempfile.tempdir = None
    tempfile.mkdtemp()
    return OK


@_fault("escape")
def _escape(place: Place) -> int:
    try:
        (place.folder.parent / "outside").write_text("escaped")
    except PermissionError:
        return OK
    return DATA
