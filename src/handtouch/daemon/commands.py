"""Commands of the control endpoint; each validates its arguments before it changes anything.

Public names: `ControlCommands`, `STATUS_AGE_NS`.
"""

from __future__ import annotations

import json
import logging
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Annotated, Any, Literal, TypeVar

import msgpack
import numpy as np
from numpy.typing import NDArray
from pydantic import Field, ValidationError

from handtouch import wire
from handtouch.calibration.calibration import LAW_AGE_S, MAX_GAIN, MIN_GAIN, LawParameters
from handtouch.config import Deployment, ObjectTable, Table
from handtouch.config.files import deployment_files
from handtouch.config.tables import RequestedOutput, SceneRequest
from handtouch.core.events import BaselineEvent, EvidenceEvent
from handtouch.core.pad_patterns import PATTERNS_PER_PAD
from handtouch.core.pipeline import Pipeline
from handtouch.core.scene import Demand, scaled_limit
from handtouch.daemon.control import (
    MAX_REPLY_BYTES,
    Command,
    Job,
    JobCommand,
    RefusedError,
    Reply,
    format_value,
)
from handtouch.daemon.percept_client import known_object
from handtouch.daemon.reload import DeploymentChange, ReloadJob
from handtouch.daemon.sampling import SamplingController
from handtouch.daemon.status_reporter import StatusReporter
from handtouch.daemon.tare import TareJob
from handtouch.host.build import build_info
from handtouch.host.logs import set_level

STATUS_AGE_NS = 100_000_000
"""Age up to which a status is returned again, as making it takes milliseconds"""
_ENVELOPE_BYTES = 100  # v, ok, now_ns
_log = logging.getLogger("handtouch.control")

PadPattern = Annotated[str, Field(max_length=129)]
"""Hand, slash and link, each of up to 64 characters"""
PadPatterns = Annotated[tuple[PadPattern, ...], Field(strict=False, min_length=1, max_length=1000)]
ClientName = Annotated[str, Field(pattern=r"^[^\x00-\x1f\x7f]+$", max_length=64)]
CalibrationId = Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_.\-]*$", max_length=64)]
Gain = Annotated[float, Field(ge=MIN_GAIN, le=MAX_GAIN)]
Offset = Annotated[float, Field(ge=-1e9, le=1e9)]
Resistance = Annotated[float, Field(ge=1e-3, le=1e12)]


class _NoArguments(Table):
    pass


class _PadArguments(Table):
    pads: PadPatterns


class _SwitchArguments(_PadArguments):
    name: ClientName = "control"


class _SceneArguments(Table):
    links: Annotated[tuple[PadPattern, ...], Field(strict=False, max_length=1000)] | None = None
    outputs: Annotated[tuple[RequestedOutput, ...], Field(strict=False, max_length=10)] | None = None
    rate_hz: Annotated[float, Field(ge=0)] | None = None  # 0: every SYNC
    name: ClientName | None = None
    lease_s: Annotated[float, Field(ge=0.1, le=3600)] = 10.0
    reset: bool = False


class _LawArguments(Table):
    contact_ohm_mm2: Resistance
    alpha: Annotated[float, Field(ge=0.1, le=10)]
    ohm_per_square: Resistance
    hertz_force_n: Annotated[float, Field(gt=0, le=1000)] | None = None
    age_s: Annotated[float, Field(gt=0, le=3600)] = LAW_AGE_S


class _CalibrateArguments(Table):
    pad: Annotated[str, Field(max_length=200)]
    name: CalibrationId | None = None
    gains: Annotated[tuple[Gain, ...], Field(strict=False)] | None = None
    offset_counts: Annotated[tuple[Offset, ...], Field(strict=False)] | None = None
    law: _LawArguments | None = None
    second_law: _LawArguments | None = None


class _ReloadArguments(Table):
    dry_run: bool = False


class _ObjectArguments(Table):
    hand: Annotated[str, Field(max_length=64)]
    name: ClientName | None = None
    table: dict[str, Any] | None = None
    none: bool = False


class _LogArguments(Table):
    level: Literal["debug", "info", "warning", "error"]


class ControlCommands:
    """The daemon's commands, by name in `by_name`, longer ones in `jobs`.

    They run in the hot thread, between two ticks. `read` reads the deployment file again; None if the
    deployment has no file.
    """

    def __init__(
        self,
        deployment: Deployment,
        read: Callable[[], Deployment] | None,
        pipeline: Pipeline,
        reporter: StatusReporter,
        demand: Demand,
        sampling: SamplingController,
    ) -> None:
        self.deployment = deployment
        self._files: Mapping[str, bytes] = deployment_files(deployment)
        self._read_deployment, self._pipeline, self._reporter = read, pipeline, reporter
        self._demand, self._sampling = demand, sampling
        self._pad_names = demand.scenes.names
        self._reload_job: ReloadJob | None = None
        self._status_reply: Reply = {}
        self._status_ns: int | None = None
        changing: dict[str, Command] = {
            "scene": self._scene,
            "calibrate": self._calibrate,
            "enable": partial(self._switch, True),
            "disable": partial(self._switch, False),
            "log": self._set_log_level,
            "object": self._set_object,
        }
        self.by_name: dict[str, Command] = {
            "status": self._status,
            "snapshot": self._snapshot,
            **{name: partial(self._run_changing, command) for name, command in changing.items()},
        }
        self.jobs: dict[str, JobCommand] = {"tare": self._tare, "reload": self._reload_file}

    def _run_changing(self, command: Command, arguments: dict[str, Any], now_ns: int) -> Reply:
        """Run a command that may change what `status` returns."""
        self._status_ns = None
        return command(arguments, now_ns)

    def _status(self, arguments: dict[str, Any], now_ns: int) -> Reply:
        """Return the status, up to `STATUS_AGE_NS` old unless a command was carried out since."""
        parse_arguments(_NoArguments, arguments)
        if self._status_ns is None or now_ns - self._status_ns >= STATUS_AGE_NS:
            self._status_ns = now_ns
            self._status_reply = {**self._reporter.status(now_ns), "scene": self._scene_reply(now_ns)}
            limit = scaled_limit(MAX_REPLY_BYTES, len(self._pad_names))
            if len(msgpack.packb(self._status_reply)) > limit - _ENVELOPE_BYTES:
                self._status_reply["scene"] = {"scenes": [], "pads": []}
        return {**self._status_reply, "now_ns": time.monotonic_ns()}

    def _snapshot(self, arguments: dict[str, Any], now_ns: int) -> Reply:
        """Return all hands and contacts now, computed whether requested or not."""
        parse_arguments(_NoArguments, arguments)
        messages = self._pipeline.solved_messages(now_ns)
        maps = {topic: wire.to_map(message) for topic, message in messages.items()}
        return {
            "hands": {topic[len("hand/") :]: m for topic, m in maps.items() if topic.startswith("hand/")},
            "contacts": [message for topic, message in maps.items() if topic.startswith("contact/")],
        }

    def _scene(self, arguments: dict[str, Any], now_ns: int) -> Reply:
        request = parse_arguments(_SceneArguments, arguments)
        keys = ("links", "outputs", "rate_hz")
        given = {key: value for key in keys if (value := getattr(request, key)) is not None}
        if given.get("rate_hz") == 0:
            given["rate_hz"] = None
        if given and request.reset:
            raise RefusedError("reset can't be combined with other changes; send two requests")
        if request.name is None:
            _check_base_scene(request)
        scenes = self._demand.scenes
        try:
            self._check_count(request.links or ())
            if request.name is not None:
                scenes.check_size(request.name, request.links or ())
                if request.reset:
                    scenes.remove_client(request.name)
                else:
                    known = scenes.client_scene(request.name) or SceneRequest()
                    lease_ns = round(request.lease_s * 1e9)
                    scenes.set_client_scene(request.name, known.model_copy(update=given), lease_ns, now_ns)
            elif request.reset:
                scenes.set_base(None)
            elif given:
                kept = {key: getattr(scenes.base, key) for key in keys}
                scenes.set_base(SceneRequest(**{**kept, **given}))
        except ValueError as error:
            raise RefusedError(str(error)) from error
        self._demand.update(now_ns)
        return self._scene_reply(now_ns)

    def _check_count(self, patterns: Sequence[str]) -> None:
        """Raise ValueError for more patterns than name pads; matching them takes the loop's time."""
        most = PATTERNS_PER_PAD * len(self._pad_names)
        if len(patterns) > most:
            raise ValueError(f"{len(patterns)} patterns, and {most} are allowed; use wildcards")

    def _scene_reply(self, now_ns: int) -> Reply:
        return {"scenes": self._demand.scenes.describe(now_ns), "pads": self._demand.describe_pads()}

    def _tare(self, arguments: dict[str, Any], now_ns: int) -> Job:
        selected = self._select_pads(parse_arguments(_PadArguments, arguments).pads)
        return TareJob(self._pad_names, selected, self._pipeline, self._sampling, now_ns, self._on_tared)

    def _on_tared(self, pad: int, offset_counts: tuple[float, ...]) -> None:
        self._status_ns = None
        if self._reporter.supervisor is not None:
            self._reporter.supervisor.register_manual_calibration(pad, {"offset_counts"}, offset_counts)

    def _calibrate(self, arguments: dict[str, Any], now_ns: int) -> Reply:  # noqa: ARG002
        """Change the given parts of a pad's calibration, and return the whole calibration."""
        request = parse_arguments(_CalibrateArguments, arguments)
        pads = np.flatnonzero(self._select_pads([request.pad]))
        if len(pads) != 1:
            raise RefusedError(f"pad = {request.pad!r} matches {len(pads)} pads; name exactly one")
        (pad,) = pads.tolist()
        pipeline = self._pipeline
        before, offsets = pipeline.calibrations[pad].calibration_id, request.offset_counts
        if request.model_fields_set > {"pad"}:
            if request.name is None:
                raise RefusedError("name is missing: contacts are published with it as calibration_id")
            self._apply_calibration(pad, request, request.name)
            _log.info("%s: calibration %s -> %s", "/".join(self._pad_names[pad]), before, request.name)
        hand, link = self._pad_names[pad]
        calibration, model = pipeline.calibrations[pad], pipeline.model
        law = calibration.law or model.default_law(pad)
        second = calibration.second_law or model.default_second_law(pad)
        return {
            "hand": hand,
            "link": link,
            "previous_calibration_id": before,
            "calibration_id": calibration.calibration_id,
            "default_calibration_id": model.default_calibration_ids[pad],
            "gains": list(calibration.gains),
            "offset_counts": list(
                offsets or pipeline.tick.baseline.expected_counts[pad, : self._channels(pad)].tolist()
            ),
            "law": _law_values(law),
            "second_law": None if second is None else _law_values(second),
            "store": None if self._reporter.supervisor is None else self._reporter.supervisor.store,
        }

    def _apply_calibration(self, pad: int, request: _CalibrateArguments, name: str) -> None:
        pipeline = self._pipeline
        for key in ("gains", "offset_counts"):
            values = getattr(request, key)
            if values is not None and len(values) != self._channels(pad):
                raise RefusedError(f"{key} = {list(values)}: must have {self._channels(pad)} values")
        offsets, max_counts = request.offset_counts, float(pipeline.model.max_counts[pad]) / 2
        if offsets is not None and max(map(abs, offsets)) > max_counts:
            raise RefusedError(
                f"offset_counts = {list(offsets)}: larger than half the range, {max_counts:.0f} counts"
            )
        before = pipeline.calibrations[pad]
        if request.second_law is not None and not pipeline.tick.second.has_second(pad):
            raise RefusedError(f"second_law: {request.pad} has one sheet")
        laws = [
            own if new is None else LawParameters(**new.model_dump(), covariance=((0.0,) * 3,) * 3)
            for own, new in ((before.law, request.law), (before.second_law, request.second_law))
        ]
        gains = before.gains if request.gains is None else request.gains
        calibration = replace(before, calibration_id=name, gains=gains, law=laws[0], second_law=laws[1])
        pipeline.set_calibration(pad, calibration)
        pipeline.add_event(EvidenceEvent(pad))
        if offsets is not None:
            pipeline.add_event(BaselineEvent(pad, offsets, (0.0,) * len(offsets)))
        if self._reporter.supervisor is not None:
            parts = ("gains", "law", "offset_counts")
            given = {part for part in parts if getattr(request, part) is not None}
            given |= set() if request.second_law is None else {"law"}
            self._reporter.supervisor.register_manual_calibration(pad, given, offsets)

    def _channels(self, pad: int) -> int:
        return int(self._pipeline.model.electrode_counts[pad])

    def _switch(self, enable: bool, arguments: dict[str, Any], now_ns: int) -> Reply:
        request = parse_arguments(_SwitchArguments, arguments)
        pads = np.flatnonzero(self._select_pads(request.pads)).tolist()
        if enable:
            self._demand.enable(pads)
        else:
            self._demand.disable(pads, request.name)
        names = self.deployment.pad_names
        switched = "enabled" if enable else "disabled"
        _log.info("%s: %s by %s", ", ".join(names[pad] for pad in pads), switched, request.name)
        self._demand.update(now_ns)
        return {"disabled": {names[pad]: by for pad, by in self._demand.disabled_by.items()}}

    def _reload_file(self, arguments: dict[str, Any], now_ns: int) -> Job:
        request = parse_arguments(_ReloadArguments, arguments)
        if self._read_deployment is None:
            raise RefusedError("this daemon was not started from a deployment file")
        if self._reload_job is not None and not self._reload_job.done:
            raise RefusedError("another reload is in progress; retry when it has finished")
        self._reload_job = ReloadJob.start(
            self.deployment,
            self._files,
            self._read_deployment,
            self._apply_reload,
            request.dry_run,
            now_ns,
        )
        return self._reload_job

    def _apply_reload(self, change: DeploymentChange, now_ns: int) -> None:
        """Apply a reloaded deployment completely, between two ticks."""
        self._status_ns = None
        if change.model is not None:
            self._pipeline.replace_model(change.model, sorted(change.changed_keys_of_pad))
        if change.deployment.daemon.log_level != self.deployment.daemon.log_level:
            set_level(change.deployment.daemon.log_level)
        self.deployment = change.deployment
        supervisor = self._reporter.supervisor
        if supervisor is not None:
            supervisor.excitation.set_after(change.deployment.scene.excitation_off_after_s)
            if change.model is not None:
                supervisor.restart_with(change.deployment, now_ns)
        if self._reporter.percepts is not None and change.changed_keys_of_pad:
            self._reporter.percepts.restart_with(change.deployment, now_ns)
        if self._reporter.percepts is not None:
            self._reporter.percepts.set_stated_objects(change.deployment)
        self._files = change.files
        self._pipeline.journal.publish_config(change.deployment, dict(change.files), build_info(), now_ns)
        self._demand.scenes.set_file(change.deployment.scene)
        self._sampling.set_idle_settings(change.deployment.scene)
        changed = [
            *change.changed_tables,
            *("/".join(self._pad_names[pad]) for pad in change.changed_keys_of_pad),
        ]
        _log.info("deployment reloaded; changed: %s", ", ".join(changed) or "nothing")

    def _set_log_level(self, arguments: dict[str, Any], now_ns: int) -> Reply:  # noqa: ARG002
        request = parse_arguments(_LogArguments, arguments)
        before = logging.getLevelName(logging.getLogger("handtouch").getEffectiveLevel()).lower()
        set_level(request.level)
        return {"previous_level": before, "level": request.level}

    def _set_object(self, arguments: dict[str, Any], now_ns: int) -> Reply:  # noqa: ARG002
        """Set the object in a hand: one of the deployment by its name, or another by its table, or none."""
        request = parse_arguments(_ObjectArguments, arguments)
        percepts = self._reporter.percepts
        if percepts is None or request.hand not in percepts.objects:
            known = ", ".join(hand.name for hand in self.deployment.hands)
            raise RefusedError(f"hand = {request.hand!r}: there is no such hand; known: {known}")
        if request.none:
            percepts.set_object(request.hand, "")
        elif request.name is not None:
            percepts.set_object(request.hand, known_object(request.name, self._object_table(request)))
        name, _, table = percepts.objects[request.hand].partition("=")
        return {"hand": request.hand, "name": name or None, "table": json.loads(table) if table else None}

    def _object_table(self, request: _ObjectArguments) -> ObjectTable:
        assert request.name is not None
        if request.table is None:
            if request.name not in self.deployment.objects:
                known = ", ".join(self.deployment.objects) or "none"
                raise RefusedError(
                    f"name = {request.name!r}: the deployment has no such object; known: {known}; state "
                    "another with table"
                )
            return self.deployment.objects[request.name]
        if "=" in request.name:
            raise RefusedError(f"name = {request.name!r}: must have no =")
        table = parse_arguments(ObjectTable, request.table)
        if table.shape.kind == "mesh":
            raise RefusedError("a mesh must be stated in the deployment; send its name without a table")
        return table

    def _select_pads(self, patterns: Sequence[str]) -> NDArray[np.bool_]:
        try:
            self._check_count(patterns)
            return self._demand.scenes.pads.select(patterns)
        except ValueError as error:
            raise RefusedError(str(error)) from error


def _law_values(law: LawParameters) -> dict[str, Any]:
    return {key: getattr(law, key) for key in _LawArguments.model_fields}


def _check_base_scene(request: _SceneArguments) -> None:
    """Raise RefusedError for changes of the base scene that only a client's scene should make."""
    if "lease_s" in request.model_fields_set:
        raise RefusedError(
            'lease_s needs a name: the base scene lasts until reset; for your own scene add name = "NAME"'
        )
    if request.links == ():
        raise RefusedError(
            "links = [] would switch off every pad until reset; to switch pads off, send disable with "
            'pads = ["*"]; for a scene of your own add name = "NAME" and lease_s'
        )


_MAX_PROBLEMS = 5
_TEXTS = {
    "missing": "is missing",
    "extra_forbidden": "unknown argument",
    "tuple_type": "must be an array",
    "list_type": "must be an array",
    "string_type": "must be a string",
    "bool_type": "must be true or false",
    "int_type": "must be an integer",
    "float_type": "must be a number",
    "finite_number": "must be a finite number",
    "model_type": "must be an object",
    "model_attributes_type": "must be an object",
    "dict_type": "must be an object",
    "too_short": "must have at least {min_length} elements",
    "too_long": "must have at most {max_length} elements",
    "string_too_short": "must have at least {min_length} characters",
    "string_too_long": "must have at most {max_length} characters",
    "string_pattern_mismatch": "must match {pattern}",
    "literal_error": "must be {expected}",
    "enum": "must be {expected}",
    "greater_than": "must be greater than {gt:g}",
    "greater_than_equal": "must be at least {ge:g}",
    "less_than": "must be less than {lt:g}",
    "less_than_equal": "must be at most {le:g}",
}
"""pydantic error type -> text, with the values of its context"""

_T = TypeVar("_T", bound=Table)


def parse_arguments(kind: type[_T], arguments: dict[str, Any]) -> _T:
    """Return the arguments as a table of the given kind. Raises RefusedError naming every mistake."""
    try:
        return kind.model_validate(arguments)
    except ValidationError as error:
        known = ", ".join(kind.model_fields) or "none"
        problems = [_describe(dict(item)) for item in error.errors(include_url=False)[:_MAX_PROBLEMS]]
        raise RefusedError("; ".join(problems) + f" (arguments: {known})") from error


def _describe(error: dict[str, Any]) -> str:
    key = "".join(f"[{part}]" if isinstance(part, int) else f".{part}" for part in error["loc"]).lstrip(".")
    known = _TEXTS.get(error["type"])
    text = error["msg"] if known is None else known.format(**error.get("ctx", {})).replace("'", '"')
    return (
        f"{key} {text}" if error["type"] == "missing" else f"{key} = {format_value(error['input'])}: {text}"
    )
