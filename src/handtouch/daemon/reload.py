"""Reload: read the deployment file again at run time; pads that don't change are not disturbed.

Public names: `ReloadJob`, `DeploymentChange`, `find_changes`, `find_restart_changes`. Reading and building
take a second, so a thread does them (a process would delay the loop just as much); the result is applied
between two ticks.
"""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable, Mapping
from concurrent.futures import Future
from dataclasses import dataclass
from typing import Any

from handtouch.canbus.nodes.spec import node_specs
from handtouch.config import ConfigError, Deployment, Table
from handtouch.config.eds import EdsError
from handtouch.config.files import deployment_files
from handtouch.core.pad_model import PadModel
from handtouch.daemon.control import RefusedError
from handtouch.daemon.table_cache import build_pad_model

_log = logging.getLogger("handtouch.control")
_RESTART_REMEDY = "restart the daemon to apply that"
_MAX_DURATION_NS = 20_000_000_000
"""Reading and building take a second or two; a file that takes longer is a pipe, or its drive hangs."""


@dataclass(frozen=True)
class DeploymentChange:
    """The new deployment with the files it names, changed keys of each pad (by row), changed tables, and a
    model if pads change."""

    deployment: Deployment
    files: Mapping[str, bytes]
    changed_keys_of_pad: dict[int, list[str]]
    changed_tables: list[str]
    model: PadModel | None


class ReloadJob:
    """Passes a change that is being prepared to `apply` with the time [ns], unless it is a `dry_run`.

    Created by `start`.
    """

    def __init__(
        self,
        future: Future[DeploymentChange],
        apply: Callable[[DeploymentChange, int], None],
        dry_run: bool,
        end_ns: int,
    ) -> None:
        self._future, self._apply, self._dry_run, self._end_ns = future, apply, dry_run, end_ns
        self._timed_out = False

    @classmethod
    def start(
        cls,
        present: Deployment,
        files: Mapping[str, bytes],
        read: Callable[[], Deployment],
        apply: Callable[[DeploymentChange, int], None],
        dry_run: bool,
        now_ns: int,
    ) -> ReloadJob:
        """Start a thread that reads a deployment with `read` and compares it with the present one.

        files: content of those that the present one names, when it was read. The thread doesn't keep the
        process alive.
        """
        future: Future[DeploymentChange] = Future()

        def prepare() -> None:
            try:
                future.set_result(_prepare(present, files, read, dry_run))
            except Exception as error:  # noqa: BLE001 - `poll` raises it
                future.set_exception(error)

        threading.Thread(target=prepare, name="reload", daemon=True).start()
        return cls(future, apply, dry_run, now_ns + _MAX_DURATION_NS)

    @property
    def done(self) -> bool:
        """True once reading has finished, or takes too long."""
        return self._timed_out or self._future.done()

    def poll(self, now_ns: int) -> dict[str, Any] | None:
        """Return the changes once they are applied. Raises RefusedError."""
        if not self._future.done():
            if now_ns < self._end_ns:
                return None
            self._timed_out = True
            raise RefusedError(
                f"nothing changed: reading the deployment takes longer than {_MAX_DURATION_NS * 1e-9:.0f} s; "
                "check that the file and those it names are ordinary files on a drive that responds"
            )
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


def _prepare(
    present: Deployment, present_files: Mapping[str, bytes], read: Callable[[], Deployment], dry_run: bool
) -> DeploymentChange:
    deployment = read()
    files = deployment_files(deployment)
    obstacles = find_restart_changes(present, deployment)
    obstacles += [
        f"{path} has another content"
        for path, content in files.items()
        if present_files.get(path, content) != content
    ]
    if obstacles:
        raise RefusedError("nothing changed: " + "; ".join(obstacles) + f"; {_RESTART_REMEDY}")
    pads, tables = find_changes(present, deployment)
    model = build_pad_model(deployment) if pads and not dry_run else None
    return DeploymentChange(deployment, files, pads, tables, model)


def find_changes(old: Deployment, new: Deployment) -> tuple[dict[int, list[str]], list[str]]:
    """Return the changed keys and tables of each changed pad (by row), and the names of changed tables.

    Both are valid deployments with the same pads.
    """
    pairs = list(zip(_pads(old), _pads(new), strict=True))
    pads: dict[int, list[str]] = {}
    for number, (before, after) in enumerate(pairs):
        what = _changed_keys(before, after)
        what += [f"node.{after.node}"] * (old.nodes[before.node] != new.nodes[after.node])
        sheets = old.sheets.get(before.sheet), new.sheets.get(after.sheet)
        what += [f"sheet.{after.sheet}"] * (sheets[0] != sheets[1])
        seconds = old.sheets.get(before.second_sheet), new.sheets.get(after.second_sheet)
        if seconds[0] != seconds[1] and before.second_sheet == after.second_sheet:
            what.append(f"sheet.{after.second_sheet}")
        shears = old.shears.get(before.shear), new.shears.get(after.shear)
        what += [f"shear.{after.shear}"] * (shears[0] != shears[1])
        if old.touch_of(before) != new.touch_of(after) and "touch" not in what:
            what.append("touch")
        if what:
            pads[number] = what
    tables = [name for name in ("daemon", "scene", "touch") if getattr(old, name) != getattr(new, name)]
    for name in ("nodes", "sheets", "responses", "shears", "objects"):
        before_all, after_all = getattr(old, name), getattr(new, name)
        keys = sorted(before_all.keys() | after_all.keys())
        tables += [f"{name[:-1]}.{key}" for key in keys if before_all.get(key) != after_all.get(key)]
    pairs_of_hands = zip(old.hands, new.hands, strict=True)
    tables += [f"hand {after.name}" for before, after in pairs_of_hands if before.object != after.object]
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
            f"[[hand]] {after.name}: {key} differs"
            for key in _changed_keys(before, after)
            if key not in ("pads", "object")
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
