"""`--json`: one document on stdout, with the numbers that people read, whatever the exit code."""

import json
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from catalog.control_point import SHADOW_AZIMUTHS
from optnav_cli.main import run
from optnav_cli.output.wording import format_json
from tests.catalog.made_catalogs import World, make_world

TABLES = Path(__file__).resolve().parents[3] / "optnav_cli" / "TABLES.md"


def unknown_world(seed: int = 7) -> World:
    """A catalog whose first point has no radius and no certificate, and is not usable."""
    world = make_world(seed)
    point, patches = world.points[0]
    nothing = replace(
        point,
        radius_m=float("nan"),
        localisation_nodes=float("nan"),
        uniqueness=(float("nan"),) * world.meta.levels,
        shadow_limit_deg=(float("inf"),) * SHADOW_AZIMUTHS,
        usable=False,
    )
    return replace(world, points=[(nothing, patches), *world.points[1:]])


@pytest.fixture(scope="module")
def catalog(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return unknown_world().write(tmp_path_factory.mktemp("json") / "one.gpkg").path


class Asked:
    """What a command answers with and without --json."""

    def __init__(self, capture: pytest.CaptureFixture[str]) -> None:
        self.capture = capture

    def __call__(self, *words: object, code: int = 0) -> tuple[dict[str, Any], str]:
        """The document and the lines for people; both ways end with the same code."""
        args = [str(word) for word in words]
        self.capture.readouterr()
        assert run(["-q", *args]) == code
        lines = self.capture.readouterr().out
        assert run(["-q", *args, "--json"]) == code
        document = json.loads(self.capture.readouterr().out, parse_constant=pytest.fail)
        assert isinstance(document, dict)
        return document, lines

    def keys(self, words: str, document: dict[str, Any]) -> None:
        """The documents of TABLES.md have the keys that there are, in their order."""
        row = re.search(rf"^\| `optnav {words} --json` \| (.*) \|$", TABLES.read_text(), re.M)
        assert row is not None
        assert row[1].split(" · ")[0].strip("`").split() == list(document)


@pytest.fixture
def ask(capsys: pytest.CaptureFixture[str]) -> Asked:
    return Asked(capsys)


def named(text: str) -> dict[str, str]:
    return dict(line.split(": ", 1) for line in text.splitlines())


def test_info_holds_the_numbers_of_its_lines(ask: Asked, catalog: Path) -> None:
    document, text = ask("catalog", "info", catalog)
    lines = named(text)
    for name in ("points", "usable", "rejected", "cells_on_body", "levels", "size_bytes"):
        assert document[name] == int(lines[name])
    assert document["size_nodes"] == int(lines["size"])
    for name in ("radius_m", "cell_deg", "height_step_m"):
        assert document[name] == float(lines[name])
    assert document["posting_m"] == [float(m) for m in lines["posting_m"].split(", ")]
    assert document["digest"] == lines["digest"]
    assert document["rejected_by_reason"] == {
        name.removeprefix("rejected_").replace("_", " "): int(value)
        for name, value in lines.items()
        if name.startswith("rejected_")
    }
    corners = [float(number) for number in re.findall(r"-?\d+\.\d+", lines["extent_deg"])]
    assert list(document["extent"].values()) == pytest.approx(corners, abs=1e-4)
    assert f"median {document['recognition_rate_usable']['median']:.3f}" in text
    assert (document["relief"], document["planes"]) == (None, None)
    row = TABLES.read_text().partition("`optnav catalog info --json`")[2].partition("\n")[0]
    for name in ("extent", "recognition_rate_usable"):
        assert f"(`{' '.join(document[name])}`)" in row
    ask.keys("catalog info", document)


def test_nearest_and_show_hold_the_point_with_null_for_what_is_unknown(
    ask: Asked, catalog: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    first = unknown_world().points[0][0]
    document, text = ask("catalog", "nearest", catalog, first.lat_deg, first.lon_deg)
    (point,) = document["points"]
    lines = named(text)
    assert point["id"] == first.id == int(lines["id"])
    assert point["lat_deg"] == float(lines["lat_deg"])
    assert point["distance_m"] == pytest.approx(1e3 * float(lines["distance_km"]), abs=0.5)
    assert (point["radius_m"], point["x_m"], point["localisation_nodes"]) == (None, None, None)
    assert point["uniqueness"] == [None] * 3
    assert point["shadow_limit_deg"] == [None] * SHADOW_AZIMUTHS
    assert ", ".join(point["reasons"]) == lines["reasons"].replace("none", "")
    ask.keys("catalog nearest", document)
    shown, text = ask("catalog", "show", catalog, document["points"][0]["id"])
    assert shown["picture"] == named(text)["picture"] == f"one-{first.id}.png"
    assert {name: shown[name] for name in point if name in shown} == {
        name: value for name, value in point.items() if name in shown
    }
    ask.keys("catalog show", shown)


def test_verify_holds_its_findings_and_still_ends_with_3(
    ask: Asked, catalog: Path, tmp_path: Path
) -> None:
    whole, text = ask("catalog", "verify", catalog)
    lines = named(text)
    assert (whole["sound"], whole["problems"], whole["seal"]) == (True, [], "whole")
    assert (whole["points"], whole["patches"]) == (int(lines["points"]), int(lines["patches"]))
    assert whole["digest"] == whole["stated_digest"] == lines["digest"]
    ask.keys("catalog verify", whole)
    damaged, data = tmp_path / "damaged.gpkg", bytearray(catalog.read_bytes())
    data[2 * 65536 - 1000 :: 65536] = bytes(b ^ 1 for b in data[2 * 65536 - 1000 :: 65536])
    damaged.write_bytes(data)
    bad, text = ask("catalog", "verify", damaged, code=3)
    assert bad["sound"] is False
    assert [f"damaged: {p['place']}: {p['what']}" for p in bad["problems"]] == [
        line for line in text.splitlines() if line.startswith("damaged: ")
    ]
    damaged.write_bytes(data[: len(data) // 2])
    assert run(["-q", "catalog", "verify", str(damaged), "--json"]) == 3
    cut = json.loads(ask.capture.readouterr().out)
    assert "cut short" in cut["problems"][0]["what"]
    assert list(cut) == list(whole)


def test_compare_holds_every_point_that_differs_and_ends_with_5(
    ask: Asked, catalog: Path, tmp_path: Path
) -> None:
    same, text = ask("catalog", "compare", catalog, catalog)
    assert (same["same"], same["points"]) == (True, [])
    assert text.endswith("content: the same\n")
    ask.keys("catalog compare", same)
    world = unknown_world()
    (first, patches), *others = world.points
    moved = replace(first, lat_deg=first.lat_deg + 1e-4, radius_m=1737400.0)
    table = tmp_path / "table.csv"
    other = replace(world, points=[(moved, patches), *others[:-1]]).write(tmp_path / "b.gpkg").path
    document, text = ask("catalog", "compare", catalog, other, "-o", table, code=5)
    assert document["same"] is False
    assert (document["counts"]["only_in_first"], document["counts"]["moved"]) == (1, 1)
    assert document["first"]["digest"] == named(text)["first_digest"]
    rows = table.read_text().splitlines()
    assert [str(point["id"]) for point in document["points"]] == [
        row.split(",")[0] for row in rows[1:]
    ]
    assert {tuple(point) for point in document["points"]} == {tuple(rows[0].split(","))}
    by_id = {point["id"]: point for point in document["points"]}
    assert f"{by_id[first.id]['moved_m']:.3f} m" in text
    assert by_id[first.id]["radius_change_m"] is None
    assert by_id[others[-1][0].id]["change"] == "only in first"


def test_evaluate_holds_the_figures_of_its_table(ask: Asked, tmp_path: Path, make_run: Any) -> None:
    made, truth = tmp_path / "run", tmp_path / "run" / "truth.csv"
    make_run(made, count=10, unsolved_from=7)
    document, text = ask("evaluate", made, "--truth", truth)
    assert f"solved {document['solved']} of {document['frames']} frames" in text
    rows = {line.split()[0]: line for line in text.splitlines() if line[:2] in ("R ", "N ", "B ")}
    for axis in "rnb":
        assert f"{document[axis]['rms_m']:.1f}" in rows[axis.upper()]
    assert f"{document['horizontal_rms_m']:.1f}" in text
    assert f"normalised error squared {document['normalised_error_squared']:.2f}" in text
    stored = json.loads((made / "evaluation.json").read_text())
    assert document == {"run": str(made), "truth": str(truth)} | stored | {"limits": []}
    ask.keys("evaluate", document)
    limits = ("--max-height-m", 0.1, "--min-solved", "50%")
    passed, _ = ask("evaluate", made, "--truth", truth, *limits, code=5)
    assert list(passed) == list(document)
    solved, height = passed["limits"]
    assert (solved["name"], solved["limit"], solved["figure"]) == ("min_solved", 0.5, 0.7)
    assert (height["name"], height["limit"], height["kept"]) == ("max_height_m", 0.1, False)
    assert height["figure"] == pytest.approx(document["height_rms_m"], abs=1e-3)


def test_config_list_holds_every_kind(ask: Asked) -> None:
    document, text = ask("config", "list")
    assert all(entry["name"] in text for entries in document.values() for entry in entries)
    ask.keys("config list", document)


def test_evaluate_tells_of_a_run_without_a_solved_frame(
    tmp_path: Path, make_run: Any, capsys: pytest.CaptureFixture[str]
) -> None:
    make_run(tmp_path, count=4, unsolved_from=0)
    words = ["evaluate", str(tmp_path), "--truth", str(tmp_path / "truth.csv"), "--json"]
    assert run(words) == 4
    document = json.loads(capsys.readouterr().out, parse_constant=pytest.fail)
    assert (document["frames"], document["solved"], document["share_solved"]) == (4, 0, 0.0)
    assert (document["height_rms_m"], document["r"]["rms_m"]) == (None, None)
    assert list(document["unsolved_reasons"].values()) == [4]
    assert run([*words, "--min-solved", "1"]) == 5
    assert run([*words, "--max-wrong", "0"]) == 4
    for share in ("-1", "1.5", "101%", "many"):
        assert run([*words, "--min-solved", share]) == 2


def test_numbers_without_a_value_are_null_at_any_depth() -> None:
    text = format_json(
        {
            "a": [np.float32("nan"), np.array([1.5, np.inf]), {"b": float("-inf")}],
            "n": np.int64(3),
            "flag": np.bool_(True),
            "path": Path("x"),
        }
    )
    assert json.loads(text) == {
        "a": [None, [1.5, None], {"b": None}],
        "n": 3,
        "flag": True,
        "path": "x",
    }


def test_a_document_can_be_printed_in_any_locale() -> None:
    name = "Höhe\udcff.tif"  # a name that is not UTF-8, as Python holds it
    text = format_json({"path": Path(name)})
    assert text.isascii()
    assert json.loads(text)["path"] == name


def test_what_has_no_place_in_a_document_is_a_bug() -> None:
    with pytest.raises(TypeError, match="no place in a document"):
        format_json({"a": object()})
