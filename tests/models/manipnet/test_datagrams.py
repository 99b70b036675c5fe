"""A tracker's datagrams: valid ones are frames, all others are refused and counted, and the stream goes on."""

import json
import os
import signal
import socket
import threading
from math import inf, nan

import numpy as np
import pytest

from hoidata.clips.clip import SIDES
from hoidata.errors import BadInput
from models.manipnet.datagrams import MAX_BYTES, MAX_REPORTS, Tracker, parse_address, parse_frame, pose_line
from models.manipnet.stream import TrackedFrame, control_of_frames
from tests.builders.objects import box_model, hinged_box
from tests.builders.udp import free_port, send_when_open

HALF = 0.5**0.5
POSE = [0.1, 0.2, 0.3, HALF, 0.0, 0.0, HALF]  # a quarter turn about z
FRAME = {"time_s": 1.25, "object": POSE, "left": None, "right": [0, 0, 1, 1, 0, 0, 0], "hinge_rad": 0.5}


def datagram(**changes: object) -> bytes:
    return json.dumps(FRAME | changes).encode()


def test_a_datagram_is_a_frame_with_metres_and_w_first() -> None:
    frame = parse_frame(datagram(), is_hinged=True)
    assert (frame.time_s, frame.wrists["left"], frame.hinge_rad) == (1.25, None, dict.fromkeys(SIDES, 0.5))
    for side in SIDES:
        pose = frame.objects[side]
        np.testing.assert_allclose(pose.rotation, [[0, -1, 0], [1, 0, 0], [0, 0, 1]], atol=1e-12)
        np.testing.assert_array_equal(pose.translation, POSE[:3])


def test_the_left_hands_own_object_is_lost_if_it_is_missing() -> None:
    lost, frame = (
        parse_frame(datagram(), has_left_object=True),
        parse_frame(datagram(left_object=[0, 0, 2, *POSE[3:]]), False, True),
    )
    assert (lost.objects["left"], lost.objects["right"] is None) == (None, False)
    assert frame.objects["left"] is not None
    assert frame.objects["left"].translation[2] == 2
    assert frame.objects["right"] is not None
    np.testing.assert_array_equal(frame.objects["right"].translation, POSE[:3])


@pytest.mark.parametrize("lost", [None, [nan] * 7, [inf, *POSE[1:]], [*POSE[:6], nan]])
def test_null_and_numbers_that_are_not_finite_are_a_lost_body(lost: object) -> None:
    frame = parse_frame(datagram(object=lost))
    assert list(frame.objects.values()) == [None, None]
    assert frame.wrists["right"] is not None


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (b" " * (MAX_BYTES + 1), "at most 4096 bytes"),
        (b"", "JSON"),
        (b"\xff\xfe\x00", "JSON"),
        (b"[" * MAX_BYTES, "JSON"),
        (b"9" * MAX_BYTES, "time_s"),
        (b"[1]", "got list"),
        (b"{}", "time_s"),
        (b'{"end": false}', "time_s"),
        (datagram(wrist=POSE), "wrist"),
        (datagram(**{"\x1b[2J": 1}), r"\\x1b"),
        (datagram(time_s="1.25"), "datagram: time_s: expected a number"),
        (datagram(time_s=True), "datagram: time_s: expected a number"),
        (datagram(time_s=nan), "a number of seconds"),
        (datagram(time_s=1.7e12), "a number of seconds"),
        (datagram(time_s=10**400), "datagram: time_s: expected a number"),
        (datagram(object=POSE[:6]), "datagram: object: expected 7 numbers"),
        (datagram(object={"x": 1}), "datagram: object: expected 7 numbers"),
        (datagram(right=[*POSE[:6], "0"]), "datagram: right: expected 7 numbers"),
        (datagram(left=[0.0] * 7), "datagram: left: expected a quaternion of length 1"),
        (datagram(left=[0.0] * 3 + [1e200] * 4), "datagram: left: expected a quaternion of length 1"),
        (datagram(hinge_rad=None), "datagram: hinge_rad: expected the angle"),
        (datagram(hinge_rad=inf), "datagram: hinge_rad: expected the angle"),
    ],
)
def test_a_bad_datagram_is_refused_with_what_it_should_be(data: bytes, message: str) -> None:
    with pytest.raises(BadInput, match=message) as caught:
        parse_frame(data, is_hinged=True)
    assert str(caught.value).isprintable()


def test_an_address_is_loopback_unless_it_names_another() -> None:
    assert parse_address("udp://:9000") == parse_address("udp://localhost:9000") == ("127.0.0.1", 9000)
    assert parse_address("udp://192.168.0.7:1") == ("192.168.0.7", 1)


@pytest.mark.parametrize(
    "text",
    ["udp://127.0.0.1", "udp://127.0.0.1:0", "udp://127.0.0.1:70000", "udp://a.example:9000", "udp://[::1]:9000",
     "tcp://127.0.0.1:9000", "udp://127.0.0.1:9000/a", "udp://127.0.0.1:x", "udp://[", ""],
)  # fmt: skip
def test_another_address_is_refused(text: str) -> None:
    with pytest.raises(BadInput, match="an address like"):
        parse_address(text)


def test_refused_datagrams_are_counted_and_reported_and_the_stream_goes_on() -> None:
    reports: list[str] = []
    tracker = Tracker(("127.0.0.1", free_port()), False, reports.append)
    good = [datagram(time_s=number) for number in range(3)]
    bad = [b"x" * 5_000, b"nonsense", b'{"time_s": {}}'] * MAX_REPORTS
    sent = [good[0], *bad, good[1], b"\x00", good[2], b'{"end": true}']
    sender = threading.Thread(target=send_when_open, args=(tracker.address[1], sent))
    sender.start()
    frames = list(tracker.frames())
    sender.join()
    assert [frame.time_s for frame in frames] == [0, 1, 2]
    assert tracker.refused == tracker.received - 4 >= len(bad) + 3
    assert len(reports) == MAX_REPORTS
    assert any("at most 4096 bytes" in report for report in reports)


def test_ctrl_c_ends_the_stream_and_is_handled_as_before_afterwards() -> None:
    before = signal.getsignal(signal.SIGINT)
    tracker = Tracker(("127.0.0.1", free_port()), False, print)
    timer = threading.Timer(0.3, os.kill, (os.getpid(), signal.SIGINT))
    timer.start()
    assert list(tracker.frames()) == []
    assert signal.getsignal(signal.SIGINT) is before


def test_a_port_in_use_is_refused_with_another_as_the_remedy() -> None:
    with socket.socket(type=socket.SOCK_DGRAM) as other:
        other.bind(("127.0.0.1", 0))
        with pytest.raises(BadInput, match="choose another port"):
            list(Tracker(other.getsockname(), False, print).frames())


def test_a_pose_line_has_the_axis_angles_of_each_hand() -> None:
    turn = np.tile([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]], (15, 1, 1))
    assert json.loads(pose_line(0.1, {"left": turn})) == {
        "time_s": 0.1,
        "left": [[0.0, 0.0, pytest.approx(np.pi / 2, abs=1e-6)]] * 15,
    }


def test_a_recording_of_a_tracker_has_its_motion_and_says_where_a_wrist_was_lost() -> None:
    frames = []
    for number in range(121):
        at = [number / 60, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0]
        lost = 20 <= number < 30 or 60 <= number < 100  # for 0.18 s and for 0.68 s
        frames.append(
            parse_frame(datagram(time_s=number / 60, object=at, right=None if lost else at, hinge_rad=number))
        )
    control, valid = control_of_frames([frame for frame in frames if frame], hinged_box())
    time_s = np.arange(61) / 30
    for motion in (control.object_motion, control.wrists["right"]):
        np.testing.assert_allclose(motion.position_m, time_s[:, None] * [1, 0, 0], atol=1e-9)
    np.testing.assert_allclose(control.hinge_rad, 60 * time_s, atol=1e-9)
    assert np.flatnonzero(~valid[1]).tolist() == list(range(30, 50))
    assert not valid[0].any()
    assert control_of_frames([TrackedFrame(0.0, {}, {})], box_model())[0] is None
