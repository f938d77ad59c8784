"""What a build says that it used is what it used."""

import subprocess
import sys
import threading
import time

import msgspec
import pytest

from catalog.control_point import Flag
from catalog.jobs.usage import Account, Peak, StageAccount, Usage, measure_usage

linux = pytest.mark.skipif(sys.platform != "linux", reason="only Linux counts a process's bytes")


def burn(seconds):
    """Use so much processor time."""
    end = time.thread_time() + seconds
    while time.thread_time() < end:
        pass


def usage(process="other:1", cpu_s=1.0, peak=100, own=True, moved=10):
    return Usage(process, cpu_s, Peak(peak, own), moved, moved)


def test_processor_time_is_that_of_the_work_not_of_waiting():
    _, used = measure_usage(lambda: (burn(0.1), time.sleep(0.2)))
    assert 0.09 < used.cpu_s < 0.2


@linux
def test_bytes_read_and_written_are_counted(tmp_path):
    data = bytes(3_000_000)

    def work():
        (tmp_path / "file").write_bytes(data)
        return len((tmp_path / "file").read_bytes())

    length, used = measure_usage(work)
    assert length == 3_000_000
    assert 3_000_000 <= used.read_bytes < 3_100_000
    assert 3_000_000 <= used.written_bytes < 3_100_000


MARKS = """
from catalog.jobs.usage import measure_usage
first = measure_usage(lambda: len(bytearray(b"x") * 200_000_000))[1].peak
second = measure_usage(lambda: len(bytearray(b"x") * 1_000_000))[1].peak
third = measure_usage(lambda: len(bytearray(b"x") * 300_000_000))[1].peak
print(first.bytes, first.is_own, second.bytes, second.is_own, third.bytes, third.is_own)
"""


@linux
def test_a_peak_is_the_works_own_only_where_it_raised_the_mark():
    # in a process of its own: this one's mark is whatever the tests before have made it
    done = subprocess.run(
        [sys.executable, "-c", MARKS], capture_output=True, text=True, check=True,
        env={"PYTHONPATH": ":".join(sys.path)},
    )  # fmt: skip
    first, first_own, second, second_own, third, third_own = done.stdout.split()
    assert (first_own, second_own, third_own) == ("True", "False", "True")
    assert 200e6 < int(first) == int(second) < 300e6 < int(third) < 500e6


def test_threads_of_a_process_together_report_what_it_used():
    reports = []
    both = threading.Barrier(2)

    def work():
        both.wait()
        burn(0.1)

    threads = [
        threading.Thread(target=lambda: reports.append(measure_usage(work)[1])) for _ in "ab"
    ]
    before = time.process_time()
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    spent = time.process_time() - before
    assert sum(report.cpu_s for report in reports) == pytest.approx(spent, abs=0.02)


def test_work_that_fails_does_not_spoil_the_next_measurement():
    with pytest.raises(ZeroDivisionError):
        measure_usage(lambda: 1 / 0)
    burn(0.1)
    assert measure_usage(lambda: burn(0.05))[1].cpu_s < 0.1


def test_a_stage_adds_up_its_workers_and_knows_the_greatest():
    stage = StageAccount("render")
    stage.add(usage(peak=100, cpu_s=1.0))
    stage.add(usage("other:2", peak=300, own=False, cpu_s=2.0))
    stage.add(usage("other:2", peak=300, own=True, cpu_s=3.0))
    stage.add(usage(peak=200, cpu_s=4.0))
    assert stage.workers_cpu_s == stage.cpu_s == 10.0
    assert stage.worker_peak == Peak(300, True)
    assert stage.read_bytes == 40


def test_work_done_in_the_own_process_counts_once():
    stage = StageAccount("render")
    with stage.measure_block():
        _, used = measure_usage(lambda: burn(0.1))
        stage.add(used)
    assert 0.09 < stage.cpu_s < 0.19
    assert stage.workers_cpu_s == 0.0
    assert stage.worker_peak is None


def test_bytes_that_one_process_cannot_tell_are_unknown_for_the_stage():
    stage = StageAccount("render")
    stage.add(usage())
    stage.add(Usage("other:2", 1.0, Peak(1, True), None, None))
    stage.add(usage())
    assert stage.read_bytes is stage.written_bytes is None


def test_points_are_judged_by_all_their_reasons():
    account = Account("optnav", 1)
    account.judge(
        [
            (True, Flag.CROWDED),  # a word about a usable point is no reason against it
            (False, Flag.FLAT),
            (False, Flag.FLAT | Flag.NOT_UNIQUE),
        ]
    )
    assert (account.points, account.usable) == (3, 1)
    assert list(account.reasons.items()) == [("flat", 2), ("not unique", 1)]


def test_an_account_rests_as_json_and_comes_back():
    account = Account("optnav", 2, cells=5)
    account.judge([(False, Flag.FLAT)])
    account.stages.append(StageAccount("render", done=3, worker_peak=Peak(5, False)))
    assert msgspec.json.decode(msgspec.json.encode(account), type=Account) == account
