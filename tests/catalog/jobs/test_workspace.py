"""The work folder keeps what is whole, refuses what is not its own, and is one process's."""

import os
import subprocess
import sys

import msgspec
import pytest

from catalog.errors import OutputError
from catalog.jobs.workspace import Workspace, compute_stage_key, encode_records, hash_contents
from catalog.progress import SilentProgress


class Thing(msgspec.Struct):
    cell: int


def test_a_missing_folder_is_made_and_known_again(tmp_path):
    Workspace(tmp_path / "a" / "b").put("x/y.bin", b"123")
    assert Workspace(tmp_path / "a" / "b").get("x/y.bin") == b"123"


def test_a_folder_with_other_things_is_refused_and_left_alone(tmp_path):
    (tmp_path / "thesis.txt").write_text("years of work")
    with pytest.raises(OutputError, match="not a work folder of optnav"):
        Workspace(tmp_path)
    assert [p.name for p in tmp_path.iterdir()] == ["thesis.txt"]


def test_a_file_is_no_work_folder(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(OutputError, match="is a file"):
        Workspace(tmp_path / "file")


def test_a_workspace_of_another_format_is_refused(tmp_path):
    Workspace(tmp_path)
    (tmp_path / "optnav-workspace.json").write_text('{"made_by": "optnav", "format": 99}')
    with pytest.raises(OutputError, match="another version"):
        Workspace(tmp_path)


@pytest.mark.skipif(os.geteuid() == 0, reason="root writes anywhere")
def test_an_unwritable_place_is_refused(tmp_path):
    tmp_path.chmod(0o500)
    with pytest.raises(OutputError, match="cannot be written"):
        Workspace(tmp_path / "work")


def test_a_place_under_a_file_is_refused(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(OutputError, match="cannot be written"):
        Workspace(tmp_path / "file" / "work")


def test_a_write_that_fails_leaves_the_old_file_and_no_remains(tmp_path, monkeypatch):
    workspace = Workspace(tmp_path)
    workspace.put("a.bin", b"old")

    def full(_handle):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("os.fsync", full)
    with pytest.raises(OutputError, match="No space left"):
        workspace.put("a.bin", b"new")
    assert workspace.get("a.bin") == b"old"
    assert not list(tmp_path.glob("*.partial"))


def test_what_a_killed_process_was_writing_goes_when_the_next_one_begins(tmp_path):
    workspace = Workspace(tmp_path)
    workspace.put("s/whole.bin", b"all of it")
    (tmp_path / "s" / "torn.bin.4711.partial").write_bytes(b"half of")
    with workspace.lock():
        assert [path.name for path in (tmp_path / "s").iterdir()] == ["whole.bin"]


def test_damaged_results_count_as_missing(tmp_path):
    workspace = Workspace(tmp_path)
    data = encode_records([Thing(5)])
    workspace.put("s/good.bin", data)
    workspace.put("s/bad.bin", data[:-1])
    assert [r.cell for r in workspace.read_records("s/good.bin", Thing)] == [5]
    assert workspace.read_records("s/bad.bin", Thing) is None
    assert workspace.read_records("s/none.bin", Thing) is None
    assert not workspace.path("s/bad.bin").exists()


HOLD = """
import sys, time
from pathlib import Path
from catalog.jobs.workspace import Workspace
with Workspace(Path(sys.argv[1])).lock():
    print("held", flush=True)
    time.sleep(60)
"""


def test_two_processes_do_not_share_a_workspace_and_a_killed_one_leaves_no_lock(tmp_path):
    holder = subprocess.Popen(
        [sys.executable, "-c", HOLD, str(tmp_path)], stdout=subprocess.PIPE, text=True
    )
    try:
        assert holder.stdout is not None
        assert holder.stdout.readline() == "held\n"
        workspace = Workspace(tmp_path)
        busy = pytest.raises(OutputError, match=f"process {holder.pid} works in it")
        with busy, workspace.lock():
            pass
        holder.kill()
        holder.wait()
        with workspace.lock():
            pass
    finally:
        holder.kill()
        holder.communicate()


def test_keys_follow_all_settings_and_nothing_else():
    assert compute_stage_key("a", {"x": 1, "y": 2}) == compute_stage_key("a", {"y": 2, "x": 1})
    keys = {
        compute_stage_key("a", 1),
        compute_stage_key("a", 2),
        compute_stage_key("b", 1),
        compute_stage_key("a", "1"),
    }
    assert len(keys) == 4


def test_results_of_other_keys_are_removed(tmp_path):
    workspace = Workspace(tmp_path)
    for key in ("old", "new"):
        workspace.put(f"render-{key}/chunk-00000.bin", b"")
    workspace.put("check-old/chunk-00000.bin", b"")
    workspace.keep_only("render", {"new"})
    assert sorted(p.name for p in tmp_path.iterdir() if p.is_dir()) == ["check-old", "render-new"]


@pytest.mark.parametrize("left", [b"\xff{", b"[" * 100_000, b'{"a": "not a hash"}', b"null", b""])
def test_damaged_checksums_are_computed_again(tmp_path, left):
    path = tmp_path / "dem.tif"
    path.write_bytes(b"heights")
    workspace = Workspace(tmp_path / "work")
    whole = hash_contents([path], workspace, SilentProgress())
    (file,) = workspace.folder.glob("*hashes*")
    file.write_bytes(
        left.replace(b"a", os.fsencode(next(iter(msgspec.json.decode(file.read_bytes())))))
    )
    assert hash_contents([path], workspace, SilentProgress()) == whole


def test_a_damaged_mark_is_another_version(tmp_path):
    Workspace(tmp_path)
    (tmp_path / "optnav-workspace.json").write_bytes(b"\xff\xff")
    with pytest.raises(OutputError, match="another version"):
        Workspace(tmp_path)
