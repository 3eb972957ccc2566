"""`handtouch commission` on simulated nodes: wiring is found, and every fault of a pad is named."""

from __future__ import annotations

import contextlib
import itertools
import random
import re
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import can
import numpy as np
import pytest
from numpy.typing import NDArray
from rich.text import Text

from handtouch import cli, config
from handtouch.canbus.nodes.lifecycle_types import NodeState
from handtouch.canbus.nodes.spec import Identity, NodeStatus
from handtouch.cli import commission as commission_command
from handtouch.cli.commission import format_table
from handtouch.config import shipped
from handtouch.config.tables import SIDE_ELECTRODES
from handtouch.device import Device, DeviceBus
from handtouch.hand import pad_network, pad_surface
from handtouch.procedures.commission.deployment_edit import apply_edits
from handtouch.procedures.commission.electrode_order import PRESS_TARGETS, target_fractions
from handtouch.procedures.commission.outcome import PadOutcome, PadResult, SampleSource
from handtouch.procedures.commission.procedure import CommissioningProcedure
from handtouch.procedures.commission.sample_source import HandSample, open_sample_source
from handtouch.procedures.dialogue import Key
from tests.deployments import SIX_ARCS, arcs_text

PROMPT = re.compile(r"\[\d+/\d+\] \w+/(\w+): press (?:it anywhere|near electrode (\w+))")
TOTAL = 4000.0
PERIOD_NS = 20_000_000
START = 1  # NMT
_numbers = itertools.count()

pytestmark = pytest.mark.filterwarnings("ignore::ResourceWarning")


class Pads:
    """A hand of a few pads on a virtual bus; presses show in the next samples."""

    def __init__(self, links: list[str], whole: config.Deployment | None = None, **changes: Any) -> None:
        channel = f"commission{next(_numbers)}"
        self.option = f"can0=virtual:{channel}"
        whole = whole or config.parse(shipped.path("utah_mit.toml").read_text())
        pads = tuple(pad for pad in whole.hands[0].pads if pad.link in links)
        hand = whole.hands[0].model_copy(update={"pads": pads})
        nodes = {name: node.model_copy(update=changes) for name, node in whole.nodes.items()}
        self.truth = config.with_bus(whole.model_copy(update={"hands": (hand,), "nodes": nodes}), self.option)
        self._pads = pads
        self._networks = [pad_network(pad, whole.sheets[pad.sheet]) for pad in pads]
        self._rng = np.random.default_rng(1)
        shape = len(pads), max(len(pad.electrode_names) for pad in pads)
        self.currents, self.offset, self.noise = np.zeros(shape), np.zeros(shape), np.ones(shape)
        self._bus = can.Bus(interface="virtual", channel=channel)
        self.nodes = DeviceBus(self._bus, self._sample)
        self.devices: dict[str, Device] = {
            pad.link: self.nodes.add(
                pad.node_id,
                serial=pad.serial,
                channels=tuple((0x6401, sub + 1) for sub in range(len(pad.electrode_names))),
            )
            for pad in pads
        }

    def press(self, link: str, near: str | None, total: float = TOTAL) -> None:
        """Press near an electrode, or in the middle."""
        row = [pad.link for pad in self._pads].index(link)
        pad, network, surface = self._pads[row], self._networks[row], pad_surface(self._pads[row])
        targets = dict(zip(pad.electrode_names, target_fractions(network), strict=True))
        s, t = (0.5, 0.5) if near is None else targets[near] if pad.arcs_mm else PRESS_TARGETS[near]
        x = s * network.a if pad.arcs_mm else surface.to_rectangle(s * surface.extent_m[0], 0.0)[0]
        self.currents[row, : len(targets)] = total * network.fractions(float(x), t * surface.b)

    def release(self) -> None:
        self.currents = np.zeros_like(self.currents)

    def close(self) -> None:
        self.nodes.stop()
        self._bus.shutdown()

    def _sample(self, _: int) -> NDArray[np.int64]:
        noise = self.noise * self._rng.standard_normal(self.currents.shape)
        return np.rint(self.offset + self.currents + noise).astype(np.int64)


class SteppedSource:
    """The nodes of `pads` as a SampleSource without waiting: each sample is the response to a SYNC."""

    def __init__(self, pads: Pads, deployment: config.Deployment) -> None:
        self._pads, self._t_ns = pads, 0
        configured = [(hand.name, pad) for hand in deployment.hands for pad in hand.pads]
        self._devices = [pads.nodes.devices[pad.node_id] for _, pad in configured]
        for device in self._devices:
            device.plug()
            self._send(0x000, bytes((START, device.node_id)))
        self.nodes = [
            NodeStatus(
                slot=slot,
                name=f"{hand}/{pad.link}",
                bus=pad.bus,
                node_id=pad.node_id,
                state=NodeState.OPERATIONAL,
                since_ns=0,
                reason="started",
                identity=Identity(0, serial=device.serial),
                cob_ids=(),
                guarded=False,
                idle=False,
                heartbeats=0,
                heartbeats_missed=0,
                reboots=0,
                emergencies=(),
                error_register=None,
                error_history=(),
            )
            for slot, ((hand, pad), device) in enumerate(zip(configured, self._devices, strict=True))
        ]

    def __enter__(self) -> SteppedSource:
        return self

    def __exit__(self, *_: object) -> None:
        pass

    def samples(self) -> Iterator[HandSample]:
        while True:
            self._t_ns += PERIOD_NS
            self._send(0x080)
            counts = np.zeros(self._pads.currents.shape, np.int64)
            for row, device in zip(counts, self._devices, strict=True):
                read = device.channel_counts()
                row[: len(read)] = read
            yield HandSample(
                self._t_ns, counts, np.array([bool(device.active_tpdos) for device in self._devices])
            )

    def _send(self, can_id: int, data: bytes = b"") -> None:
        message = can.Message(arbitration_id=can_id, data=data, is_extended_id=False)
        self._pads.nodes.handle_frame(message, self._t_ns)


@dataclass
class SimulatedUser:
    """A simulated user who presses as prompted, and answers questions with `keys`; a Dialogue.

    `instead`: link of a prompt -> another action, to simulate errors of the user.
    """

    pads: Pads
    keys: list[Key] = field(default_factory=list)
    instead: Mapping[str, Callable[[str | None], None]] = field(default_factory=dict)
    lines: list[str] = field(default_factory=list)
    pending: list[Key] = field(default_factory=list)
    other_pads: Pads | None = None

    @property
    def accepts_keys(self) -> bool:
        return bool(self.keys or self.pending)

    def print_line(self, text: str, style: str = "") -> None:  # noqa: ARG002
        self.lines.append(text)
        if prompt := PROMPT.search(text):
            electrode: Any = prompt[2]
            if prompt[1] in self.instead:
                self.instead[prompt[1]](electrode)
            else:
                self.pads.press(prompt[1], electrode)
        elif "let go" in text:
            self.pads.release()
            if self.other_pads is not None:
                self.other_pads.release()
        elif "Enter" in text and self.keys:
            self.pads.release()
            self.pending.append(self.keys.pop(0))

    def show_live(self, t_ns: int, draw: Callable[[], Text]) -> None:
        pass

    def read_key(self) -> Key | None:
        return self.pending.pop(0) if self.pending else None

    @property
    def text(self) -> str:
        return "\n".join(self.lines)


@pytest.fixture
def made() -> Iterator[Callable[..., Pads]]:
    all_made = []

    def make(*links: str, **changes: Any) -> Pads:
        all_made.append(Pads(list(links), **changes))
        return all_made[-1]

    yield make
    for pads in all_made:
        pads.close()


def run_commissioning(
    pads: Pads,
    user: SimulatedUser,
    deployment: config.Deployment | None = None,
    *,
    assume_yes: bool = False,
    source: SampleSource | None = None,
) -> tuple[dict[str, PadOutcome], CommissioningProcedure]:
    """Commission all pads with `deployment` as the file's contents; return the outcomes by link."""
    deployment = deployment or pads.truth
    rows = range(len(deployment.pads))
    source = source or SteppedSource(pads, deployment)
    procedure = CommissioningProcedure(
        deployment, source, user, lambda _: None, rows, assume_yes=assume_yes, timeout_s=20.0
    )
    procedure.run()
    text = format_table(procedure)
    assert all(outcome.name in text for outcome in procedure.outcomes)
    return {outcome.pad.link: outcome for outcome in procedure.outcomes}, procedure


def with_pads(deployment: config.Deployment, **updates: dict[str, Any]) -> config.Deployment:
    """Return the deployment with changed keys of some pads."""
    (hand,) = deployment.hands
    pads = tuple(pad.model_copy(update=updates.get(pad.link, {})) for pad in hand.pads)
    return deployment.model_copy(update={"hands": (hand.model_copy(update={"pads": pads}),)})


def test_hand_as_configured_is_ok_and_unchanged(made: Callable[..., Pads]) -> None:
    pads = made("index_distal", "palm_heel")
    outcomes, procedure = run_commissioning(pads, SimulatedUser(pads))
    assert {outcome.result for outcome in outcomes.values()} == {PadResult.AS_CONFIGURED}
    assert all(outcome.ok for outcome in outcomes.values())
    edits = procedure.assignment.pad_edits()
    assert {link: edit.as_keys() for (_, link), edit in edits.items()} == {
        pad.link: {name: getattr(pad, name) for name in ("bus", "node_id", "node", "serial", "electrodes")}
        for pad in pads.truth.hands[0].pads
    }


@pytest.mark.parametrize("order", [("xa", "x0", "y0", "yb"), ("y0", "x0", "yb", "xa")])
def test_electrode_order_is_found_whatever_the_file_contains(
    made: Callable[..., Pads], order: tuple[str, ...]
) -> None:
    pads = made("index_middle")
    pads.devices["index_middle"].wiring = tuple(map(SIDE_ELECTRODES.index, order))
    outcomes, _ = run_commissioning(
        pads, SimulatedUser(pads), with_pads(pads.truth, index_middle={"electrodes": order[::-1]})
    )
    assert outcomes["index_middle"].electrodes == order
    assert outcomes["index_middle"].result is PadResult.CHANGED


def test_electrodes_on_arcs_are_found_beside_a_pad_with_sides(made: Callable[..., Pads]) -> None:
    pads = made("plane", "disc", whole=config.parse(arcs_text(SIX_ARCS)))
    wired = (4, 1, 0, 5, 3, 2)
    pads.devices["disc"].wiring = wired
    user = SimulatedUser(pads)
    outcomes, _ = run_commissioning(pads, user)
    assert outcomes["disc"].electrodes == tuple("abcdef"[k] for k in wired)
    assert [outcome.result for outcome in outcomes.values()] == [PadResult.AS_CONFIGURED, PadResult.CHANGED]
    assert "the rim towards" in user.text


def test_a_node_of_another_number_of_channels_is_not_assigned(made: Callable[..., Pads]) -> None:
    pads = made("plane", "disc", whole=config.parse(arcs_text(SIX_ARCS)))
    user = SimulatedUser(pads, instead={"plane": lambda near: pads.press("disc", near and "a")})
    outcomes, _ = run_commissioning(pads, user)
    assert outcomes["plane"].electrodes is None
    assert "a node of 6 channels responded" in outcomes["plane"].problems[0]


def test_cyclically_swapped_nodes_are_assigned(made: Callable[..., Pads]) -> None:
    links = ("index_proximal", "index_middle", "index_distal")
    pads = made(*links)
    ids = [pad.node_id for pad in pads.truth.hands[0].pads]
    file = with_pads(
        pads.truth,
        **{link: {"node_id": ids[(i + 1) % 3], "serial": 1005 + i} for i, link in enumerate(links)},
    )
    outcomes, procedure = run_commissioning(pads, SimulatedUser(pads), file, assume_yes=True)
    found = {
        link: (edit.node_id, edit.serial) for (_, link), edit in procedure.assignment.pad_edits().items()
    }
    assert found == {pad.link: (pad.node_id, pad.serial) for pad in pads.truth.hands[0].pads}
    assert all(outcome.ok for outcome in outcomes.values())


def test_nodes_swapped_between_buses_and_kinds_are_assigned(made: Callable[..., Pads]) -> None:
    near_thumb, near_palm = made("thumb_middle"), made("palm_heel", noise_counts=3.0)
    near_thumb.nodes.start()
    near_palm.nodes.start()
    (thumb,), (palm,) = (pads.truth.hands[0].pads for pads in (near_thumb, near_palm))
    palm = palm.model_copy(update={"bus": "can1", "node": "noisy"})
    (can0,), (can1,) = (pads.truth.buses for pads in (near_thumb, near_palm))
    truth = near_thumb.truth.model_copy(
        update={
            "buses": (can0, can1.model_copy(update={"name": "can1"})),
            "nodes": {**near_thumb.truth.nodes, "noisy": near_palm.truth.nodes["four_channel"]},
            "hands": (near_thumb.truth.hands[0].model_copy(update={"pads": (thumb, palm)}),),
        }
    )
    keys = ("bus", "node_id", "node", "serial")
    thumbs, palms = ({key: getattr(pad, key) for key in keys} for pad in (thumb, palm))
    user = SimulatedUser(near_thumb, other_pads=near_palm)
    user.instead = {"palm_heel": lambda near: near_palm.press("palm_heel", near)}
    file = with_pads(truth, thumb_middle=palms, palm_heel=thumbs)
    with open_sample_source(file) as source:
        _, procedure = run_commissioning(near_thumb, user, file, assume_yes=True, source=source)
    assert apply_edits(truth, procedure.assignment.pad_edits()) == truth
    assert {link for _, link in procedure.assignment.pad_edits()} == {"thumb_middle", "palm_heel"}


def test_randomly_wired_hand_is_found(made: Callable[..., Pads]) -> None:
    (hand,) = config.parse(shipped.path("utah_mit.toml").read_text()).hands
    pads = made(*(pad.link for pad in hand.pads))
    chance = random.Random(1)
    right: dict[str, dict[str, Any]] = {}
    wrong: dict[str, dict[str, Any]] = {}
    others = chance.sample(hand.pads, len(hand.pads))
    for pad, other in zip(hand.pads, others, strict=True):
        right[pad.link] = {"electrodes": tuple(chance.sample(SIDE_ELECTRODES, 4))}
        pads.devices[pad.link].wiring = tuple(map(SIDE_ELECTRODES.index, right[pad.link]["electrodes"]))
        wrong[pad.link] = {"node_id": other.node_id, "serial": other.serial}
    outcomes, procedure = run_commissioning(
        pads, SimulatedUser(pads), with_pads(pads.truth, **wrong), assume_yes=True
    )
    assert all(outcome.ok for outcome in outcomes.values())
    assert apply_edits(pads.truth, procedure.assignment.pad_edits()) == with_pads(pads.truth, **right)


def test_swap_requires_confirmation(made: Callable[..., Pads]) -> None:
    pads = made("index_proximal", "index_middle")
    first, second = (pad.node_id for pad in pads.truth.hands[0].pads)
    file = with_pads(pads.truth, index_proximal={"node_id": second}, index_middle={"node_id": first})
    outcomes, procedure = run_commissioning(pads, SimulatedUser(pads))
    assert procedure.assignment.pad_edits()["right", "index_proximal"].node_id == first
    outcomes, procedure = run_commissioning(pads, SimulatedUser(pads), file)  # without keyboard input
    assert outcomes["index_proximal"].result is PadResult.SKIPPED
    assert not procedure.assignment.pad_edits()
    outcomes, procedure = run_commissioning(pads, SimulatedUser(pads, keys=[Key.ENTER]), file)
    assert procedure.assignment.pad_edits()["right", "index_proximal"].node_id == first
    assert all(outcome.ok for outcome in outcomes.values())


def test_dead_channel_is_named_and_the_order_still_found(
    made: Callable[..., Pads],
) -> None:
    pads = made("palm_thumb")
    order = ("yb", "x0", "y0", "xa")
    pads.devices["palm_thumb"].wiring = tuple(map(SIDE_ELECTRODES.index, order))
    pads.devices["palm_thumb"].open_electrodes = {SIDE_ELECTRODES.index("y0")}
    outcomes, _ = run_commissioning(pads, SimulatedUser(pads))
    assert outcomes["palm_thumb"].electrodes == order
    assert outcomes["palm_thumb"].problems == [
        "channel 3 (electrode y0) doesn't respond: broken wire or dead input"
    ]
    assert not outcomes["palm_thumb"].ok


def test_stuck_noisy_and_offset_channels_are_named(made: Callable[..., Pads]) -> None:
    pads = made("palm_thumb", "palm_heel")
    pads.devices["palm_thumb"].stuck_counts = {1: 123}
    pads.noise[0, 2] = 5.0  # palm_heel comes first
    pads.offset[0, 0] = -80
    outcomes, _ = run_commissioning(pads, SimulatedUser(pads))
    (stuck,) = outcomes["palm_thumb"].problems
    assert stuck == "channel 2 is stuck at 123 counts: broken input or amplifier"
    negative, noisy = outcomes["palm_heel"].problems
    assert negative == "channel 1 has a negative reading of -80 counts at rest"
    assert re.fullmatch(r"channel 3 is noisy: [45]\.\d counts, noise_counts = 1 is configured", noisy)
    assert all(outcome.electrodes == SIDE_ELECTRODES for outcome in outcomes.values())


def test_pad_without_response_is_reported_with_causes_and_others_continue(
    made: Callable[..., Pads],
) -> None:
    pads = made("index_proximal", "index_distal")
    pads.devices["index_proximal"].send_data = False
    outcomes, _ = run_commissioning(pads, SimulatedUser(pads))
    assert outcomes["index_proximal"].result is PadResult.NO_ANSWER
    assert "isn't on the bus" in outcomes["index_proximal"].problems[0]
    assert outcomes["index_distal"].result is PadResult.AS_CONFIGURED


def test_two_pads_pressed_together_are_reported(made: Callable[..., Pads]) -> None:
    pads = made("index_proximal", "index_distal")

    def both(near: str | None) -> None:
        pads.press("index_proximal", near)
        pads.press("index_distal", near)

    outcomes, _ = run_commissioning(pads, user := SimulatedUser(pads, instead={"index_proximal": both}))
    assert outcomes["index_proximal"].result is PadResult.AMBIGUOUS
    assert "respond together" in user.text
    assert outcomes["index_distal"].result is PadResult.AS_CONFIGURED


def test_press_of_another_pad_is_reported_and_repeated(made: Callable[..., Pads]) -> None:
    pads = made("index_proximal", "index_distal")
    presses = itertools.count()

    def press_another(near: str | None) -> None:
        pads.press("index_distal" if next(presses) == 1 else "index_proximal", near)

    outcomes, _ = run_commissioning(
        pads, user := SimulatedUser(pads, instead={"index_proximal": press_another})
    )
    assert "this time the node of right/index_distal responded" in user.text
    assert all(outcome.result is PadResult.AS_CONFIGURED for outcome in outcomes.values())


def test_presses_in_the_middle_leave_the_order_ambiguous(made: Callable[..., Pads]) -> None:
    pads = made("palm_heel")
    middle = {"palm_heel": lambda _: pads.press("palm_heel", None)}
    outcomes, procedure = run_commissioning(pads, user := SimulatedUser(pads, instead=middle))
    assert outcomes["palm_heel"].result is PadResult.AMBIGUOUS
    assert "the electrode order is ambiguous" in outcomes["palm_heel"].problems[0]
    assert sum("near electrode" in line for line in user.lines) == 6
    assert (
        procedure.assignment.pad_edits()["right", "palm_heel"].electrodes
        == pads.truth.hands[0].pads[0].electrodes
    )


def test_saturating_press_is_repeated(made: Callable[..., Pads]) -> None:
    pads = made("palm_heel")
    totals = iter([100_000.0, *[TOTAL] * 9])
    press = {"palm_heel": lambda near: pads.press("palm_heel", near, next(totals))}
    outcomes, _ = run_commissioning(pads, user := SimulatedUser(pads, instead=press))
    assert "press more lightly" in user.text
    assert outcomes["palm_heel"].result is PadResult.AS_CONFIGURED


def test_unequal_channel_scales_are_taken_into_account(made: Callable[..., Pads]) -> None:
    pads = made("palm_heel", channel_scale=(4.0, 1.0, 1.0, 0.5))
    order = ("y0", "xa", "x0", "yb")
    pads.devices["palm_heel"].wiring = tuple(map(SIDE_ELECTRODES.index, order))
    electrode_scale = {"y0": 4.0, "xa": 1.0, "x0": 1.0, "yb": 0.5}

    def press(near: str | None) -> None:
        pads.press("palm_heel", near)
        pads.currents[0] /= [electrode_scale[name] for name in SIDE_ELECTRODES]

    outcomes, _ = run_commissioning(pads, SimulatedUser(pads, instead={"palm_heel": press}))
    assert outcomes["palm_heel"].electrodes == order


def test_keys_skip_repeat_and_quit(made: Callable[..., Pads]) -> None:
    pads = made("index_proximal", "index_middle", "index_distal")
    user = SimulatedUser(pads)
    prompts: list[str] = []

    def key(link: str, *keys: Key) -> Callable[[str | None], None]:
        remaining = list(keys)

        def act(near: str | None) -> None:
            prompts.append(f"{link} {near}")
            if remaining:
                user.pending.append(remaining.pop(0))
            else:
                pads.press(link, near)

        return act

    user.instead = {
        "index_proximal": key("index_proximal", Key.AGAIN),
        "index_middle": key("index_middle", Key.SKIP),
        "index_distal": key("index_distal", Key.QUIT),
    }
    outcomes, _ = run_commissioning(pads, user)
    assert [outcome.result for outcome in outcomes.values()] == [
        PadResult.AS_CONFIGURED,
        PadResult.SKIPPED,
        PadResult.NOT_DONE,
    ]
    assert prompts[:2] == ["index_proximal None", "index_proximal None"]
    assert not outcomes["index_distal"].ok


def test_shared_serial_numbers_are_not_written(made: Callable[..., Pads]) -> None:
    pads = made("index_proximal", "index_distal")
    for device in pads.devices.values():
        device.write_object(0x1018, 4, 77, keep=True)
    _, procedure = run_commissioning(pads, SimulatedUser(pads))
    assert {edit.serial for edit in procedure.assignment.pad_edits().values()} == {None}


@dataclass
class CommissioningSetup:
    """A hand, its deployment file with the first two channels swapped, and a user."""

    pads: Pads
    path: Path
    user: SimulatedUser

    def run(self, **options: Any) -> int:
        return commission_command.run(self.path, [self.pads.option], **options)


@pytest.fixture
def setup(
    made: Callable[..., Pads],
    tmp_path: Path,
    endpoints: dict[str, str],
    monkeypatch: pytest.MonkeyPatch,
) -> CommissioningSetup:
    pads = made("thumb_proximal", "thumb_middle")
    user = SimulatedUser(pads)
    monkeypatch.setattr(commission_command, "open_dialogue", lambda: contextlib.nullcontext(user))
    monkeypatch.setattr(commission_command, "open_sample_source", lambda file: SteppedSource(pads, file))
    text = "".join(re.split(r"(?m)^(?=\[\[hand\.pad\]\])", shipped.path("utah_mit.toml").read_text())[:3])
    text = text.replace("[daemon]\n", f'[daemon]\ncontrol = "{endpoints["control"]}"\n')
    pads.devices["thumb_middle"].wiring = (1, 0, 2, 3)
    path = tmp_path / "hand.toml"
    path.write_text(text)
    return CommissioningSetup(pads, path, user)


def test_line_ends_are_preserved(setup: CommissioningSetup) -> None:
    before = setup.path.read_text().replace("\n", "\r\n")
    setup.path.write_bytes(before.encode())
    assert setup.run() == 0
    after = setup.path.read_bytes().decode()
    (new,) = set(after.split("\r\n")) - set(before.split("\r\n"))
    assert new == 'electrodes = ["xa", "x0", "y0", "yb"]'


def test_concurrent_edits_of_the_file_are_kept(setup: CommissioningSetup) -> None:
    def press_and_write(near: str | None) -> None:
        if near is None:
            setup.path.write_text(setup.path.read_text() + "# Mind the third finger.\n")
        setup.pads.press("thumb_middle", near)

    setup.user.instead = {"thumb_middle": press_and_write}
    assert setup.run() == 0
    after = setup.path.read_text()
    assert after.endswith("# Mind the third finger.\n")
    assert config.load(setup.path).hands[0].pads[1].electrodes == ("xa", "x0", "y0", "yb")


def test_file_that_cannot_hold_the_results_is_left_unchanged(
    setup: CommissioningSetup, capsys: pytest.CaptureFixture[str]
) -> None:
    broken = "a pad too few"

    def press_and_break(near: str | None) -> None:
        setup.path.write_text(broken)
        setup.pads.press("thumb_middle", near)

    setup.user.instead = {"thumb_middle": press_and_break}
    assert setup.run() == 1
    assert "can't be written" in setup.user.text
    assert setup.path.read_text() == broken
    assert "xa x0 y0 yb" in capsys.readouterr().out  # the result isn't lost


def test_one_pad_can_be_repeated(setup: CommissioningSetup) -> None:
    assert setup.run(links=["thumb_proximal"]) == 0
    assert (setup.path.parent / "hand.toml.commissioned").read_text() == "right/thumb_proximal\n"
    assert setup.run(links=["right/thumb_proximal"]) == 0
    assert sum("press it anywhere" in line for line in setup.user.lines) == 2
    assert setup.run() == 0
    assert not (setup.path.parent / "hand.toml.commissioned").exists()


def test_usage_is_checked_before_a_bus_is_opened(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "hand.toml"
    path.write_text(shipped.path("utah_mit.toml").read_text())
    assert cli.main(["commission", str(tmp_path / "none.toml")]) == 2
    assert cli.main(["commission", str(path), "--link", "toe_*"]) == 2
    assert "--link toe_*" in capsys.readouterr().err
    assert cli.main(["commission", str(path), "--bus", "can0=socketcan:none0"]) == 1
    assert "can't be opened" in capsys.readouterr().err
