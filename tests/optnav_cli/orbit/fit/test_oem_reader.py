"""OEMs of other writers: each keyword that changes a number is used, or refused by its name."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from catalog.errors import DataError
from optnav_cli.orbit.fit.oem_reader import J2000_EPOCHS, KEYWORDS, read_oem

GM = 4902.8e9
RADIUS, TILT = 1.9e6, Rotation.from_euler("xz", [0.7, 0.3])
RATE = np.sqrt(GM / RADIUS**3)
META = {
    "OBJECT_NAME": "CRAFT",
    "OBJECT_ID": "2026-001A",
    "CENTER_NAME": "MOON",
    "REF_FRAME": "EME2000",
    "TIME_SYSTEM": "TDB",
}
START = 86400.0 * 9539  # TDB s of 2026-02-12T12:00:00


def circle(seconds):
    """True states (n, 9), with accelerations, km, of a circular orbit."""
    angle = RATE * np.atleast_1d(seconds)
    out = np.stack([np.cos(angle), np.sin(angle), 0.0 * angle], axis=1)
    on = np.stack([-np.sin(angle), np.cos(angle), 0.0 * angle], axis=1)
    rows = [RADIUS * out, RADIUS * RATE * on, -RADIUS * RATE**2 * out]
    return np.concatenate([TILT.apply(part) for part in rows], axis=1) / 1e3


def stamp(seconds):
    whole = np.datetime64("2026-02-12T12:00:00.000") + np.timedelta64(round(1e3 * seconds), "ms")
    return str(whole)


def segment(seconds, meta=(), numbers=6, states=None, covariances=()):
    """Text of a segment; covariances: (seconds, matrix, further lines) of each."""
    seconds = np.asarray(seconds, float)
    states = circle(seconds) if states is None else states
    lines = ["META_START", *(f"{k} = {v}" for k, v in {**META, **dict(meta)}.items()), "META_STOP"]
    for time, state in zip(seconds, states, strict=True):
        lines.append(" ".join([stamp(time), *(f"{v:.12f}" for v in state[:numbers])]))
    if covariances:
        lines.append("COVARIANCE_START")
        for time, matrix, more in covariances:
            lines += [f"EPOCH = {stamp(time)}", *more]
            lines += [" ".join(f"{v:.17e}" for v in matrix[k, : k + 1]) for k in range(6)]
        lines.append("COVARIANCE_STOP")
    return "\n".join(lines) + "\n"


@pytest.fixture
def read(tmp_path):
    def reads(*segments, version="2.0", header="", body="moon"):
        head = f"CCSDS_OEM_VERS = {version}\nCREATION_DATE = 2026-01-01\nORIGINATOR = US\n"
        (tmp_path / "a.oem").write_text(head + header + "".join(segments), encoding="utf-8")
        return read_oem(tmp_path / "a.oem", body)

    return reads


SPREAD = np.diag([1.0, 9.0, 4.0, 1e-6, 4e-6, 9e-6]) + 0.0
SPREAD[3, 1] = SPREAD[1, 3] = -2e-3
EVERY = np.arange(0.0, 3601.0, 300.0)


def axes_of(state, kind):
    """Axes as rows, from the words of CCSDS 502.0 alone."""
    r, v = state[:3], state[3:6]
    h = np.cross(r, v)
    r, v, h = (x / np.linalg.norm(x) for x in (r, v, h))
    if kind in ("TNW", "TNW_INERTIAL"):
        return np.array([v, np.cross(h, v), h])
    if kind == "NTW":
        return np.array([np.cross(v, h), v, h])
    return np.array([r, np.cross(h, r), h]) if kind else np.eye(3)


@pytest.mark.parametrize(
    "kind",
    [
        "",
        "ICRF",
        "EME2000",
        "RTN",
        "RSW",
        "RIC",
        "QSW",
        "TNW",
        "NTW",
        "RTN_INERTIAL",
        "TNW_INERTIAL",
    ],
)
def test_a_covariance_is_turned_from_the_axes_that_it_states(kind, read):
    # an eccentric orbit, so that the velocity is not square to the radius
    states = circle(EVERY)
    states[:, 3:6] += 0.2 * states[:, :3] / 1.9e3
    more = [f"COV_REF_FRAME = {kind}"] if kind else []
    found = read(segment(EVERY, states=states, covariances=[(600.0, SPREAD, more)]))
    inner = "" if kind in ("ICRF", "EME2000") else kind
    turn = np.kron(np.eye(2), axes_of(states[2], inner))
    assert np.allclose(found.covariances[0], 1e6 * turn.T @ SPREAD @ turn, rtol=1e-9, atol=1e-6)


def test_covariances_of_one_block_have_frames_of_their_own(read):
    both = [(0.0, SPREAD, ["COV_REF_FRAME = RTN"]), (300.0, SPREAD, [])]
    found = read(segment(EVERY, covariances=both))
    assert not np.allclose(found.covariances[0], 1e6 * SPREAD)
    assert np.allclose(found.covariances[1], 1e6 * SPREAD)


def test_a_covariance_between_states_is_turned_by_the_state_there(read):
    found = read(segment(EVERY, covariances=[(450.0, SPREAD, ["COV_REF_FRAME = RTN"])]))
    turn = np.kron(np.eye(2), axes_of(circle(450.0)[0], "RTN"))
    assert np.allclose(found.covariances[0], 1e6 * turn.T @ SPREAD @ turn, rtol=1e-5, atol=1.0)


@pytest.mark.parametrize("kind", ["RTN_ROTATING", "LVLH", "VVLH", "ITRF", "MOON_ME", "SPACECRAFT"])
def test_axes_of_a_covariance_that_are_not_known_are_refused(kind, read):
    with pytest.raises(DataError, match=f"line [0-9]+: COV_REF_FRAME = {kind}; wanted RTN"):
        read(segment(EVERY, covariances=[(600.0, SPREAD, [f"COV_REF_FRAME = {kind}"])]))


@pytest.mark.parametrize(
    ("method", "degree", "atol_m"),
    # errors of the polynomials themselves on states 300 s apart; a wrong degree misses them
    [("LAGRANGE", 9, 1.0), ("LAGRANGE", 4, 3e3), ("HERMITE", 7, 0.5), ("HERMITE", 3, 100.0)],
)
def test_states_are_interpolated_by_the_degree_stated(method, degree, atol_m, read):
    meta = {"INTERPOLATION": method, "INTERPOLATION_DEGREE": degree}
    found = read(segment(EVERY, meta))
    (part,) = found.segments
    assert (part.method, part.degree) == (method, degree)
    off = [
        np.abs(found.state_at(START + t)[:3] - 1e3 * circle(t)[0, :3]).max()
        for t in (150.0, 1000.0, 1801.0)
    ]
    assert 1e-5 * atol_m < max(off) < atol_m
    assert np.array_equal(found.state_at(START + 600.0), found.states[2])


def test_a_line_is_a_line(read):
    found = read(segment(EVERY, {"INTERPOLATION": "linear"}))
    middle = 0.5 * (found.states[0] + found.states[1])
    assert np.allclose(found.state_at(START + 150.0), middle, atol=1e-6)


def test_accelerations_serve_the_velocity_between_states(read):
    meta = {"INTERPOLATION": "HERMITE", "INTERPOLATION_DEGREE": 3}
    errors = []
    for numbers in (6, 9):
        speed = read(segment(EVERY, meta, numbers)).state_at(START + 80.0)[3:]
        errors.append(np.abs(speed - 1e3 * circle(80.0)[0, 3:6]).max())
    assert errors[1] < 0.3 * errors[0]


def test_segments_with_a_border_in_common_are_not_mixed(read):
    meta = {"INTERPOLATION": "LAGRANGE", "INTERPOLATION_DEGREE": 5}
    kicked = circle(EVERY[6:])
    kicked[:, 5] += 0.5
    found = read(segment(EVERY[:7], meta), segment(EVERY[6:], meta, states=kicked))
    assert len(found.times) == len(EVERY)
    assert np.allclose(found.state_at(START + 1790.0)[5], 1e3 * circle(1790.0)[0, 5], atol=0.1)
    for after in (1800.0, 1810.0):
        assert np.allclose(
            found.state_at(START + after)[5], 1e3 * circle(after)[0, 5] + 500.0, atol=0.1
        )


def test_a_gap_between_segments_has_no_states(read):
    found = read(segment(EVERY[:5]), segment(EVERY[8:]))
    with pytest.raises(DataError, match=r"no states at 2026-02-12T12:28.*spans are 2026"):
        found.state_at(START + 1800.0)


def test_segments_out_of_order_are_sorted(read):
    found = read(segment(EVERY[8:]), segment(EVERY[:5]))
    assert (np.diff(found.times) > 0.0).all()


def test_segments_that_overlap_are_refused_unless_their_use_is_stated(read):
    with pytest.raises(DataError, match=r"two segments have states.*state USEABLE_START_TIME"):
        read(segment(EVERY[:7]), segment(EVERY[4:]))
    first = segment(EVERY[:7], {"USEABLE_STOP_TIME": stamp(1500.0)})
    found = read(first, segment(EVERY[4:], {"USEABLE_START_TIME": stamp(1500.0)}))
    assert len(found.times) == len(EVERY)


def test_states_outside_of_the_usable_span_serve_interpolation_alone(read):
    meta = {"INTERPOLATION": "LAGRANGE", "INTERPOLATION_DEGREE": 12}
    meta |= {"USEABLE_START_TIME": stamp(900.0), "USEABLE_STOP_TIME": stamp(1500.0)}
    found = read(segment(EVERY, meta, covariances=[(0.0, SPREAD, []), (1200.0, SPREAD, [])]))
    assert list(found.times - START) == pytest.approx([900.0, 1200.0, 1500.0], abs=1e-5)
    assert len(found.covariances) == 1
    assert np.allclose(found.state_at(START + 1000.0)[:3], 1e3 * circle(1000.0)[0, :3], atol=1.0)
    with pytest.raises(DataError, match="no states at"):
        found.state_at(START + 600.0)


def test_too_few_states_for_the_degree_are_said_where_it_is_needed(read):
    meta = {"INTERPOLATION": "LAGRANGE", "INTERPOLATION_DEGREE": 9}
    found = read(segment(EVERY[:4], meta))
    assert np.array_equal(found.state_at(START + 300.0), found.states[1])
    with pytest.raises(DataError, match="degree 9, which needs 10"):
        found.state_at(START + 310.0)


# Seconds that the same calendar time in each system is before TDB: TAI is 32.184 s behind TT, GPS
# 19 s more; UTC 37 leap seconds behind TAI in 2026.
@pytest.mark.parametrize(
    ("system", "later_s"),
    [("TDB", 0.0), ("TT", 0.0), ("TAI", 32.184), ("GPS", 51.184), ("UTC", 69.184)],
)
def test_times_are_of_their_system(system, later_s, read):
    found = read(segment(EVERY, {"TIME_SYSTEM": system}))
    assert found.times[0] == pytest.approx(START + later_s, abs=2e-3)  # TDB less TT: 1.7 ms


@pytest.mark.parametrize(
    ("meta", "words"),
    [
        ({"CENTER_NAME": "EARTH BARYCENTER"}, "CENTER_NAME is 'EARTH BARYCENTER'.*a barycentre is"),
        ({"CENTER_NAME": "MARS"}, "CENTER_NAME is 'MARS'; wanted MOON"),
        ({"REF_FRAME": "TOD"}, "REF_FRAME is 'TOD'; wanted ICRF or EME2000: turn the states"),
        ({"REF_FRAME": "ITRF2000"}, "REF_FRAME is 'ITRF2000'"),
        ({"REF_FRAME": "MOON_PA"}, "REF_FRAME is 'MOON_PA'"),
        ({"REF_FRAME": "TEME"}, "REF_FRAME is 'TEME'"),
        ({"TIME_SYSTEM": "UT1"}, "TIME_SYSTEM is 'UT1'; wanted UTC, TDB"),
        ({"TIME_SYSTEM": "MET"}, "TIME_SYSTEM is 'MET'"),
        ({"INTERPOLATION": "CHEBYSHEV"}, "INTERPOLATION is 'CHEBYSHEV'; wanted HERMITE"),
        ({"INTERPOLATION": "LAGRANGE"}, "has INTERPOLATION_DEGREE ''; wanted 1 to 31"),
        ({"INTERPOLATION_DEGREE": "7"}, "INTERPOLATION is ''"),
        ({"INTERPOLATION": "LINEAR", "INTERPOLATION_DEGREE": "5"}, "'5'; wanted 1"),
        ({"INTERPOLATION": "HERMITE", "INTERPOLATION_DEGREE": "-7"}, "'-7'; wanted 1 to 31"),
        ({"INTERPOLATION": "HERMITE", "INTERPOLATION_DEGREE": "9" * 5000}, "wanted 1 to 31"),
        ({"START_TIME": stamp(900.0)}, "states lie outside of START_TIME"),
        ({"STOP_TIME": stamp(900.0)}, "states lie outside of STOP_TIME"),
        ({"STOP_TIME": stamp(9000.0)}, "the last state is 5400 s before it; the file is cut short"),
        ({"START_TIME": "soon"}, "START_TIME: time 'soon' is not understood"),
        ({"USEABLE_START_TIME": stamp(9000.0)}, "no state lies from USEABLE_START_TIME"),
        ({"REF_FRAME_EPOCH": "2026-01-01T00:00:00"}, "states REF_FRAME_EPOCH = 2026.*remove it"),
        ({"CENTRE_NAME": "MOON"}, "line 10: CENTRE_NAME is no keyword.*did you mean CENTER_NAME"),
        ({"DRAG_COEFF": "2.2"}, "DRAG_COEFF is no keyword of an OEM; remove it"),
    ],
)
def test_what_cannot_be_used_is_refused_by_its_keyword(meta, words, read):
    with pytest.raises(DataError, match=words):
        read(segment(EVERY, meta))


REFUSED = [name for name, keyword in KEYWORDS.items() if keyword.fate == "refused"]


@pytest.mark.parametrize("name", REFUSED)
def test_each_refused_keyword_is_named(name, read):
    with pytest.raises(DataError, match=rf"states {name} = 1999-01-01T00:00:00; .*remove it"):
        read(segment(EVERY, {name: "1999-01-01T00:00:00"}))


def test_what_is_harmless_changes_nothing(read):
    plain = read(segment(EVERY, covariances=[(0.0, SPREAD, [])]))
    text = segment(EVERY, {"REF_FRAME_EPOCH": J2000_EPOCHS[0]}, covariances=[(0.0, SPREAD, [])])
    said = "COMMENT né à Kourou, EPOCH = 1\n"
    # a comment after each line, also among the rows of a covariance
    full = "".join(line + said for line in text.splitlines(keepends=True))
    head = "CLASSIFICATION = none\nMESSAGE_ID = 7\n"
    other = read(full.replace("\n", "\r\n"), version="3.0", header=head)
    assert np.array_equal(plain.states, other.states)
    assert np.array_equal(plain.covariances, other.covariances)
    named = read(segment(EVERY, {"CENTER_NAME": "301", "REF_FRAME": "gcrf"}), version="1.0")
    assert np.array_equal(plain.states, named.states)


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("CCSDS_OEM_VERS = 2.0", "CCSDS_OEM_VERS = 4.0", "CCSDS_OEM_VERS is '4.0'"),
        ("CCSDS_OEM_VERS = 2.0", "CCSDS_OPM_VERS = 2.0", "is a CCSDS OPM: state its one state"),
        ("CCSDS_OEM_VERS = 2.0", '<?xml version="1.0"?>', "is XML: wanted the keyword form"),
        ("CCSDS_OEM_VERS = 2.0", "stk.v.11.0", "is an ephemeris of STK"),
        ("COVARIANCE_STOP\n", "", "ends inside of COVARIANCE; it is cut short"),
        ("META_STOP\n", "", "wanted KEYWORD = value"),
        ("META_START\n", "", "wanted KEYWORD = value|META_STOP without"),
        ("EPOCH = 2026-02-12T12:05:00.000\n", "", "a covariance without an EPOCH"),
        ("EPOCH = 2026-02-12T12:05", "EPOCH = 2026-02-12T14:05", "of a time outside of its states"),
        ("12:05:00.000 1", "12:00:00.000 1", "times are not in order"),
        ("12:05:00.000 1", "12:05:00.000 1_0", "has a word where a number belongs"),
        ("OBJECT_ID = 2026-001A", "OBJECT_ID = A\nOBJECT_ID = B", "is 'B', and 'A' above"),
    ],
)  # fmt: skip
def test_a_damaged_file_is_refused(old, new, words, tmp_path):
    text = "CCSDS_OEM_VERS = 2.0\n" + segment(EVERY, covariances=[(300.0, SPREAD, [])])
    assert old in text
    (tmp_path / "a.oem").write_text(text.replace(old, new, 1))
    with pytest.raises(DataError, match=words):
        read_oem(tmp_path / "a.oem", "moon")


def test_two_craft_in_one_file_are_refused(read):
    with pytest.raises(DataError, match="OBJECT_ID 2026-001A, 2026-001B; keep those of one craft"):
        read(segment(EVERY[:5]), segment(EVERY[5:], {"OBJECT_ID": "2026-001B"}))


def test_a_file_of_another_library_is_read(tmp_path):
    ndm = pytest.importorskip("ccsds_ndm.ndm_io", reason="ccsds-ndm (extra test) is not there")
    text = "CCSDS_OEM_VERS = 2.0\nCREATION_DATE = 2026-01-01T00:00:00\nORIGINATOR = US\n"
    meta = {
        "START_TIME": stamp(0.0),
        "STOP_TIME": stamp(3600.0),
        "INTERPOLATION": "HERMITE",
        "INTERPOLATION_DEGREE": 5,
    }
    covariances = [(0.0, SPREAD, ["COV_REF_FRAME = TNW"])]
    (tmp_path / "a.oem").write_text(text + segment(EVERY, meta, 9, covariances=covariances))
    io = ndm.NdmIo()
    io.to_file(io.from_path(tmp_path / "a.oem"), ndm.NDMFileFormats.KVN, tmp_path / "b.oem")
    ours, theirs = (read_oem(tmp_path / name, "moon") for name in ("a.oem", "b.oem"))
    assert np.allclose(ours.states, theirs.states, atol=1e-6)
    assert np.allclose(ours.covariances, theirs.covariances, rtol=1e-9)
    assert np.allclose(ours.segments[0].accelerations, theirs.segments[0].accelerations)
    assert theirs.segments[0].degree == 5
