"""manifest.json: hashes against sha256sum's known value, the same bytes but for the times."""

from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path

import pytest

from catalog.errors import DataError
from catalog.files import hash_file, is_made_by_optnav
from optnav_cli.output.manifest import hash_files, read_manifest, write_manifest

STARTED = datetime(2024, 5, 6, 7, 8, 9, tzinfo=UTC)


def write(folder):
    write_manifest(
        folder,
        "run",
        command="navigate",
        options={"matcher": "ncc", "catalog": Path("moon.gpkg")},
        inputs={"catalog": {"digest": "ab12"}, "pictures": {"a.png": None}},
        started=STARTED,
    )


def test_hashes_are_sha256(tmp_path):
    (tmp_path / "abc").write_bytes(b"abc")  # the first test vector of FIPS 180
    known = "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad"
    assert hash_file(tmp_path / "abc") == known
    assert hash_files(tmp_path, ["z", "abc"]) == {"abc": known, "z": None}
    with pytest.raises(DataError, match="z: cannot be read"):
        hash_file(tmp_path / "z")


def test_a_manifest_marks_its_folder_and_names_versions(tmp_path):
    write(tmp_path)
    manifest = read_manifest(tmp_path)
    assert is_made_by_optnav(tmp_path, "run")
    assert not is_made_by_optnav(tmp_path, "pictures")
    assert manifest["versions"]["numpy"] == version("numpy")
    assert manifest["started_utc"] == "2024-05-06T07:08:09Z"
    assert manifest["options"]["catalog"] == "moon.gpkg"


def test_two_manifests_of_the_same_run_differ_only_in_times(tmp_path):
    texts = []
    for _ in range(2):
        write(tmp_path)
        lines = (tmp_path / "manifest.json").read_text().splitlines()
        texts.append([line for line in lines if "_utc" not in line])
    assert texts[0] == texts[1]


@pytest.mark.parametrize("text", ["{", "[]", '{"made_by": "npm"}'])
def test_a_foreign_or_damaged_manifest_is_refused(tmp_path, text):
    (tmp_path / "manifest.json").write_text(text)
    assert not is_made_by_optnav(tmp_path, "run")
    with pytest.raises(DataError, match=r"manifest\.json"):
        read_manifest(tmp_path)


def test_a_value_without_a_place_in_json_is_a_bug(tmp_path):
    with pytest.raises((TypeError, ValueError)):
        write_manifest(
            tmp_path,
            "run",
            command="navigate",
            options={"limit": float("nan")},
            inputs={},
            started=STARTED,
        )
    assert not (tmp_path / "manifest.json").exists()
