"""Frames of a tracker as JSON datagrams over UDP, and finger poses as JSON lines or datagrams.

A frame: ``{"time_s": 1.25, "object": [x, y, z, qw, qx, qy, qz], "left": null, "right": [...], "hinge_rad": 0.3}``, with
metres, seconds of any clock, and ``hinge_rad`` for a hinged object. A missing body, null or NaN: the tracker lost it.
With an object in each hand, ``left_object`` is the left hand's.
``{"end": true}`` ends the stream. A pose: ``{"time_s": 1.25, "left": [[x, y, z], ...], "right": ...}``, axis-angles.
"""

import json
import signal
import socket
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from ipaddress import IPv4Address
from math import hypot
from urllib.parse import urlsplit

import numpy as np
from scipy.spatial.transform import Rotation

from hoidata.clips.clip import SIDES, Side
from hoidata.errors import BadInput
from hoidata.geometry.rotations import rotmat_to_rotvec
from hoidata.geometry.transform import RigidTransform
from hoidata.object_paths.trajectory_files import BODIES
from models.manipnet.stream import TrackedFrame

MAX_BYTES = 4096
NAMES = {"time_s", "hinge_rad", *BODIES}
MAX_TIME_S = 4e9  # Unix time is below it; larger times lose microseconds
MAX_REPORTS = 10
WAIT_S = 0.2  # how soon Ctrl-C ends the stream


def parse_address(text: str) -> tuple[str, int]:
    """IPv4 address and port of ``udp://127.0.0.1:9000``; without an address, or for localhost, that of loopback."""
    try:
        parts = urlsplit(text)
        host = "127.0.0.1" if parts.hostname in (None, "localhost") else str(IPv4Address(parts.hostname))
        if parts.scheme != "udp" or not parts.port or parts.path + parts.query + parts.fragment:
            raise ValueError
    except ValueError as error:
        remedy = "give an IPv4 address and a port of 1 to 65535"
        raise BadInput("--from or --to", "an address like udp://127.0.0.1:9000", ascii(text[:80]), remedy) from error
    return host, parts.port


def parse_frame(data: bytes, is_hinged: bool = False, has_left_object: bool = False) -> TrackedFrame | None:
    """Parse any bytes; None: the end of the stream. Raises BadInput, also if a hinged object has no angle."""
    if len(data) > MAX_BYTES:
        raise BadInput("datagram", f"at most {MAX_BYTES} bytes", "more", "send one frame in each")
    try:
        values = json.loads(data)
    except (ValueError, RecursionError) as error:
        raise BadInput("datagram", "JSON", type(error).__name__, "see docs/fingers.md") from error
    if values == {"end": True}:
        return None
    if not isinstance(values, dict) or "time_s" not in values or not NAMES.issuperset(values):
        got = str(list(values))[:80] if isinstance(values, dict) else type(values).__name__
        raise BadInput("datagram", f"time_s and any of {', '.join(sorted(NAMES - {'time_s'}))}", got, "correct it")
    time_s, hinge_rad = (float(_numbers(values, name, 1)[0]) for name in ("time_s", "hinge_rad"))
    if not abs(time_s) < MAX_TIME_S:
        raise BadInput("datagram: time_s", f"a number of seconds below {MAX_TIME_S:g}", f"{time_s}", "correct it")
    body = _pose(values, "object")
    if is_hinged and body and not np.isfinite(hinge_rad):
        raise BadInput("datagram: hinge_rad", "the angle of the hinged object", "none", "send it")
    wrists: dict[Side, RigidTransform | None] = {side: _pose(values, side) for side in SIDES}
    left = _pose(values, "left_object") if has_left_object else body
    return TrackedFrame(time_s, wrists, {"left": left, "right": body}, dict.fromkeys(SIDES, hinge_rad))


def _numbers(values: Mapping[str, object], name: str, count: int) -> np.ndarray:
    """(count,) numbers; NaN if there are none."""
    value = values.get(name)
    numbers = [value] if count == 1 else value
    if value is None:
        return np.full(count, np.nan)
    if isinstance(numbers, list) and len(numbers) == count and all(type(one) in (int, float) for one in numbers):
        with suppress(OverflowError):
            return np.array(numbers, dtype=np.float64)
    raise BadInput(f"datagram: {name}", f"{count} numbers" if count > 1 else "a number", "something else", "correct it")


def _pose(values: Mapping[str, object], body: str) -> RigidTransform | None:
    """The pose of a body; None if it is lost."""
    numbers = _numbers(values, body, 7)
    if not np.isfinite(numbers).all():
        return None
    length = hypot(*numbers[3:])
    if abs(length - 1) > 0.01:
        remedy = "send x, y, z and then w, x, y, z of a rotation"
        raise BadInput(f"datagram: {body}", "a quaternion of length 1", f"length {length:.3g}", remedy)
    return RigidTransform(Rotation.from_quat(numbers[[4, 5, 6, 3]]).as_matrix(), numbers[:3])


@dataclass
class Tracker:
    """Receives the frames of a tracker. A datagram that cannot be used is counted and reported; the stream goes on."""

    address: tuple[str, int]
    is_hinged: bool  # the object
    report: Callable[[str], None]  # called for the first ``MAX_REPORTS`` refused datagrams
    has_left_object: bool = False
    received = refused = 0

    def frames(self) -> Iterator[TrackedFrame]:
        """Yield frames until a datagram says the end, or Ctrl-C."""
        interrupts: list[int] = []
        before = signal.signal(signal.SIGINT, lambda number, _: interrupts.append(number))
        try:
            with socket.socket(type=socket.SOCK_DGRAM) as receiver:
                receiver.settimeout(WAIT_S)
                try:
                    receiver.bind(self.address)
                except OSError as error:
                    remedy = "choose another port, or an address of this machine"
                    raise BadInput("--from", "a free port", str(error), remedy) from error
                while not interrupts:
                    with suppress(TimeoutError):
                        data = receiver.recv(MAX_BYTES + 1)
                        self.received += 1
                        try:
                            frame = parse_frame(data, self.is_hinged, self.has_left_object)
                        except BadInput as error:
                            self.refused += 1
                            if self.refused <= MAX_REPORTS:
                                is_last = self.refused == MAX_REPORTS
                                self.report(f"{error}; further ones are only counted" if is_last else str(error))
                            continue
                        if frame is None:
                            return
                        yield frame
        finally:
            signal.signal(signal.SIGINT, before)


def pose_line(time_s: float, poses: Mapping[Side, np.ndarray]) -> str:
    """One pose as JSON; poses: rotations (15, 3, 3) by side."""
    rotations = {side: rotmat_to_rotvec(pose).round(6).tolist() for side, pose in poses.items()}
    return json.dumps({"time_s": round(time_s, 6), **rotations})
