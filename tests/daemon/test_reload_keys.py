"""Reload: what follows from each key of a deployment, and what a pad that doesn't change keeps."""

from __future__ import annotations

import copy
import dataclasses
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

from handtouch import wire
from handtouch.config import Deployment, Table, parse, shipped
from handtouch.config.tables import TABLES, Idle
from handtouch.core.pad_model import PadModel
from handtouch.core.pipeline import Pipeline
from handtouch.daemon.reload import find_changes, find_restart_changes
from handtouch.daemon.table_cache import build_pad_model
from tests.deployments import CYLINDER, deployment_text, pad_text
from tests.record.conftest import PERIOD_NS, SESSION, CollectingSink, Hand

APPLIED_WITHOUT_PADS = {"daemon", "scene", "object.ball", "hand h"}
"""tables whose changed keys are applied by other owners than the pads' model: log level, scenes, sampling,
known objects"""


VALUES: dict[str, object] = {
    "eds": str(shipped.path("handtouch-node.eds")),
    "channels": tuple(f"0x6401:{sub}:i32" for sub in range(1, 5)),
    "idle": Idle(delta_counts=12),
    "excitation_object": "0x2100:0:u8",
    "electrodes": ("xa", "x0", "y0", "yb"),
}
NOT_WALKED = {"node", "second_sheet", "shear", "electrode_arcs_mm", "switch_states"}
"""keys of a pad that need another table, or other electrodes"""


def other_values(name: str, value: object) -> Iterator[object]:
    """Return values of a key that differ from its present one, of its kind where that is known."""
    if name in VALUES:
        yield VALUES[name]
    elif isinstance(value, bool):
        yield not value
    elif isinstance(value, int | float):
        yield value + 1
    elif isinstance(value, str):
        yield value + "x"
    else:
        yield from (1.0, 1, "x", (0.5, 1.5), None)


def changed(value: object, name: str = "") -> Iterator[tuple[str, object]]:
    """Return the value with one key changed, for each key in it, and the key's path."""
    if isinstance(value, Table):
        for key in type(value).model_fields:
            for path, other in changed(getattr(value, key), key):
                yield f"{key}.{path}", value.model_copy(update={key: other})
    elif isinstance(value, dict):
        for key, item in value.items():
            for path, other in changed(item):
                yield f"{key}.{path}", {**value, key: other}
    elif isinstance(value, tuple) and any(isinstance(item, Table) for item in value):
        for number, item in enumerate(value):
            for path, other in changed(item):
                yield f"{number}.{path}", (*value[:number], other, *value[number + 1 :])
    else:
        yield from (("", other) for other in other_values(name, value) if other != value)


RICH = deployment_text(
    pad_text("plane", 1, extra="[hand.pad.touch]\nbegin_threshold_n = 0.2\n"), pad_text("round", 2, CYLINDER)
).replace(
    "[touch]",
    "[sheet.s.behaviour]\ngain_std = 0.2\n\n"
    '[object.ball]\nshape = { kind = "sphere", diameter_mm = 50.0 }\n\n[touch]',
    1,
)


def test_every_key_is_applied_or_needs_a_restart() -> None:
    """A key that is compared nowhere would be answered with "nothing changed"."""
    old = parse(RICH)
    found: dict[str, set[str]] = {}
    for path, new in changed(old):
        key = path.rstrip(".")
        found.setdefault(key, set())
        assert isinstance(new, Deployment)
        try:
            restart = find_restart_changes(old, new)
            pads, tables = ({}, []) if restart else find_changes(old, new)
        except (TypeError, ValueError, AttributeError, LookupError, RuntimeError):
            continue  # not a value of this key's kind
        outcome = "restart" if restart else "pads" if pads else " ".join(tables) or "unchanged"
        found[key].add(outcome)
    assert len(found) > 130
    assert {key.split(".")[-1] for key, outcomes in found.items() if not outcomes} == NOT_WALKED
    assert {key: outcome for key, outcome in found.items() if "unchanged" in outcome} == {}
    for key, outcomes in found.items():
        assert outcomes <= {"restart", "pads", *APPLIED_WITHOUT_PADS, "touch"}, key
        if "touch" in outcomes:  # every pad has its own, or the key is in it
            assert key.startswith("touch.")


def test_each_key_of_a_deployment_is_walked() -> None:
    walked = {type(value) for value in _tables(parse(RICH))}
    missing = {name for name, table in TABLES.items() if table not in walked}
    assert missing <= {"node.*.idle", "shear.*"}, missing


def _tables(value: object) -> Iterator[Table]:
    if isinstance(value, Table):
        yield value
        for name in type(value).model_fields:
            yield from _tables(getattr(value, name))
    elif isinstance(value, dict | tuple):
        for item in value.values() if isinstance(value, dict) else value:
            yield from _tables(item)


TWO_SHEETS = deployment_text(pad_text("plane", 1), pad_text("round", 2, CYLINDER)).replace(
    "[touch]",
    "[sheet.s.behaviour]\ncreep_share = 0.3\ncreep_time_s = 0.4\ngain_std = 0.2\n\n"
    "[sheet.other]\nohm_per_square = 2400.0\ncontact_ohm_mm2 = 20000.0\nalpha = 1.5\n"
    "contact_radius_mm = 2.5\ncontact_radius_std_mm = 0.5\n\n"
    "[sheet.other.behaviour]\ncreep_share = 0.2\ngain_std = 0.1\n\n[touch]",
    1,
)
SECOND = TWO_SHEETS.rindex('sheet = "s"')
DEPLOYMENT = TWO_SHEETS[:SECOND] + 'sheet = "other"' + TWO_SHEETS[SECOND + len('sheet = "s"') :]
TICKS = 240
CHANGES = [
    ("creep_share = 0.2", "creep_share = 0.4"),
    ("creep_share = 0.2", "creep_share = 0.2\ncreep_time_s = 3.0"),
    ("gain_std = 0.1", "gain_std = 0.3"),
    ("[sheet.other]\nohm_per_square = 2400.0", "[sheet.other]\nohm_per_square = 3000.0"),
    ("[sheet.other]\nohm_per_square = 2400.0\ncontact_ohm_mm2 = 20000.0",
     "[sheet.other]\nohm_per_square = 2400.0\ncontact_ohm_mm2 = 15000.0"),
    ("radius_mm = 10.0", "radius_mm = 12.0"),
]  # fmt: skip


@pytest.fixture(scope="module")
def models() -> list[tuple[Deployment, PadModel]]:
    """Return the deployment, and those in which something of the second pad differs, with their models."""
    texts = [DEPLOYMENT, *(DEPLOYMENT.replace(before, after) for before, after in CHANGES)]
    assert len(set(texts)) == len(texts)
    return [(deployment, build_pad_model(deployment)) for deployment in map(parse, texts)]


def _messages_of_first_pad(
    models: list[tuple[Deployment, PadModel]], seed: int, reloads: dict[int, int]
) -> list[dict[str, Any]]:
    """Return the contact messages of the first pad; reloads: tick -> number of a deployment."""
    sink = CollectingSink()
    deployment, model = models[0]
    hand = Hand(deployment, Pipeline(copy.deepcopy(model), PERIOD_NS, 0.6, sink, SESSION), sink)
    random, present = np.random.default_rng(seed), 0
    for tick in range(TICKS):
        if tick in reloads:
            new = reloads[tick]
            rows = sorted(find_changes(models[present][0], models[new][0])[0])
            assert rows in ([], [1])
            if rows:
                hand.pipeline.replace_model(copy.deepcopy(models[new][1]), rows)
            present = new
        hand.stroke_step(tick % 60 / 60, random)
    return [
        dataclasses.asdict(message)
        for message in sink.messages
        if isinstance(message, wire.Contact) and message.link == "plane"
    ]


@pytest.mark.parametrize("seed", range(6))
def test_a_pad_that_does_not_change_publishes_the_same_through_reloads(
    models: list[tuple[Deployment, PadModel]], seed: int
) -> None:
    random = np.random.default_rng(seed)
    ticks = sorted(random.choice(np.arange(1, TICKS), 4, replace=False).tolist())
    reloads = {tick: int(random.integers(len(models))) for tick in ticks}
    without = _messages_of_first_pad(models, seed, {})
    assert len(without) > 50
    messages = _messages_of_first_pad(models, seed, reloads)
    for message, expected in zip(messages, without, strict=True):
        differing = [key for key in expected if not _same(message[key], expected[key])]
        assert differing == [], (message["tick"], reloads)


def _same(value: object, expected: object) -> bool:
    return value == expected or (value != value and expected != expected)  # NaN
