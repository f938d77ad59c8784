"""Runs of stars and cylinders: compared with truths, exported for GIS programs."""

import csv
import json
import sqlite3
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from catalog.files import replace_folder
from catalog.geometry.rotations import ARCSEC, quaternion_from_rotation
from optnav_cli.frames.tables import ATTITUDES, CYLINDER, QUATERNION
from optnav_cli.main import run
from optnav_cli.output.manifest import write_manifest

UTC = "2024-06-01T10:00:00.000Z"
TURNS = [Rotation.from_rotvec([0.3, -0.2, k]) for k in (0.1, 1.0, 2.0)]
OFF = np.array([[3.0, -4.0, 30.0], [-3.0, 4.0, -30.0], [3.0, 4.0, 30.0]]) * ARCSEC


def made_run(path: Path, kind: str, table, name: str, rows, inputs=None) -> Path:
    from datetime import UTC as zone
    from datetime import datetime

    with replace_folder(path, kind) as place:
        table.write(place / name, rows)
        write_manifest(
            place, kind, command=kind, options={}, inputs=inputs or {}, results={},
            started=datetime.now(zone),
        )  # fmt: skip
    return path


@pytest.fixture
def stars(tmp_path: Path) -> Path:
    rows = []
    for k, (turn, off) in enumerate(zip(TURNS, OFF, strict=True)):
        found = Rotation.from_rotvec(off) * turn
        row = {"file": f"{k}.png", "utc": UTC, "status": "solved", "n_used": 9}
        row |= zip(QUATERNION, quaternion_from_rotation(found), strict=True)
        row |= {"sigma_x_arcsec": 3.0, "sigma_y_arcsec": 4.0, "sigma_z_arcsec": 30.0}
        rows.append(row)
    rows.append({"file": "3.png", "utc": UTC, "status": "unsolved", "reason": "no stars"})
    return made_run(tmp_path / "run", "stars", ATTITUDES, "attitudes.csv", rows)


def star_truth(path: Path, heads: str = "file,qw,qx,qy,qz") -> Path:
    lines = [heads]
    for k, turn in enumerate(TURNS):
        cells = [f"{k}.png", *(f"{v:.15f}" for v in quaternion_from_rotation(turn))]
        lines.append(",".join(cells))
    path.write_text("\n".join(lines) + "\n")
    return path


def test_attitudes_of_stars_are_compared_axis_by_axis(stars: Path, tmp_path: Path, capsys) -> None:
    truth = star_truth(tmp_path / "truth.csv")
    assert run(["evaluate", str(stars), "--truth", str(truth)]) == 0
    assert "solved 3 of 4" in capsys.readouterr().out
    document = json.loads((stars / "evaluation.json").read_text())
    assert [row["quantity"] for row in document["quantities"]] == [f"attitude_{i}" for i in "xyz"]
    assert [row["rms"] for row in document["quantities"]] == pytest.approx(
        [3.0, 4.0, 30.0], rel=1e-4
    )
    assert [row["normalised_error_squared"] for row in document["quantities"]] == pytest.approx(
        [1.0] * 3, rel=1e-3
    )
    with (stars / "evaluation.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert float(rows[0]["error"]) == pytest.approx(3.0, rel=1e-4)
    # again, over the first one
    assert run(["evaluate", str(stars), "--truth", str(truth), "--json"]) == 0


def test_a_body_fixed_truth_of_stars_is_read_as_run_toml_says(stars: Path, tmp_path: Path) -> None:
    """The same truths, but written for the body that turns: no difference remains."""
    from catalog.bodies.body import load_body
    from catalog.bodies.epochs import utc_to_tdb_s
    from catalog.bodies.rotation import body_from_inertial

    inertial = Rotation.from_matrix(body_from_inertial(load_body("moon"), utc_to_tdb_s(UTC)))
    place = tmp_path / "pictures"
    place.mkdir()
    (place / "run.toml").write_text('body = "moon"\nattitude = "camera_from_body"\n')
    lines = ["file,utc,qw,qx,qy,qz"]
    for k, turn in enumerate(TURNS):
        written = quaternion_from_rotation(turn * inertial.inv())
        lines.append(",".join([f"{k}.png", UTC, *(f"{v:.15f}" for v in written)]))
    (place / "truth.csv").write_text("\n".join(lines) + "\n")
    assert run(["evaluate", str(stars), "--truth", str(place / "truth.csv")]) == 0
    document = json.loads((stars / "evaluation.json").read_text())
    assert document["quantities"][2]["rms"] == pytest.approx(30.0, rel=1e-4)


@pytest.mark.parametrize(
    ("lines", "words"),
    [
        (["file,qw,qx,qy,qz", "0.png,1,0,0,0"], "has no 1.png of the run"),
        (["file,qw,qx,qy,qz", *(f"{k}.png,,,," for k in range(3))], "has no quaternion"),
        (["file,x_m", "0.png,1"], "has no column 'qw'"),
        (["file,qw,qx,qy,qz", "0.png,1,0,0,0", "0.png,1,0,0,0"], "stands there twice"),
    ],
)
def test_a_truth_of_something_else_is_refused(
    lines: list[str], words: str, stars: Path, tmp_path: Path, capsys
) -> None:
    (tmp_path / "truth.csv").write_text("\n".join(lines) + "\n")
    assert run(["evaluate", str(stars), "--truth", str(tmp_path / "truth.csv")]) == 3
    assert words in capsys.readouterr().err


def test_limits_of_positions_are_not_for_stars(stars: Path, tmp_path: Path) -> None:
    truth = str(star_truth(tmp_path / "truth.csv"))
    words = ["evaluate", str(stars), "--truth", truth, "--max-horizontal-m", "3"]
    assert run(words) == 2


@pytest.fixture
def cylinder(tmp_path: Path) -> Path:
    rows = [
        {"file": f"{k}.png", "utc": UTC, "status": "solved", "zone": "ok", "d_m": 2.0 + 0.001 * k,
         "d_sigma_m": 0.001, "theta_deg": 179.9, "theta_sigma_deg": 0.2, "bearing_deg": 1.0}
        for k in (1, -1)
    ]  # fmt: skip
    inputs = {"radius_m": 0.5}
    return made_run(tmp_path / "lamp", "cylinder", CYLINDER, "cylinder.csv", rows, inputs)


def test_distances_of_a_cylinder_are_compared_and_angles_go_round(
    cylinder: Path, tmp_path: Path
) -> None:
    truth = tmp_path / "truth.csv"
    truth.write_text(f"file,utc,d_m,theta_deg\n1.png,{UTC},2.0,-179.9\n-1.png,{UTC},2.0,-179.9\n")
    assert run(["evaluate", str(cylinder), "--truth", str(truth)]) == 0
    found = json.loads((cylinder / "evaluation.json").read_text())["quantities"]
    assert [row["quantity"] for row in found] == ["d_m", "theta_deg"]
    assert found[0]["rms"] == pytest.approx(0.001)
    assert found[0]["mean"] == pytest.approx(0.0, abs=1e-9)
    assert found[1]["mean"] == pytest.approx(-0.2)
    assert found[1]["normalised_error_squared"] == pytest.approx(1.0)


def test_both_kinds_are_exported_as_layers(stars: Path, cylinder: Path, tmp_path: Path) -> None:
    assert run(["export", str(stars), "-o", str(tmp_path / "sky.gpkg")]) == 0
    assert run(["export", str(cylinder), "-o", str(tmp_path / "lamp.gpkg")]) == 0
    with sqlite3.connect(tmp_path / "sky.gpkg") as db:
        rows = db.execute(
            "SELECT file, ra_deg, dec_deg, sigma_about_arcsec FROM boresights"
        ).fetchall()
    axis = (Rotation.from_rotvec(OFF[0]) * TURNS[0]).inv().apply([0.0, 0.0, 1.0])
    assert rows[0][1] == pytest.approx(np.degrees(np.arctan2(axis[1], axis[0])), abs=1e-9)
    assert rows[0][3] == 30.0
    assert rows[3] == ("3.png", None, None, None)
    with sqlite3.connect(tmp_path / "lamp.gpkg") as db:
        (box,) = db.execute("SELECT min_x, min_y, max_x, max_y FROM gpkg_contents WHERE "
                            "table_name = 'camera_places'").fetchall()  # fmt: skip
    assert box[1] == pytest.approx(-2.501 * np.cos(np.radians(0.1)), abs=1e-6)
    # another kind of file in the place is left alone
    assert run(["export", str(cylinder), "-o", str(tmp_path / "sky.gpkg")]) == 3
