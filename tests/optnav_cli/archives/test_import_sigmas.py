"""Default sigmas of imports: what the source can know, by the height above the body."""

from pathlib import Path

import numpy as np
import pytest

from catalog.bodies.body import load_body
from optnav_cli.archives.frame import Share
from optnav_cli.archives.job import ImportOptions, import_folder
from optnav_cli.frames.frames import Frame
from tests.optnav_cli.archives.made_cubes import CAMERA_BODY_KM, Cube, write_cube
from tests.optnav_cli.archives.test_import_times import made_times, planets  # noqa: F401


def height_m(frame: Frame) -> float:
    assert frame.position_m is not None
    return float(np.linalg.norm(frame.position_m)) - load_body("moon").radius_m


def test_the_least_sigma_holds_near_the_body() -> None:
    share = Share(0.01, 10.0)
    assert share.sigma_m(np.array([0.0, 0.0, 250.0 + 240.0]), 240.0) == 10.0
    assert share.sigma_m(np.array([0.0, 0.0, 5240.0]), 240.0) == pytest.approx(50.0)
    assert share.sigma_m(np.array([0.0, 0.0, 100.0]), 240.0) == 10.0


@pytest.mark.parametrize(
    ("orbit", "pointing", "share", "degrees"),
    [
        ("Reconstructed", "Reconstructed", 0.005, 0.1),
        ("Predicted", "Predicted", 0.01, 0.5),
        ("", "", 0.01, 0.5),
        ("Reconstructed", "Nadir", 0.005, None),
    ],
)
def test_a_cube_is_as_good_as_spiceinit_says(
    orbit: str, pointing: str, share: float, degrees: float | None, tmp_path: Path
) -> None:
    kernels = {"InstrumentPositionQuality": orbit, "InstrumentPointingQuality": pointing}
    path = write_cube(tmp_path / "a.cub", Cube(kernels=kernels))
    imported = import_folder([path], tmp_path / "out")
    frame = imported.frames[0]
    from_centre_m = np.linalg.norm(CAMERA_BODY_KM) * 1e3
    assert from_centre_m - height_m(frame) == pytest.approx(load_body("moon").radius_m)
    assert frame.position_sigma_m == pytest.approx(share * height_m(frame))
    sigma = frame.attitude_sigma_rad
    assert (sigma is None) == (degrees is None)
    assert sigma is None or np.degrees(sigma) == pytest.approx(degrees)
    words = f"position {100 * share:g} % of the height"
    assert any(words in line and orbit.lower() in line for line in imported.remarks)


@pytest.mark.parametrize(
    ("orbit", "attitude", "share", "degrees"),
    [
        ("reconstructed", "reconstructed", 2e-4, 0.05),
        ("predict", "predict", 0.005, 0.2),
        ("od137", "rel", 1e-3, 0.1),
    ],
)
def test_kernels_are_as_good_as_their_names_say(
    orbit: str,
    attitude: str,
    share: float,
    degrees: float,
    planets: tuple[Path, ...],  # noqa: F811
    tmp_path: Path,
) -> None:
    options, paths = made_times(tmp_path)
    *texts, bc, bsp = paths
    names = bc.with_name(f"{attitude}.bc"), bsp.with_name(f"{orbit}.bsp")
    for old, new in zip((bc, bsp), names, strict=True):
        old.rename(new)
    options = ImportOptions(table=options.table, kernels=(*texts, *names, *planets))
    imported = import_folder([tmp_path / "times.csv"], tmp_path / "out", options)
    frame = imported.frames[0]
    wanted = max(share * height_m(frame), 1000.0 if orbit == "predict" else 100.0)
    assert frame.position_sigma_m == pytest.approx(wanted)
    assert frame.attitude_sigma_rad == pytest.approx(np.radians(degrees))
    assert any("1-sigma errors are defaults" in line for line in imported.remarks)


def test_stated_sigmas_have_precedence(tmp_path: Path) -> None:
    table = 'format = "isis"\nattitude_sigma_deg = 0.03\nposition_sigma_m = 77.0\nbody = "moon"\n'
    (tmp_path / "t.toml").write_text(table)
    path = write_cube(tmp_path / "a.cub")
    options = ImportOptions(table=str(tmp_path / "t.toml"))
    imported = import_folder([path], tmp_path / "out", options)
    frame = imported.frames[0]
    assert frame.position_sigma_m == 77.0
    assert frame.attitude_sigma_rad == pytest.approx(np.radians(0.03))
    assert not any("defaults" in line for line in imported.remarks)
