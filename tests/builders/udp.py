"""A tracker that sends datagrams to a port of this machine."""

import socket
import time


def free_port() -> int:
    with socket.socket(type=socket.SOCK_DGRAM) as one:
        one.bind(("127.0.0.1", 0))
        return one.getsockname()[1]


def send_when_open(port: int, datagrams: list[bytes]) -> None:
    """Send datagrams when somebody receives at a port; the first datagrams there are b"?"."""
    with socket.socket(type=socket.SOCK_DGRAM) as sender:
        sender.connect(("127.0.0.1", port))
        while True:
            try:
                sender.send(b"?")
                time.sleep(0.05)
                sender.send(b"?")  # fails if nobody received the one before
                break
            except ConnectionRefusedError:
                continue
        for data in datagrams:
            sender.send(data)
            time.sleep(0.002)  # the buffer of the receiver is small
