"""Settings are read strictly: what is wrong is named by file, section and key."""

import os
from pathlib import Path
from typing import Annotated, Literal

import msgspec
import pytest

from catalog.config import load_toml, nearest_name, parse_toml, resource
from catalog.errors import ConfigError


class Dem(msgspec.Struct):
    path: str
    priority: Annotated[int, msgspec.Meta(ge=1)] = 1
    heights: Literal["height", "radius"] = "height"
    corner: tuple[float, float] | None = None


class Select(msgspec.Struct, forbid_unknown_fields=True):
    edge_sigma_px: Annotated[float, msgspec.Meta(gt=0, le=9)] = 1.0
    posting_m: float | None = None

    def __post_init__(self) -> None:
        if self.posting_m == 7.0:
            raise ValueError("posting_m must not be 7")


class Config(msgspec.Struct):
    dem: list[Dem]
    select: Select
    named: dict[str, Dem] = {}
    title: str = ""


GOOD = '[select]\n[[dem]]\npath = "a.tif"\n'


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("[select]\nedge_sigma = 1\n", "[select] has no setting 'edge_sigma'; did you mean 'edge_sigma_px'?"),
        ("[selct]\n", "it has no section [selct]; did you mean [select]?"),
        (GOOD + "edge_sigma_px = 1", "[[dem]] number 1 has no setting 'edge_sigma_px'; it belongs to [select]"),
        (GOOD + "zzz = 1", "[[dem]] number 1 has no setting 'zzz'; it knows corner, heights, path, priority"),
        (GOOD + '[named.north]\npath = "b"\nprioritty = 2', "[named.north] has no setting 'prioritty'; did you mean 'priority'?"),
        ("[select]\nedge_sigma_px = '1'\n[[dem]]\npath = 'a'", '[select] edge_sigma_px = "1": must be a number'),
        ("[select]\nedge_sigma_px = 10\n[[dem]]\npath = 'a'", "[select] edge_sigma_px = 10: must be a number <= 9.0"),
        ("[select]\nedge_sigma_px = true\n[[dem]]\npath = 'a'", "[select] edge_sigma_px = true: must be a number"),
        ("[select]\nedge_sigma_px = nan\n[[dem]]\npath = 'a'", "[select] edge_sigma_px must be a finite number"),
        ("[select]\nposting_m = 7\n[[dem]]\npath = 'a'", "[select]: posting_m must not be 7"),
        (GOOD + "priority = 0", "[[dem]] number 1 priority = 0: must be a whole number >= 1"),
        (GOOD + "heights = 'hight'", "[[dem]] number 1 heights = \"hight\": must be one of height, radius; did you mean 'height'?"),
        (GOOD + "corner = [1]", "[[dem]] number 1 corner: must be a list of length 2; it is 1 long"),
        (GOOD + "corner = [1, inf]", "[[dem]] number 1 corner, item 2 must be a finite number"),
        (GOOD + "corner = [1, 'x']", '[[dem]] number 1 corner, item 2 = "x": must be a number'),
        ("[select]\n[[dem]]\npriority = 2", "[[dem]] number 1 needs the setting 'path'; add it"),
        ("[select]", "it has no section [[dem]]; add at least one"),
        ("dem = []", "it has no section [select]; add it"),
        ("[select]\ndem = 3", "[select] has no setting 'dem'; it belongs to the top of the file"),
        ("dem = 3\n[select]", "dem = 3: must be a list"),
        ("title = []\n" + GOOD, "title: must be text; it is a list"),
        ("[select\n", "not valid TOML: Expected ']' at the end of a table declaration (at line 1, column 8)"),
        ("title = 'a'\ntitle = 'b'\n", "not valid TOML: Cannot overwrite a value (at line 2, column 12)"),
    ],
)  # fmt: skip
def test_a_mistake_is_named_with_its_place_and_remedy(text: str, message: str) -> None:
    with pytest.raises(ConfigError) as error:
        parse_toml(text, Config, "moon.toml")
    assert str(error.value) == f"moon.toml: {message}"


def test_a_right_file_gives_the_settings(tmp_path: Path) -> None:
    path = tmp_path / "a.toml"
    path.write_bytes(b"\xef\xbb\xbf" + GOOD.replace("\n", "\r\n").encode())
    config = load_toml(path, Config)
    assert config == Config(dem=[Dem("a.tif")], select=Select())


def test_a_whole_number_is_taken_where_a_number_is_wanted() -> None:
    text = "[select]\nedge_sigma_px = 2\n[[dem]]\npath = 'a'"
    assert parse_toml(text, Config, "x").select.edge_sigma_px == 2.0


def test_a_missing_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"no\.toml: there is no such file; check the path"):
        load_toml(tmp_path / "no.toml", Config)


def test_a_folder_is_not_taken_for_a_config(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="is a folder; name a file"):
        load_toml(tmp_path, Config)


def test_a_file_that_is_not_utf8_is_refused_with_its_line(tmp_path: Path) -> None:
    path = tmp_path / "latin.toml"
    path.write_bytes(b"[select]\n# caf\xe9\n")
    with pytest.raises(ConfigError, match=r"latin\.toml: line 2 is not UTF-8 text"):
        load_toml(path, Config)


def test_a_picture_given_as_config_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "picture.png"
    path.write_bytes(bytes(range(256)))
    with pytest.raises(ConfigError, match="not UTF-8"):
        load_toml(path, Config)


def test_shipped_files_are_found() -> None:
    assert resource("configs/bodies/moon.toml").read_text(encoding="utf-8")
    assert resource("data/moon_gld100_4ppd.tif").stat().st_size > 100_000


@pytest.mark.parametrize(
    "name",
    [
        "configs/../pyproject.toml",
        "errors.py",
        "/etc/passwd",
        "data",
        "data/nul\0",
        "configs/bodies/\0.toml",
    ],
)
def test_only_data_and_configs_are_resources(name: str) -> None:
    with pytest.raises(ConfigError, match="optnav ships no file"):
        resource(name)


def test_a_missing_resource_names_what_is_there() -> None:
    with pytest.raises(ConfigError, match=r"'configs/bodies/vulcan\.toml'; it has .*moon\.toml"):
        resource("configs/bodies/vulcan.toml")


@pytest.mark.parametrize(
    ("name", "meant"),
    [("edge_sigma", "edge_sigma_px"), ("sgima", "sigma"), ("qqq", None), ("post", "posting_m")],
)
def test_the_nearest_name_is_the_one_meant(name: str, meant: str | None) -> None:
    assert nearest_name(name, ["edge_sigma_px", "sigma", "posting_m"]) == meant


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("posting_m = " + "9" * 5000, "not valid TOML"),
        ("posting_m = 0x" + "f" * 5000, r"\[select\] posting_m must be a whole number of at most"),
        ("posting_m = 1e400", "must be a finite number"),
        ("posting_m = " + "[" * 2000 + "]" * 2000, "too deep"),
        ("posting_m = " + "[" * 60 + "]" * 60, "lists or sections in each other"),
        ("a." * 2000 + "b = 1", "lists or sections|too deep"),
    ],
)
def test_numbers_and_lists_that_no_setting_can_be_are_refused(text: str, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        parse_toml(f'[select]\n{text}\n[[dem]]\npath = "a.tif"\n', Config, "a.toml")


def test_what_is_no_file_is_refused_at_once(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe.toml")
    (tmp_path / "loop.toml").symlink_to("loop.toml")
    (tmp_path / "large.toml").write_bytes(b"# \n" * 2_000_000)
    wanted = {"pipe": "pipe or a device", "loop": "cannot be read", "large": "at most 4"}
    for name, message in wanted.items():
        with pytest.raises(ConfigError, match=message):
            load_toml(tmp_path / f"{name}.toml", Config)
    with pytest.raises(ConfigError, match="not a name"):
        load_toml("a\0b.toml", Config)
