"""Interrupts that come in a block which must not be left half done."""

import signal
import threading

import pytest

from catalog.jobs.workers import mask_signals


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_waits_for_the_end_of_the_block(number):
    def stop(*_):
        raise KeyboardInterrupt

    def block():
        with mask_signals():
            signal.raise_signal(number)
            done.append("whole")

    before = signal.signal(number, stop)
    done = []
    try:
        with pytest.raises(KeyboardInterrupt):
            block()
        assert done == ["whole"]
        assert signal.getsignal(number) is stop
    finally:
        signal.signal(number, before)


def test_an_ignored_signal_stays_ignored():
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        with mask_signals():
            signal.raise_signal(signal.SIGINT)
        assert signal.getsignal(signal.SIGINT) is signal.SIG_IGN
    finally:
        signal.signal(signal.SIGINT, before)


def test_other_threads_leave_signals_alone():
    seen = []

    def work():
        with mask_signals():
            seen.append(signal.getsignal(signal.SIGINT))

    thread = threading.Thread(target=work)
    thread.start()
    thread.join()
    assert seen == [signal.getsignal(signal.SIGINT)]


def test_an_error_in_the_block_does_not_swallow_the_signal():
    def block():
        with mask_signals():
            signal.raise_signal(signal.SIGINT)
            raise ValueError("ours")

    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        with pytest.raises(KeyboardInterrupt):
            block()
    finally:
        signal.signal(signal.SIGINT, before)
