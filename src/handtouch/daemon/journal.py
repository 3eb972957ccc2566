"""Tells recorders what each tick was made from, so that it can be made again bit for bit.

Public names: `Journal`, `build`.

Whatever changes the tick between two steps, other than what `TickInputs` holds, sets `tick.disturbed`
(`tick.forget` does); the whole state follows. Nothing is encoded while nobody has subscribed.
"""

from __future__ import annotations

import hashlib
import platform
from collections.abc import Callable
from functools import cache
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from handtouch import __version__, wire
from handtouch.config import Deployment

if TYPE_CHECKING:
    from handtouch.daemon.messages import Outlet
    from handtouch.daemon.pipeline import Pipeline

_FOREVER_NS = np.iinfo(np.int64).max


class Journal:
    """Writes `tick`, `state` and `config` of a pipeline."""

    def __init__(self, pipeline: Pipeline, run: int, outlet: Outlet) -> None:
        self._pipeline, self._run, self._outlet = pipeline, run, outlet
        self._ticks = self._states = self._configs = 0  # seq of each topic
        self._limits = b""  # as last told
        self._deployment: Deployment | None = None
        self.others: dict[str, Callable[[], Any]] = {}
        """what else ticks are made from: name -> what tells it as msgpack takes it, empty if nothing"""

    def present(self) -> dict[str, Callable[[int], wire.Message | None]]:
        """Topic -> what there is to repeat of it."""
        return {"config": self._config, "state": lambda now_ns: self._state(now_ns, repeat=True)}

    def serve(self, deployment: Deployment, now_ns: int) -> None:
        """This deployment is served from now on."""
        self._deployment = deployment
        self._configs += 1
        if self._outlet.wants("config") and (message := self._config(now_ns, repeat=False)):
            self._outlet.send(message)

    def between(self, now_ns: int) -> None:
        """Tell the state if something other than a tick changed it; before samples of the next come."""
        tick = self._pipeline.tick
        if tick.disturbed:
            tick.disturbed = False
            self._states += 1
            if self._outlet.wants("state"):
                self._outlet.send(self._state(now_ns, repeat=False))

    def ticked(self, now_ns: int, until_ns: int, stopped: bool = False) -> None:
        """Tell what the last step was made from."""
        self._ticks += 1
        if not self._outlet.wants("tick"):
            return
        pipeline = self._pipeline
        tick, cycle, slab = pipeline.tick, pipeline.cycle, pipeline.slab
        limits = slab.limits.tobytes()
        changed, self._limits = limits != self._limits, limits
        self._outlet.send(
            wire.TickInputs(
                v=wire.SCHEMA_VERSION,
                run=self._run,
                seq=self._ticks,
                t_ns=cycle.t_ns,
                tick=pipeline.ticks,
                previous_ns=cycle.previous_ns,
                now_ns=now_ns,
                until_ns=None if until_ns == _FOREVER_NS else until_ns,
                stopped=stopped,
                counts=tick.counts.astype("<i8", copy=False).tobytes(),
                arrived_ns=slab.t_ns.astype("<i8", copy=False).tobytes(),
                fresh=slab.fresh.tobytes(),
                node_state=pipeline.node_state.tobytes(),
                synchronous=tick.synchronous.tobytes(),
                period_ns=tick.period_ns.astype("<i8", copy=False).tobytes(),
                paced_ns=tick.paced_ns.astype("<i8", copy=False).tobytes(),
                limits=limits if changed else None,
                others={name: told for name, tell in self.others.items() if (told := tell())},
                repeat=False,
            )
        )

    def _state(self, now_ns: int, repeat: bool) -> wire.State:
        from handtouch.daemon import state  # it knows the pipeline, which has this

        return wire.State(
            v=wire.SCHEMA_VERSION,
            run=self._run,
            seq=self._states,
            t_ns=now_ns,
            tick=self._pipeline.ticks,
            state=state.pack(state.save(self._pipeline)),
            limits=self._pipeline.slab.limits.tobytes(),
            repeat=repeat,
        )

    def _config(self, now_ns: int, repeat: bool = True) -> wire.Config | None:
        if self._deployment is None:
            return None
        return wire.Config(
            v=wire.SCHEMA_VERSION,
            run=self._run,
            seq=self._configs,
            t_ns=now_ns,
            deployment=self._deployment.model_dump_json(by_alias=True),
            files=_files(self._deployment),
            build=build(),
            repeat=repeat,
        )


def _files(deployment: Deployment) -> dict[str, Any]:
    """Every file that the deployment names and that a model of it needs, as far as it is still there."""
    named = {node.eds for node in deployment.nodes.values() if node.eds}
    named |= {hand.urdf for hand in deployment.hands if hand.urdf}
    return {path: Path(path).read_bytes() for path in sorted(named) if Path(path).is_file()}


@cache
def build() -> dict[str, Any]:
    """What decides on the last bit of a result: code, libraries, processor."""
    code = hashlib.sha256()
    package = Path(__file__).parents[1]
    for room in ("canbus", "config", "daemon", "field", "hand", "sheet", "supervise"):
        for file in sorted((package / room).rglob("*.py")):
            code.update(file.read_bytes())
    return {
        "handtouch": __version__,
        "source": code.hexdigest()[:16],
        "python": platform.python_version(),
        **{name: version(name) for name in ("numpy", "scipy")},
        "processor": _processor(),
        "features": _features(),
    }


def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        lines = []
    told = [line.split(":", 1)[1].strip() for line in lines if line.startswith(("model name", "CPU part"))]
    return told[0] if told else platform.machine()


def _features() -> list[str]:
    """Instruction sets that numpy found here, which choose its loops and those of its linear algebra."""
    found: dict[str, NDArray[Any] | bool] = np._core._multiarray_umath.__cpu_features__  # type: ignore[attr-defined]
    return sorted(name for name, here in found.items() if here)
