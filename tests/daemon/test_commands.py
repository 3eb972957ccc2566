"""Control commands: arguments are validated first; refused requests get a reason."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import msgpack
import numpy as np
import pytest
import zmq
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from handtouch.calibration.calibration import (
    LawParameters,
)
from handtouch.client import request
from handtouch.config import ConfigError, Deployment, ObjectTable, parse
from handtouch.core.active_calibration import ActiveCalibration
from handtouch.core.scene import MAX_CLIENTS
from handtouch.daemon.control import MAX_REPLY_BYTES
from handtouch.daemon.daemon import HandtouchDaemon
from handtouch.daemon.table_cache import build_pad_model
from handtouch.wire import PadState

PERIOD_NS = 5_000_000
COMMANDS = (
    "status",
    "snapshot",
    "scene",
    "tare",
    "calibrate",
    "enable",
    "disable",
    "reload",
    "object",
    "log",
)
KEYS = (
    *("pads", "pad", "name", "links", "outputs", "rate_hz", "lease_s", "reset", "gains"),
    *("offset_counts", "law", "dry_run", "level", "hand", "table", "none", "anything"),
)
VALUES = st.recursive(
    st.none()
    | st.booleans()
    | st.integers(-(2**63), 2**64 - 1)
    | st.floats()
    | st.sampled_from(["*", "plane", "position", "force", "raw", "bench-1", "debug", ""])
    | st.binary(max_size=9),
    lambda inner: st.lists(inner, max_size=4),
    max_leaves=8,
)


BALL: dict[str, Any] = {"kind": "sphere", "diameter_mm": 60.0}
MESH: dict[str, Any] = {"kind": "mesh", "file": "/etc/passwd"}


class Bench:
    """A real daemon driven by the test; samples are written to its slab, as its bus has no nodes."""

    def __init__(self, deployment: Deployment, model: Any, endpoints: dict[str, str]) -> None:
        settings = deployment.daemon.model_copy(update=endpoints)
        self.deployment = deployment.model_copy(update={"daemon": settings})
        self.reloaded: Callable[[], Deployment] = lambda: self.deployment
        self.daemon = HandtouchDaemon.open(self.deployment, model, lambda: self.reloaded())
        self.pipeline, self.control = self.daemon.pipeline, self.daemon.control
        self.pipeline.node_state[:] = PadState.CLEAR
        self.t_ns = 10**12
        self.counts = np.zeros((3, 4))
        self._noise = np.random.default_rng(3)

    def tick(self) -> None:
        self.t_ns += PERIOD_NS
        self.pipeline.begin_cycle(self.t_ns, self.t_ns)
        read = np.rint(self.counts + self._noise.normal(size=self.counts.shape)).astype("<i2")
        for pad, row in enumerate(read):
            self.pipeline.slab.write_pdo(pad, row.tobytes(), self.t_ns + 1000)
        self.pipeline.tick_if_due(self.t_ns + 2000)
        self.daemon.demand.update(self.t_ns)

    def ask(self, command: str, **arguments: Any) -> dict[str, Any]:
        """Run ticks until the reply is there, and return it."""
        with zmq.Context() as context, context.socket(zmq.REQ) as client:
            client.connect(self.control.endpoint)
            client.send(msgpack.packb({"v": 1, "command": command, **arguments}))
            while not client.poll(1):  # a reload's thread needs its share
                self.tick()
                self.control.poll(self.t_ns)
            return dict(msgpack.unpackb(client.recv()))

    def pads(self, answer: dict[str, Any]) -> dict[str, Any]:
        assert answer["ok"], answer
        return {pad["link"]: pad for pad in answer["pads"]}


@pytest.fixture
def served(bench: Any, endpoints: dict[str, str]) -> Iterator[Bench]:
    made = Bench(bench.deployment, build_pad_model(bench.deployment), endpoints)
    for _ in range(5):
        made.tick()
    yield made
    made.daemon.close()
    logging.getLogger("handtouch").setLevel(logging.NOTSET)


def test_a_daemon_whose_every_tick_is_late_answers_and_notifies_the_watchdog(
    served: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(served.daemon.gravity, "update_felt", lambda _: time.sleep(4e-9 * PERIOD_NS))
    stop, notified = threading.Event(), list[int]()
    thread = threading.Thread(target=served.daemon.run, args=(stop, notified.append))
    thread.start()
    try:
        overruns, end_s = 0, time.monotonic() + 60
        while (not overruns or len(notified) < 2) and time.monotonic() < end_s:
            answer = request("status", endpoint=served.control.endpoint, timeout_s=60)
            overruns = answer["service"]["overruns"]
    finally:
        stop.set()
        thread.join()
    assert overruns > 0
    assert len(notified) > 1


@settings(max_examples=100, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.sampled_from(COMMANDS), st.dictionaries(st.sampled_from(KEYS), VALUES, max_size=5))
def test_any_arguments_get_a_reply_and_ticks_continue(
    served: Bench, command: str, arguments: dict[str, Any]
) -> None:
    request = msgpack.packb({"v": 1, "command": command, **arguments})
    _, answer = served.control.start_request(request, served.t_ns)
    if isinstance(answer, dict):
        assert msgpack.unpackb(msgpack.packb(answer))["v"] == 1
        assert "failed" not in answer.get("error", "")
    else:
        answer.poll(served.t_ns)
    ticks = served.pipeline.ticks
    served.tick()
    assert served.pipeline.ticks == ticks + 1


@pytest.mark.parametrize(
    ("command", "arguments", "why"),
    [
        ("tare", {}, "pads is missing"),
        ("tare", {"pads": []}, "pads = []: must have at least 1 elements"),
        ("tare", {"pads": ["nowhere"]}, 'no pad is named "nowhere"'),
        ("tare", {"pads": ["plaen"]}, 'did you mean "plane"? there are'),
        ("tare", {"pads": "plane"}, 'pads = "plane": must be an array'),
        ("tare", {"pads": [1]}, "pads[0] = 1: must be a string"),
        ("tare", {"pads": b"plane"}, 'pads = "binary": must be an array'),
        ("reload", {"dry_run": "yes"}, 'dry_run = "yes": must be true or false'),
        ("calibrate", {"pad": "plane", "name": "c", "law": 1}, "law = 1: must be an object"),
        ("scene", {"tolerance": 1}, "tolerance"),
        ("scene", {"outputs": ["smell"]}, "position"),
        ("scene", {"rate_hz": -1.0}, "rate_hz = -1.0: must be at least 0"),
        ("scene", {"rate_hz": float("nan")}, "rate_hz"),
        ("scene", {"links": ["thumb*"]}, "no pad is named"),
        ("scene", {"reset": True, "rate_hz": 5.0}, "send two requests"),
        ("scene", {"name": "a\nb"}, "name"),
        (
            "scene",
            {"lease_s": 5.0, "rate_hz": 5.0},
            "lease_s needs a name",
        ),
        ("scene", {"links": []}, 'to switch pads off, send disable with pads = ["*"]'),
        ("calibrate", {"pad": "*", "name": "c", "gains": [1] * 4, "offset_counts": [0] * 4}, "3 pads"),
        ("calibrate", {"pad": "plane", "name": "c", "gains": [1] * 3, "offset_counts": [0] * 4}, "gains"),
        ("calibrate", {"pad": "plane", "name": "c", "gains": [11] * 4, "offset_counts": [0] * 4}, "gains"),
        ("calibrate", {"pad": "plane", "name": "c", "gains": [1] * 4, "offset_counts": [2e4] * 4}, "half"),
        ("calibrate", {"pad": "plane", "gains": [1] * 4}, "name is missing"),
        ("calibrate", {"pad": "plane", "name": "c", "law": {"alpha": 1.5}}, "contact_ohm_mm2 is missing"),
        ("object", {"hand": "left"}, "hand = 'left': there is no such hand; known: h"),
        (
            "object",
            {"hand": "h", "name": "mug"},
            "name = 'mug': the deployment has no such object; known: none",
        ),
        (
            "object",
            {"hand": "h", "name": "mug", "table": {"shape": MESH}},
            "a mesh must be stated in the deployment",
        ),
        ("object", {"hand": "h", "name": "a=b", "table": {"shape": BALL}}, "must have no ="),
        ("log", {"level": "loud"}, 'level = "loud": must be "debug", "info", "warning" or "error"'),
        ("log", {"level": msgpack.Timestamp(1)}, 'level = "extension type": must be'),
        ("status", {"verbose": True}, "verbose = true: unknown argument"),
    ],
)
def test_invalid_arguments_are_refused_in_json_terms_and_change_nothing(
    served: Bench, command: str, arguments: dict[str, Any], why: str
) -> None:
    before = served.daemon.demand.scenes.version
    answer = served.ask(command, **arguments)
    assert not answer["ok"]
    assert why in answer["error"]
    assert served.daemon.demand.scenes.version == before
    assert np.abs(served.pipeline.tick.baseline.expected_counts).max() < 1  # noise of a count


def test_tare_sets_the_offsets_of_an_unloaded_pad(served: Bench) -> None:
    served.counts[0] = [5, -4, 3, 2]
    (pad,) = served.pads(served.ask("tare", pads=["plane"])).values()
    assert (pad["tared"], pad["samples"]) == (True, 200)
    np.testing.assert_allclose(pad["offset_counts"], served.counts[0], atol=5 / np.sqrt(200))
    served.counts[1] = [3, 3, 3, 3]
    for _ in range(100):
        served.tick()
    noise_a = served.pipeline.model.noise_a[0].sum()
    assert abs(served.pipeline.tick.columns.total_current_a[0]) < 4 * noise_a


@pytest.mark.parametrize(
    ("part", "noise", "why"),
    [(10.0, 0.0, "touched"), (0.9, 0.0, "from the baseline"), (0.0, 12.0, "standard deviation")],
    ids=["touched", "lightly loaded", "noisy"],
)
def test_tare_is_refused_with_the_reason(served: Bench, part: float, noise: float, why: str) -> None:
    model = served.pipeline.model
    for _ in range(60):  # untouched before
        served.tick()
    counts = (
        part * model.begin_threshold_a[0] / 4 / model.ampere_per_count[0]
    )  # fraction of the begin threshold
    extra = np.random.default_rng(9)
    job = served.daemon.control.jobs["tare"]({"pads": ["plane", "round"]}, served.t_ns)
    answer = None
    while answer is None:
        served.counts[0] = counts + noise * extra.normal(size=4)
        served.tick()
        answer = job.poll(served.t_ns)
    plane, round_ = answer["pads"]
    assert not plane["tared"]
    assert why in plane["reason"]
    assert round_["tared"]
    assert served.pipeline.tick.baseline.expected_counts[0] == pytest.approx(0.0, abs=3.0)


def test_tare_is_refused_without_samples(served: Bench) -> None:
    served.pipeline.node_state[2] = PadState.LOST
    pad = served.pads(served.ask("tare", pads=["resisted"]))["resisted"]
    assert not pad["tared"]
    assert "lost" in pad["reason"]


def test_calibration_scales_and_shifts_currents(served: Bench) -> None:
    served.counts[0] = 200
    served.ask("calibrate", pad="plane", name="c1", gains=[2, 1, 1, 1], offset_counts=[100, 0, 0, 0])
    for _ in range(3):
        served.tick()
    model = served.pipeline.model
    amperes = served.deployment.nodes["n"].full_scale_ma * 1e-3 / 32767
    expected = (2 * 100 + 3 * 200) * amperes
    assert served.pipeline.tick.columns.total_current_a[0] == pytest.approx(expected, abs=10 * amperes)
    ids = [calibration.calibration_id for calibration in model.calibrations]
    assert ids[:2] == ["c1", model.default_calibration_ids[1]]


def test_status_lists_computed_outputs_and_their_requesters(served: Bench) -> None:
    pads = served.pads(served.ask("status")["scene"] | {"ok": True})
    assert pads["plane"]["computed"] == ["contact"]
    assert pads["plane"]["not_computed"]["position"] == "no subscriber"
    served.ask("disable", pads=["round"], name="me")
    pads = served.pads(served.ask("scene", links=["plane", "round"]))
    assert pads["round"]["not_computed"]["contact"] == "disabled by me"
    assert pads["resisted"]["not_computed"]["contact"] == "in no scene"


def test_no_answer_is_longer_than_stated(served: Bench) -> None:
    """With as many clients as there may be, as long names and patterns as they may have."""
    for client in range(MAX_CLIENTS):
        name = f"{client}".ljust(64, "x")
        assert served.ask("scene", name=name, links=["*" * 129] * 6, lease_s=3600.0)["ok"]
    scene, status = served.ask("scene"), served.ask("status")
    assert len(scene["scenes"]) == 1 + MAX_CLIENTS
    assert status["scene"]["scenes"]
    for reply in (scene, status, served.ask("snapshot")):
        assert len(msgpack.packb(reply)) <= MAX_REPLY_BYTES


def test_snapshot_solves_unrequested_outputs_and_leaves_no_trace(served: Bench) -> None:
    for _ in range(60):  # until the baselines are known
        served.tick()
    served.counts[0] = 400
    for _ in range(4):
        served.tick()
    columns = served.pipeline.tick.columns
    assert np.isnan(columns.position_m[0]).all()
    (contact,) = served.ask("snapshot")["contacts"]
    assert (contact["position_status"], contact["force_status"], contact["link"]) == (
        "unreliable",  # no point of a pad of 30 x 24 mm sends the same current to every electrode
        "unreliable",  # nor is the force that of one contact
        "plane",
    )
    assert np.isnan(columns.position_m[0]).all()
    assert np.isnan(columns.published_values).all()


def test_reload_keeps_calibrations_and_contacts(served: Bench) -> None:
    served.ask("calibrate", pad="round", name="c1", gains=[1.1] * 4, offset_counts=[2] * 4)
    served.counts[0] = 400
    for _ in range(4):
        served.tick()
    contact = int(served.pipeline.tick.state.contact_id[0])
    _change_sheet(served)
    answer = served.ask("reload")
    assert answer["ok"], answer
    assert answer["tables"] == ["sheet.s"]
    assert answer["pads"] == {f"h/{link}": ["sheet.s"] for link in ("plane", "round", "resisted")}
    for _ in range(4):
        served.tick()
    model = served.pipeline.model
    assert served.pipeline.tick.model is model
    assert model.calibrations[1].calibration_id == "c1"
    assert (served.pipeline.tick.baseline.expected_counts[1] > 0.5).all()  # it falls to the readings of 0
    assert model.calibrations[0].calibration_id == model.default_calibration_ids[0]
    assert int(served.pipeline.tick.state.contact_id[0]) == contact
    assert model.begin_threshold_a[0] != 0
    assert served.ask("reload")["tables"] == []  # the new file is applied already


def test_contact_law_applies_from_the_next_sample_and_other_parts_stay(served: Bench) -> None:
    served.counts[0] = 900.0
    for _ in range(4):
        served.tick()
    model = served.pipeline.model
    on_a = model.begin_threshold_a.copy()
    (before,) = served.ask("snapshot")["contacts"]
    file = served.ask("calibrate", pad="plane")
    assert file["calibration_id"] == file["previous_calibration_id"] == file["default_calibration_id"]
    nominal = {"contact_ohm_mm2": 20000.0, "alpha": 1.5, "ohm_per_square": 2400.0, "hertz_force_n": None}
    nominal["age_s"] = 1.5
    assert file["law"] == nominal
    law = {**nominal, "contact_ohm_mm2": 20000.0 * 8}
    now = served.ask("calibrate", pad="plane", name="c2", law=law)
    assert (now["law"], now["gains"], now["calibration_id"]) == (law, file["gains"], "c2")
    served.tick()
    (after,) = served.ask("snapshot")["contacts"]
    assert (before["id"], after["calibration_id"]) == (after["id"], "c2")
    assert after["force_n"] == pytest.approx(4 * before["force_n"], rel=0.02)  # 8^(1 / alpha)
    assert after["peak_force_n"] < 1.01 * after["force_n"]  # of this calibration
    assert model.begin_threshold_a[0] == pytest.approx(on_a[0] / 8, rel=0.1)
    assert (model.begin_threshold_a[1:] == on_a[1:]).all()
    served.ask("calibrate", pad="plane", name="c3", offset_counts=[1] * 4)
    assert served.ask("calibrate", pad="plane")["law"] == law


def test_stored_calibration_is_applied_whole_and_an_empty_one_restores_the_file(served: Bench) -> None:
    model = served.pipeline.model
    nothing = ((0.0,) * 3,) * 3
    law = LawParameters(1e4, 1.2, 3000.0, nothing)
    on_a = model.begin_threshold_a.copy()
    model.set_calibration(0, ActiveCalibration("7-1", (1.1, 0.9, 1.0, 1.0), law))
    assert (model.law(0), model.gains[0, 0]) == (law, 1.1)
    new_model = build_pad_model(served.deployment)
    new_model.copy_calibrations(model)
    assert (new_model.law(0), new_model.begin_threshold_a[0]) == (law, model.begin_threshold_a[0])
    model.set_calibration(0, model.default_calibration(0))
    assert model.law(0).ohm_per_square == 2400.0
    assert model.begin_threshold_a == pytest.approx(on_a)


def test_dry_run_changes_nothing(served: Bench) -> None:
    _change_sheet(served)
    model = served.pipeline.model
    assert served.ask("reload", dry_run=True)["tables"] == ["sheet.s"]
    assert served.pipeline.model is model
    assert served.ask("reload", dry_run=True)["tables"] == ["sheet.s"]


def test_reload_refuses_changes_that_need_a_restart_and_invalid_files(served: Bench) -> None:
    present = served.deployment
    (hand,) = present.hands

    def with_pad(**update: Any) -> Deployment:
        pads = (hand.pads[0].model_copy(update=update), *hand.pads[1:])
        return present.model_copy(update={"hands": (hand.model_copy(update={"pads": pads}),)})

    def broken() -> Deployment:
        return parse("nonsense = 1")

    for reloaded, why in (
        (lambda: with_pad(node_id=9), "the node of h/plane"),
        (lambda: with_pad(electrodes=("xa", "x0", "y0", "yb")), "wiring"),
        (lambda: with_pad(link="other"), "the pads or their order"),
        (broken, "nonsense"),
    ):
        served.reloaded = reloaded
        answer = served.ask("reload")
        assert not answer["ok"]
        assert "nothing changed" in answer["error"]
        assert why in answer["error"]
    with pytest.raises(ConfigError):
        broken()


def test_reload_that_hangs_is_refused_and_the_next_one_works(served: Bench) -> None:
    forever = threading.Event()

    def hang() -> Deployment:
        served.t_ns += 60 * 10**9
        forever.wait()
        return served.deployment

    served.reloaded = hang
    refused = served.ask("reload")
    assert not refused["ok"]
    assert "takes longer than" in refused["error"]
    _change_sheet(served)
    assert served.ask("reload")["tables"] == ["sheet.s"]
    forever.set()


def test_reload_sees_another_content_of_a_file_that_the_deployment_names(
    served: Bench, tmp_path: Path
) -> None:
    eds = tmp_path / "node.eds"
    eds.write_bytes((Path(__file__).parent.parent / "data" / "eds" / "feldmann-ai4w.eds").read_bytes())
    node = served.deployment.nodes["n"].model_copy(update={"eds": str(eds)})
    deployment = served.deployment.model_copy(update={"nodes": {"n": node}})
    endpoints = {stream: f"ipc://{tmp_path}/{stream}" for stream in ("live", "complete", "control", "inputs")}
    bench = Bench(deployment, build_pad_model(deployment), endpoints)
    try:
        assert bench.ask("reload")["ok"]
        eds.write_text(eds.read_text(errors="replace") + "\n; changed\n")
        answer = bench.ask("reload")
        assert not answer["ok"]
        assert f"{eds} has another content" in answer["error"]
    finally:
        bench.daemon.close()


def _change_sheet(served: Bench) -> None:
    sheet = served.deployment.sheets["s"].model_copy(update={"ohm_per_square": 3000.0})
    changed = served.deployment.model_copy(update={"sheets": {"s": sheet}})
    served.reloaded = lambda: changed


def test_the_session_is_random_and_exact_as_a_double(served: Bench, tmp_path: Path) -> None:
    endpoints = {stream: f"ipc://{tmp_path}/{stream}" for stream in ("live", "complete", "control", "inputs")}
    again = Bench(served.deployment, build_pad_model(served.deployment), endpoints)
    sessions = [made.daemon.publisher.session for made in (served, again)]
    again.daemon.close()
    assert sessions[0] != sessions[1]
    assert all(0 <= session < 2**53 and abs(session - time.time()) > 1e6 for session in sessions)


def test_an_object_is_stated_over_control_until_the_deployments_object_changes(served: Bench) -> None:
    assert served.ask("object", hand="h")["name"] is None
    answer = served.ask("object", hand="h", name="ball", table={"shape": BALL})
    assert (answer["name"], answer["table"]) == ("ball", {"shape": BALL})
    before = served.deployment
    served.reloaded = lambda: before
    assert served.ask("reload")["ok"]
    assert served.ask("object", hand="h")["name"] == "ball"
    hand = before.hands[0].model_copy(update={"object": "rod"})
    rod = ObjectTable.model_validate({"shape": {"kind": "cylinder", "diameter_mm": 9.0, "length_mm": 90.0}})
    served.reloaded = lambda: before.model_copy(update={"hands": (hand,), "objects": {"rod": rod}})
    assert set(served.ask("reload")["tables"]) == {"object.rod", "hand h"}
    assert served.ask("object", hand="h")["name"] == "rod"
    assert served.ask("object", hand="h", none=True)["name"] is None
