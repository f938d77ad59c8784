"""A worker that would do the work otherwise says what differs."""

import os
import re

import pytest

from catalog.jobs.cluster import collect_needs, find_misfit


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"code": "0" * 64}, "runs other code of optnav"),
        ({"files": {"/no/such/dem.tif": (1, "")}}, "/no/such/dem.tif: cannot be read there"),
    ],
)
def test_a_worker_that_is_not_fit_says_why(change, reason):
    needs = collect_needs([])
    assert find_misfit(needs) is None
    assert reason in (find_misfit({**needs, **change}) or "")


def test_a_worker_with_other_libraries_is_not_fit():
    needs = collect_needs([])
    needs["surroundings"] = tuple(
        (name, "1.0" if name == "numpy" else found) for name, found in needs["surroundings"]
    )
    assert re.match(r"has numpy [2-9].*, the build 1\.0:", find_misfit(needs) or "")


@pytest.mark.parametrize("change", [b"short", b"longer than it was before", None])
def test_a_file_of_other_content_is_told_by_its_path(tmp_path, change):
    path = tmp_path / "dem.tif"
    path.write_bytes(b"0" * 300_000)
    needs = collect_needs([path])
    os.utime(path, (1, 1))  # copies have other dates
    assert find_misfit(needs) is None
    data = bytearray(b"0" * 300_000) if change is None else change
    if change is None:
        data[150_000:160_000] = b"1" * 10_000
    path.write_bytes(data)
    assert (find_misfit(needs) or "").startswith(f"{path}: is another file there")
