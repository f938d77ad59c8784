"""run.mcap read back with the mcap reader: schemas, times, poses and marks."""

import base64
import json
from dataclasses import replace

import cv2
import numpy as np
import pytest
from mcap.reader import make_reader
from scipy.spatial.transform import Rotation

from catalog.bodies.body import load_body
from optnav_cli.camera.camera import Camera
from optnav_cli.fix import MatchRow, OutlineMarks
from optnav_cli.output.canvas import scale_to_eight_bits
from optnav_cli.output.recording import (
    MessageLog,
    Recording,
    encode_recorded_image,
    parse_nanoseconds,
)
from tests.optnav_cli.rows import solved, unsolved

MOON = load_body("moon")
UTC = "2023-08-17T05:23:10.250Z"
NS = 1692249790_250000000  # date -u -d 2023-08-17T05:23:10 +%s
UNK = Camera("unk", "pinhole", 640, 480, 900.0, (319.5, 239.5))
FISHEYE = Camera("shnk", "equidistant", 4096, 4096, 1305.0, (2047.5, 2047.5))

# The required fields of the published definitions.
REQUIRED = {
    "foxglove.CompressedImage": {"timestamp", "frame_id", "data", "format"},
    "foxglove.CameraCalibration": set(),
    "foxglove.ImageAnnotations": {"circles", "points", "texts"},
    "foxglove.PoseInFrame": {"timestamp", "frame_id", "pose"},
    "foxglove.FrameTransform": {
        "timestamp",
        "parent_frame_id",
        "child_frame_id",
        "translation",
        "rotation",
    },
    "foxglove.Log": {"timestamp", "level", "message", "name", "file", "line"},
    "foxglove.SceneUpdate": {"deletions", "entities"},
    "optnav.Solution": {
        *("timestamp", "file", "camera", "status", "method", "prior", "reason", "reason_code"),
    },
}
TOPICS = {
    *("/body", "/tf", "/log"),
    *(
        f"/camera/{name}/{what}"
        for name in ("unk", "shnk")
        for what in ("image", "calibration", "annotations", "scene", "control_points", "solution")
    ),
    *("/camera/unk/pose", "/camera/unk/predicted"),
    *(f"/camera/camera/{what}" for what in ("scene", "control_points", "solution")),
}


def conforms(value, schema, where="message"):
    """Check a value against the parts of JSON Schema that these schemas use; no unknown field."""
    if "oneOf" in schema:
        assert value in [option["const"] for option in schema["oneOf"]], where
        return
    types = {"object": dict, "array": list, "string": str, "integer": int, "number": (int, float)}
    types["boolean"] = bool
    assert isinstance(value, types[schema["type"]]), where
    assert isinstance(value, bool) == (schema["type"] == "boolean"), where
    if schema["type"] == "object":
        assert set(schema.get("required", ())) <= set(value), where
        assert set(value) <= set(schema["properties"]), where
        for key, item in value.items():
            conforms(item, schema["properties"][key], f"{where}.{key}")
    elif schema["type"] == "array":
        assert schema.get("minItems", 0) <= len(value) <= schema.get("maxItems", 10**9), where
        for item in value:
            conforms(item, schema["items"], f"{where}[]")
    elif schema["type"] in ("integer", "number"):
        assert schema.get("minimum", value) <= value <= schema.get("maximum", value), where


def a_pose(seed=2):
    rng = np.random.default_rng(seed)
    return rng.normal(size=3) * 1e6, Rotation.random(rng=rng)


def a_frame(file="a.png", utc=UTC):
    position, attitude = a_pose()
    row = solved(
        file, utc, "control_points", position, np.diag([9.0, 16.0, 25.0]), attitude, 0.0,
        n_predicted=3, n_matched=2, n_used=1, residual_rms_px=0.2,
    )  # fmt: skip
    return replace(row, prior="frames.csv", prior_m=position + [300.0, 0.0, 400.0])


MATCHES = [
    MatchRow(
        "a.png", 7, 0, np.ones(3), np.array([10.0, 20.0]), np.array([11.0, 20.5]), 0.9, 0.2, True,
        prior_px=np.array([13.0, 24.0]),
    ),
    MatchRow(
        "a.png", 8, 1, np.ones(3), np.array([30.0, 40.0]), np.array([70.0, 80.0]), 0.7, 0.6,
        reason="residual",
    ),
    MatchRow("a.png", 9, 1, np.ones(3), np.array([np.nan, np.nan]), reason="not found"),
]  # fmt: skip


def read(path):
    with path.open("rb") as file:
        return [
            (schema, channel, message, json.loads(message.data))
            for schema, channel, message in make_reader(file, validate_crcs=True).iter_messages()
        ]


@pytest.fixture
def recorded(tmp_path):
    path = tmp_path / "run.mcap"
    picture = np.arange(480 * 640, dtype=np.float32).reshape(480, 640)
    with Recording(path, MOON) as recording:
        recording.add_frame(
            a_frame(), MATCHES, UNK, encode_recorded_image(scale_to_eight_bits(picture), UNK)
        )
        recording.add_frame(
            unsolved("b.png", "2023-08-17T05:24:10Z", "picture is black"), (), FISHEYE,
            encode_recorded_image(np.zeros((4096, 4096), np.uint8), FISHEYE),
        )  # fmt: skip
        recording.add_frame(unsolved("c.png", "yesterday", "time is not understood"))
    return read(path)


def test_every_message_follows_its_schema_and_its_schema_the_published_one(recorded):
    assert {schema.name for schema, *_ in recorded} == set(REQUIRED)
    for schema, channel, _, content in recorded:
        body = json.loads(schema.data)
        assert (schema.encoding, channel.message_encoding) == ("jsonschema", "json")
        assert body["title"] == schema.name
        assert set(body["required"]) == REQUIRED[schema.name]
        conforms(content, body, schema.name)


def test_each_topic_is_there_its_times_never_go_back_and_nothing_is_no_number(recorded):
    assert {channel.topic for _, channel, *_ in recorded} == TOPICS
    for topic in TOPICS:
        times = [m.log_time for _, channel, m, _ in recorded if channel.topic == topic]
        assert times == sorted(times)
    for _, _, message, _ in recorded:
        json.loads(message.data, parse_constant=pytest.fail)


def test_frames_stand_in_one_tree_that_begins_at_the_body(recorded):
    parents = {
        content["child_frame_id"]: content["parent_frame_id"]
        for schema, _, _, content in recorded
        if schema.name == "foxglove.FrameTransform"
    }
    assert parents == {"unk": "moon"}
    entities = [e for s, _, _, c in recorded if "SceneUpdate" in s.name for e in c["entities"]]
    assert {entity["frame_id"] for entity in entities} == {"moon"}


def test_a_camera_called_like_the_body_has_a_frame_of_its_own(tmp_path):
    camera = replace(UNK, name="moon")
    with Recording(tmp_path / "run.mcap", MOON) as recording:
        recording.add_frame(
            a_frame(), (), camera, encode_recorded_image(np.zeros((480, 640), np.uint8), UNK)
        )
    messages = read(tmp_path / "run.mcap")
    (transform,) = [c for s, _, _, c in messages if s.name == "foxglove.FrameTransform"]
    assert (transform["parent_frame_id"], transform["child_frame_id"]) == ("moon", "moon camera")
    (image,) = [c for s, _, _, c in messages if s.name == "foxglove.CompressedImage"]
    assert image["frame_id"] == "moon camera"


def test_a_solution_is_recorded_in_numbers_and_without_what_is_unknown(recorded):
    first, second, _ = [c for s, _, _, c in recorded if s.name == "optnav.Solution"]
    assert [first[f"sigma_{axis}_m"] for axis in "xyz"] == [3.0, 4.0, 5.0]
    local = [first[f"sigma_{axis}_m"] ** 2 for axis in ("up", "north", "east")]
    assert sum(local) == pytest.approx(50.0)
    assert first["sigma_m"] == pytest.approx(np.sqrt(50.0 / 3.0))
    assert first["moved_from_prior_m"] == pytest.approx(500.0)
    assert (first["n_used"], first["n_predicted"], first["residual_rms_px"]) == (1, 3, 0.2)
    assert (second["status"], second["reason"]) == ("unsolved", "picture is black")
    assert not any(key.startswith(("sigma", "n_", "lat")) for key in second)


def test_a_metadata_record_says_what_the_run_was_made_from(tmp_path):
    about = {"optnav": "0.2.0", "body": "moon", "catalog moon.gpkg": "abc"}
    with Recording(tmp_path / "run.mcap", MOON, None, ("unk",), about) as recording:
        recording.add_frame(a_frame(), (), UNK)
    with (tmp_path / "run.mcap").open("rb") as file:
        (record,) = make_reader(file).iter_metadata()
    assert (record.name, record.metadata) == ("optnav", about)


def test_messages_carry_the_frames_utc(recorded):
    minute = 60 * 10**9
    times = {m.log_time for _, _, m, _ in recorded}
    assert times == {NS, NS - 250_000_000 + minute}
    for _, _, message, content in recorded:
        if "timestamp" in content:
            stamp = content["timestamp"]
            assert stamp["sec"] * 10**9 + stamp["nsec"] == message.log_time == message.publish_time


def test_the_pose_takes_camera_points_to_the_body(recorded):
    position, attitude = a_pose()
    pose, predicted = [c for s, _, _, c in recorded if s.name == "foxglove.PoseInFrame"]
    (transform,) = [c for s, _, _, c in recorded if s.name == "foxglove.FrameTransform"]
    q = pose["pose"]["orientation"]
    body_from_camera = Rotation.from_quat([q["x"], q["y"], q["z"], q["w"]])
    boresight = np.array([0.0, 0.0, 1.0])
    np.testing.assert_allclose(
        body_from_camera.apply(boresight), attitude.inv().apply(boresight), atol=1e-12
    )
    np.testing.assert_allclose(list(pose["pose"]["position"].values()), position, atol=1e-8)
    expected = np.array(list(predicted["pose"]["position"].values()))
    np.testing.assert_allclose(expected - position, [300.0, 0.0, 400.0], atol=1e-6)
    assert (pose["frame_id"], transform["parent_frame_id"]) == ("moon", "moon")
    assert transform["child_frame_id"] == "unk"
    assert transform["rotation"] == q


def test_marks_count_pixels_from_the_corner_and_skip_what_has_no_place(recorded):
    marks = next(c for s, _, _, c in recorded if s.name == "foxglove.ImageAnnotations")
    places = [(c["position"]["x"], c["position"]["y"]) for c in marks["circles"]]
    by_prior = (13.5, 24.5)
    assert places == [by_prior, (10.5, 20.5), (11.5, 21.0), (30.5, 40.5), (70.5, 80.5)]
    assert [t["text"] for t in marks["texts"]] == ["7", "8"]


def test_the_outline_is_recorded_with_its_fit(tmp_path):
    corners = np.array([[10.0, 5.0], [11.0, 5.0], [12.0, 5.0], [13.0, 5.0]])
    down = np.tile([0.0, 1.0], (4, 1))
    limb = OutlineMarks(corners, down, np.array([0.5, 0.5, np.nan, 0.5]))
    disc = OutlineMarks.mark_disc(np.array([30.0, 40.0]))
    with Recording(tmp_path / "run.mcap", MOON) as recording:
        for marks in (limb, disc):
            recording.add_frame(unsolved("b.png", UTC, ""), (), UNK, marks=marks)
    drawn = [c for s, _, _, c in read(tmp_path / "run.mcap") if "ImageAnnotations" in s.name]
    used, left_out, fitted = (
        [(p["x"], p["y"]) for p in part["points"]] for part in drawn[0]["points"]
    )
    assert [part["type"] for part in drawn[0]["points"]] == [1, 1, 3]  # points, points, line strip
    assert used == [(10.5, 5.5), (11.5, 5.5), (13.5, 5.5)]
    assert left_out == [(12.5, 5.5)]
    assert fitted == [(10.5, 6.0), (11.5, 6.0), (13.5, 6.0)]  # half a pixel nearer to the body
    (circle,) = drawn[1]["circles"]
    assert (circle["position"]["x"], circle["position"]["y"]) == (30.5, 40.5)


def test_a_large_picture_is_recorded_smaller_with_its_calibration(recorded):
    images = [c for s, _, _, c in recorded if s.name == "foxglove.CompressedImage"]
    sizes = []
    for image in images:
        data = np.frombuffer(base64.b64decode(image["data"]), np.uint8)
        sizes.append(cv2.imdecode(data, cv2.IMREAD_UNCHANGED).shape)
    assert sizes == [(480, 640), (2048, 2048)]
    unk, fisheye = [c for s, _, _, c in recorded if s.name == "foxglove.CameraCalibration"]
    assert (unk["distortion_model"], unk["D"]) == ("plumb_bob", [0.0] * 5)
    assert (fisheye["distortion_model"], fisheye["D"]) == ("kannala_brandt", [0.0] * 4)
    assert fisheye["width"] == 2048
    # A ray 0.4 rad off the boresight, through OpenCV's fisheye model with the recorded numbers.
    ray = np.array([[[np.tan(0.4), 0.0, 1.0]]])
    small = cv2.fisheye.projectPoints(
        ray, np.zeros(3), np.zeros(3), np.reshape(fisheye["K"], (3, 3)), np.zeros(4)
    )[0][0, 0]
    full = FISHEYE.project(ray[0, 0])
    np.testing.assert_allclose(small, (full + 0.5) / 2.0 - 0.5, atol=1e-9)


def test_each_frame_has_a_log_line_and_an_unsolved_one_says_why(recorded):
    lines = [(c["level"], c["message"]) for s, _, _, c in recorded if s.name == "foxglove.Log"]
    assert lines == [
        (2, "a.png: solved: 1 of 3 control points, rms 0.20 px, sigma 4.1 m an axis"),
        (3, "b.png: unsolved: picture is black"),
        (3, "c.png: unsolved: time is not understood"),
    ]


def test_the_same_run_gives_the_same_bytes(tmp_path):
    for name in ("one", "other"):
        with Recording(tmp_path / name, MOON) as recording:
            recording.add_frame(
                a_frame(), MATCHES, UNK, encode_recorded_image(np.ones((480, 640), np.uint8), UNK)
            )
    assert (tmp_path / "one").read_bytes() == (tmp_path / "other").read_bytes()


def test_messages_are_json_of_finite_numbers_alone(tmp_path):
    schema = {"title": "t", "type": "object"}
    with MessageLog(tmp_path / "a.mcap") as log:
        for value in (0.1, np.float64(1e-7), None, "null", "\udc80"):
            log.add("/t", schema, {"value": value})
        for value in (float("nan"), np.inf, [1.0, np.nan]):
            with pytest.raises(ValueError, match="not JSON compliant"):
                log.add("/t", schema, {"value": value})
    with (tmp_path / "a.mcap").open("rb") as file:
        read = [json.loads(m.data)["value"] for *_, m in make_reader(file).iter_messages()]
    assert read == [0.1, 1e-7, None, "null", "\udc80"]


def test_a_frame_that_cannot_be_written_leaves_nothing_and_the_next_ones_go_on(tmp_path):
    broken = replace(a_frame("a.png"), prior_m=np.full(3, np.inf))
    with Recording(tmp_path / "run.mcap", MOON) as recording:
        with pytest.raises(ValueError, match="JSON"):
            recording.add_frame(
                broken, MATCHES, UNK, encode_recorded_image(np.ones((480, 640), np.uint8), UNK)
            )
        recording.add_frame(a_frame("b.png"), MATCHES, UNK)
    lines = [c["file"] for s, _, _, c in read(tmp_path / "run.mcap") if s.name == "foxglove.Log"]
    assert lines == ["b.png"]


@pytest.mark.parametrize(
    ("utc", "expected"),
    [
        (UTC, NS),
        ("2023-08-17 05:23:10.25+00:00", NS),
        ("2016-12-31T23:59:60Z", 1483228800 * 10**9),
        ("1971-07-31T00:00Z", 49766400 * 10**9),
        ("1971-212T00:00", 49766400 * 10**9),
        ("2023-02-30T00:00:00Z", 77),
        ("9999-12-31T00:00:00Z", 2**64 - 1),
        ("soon", 77),
    ],
)
def test_times_become_nanoseconds_since_1970(utc, expected):
    assert parse_nanoseconds(utc, 77) == expected
