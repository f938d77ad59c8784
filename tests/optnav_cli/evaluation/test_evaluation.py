"""Evaluation: planted errors come back by axis, the covariance test separates good from bad."""

import csv
import json

import numpy as np
import pytest

from catalog.config import resource
from catalog.errors import DataError, DifferenceError, NothingToDoError
from catalog.geometry.rotations import quaternion_from_rotation, rotation_from_quaternion
from optnav_cli.evaluation.evaluation import combine_evaluations
from optnav_cli.evaluation.figures import Limits, check_limits
from optnav_cli.evaluation.files import (
    evaluate_run,
    format_table,
    make_stated_rows,
    read_error_rows,
    write_evaluation,
)
from optnav_cli.frames.run_settings import FileAttitude, read_run_settings
from optnav_cli.output.run_folder import copy_inputs, read_run
from tests.optnav_cli.output.approach import RADIUS_M, write_approach


def test_a_run_at_a_body_of_the_user_s_own_file_is_read_without_its_pictures(tmp_path, make_run):
    make_run(tmp_path / "pictures", count=4)
    text = resource("configs/bodies/moon.toml").read_text()
    own = text.replace('name = "moon"', 'name = "ours"').replace("km = 1737.4 ", "km = 1730.0 ")
    (tmp_path / "ours.toml").write_text(own)
    run_toml = 'body = "../ours.toml"\nattitude = "camera_from_body"\n'
    pictures, run = tmp_path / "pictures", tmp_path / "elsewhere" / "run"
    (pictures / "run.toml").write_text(run_toml)
    run.mkdir(parents=True)
    copy_inputs(pictures, read_run_settings(pictures / "run.toml")[0], run)
    for name in ("solution.csv", "matches.csv", "truth.csv"):
        (pictures / name).rename(run / name)
    (tmp_path / "ours.toml").unlink()
    assert read_run(run).attitude.body.name == "ours"
    evaluation = evaluate_run(run, run / "truth.csv")
    heights = [frame.height_m for frame in evaluation.frames]
    np.testing.assert_allclose(heights, 207.4e3, atol=1e-3)


@pytest.mark.parametrize("attitude", ["camera_from_body", "camera_from_inertial"])
@pytest.mark.parametrize(
    "written",
    ["camera_from_body", "body_from_camera", "camera_from_inertial", "inertial_from_camera"],
)
def test_a_truth_in_another_frame_is_told_so(tmp_path, make_run, attitude, written):
    make_run(tmp_path, count=6, attitude=attitude)
    truth = tmp_path / "truth.csv"
    settings, body = read_run_settings(tmp_path / "run.toml")
    stated = FileAttitude(settings.attitude, body)
    wanted = FileAttitude(
        "camera_from_inertial" if "inertial" in written else "camera_from_body", body
    )
    header, *lines = truth.read_text().splitlines()
    rows = []
    for line in lines:
        cells = line.split(",")
        turn = stated.read(rotation_from_quaternion(*map(float, cells[5:])), cells[1])
        turn = wanted.convert_for_file(turn, cells[1])
        turn = turn if written.startswith("camera") else turn.inv()
        rows.append(",".join([*cells[:5], *map(str, quaternion_from_rotation(turn))]))
    truth.write_text("\n".join([header, *rows]) + "\n")
    evaluation = evaluate_run(tmp_path, truth)
    table, figures = format_table(evaluation), evaluation.figures()
    if written == attitude:
        assert evaluation.remarks == ()
        assert figures.attitude_rms == pytest.approx(1e-5, rel=1e-3)
        return
    assert f"its quaternions are {written}; wanted {attitude}, as run.toml says" in table
    assert figures.attitude_rms is None
    assert "attitude error" not in table.split("its quaternions")[0]
    assert figures.horizontal_rms_m > 0.0
    assert {frame.n_wrong for frame in evaluation.frames} == {None}


@pytest.mark.parametrize("attitude", ["camera_from_body", "camera_from_inertial"])
def test_planted_errors_come_back_along_r_n_and_b(tmp_path, make_run, attitude):
    errors = make_run(tmp_path, attitude=attitude)
    evaluation = evaluate_run(tmp_path, tmp_path / "truth.csv")
    found = np.array([frame.error_rnb_m for frame in evaluation.frames])
    # The truth's chord between neighbours is the tangent to 1e-9, but the files round to 0.1 mm.
    np.testing.assert_allclose(found, errors, atol=2e-3)
    figures = evaluation.figures()
    assert (figures.frames, figures.solved, figures.north_frames) == (40, 40, 0)
    for spread, values in zip((figures.r, figures.n, figures.b), errors.T, strict=True):
        assert spread.bias == pytest.approx(values.mean(), abs=1e-3)
        assert spread.sigma == pytest.approx(np.std(values, ddof=1), abs=1e-3)
        assert spread.rms == pytest.approx(np.sqrt((values**2).mean()), abs=1e-3)
        assert spread.max == pytest.approx(np.abs(values).max(), abs=2e-3)
    across = np.hypot(errors[:, 1], errors[:, 2])
    assert figures.horizontal_rms_m == pytest.approx(np.sqrt((across**2).mean()), abs=1e-3)
    assert figures.attitude_rms == pytest.approx(1e-5, rel=1e-3)


def test_an_honest_covariance_passes_and_one_too_small_or_too_large_does_not(tmp_path, make_run):
    """Errors of 1, 1.4 and 0.7 times the stated sigma: normalised error squared 1, 2 and 0.5."""
    found = []
    for scale in (1.0, 1.4, 0.7):
        folder = tmp_path / str(scale)
        make_run(folder, count=120, scale=scale)
        figures = evaluate_run(folder, folder / "truth.csv").figures()
        found.append(figures.nees)
        low, high = figures.nees_range
        assert (low <= figures.nees <= high) == (scale == 1.0)
    # 360 terms of variance 2: the mean of the first is 1 +- 0.075
    np.testing.assert_allclose(found, np.array([1.0, 1.96, 0.49]), rtol=0.2)


def test_shares_inside_three_sigmas_are_counted_by_component(tmp_path, make_run):
    errors = make_run(tmp_path, count=60, scale=2.5)
    figures = evaluate_run(tmp_path, tmp_path / "truth.csv").figures()
    expected = (np.abs(errors) <= 3.0 * np.array([60.0, 20.0, 15.0])).mean(axis=0)
    assert 0.6 < expected.min() < 0.95
    assert figures.inside_3_sigma == pytest.approx(tuple(expected))


def test_wrong_matches_that_were_kept_are_counted_against_the_true_pose(tmp_path, make_run):
    make_run(tmp_path, count=5)
    figures = evaluate_run(tmp_path, tmp_path / "truth.csv").figures()
    assert (figures.n_checked, figures.n_wrong) == (40, 5)
    assert (figures.n_predicted, figures.n_matched, figures.n_used) == (50, 45, 40)


def test_without_the_cameras_matches_are_not_checked_and_it_is_said(tmp_path, make_run):
    make_run(tmp_path, count=5)
    (tmp_path / "cameras" / "unk.toml").unlink()
    evaluation = evaluate_run(tmp_path, tmp_path / "truth.csv")
    assert evaluation.figures().n_checked is None
    assert "wrong matches: not checked (the run has no camera files" in format_table(evaluation)


def test_a_run_that_kept_windows_alone_is_not_said_to_lack_cameras(tmp_path, make_run):
    make_run(tmp_path, count=5)
    path = tmp_path / "matches.csv"
    with path.open(newline="") as file:
        rows = list(csv.DictReader(file))
    with path.open("w", newline="") as file:
        writer = csv.DictWriter(file, [*(key for key in rows[0] if key != "kind"), "kind"])
        writer.writeheader()
        writer.writerows({**row, "kind": "window"} for row in rows)
    evaluation = evaluate_run(tmp_path, tmp_path / "truth.csv")
    assert evaluation.figures().n_checked == 0
    assert "not checked (no control point was kept; where windows" in format_table(evaluation)


def test_a_lone_frame_is_measured_along_local_north_and_it_is_said(tmp_path, make_run):
    errors = make_run(tmp_path, count=1)
    evaluation = evaluate_run(tmp_path, tmp_path / "truth.csv")
    (frame,) = evaluation.frames
    assert frame.forward == "north"
    # The made-up orbit flies south: N is reversed, and B with it.
    np.testing.assert_allclose(frame.error_rnb_m, errors[0] * [1.0, -1.0, -1.0], atol=2e-3)
    assert evaluation.figures().n.sigma is None
    assert "N is local north for 1 of 1 frames" in format_table(evaluation)


def test_unsolved_frames_count_in_the_share_and_their_reasons_are_listed(tmp_path, make_run):
    make_run(tmp_path, count=10, unsolved_from=7)
    evaluation = evaluate_run(tmp_path, tmp_path / "truth.csv")
    table = format_table(evaluation)
    assert "solved 7 of 10 frames (70.0 %)" in table
    assert "unsolved 3 times: no solution" in table


def test_a_run_without_a_solved_frame_says_so(tmp_path, make_run):
    make_run(tmp_path, count=4, unsolved_from=0)
    with pytest.raises(
        NothingToDoError, match=r"none of the 4 frames is solved.*no solution \(4\)"
    ):
        write_evaluation(evaluate_run(tmp_path, tmp_path / "truth.csv"), tmp_path)
    assert not (tmp_path / "evaluation.json").exists()


def test_limits_name_the_figure_that_passes_them(tmp_path, make_run):
    make_run(tmp_path)
    figures = evaluate_run(tmp_path, tmp_path / "truth.csv").figures()
    check_limits(figures, Limits(1000.0, 1000.0, 1.0, 5.0, 0))
    check_limits(figures, Limits())
    for limits, words in (
        (Limits(5.0, 1000.0), r"^horizontal error .* m \(rms\) passes the limit of 5 m$"),
        (Limits(1000.0, 10.0), r"^height error .* m \(rms\) passes the limit of 10 m$"),
        (Limits(min_solved=41), r"^40 of 40 frames are solved, fewer than the limit of 41$"),
        (Limits(max_nees=0.1), r"^normalised error squared \S+ passes the limit of 0\.1$"),
        (Limits(5.0, 10.0), r"^horizontal error .* 5 m; height error .* 10 m$"),
    ):
        with pytest.raises(DifferenceError, match=words):
            check_limits(figures, limits)


def test_a_share_of_solved_frames_is_told_from_their_number(tmp_path, make_run):
    make_run(tmp_path, count=10, unsolved_from=9)
    figures = evaluate_run(tmp_path, tmp_path / "truth.csv").figures()
    for kept in (9, 0.9, 0.0, 1):
        check_limits(figures, Limits(min_solved=kept))
    for passed, words in ((10, "limit of 10$"), (1.0, r"\(90\.0 %\), fewer .* of 100\.0 %$")):
        with pytest.raises(DifferenceError, match=words):
            check_limits(figures, Limits(min_solved=passed))


def test_frames_off_by_more_than_five_stated_sigmas_are_counted(tmp_path, make_run):
    """Errors of 5 times the stated sigma a component: most are beyond 5 sigmas as a whole."""
    make_run(tmp_path, count=60, scale=5.0)
    evaluation = evaluate_run(tmp_path, tmp_path / "truth.csv")
    figures = evaluation.figures()
    beyond = sum(frame.nees > 25.0 for frame in evaluation.frames)
    assert 30 < figures.beyond_5_sigma == beyond
    assert f"off by more than 5 stated sigmas: {beyond} of 60 solved" in format_table(evaluation)
    check_limits(figures, Limits(max_wrong=beyond))
    with pytest.raises(DifferenceError, match=rf"^{beyond} of 60 solved .* passes the limit of 0$"):
        check_limits(figures, Limits(max_wrong=0))


def test_without_a_solved_frame_the_number_of_solved_ones_alone_is_held_to(tmp_path, make_run):
    make_run(tmp_path, count=4, unsolved_from=0)
    figures = evaluate_run(tmp_path, tmp_path / "truth.csv").figures_if_any()
    check_limits(figures, Limits(1.0, 1.0, None, 1.0, 0))
    with pytest.raises(DifferenceError, match=r"^0 of 4 frames are solved"):
        check_limits(figures, Limits(1.0, min_solved=1))


def test_the_files_hold_the_figures_and_one_row_a_frame(tmp_path, make_run):
    errors = make_run(tmp_path, count=12, unsolved_from=10)
    evaluation = evaluate_run(tmp_path, tmp_path / "truth.csv")
    write_evaluation(evaluation, tmp_path)
    first = (tmp_path / "evaluation.json").read_bytes()
    write_evaluation(evaluation, tmp_path)
    assert (tmp_path / "evaluation.json").read_bytes() == first
    summary = json.loads(first)
    assert summary["share_solved"] == pytest.approx(10 / 12, abs=1e-6)
    assert summary["r"]["rms_m"] == pytest.approx(np.sqrt((errors[:10, 0] ** 2).mean()), abs=2e-3)
    rows = list(csv.DictReader((tmp_path / "evaluation.csv").read_text().splitlines()))
    assert [row["status"] for row in rows] == ["solved"] * 10 + ["unsolved"] * 2
    assert rows[11]["error_r_m"] == ""
    back = read_error_rows(tmp_path / "evaluation.csv")
    assert [row.solved for row in back] == [True] * 10 + [False] * 2
    solved = back[:10]
    np.testing.assert_allclose([row.error_rnb_m for row in solved], errors[:10], atol=2e-3)
    np.testing.assert_allclose(
        [row.sigma_rnb_m for row in solved], [[60.0, 20.0, 15.0]] * 10, atol=1e-2
    )


def test_runs_of_several_seeds_are_pooled_with_their_own_truths(tmp_path, make_run):
    errors = [make_run(tmp_path / str(seed), count=8, seed=seed) for seed in range(3)]
    pooled = combine_evaluations(
        evaluate_run(tmp_path / str(seed), tmp_path / str(seed) / "truth.csv") for seed in range(3)
    ).figures()
    assert (pooled.frames, pooled.n_wrong) == (24, 24)
    assert pooled.height_rms_m == pytest.approx(
        np.sqrt((np.concatenate(errors)[:, 0] ** 2).mean()), abs=1e-3
    )


def edit(path, old, new):
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new))


@pytest.mark.parametrize(
    ("file", "old", "new", "word"),
    [
        ("truth.csv", "frame_0003", "picture_0003", r"truth.csv: the truth has no frame_0003"),
        ("truth.csv", "05:23:", "06:23:", r"frame_0000.png: the run has the time .*, the truth"),
        ("truth.csv", "frame_0001", "frame_0000", r"frame_0000.png\): the file stands there twice"),
        ("truth.csv", "x_m", "x_km", "no column 'x_m'"),
        ("run.toml", "moon", "mooon", "mooon"),
        ("solution.csv", "solved", "sloved", "status is 'sloved'"),
    ],
)  # fmt: skip
def test_a_foreign_truth_or_a_damaged_run_is_named(tmp_path, make_run, file, old, new, word):
    make_run(tmp_path, count=4)
    edit(tmp_path / file, old, new)
    with pytest.raises(DataError, match=word):
        evaluate_run(tmp_path, tmp_path / "truth.csv")


def test_places_that_are_no_run_and_no_truth_are_named(tmp_path, make_run):
    with pytest.raises(DataError, match=r"wanted the folder that `optnav navigate -o` wrote"):
        evaluate_run(tmp_path, tmp_path / "truth.csv")
    make_run(tmp_path / "run", count=2)
    with pytest.raises(DataError, match=r"none\.csv: there is no such file"):
        evaluate_run(tmp_path / "run", tmp_path / "none.csv")


def test_frames_that_only_the_truth_has_are_left_out_with_a_remark(tmp_path, make_run):
    make_run(tmp_path, count=5)
    lines = (tmp_path / "solution.csv").read_text().splitlines(keepends=True)
    (tmp_path / "solution.csv").write_text("".join(lines[:-2]))
    evaluation = evaluate_run(tmp_path, tmp_path / "truth.csv")
    assert "2 frames of the truth are not in the run" in format_table(evaluation)
    # Their places still give the direction of motion.
    assert [frame.forward for frame in evaluation.frames] == ["motion"] * 3


def test_range_and_direction_errors_are_those_planted(tmp_path):
    planted = write_approach(tmp_path / "run")
    evaluation = evaluate_run(tmp_path / "run", tmp_path / "run" / "truth.csv")
    write_evaluation(evaluation, tmp_path / "run")
    checked = 0
    for row in read_error_rows(tmp_path / "run" / "evaluation.csv"):
        height, method, error = planted[row.file]
        assert row.height_m == pytest.approx(height, abs=1e-2)
        assert row.solved == (method is not None)
        if error is None:
            assert row.reason
            continue
        # the chord of three places, not the tangent, turns N and B about R by a little
        across = float(np.hypot(*error[1:]))
        assert row.error_rnb_m[0] == pytest.approx(error[0], abs=1e-2 + 1e-9 * height)
        assert row.range_percent == pytest.approx(100.0 * error[0] / height, abs=2e-6)
        angle = np.degrees(np.arctan2(across, RADIUS_M + height + error[0])) * 3600.0
        assert row.direction_arcsec == pytest.approx(angle, rel=1e-6, abs=1e-3)
        checked += 1
    assert checked == 44


def test_methods_are_told_apart_by_camera_and_ordered_from_afar(tmp_path):
    planted = write_approach(tmp_path / "run", count=48)
    evaluation = evaluate_run(tmp_path / "run", tmp_path / "run" / "truth.csv")
    methods = evaluation.by_method()
    assert [(m.method, m.camera) for m in methods] == [
        ("brightness_centre", "shnk"),
        ("horizon_sphere", "shnk"),
        ("horizon", "unk"),
        ("control_points", "shnk"),
        ("control_points", "unk"),
    ]
    for found in methods:
        errors = [
            (height, error)
            for file, (height, method, error) in planted.items()
            if method == found.method and file.startswith(found.camera)
        ]
        assert (found.figures.solved, found.of_frames) == (len(errors), 48)
        along = np.array([error[0] for _, error in errors])
        assert found.figures.r.bias == pytest.approx(along.mean(), abs=1.0)
        assert found.figures.r.max == pytest.approx(np.abs(along).max(), abs=1.0)
        shares = along / np.array([height for height, _ in errors])
        assert found.range_rms == pytest.approx(np.sqrt((shares**2).mean()), rel=1e-4)
    table = format_table(evaluation)
    assert "horizon, unk" in table
    # no frame of this run counts control points: nothing is said about them
    assert "predicted" not in table


def test_a_run_of_control_points_alone_has_no_table_of_methods(tmp_path, make_run):
    make_run(tmp_path, count=5)
    assert "method, camera" not in format_table(evaluate_run(tmp_path, tmp_path / "truth.csv"))


def test_an_evaluation_of_an_older_version_is_told_to_be_made_anew(tmp_path):
    (tmp_path / "evaluation.csv").write_text("file,utc,status,forward\n")
    with pytest.raises(DataError, match=r"no column 'method'.*optnav evaluate` again"):
        read_error_rows(tmp_path / "evaluation.csv")


def test_an_evaluation_without_a_solved_frame_is_told_to_be_made_anew(tmp_path, make_run):
    """None is ever written."""
    make_run(tmp_path, count=4, unsolved_from=2)
    write_evaluation(evaluate_run(tmp_path, tmp_path / "truth.csv"), tmp_path)
    path = tmp_path / "evaluation.csv"
    header, *rows = path.read_text().splitlines()
    for kept in ([], rows[2:]):
        path.write_text("\n".join([header, *kept]) + "\n")
        with pytest.raises(DataError, match=r"no frame with an error; run `optnav evaluate` again"):
            read_error_rows(path)


def test_without_a_truth_rows_hold_what_the_solutions_state(tmp_path):
    planted = write_approach(tmp_path / "run", scale=0.0)
    rows = make_stated_rows(read_run(tmp_path / "run"))
    assert [row.solved for row in rows] == [method is not None for _, method, _ in planted.values()]
    evaluated = evaluate_run(tmp_path / "run", tmp_path / "run" / "truth.csv").frames
    for row, frame in zip(rows, evaluated, strict=True):
        assert row.error_rnb_m is None
        if row.solved:
            # without errors the solved path is the true one, so the axes are the same, but where
            # unsolved frames leave a gap
            assert row.sigma_rnb_m[0] == pytest.approx(frame.sigma_rnb_m[0], rel=1e-6)
            assert row.range_sigma == pytest.approx(100.0 * frame.range_error[1], rel=1e-5)
            assert row.direction_sigma == pytest.approx(
                np.degrees(frame.direction_error[1]) * 3600.0, rel=1e-3
            )


def test_a_truth_without_quaternions_compares_positions_alone(tmp_path, make_run):
    errors = make_run(tmp_path)
    lines = [line.split(",") for line in (tmp_path / "truth.csv").read_text().splitlines()]
    first = lines[0].index("qw")
    (tmp_path / "truth.csv").write_text("".join(",".join(line[:first]) + "\n" for line in lines))
    evaluation = evaluate_run(tmp_path, tmp_path / "truth.csv")
    found = np.array([frame.error_rnb_m for frame in evaluation.frames])
    np.testing.assert_allclose(found, errors, atol=2e-3)
    assert evaluation.figures().attitude_rms is None
