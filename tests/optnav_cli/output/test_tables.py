"""solution.csv and matches.csv: the contract's header, round trips, awkward places."""

import csv
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from catalog.bodies.body import CatalogFrame, load_body
from catalog.errors import DataError
from optnav_cli.fix import MatchRow
from optnav_cli.frames.run_settings import FileAttitude
from optnav_cli.output.tables import (
    format_fixed,
    read_matches,
    read_solutions,
    write_matches,
    write_solutions,
)
from optnav_cli.reasons import ReasonCode
from tests.optnav_cli.rows import solved, unsolved

HEADER = (
    "file,utc,status,method,x_m,y_m,z_m,cov_xx_m2,cov_xy_m2,cov_xz_m2,cov_yy_m2,cov_yz_m2,"
    "cov_zz_m2,qw,qx,qy,qz,attitude_sigma_arcsec,lat_deg,lon_deg,height_m,n_predicted,n_matched,"
    "n_used,residual_rms_px,prior,n_limb,arc_deg,reason,reason_code,"
    "n_windows,n_landmarks,attitude_source"
)
UTC = "2023-08-17T05:23:10.250Z"


@pytest.fixture
def moon():
    return load_body("moon")


def a_solution(position, seed=1, file="a.png"):
    rng = np.random.default_rng(seed)
    half = rng.normal(size=(3, 3)) * 20.0
    return solved(
        file,
        UTC,
        "control_points",
        position,
        half @ half.T + np.eye(3),
        Rotation.random(rng=rng),
        4.8e-5,
        n_predicted=21,
        n_matched=20,
        n_used=19,
        residual_rms_px=0.21,
        prior="arc of 3 fixes",
        n_limb=812,
        arc_deg=143.25,
    )


@pytest.fixture
def moved(moon):
    """The Moon whose catalogs lie elsewhere than positions are stated."""
    return replace(moon, catalog_frame=CatalogFrame((0.1, 0.7, -0.2), (60.0, 49.0, 18.0), 1.0075))


def test_solutions_are_written_in_the_stated_frame(tmp_path, moon, moved):
    row = a_solution(np.array([1.2e6, -1.1e6, 0.9e6]))
    write_solutions(tmp_path / "a.csv", [row], FileAttitude("camera_from_body", moved))
    (back,) = read_solutions(tmp_path / "a.csv", FileAttitude("camera_from_body", moved))
    (stated,) = read_solutions(tmp_path / "a.csv", FileAttitude("camera_from_body", moon))
    np.testing.assert_allclose(back.position_m, row.position_m, atol=1e-3)
    np.testing.assert_allclose(back.covariance_m2, row.covariance_m2, rtol=1e-6)
    frame = moved.catalog_frame
    np.testing.assert_allclose(
        stated.position_m, frame.transform_to_stated(row.position_m), atol=1e-3
    )
    along = frame.stated_from_catalog.apply([0.0, 0.6, 0.8])
    variance = row.covariance_m2[1:, 1:] @ [0.6, 0.8] @ [0.6, 0.8]
    assert along @ stated.covariance_m2 @ along == pytest.approx(1.0075**2 * variance)


@pytest.mark.parametrize("name", ["camera_from_body", "camera_from_inertial"])
def test_solutions_come_back_as_they_were_written(tmp_path, moon, name):
    rng = np.random.default_rng(3)
    attitude = FileAttitude(name, moon)
    rows = [a_solution(rng.normal(size=3) * 1.2e6, seed) for seed in range(5)]
    rows.append(
        unsolved(
            'b,"c".png',
            UTC,
            "no prior: x_m, y_m, z_m are empty",
            ReasonCode.NO_PRIOR,
            n_predicted=3,
        )
    )
    write_solutions(tmp_path / "solution.csv", rows, attitude)
    back = read_solutions(tmp_path / "solution.csv", attitude)
    for row, other in zip(rows[:-1], back[:-1], strict=True):
        np.testing.assert_allclose(other.position_m, row.position_m, rtol=0.0, atol=6e-5)
        np.testing.assert_allclose(other.covariance_m2, row.covariance_m2, rtol=1e-9)
        assert (other.camera_from_body * row.camera_from_body.inv()).magnitude() < 1e-12
        assert other.attitude_sigma_rad == pytest.approx(4.8e-5, rel=1e-6)
        assert (other.n_predicted, other.n_matched, other.n_used) == (21, 20, 19)
        assert other.residual_rms_px == 0.21
        assert (other.prior, other.n_limb, other.arc_deg) == ("arc of 3 fixes", 812, 143.25)
    last = back[-1]
    assert (last.file, last.status, last.reason, last.reason_code) == (
        'b,"c".png',
        "unsolved",
        "no prior: x_m, y_m, z_m are empty",
        ReasonCode.NO_PRIOR,
    )
    assert (last.position_m, last.camera_from_body, last.n_predicted, last.n_used) == (
        None,
        None,
        3,
        None,
    )


def test_the_header_is_the_contracted_one_and_unknown_is_empty(tmp_path, moon):
    path = tmp_path / "solution.csv"
    write_solutions(
        path,
        [unsolved("a.png", UTC, "no prior", ReasonCode.NO_PRIOR)],
        FileAttitude("camera_from_body", moon),
    )
    lines = path.read_bytes().decode().split("\n")
    assert lines == [HEADER, f"a.png,{UTC},unsolved" + "," * 26 + "no prior,no_prior,,,", ""]


def test_the_inertial_attitude_is_the_body_attitude_times_the_bodys_rotation(tmp_path, moon):
    """Half a lunar month apart the same body attitude is written about half a turn apart."""
    rotation = Rotation.random(rng=np.random.default_rng(5))
    attitude = FileAttitude("camera_from_inertial", moon)
    one = attitude.convert_for_file(rotation, "2023-08-01T00:00:00Z")
    # 13.66083 days is half the sidereal month of 27.32166 days.
    other = attitude.convert_for_file(rotation, "2023-08-14T15:51:35Z")
    assert np.degrees((one.inv() * other).magnitude()) == pytest.approx(180.0, abs=0.2)


@pytest.mark.parametrize(
    ("xyz", "lat", "lon", "height"),
    [
        ((0.0, 0.0, 1.8374e6), "90.000000000", None, "100000.0000"),
        ((-1.8374e6, 0.0, 0.0), "0.000000000", "-180.000000000", "100000.0000"),
        ((-1.8374e6, 1e-7, 0.0), "0.000000000", "-180.000000000", "100000.0000"),
        ((-1.8374e6, -1e-7, -1e-7), "0.000000000", "-180.000000000", "100000.0000"),
        ((0.0, -1.7374e6, 0.0), "0.000000000", "-90.000000000", "0.0000"),
    ],
)
def test_places_at_poles_and_the_date_line_are_written_in_range(
    tmp_path, moon, xyz, lat, lon, height
):
    path = tmp_path / "solution.csv"
    write_solutions(path, [a_solution(xyz)], FileAttitude("camera_from_body", moon))
    (row,) = csv.DictReader(path.read_text().splitlines())
    assert row["lat_deg"] == lat
    assert row["height_m"] == height
    assert lon is None or row["lon_deg"] == lon


def test_the_same_solutions_give_the_same_bytes(tmp_path, moon):
    attitude = FileAttitude("camera_from_body", moon)
    for name in ("one.csv", "other.csv"):
        write_solutions(tmp_path / name, [a_solution((1.9e6, 2.0, 3.0))], attitude)
    assert (tmp_path / "one.csv").read_bytes() == (tmp_path / "other.csv").read_bytes()


def test_matches_come_back_as_they_were_written(tmp_path):
    found = MatchRow(
        "a.png",
        7,
        0,
        np.array([1.2e6, -0.9e6, 0.8e6]),
        np.array([100.25, 20.5]),
        np.array([100.5, 20.0]),
        0.91,
        0.32,
        True,
        "",
        23.5,
        np.array([0.25, -0.5]),
        np.array([90.5, 31.25]),
    )
    lost = MatchRow(
        "a.png",
        8,
        3,
        np.array([1.2e6, 0.9e6, 0.8e6]),
        np.array([-3.0, 4.0]),
        reason="below threshold",
        reason_code=ReasonCode.LOW_SCORE,
    )
    write_matches(tmp_path / "matches.csv", [found, lost])
    one, other = read_matches(tmp_path / "matches.csv")
    np.testing.assert_allclose(one.cp_position_m, found.cp_position_m, rtol=0.0, atol=1e-3)
    np.testing.assert_array_equal(one.residual_px, found.residual_px)
    np.testing.assert_array_equal(one.prior_px, found.prior_px)
    assert other.prior_px is None
    assert (one.cp_id, one.level, one.score, one.runner_up, one.used) == (7, 0, 0.91, 0.32, True)
    assert one.sun_elevation_deg == 23.5
    assert (other.measured_px, other.score, other.used) == (None, None, False)
    assert (other.reason, other.reason_code) == ("below threshold", ReasonCode.LOW_SCORE)


@pytest.mark.parametrize(
    ("old", "new", "word"),
    [
        (",solved,", ",maybe,", "status is 'maybe'"),
        ("1900000.0000", "nan", "x_m is nan"),
        ("1900000.0000", "1e200", "the position lies at the centre or beyond 1e"),
        ("1900000.0000", "", "x_m is empty, but"),
        ("cov_xy_m2", "cov", "no column 'cov_xy_m2'; is 'cov' meant"),
        (",19,", ",-19,", "n_used is '-19'"),
        (",control_points,", ",guess,", "method is 'guess'; wanted control_points, horizon"),
        ("143.25,,", "143.25,,why", "'why' is no reason code"),
        ("2.0000", "2.0000,5", "the row has 34 values; wanted 33"),
    ],
)
def test_a_damaged_row_is_named(tmp_path, moon, old, new, word):
    attitude = FileAttitude("camera_from_body", moon)
    path = tmp_path / "solution.csv"
    write_solutions(path, [a_solution((1.9e6, 2.0, 3.0))], attitude)
    path.write_text(path.read_text().replace(old, new, 1))
    with pytest.raises(DataError, match=word) as caught:
        read_solutions(path, attitude)
    assert "solution.csv" in str(caught.value)


def test_a_covariance_that_is_none_is_refused(tmp_path, moon):
    attitude = FileAttitude("camera_from_body", moon)
    bad = solved(
        "a.png",
        UTC,
        "horizon",
        np.array([2e6, 0.0, 0.0]),
        np.diag([1.0, -1.0, 1.0]),
        Rotation.identity(),
        0.0,
        n_predicted=2,
        n_matched=2,
        n_used=2,
        residual_rms_px=None,
    )
    write_solutions(tmp_path / "solution.csv", [bad], attitude)
    with pytest.raises(DataError, match="line 2: the covariance is not positive definite"):
        read_solutions(tmp_path / "solution.csv", attitude)


def test_a_tiny_negative_number_is_written_without_its_sign():
    assert [format_fixed(v, 2) for v in (-0.001, -0.006, None, 0.0)] == [
        "0.00",
        "-0.01",
        "",
        "0.00",
    ]


def test_runs_written_before_reasons_had_codes_are_read(tmp_path, moon):
    path, attitude = tmp_path / "solution.csv", FileAttitude("camera_from_body", moon)
    write_solutions(path, [a_solution(np.array([1.9e6, 0.0, 0.0]))], attitude)
    lines = [line.rsplit(",", 4)[0] for line in path.read_text().splitlines()]
    assert lines[0].endswith(",reason")
    path.write_text("\n".join(lines) + "\n")
    (read,) = read_solutions(path, attitude)
    assert read.solved
    assert read.reason_code == ReasonCode.NONE
