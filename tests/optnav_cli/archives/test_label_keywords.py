"""Keywords of labels that say what their numbers mean."""

import tomllib
from pathlib import Path

import pytest

from catalog.config import resource
from catalog.errors import DataError
from optnav_cli.archives.label import ArchiveLabel, read_label
from optnav_cli.archives.label_geometry import KEYWORDS, check_label

REFUSED = [name for name, keyword in KEYWORDS.items() if keyword.fate == "refused"]


def label(folder: Path, key: str, value: str) -> ArchiveLabel:
    """A PDS4 label for keywords in small letters, a PDS3 label for others."""
    if key.islower():
        path = folder / "a.xml"
        path.write_text(
            f"<Product_Observational><A><{key}>{value}</{key}></A></Product_Observational>"
        )
        return read_label(path, "pds4")
    path = folder / "a.lbl"
    path.write_text(f'PDS_VERSION_ID = PDS3\n{key} = "{value}"\nEND\n')
    return read_label(path, "pds3")


@pytest.mark.parametrize("key", REFUSED)
def test_what_changes_the_meaning_of_numbers_is_refused(tmp_path: Path, key: str) -> None:
    with pytest.raises(DataError, match=rf"states {key} = OTHER; {KEYWORDS[key].why}"):
        check_label(label(tmp_path, key, "OTHER"))
    for usual in KEYWORDS[key].allowed:
        assert check_label(label(tmp_path, key, usual)) == []


@pytest.mark.parametrize(
    ("key", "value"), [("TIMESYS", "TDB"), ("TIME_SYSTEM", "ET"), ("RADESYS", "FK4"),
                       ("EQUINOX", "1950.0")]
)  # fmt: skip
def test_other_frames_and_times_are_refused(tmp_path: Path, key: str, value: str) -> None:
    with pytest.raises(DataError, match=f"states {key} = {value}"):
        check_label(label(tmp_path, key, value))


def test_a_window_without_a_value_outside_is_reported(tmp_path: Path) -> None:
    path = tmp_path / "a.lbl"
    path.write_text("PDS_VERSION_ID = PDS3\nCUT_OUT_WINDOW = {2, 1, 399, 392}\nEND\n")
    (remark,) = check_label(read_label(path, "pds3"))
    assert remark.startswith("a.lbl states CUT_OUT_WINDOW = 2,1,399,392: pixels outside")
    path.write_text("PDS_VERSION_ID = PDS3\nCUT_OUT_WINDOW = {1, 1, 800, 800}\nEND\n")
    assert check_label(read_label(path, "pds3")) == []


def test_every_keyword_of_the_shipped_tables_is_decided() -> None:
    for path in resource("configs/imports/pds3.toml").parent.glob("*.toml"):
        table = tomllib.loads(path.read_text("utf-8"))
        if table["format"] not in ("pds3", "pds4", "vicar"):
            continue
        keys = [value for name, value in table["time"].items() if name != "exposure_s"]
        keys += [table.get("target", "")]
        for section in ("attitude", "position", "sun"):
            values = table.get(section, {})
            keys += [values.get("range", "")]
            for name in ("quaternion", "boresight", "keys", "minus", "sub_point", "corners"):
                keys += values.get(name, [])
        flat = [key for entry in keys for key in (entry if isinstance(entry, list) else [entry])]
        for key in filter(None, flat):
            name = key.removeprefix("-").rpartition("/")[2]
            if name != "name":  # of a PDS4 target
                assert KEYWORDS[name].fate == "used", f"{path.name}: {key}"
