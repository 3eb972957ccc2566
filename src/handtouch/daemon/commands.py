"""What the control endpoint can be asked for; each command checks its arguments before it touches anything.

Public names: `Commands`.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Sequence
from typing import Annotated, Any, Literal, TypeVar

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, ValidationError

from handtouch import wire
from handtouch.config import Deployment, Table
from handtouch.config.tables import Output, Wants
from handtouch.daemon.control import Command, Job, RefusedError, Reply
from handtouch.daemon.logs import set_level
from handtouch.daemon.pacer import Pacer
from handtouch.daemon.pipeline import Pipeline
from handtouch.daemon.reload import Fresh, Reload
from handtouch.daemon.report import Report
from handtouch.daemon.scene import Demand, select
from handtouch.daemon.tare import Tare
from handtouch.supervise.calibration import LEAST_GAIN, MOST_GAIN, Law

_log = logging.getLogger("handtouch.control")

Patterns = Annotated[
    tuple[Annotated[str, Field(max_length=200)], ...], Field(strict=False, min_length=1, max_length=1000)
]
Who = Annotated[str, Field(pattern=r"^[^\x00-\x1f\x7f]+$", max_length=64)]
Calibration = Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_.\-]*$", max_length=64)]
Gain = Annotated[float, Field(ge=LEAST_GAIN, le=MOST_GAIN)]
Offset = Annotated[float, Field(ge=-1e9, le=1e9)]
Resistance = Annotated[float, Field(ge=1e-3, le=1e12)]


class _Nothing(Table):
    pass


class _Pads(Table):
    pads: Patterns


class _Switch(_Pads):
    name: Who = "control"


class _Scene(Table):
    links: Annotated[tuple[str, ...], Field(strict=False, max_length=1000)] | None = None
    outputs: Annotated[tuple[Output, ...], Field(strict=False, max_length=10)] | None = None
    tolerance_mm: Annotated[float, Field(ge=0, le=10)] | None = None
    rate_hz: Annotated[float, Field(ge=0)] | None = None  # 0: every SYNC
    name: Who | None = None
    lease_s: Annotated[float, Field(ge=0.1, le=3600)] = 10.0
    reset: bool = False


class _Law(Table):
    contact_ohm_mm2: Resistance
    alpha: Annotated[float, Field(ge=0.1, le=10)]
    ohm_per_square: Resistance


class _Calibrate(Table):
    pad: Annotated[str, Field(max_length=200)]
    name: Calibration | None = None
    gains: Annotated[tuple[Gain, Gain, Gain, Gain], Field(strict=False)] | None = None
    offset_counts: Annotated[tuple[Offset, Offset, Offset, Offset], Field(strict=False)] | None = None
    law: _Law | None = None


class _Reload(Table):
    trial: bool = False


class _Log(Table):
    level: Literal["debug", "info", "warning", "error"]


_T = TypeVar("_T", bound=Table)


class Commands:
    """The commands of a daemon, by name in `by_name`; they run in the hot thread, between two ticks.

    `read` reads the deployment again, None where it came from no file.
    """

    def __init__(
        self,
        deployment: Deployment,
        read: Callable[[], Deployment] | None,
        pipeline: Pipeline,
        report: Report,
        demand: Demand,
        pacer: Pacer,
    ) -> None:
        self.deployment = deployment
        self._read, self._pipeline, self._report = read, pipeline, report
        self._demand, self._pacer = demand, pacer
        self._names = demand.scenes.names
        self._reload: Reload | None = None
        self.by_name: dict[str, Command] = {
            "status": self._status,
            "snapshot": self._snapshot,
            "scene": self._scene,
            "tare": self._tare,
            "calibrate": self._calibrate,
            "enable": self._enable,
            "disable": self._disable,
            "reload": self._reload_file,
            "log": self._log_level,
        }

    def _status(self, arguments: dict[str, Any], now_ns: int) -> Reply:
        _checked(_Nothing, arguments)
        return {**self._report.status(), "scene": self._told_scene(now_ns)}

    def _snapshot(self, arguments: dict[str, Any], now_ns: int) -> Reply:
        """All that can be said of the hands now, wanted by somebody or not."""
        _checked(_Nothing, arguments)
        tick, wanted = self._pipeline.tick, self._demand.wanted
        tick.solve_all()
        made = {topic: make(now_ns) for topic, make in self._pipeline.messages.present().items()}
        self._pipeline.want(wanted)
        told = {topic: wire.plain(message) for topic, message in made.items() if message is not None}
        return {
            "hands": {topic[len("hand/") :]: m for topic, m in told.items() if topic.startswith("hand/")},
            "contacts": [message for topic, message in told.items() if topic.startswith("contact/")],
        }

    def _scene(self, arguments: dict[str, Any], now_ns: int) -> Reply:
        asked = _checked(_Scene, arguments)
        keys = ("links", "outputs", "tolerance_mm", "rate_hz")
        given = {key: value for key in keys if (value := getattr(asked, key)) is not None}
        if given.get("rate_hz") == 0:
            given["rate_hz"] = None
        if given and asked.reset:
            raise RefusedError("reset takes no other change; ask for one after the other")
        scenes = self._demand.scenes
        try:
            if asked.name is not None:
                if asked.reset:
                    scenes.leave(asked.name)
                else:
                    known = scenes.held_by(asked.name) or Wants()
                    lease_ns = round(asked.lease_s * 1e9)
                    scenes.hold(asked.name, known.model_copy(update=given), lease_ns, now_ns)
            elif asked.reset:
                scenes.set_base(None)
            elif given:
                kept = {key: getattr(scenes.base, key) for key in keys}
                scenes.set_base(Wants(**{**kept, **given}))
        except ValueError as error:
            raise RefusedError(str(error)) from error
        self._demand.step(now_ns)
        return self._told_scene(now_ns)

    def _told_scene(self, now_ns: int) -> Reply:
        return {"scenes": self._demand.scenes.tell(now_ns), "pads": self._demand.tell()}

    def _tare(self, arguments: dict[str, Any], now_ns: int) -> Job:
        chosen = self._chosen(_checked(_Pads, arguments).pads)
        return Tare(self._names, chosen, self._pipeline.tick, self._pacer, now_ns, self._tared)

    def _tared(self, pad: int) -> None:
        if self._report.supervisor is not None:
            self._report.supervisor.put(pad, {"offset_counts"})

    def _calibrate(self, arguments: dict[str, Any], now_ns: int) -> Reply:  # noqa: ARG002
        """Change what is given of a pad's calibration, and tell all of it."""
        asked = _checked(_Calibrate, arguments)
        pads = np.flatnonzero(self._chosen([asked.pad]))
        if len(pads) != 1:
            raise RefusedError(f"pad = {asked.pad!r} names {len(pads)} pads; a calibration is of one")
        (pad,) = pads.tolist()
        model = self._pipeline.model
        before = model.calibration[pad]
        if asked.model_fields_set > {"pad"}:
            if asked.name is None:
                raise RefusedError("name is missing: contacts tell the calibration by it")
            self._put(pad, asked, asked.name)
            _log.info("%s: calibration %s -> %s", "/".join(self._names[pad]), before, asked.name)
        hand, link = self._names[pad]
        law = model.law(pad)
        return {
            "hand": hand,
            "link": link,
            "before": before,
            "now": model.calibration[pad],
            "nominal": model.nominal[pad],
            "gains": model.gains[pad].tolist(),
            "offset_counts": self._pipeline.tick.baseline.expected[pad].tolist(),
            "law": {key: getattr(law, key) for key in _Law.model_fields},
        }

    def _put(self, pad: int, asked: _Calibrate, name: str) -> None:
        model = self._pipeline.model
        offsets, largest = asked.offset_counts, float(model.largest_counts[pad]) / 2
        if offsets is not None and max(map(abs, offsets)) > largest:
            raise RefusedError(f"offset_counts = {list(offsets)}: beyond half the range, {largest:.0f}")
        law = model.laws[pad]
        if asked.law is not None:
            law = Law(**asked.law.model_dump(), covariance=((0.0,) * 3,) * 3)
        model.calibrate(pad, model.gains[pad] if asked.gains is None else asked.gains, name, law)
        self._pipeline.adopt(model, np.array([pad]))
        if offsets is not None:
            self._pipeline.tick.assume(pad, offsets)
        if self._report.supervisor is not None:
            parts = ("gains", "law", "offset_counts")
            self._report.supervisor.put(pad, {part for part in parts if getattr(asked, part) is not None})

    def _disable(self, arguments: dict[str, Any], now_ns: int) -> Reply:
        asked = _checked(_Switch, arguments)
        pads = np.flatnonzero(self._chosen(asked.pads)).tolist()
        self._demand.disable(pads, asked.name)
        _log.info("%s: disabled by %s", ", ".join("/".join(self._names[pad]) for pad in pads), asked.name)
        return self._switched(now_ns)

    def _enable(self, arguments: dict[str, Any], now_ns: int) -> Reply:
        asked = _checked(_Switch, arguments)
        pads = np.flatnonzero(self._chosen(asked.pads)).tolist()
        self._demand.enable(pads)
        _log.info("%s: enabled by %s", ", ".join("/".join(self._names[pad]) for pad in pads), asked.name)
        return self._switched(now_ns)

    def _switched(self, now_ns: int) -> Reply:
        self._demand.step(now_ns)
        return {"disabled": {"/".join(self._names[pad]): by for pad, by in self._demand.disabled_by.items()}}

    def _reload_file(self, arguments: dict[str, Any], now_ns: int) -> Job:  # noqa: ARG002
        asked = _checked(_Reload, arguments)
        if self._read is None:
            raise RefusedError("this daemon was not started from a deployment file")
        if self._reload is not None and not self._reload.done:
            raise RefusedError("another one is under way; ask again when it is done")
        self._reload = Reload(self.deployment, self._read, self._adopt, asked.trial)
        return self._reload

    def _adopt(self, fresh: Fresh) -> None:
        """Take over what the file says now: all of it, between two ticks."""
        if fresh.model is not None:
            fresh.model.take_over(self._pipeline.model)
            self._pipeline.adopt(fresh.model, np.array(sorted(fresh.pads), dtype=np.intp))
        if fresh.deployment.daemon.log_level != self.deployment.daemon.log_level:
            set_level(fresh.deployment.daemon.log_level)
        self.deployment = fresh.deployment
        if self._report.supervisor is not None and fresh.pads:
            self._report.supervisor.adopt(fresh.deployment, time.monotonic_ns())
        self._pipeline.journal.serve(fresh.deployment, now_ns=time.monotonic_ns())
        self._demand.scenes.set_file(fresh.deployment.scene)
        self._pacer.set_idle(fresh.deployment.scene)
        changed = [*fresh.tables, *("/".join(self._names[pad]) for pad in fresh.pads)]
        _log.info("deployment read again; changed: %s", ", ".join(changed) or "nothing")

    def _log_level(self, arguments: dict[str, Any], now_ns: int) -> Reply:  # noqa: ARG002
        asked = _checked(_Log, arguments)
        before = logging.getLevelName(logging.getLogger("handtouch").getEffectiveLevel()).lower()
        set_level(asked.level)
        return {"before": before, "now": asked.level}

    def _chosen(self, patterns: Sequence[str]) -> NDArray[np.bool_]:
        try:
            return select(patterns, self._names)
        except ValueError as error:
            raise RefusedError(str(error)) from error


def _checked(kind: type[_T], arguments: dict[str, Any]) -> _T:
    """The arguments, if they are of that kind. Raises RefusedError naming every mistake."""
    try:
        return kind.model_validate(arguments)
    except ValidationError as error:
        known = ", ".join(kind.model_fields) or "none"
        raise RefusedError(
            "; ".join(
                f"{'.'.join(map(str, item['loc']))} = {item['input']!r:.60}: {item['msg']}"
                if item["type"] != "missing"
                else f"{'.'.join(map(str, item['loc']))} is missing"
                for item in error.errors(include_url=False)[:5]
            )
            + f" (arguments: {known})"
        ) from error
