"""Keeping interrupts out of code that they would leave half done.

Python raises KeyboardInterrupt between any two steps, also just after a library took a lock and
before it could promise to release it. Whoever needs that lock then waits for ever.
"""

import signal
import threading
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from types import FrameType

HELD = (signal.SIGINT, signal.SIGTERM)


@contextmanager
def uninterrupted() -> Iterator[None]:
    """Hold SIGINT and SIGTERM back until the block is left; for short blocks.

    Does nothing outside the main thread, where no signal arrives, or for a signal whose handler
    is not a Python function.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    with ExitStack() as stack:
        for number in HELD:
            stack.enter_context(_held(number))
        yield


@contextmanager
def _held(number: signal.Signals) -> Iterator[None]:
    handler = signal.getsignal(number)
    if not callable(handler):
        yield
        return
    came: list[FrameType | None] = []
    signal.signal(number, lambda _, frame: came.append(frame))
    try:
        yield
    finally:
        signal.signal(number, handler)
        if came:  # also when the block failed: who handles its error may go on with the work
            handler(number, came[0])
