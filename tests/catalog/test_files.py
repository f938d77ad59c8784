"""Files and folders: atomic replacement, refusal of foreign files, what a killed command leaves."""

import errno
import json
import os
import resource
import signal
import subprocess
import sys
import textwrap
from contextlib import ExitStack
from pathlib import Path

import pytest

from catalog import files
from catalog.errors import OutputError
from catalog.files import (
    check_file,
    make_prefix_test,
    replace_file,
    replace_folder,
    replace_work_folder,
)


def fill(folder, word, kind="run"):
    (folder / "manifest.json").write_text(json.dumps({"made_by": "optnav", "kind": kind}))
    (folder / "word.txt").write_text(word)


def fail_halfway(path, failure):
    path.write_text("<!-- optnav -->half")
    raise failure


def names(folder):
    return sorted(path.name for path in folder.iterdir())


def test_a_new_folder_appears_whole_and_nothing_stays_beside_it(tmp_path):
    target = tmp_path / "deep" / "run"
    with replace_folder(target, "run") as new:
        fill(new, "one")
        assert not target.exists()
    assert names(target) == ["manifest.json", "word.txt"]
    assert names(target.parent) == ["run"]


@pytest.mark.parametrize("exchange", [True, False], ids=["one step", "two steps"])
def test_an_older_output_is_replaced_and_its_files_go(tmp_path, monkeypatch, exchange):
    if not exchange:
        monkeypatch.setattr(files, "_swap_folders", lambda one, other: False)
    target = tmp_path / "run"
    with replace_folder(target, "run") as new:
        fill(new, "one")
        (new / "only_in_the_first").touch()
    with replace_folder(target, "run") as new:
        fill(new, "two")
        assert (target / "word.txt").read_text() == "one"
    assert (target / "word.txt").read_text() == "two"
    assert names(target) == ["manifest.json", "word.txt"]
    assert names(tmp_path) == ["run"]


def test_a_failure_leaves_the_older_output_alone(tmp_path):
    target = tmp_path / "run"
    with replace_folder(target, "run") as new:
        fill(new, "one")
    with pytest.raises(KeyboardInterrupt), replace_folder(target, "run") as new:
        fail_halfway(new / "half", KeyboardInterrupt)
    assert (target / "word.txt").read_text() == "one"
    assert names(tmp_path) == ["run"]


def test_a_foreign_folder_a_file_and_an_output_of_another_kind_are_refused(tmp_path):
    foreign = tmp_path / "letters"
    foreign.mkdir()
    (foreign / "to_mum.txt").touch()
    with (
        pytest.raises(OutputError, match=r"letters: the folder is not empty and holds no run"),
        replace_folder(foreign, "run"),
    ):
        pass
    assert names(foreign) == ["to_mum.txt"]
    with pytest.raises(OutputError, match="a file is in the way"):
        replace_folder(foreign / "to_mum.txt", "run").__enter__()
    pictures = tmp_path / "pictures"
    pictures.mkdir()
    fill(pictures, "frames", kind="pictures")
    with pytest.raises(OutputError, match="holds no run that optnav made"):
        replace_folder(pictures, "run").__enter__()
    assert (pictures / "word.txt").read_text() == "frames"


def test_an_empty_folder_is_taken(tmp_path):
    (tmp_path / "run").mkdir()
    with replace_folder(tmp_path / "run", "run") as new:
        fill(new, "one")
    assert (tmp_path / "run" / "word.txt").read_text() == "one"


def test_a_place_below_a_file_is_an_output_error_that_names_it(tmp_path):
    (tmp_path / "file").touch()
    with pytest.raises(OutputError, match=r"run: cannot be written \(.*another place"):
        replace_folder(tmp_path / "file" / "run", "run").__enter__()


def test_a_full_disk_is_an_output_error_and_other_failures_pass_through(tmp_path):
    with (
        pytest.raises(OutputError, match="No space left"),
        replace_folder(tmp_path / "run", "run"),
    ):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
    with pytest.raises(FileNotFoundError), replace_folder(tmp_path / "run", "run"):
        (tmp_path.parent / "no such input").read_text()
    assert names(tmp_path) == []


def test_forgetting_the_manifest_is_a_bug_and_writes_nothing(tmp_path):
    with pytest.raises(ValueError, match="manifest"), replace_folder(tmp_path / "run", "run"):
        pass
    assert names(tmp_path) == []


KILLED = """
    import json, os, signal, sys, time
    from pathlib import Path
    from catalog.files import replace_folder
    with replace_folder(Path(sys.argv[1]), "run") as new:
        (new / "manifest.json").write_text(json.dumps({"made_by": "optnav", "kind": "run"}))
        (new / "half.txt").write_text("half")
        print("ready", flush=True)
        time.sleep(60)
"""


def test_a_killed_command_leaves_the_old_output_and_the_next_cleans_up(tmp_path):
    target = tmp_path / "run"
    with replace_folder(target, "run") as new:
        fill(new, "one")
    writer = subprocess.Popen(
        [sys.executable, "-c", textwrap.dedent(KILLED), str(target)],
        stdout=subprocess.PIPE,
        text=True,
    )
    with writer:
        assert writer.stdout.readline() == "ready\n"
        with pytest.raises(OutputError, match="another optnav is writing this output"):
            replace_folder(target, "run").__enter__()
        writer.send_signal(signal.SIGKILL)
    assert (target / "word.txt").read_text() == "one"
    assert len(names(tmp_path)) == 3  # with the half output and the lock file
    with replace_folder(target, "run") as new:
        fill(new, "two")
    assert names(tmp_path) == ["run"]
    assert (target / "word.txt").read_text() == "two"


def test_an_output_that_a_kill_left_moved_aside_is_given_back(tmp_path):
    target = tmp_path / "run"
    aside = tmp_path / ".run.optnav-old"
    aside.mkdir()
    fill(aside, "one")
    with pytest.raises(RuntimeError), replace_folder(target, "run"):
        raise RuntimeError
    assert (target / "word.txt").read_text() == "one"
    assert names(tmp_path) == ["run"]


def test_a_file_is_replaced_when_it_is_ours_and_refused_when_it_is_not(tmp_path):
    target = tmp_path / "report.html"
    ours = make_prefix_test(b"<!-- optnav", b"<!doctype")
    for word in ("one", "two"):
        with replace_file(target, ours) as new:
            new.write_text("<!-- optnav -->" + word)
    assert target.read_text().endswith("two")
    with pytest.raises(RuntimeError), replace_file(target, ours) as new:
        fail_halfway(new, RuntimeError)
    assert target.read_text().endswith("two")
    target.write_text("a letter")
    with pytest.raises(OutputError, match="not made by optnav"):
        replace_file(target, ours).__enter__()
    (tmp_path / "folder").mkdir()
    with pytest.raises(OutputError, match="a folder is in the way"):
        replace_file(tmp_path / "folder", ours).__enter__()
    assert target.read_text() == "a letter"
    assert names(tmp_path) == ["folder", "report.html"]


def fill_while_a_letter_comes(target):
    with replace_file(target, make_prefix_test(b"<!-- optnav")) as new:
        new.write_text("<!-- optnav -->")
        target.write_text("a letter")


def test_a_foreign_file_that_comes_while_an_output_is_made_stays(tmp_path):
    target = tmp_path / "report.html"
    with pytest.raises(OutputError, match="not made by optnav"):
        fill_while_a_letter_comes(target)
    assert target.read_text() == "a letter"
    assert names(tmp_path) == ["report.html"]


def nested(path):
    path.write_bytes(b'{"a":' + b"[" * 10**6 + b"]" * 10**6 + b',"made_by":"optnav","kind":"run"}')


def huge(path):
    path.write_text('{"made_by":"optnav","kind":"run"}')
    os.truncate(path, 1 << 40)  # sparse


def not_utf8(path):
    path.write_bytes(b'{"made_by":"optnav","kind":"\xff"}')


@pytest.mark.parametrize(
    "manifest", [nested, huge, not_utf8, Path.mkdir, os.mkfifo], ids=lambda make: make.__name__
)
def test_a_folder_whose_manifest_is_none_is_not_ours(tmp_path, manifest):
    """A pipe for a manifest must not be waited for either."""
    target = tmp_path / "run"
    target.mkdir()
    manifest(target / "manifest.json")
    with pytest.raises(OutputError, match="holds no run that optnav made"):
        replace_folder(target, "run").__enter__()
    assert names(target) == ["manifest.json"]
    assert names(tmp_path) == ["run"]


@pytest.mark.parametrize("name", ["n" * 255, "ü" * 127, "a run\n"])
def test_any_name_that_the_disk_takes_can_be_an_output(tmp_path, name):
    for word in ("one", "two"):
        with replace_folder(tmp_path / name, "run") as new:
            fill(new, word)
    assert (tmp_path / name / "word.txt").read_text() == "two"
    file = tmp_path / "deep" / name
    for word in ("one", "two"):
        with replace_file(file, make_prefix_test(b"<!-- optnav")) as new:
            new.write_text("<!-- optnav -->" + word)
    assert file.read_text().endswith("two")
    assert names(tmp_path) == sorted([name, "deep"])
    assert names(file.parent) == [name]


def test_a_name_leaves_room_for_those_of_its_side_files(tmp_path):
    with pytest.raises(OutputError, match="File name too long"):
        check_file(tmp_path / ("n" * 252), lambda _: True, ("-wal",))
    check_file(tmp_path / ("n" * 251), lambda _: True, ("-wal",))


def test_side_files_that_are_no_files_stay(tmp_path):
    (tmp_path / "c.db-wal").mkdir()
    with replace_file(tmp_path / "c.db", lambda _: True, ("-wal",)) as new:
        new.write_bytes(b"new")
    assert names(tmp_path) == ["c.db", "c.db-wal"]


def test_a_place_is_asked_for_without_being_touched(tmp_path):
    ours = make_prefix_test(b"<!-- optnav")
    check_file(tmp_path / "new.html", ours)
    (tmp_path / "empty.html").touch()
    check_file(tmp_path / "empty.html", ours)
    (tmp_path / "letter.html").write_text("Dear")
    with pytest.raises(OutputError, match=r"letter.html: exists and was not made by optnav"):
        check_file(tmp_path / "letter.html", ours)
    with pytest.raises(OutputError, match="is not a name for an output"):
        check_file(Path("/"), ours)
    assert names(tmp_path) == ["empty.html", "letter.html"]


def test_side_files_of_the_old_file_go_with_it(tmp_path):
    target = tmp_path / "c.db"
    for name in ("c.db-wal", "c.db.txt"):
        (tmp_path / name).touch()
    with replace_file(target, lambda _: True, ("-wal",)) as new:
        new.write_bytes(b"new")
        assert (tmp_path / "c.db-wal").exists()
    assert names(tmp_path) == ["c.db", "c.db.txt"]


def test_a_folder_of_a_work_folder_is_there_whole_or_as_it_was(tmp_path):
    target = tmp_path / "levels"
    for word in ("one", "two"):
        with replace_work_folder(target) as new:
            (new / "word.txt").write_text(word)
            assert target.exists() == (word == "two")
    with pytest.raises(RuntimeError), replace_work_folder(target) as new:
        fail_halfway(new / "word.txt", RuntimeError)
    assert (target / "word.txt").read_text() == "two"
    assert names(tmp_path) == ["levels"]


def test_a_folder_is_removed_where_no_more_files_can_be_opened(tmp_path):
    def fill_and_open_until_it_fails():
        with ExitStack() as held, replace_folder(tmp_path / "run", "run") as new:
            (new / "overlays" / "deep").mkdir(parents=True)
            (new / "overlays" / "deep" / "a.png").touch()
            while True:
                held.enter_context((new / "overlays" / "a.png").open("wb"))

    limits = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (100, limits[1]))
    try:
        with pytest.raises(OutputError, match="Too many open files"):
            fill_and_open_until_it_fails()
    finally:
        resource.setrlimit(resource.RLIMIT_NOFILE, limits)
    assert list(tmp_path.iterdir()) == []
