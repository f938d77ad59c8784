"""truth.csv."""

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from catalog.bodies.body import load_body
from catalog.bodies.epochs import utc_to_tdb_s
from catalog.errors import DataError
from optnav_cli.frames.run_settings import FileAttitude
from optnav_cli.frames.truth import Truth, read_truth, write_truth

UTC = "2023-08-17T05:23:00Z"
HEADER = "file,utc,x_m,y_m,z_m,qw,qx,qy,qz"
ROW = f"a.png,{UTC},1837400,0,0,1,0,0,0"
ATTITUDE = FileAttitude("camera_from_body", load_body("moon"))


@pytest.mark.parametrize("attitude", ["camera_from_body", "camera_from_inertial"])
def test_a_truth_reads_back_as_written(attitude: str, tmp_path: Path) -> None:
    written = FileAttitude(attitude, load_body("moon"))  # type: ignore[arg-type]
    rotation = Rotation.from_rotvec([1.0, -2.0, 0.5])
    truth = Truth("a.png", UTC, utc_to_tdb_s(UTC), np.array([1.9e6, 1.5, -2.25]), rotation)
    path = tmp_path / "truth.csv"
    write_truth(path, written, [truth])
    assert path.read_text().splitlines()[0] == HEADER
    (back,) = read_truth(path, written)
    assert (back.file, back.utc, back.tdb_s) == ("a.png", UTC, truth.tdb_s)
    np.testing.assert_allclose(back.position_m, truth.position_m, atol=1e-4)
    assert (back.camera_from_body * rotation.inv()).magnitude() < 1e-11


@pytest.mark.parametrize(
    ("rows", "message"),
    [
        ([ROW, ROW], "row 2 .* twice"),
        ([ROW.replace("1837400", "")], "x_m is empty"),
        ([ROW.replace("1837400,0,0", ",,")], "fill it in"),
        ([ROW.replace("1,0,0,0", "0,0,0,0")], "row 1 .*quaternion"),
        ([ROW.replace("1837400", "nan")], "row 1 .*x_m is nan"),
        ([ROW.replace(UTC, "noon")], "row 1 .*noon"),
        ([ROW[:-2]], "8 values; wanted 9"),
        ([], "no rows"),
    ],
)
def test_a_truth_with_holes_is_refused(rows: list[str], message: str, tmp_path: Path) -> None:
    path = tmp_path / "truth.csv"
    path.write_text("\n".join([HEADER, *rows]) + "\n")
    with pytest.raises(DataError, match=message) as caught:
        read_truth(path, ATTITUDE)
    assert "truth.csv" in str(caught.value)


def test_a_truth_may_come_without_attitudes(tmp_path: Path) -> None:
    path = tmp_path / "truth.csv"
    path.write_text(f"file,utc,x_m,y_m,z_m\na.png,{UTC},1837400,0,0\n")
    (truth,) = read_truth(path, ATTITUDE)
    assert not truth.has_attitude
    write_truth(path, ATTITUDE, [truth])
    assert path.read_text().splitlines()[1].endswith(",,,,")
    assert not read_truth(path, ATTITUDE)[0].has_attitude
