"""ZeroMQ endpoints: defaults of the daemon and the simulated gripper, `to_connect` for bound ones;
`check_ipc_path` and `is_loopback` for those to bind."""

import ipaddress
import os
import socket
import stat
from pathlib import Path

LIVE_ENDPOINT = "tcp://127.0.0.1:5580"
CONTROL_ENDPOINT = "tcp://127.0.0.1:5581"
COMPLETE_ENDPOINT = "tcp://127.0.0.1:5582"
INPUTS_ENDPOINT = "tcp://127.0.0.1:5583"
GRIPPER_ENDPOINT = "tcp://127.0.0.1:5590"


def check_ipc_path(endpoint: str) -> None:
    """Raise OSError unless the path of an ipc endpoint is free, or a socket of this user that nobody uses.

    ZeroMQ deletes whatever is there before it binds. Other endpoints pass.
    """
    if not endpoint.startswith("ipc://") or endpoint.startswith("ipc://@"):
        return
    path = Path(endpoint.removeprefix("ipc://"))
    if not path.parent.is_dir():
        raise OSError(f"folder {path.parent} doesn't exist; create it")
    try:
        status = path.lstat()
    except FileNotFoundError:
        return
    if not stat.S_ISSOCK(status.st_mode):
        raise OSError(f"{path} is a file, which binding would delete; choose a path that doesn't exist")
    if status.st_uid != os.geteuid():
        raise OSError(f"{path} is a socket of another user; choose another path")
    with socket.socket(socket.AF_UNIX) as probe:
        if probe.connect_ex(str(path)) == 0:
            raise OSError("another daemon is using it; stop that one, or set another endpoint")


def is_loopback(host: str) -> bool:
    """Return True for an address of this machine that no other one can reach, and for localhost."""
    try:
        return host == "localhost" or ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


def to_connect(bound: str) -> str:
    """Return the endpoint that clients on this machine connect to, of one that the daemon binds.

    Raises ValueError for any free port.
    """
    if bound.endswith(":*"):
        raise ValueError(f"{bound} in [daemon] is any free port; give it a number, or use --endpoint")
    return bound.replace("tcp://*:", "tcp://127.0.0.1:").replace("tcp://0.0.0.0:", "tcp://127.0.0.1:")
