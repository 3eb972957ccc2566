"""The dialogue with the person who presses: one pad after another, and what was found of each.

No clock, bus, file or terminal: samples come in with their times, words go out by a `Dialogue`.

Public name: `Session`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cache

import numpy as np
from numpy.typing import NDArray

from handtouch import config
from handtouch.canbus.nodes.life import NodeState
from handtouch.canbus.nodes.spec import NodeStatus
from handtouch.canbus.objects.channels import channels_of
from handtouch.dialogue import Dialogue, Key
from handtouch.hand import network_of, surface_of

from . import words
from .bars import bars
from .bench import Sample
from .edit import Edit
from .ledger import Ledger
from .order import Near, Reading, Shares, Verdict, judge
from .outcome import Hand, Outcome, Result
from .press import Press, PressDetector, Rest, judge_rest, polarity, reacted

_SECOND_NS = 1_000_000_000
_BOOT_NS = 10 * _SECOND_NS
_REST_NS, _REST_SAMPLES = _SECOND_NS, 24
_TRIES = 3
_FIRST: tuple[Near, ...] = ("xa", "yb")
_MORE: tuple[Near, ...] = ("x0", "y0", "xa", "yb")  # asked for while the order isn't clear
_RAIL = 0.98  # of the range
_NO_ANSWER = (
    "no node answered. Likely causes: its node isn't on the bus, or has an id that the deployment doesn't "
    "name (`handtouch scan` tells); the pad isn't plugged into its node; its sheet has no supply; or the "
    "press was too light"
)


class _Said(Exception):  # noqa: N818 - no error: a key that ends what is being done
    def __init__(self, key: Key) -> None:
        self.key = key


class _NoPress(Exception):  # noqa: N818
    """There was no press in time, or none that could be used; `str` says why."""

    def __init__(self, result: Result, why: str) -> None:
        super().__init__(why)
        self.result = result


class Session:
    """Commissions the pads of a deployment, `chosen` by their rows; `save` is called after each.

    `yes`: what is found is taken over without asking. `patience_s`: how long to wait for a press or a key.
    `outcomes` has one for every pad of the deployment, in its order, `rests` what its slots show at rest,
    `ledger` which slot is whose.
    """

    def __init__(
        self,
        deployment: config.Deployment,
        hand: Hand,
        dialogue: Dialogue,
        save: Callable[[Session], None],
        chosen: Sequence[int],
        *,
        yes: bool = False,
        patience_s: float = 60.0,
    ) -> None:
        self.outcomes = [Outcome(h.name, pad) for h in deployment.hands for pad in h.pads]
        self.rests: list[Rest] = []
        self._deployment = deployment
        self._hand, self._dialogue, self._save = hand, dialogue, save
        self.chosen, self._yes = chosen, yes
        self._patience_ns = round(patience_s * 1e9)
        self._samples = hand.samples()
        self.ledger = Ledger(self.outcomes, lambda: hand.nodes)
        kinds = [deployment.nodes[outcome.pad.node] for outcome in self.outcomes]
        self._noise = [kind.noise_counts for kind in kinds]
        channels = {name: channels_of(n.channels, n.eds) for name, n in deployment.nodes.items()}
        tops = np.array([[c.limits[1] for c in channels[o.pad.node]] for o in self.outcomes], np.float64)
        full = np.array([[kind.full_scale_counts or 0] * 4 for kind in kinds])
        self._top = tops
        self._per_count = np.array([kind.channel_scale for kind in kinds]) / np.where(full > 0, full, tops)
        self._detector: PressDetector
        self._shares = cache(self._shares_of)

    def run(self) -> None:
        """Go through the pads; returns early when the person quits."""
        try:
            self._bring_up()
            self._rest()
            left = [row for row in self.chosen if self.outcomes[row].result is not Result.BEFORE]
            for number, row in enumerate(left, 1):
                self._commission(row, f"[{number}/{len(left)}] {self.outcomes[row].name}")
        except _Said:  # quit; skip and again were taken care of
            self._say("Left; what was found is kept.")

    def node_of(self, row: int) -> NodeStatus:
        """The node that a pad is connected to, as far as is known."""
        return self._hand.nodes[self.ledger.slot(row)]

    def rest_of(self, row: int) -> Rest | None:
        """What that node showed at rest."""
        return self.rests[self.ledger.slot(row)] if self.rests else None

    def noise_counts(self, row: int) -> float:
        """What the deployment says of that node's noise."""
        return self._noise[self.ledger.slot(row)]

    # Before the first press -------------------------------------------------------------------------------

    def _bring_up(self) -> None:
        self._say("Bringing up the nodes ...")
        first_ns: int | None = None
        for sample in self._samples:
            first_ns = first_ns if first_ns is not None else sample.t_ns
            self._quit_if_asked()
            if sample.alive.all() or sample.t_ns - first_ns > _BOOT_NS:
                break
        nodes = self._hand.nodes
        for node, alive in zip(nodes, sample.alive, strict=True):
            if not alive:
                state = "no samples" if node.state is NodeState.OPERATIONAL else node.state.name.lower()
                self._say(f"  node 0x{node.node_id:02X} of {node.name}: {state}, {node.reason}", "bad")
        self._say(f"{int(sample.alive.sum())} of {len(nodes)} nodes answer.")

    def _rest(self) -> None:
        for attempt in range(_TRIES):
            self._say("Touch nothing for a second ...", "ask")
            self.rests = self._measure()
            moved = [
                self.outcomes[slot].name
                for slot, rest in enumerate(self.rests)
                if rest.touched(self._noise[slot])
            ]
            if not moved:
                break
            if attempt + 1 < _TRIES:
                self._say(f"  {', '.join(moved)} moved; once more.", "bad")
        baseline = [rest.mean if rest.samples else np.full(4, np.nan) for rest in self.rests]
        noise = [max(n, 0.5, float(np.median(r.std))) for n, r in zip(self._noise, self.rests, strict=True)]
        self._detector = PressDetector(np.array(baseline), np.array(noise))

    def _measure(self) -> list[Rest]:
        samples: list[Sample] = []
        for sample in self._samples:
            self._quit_if_asked()
            samples.append(sample)
            if sample.t_ns - samples[0].t_ns >= _REST_NS and len(samples) >= _REST_SAMPLES:
                break
        counts = np.array([sample.counts for sample in samples], np.float64)
        alive = np.array([sample.alive for sample in samples])
        return [Rest.of(counts[alive[:, slot], slot]) for slot in range(len(self.outcomes))]

    # One pad ----------------------------------------------------------------------------------------------

    def _commission(self, row: int, title: str) -> None:
        outcome = self.outcomes[row]
        while True:
            try:
                slot = self._find_node(row, title)
                presses, verdict = self._find_order(row, slot, title)
            except _NoPress as failed:
                outcome.result, outcome.problems = failed.result, [str(failed)]
                self._say(f"  {failed}.", "bad")
                key = self._ask("Enter or a: again, s: skip, q: quit")
            except _Said as said:
                key = said.key
            else:
                self._conclude(row, slot, presses, verdict)
                return
            if key is Key.QUIT:
                raise _Said(key)
            if key is Key.SKIP:
                if outcome.result is Result.LEFT:
                    outcome.result = Result.SKIPPED
                return
            outcome.result, outcome.problems = Result.LEFT, []

    def _find_node(self, row: int, title: str) -> int:
        """Which node answers. Raises _NoPress and _Said."""
        while True:
            press = self._press(row, f"{title}: press it anywhere")
            holder = self.ledger.holder(press.slot, row)
            if holder is not None:
                self._say(
                    f"  the node of {holder} answered, which was found before: was the right pad pressed? "
                    f"If so, do {holder} again later, by --link.",
                    "bad",
                )
                self._go_on("Enter: press again, s: skip, q: quit")
                continue
            if press.slot == self.ledger.slot(row):
                return press.slot
            other = self.outcomes[self.ledger.row(press.slot)].name
            self._say(
                f"  the node of {other} answered ({self._node_text(press.slot)}): the nodes are swapped, or "
                "another pad was pressed.",
                "bad",
            )
            if not self._yes:
                self._go_on("Enter: they are swapped, a: again, s: skip, q: quit")
            return press.slot

    def _find_order(self, row: int, slot: int, title: str) -> tuple[list[tuple[Near, Press]], Verdict | None]:
        """Presses near electrodes until the order is clear, with the verdict. Raises _NoPress and _Said."""
        presses: list[tuple[Near, Press]] = []
        verdict: Verdict | None = None
        asked = list(_FIRST)
        more = list(_MORE)
        while asked:
            near = asked.pop(0)
            where = words.instruction(self.outcomes[row].pad, near)
            presses.append((near, self._press(row, f"{title}: press near electrode {near}, {where}", slot)))
            if asked:
                continue
            live = self._live(slot, presses)
            verdict = judge(self._shares(row), self._readings(slot, presses, live)) if live.any() else None
            silent = _silent_electrode(verdict, live)
            if silent is not None and silent not in [place for place, _ in presses]:
                asked = [silent]
            elif (verdict is None or not verdict.clear) and more:
                asked = [more.pop(0)]
        return presses, verdict

    def _conclude(
        self, row: int, slot: int, presses: list[tuple[Near, Press]], verdict: Verdict | None
    ) -> None:
        outcome = self.outcomes[row]
        self.ledger.take(row, slot)
        noise, rest = float(self._detector.noise[slot]), self.rests[slot]
        findings = judge_rest(rest, self._noise[slot]) + polarity([press for _, press in presses], noise)
        outcome.problems = [str(finding) for finding in findings]
        live, stuck = self._live(slot, presses), rest.stuck(self._noise[slot])
        for channel in np.flatnonzero(~live & ~stuck).tolist():
            wired = f" (electrode {verdict.electrodes[channel]})" if verdict and verdict.clear else ""
            outcome.problems.append(f"channel {channel + 1}{wired} doesn't react: broken wire or dead input")
        if verdict is None or not verdict.clear:
            outcome.result = Result.UNCLEAR
            outcome.problems.append(
                "no order of the electrodes is clearly the right one: were the presses where asked, and do "
                "surface and gap_mm tell the pad's true shape?"
            )
        else:
            outcome.electrodes = verdict.electrodes
        before = Edit.of(outcome.pad)
        edit = self.ledger.edit(row)
        if outcome.electrodes is not None:
            outcome.result = Result.WELL if edit == before else Result.CHANGED
        for problem in outcome.problems:
            self._say(f"  {problem}.", "bad")
        if outcome.electrodes is not None:
            order = ", ".join(outcome.electrodes)
            self._say(f"  {self._node_text(slot)}, electrodes {order}: {outcome.result.value}.", "good")
        self._save(self)

    # Presses ----------------------------------------------------------------------------------------------

    def _press(self, row: int, prompt: str, expected: int | None = None) -> Press:
        """Ask for a press until there is a good one. Raises _NoPress, _Said."""
        self._let_go()
        complaint: str | None = None
        for _ in range(_TRIES):
            self._say(prompt, "ask")
            press = self._await_press(self.ledger.slot(row) if expected is None else expected)
            complaint = self._complaint(press, expected)
            if complaint is None:
                self._say(f"  felt by {self._node_text(press.slot)}; let go.")
                return press
            self._say(f"  {complaint}; let go, and press again.", "bad")
            self._let_go()
        raise _NoPress(Result.UNCLEAR, complaint or "")

    def _complaint(self, press: Press, expected: int | None) -> str | None:
        if press.others:
            names = " and ".join(self.outcomes[slot].name for slot in (press.slot, *press.others))
            return f"the nodes of {names} answer together: press one pad alone, or look for crossed wires"
        if expected is not None and press.slot != expected:
            return f"now the node of {self.outcomes[press.slot].name} answered: press the same pad as before"
        reading = press.counts + self._detector.baseline[press.slot]
        if (np.abs(reading) >= _RAIL * self._top[press.slot]).any():
            return "a channel is at the end of its range: press more gently"
        return None

    def _await_press(self, slot: int) -> Press:
        name = self.outcomes[slot].name
        begun_ns: int | None = None
        for sample in self._samples:
            begun_ns = begun_ns if begun_ns is not None else sample.t_ns
            self._raise_key()
            press = self._detector.feed(sample.t_ns, sample.counts, sample.alive)
            strongest = int(np.argmax(self._detector.level))
            shown = strongest if strongest in self._detector.pressed else slot
            self._show(sample.t_ns, shown, name if shown == slot else self.outcomes[shown].name)
            if press is not None:
                return press
            if sample.t_ns - begun_ns > self._patience_ns:
                break
        raise _NoPress(Result.NO_ANSWER, _NO_ANSWER)

    def _let_go(self) -> None:
        """Wait until nothing is pressed; what stays pressed is taken for rest in the end."""
        detector = self._detector
        detector.again()
        begun_ns: int | None = None
        told = False
        for sample in self._samples:
            begun_ns = begun_ns if begun_ns is not None else sample.t_ns
            self._raise_key()
            detector.feed(sample.t_ns, sample.counts, sample.alive)
            if detector.ready:
                return
            if detector.pressed:
                self._show(sample.t_ns, detector.pressed[0], self.outcomes[detector.pressed[0]].name)
            waited_ns = sample.t_ns - begun_ns
            if waited_ns > 3 * _SECOND_NS and not told and detector.pressed:
                names = ", ".join(self.outcomes[slot].name for slot in detector.pressed)
                self._say(f"  still pressed: {names}; let go.", "bad")
                told = True
            if waited_ns > self._patience_ns:
                detector.rebase()
                return

    def _live(self, slot: int, presses: Sequence[tuple[Near, Press]]) -> NDArray[np.bool_]:
        """Channels (4,) that tell something."""
        noise = float(self._detector.noise[slot])
        stuck = self.rests[slot].stuck(self._noise[slot])
        return np.asarray(reacted([press for _, press in presses], noise) & ~stuck)

    def _readings(
        self, slot: int, presses: Sequence[tuple[Near, Press]], live: NDArray[np.bool_]
    ) -> list[Reading]:
        per_count = self._per_count[slot]  # of full scale
        noise = float(self._detector.noise[slot] * per_count.max())
        return [Reading(near, np.abs(press.counts) * per_count, noise, live) for near, press in presses]

    def _shares_of(self, row: int) -> Shares:
        pad = self.outcomes[row].pad
        return Shares(network_of(pad, self._deployment.sheets[pad.sheet]), surface_of(pad))

    def _node_text(self, slot: int) -> str:
        node = self._hand.nodes[slot]
        serial = f", serial {node.serial}" if node.serial else ""
        return f"node 0x{node.node_id:02X} on {node.bus}{serial}"

    # Words ------------------------------------------------------------------------------------------------

    def _ask(self, question: str) -> Key:
        """Wait for a key; s when nobody can press one, or nobody does."""
        self._say(f"  {question}", "ask")
        begun_ns: int | None = None
        for sample in self._samples:
            begun_ns = begun_ns if begun_ns is not None else sample.t_ns
            self._detector.feed(sample.t_ns, sample.counts, sample.alive)
            key = self._dialogue.key()
            if key is not None:
                return key
            if not self._dialogue.listens or sample.t_ns - begun_ns > self._patience_ns:
                break
        return Key.SKIP

    def _go_on(self, question: str) -> None:
        """Raises _Said for any other answer than Enter."""
        key = self._ask(question)
        if key is not Key.ENTER:
            raise _Said(key)

    def _raise_key(self) -> None:
        key = self._dialogue.key()
        if key is not None and key is not Key.ENTER:
            raise _Said(key)

    def _quit_if_asked(self) -> None:
        if self._dialogue.key() is Key.QUIT:
            raise _Said(Key.QUIT)

    def _show(self, t_ns: int, slot: int, name: str) -> None:
        self._dialogue.show(t_ns, lambda: bars(slot, name, self._detector))

    def _say(self, text: str, style: str = "") -> None:
        self._dialogue.say(text, style)


def _silent_electrode(verdict: Verdict | None, live: NDArray[np.bool_]) -> Near | None:
    """Where to press to hear a channel that hasn't reacted yet."""
    silent = np.flatnonzero(~live)
    return verdict.electrodes[silent[0]] if verdict is not None and len(silent) == 1 else None
