"""Guided commissioning: prompts for presses on one pad after another, and evaluates them.

Uses no clock, bus, file or terminal: samples carry their times, text goes to a `Dialogue`.

Public name: `CommissioningProcedure`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cache, partial

import numpy as np
from numpy.typing import NDArray

from handtouch import config
from handtouch.canbus.nodes.lifecycle_types import NodeState
from handtouch.canbus.nodes.spec import NodeStatus
from handtouch.config.channels import node_channels
from handtouch.core.least_threshold import begin_samples, least_begin_counts
from handtouch.core.pad_model import PadModel
from handtouch.hand import pad_channels, pad_surface
from handtouch.procedures.commission import press_instructions as words
from handtouch.procedures.commission.deployment_edit import PadEdit
from handtouch.procedures.commission.electrode_order import (
    ElectrodeOrder,
    PressReading,
    ShareGrid,
    find_electrode_order,
)
from handtouch.procedures.commission.node_assignment import NodeAssignment
from handtouch.procedures.commission.outcome import PadOutcome, PadResult, SampleSource
from handtouch.procedures.commission.press import (
    Press,
    PressDetector,
    RestStatistics,
    find_rest_problems,
    find_reversed_channels,
    reacting_channels,
)
from handtouch.procedures.commission.press_instructions import render_channel_bars
from handtouch.procedures.commission.sample_source import HandSample
from handtouch.procedures.dialogue import Dialogue, DialogueCancelled, GuidedProcedure, Key

_NS_PER_S = 1_000_000_000
_BOOT_TIMEOUT_NS = 10 * _NS_PER_S
_MIN_REST_NS, _MIN_REST_SAMPLES = _NS_PER_S, 24
_MAX_ATTEMPTS = 3
_REQUIRED_PRESSES, _EXTRA_PRESSES = ("xa", "yb"), ("x0", "y0", "xa", "yb")
"""Electrodes on sides that are pressed, and those that are pressed while the order is ambiguous."""
_SATURATION_FRACTION = 0.98  # fraction of the range
_NO_ANSWER_TEXT = (
    "no node responded. Likely causes: the node isn't on the bus, or has a node id that the deployment "
    "doesn't list (see `handtouch scan`); the pad isn't connected to its node; the sheet has no supply; or "
    "the press was too light"
)


class _PressFailed(Exception):  # noqa: N818
    """No press in time, or no usable one; `str` gives the reason."""

    def __init__(self, result: PadResult, reason: str) -> None:
        super().__init__(reason)
        self.result = result


class CommissioningProcedure(GuidedProcedure[HandSample]):
    """Commissions the pads `selected_rows` of a deployment; `save` is called after each.

    `assume_yes`: accept swapped nodes without confirmation. `timeout_s`: time limit for a press or a key.
    `outcomes`: one for every pad of the deployment, in its order. `rest_statistics`: of each slot at rest.
    `assignment`: the slot of each pad.
    """

    key_at_timeout = Key.SKIP

    def __init__(
        self,
        deployment: config.Deployment,
        source: SampleSource,
        dialogue: Dialogue,
        save: Callable[[CommissioningProcedure], None],
        selected_rows: Sequence[int],
        *,
        assume_yes: bool = False,
        timeout_s: float = 60.0,
    ) -> None:
        super().__init__(source.samples(), dialogue, timeout_s)
        self.outcomes = [PadOutcome(hand, pad) for hand, pad in deployment.pads]
        self.rest_statistics: list[RestStatistics] = []
        self._deployment = deployment
        self._source, self._save = source, save
        self.selected_rows, self._assume_yes = selected_rows, assume_yes
        self.assignment = NodeAssignment(self.outcomes, lambda: source.nodes)
        kinds = [deployment.nodes[outcome.pad.node] for outcome in self.outcomes]
        self._noise_counts = [kind.noise_counts for kind in kinds]
        channels = {name: node_channels(n) for name, n in deployment.nodes.items()}
        self._channels = [len(outcome.pad.electrode_names) for outcome in self.outcomes]
        self._max_counts = [
            np.array([channel.limits[1] for channel in channels[outcome.pad.node][:count]])
            for outcome, count in zip(self.outcomes, self._channels, strict=True)
        ]
        self._full_scale_per_count = [
            np.array(kind.channel_scale[: len(most)]) / (kind.full_scale_counts or most)
            for kind, most in zip(kinds, self._max_counts, strict=True)
        ]
        self._period_ns = round(1e6 * deployment.daemon.sync_period_ms)
        self._begin_samples = [
            begin_samples(deployment.touch_of(outcome.pad).begin_ms, self._period_ns)
            for outcome in self.outcomes
        ]
        self._model = cache(partial(PadModel, deployment))
        self._detector: PressDetector
        self._share_grid = cache(self._make_share_grid)

    def run(self) -> None:
        """Commission the selected pads; returns early when the user quits."""
        try:
            self._start_nodes()
            self._measure_rest()
            remaining = [
                row for row in self.selected_rows if self.outcomes[row].result is not PadResult.DONE_BEFORE
            ]
            for number, row in enumerate(remaining, 1):
                self._commission_pad(row, f"[{number}/{len(remaining)}] {self.outcomes[row].name}")
        except DialogueCancelled:  # by q; a and s are handled per pad
            self.print_line("Stopped; results so far are kept.")

    def node_of(self, row: int) -> NodeStatus:
        """Return the node that a pad is connected to, as far as known."""
        return self._source.nodes[self.assignment.slot_of(row)]

    def rest_of(self, row: int) -> RestStatistics | None:
        """Return the statistics of that node at rest."""
        return self.rest_statistics[self.assignment.slot_of(row)] if self.rest_statistics else None

    def configured_noise_counts(self, row: int) -> float:
        """Return the configured noise of that node."""
        return self._noise_counts[self.assignment.slot_of(row)]

    def least_begin_threshold_n(self, row: int) -> float | None:
        """Return the least threshold of a pad by the noise of its node at rest, None if that is unknown."""
        rest = self.rest_of(row)
        if rest is None or not rest.level_std > 0:
            return None
        return self._model().centre_force(row, least_begin_counts(rest.level_std, 1e9 / self._period_ns))

    # Before the first press -------------------------------------------------------------------------------

    def _start_nodes(self) -> None:
        self.print_line("Starting the nodes ...")
        for sample, waited_ns in self.timed_samples():
            self._raise_on_quit()
            if sample.fresh.all() or waited_ns > _BOOT_TIMEOUT_NS:
                break
        nodes = self._source.nodes
        for node, fresh in zip(nodes, sample.fresh, strict=True):
            if not fresh:
                state = "no samples" if node.state is NodeState.OPERATIONAL else node.state.name.lower()
                self.print_line(f"  node 0x{node.node_id:02X} of {node.name}: {state}, {node.reason}", "bad")
        self.print_line(f"{int(sample.fresh.sum())} of {len(nodes)} nodes respond.")

    def _measure_rest(self) -> None:
        for attempt in range(_MAX_ATTEMPTS):
            self.print_line("Touch no pad for a second ...", "ask")
            self.rest_statistics = self._collect_rest_samples()
            moved = [
                self.outcomes[slot].name
                for slot, rest in enumerate(self.rest_statistics)
                if rest.was_touched(self._noise_counts[slot])
            ]
            if not moved:
                break
            if attempt + 1 < _MAX_ATTEMPTS:
                self.print_line(f"  {', '.join(moved)} changed; trying again.", "bad")
        baseline = np.zeros((len(self.outcomes), max(self._channels)))
        for row, rest in zip(baseline, self.rest_statistics, strict=True):
            row[: len(rest.mean)] = rest.mean if rest.samples else np.nan
        noise = [
            max(n, 0.5, float(np.median(r.std)))
            for n, r in zip(self._noise_counts, self.rest_statistics, strict=True)
        ]
        self._detector = PressDetector(baseline, np.array(noise))

    def _collect_rest_samples(self) -> list[RestStatistics]:
        samples: list[HandSample] = []
        for sample, waited_ns in self.timed_samples():
            self._raise_on_quit()
            samples.append(sample)
            if waited_ns >= _MIN_REST_NS and len(samples) >= _MIN_REST_SAMPLES:
                break
        counts = np.array([sample.counts for sample in samples], np.float64)
        fresh = np.array([sample.fresh for sample in samples])
        return [
            RestStatistics.from_counts(counts[fresh[:, slot], slot, :channels], begin)
            for slot, (channels, begin) in enumerate(zip(self._channels, self._begin_samples, strict=True))
        ]

    # One pad ----------------------------------------------------------------------------------------------

    def _commission_pad(self, row: int, title: str) -> None:
        outcome = self.outcomes[row]
        while True:
            try:
                slot = self._find_node(row, title)
                presses, order = self._find_electrode_order(row, slot, title)
            except _PressFailed as failed:
                outcome.result, outcome.problems = failed.result, [str(failed)]
                self.print_line(f"  {failed}.", "bad")
                key = self.ask_key("Enter or a: try again, s: skip, q: quit")
            except DialogueCancelled as cancelled:
                key = cancelled.key
            else:
                self._save_outcome(row, slot, presses, order)
                return
            if key is Key.QUIT:
                raise DialogueCancelled(key)
            if key is Key.SKIP:
                if outcome.result is PadResult.NOT_DONE:
                    outcome.result = PadResult.SKIPPED
                return
            outcome.result, outcome.problems = PadResult.NOT_DONE, []

    def _find_node(self, row: int, title: str) -> int:
        """Find the pad's node by a press. Raises _PressFailed and DialogueCancelled."""
        while True:
            press = self._request_press(row, f"{title}: press it anywhere")
            owner = self.assignment.confirmed_owner(press.slot, row)
            if owner is not None:
                self.print_line(
                    f"  the node of {owner} responded, which is already commissioned. Press the right pad; "
                    f"if you did, repeat {owner} later with --link.",
                    "bad",
                )
                self._require_enter("Enter: press again, s: skip, q: quit")
                continue
            if press.slot == self.assignment.slot_of(row):
                return press.slot
            found, needed = self._channels[press.slot], len(self.outcomes[row].pad.electrode_names)
            if found != needed:
                raise _PressFailed(
                    PadResult.AMBIGUOUS,
                    f"a node of {found} channels responded ({self._node_text(press.slot)}), and the pad has "
                    f"{needed} electrodes: another pad was pressed, or the nodes are swapped",
                )
            other = self.outcomes[self.assignment.row_of(press.slot)].name
            self.print_line(
                f"  the node of {other} responded ({self._node_text(press.slot)}): the nodes are swapped, or "
                "another pad was pressed.",
                "bad",
            )
            if not self._assume_yes:
                self._require_enter("Enter: accept as swapped, a: try again, s: skip, q: quit")
            return press.slot

    def _find_electrode_order(
        self, row: int, slot: int, title: str
    ) -> tuple[list[tuple[str, Press]], ElectrodeOrder | None]:
        """Request presses until the order is clear. Raises _PressFailed and DialogueCancelled."""
        presses: list[tuple[str, Press]] = []
        order: ElectrodeOrder | None = None
        requested, more = _requested_presses(self.outcomes[row].pad)
        while requested:
            electrode = requested.pop(0)
            position = self._describe_press(self.outcomes[row].pad, electrode)
            presses.append(
                (
                    electrode,
                    self._request_press(row, f"{title}: press near electrode {electrode}, {position}", slot),
                )
            )
            if requested:
                continue
            working = self._working_channels(slot, presses)
            order = (
                find_electrode_order(self._share_grid(row), self._press_readings(slot, presses, working))
                if working.any()
                else None
            )
            silent = _electrode_of_silent_channel(order, working)
            if silent is not None and silent not in [pressed for pressed, _ in presses]:
                requested = [silent]
            elif (order is None or not order.is_clear) and more:
                requested = [more.pop(0)]
        return presses, order

    def _save_outcome(
        self, row: int, slot: int, presses: list[tuple[str, Press]], order: ElectrodeOrder | None
    ) -> None:
        outcome = self.outcomes[row]
        self.assignment.assign_node(row, slot)
        noise, rest = float(self._detector.noise_counts[slot]), self.rest_statistics[slot]
        problems = find_rest_problems(rest, self._noise_counts[slot]) + find_reversed_channels(
            [press for _, press in presses], noise
        )
        outcome.problems = [str(problem) for problem in problems]
        working, stuck = self._working_channels(slot, presses), rest.stuck_channels(self._noise_counts[slot])
        for channel in np.flatnonzero(~working & ~stuck).tolist():
            wired = f" (electrode {order.electrodes[channel]})" if order and order.is_clear else ""
            problem = f"channel {channel + 1}{wired} doesn't respond: broken wire or dead input"
            outcome.problems.append(problem)
        if order is None or not order.is_clear:
            outcome.result = PadResult.AMBIGUOUS
            outcome.problems.append(
                "the electrode order is ambiguous; press closer to the requested positions, and check "
                "surface and gap_mm of the pad"
            )
        else:
            outcome.electrodes = order.electrodes
        before = PadEdit.from_pad(outcome.pad)
        edit = self.assignment.pad_edit(row)
        if outcome.electrodes is not None:
            outcome.result = PadResult.AS_CONFIGURED if edit == before else PadResult.CHANGED
        for problem in outcome.problems:
            self.print_line(f"  {problem}.", "bad")
        if outcome.electrodes is not None:
            electrodes = ", ".join(outcome.electrodes)
            self.print_line(
                f"  {self._node_text(slot)}, electrodes {electrodes}: {outcome.result.value}.", "good"
            )
        self._save(self)

    # Presses ----------------------------------------------------------------------------------------------

    def _request_press(self, row: int, prompt: str, expected: int | None = None) -> Press:
        """Prompt for presses until one is usable. Raises _PressFailed and DialogueCancelled."""
        self._await_release()
        problem: str | None = None
        for _ in range(_MAX_ATTEMPTS):
            self.print_line(prompt, "ask")
            press = self._await_press(self.assignment.slot_of(row) if expected is None else expected)
            problem = self._press_problem(press, expected)
            if problem is None:
                self.print_line(f"  detected by {self._node_text(press.slot)}; let go.")
                return press
            self.print_line(f"  {problem}; let go, and press again.", "bad")
            self._await_release()
        raise _PressFailed(PadResult.AMBIGUOUS, problem or "")

    def _press_problem(self, press: Press, expected: int | None) -> str | None:
        if press.other_slots:
            names = " and ".join(self.outcomes[slot].name for slot in (press.slot, *press.other_slots))
            return f"the nodes of {names} respond together: press one pad only, or check for crossed wires"
        if expected is not None and press.slot != expected:
            name = self.outcomes[press.slot].name
            return f"this time the node of {name} responded: press the same pad as before"
        reading = press.counts + self._detector.baseline[press.slot, : self._channels[press.slot]]
        if (np.abs(reading) >= _SATURATION_FRACTION * self._max_counts[press.slot]).any():
            return "a channel is saturated: press more lightly"
        return None

    def _await_press(self, slot: int) -> Press:
        name = self.outcomes[slot].name
        for sample, waited_ns in self.timed_samples():
            self.raise_on_key()
            press = self._detector.detect_press(sample.sync_ns, sample.counts, sample.fresh)
            strongest = int(np.argmax(self._detector.level_sigma))
            shown = strongest if strongest in self._detector.pressed_slots else slot
            self._show_bars(sample.sync_ns, shown, name if shown == slot else self.outcomes[shown].name)
            if press is not None:
                return replace(press, counts=press.counts[: self._channels[press.slot]])
            if waited_ns > self._timeout_ns:
                break
        raise _PressFailed(PadResult.NO_ANSWER, _NO_ANSWER_TEXT)

    def _await_release(self) -> None:
        """Wait until nothing is pressed; after the time limit a lasting load becomes the baseline."""
        detector = self._detector
        detector.wait_for_release()
        warned = False
        for sample, waited_ns in self.timed_samples():
            self.raise_on_key()
            detector.detect_press(sample.sync_ns, sample.counts, sample.fresh)
            if detector.ready:
                return
            if detector.pressed_slots:
                self._show_bars(
                    sample.sync_ns, detector.pressed_slots[0], self.outcomes[detector.pressed_slots[0]].name
                )
            if waited_ns > 3 * _NS_PER_S and not warned and detector.pressed_slots:
                names = ", ".join(self.outcomes[slot].name for slot in detector.pressed_slots)
                self.print_line(f"  still pressed: {names}; let go.", "bad")
                warned = True
            if waited_ns > self._timeout_ns:
                detector.reset_baseline()
                return

    def _working_channels(self, slot: int, presses: Sequence[tuple[str, Press]]) -> NDArray[np.bool_]:
        """Return the channels (c,) that respond to presses."""
        noise = float(self._detector.noise_counts[slot])
        stuck = self.rest_statistics[slot].stuck_channels(self._noise_counts[slot])
        return np.asarray(reacting_channels([press for _, press in presses], noise) & ~stuck)

    def _press_readings(
        self, slot: int, presses: Sequence[tuple[str, Press]], working: NDArray[np.bool_]
    ) -> list[PressReading]:
        per_count = self._full_scale_per_count[slot]  # full scale per count
        noise = float(self._detector.noise_counts[slot] * per_count.max())
        return [
            PressReading(electrode, np.abs(press.counts) * per_count, noise, working)
            for electrode, press in presses
        ]

    def _describe_press(self, pad: config.Pad, electrode: str) -> str:
        if not pad.arcs_mm:
            return words.describe_press(pad, electrode)
        network = pad_channels(pad, self._deployment.sheet_of(pad), self._deployment.nodes[pad.node])
        return words.describe_arc_press(pad, network, electrode)

    def _make_share_grid(self, row: int) -> ShareGrid:
        pad = self.outcomes[row].pad
        network = pad_channels(pad, self._deployment.sheet_of(pad), self._deployment.nodes[pad.node])
        return ShareGrid(network, pad_surface(pad), pad.electrode_names)

    def _node_text(self, slot: int) -> str:
        node = self._source.nodes[slot]
        serial = f", serial {node.serial}" if node.serial else ""
        return f"node 0x{node.node_id:02X} on {node.bus}{serial}"

    # Dialogue ---------------------------------------------------------------------------------------------

    def observe(self, sample: HandSample) -> None:
        """Track presses and baselines while a key is awaited."""
        self._detector.detect_press(sample.sync_ns, sample.counts, sample.fresh)

    def _require_enter(self, question: str) -> None:
        """Raise DialogueCancelled for any other key than Enter."""
        key = self.ask_key(question)
        if key is not Key.ENTER:
            raise DialogueCancelled(key)

    def _raise_on_quit(self) -> None:
        if self._dialogue.read_key() is Key.QUIT:
            raise DialogueCancelled(Key.QUIT)

    def _show_bars(self, t_ns: int, slot: int, name: str) -> None:
        self._dialogue.show_live(
            t_ns, lambda: render_channel_bars(slot, name, self._detector, self._channels[slot])
        )


def _requested_presses(pad: config.Pad) -> tuple[list[str], list[str]]:
    """Return the electrodes of a pad near which it is pressed, and those while the order is ambiguous.

    Of electrodes on arcs, two that aren't opposite come first, then the others around the pad.
    """
    if not pad.arcs_mm:
        return list(_REQUIRED_PRESSES), list(_EXTRA_PRESSES)
    names = pad.electrode_names
    first = [names[0], names[-(-len(names) // 3)]]
    others = [name for name in names if name not in first]
    return first, [*others, *first]


def _electrode_of_silent_channel(order: ElectrodeOrder | None, working: NDArray[np.bool_]) -> str | None:
    """Return the electrode to press for the only channel that hasn't responded yet."""
    silent = np.flatnonzero(~working)
    return order.electrodes[silent[0]] if order is not None and len(silent) == 1 else None
