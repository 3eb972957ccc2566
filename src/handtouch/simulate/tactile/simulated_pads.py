"""Counts of the pads of equal hands in several environments, from contact points on their links.

Public names: `SimulatedPads`; `LiveSheets`, sheets under loads that aren't known in advance.
"""

from __future__ import annotations

import copy
import itertools
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from handtouch import config
from handtouch.arrays import FloatArray, IntArray
from handtouch.simulate.contact_patch import ContactPatch
from handtouch.simulate.contact_patch import discs as evenly_pressed
from handtouch.simulate.grasp.mujoco_scene import MujocoPad
from handtouch.simulate.grasp.patches import pad_discs, project_points
from handtouch.simulate.sheet_history import random_factor
from handtouch.simulate.sheet_physics import SheetLaw, SheetStates
from handtouch.simulate.stimulus import AppliedContact, EventlessStimulus
from handtouch.simulate.tactile.mujoco_contacts import LinkPoints
from handtouch.simulate.virtual_hand import VirtualHand
from handtouch.simulate.worlds import DrawnWorld


class LiveSheets:
    """Sheets of one law, sampled with a constant period. In a period that ends or begins with a load a sheet
    has the load of its end; otherwise it has none.

    `keys` (n,): random streams of the sheets.
    """

    def __init__(self, law: SheetLaw, keys: NDArray[np.uint64], period_s: float) -> None:
        self._law, self._keys, self._period_s = law, keys, period_s
        self._states = SheetStates(law, len(keys))
        self._times_s = np.zeros(len(keys))
        self._presses = np.zeros(len(keys), np.int64)
        self._loaded = np.zeros(0, np.intp)

    def reset(self, sheet: int) -> None:
        """Replace a sheet by one that was never pressed."""
        self._states.reset(sheet)
        self._loaded = self._loaded[self._loaded != sheet]

    @property
    def are_loaded(self) -> bool:
        """True if any had a load at the last sample."""
        return len(self._loaded) > 0

    def apparent_force_n(
        self, t_s: float, sheets: IntArray, force_n: FloatArray, warmer_k: float
    ) -> FloatArray:
        """Return the apparent forces (k,) [N] of the sheets (k,), in order, that have a load at a sample,
        (k,) [N].

        `warmer_k`: temperature above that at the start.
        """
        if np.array_equal(sheets, self._loaded):
            began = released = sheets[:0]
        else:
            began = np.setdiff1d(sheets, self._loaded, assume_unique=True)
            released = np.setdiff1d(self._loaded, sheets, assume_unique=True)
        idle = began[t_s - self._period_s - self._times_s[began] > 0]
        idle_s = t_s - self._period_s - self._times_s[idle]
        self._states.advance(idle, idle_s, 0.0, warmer_k=warmer_k)
        self._times_s[idle] += idle_s
        changing, load_n = np.concatenate([sheets, released]), np.zeros(len(sheets) + len(released))
        load_n[: len(sheets)] = force_n
        apparent_n = self._states.advance(changing, t_s - self._times_s[changing], load_n, warmer_k=warmer_k)
        self._times_s[changing], self._loaded = t_s, sheets
        self._presses[began] += 1
        apparent_n = apparent_n[: len(sheets)]
        times_s = np.full(len(sheets), t_s)
        return apparent_n * random_factor(
            self._law, self._keys[sheets], times_s, apparent_n, self._presses[sheets]
        )


class SimulatedPads:
    """Pads of a deployment in a world, on `count` equal hands that differ in noise and history.

    Times are seconds since the start and increase from one sample to the next, by `period_s`.
    """

    def __init__(self, deployment: config.Deployment, world: DrawnWorld, count: int, period_s: float) -> None:
        self._count = count
        self._hand = VirtualHand(deployment, _NoStimulus(), world)
        self._pads = [
            MujocoPad(entry.pad.link, -1, row.rotation, row.translation, row.shape)
            for entry, row in zip(deployment.pads, self._hand.virtual_pads, strict=True)
        ]
        streams = np.arange(count, dtype=np.uint64) * np.uint64(2)
        self._sheets = [
            LiveSheets(row.sheet_law, row.noise_keys[0] + np.uint64(7) + streams, period_s)
            if row.sheet_law
            else None
            for row in self._hand.virtual_pads
        ]
        self._fresh_sheets = copy.deepcopy(self._sheets)

    def reset(self, hand: int) -> None:
        """Give a hand fresh sheets."""
        for sheets in self._sheets:
            if sheets:
                sheets.reset(hand)

    def restart(self) -> None:
        """Go back to the start: all sheets are fresh, and times begin again."""
        self._sheets = copy.deepcopy(self._fresh_sheets)

    def save_state(self) -> list[LiveSheets | None]:
        """Return the state of all sheets."""
        return copy.deepcopy(self._sheets)

    def load_state(self, state: list[LiveSheets | None]) -> None:
        """Continue with the state of an equal hand."""
        self._sheets = copy.deepcopy(state)

    def sample(self, t_s: float, contacts: LinkPoints) -> NDArray[np.int64]:
        """Return counts (hands, pads, 4) of the electrodes x0, xa, y0, yb; `contacts` at the sample's time,
        whose environments are the hands."""
        counts = self._hand.untouched_counts(t_s, self._count)
        hand, pad, currents = self._currents(t_s, self._discs(contacts))
        if len(hand):
            counts[hand, pad] += currents * self._hand.counts_per_ampere(t_s)[pad]
        return self._hand.quantise(counts)

    def _discs(self, contacts: LinkPoints) -> _Discs:
        """Return the discs that contact points make on the pads."""
        found = [
            (np.full(len(hand), pad), hand, *rest)
            for pad in np.unique(contacts.pad).tolist()
            for hand, *rest in [self._discs_on_pad(pad, contacts)]
        ]
        if not found:
            none = np.zeros(0, np.intp)
            return _Discs(none, none, np.zeros((0, 2)), np.zeros(0), np.zeros(0))
        return _Discs(*(np.concatenate(column) for column in zip(*found, strict=True)))

    def _discs_on_pad(
        self, row: int, contacts: LinkPoints
    ) -> tuple[IntArray, FloatArray, FloatArray, FloatArray]:
        pad, rows = self._pads[row], np.flatnonzero(contacts.pad == row)
        on, *points = project_points(
            pad, contacts.point_m[rows], contacts.force_n[rows], contacts.curvature[rows]
        )
        hands = contacts.environment[rows[on]]
        order = np.argsort(hands, kind="stable")
        return pad_discs(pad, hands[order], *(column[order] for column in points))

    def _currents(self, t_s: float, discs: _Discs) -> tuple[IntArray, IntArray, FloatArray]:
        """Return hands, pads (k,) and currents (k, 4) [A], at the nominal voltage, of the touched pads."""
        force_n = discs.force_n * self._force_ratio(t_s, discs)
        key = discs.key  # they are in order
        alone = np.ones(len(key), np.bool_)
        alone[1:] = other = key[1:] != key[:-1]
        alone[:-1] &= other
        patch = evenly_pressed(discs.radius_m[alone])
        hands, pads = [discs.hand[alone]], [discs.pad[alone]]
        position = discs.position[alone].T
        found = [self._hand.solve_contacts(pads[0], position, patch, force_n[alone])]
        for pad in np.unique(discs.pad[~alone]).tolist():
            rows = np.flatnonzero(~alone & (discs.pad == pad))
            touched, stimulus = _several_discs(discs, force_n, rows)
            circuit = self._hand.virtual_pads[pad].circuit
            none = np.ones(len(touched))
            found.append(circuit.currents(np.arange(len(touched), dtype=np.float64), stimulus, (), none))
            hands.append(touched)
            pads.append(np.full(len(touched), pad))
        return np.concatenate(hands), np.concatenate(pads), np.concatenate(found)

    def _force_ratio(self, t_s: float, discs: _Discs) -> FloatArray:
        """Return apparent over true force of the discs (k,), and let the sheets' histories go on."""
        warmer_k, ratio = self._hand.temperature_rise_k(t_s), np.ones(len(discs.pad))
        ends = np.searchsorted(discs.pad, np.arange(len(self._sheets) + 1))  # discs are in order of pads
        for sheets, (first, end) in zip(self._sheets, itertools.pairwise(ends.tolist()), strict=True):
            if sheets and (end > first or sheets.are_loaded):
                hand, force_n = discs.hand[first:end], discs.force_n[first:end]
                begins = np.flatnonzero(np.diff(hand, prepend=-1))  # and on each pad in order of hands
                total_n = np.add.reduceat(force_n, begins) if end > first else force_n
                apparent_n = sheets.apparent_force_n(t_s, hand[begins], total_n, warmer_k)
                ratio[first:end] = np.repeat(apparent_n / total_n, np.diff(begins, append=end - first))
        return ratio


@dataclass(frozen=True)
class _Discs:
    """Discs (k,) on the pads of all hands."""

    pad: IntArray
    hand: IntArray
    position: FloatArray
    """(k, 2), fractions of the pad."""
    force_n: FloatArray
    radius_m: FloatArray

    @property
    def key(self) -> IntArray:
        """Number (k,) of hand and pad."""
        return np.asarray(self.hand << 16 | self.pad)


def _several_discs(discs: _Discs, force_n: FloatArray, rows: IntArray) -> tuple[IntArray, _Snapshots]:
    """Return the hands (n,) with several discs on a pad, and these as contacts at the times 0 to n - 1."""
    hands, column, number = np.unique(discs.hand[rows], return_inverse=True, return_counts=True)
    order = np.argsort(column, kind="stable")
    lane = np.empty(len(rows), np.intp)
    lane[order] = np.arange(len(rows)) - np.repeat(np.cumsum(number) - number, number)
    shape = int(number.max()), len(hands)
    position, force, radius = np.full((shape[0], 2, shape[1]), 0.5), np.zeros(shape), np.full(shape, 1e-3)
    position[lane, :, column] = discs.position[rows]
    force[lane, column], radius[lane, column] = force_n[rows], discs.radius_m[rows]
    return hands, _Snapshots(position, force, evenly_pressed(radius))


@dataclass(frozen=True)
class _Snapshots:
    """Contacts on a pad, a `PadStimulus` at whole times: those of hands, one after the other."""

    position: FloatArray
    force_n: FloatArray
    patches: FloatArray

    @property
    def max_contacts(self) -> int:
        return len(self.force_n)

    @property
    def event_times_s(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        return np.zeros(0), np.zeros(0), np.zeros(0)

    def contacts(self, times_s: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        at = times_s.astype(np.intp)
        return self.position[:, :, at], self.force_n[:, at], self.patches[:, :, at]

    def tangential_n(self, times_s: FloatArray) -> FloatArray:
        return np.zeros((2, len(times_s)))


class _NoStimulus(EventlessStimulus):
    """A stimulus without contacts: those of a running simulation are given to each sample."""

    touch_links: Sequence[str] = ()

    def contacts_at(self, t_s: float) -> list[AppliedContact]:  # noqa: ARG002
        return []

    def pad_stimulus(self, link: str, patch: Callable[[int], ContactPatch]) -> _Snapshots:  # noqa: ARG002
        return _Snapshots(np.zeros((0, 2, 0)), np.zeros((0, 0)), evenly_pressed(np.zeros((0, 0))))

    def joint_trajectory(self, robot: object) -> None:
        """Return None: the simulation has the joints."""

    def check_links(self, links: Iterable[str], file: str = "") -> None:
        """Accept any links."""
