"""`optnav cylinder` of a simulated craft, end to end, and what it says of bad folders."""

import logging
import re
import shutil
from pathlib import Path

import cv2
import msgspec
import numpy as np
import pytest

from catalog.config import resource
from catalog.errors import ConfigError, NothingToDoError
from catalog.progress import SilentProgress
from optnav_cli.cylinder.job import measure_cylinder_folder
from optnav_cli.cylinder.page import draw_cylinder_sheet
from optnav_cli.frames.tables import CYLINDER, CYLINDER_TRUTH
from optnav_cli.main import run
from optnav_cli.pages import write_report
from optnav_cli.simulation.cylinder_scenario import CylinderScenario
from optnav_cli.simulation.job import simulate_folder
from optnav_cli.simulation.scenario import load_scenario
from tests.optnav_cli.cylinder.test_geometry import seen


@pytest.fixture(scope="module")
def pictures(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three pictures, 2 seconds apart, of the shipped circling craft, of half the size."""
    place = tmp_path_factory.mktemp("cylinder")
    small = resource("configs/cameras/lab_20deg.toml").read_text(encoding="utf-8")
    for old, new in (
        ("640", "320"), ("480", "240"), ("1815.0", "907.5"), ("319.5", "159.5"), ("239.5", "119.5"),
    ):  # fmt: skip
        small = small.replace(old, new)
    (place / "lab_20deg.toml").write_text(small, encoding="utf-8")
    text = resource("configs/scenarios/cylinder_circle.toml").read_text(encoding="utf-8")
    (place / "circle.toml").write_text(
        text.replace('"lab_20deg"', '"lab_20deg.toml"'), encoding="utf-8"
    )
    scenario = load_scenario(place / "circle.toml")
    assert isinstance(scenario, CylinderScenario)
    simulate_folder(scenario.shortened(3), place / "pictures", SilentProgress())
    return place / "pictures"


def test_a_circling_craft_is_followed(pictures: Path, tmp_path: Path) -> None:
    measure_cylinder_folder(pictures, tmp_path / "run", "fit", SilentProgress())
    rows = CYLINDER.rows(tmp_path / "run" / "cylinder.csv")
    truths = CYLINDER_TRUTH.rows(pictures / "truth.csv")
    assert len(rows) == 3
    for row, truth in zip(rows, truths, strict=True):
        assert (row["status"], row["zone"]) == ("solved", "ok")
        assert abs(row.number("d_m") - truth.number("d_m")) < 2e-3
        assert abs(row.number("theta_deg") - truth.number("theta_deg")) < 0.5
    middle, truth = rows[1], truths[1]
    found, true = (np.array([r.number("vx_m_s"), r.number("vy_m_s")]) for r in (middle, truth))
    assert np.linalg.norm(true) == pytest.approx(0.049, abs=0.004)
    assert np.abs(found - true).max() < 4.0 * middle.number("v_sigma_m_s") + 5e-4
    assert sorted(p.name for p in (tmp_path / "run" / "overlays").iterdir())
    write_report(tmp_path / "run", tmp_path / "run.html")
    assert "A lit cylinder" in (tmp_path / "run.html").read_text(encoding="utf-8")


def test_pictures_of_one_time_have_no_speed_and_say_so(pictures: Path, tmp_path: Path) -> None:
    folder = tmp_path / "same"
    shutil.copytree(pictures, folder)
    lines = (folder / "frames.csv").read_text(encoding="utf-8").splitlines()
    time = lines[1].split(",")[1]
    same = [lines[0], *(",".join([(c := line.split(","))[0], time, *c[2:]]) for line in lines[1:])]
    (folder / "frames.csv").write_text("\n".join(same) + "\n", encoding="utf-8")
    rows = measure_cylinder_folder(folder, tmp_path / "run", "fit", SilentProgress())
    assert all(row.d_m is not None and row.velocity is None for row in rows)
    assert all("one time" in row.reason for row in rows)


def test_a_strip_cut_above_and_beside_has_no_distance(pictures: Path, tmp_path: Path) -> None:
    """Neither its height nor its width is there to measure."""
    folder = tmp_path / "cut"
    shutil.copytree(pictures, folder)
    for place in sorted(folder.glob("*.png")):
        cv2.imwrite(str(place), seen(0.35, 0.0, 40.0).astype(np.uint8))
    with pytest.raises(NothingToDoError):
        measure_cylinder_folder(folder, tmp_path / "run", "fit", SilentProgress())
    rows = CYLINDER.rows(tmp_path / "run" / "cylinder.csv")
    assert all(row["zone"] == "cut" for row in rows)
    assert all("neither its height nor its width" in row["reason"] for row in rows)


def test_zones_are_shaded_in_the_plots(tmp_path: Path) -> None:
    rows = [
        {"file": f"{number}.png", "utc": f"2026-01-01T00:00:0{2 * number}Z", "status": "solved"}
        | {"zone": zone, "d_m": 1.2, "theta_deg": theta}
        for number, (zone, theta) in enumerate((("ok", 20), ("full_face", 3), ("glare", 175)))
    ]
    CYLINDER.write(tmp_path / "cylinder.csv", rows)
    drawn = draw_cylinder_sheet(tmp_path, 0.14)
    for series in ("s3", "s4"):  # over time in two plots, about the axis in the third
        assert drawn.count(f'class="area {series} band"') == 3
    assert 'class="area s1 band"' not in drawn


def test_the_printed_formulas_are_computed(pictures: Path, tmp_path: Path) -> None:
    rows = measure_cylinder_folder(pictures, tmp_path / "run", "printed", SilentProgress())
    assert rows[0].theta_deg == pytest.approx(60.0, abs=5.0)
    assert rows[0].theta_sigma_deg is None


def test_a_height_is_asked_for(pictures: Path, tmp_path: Path) -> None:
    (tmp_path / "folder").mkdir()
    (tmp_path / "folder" / "run.toml").write_text('target = "cylinder"\nradius_m = 0.14\n')
    with pytest.raises(ConfigError, match="height_m"):
        measure_cylinder_folder(tmp_path / "folder", tmp_path / "run", "fit", SilentProgress())


def test_a_folder_of_a_body_is_refused(tmp_path: Path) -> None:
    (tmp_path / "folder").mkdir()
    (tmp_path / "folder" / "run.toml").write_text('body = "moon"\nattitude = "camera_from_body"\n')
    with pytest.raises(ConfigError, match="names no target"):
        measure_cylinder_folder(tmp_path / "folder", tmp_path / "run", "fit", SilentProgress())


def test_missing_pictures_are_rows_with_a_reason(pictures: Path, tmp_path: Path) -> None:
    place = tmp_path / "folder"
    place.mkdir()
    (place / "cameras").mkdir()
    for name in ("run.toml", "frames.csv", "cameras/lab_20deg.toml"):
        (place / name).write_bytes((pictures / name).read_bytes())
    with pytest.raises(NothingToDoError, match="no picture gives a distance"):
        measure_cylinder_folder(place, tmp_path / "run", "fit", SilentProgress())
    rows = CYLINDER.rows(tmp_path / "run" / "cylinder.csv")
    assert all(row["status"] == "unsolved" and row["reason"] for row in rows)
    assert rows[0]["reason"].startswith("frame_0000.png: there is no such picture")


def test_a_craft_inside_the_cylinder_is_refused() -> None:
    scenario = load_scenario(resource("configs/scenarios/cylinder_still.toml"))
    assert isinstance(scenario, CylinderScenario)
    near = msgspec.structs.replace(scenario.cylinder, distance_m=0.1)
    with pytest.raises(ConfigError, match="outside the cylinder"):
        msgspec.structs.replace(scenario, cylinder=near).check()


def coded(pictures: Path, place: Path) -> Path:
    """The same pictures in 8 bits as screens have them, gamma 2.2, by a camera that states none."""
    shutil.copytree(pictures, place)
    for path in (place / "cameras").glob("*.toml"):
        path.write_text(path.read_text().replace('\n[coding]\ncurve = "linear"\n', ""))
    stored = {path: cv2.imread(str(path), cv2.IMREAD_UNCHANGED) for path in place.glob("*.png")}
    full = 1.05 * max(float(values.max()) for values in stored.values())
    for path, values in stored.items():
        cv2.imwrite(str(path), np.rint(255.0 * (values / full) ** (1.0 / 2.2)).astype(np.uint8))
    return place


def distance_errors(run_folder: Path, truth: Path) -> tuple[np.ndarray, np.ndarray, list[str]]:
    true = {row["file"]: row.number("d_m") for row in CYLINDER_TRUTH.rows(truth)}
    rows = [row for row in CYLINDER.rows(run_folder / "cylinder.csv") if row["status"] == "solved"]
    off = np.array([row.number("d_m") - true[row["file"]] for row in rows])
    return off, np.array([row.number("d_sigma_m") for row in rows]), [r["reason"] for r in rows]


def assert_truth_within_sigmas(run_folder: Path, truth: Path) -> None:
    off, sigma, _ = distance_errors(run_folder, truth)
    assert len(off) == 3
    assert (np.abs(off) < 3.0 * sigma).all()


def test_gamma_is_an_unknown_where_no_coding_is_stated(
    pictures: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """Taken for linear, distances are 9 mm short at a stated 0.2 mm."""
    folder = coded(pictures, tmp_path / "coded")
    with caplog.at_level(logging.WARNING):
        assert run(["cylinder", str(folder), "-o", str(tmp_path / "out")]) == 0
    assert_truth_within_sigmas(tmp_path / "out", pictures / "truth.csv")
    off, _, _ = distance_errors(tmp_path / "out", pictures / "truth.csv")
    assert np.abs(off).max() < 4e-3
    (words,) = re.findall(r"states no \[coding\].* ([0-9.]+) at a sigma", caplog.text)
    assert float(words) == pytest.approx(2.2, abs=0.4)


def test_linear_counts_of_an_unstated_coding_have_wider_sigmas(
    pictures: Path, tmp_path: Path
) -> None:
    folder = tmp_path / "unstated"
    shutil.copytree(pictures, folder)
    (camera,) = (folder / "cameras").glob("*.toml")
    assert 'curve = "linear"' in camera.read_text()
    measure_cylinder_folder(folder, tmp_path / "stated", "fit", SilentProgress())
    camera.write_text(camera.read_text().replace('[coding]\ncurve = "linear"\n', ""))
    measure_cylinder_folder(folder, tmp_path / "out", "fit", SilentProgress())
    assert_truth_within_sigmas(tmp_path / "out", pictures / "truth.csv")
    _, stated, _ = distance_errors(tmp_path / "stated", pictures / "truth.csv")
    _, wide, _ = distance_errors(tmp_path / "out", pictures / "truth.csv")
    assert (stated < 5e-4).all()
    assert (wide > 3.0 * stated).all()


def test_colour_pictures_are_taken(pictures: Path, tmp_path: Path) -> None:
    folder = tmp_path / "colour"
    shutil.copytree(pictures, folder)
    for path in folder.glob("*.png"):
        grey = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)[..., None]
        cv2.imwrite(str(path), np.rint(grey * np.array([0.7, 1.0, 0.85])).astype(np.uint8))
    measure_cylinder_folder(folder, tmp_path / "out", "fit", SilentProgress())
    off, _, _ = distance_errors(tmp_path / "out", pictures / "truth.csv")
    assert len(off) == 3
    assert np.abs(off).max() < 1.5e-3


def test_a_stated_coding_gives_the_distances_of_linear_counts(
    pictures: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    folder = coded(pictures, tmp_path / "coded")
    for path in (folder / "cameras").glob("*.toml"):
        path.write_text(path.read_text() + '\n[coding]\ncurve = "gamma"\ngamma = 2.2\n')
    with caplog.at_level(logging.WARNING):
        assert run(["cylinder", str(folder), "-o", str(tmp_path / "out")]) == 0
    off, _, _ = distance_errors(tmp_path / "out", pictures / "truth.csv")
    assert np.abs(off).max() < 1.5e-3
    assert "coding" not in caplog.text
