"""Run every example against a simulated gripper (`make examples`); starts and stops all processes."""

from __future__ import annotations

import contextlib
import json
import os
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from pathlib import Path

from common import Options

import handtouch

HERE = Path(__file__).parent
PROGRAMS = ("stop_on_touch", "keep_force", "follow_edge", "stop_slip")
NOTEBOOK = HERE / "log_contacts.ipynb"
FIGURE = Path(tempfile.gettempdir()) / "contacts.png"
_START_S, _LOG_S = 60.0, 9.0


@contextlib.contextmanager
def rig(folder: Path, prefix: Sequence[str] = (), period_ms: float = 10.0) -> Iterator[Options]:
    """Run the gripper and its daemon on a private bus and private endpoints; `prefix`: of their commands."""
    bus = f"udp_multicast:239.74.163.2,port={free_port()}"
    endpoints = {name: f"ipc://{folder}/{name}" for name in ("live", "complete", "control", "inputs")}
    endpoint_keys = "".join(f'{name} = "{endpoint}"\n' for name, endpoint in endpoints.items())
    deployment = (HERE.parent / "config/two_finger.toml").read_text()
    config = folder / "two_finger.toml"
    deployment = deployment.replace("sync_period_ms = 10.0", f"sync_period_ms = {period_ms}")
    config.write_text(deployment.replace("[daemon]\n", f"[daemon]\nsupervise = false\n{endpoint_keys}", 1))
    options = Options(endpoints["live"], endpoints["control"], f"ipc://{folder}/gripper")
    simulate, run = (
        [*prefix, sys.executable, "-m", "handtouch", name, str(config), "--bus", f"can0={bus}"]
        for name in ("simulate", "run")
    )
    with contextlib.ExitStack() as stack:
        for command in ([*simulate, "--gripper", options.robot], run):
            log = stack.enter_context((folder / "log.txt").open("a"))
            process = stack.enter_context(subprocess.Popen(command, stdout=log, stderr=log))
            stack.callback(process.terminate)
        wait_operational(options.control, folder / "log.txt")
        yield options


def free_port() -> int:
    """Return an unused UDP port."""
    with socket.socket(type=socket.SOCK_DGRAM) as udp:
        udp.bind(("", 0))
        return int(udp.getsockname()[1])


def wait_operational(control: str, log: Path) -> None:
    """Wait until both pads are sampled. Raises RuntimeError with the output of the processes."""
    end_s = time.monotonic() + _START_S
    while time.monotonic() < end_s:
        with contextlib.suppress(TimeoutError):
            pads = handtouch.request("status", endpoint=control, timeout_s=1.0)["pads"]
            if all(pad["node_state"] == "operational" for pad in pads):
                return
        time.sleep(0.05)
    raise RuntimeError(f"the gripper is not operational after {_START_S:.0f} s:\n{log.read_text()}")


def cells(notebook: Path) -> str:
    """Return the code of a notebook as a program."""
    found = json.loads(notebook.read_text())["cells"]
    return "\n\n".join("".join(cell["source"]) for cell in found if cell["cell_type"] == "code")


def log(live: str, figure: Path, seconds: float) -> subprocess.Popen[bytes]:
    """Start the notebook's code without Jupyter, to log while an example runs."""
    environment = {
        "HANDTOUCH_LIVE": live,
        "SECONDS": str(seconds),
        "FIGURE": str(figure),
        "MPLBACKEND": "agg",
    }
    return subprocess.Popen([sys.executable, "-c", cells(NOTEBOOK)], env={**os.environ, **environment})


def main() -> int:
    """Run the examples in sequence, the notebook during the last one; return the number of failures."""
    failed = 0
    with tempfile.TemporaryDirectory(prefix="ht.") as folder, rig(Path(folder)) as options:
        arguments = ["--live", options.live, "--control", options.control, "--robot", options.robot]
        for name in PROGRAMS:
            print(f"== examples/{name}.py", flush=True)
            notebook = log(options.live, FIGURE, _LOG_S) if name == PROGRAMS[-1] else None
            failed += (
                subprocess.run([sys.executable, HERE / f"{name}.py", *arguments], check=False).returncode != 0
            )
        print(f"== {NOTEBOOK.relative_to(HERE.parent)}", flush=True)
        failed += notebook is None or notebook.wait() != 0
        print(f"figure: {FIGURE}")
    return failed


if __name__ == "__main__":
    sys.exit(main())
