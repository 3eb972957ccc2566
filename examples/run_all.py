"""Run every example against a simulated gripper: `make examples`. Starts all that is needed, and ends it."""

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
    """The gripper and its daemon, on a bus and with endpoints of their own; `prefix` of their commands."""
    bus = f"udp_multicast:239.74.163.2,port={free_port()}"
    endpoints = {name: f"ipc://{folder}/{name}" for name in ("live", "complete", "control", "inputs")}
    told = "".join(f'{name} = "{endpoint}"\n' for name, endpoint in endpoints.items())
    deployment = (HERE.parent / "config/two_finger.toml").read_text()
    config = folder / "two_finger.toml"
    deployment = deployment.replace("sync_period_ms = 10.0", f"sync_period_ms = {period_ms}")
    config.write_text(deployment.replace("[daemon]\n", f"[daemon]\nsupervise = false\n{told}", 1))
    asked = Options(endpoints["live"], endpoints["control"], f"ipc://{folder}/gripper")
    simulate, run = (
        [*prefix, sys.executable, "-m", "handtouch", name, str(config), "--bus", f"can0={bus}"]
        for name in ("simulate", "run")
    )
    with contextlib.ExitStack() as stack:
        for command in ([*simulate, "--gripper", asked.robot], run):
            log = stack.enter_context((folder / "log.txt").open("a"))
            process = stack.enter_context(subprocess.Popen(command, stdout=log, stderr=log))
            stack.callback(process.terminate)
        wait_until_up(asked.control, folder / "log.txt")
        yield asked


def free_port() -> int:
    """A UDP port that nobody has."""
    with socket.socket(type=socket.SOCK_DGRAM) as udp:
        udp.bind(("", 0))
        return int(udp.getsockname()[1])


def wait_until_up(control: str, log: Path) -> None:
    """Until both pads are sampled; raises RuntimeError with what was printed."""
    end_s = time.monotonic() + _START_S
    while time.monotonic() < end_s:
        with contextlib.suppress(TimeoutError):
            pads = handtouch.request("status", endpoint=control, timeout_s=1.0)["pads"]
            if all(pad["node"] == "operational" for pad in pads):
                return
        time.sleep(0.05)
    raise RuntimeError(f"the gripper didn't come up within {_START_S:.0f} s:\n{log.read_text()}")


def cells(notebook: Path) -> str:
    """The code of a notebook, as a program."""
    found = json.loads(notebook.read_text())["cells"]
    return "\n\n".join("".join(cell["source"]) for cell in found if cell["cell_type"] == "code")


def log(live: str, figure: Path, seconds: float) -> subprocess.Popen[bytes]:
    """Run the notebook's code, without Jupyter, so that it logs while something else goes on."""
    told = {"HANDTOUCH_LIVE": live, "SECONDS": str(seconds), "FIGURE": str(figure), "MPLBACKEND": "agg"}
    return subprocess.Popen([sys.executable, "-c", cells(NOTEBOOK)], env={**os.environ, **told})


def main() -> int:
    """Run them one after the other, the notebook beside the last; how many failed."""
    failed = 0
    with tempfile.TemporaryDirectory(prefix="ht.") as folder, rig(Path(folder)) as asked:
        where = ["--live", asked.live, "--control", asked.control, "--robot", asked.robot]
        for name in PROGRAMS:
            print(f"== examples/{name}.py", flush=True)
            notebook = log(asked.live, FIGURE, _LOG_S) if name == PROGRAMS[-1] else None
            failed += (
                subprocess.run([sys.executable, HERE / f"{name}.py", *where], check=False).returncode != 0
            )
        print(f"== {NOTEBOOK.relative_to(HERE.parent)}", flush=True)
        failed += notebook is None or notebook.wait() != 0
        print(f"the figure is {FIGURE}")
    return failed


if __name__ == "__main__":
    sys.exit(main())
