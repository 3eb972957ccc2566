"""Reload: the deployment file read again while the hand is served; what is unchanged goes on undisturbed.

Public names: `Reload`, `Fresh`, `changes`, `fixed`. Reading and building take a second, so a thread does them
(it makes the loop no later than a process of its own would); the result is taken over between two ticks.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

from handtouch.canbus.nodes.spec import node_specs
from handtouch.canbus.objects.eds import EdsError
from handtouch.config import ConfigError, Deployment, Table
from handtouch.daemon.control import RefusedError
from handtouch.daemon.model import PadModel

_log = logging.getLogger("handtouch.control")
_RESTART = "restart the daemon for that"


@dataclass(frozen=True)
class Fresh:
    """What the file says now: which pads (by number) and tables it changes, and a model if pads change."""

    deployment: Deployment
    pads: dict[int, list[str]]
    tables: list[str]
    model: PadModel | None


class Reload:
    """Reads a deployment with `read` and hands it to `adopt`, unless it is a `trial`."""

    def __init__(
        self,
        present: Deployment,
        read: Callable[[], Deployment],
        adopt: Callable[[Fresh], None],
        trial: bool,
    ) -> None:
        self._adopt, self._trial, self._present = adopt, trial, present
        self._worker = ThreadPoolExecutor(1, thread_name_prefix="reload")
        self._coming: Future[Fresh] = self._worker.submit(_prepare, present, read, trial)
        self._worker.shutdown(wait=False)

    @property
    def done(self) -> bool:
        """Whether another may begin."""
        return self._coming.done()

    def poll(self, now_ns: int) -> dict[str, Any] | None:  # noqa: ARG002
        """What changes, once it is known and taken over. Raises RefusedError."""
        if not self._coming.done():
            return None
        try:
            fresh = self._coming.result()
        except (ConfigError, EdsError) as error:
            raise RefusedError(f"nothing is changed:\n{error}") from error
        if not self._trial:
            self._adopt(fresh)
        names = [f"{hand.name}/{pad.link}" for hand in fresh.deployment.hands for pad in hand.pads]
        return {
            "applied": not self._trial,
            "tables": fresh.tables,
            "pads": {names[pad]: what for pad, what in fresh.pads.items()},
        }


def _prepare(present: Deployment, read: Callable[[], Deployment], trial: bool) -> Fresh:
    deployment = read()
    if obstacles := fixed(present, deployment):
        raise RefusedError("nothing is changed: " + "; ".join(obstacles) + f"; {_RESTART}")
    pads, tables = changes(present, deployment)
    return Fresh(deployment, pads, tables, PadModel(deployment) if pads and not trial else None)


def changes(old: Deployment, new: Deployment) -> tuple[dict[int, list[str]], list[str]]:
    """What differs: number of each changed pad -> its keys and tables, and the names of changed tables.

    Raises nothing: both are checked deployments with the same pads.
    """
    pairs = list(zip(_pads(old), _pads(new), strict=True))
    pads: dict[int, list[str]] = {}
    for number, (before, after) in enumerate(pairs):
        what = _keys(before, after)
        what += [f"node.{after.node}"] * (old.nodes[before.node] != new.nodes[after.node])
        what += [f"sheet.{after.sheet}"] * (old.sheets[before.sheet] != new.sheets[after.sheet])
        if (before.touch or old.touch) != (after.touch or new.touch) and "touch" not in what:
            what.append("touch")
        if what:
            pads[number] = what
    tables = [name for name in ("daemon", "scene", "touch") if getattr(old, name) != getattr(new, name)]
    for name in ("nodes", "sheets"):
        before_all, after_all = getattr(old, name), getattr(new, name)
        keys = sorted(before_all.keys() | after_all.keys())
        tables += [f"{name[:-1]}.{key}" for key in keys if before_all.get(key) != after_all.get(key)]
    return pads, tables


def fixed(old: Deployment, new: Deployment) -> list[str]:
    """What differs and can't change while the daemon runs, in words."""
    told = [f"[daemon] {key} differs" for key in _keys(old.daemon, new.daemon) if key != "log_level"]
    if old.buses != new.buses:
        told.append("[[bus]] differs")
    for before, after in zip(old.hands, new.hands, strict=False):
        told += [f"[[hand]] {after.name}: {key} differs" for key in _keys(before, after) if key != "pads"]
    names = [[(hand.name, pad.link) for hand in d.hands for pad in hand.pads] for d in (old, new)]
    if names[0] != names[1]:
        told.append("the pads or their order differ")
    elif not told:  # nodes depend on the period
        specs = zip(node_specs(old), node_specs(new), strict=True)
        told += [
            f"the node of {after.name} differs in its id, bus, identity, wiring or supervision"
            for before, after in specs
            if before != after
        ]
    return told


def _pads(deployment: Deployment) -> list[Any]:
    return [pad for hand in deployment.hands for pad in hand.pads]


def _keys(old: Table, new: Table) -> list[str]:
    """Keys of a table whose values differ."""
    return [key for key in type(new).model_fields if getattr(old, key) != getattr(new, key)]
