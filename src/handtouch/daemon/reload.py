"""Reload: read the deployment file again at run time; pads that don't change are not disturbed.

Public names: `ReloadJob`, `DeploymentChange`, `find_changes`, `find_restart_changes`. Reading and building
take a second, so a thread does them (a process would delay the loop just as much); the result is applied
between two ticks.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

from handtouch.canbus.nodes.spec import node_specs
from handtouch.config import ConfigError, Deployment, Table
from handtouch.config.eds import EdsError
from handtouch.core.pad_model import PadModel
from handtouch.daemon.control import RefusedError
from handtouch.daemon.table_cache import build_pad_model

_log = logging.getLogger("handtouch.control")
_RESTART_REMEDY = "restart the daemon to apply that"


@dataclass(frozen=True)
class DeploymentChange:
    """The new deployment, changed keys of each pad (by row), changed tables, and a model if pads change."""

    deployment: Deployment
    changed_keys_of_pad: dict[int, list[str]]
    changed_tables: list[str]
    model: PadModel | None


class ReloadJob:
    """Passes a change that is being prepared to `apply` with the time [ns], unless it is a `dry_run`.

    Created by `start`.
    """

    def __init__(
        self, future: Future[DeploymentChange], apply: Callable[[DeploymentChange, int], None], dry_run: bool
    ) -> None:
        self._future, self._apply, self._dry_run = future, apply, dry_run

    @classmethod
    def start(
        cls,
        present: Deployment,
        read: Callable[[], Deployment],
        apply: Callable[[DeploymentChange, int], None],
        dry_run: bool,
    ) -> ReloadJob:
        """Start a thread that reads a deployment with `read` and compares it with the present one."""
        worker = ThreadPoolExecutor(1, thread_name_prefix="reload")
        future = worker.submit(_prepare, present, read, dry_run)
        worker.shutdown(wait=False)
        return cls(future, apply, dry_run)

    @property
    def done(self) -> bool:
        """True once reading has finished."""
        return self._future.done()

    def poll(self, now_ns: int) -> dict[str, Any] | None:
        """Return the changes once they are applied. Raises RefusedError."""
        if not self._future.done():
            return None
        try:
            change = self._future.result()
        except (ConfigError, EdsError) as error:
            raise RefusedError(f"nothing changed:\n{error}") from error
        if not self._dry_run:
            self._apply(change, now_ns)
        names = change.deployment.pad_names
        return {
            "applied": not self._dry_run,
            "tables": change.changed_tables,
            "pads": {names[pad]: what for pad, what in change.changed_keys_of_pad.items()},
        }


def _prepare(present: Deployment, read: Callable[[], Deployment], dry_run: bool) -> DeploymentChange:
    deployment = read()
    if obstacles := find_restart_changes(present, deployment):
        raise RefusedError("nothing changed: " + "; ".join(obstacles) + f"; {_RESTART_REMEDY}")
    pads, tables = find_changes(present, deployment)
    return DeploymentChange(
        deployment, pads, tables, build_pad_model(deployment) if pads and not dry_run else None
    )


def find_changes(old: Deployment, new: Deployment) -> tuple[dict[int, list[str]], list[str]]:
    """Return the changed keys and tables of each changed pad (by row), and the names of changed tables.

    Both are valid deployments with the same pads.
    """
    pairs = list(zip(_pads(old), _pads(new), strict=True))
    pads: dict[int, list[str]] = {}
    for number, (before, after) in enumerate(pairs):
        what = _changed_keys(before, after)
        what += [f"node.{after.node}"] * (old.nodes[before.node] != new.nodes[after.node])
        what += [f"sheet.{after.sheet}"] * (old.sheets[before.sheet] != new.sheets[after.sheet])
        shears = old.shears.get(before.shear), new.shears.get(after.shear)
        what += [f"shear.{after.shear}"] * (shears[0] != shears[1])
        if (before.touch or old.touch) != (after.touch or new.touch) and "touch" not in what:
            what.append("touch")
        if what:
            pads[number] = what
    tables = [name for name in ("daemon", "scene", "touch") if getattr(old, name) != getattr(new, name)]
    for name in ("nodes", "sheets", "shears"):
        before_all, after_all = getattr(old, name), getattr(new, name)
        keys = sorted(before_all.keys() | after_all.keys())
        tables += [f"{name[:-1]}.{key}" for key in keys if before_all.get(key) != after_all.get(key)]
    return pads, tables


def find_restart_changes(old: Deployment, new: Deployment) -> list[str]:
    """Return a text for each difference that needs a restart of the daemon."""
    differences = [
        f"[daemon] {key} differs" for key in _changed_keys(old.daemon, new.daemon) if key != "log_level"
    ]
    if old.buses != new.buses:
        differences.append("[[bus]] differs")
    for before, after in zip(old.hands, new.hands, strict=False):
        differences += [
            f"[[hand]] {after.name}: {key} differs" for key in _changed_keys(before, after) if key != "pads"
        ]
    names = [[(hand.name, pad.link) for hand in d.hands for pad in hand.pads] for d in (old, new)]
    if names[0] != names[1]:
        differences.append("the pads or their order differ")
    elif not differences:  # nodes depend on the period
        specs = zip(node_specs(old), node_specs(new), strict=True)
        differences += [
            f"the node of {after.name} differs in its id, bus, identity, wiring or supervision"
            for before, after in specs
            if before != after
        ]
    return differences


def _pads(deployment: Deployment) -> list[Any]:
    return [entry.pad for entry in deployment.pads]


def _changed_keys(old: Table, new: Table) -> list[str]:
    """Return the keys of a table whose values differ."""
    return [key for key in type(new).model_fields if getattr(old, key) != getattr(new, key)]
