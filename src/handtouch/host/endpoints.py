"""ZeroMQ endpoints: defaults of the daemon and the simulated gripper, and `to_connect` for bound ones."""

LIVE_ENDPOINT = "tcp://127.0.0.1:5580"
CONTROL_ENDPOINT = "tcp://127.0.0.1:5581"
COMPLETE_ENDPOINT = "tcp://127.0.0.1:5582"
INPUTS_ENDPOINT = "tcp://127.0.0.1:5583"
GRIPPER_ENDPOINT = "tcp://127.0.0.1:5590"


def to_connect(bound: str) -> str:
    """Return the endpoint that clients on this machine connect to, of one that the daemon binds."""
    return bound.replace("tcp://*:", "tcp://127.0.0.1:").replace("tcp://0.0.0.0:", "tcp://127.0.0.1:")
