"""Ports for servers that tests start."""

import socket


def unused_port() -> int:
    """A random port that is free now. Tests in other processes are unlikely to receive the same."""
    with socket.socket() as listener:
        listener.bind(("127.0.0.1", 0))
        return listener.getsockname()[1]
