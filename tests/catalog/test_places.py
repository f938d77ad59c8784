"""Output places: what is never replaced, and that one process at a time writes to a place."""

import os
import signal
import socket
import stat
import subprocess
import sys
import textwrap
import threading
from contextlib import suppress
from pathlib import Path

import pytest

from catalog.errors import OutputError
from catalog.files import replace_file, replace_folder
from catalog.places import check_apart, lock_file, lock_output, make_folder

CHECKOUT = Path(__file__).resolve().parents[2]


def names(folder):
    return sorted(path.name for path in folder.iterdir())


def untouched(path):
    """What a write would change of a node; not its access time, which reading a link moves."""
    stat = os.lstat(path)
    return stat.st_mode, stat.st_ino, stat.st_size, stat.st_mtime_ns, stat.st_ctime_ns


def pipe(path):
    os.mkfifo(path)


def bound_socket(path):
    with socket.socket(socket.AF_UNIX) as made:
        made.bind(os.path.relpath(path))  # a socket's whole path has 108 bytes at most


def device(path):
    try:  # another node of /dev/null
        os.mknod(path, stat.S_IFCHR | 0o600, os.makedev(1, 3))
    except PermissionError:
        pytest.skip("may not make a device here")


def link_to_a_pipe(path):
    os.mkfifo(path.with_name("target"))
    path.symlink_to("target")


def link_to_nothing(path):
    path.symlink_to("nothing")


def link_to_itself(path):
    path.symlink_to(path.name)


def write_file(path):
    with replace_file(path, lambda _: True) as new:
        new.write_bytes(b"new")


def write_folder(path):
    with replace_folder(path, "run"):
        pass


@pytest.mark.parametrize("write", [write_file, write_folder, make_folder])
@pytest.mark.parametrize(
    ("make", "said"),
    [
        (pipe, "is a pipe, which no output replaces"),
        (bound_socket, "is a socket, which"),
        (device, "is a device, which"),
        (link_to_a_pipe, "is a pipe, which"),
        (link_to_nothing, "is a link to nothing, which does not exist"),
        (link_to_itself, "cannot be written .*symbolic links"),
    ],
)
def test_what_is_no_file_and_no_folder_is_left_alone(tmp_path, make, said, write):
    place = tmp_path / "place"
    make(place)
    before = names(tmp_path), untouched(place)
    with pytest.raises(OutputError, match=rf"place: {said}.*name another place"):
        write(place)
    assert (names(tmp_path), untouched(place)) == before


@pytest.mark.parametrize("write", [write_file, write_folder, make_folder])
@pytest.mark.parametrize("above", ["file", "loop", "n" * 256])
def test_a_place_that_cannot_be_is_refused(tmp_path, write, above):
    (tmp_path / "file").touch()
    (tmp_path / "loop").symlink_to("loop")
    not_text = os.fsdecode(b"\xff\xfe")
    for name in (f"{above}/place", "n" * 256, not_text, f"{not_text}/new", "/", ""):
        place = tmp_path / name if name.strip("/") else Path(name)
        with pytest.raises(OutputError, match=r"name (one|another)"):
            write(place)
    assert names(tmp_path) == ["file", "loop"]


def test_a_link_stays_and_what_it_leads_to_is_replaced(tmp_path):
    (tmp_path / "target").touch()
    (tmp_path / "link").symlink_to("target")
    write_file(tmp_path / "link")
    assert (tmp_path / "target").read_bytes() == b"new"
    assert (tmp_path / "link").is_symlink()


def test_what_is_locked_is_not_locked_twice(tmp_path):
    lock = tmp_path / "lock"
    with lock_file(lock), pytest.raises(BlockingIOError), lock_file(lock):
        pass
    with lock_file(lock):
        pass


def test_a_lock_is_neither_a_link_nor_a_pipe(tmp_path):
    (tmp_path / "letter").write_text("Dear")
    (tmp_path / "link").symlink_to("letter")
    os.mkfifo(tmp_path / "pipe")
    for name in ("link", "pipe"):
        with pytest.raises(OSError, match=name):
            lock_file(tmp_path / name).__enter__()
    assert (tmp_path / "letter").read_text() == "Dear"


def in_another_thread(action):
    """What an action raised in a thread of its own: claims are a thread's."""
    raised = []

    def call():
        try:
            action()
        except OutputError as error:
            raised.append(str(error))

    thread = threading.Thread(target=call)
    thread.start()
    thread.join()
    return raised


def test_a_claimed_place_is_refused_under_each_of_its_names(tmp_path):
    place = tmp_path / "run"
    (tmp_path / "link").symlink_to("run")
    (tmp_path / "beside").symlink_to(tmp_path)
    place.mkdir()
    with lock_output(place):
        for other in (place, tmp_path / "link", tmp_path / "beside" / "run"):
            (said,) = in_another_thread(lambda other=other: write_folder(other))
            assert "another optnav is writing this output; wait for it or name another" in said
        assert not in_another_thread(lambda: write_file(tmp_path / "run2"))
        with lock_output(place):  # its own thread may
            pass
        assert in_another_thread(lambda: write_folder(place))
    assert names(tmp_path) == ["beside", "link", "run", "run2"]


def test_a_folder_and_what_is_written_into_it_are_not_written_at_once(tmp_path):
    place, inside = tmp_path / "run", tmp_path / "run" / "deep" / "report.html"
    inside.parent.mkdir(parents=True)
    (place / "manifest.json").write_text('{"made_by": "optnav", "kind": "run"}')
    for first, second in ((place, inside), (inside, place)):
        with lock_output(first):
            (said,) = in_another_thread(lambda second=second: lock_output(second).__enter__())
            assert said.startswith(f"{first}: another optnav is writing this output")
            with lock_output(second):  # as a demo does, whose folder holds all its outputs
                pass
    (place / ".gone.optnav-lock").touch()  # of a killed process
    with lock_output(place), lock_output(inside):
        pass


def test_a_claim_leaves_no_empty_folders_behind(tmp_path):
    with suppress(RuntimeError), lock_output(tmp_path / "deep" / "deeper" / "file"):
        raise RuntimeError
    assert names(tmp_path) == []
    write_file(tmp_path / "deep" / "deeper" / "file")
    assert names(tmp_path / "deep") == ["deeper"]


KILLED = """
    import sys, time
    from pathlib import Path
    from catalog.places import lock_output
    with lock_output(Path(sys.argv[1])):
        print("ready", flush=True)
        time.sleep(60)
"""


def test_the_claim_of_a_killed_process_is_gone_with_it(tmp_path):
    place = tmp_path / "file"
    words = [sys.executable, "-c", textwrap.dedent(KILLED), str(place)]
    with subprocess.Popen(words, cwd=CHECKOUT, stdout=subprocess.PIPE, text=True) as writer:
        assert writer.stdout.readline() == "ready\n"
        with pytest.raises(OutputError, match="another optnav"):
            write_file(place)
        writer.send_signal(signal.SIGKILL)
    assert names(tmp_path) == [".file.optnav-lock"]
    write_file(place)
    assert names(tmp_path) == ["file"]


# Two forked writers a round begin together. What each wrote must be there whole, or an older one.
PAIRS = """
    import json, os, sys, time
    from pathlib import Path
    from catalog.errors import OutputError
    from catalog.files import replace_file, replace_folder

    kind, place = sys.argv[1], Path(sys.argv[2])
    written = refused = 0

    def write(word):
        if kind == "file":
            with replace_file(place, lambda _: True) as new:
                new.write_text(word * 1000)
                time.sleep(0.02)
        else:
            with replace_folder(place, "run") as new:
                (new / "manifest.json").write_text('{"made_by": "optnav", "kind": "run"}')
                time.sleep(0.02)
                (new / "word").write_text(word * 1000)

    for number in range(100):
        gate, opened = os.pipe()
        children = []
        for word in (f"{number}a", f"{number}b"):
            child = os.fork()
            if not child:
                os.close(opened)
                os.read(gate, 1)  # until the parent closes it
                try:
                    write(word)
                except OutputError as error:
                    os._exit(3 if "another optnav is writing" in str(error) else 4)
                except BaseException:
                    os._exit(1)
                os._exit(0)
            children.append(child)
        os.close(opened)
        os.close(gate)
        codes = [os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) for child in children]
        text = (place if kind == "file" else place / "word").read_text()
        whole = {f"{number}{letter}" * 1000 for letter, code in zip("ab", codes) if code == 0}
        if text not in whole or not set(codes) <= {0, 3}:
            sys.exit(f"pair {number}: {codes}, {text[:20]!r}")
        refused += codes.count(3)
    print(refused, sorted(os.listdir(place.parent)))
"""


@pytest.mark.parametrize("kind", ["file", "folder"])
def test_of_a_hundred_pairs_each_leaves_the_output_of_one(tmp_path, kind):
    done = subprocess.run(
        [sys.executable, "-c", textwrap.dedent(PAIRS), kind, str(tmp_path / "place")],
        cwd=CHECKOUT, capture_output=True, text=True,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    refused, left = done.stdout.split(maxsplit=1)
    assert left == "['place']\n"
    assert int(refused) > 10  # or they never met


def test_a_name_that_is_none_lies_in_no_output(tmp_path):
    check_apart(tmp_path / "run", [Path("a\0b")])
