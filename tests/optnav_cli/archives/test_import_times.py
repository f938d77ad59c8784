"""Import of a list of times: the geometry of SPICE kernels, as the toolkit itself has it."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from catalog.bodies.epochs import utc_to_tdb_s
from catalog.errors import DataError
from optnav_cli.archives.job import ImportOptions, import_folder
from tests.catalog.bodies.made_kernels import (
    TIMES_S,
    attitude_segment,
    daf,
    orbit_segment,
    write_kernels,
)

UTC = "2009-01-20T00:01:40Z"
CAMERA = """name = "made"
model = "pinhole"
width_px = 6
height_px = 4
focal_length_px = 100.0
principal_point_px = [2.5, 1.5]
"""


@pytest.fixture
def planets(kernels: list[Path], shared_data: Callable[[str], Path]) -> tuple[Path, ...]:
    return tuple(dict.fromkeys((*kernels, shared_data("spice/de405s_littleendian.bsp"))))


def made_times(folder: Path, table: str = "", pieces: int = 1) -> tuple[ImportOptions, list[Path]]:
    """A list of one time, its picture, table, camera and the craft's kernels in a folder."""
    times = utc_to_tdb_s("2009-01-20T00:00:00Z") + TIMES_S
    split = np.split(times, 3)[:pieces:2] if pieces > 1 else [times]
    orbit = daf([orbit_segment(part) for part in split], b"DAF/SPK ")
    attitude = daf([attitude_segment(3, times_s=part) for part in split])
    (folder / "a.pgm").write_bytes(b"P5 6 4 255\n" + bytes(range(24)))
    (folder / "made.toml").write_text(CAMERA)
    (folder / "times.csv").write_text(f"file,utc\na.pgm,{UTC}\n")
    (folder / "t.toml").write_text(
        'format = "times"\ncamera = "made.toml"\nbody = "moon"\n'
        'camera_from_frame = [-1, 0, 0, 0, -1, 0, 0, 0, 1]\n'
        f'[spice]\ncraft = -999\nframe = "MADE_CAMERA"\n{table}'
    )  # fmt: skip
    return ImportOptions(table=str(folder / "t.toml")), write_kernels(folder, attitude, orbit)


@pytest.mark.parametrize("correction", ["", "LT+S", "LT", "NONE"])
def test_position_attitude_and_sun_are_those_of_the_toolkit(
    correction: str, planets: tuple[Path, ...], tmp_path: Path
) -> None:
    table = f'correction = "{correction}"\n' if correction else ""
    options, paths = made_times(tmp_path, table)
    options = ImportOptions(table=options.table, kernels=(*paths, *planets))
    frame = import_folder([tmp_path / "times.csv"], tmp_path / "out", options).frames[0]
    import spiceypy

    et, how = utc_to_tdb_s(UTC), correction or "LT+S"
    seen, light = spiceypy.spkpos("301", et, "MOON_ME", how, "-999")
    light = 0.0 if how == "NONE" else light
    np.testing.assert_allclose(frame.position_m, -1e3 * np.asarray(seen), rtol=1e-12)
    turn = spiceypy.pxform("J2000", "MADE_CAMERA", et)
    turn = np.diag([-1, -1, 1]) @ turn @ spiceypy.pxform("MOON_ME", "J2000", et - light)
    assert frame.camera_from_body is not None
    assert (Rotation.from_matrix(turn).inv() * frame.camera_from_body).magnitude() < 1e-10
    sun, _ = spiceypy.spkpos("10", et - light, "MOON_ME", "LT+S", "301")
    np.testing.assert_allclose(frame.sun_body, sun / np.linalg.norm(sun), atol=1e-9)


def test_a_craft_that_no_planet_kernel_joins_is_seen_without_light_time(
    planets: tuple[Path, ...], tmp_path: Path
) -> None:
    options, paths = made_times(tmp_path)
    rotations = [path for path in planets if path.suffix != ".bsp"]
    options = ImportOptions(table=options.table, kernels=(*paths, *rotations))
    imported = import_folder([tmp_path / "times.csv"], tmp_path / "out", options)
    assert any("light time and aberration: no kernel joins" in line for line in imported.remarks)
    assert imported.frames[0].sun_body is not None


def test_a_time_in_a_gap_is_left_out_with_the_gap(
    planets: tuple[Path, ...], tmp_path: Path
) -> None:
    options, paths = made_times(tmp_path, pieces=3)
    (tmp_path / "times.csv").write_text("file,utc\na.pgm,2009-01-20T00:05:00Z\n")
    options = ImportOptions(table=options.table, kernels=(*paths, *planets))
    with pytest.raises(DataError, match=r"times\.csv, a\.pgm: .*the gap from \S+00:03:10Z to "):
        import_folder([tmp_path / "times.csv"], tmp_path / "out", options)
