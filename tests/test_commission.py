"""`handtouch commission` on simulated nodes: what is wrong with a pad is found and named, whatever it is."""

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

from handtouch import cli, commission, config, shipped
from handtouch.canbus.device import Device, DeviceBus
from handtouch.canbus.nodes.boot import Identity
from handtouch.canbus.nodes.life import NodeState
from handtouch.canbus.nodes.spec import NodeStatus
from handtouch.canbus.objects.channels import ELECTRODES
from handtouch.commission.bench import Bench, Sample
from handtouch.commission.edit import applied
from handtouch.commission.order import ASKED, Near
from handtouch.commission.outcome import Hand, Outcome, Result
from handtouch.commission.report import table
from handtouch.commission.session import Session
from handtouch.dialogue import Key
from handtouch.hand import network_of, surface_of

PROMPT = re.compile(r"\[\d+/\d+\] right/(\w+): press (?:it anywhere|near electrode (\w+))")
TOTAL = 4000.0
PERIOD_NS = 20_000_000
START = 1  # NMT
_numbers = itertools.count()

pytestmark = pytest.mark.filterwarnings("ignore::ResourceWarning")


class Pads:
    """A hand of a few pads on a virtual bus; what is pressed shows in the next samples."""

    def __init__(self, links: list[str], **changes: Any) -> None:
        channel = f"commission{next(_numbers)}"
        self.option = f"can0=virtual:{channel}"
        whole = config.parse(shipped.path("utah_mit.toml").read_text())
        pads = tuple(pad for pad in whole.hands[0].pads if pad.link in links)
        hand = whole.hands[0].model_copy(update={"pads": pads})
        nodes = {"four_channel": whole.nodes["four_channel"].model_copy(update=changes)}
        self.truth = config.with_bus(whole.model_copy(update={"hands": (hand,), "nodes": nodes}), self.option)
        self._pads = pads
        self._networks = [network_of(pad, whole.sheets[pad.sheet]) for pad in pads]
        self._rng = np.random.default_rng(1)
        self._currents = np.zeros((len(pads), 4))
        self.offset = np.zeros((len(pads), 4))
        self.noise = np.ones((len(pads), 4))
        self._bus = can.Bus(interface="virtual", channel=channel)
        self.nodes = DeviceBus(self._bus, self._sample)
        self.devices: dict[str, Device] = {
            pad.link: self.nodes.add(pad.node_id, serial=pad.serial) for pad in pads
        }

    def press(self, link: str, near: Near | None, total: float = TOTAL) -> None:
        """Press near an electrode, or in the middle."""
        row = [pad.link for pad in self._pads].index(link)
        surface = surface_of(self._pads[row])
        s, t = (0.5, 0.5) if near is None else ASKED[near]
        x, _ = surface.to_rectangle(s * surface.extent_m[0], 0.0)
        self._currents[row] = total * self._networks[row].fractions(float(x), t * surface.b)

    def release(self) -> None:
        self._currents = np.zeros_like(self._currents)

    def close(self) -> None:
        self.nodes.stop()
        self._bus.shutdown()

    def _sample(self, _: int) -> NDArray[np.int64]:
        noise = self.noise * self._rng.standard_normal(self._currents.shape)
        return np.rint(self.offset + self._currents + noise).astype(np.int64)


class Stepped:
    """The nodes of `pads` as a Hand that nobody waits for: each sample is the answer to the next SYNC."""

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
            )
            for slot, ((hand, pad), device) in enumerate(zip(configured, self._devices, strict=True))
        ]

    def __enter__(self) -> Stepped:
        return self

    def __exit__(self, *_: object) -> None:
        pass

    def samples(self) -> Iterator[Sample]:
        while True:
            self._t_ns += PERIOD_NS
            self._send(0x080)
            counts = np.array([device.sample() for device in self._devices])
            yield Sample(self._t_ns, counts, np.array([bool(device.tpdos) for device in self._devices]))

    def _send(self, can_id: int, data: bytes = b"") -> None:
        message = can.Message(arbitration_id=can_id, data=data, is_extended_id=False)
        self._pads.nodes.handle(message, self._t_ns)


@dataclass
class Person:
    """Somebody who presses as told, and answers questions with `keys`; a Dialogue.

    `instead` (link asked for -> what is done instead) is how they err.
    """

    pads: Pads
    keys: list[Key] = field(default_factory=list)
    instead: Mapping[str, Callable[[Near | None], None]] = field(default_factory=dict)
    said: list[str] = field(default_factory=list)
    pending: list[Key] = field(default_factory=list)
    also: Pads | None = None

    @property
    def listens(self) -> bool:
        return bool(self.keys or self.pending)

    def say(self, text: str, style: str = "") -> None:  # noqa: ARG002
        self.said.append(text)
        if prompt := PROMPT.search(text):
            near: Any = prompt[2]
            if prompt[1] in self.instead:
                self.instead[prompt[1]](near)
            else:
                self.pads.press(prompt[1], near)
        elif "let go" in text:
            self.pads.release()
            if self.also is not None:
                self.also.release()
        elif "Enter" in text and self.keys:
            self.pads.release()
            self.pending.append(self.keys.pop(0))

    def show(self, t_ns: int, draw: Callable[[], Text]) -> None:
        pass

    def key(self) -> Key | None:
        return self.pending.pop(0) if self.pending else None

    @property
    def text(self) -> str:
        return "\n".join(self.said)


@pytest.fixture
def made() -> Iterator[Callable[..., Pads]]:
    all_made = []

    def make(*links: str, **changes: Any) -> Pads:
        all_made.append(Pads(list(links), **changes))
        return all_made[-1]

    yield make
    for pads in all_made:
        pads.close()


def told(
    pads: Pads,
    person: Person,
    deployment: config.Deployment | None = None,
    *,
    yes: bool = False,
    hand: Hand | None = None,
) -> tuple[dict[str, Outcome], Session]:
    """Commission all pads, the file saying `deployment` of them; outcomes by link."""
    deployment = deployment or pads.truth
    rows = range(sum(len(hand.pads) for hand in deployment.hands))
    hand = hand or Stepped(pads, deployment)
    session = Session(deployment, hand, person, lambda _: None, rows, yes=yes, patience_s=20.0)
    session.run()
    text = table(session)
    assert all(outcome.name in text for outcome in session.outcomes)
    return {outcome.pad.link: outcome for outcome in session.outcomes}, session


def with_pads(deployment: config.Deployment, **updates: dict[str, Any]) -> config.Deployment:
    """The deployment with other keys of some pads."""
    (hand,) = deployment.hands
    pads = tuple(pad.model_copy(update=updates.get(pad.link, {})) for pad in hand.pads)
    return deployment.model_copy(update={"hands": (hand.model_copy(update={"pads": pads}),)})


def test_a_hand_that_is_as_its_file_says_is_well_and_nothing_changes(made: Callable[..., Pads]) -> None:
    pads = made("index_distal", "palm_heel")
    outcomes, session = told(pads, Person(pads))
    assert {outcome.result for outcome in outcomes.values()} == {Result.WELL}
    assert all(outcome.well for outcome in outcomes.values())
    edits = session.ledger.edits()
    assert {link: edit.keys() for (_, link), edit in edits.items()} == {
        pad.link: {name: getattr(pad, name) for name in ("bus", "node_id", "node", "serial", "electrodes")}
        for pad in pads.truth.hands[0].pads
    }


@pytest.mark.parametrize("order", [("xa", "x0", "y0", "yb"), ("y0", "x0", "yb", "xa")])
def test_the_order_of_the_channels_is_found_whatever_the_file_says(
    made: Callable[..., Pads], order: tuple[str, ...]
) -> None:
    pads = made("index_middle")
    pads.devices["index_middle"].wired = tuple(map(ELECTRODES.index, order))
    outcomes, _ = told(pads, Person(pads), with_pads(pads.truth, index_middle={"electrodes": order[::-1]}))
    assert outcomes["index_middle"].electrodes == order
    assert outcomes["index_middle"].result is Result.CHANGED


def test_three_nodes_in_a_ring_go_each_to_its_pad(made: Callable[..., Pads]) -> None:
    links = ("index_proximal", "index_middle", "index_distal")
    pads = made(*links)
    ids = [pad.node_id for pad in pads.truth.hands[0].pads]
    file = with_pads(
        pads.truth,
        **{link: {"node_id": ids[(i + 1) % 3], "serial": 1005 + i} for i, link in enumerate(links)},
    )
    outcomes, session = told(pads, Person(pads), file, yes=True)
    found = {link: (edit.node_id, edit.serial) for (_, link), edit in session.ledger.edits().items()}
    assert found == {pad.link: (pad.node_id, pad.serial) for pad in pads.truth.hands[0].pads}
    assert all(outcome.well for outcome in outcomes.values())


def test_nodes_swapped_between_two_buses_and_of_two_kinds_go_to_their_pads(made: Callable[..., Pads]) -> None:
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
    person = Person(near_thumb, also=near_palm)
    person.instead = {"palm_heel": lambda near: near_palm.press("palm_heel", near)}
    file = with_pads(truth, thumb_middle=palms, palm_heel=thumbs)
    with Bench(file) as bench:
        _, session = told(near_thumb, person, file, yes=True, hand=bench)
    assert applied(truth, session.ledger.edits()) == truth
    assert {link for _, link in session.ledger.edits()} == {"thumb_middle", "palm_heel"}


def test_every_pad_of_a_whole_hand_wired_at_random_is_found(made: Callable[..., Pads]) -> None:
    (hand,) = config.parse(shipped.path("utah_mit.toml").read_text()).hands
    pads = made(*(pad.link for pad in hand.pads))
    chance = random.Random(1)
    right: dict[str, dict[str, Any]] = {}
    wrong: dict[str, dict[str, Any]] = {}
    others = chance.sample(hand.pads, len(hand.pads))
    for pad, other in zip(hand.pads, others, strict=True):
        right[pad.link] = {"electrodes": tuple(chance.sample(ELECTRODES, 4))}
        pads.devices[pad.link].wired = tuple(map(ELECTRODES.index, right[pad.link]["electrodes"]))
        wrong[pad.link] = {"node_id": other.node_id, "serial": other.serial}
    outcomes, session = told(pads, Person(pads), with_pads(pads.truth, **wrong), yes=True)
    assert all(outcome.well for outcome in outcomes.values())
    assert applied(pads.truth, session.ledger.edits()) == with_pads(pads.truth, **right)


def test_a_swap_is_taken_over_only_when_somebody_says_so(made: Callable[..., Pads]) -> None:
    pads = made("index_proximal", "index_middle")
    first, second = (pad.node_id for pad in pads.truth.hands[0].pads)
    file = with_pads(pads.truth, index_proximal={"node_id": second}, index_middle={"node_id": first})
    outcomes, session = told(pads, Person(pads))
    assert session.ledger.edits()["right", "index_proximal"].node_id == first
    outcomes, session = told(pads, Person(pads), file)  # nobody there to ask
    assert outcomes["index_proximal"].result is Result.SKIPPED
    assert not session.ledger.edits()
    outcomes, session = told(pads, Person(pads, keys=[Key.ENTER]), file)
    assert session.ledger.edits()["right", "index_proximal"].node_id == first
    assert all(outcome.well for outcome in outcomes.values())


def test_a_dead_channel_is_named_with_its_electrode_and_the_order_still_found(
    made: Callable[..., Pads],
) -> None:
    pads = made("palm_thumb")
    order = ("yb", "x0", "y0", "xa")
    pads.devices["palm_thumb"].wired = tuple(map(ELECTRODES.index, order))
    pads.devices["palm_thumb"].dead = {ELECTRODES.index("y0")}
    outcomes, _ = told(pads, Person(pads))
    assert outcomes["palm_thumb"].electrodes == order
    assert outcomes["palm_thumb"].problems == [
        "channel 3 (electrode y0) doesn't react: broken wire or dead input"
    ]
    assert not outcomes["palm_thumb"].well


def test_stuck_noisy_and_offset_channels_are_named(made: Callable[..., Pads]) -> None:
    pads = made("palm_thumb", "palm_heel")
    pads.devices["palm_thumb"].held = {1: 123}
    pads.noise[0, 2] = 5.0  # palm_heel comes first
    pads.offset[0, 0] = -80
    outcomes, _ = told(pads, Person(pads))
    (stuck,) = outcomes["palm_thumb"].problems
    assert stuck == "channel 2 is stuck at 123 counts: broken input or amplifier"
    negative, noisy = outcomes["palm_heel"].problems
    assert negative == "channel 1 has a negative reading of -80 counts at rest"
    assert re.fullmatch(r"channel 3 is noisy: [45]\.\d counts, noise_counts = 1 is configured", noisy)
    assert all(outcome.electrodes == ELECTRODES for outcome in outcomes.values())


def test_a_pad_whose_node_is_silent_is_told_with_likely_causes_and_the_others_are_done(
    made: Callable[..., Pads],
) -> None:
    pads = made("index_proximal", "index_distal")
    pads.devices["index_proximal"].send_data = False
    outcomes, _ = told(pads, Person(pads))
    assert outcomes["index_proximal"].result is Result.NO_ANSWER
    assert "isn't on the bus" in outcomes["index_proximal"].problems[0]
    assert outcomes["index_distal"].result is Result.WELL


def test_two_pads_pressed_at_once_are_told(made: Callable[..., Pads]) -> None:
    pads = made("index_proximal", "index_distal")

    def both(near: Near | None) -> None:
        pads.press("index_proximal", near)
        pads.press("index_distal", near)

    outcomes, _ = told(pads, person := Person(pads, instead={"index_proximal": both}))
    assert outcomes["index_proximal"].result is Result.UNCLEAR
    assert "answer together" in person.text
    assert outcomes["index_distal"].result is Result.WELL


def test_another_pad_pressed_halfway_is_told_and_asked_for_again(made: Callable[..., Pads]) -> None:
    pads = made("index_proximal", "index_distal")
    presses = itertools.count()

    def astray(near: Near | None) -> None:
        pads.press("index_distal" if next(presses) == 1 else "index_proximal", near)

    outcomes, _ = told(pads, person := Person(pads, instead={"index_proximal": astray}))
    assert "now the node of right/index_distal answered" in person.text
    assert all(outcome.result is Result.WELL for outcome in outcomes.values())


def test_a_press_in_the_middle_again_and_again_gives_no_order(made: Callable[..., Pads]) -> None:
    pads = made("palm_heel")
    middle = {"palm_heel": lambda _: pads.press("palm_heel", None)}
    outcomes, session = told(pads, person := Person(pads, instead=middle))
    assert outcomes["palm_heel"].result is Result.UNCLEAR
    assert "no order of the electrodes" in outcomes["palm_heel"].problems[0]
    assert sum("near electrode" in line for line in person.said) == 6
    assert session.ledger.edits()["right", "palm_heel"].electrodes == pads.truth.hands[0].pads[0].electrodes


def test_a_press_beyond_the_range_is_to_be_gentler(made: Callable[..., Pads]) -> None:
    pads = made("palm_heel")
    totals = iter([100_000.0, *[TOTAL] * 9])
    press = {"palm_heel": lambda near: pads.press("palm_heel", near, next(totals))}
    outcomes, _ = told(pads, person := Person(pads, instead=press))
    assert "press more gently" in person.text
    assert outcomes["palm_heel"].result is Result.WELL


def test_unequal_channel_scales_are_taken_into_account(made: Callable[..., Pads]) -> None:
    pads = made("palm_heel", channel_scale=(4.0, 1.0, 1.0, 0.5))
    order = ("y0", "xa", "x0", "yb")
    pads.devices["palm_heel"].wired = tuple(map(ELECTRODES.index, order))
    electrode_scale = {"y0": 4.0, "xa": 1.0, "x0": 1.0, "yb": 0.5}

    def press(near: Near | None) -> None:
        pads.press("palm_heel", near)
        pads._currents[0] /= [electrode_scale[name] for name in ELECTRODES]

    outcomes, _ = told(pads, Person(pads, instead={"palm_heel": press}))
    assert outcomes["palm_heel"].electrodes == order


def test_keys_skip_a_pad_begin_it_again_and_quit(made: Callable[..., Pads]) -> None:
    pads = made("index_proximal", "index_middle", "index_distal")
    person = Person(pads)
    said: list[str] = []

    def key(link: str, *keys: Key) -> Callable[[Near | None], None]:
        left = list(keys)

        def act(near: Near | None) -> None:
            said.append(f"{link} {near}")
            if left:
                person.pending.append(left.pop(0))
            else:
                pads.press(link, near)

        return act

    person.instead = {
        "index_proximal": key("index_proximal", Key.AGAIN),
        "index_middle": key("index_middle", Key.SKIP),
        "index_distal": key("index_distal", Key.QUIT),
    }
    outcomes, _ = told(pads, person)
    assert [outcome.result for outcome in outcomes.values()] == [Result.WELL, Result.SKIPPED, Result.LEFT]
    assert said[:2] == ["index_proximal None", "index_proximal None"]
    assert not outcomes["index_distal"].well


def test_serial_numbers_that_nodes_share_are_not_written(made: Callable[..., Pads]) -> None:
    pads = made("index_proximal", "index_distal")
    for device in pads.devices.values():
        device.write(0x1018, 4, 77, keep=True)
    _, session = told(pads, Person(pads))
    assert {edit.serial for edit in session.ledger.edits().values()} == {None}


@dataclass
class Written:
    """A hand, its file, where the first two channels are told in the wrong order, and somebody at it."""

    pads: Pads
    path: Path
    person: Person

    def run(self, **options: Any) -> int:
        return commission.run(self.path, [self.pads.option], **options)


@pytest.fixture
def written(
    made: Callable[..., Pads],
    tmp_path: Path,
    endpoints: dict[str, str],
    monkeypatch: pytest.MonkeyPatch,
) -> Written:
    pads = made("thumb_proximal", "thumb_middle")
    person = Person(pads)
    monkeypatch.setattr(commission, "open_dialogue", lambda: contextlib.nullcontext(person))
    monkeypatch.setattr(commission, "Bench", lambda file: Stepped(pads, file))
    text = "".join(re.split(r"(?m)^(?=\[\[hand\.pad\]\])", shipped.path("utah_mit.toml").read_text())[:3])
    text = text.replace("[daemon]\n", f'[daemon]\ncontrol = "{endpoints["control"]}"\n')
    pads.devices["thumb_middle"].wired = (1, 0, 2, 3)
    path = tmp_path / "hand.toml"
    path.write_text(text)
    return Written(pads, path, person)


def test_line_ends_stay_as_they_are(written: Written) -> None:
    before = written.path.read_text().replace("\n", "\r\n")
    written.path.write_bytes(before.encode())
    assert written.run() == 0
    after = written.path.read_bytes().decode()
    (new,) = set(after.split("\r\n")) - set(before.split("\r\n"))
    assert new == 'electrodes = ["xa", "x0", "y0", "yb"]'


def test_what_somebody_writes_meanwhile_stays(written: Written) -> None:
    def press_and_write(near: Near | None) -> None:
        if near is None:
            written.path.write_text(written.path.read_text() + "# Mind the third finger.\n")
        written.pads.press("thumb_middle", near)

    written.person.instead = {"thumb_middle": press_and_write}
    assert written.run() == 0
    after = written.path.read_text()
    assert after.endswith("# Mind the third finger.\n")
    assert config.load(written.path).hands[0].pads[1].electrodes == ("xa", "x0", "y0", "yb")


def test_a_file_that_cannot_say_what_was_found_is_left_alone(
    written: Written, capsys: pytest.CaptureFixture[str]
) -> None:
    broken = "a pad too few"

    def press_and_break(near: Near | None) -> None:
        written.path.write_text(broken)
        written.pads.press("thumb_middle", near)

    written.person.instead = {"thumb_middle": press_and_break}
    assert written.run() == 1
    assert "can't be written" in written.person.text
    assert written.path.read_text() == broken
    assert "xa x0 y0 yb" in capsys.readouterr().out  # what was found isn't lost


def test_one_pad_can_be_done_again_when_all_others_are_left(written: Written) -> None:
    assert written.run(links=["thumb_proximal"]) == 0
    assert (written.path.parent / "hand.toml.commissioned").read_text() == "right/thumb_proximal\n"
    assert written.run(links=["right/thumb_proximal"]) == 0
    assert sum("press it anywhere" in line for line in written.person.said) == 2
    assert written.run() == 0
    assert not (written.path.parent / "hand.toml.commissioned").exists()


def test_usage_is_checked_before_a_bus_is_touched(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "hand.toml"
    path.write_text(shipped.path("utah_mit.toml").read_text())
    assert cli.main(["commission", str(tmp_path / "none.toml")]) == 2
    assert cli.main(["commission", str(path), "--link", "toe_*"]) == 2
    assert "--link toe_*" in capsys.readouterr().err
    assert commission.run(path, ["can0=socketcan:none0"]) == 1
    assert "can't be opened" in capsys.readouterr().err
