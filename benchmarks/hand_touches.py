"""Single touches all over a hand through the daemon's pipeline: position and force of one sample of each.

Public names: `draw_touches`, `serve`, `sampled`, `TouchReadings`, `compare`, `position_error`, `force_error`,
and the times of a touch `REST_S`, `STEP_S`, `TOUCH_S`, `SAMPLE_S`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.daemon_settings import decoded, lay_out_channels, pipeline_of, write_counts
from benchmarks.oracle import PadOracle
from benchmarks.scores import Estimates, bin_labels
from handtouch import wire
from handtouch.config import Deployment
from handtouch.config.roles import channel_count
from handtouch.core.pad_model import PadModel
from handtouch.simulate.touch import ScenarioTouch
from handtouch.simulate.truth import GroundTruth
from handtouch.simulate.virtual_hand import VirtualHand

FloatArray = NDArray[np.float64]
FORCES_N = (0.2, 12.0)
REST_S, STEP_S, TOUCH_S, SAMPLE_S = 2.0, 0.65, 0.5, 0.32
"""Time before the first touch, from touch to touch of a pad, of a touch, and from its begin to its sample."""
_FIRST_NS = 1_000_000_000
Key = tuple[int, str]
"""Number of a touch, and its link."""
Sampled = tuple[dict[Key, wire.Contact], dict[Key, GroundTruth]]


class Collector:
    """Subscriber to all contacts that keeps those of the sampled ticks, by link."""

    def __init__(self) -> None:
        self.contacts: dict[tuple[int, str], wire.Contact] = {}
        self.sampled: int | None = None

    def has_subscriber(self, topic: str) -> bool:
        return topic.startswith("contact/")

    def send(self, message: wire.OutgoingMessage) -> None:
        if self.sampled is None:
            return
        contact = decoded(message)
        if isinstance(contact, wire.Contact) and contact.event != "end":
            self.contacts[self.sampled, contact.link] = contact


def draw_touches(links: Sequence[str], count: int, seed: int) -> tuple[ScenarioTouch, ...]:
    """Return `count` touches of each pad, one after the other: places uniform, forces log-uniform."""
    rng = np.random.default_rng((seed, 5))
    low, high = np.log(FORCES_N)
    return tuple(
        ScenarioTouch(
            link=link,
            from_s=REST_S + number * STEP_S,
            duration_s=TOUCH_S,
            path=((float(x), float(y)),),
            force_n=(float(np.exp(force)),),
        )
        for number in range(count)
        for link, (x, y), force in zip(
            links, rng.uniform(0.02, 0.98, (len(links), 2)), rng.uniform(low, high, len(links)), strict=True
        )
    )


def serve(
    model: PadModel,
    deployment: Deployment,
    counts: NDArray[np.int64],
    sampled: Mapping[int, int],
    times_s: FloatArray | None = None,
) -> dict[tuple[int, str], wire.Contact]:
    """Return the contacts in the `sampled` ticks by touch number and link; counts (ticks, pads, c).

    Those of a pad's shear pad and its second sheet follow its own. times_s: (ticks,), by default a period
    apart.
    """
    period_ns = round(deployment.daemon.sync_period_ms * 1e6)
    since_ns = period_ns * np.arange(len(counts)) if times_s is None else np.round(1e9 * times_s)
    stamps_ns = _FIRST_NS + since_ns.astype(np.int64)
    collector = Collector()
    pipeline = pipeline_of(deployment, collector, model=model)
    lay_out_channels(pipeline, deployment)
    channels = [channel_count(entry.pad) for entry in deployment.pads]
    for tick, rows in enumerate(counts):
        t_ns = int(stamps_ns[tick])
        collector.sampled = sampled.get(tick)
        pipeline.begin_cycle(t_ns, t_ns)
        for pad, row in enumerate(rows):
            write_counts(pipeline, pad, row[: channels[pad]], t_ns + 1)
        pipeline.tick_if_due(t_ns + period_ns)
        pipeline.prepare_next_tick()
    return collector.contacts


def sampled(hand: VirtualHand, model: PadModel, deployment: Deployment, numbers: range) -> Sampled:
    """Serve all touches up to the last of these numbers, `STEP_S` apart; return contacts and truths."""
    readings = TouchReadings.of_hand(hand, deployment, numbers)
    return readings.contacts(model, deployment), readings.truths


@dataclass(frozen=True)
class TouchReadings:
    """Counts (ticks, pads, c) of touches, c of the pad with most electrodes, and truths of their samples.

    `sampled`: touch number by tick. `times_s`: (ticks,).
    """

    counts: NDArray[np.int64]
    sampled: Mapping[int, int]
    truths: dict[Key, GroundTruth]
    times_s: FloatArray

    @classmethod
    def of_hand(cls, hand: VirtualHand, deployment: Deployment, numbers: range) -> TouchReadings:
        """Return all touches up to the last of these numbers, `STEP_S` apart; these numbers are sampled."""
        period_s = deployment.daemon.sync_period_ms * 1e-3
        ticks = round((REST_S + numbers.stop * STEP_S) / period_s)
        times_s = np.asarray(period_s * np.arange(ticks), np.float64)
        at = {round((REST_S + k * STEP_S + SAMPLE_S) / period_s): k for k in numbers}
        return cls.at_times(hand, times_s, at)

    @classmethod
    def at_times(cls, hand: VirtualHand, times_s: FloatArray, sampled: Mapping[int, int]) -> TouchReadings:
        """Return what a hand reads at these times (ticks,); sampled: touch number by tick."""
        pads = hand.pads
        made = [hand.all_counts(row, times_s) for row in range(len(pads))]
        counts = np.zeros((len(times_s), len(pads), max(own.shape[1] for own in made)), np.int64)
        for row, own in enumerate(made):
            counts[:, row, : own.shape[1]] = own
        truths = {
            (k, truth.link): truth
            for tick, k in sampled.items()
            for truth in reversed(hand.truth(float(times_s[tick])))  # the first touch of those at once
        }
        return cls(counts, sampled, truths, times_s)

    def contacts(self, model: PadModel, deployment: Deployment) -> dict[Key, wire.Contact]:
        """Return the contacts at the samples, through the daemon's pipeline."""
        return serve(model, deployment, self.counts, self.sampled, self.times_s)


def compare(
    found: Sequence[tuple[wire.Contact | None, GroundTruth]], oracle: PadOracle, labels: Mapping[str, str]
) -> tuple[Estimates, Estimates]:
    """Return position and force of one pad's touches; a touch without a contact isn't valid."""
    u, v, true_n = np.array([(truth.u_m, truth.v_m, truth.force_n) for _, truth in found]).T
    stated = oracle.covariances(u, v, true_n)
    columns = {name: np.full(len(found), label) for name, label in labels.items()}
    columns |= {
        "surface": np.full(len(found), oracle.surface_name),
        "aspect": bin_labels(np.full(len(found), oracle.aspect), (1.3, 1.8)),
        "force": bin_labels(true_n, (0.5, 2.0, 5.0), "N"),
        "edge distance": bin_labels(100 * oracle.edge_distance(u, v), (5.0, 15.0), "%"),
    }
    bound_m = np.array([truth.bound_m for _, truth in found])
    return (
        estimates([position_error(*pair) for pair in found], bound_m, stated.position_m2, columns),
        estimates([force_error(*pair) for pair in found], stated.force_bound_n, stated.force_n2, columns),
    )


def estimates(
    found: Sequence[tuple[FloatArray, FloatArray]],
    bound: FloatArray,
    oracle_covariance: FloatArray,
    columns: Mapping[str, NDArray[Any]],
) -> Estimates:
    """Return a table of errors with covariances; valid are those that aren't NaN."""
    error, covariance = (np.array(values) for values in zip(*found, strict=True))
    return Estimates(error, covariance, ~np.isnan(error[:, 0]), bound, oracle_covariance, columns)


def position_error(contact: wire.Contact | None, truth: GroundTruth) -> tuple[FloatArray, FloatArray]:
    """Return error (2,) [m] and covariance (2, 2) along the surface; NaN without a valid position."""
    if not contact or not contact.position_m or not contact.normal or not contact.covariance_m2:
        return np.full(2, np.nan), np.full((2, 2), np.nan)
    if contact.position_status != "valid":
        return np.full(2, np.nan), np.full((2, 2), np.nan)
    across = tangent_basis(np.array(contact.normal))
    on_pad = np.subtract(contact.covariance_m2, contact.mount_covariance_m2 or 0.0)  # mounts are as stated
    covariance = across @ on_pad.reshape(3, 3) @ across.T
    return across @ np.subtract(contact.position_m, truth.position_m), covariance


def force_error(contact: wire.Contact | None, truth: GroundTruth) -> tuple[FloatArray, FloatArray]:
    """Return error (1,) [N] and variance (1, 1) of the force; NaN without a valid force."""
    if not contact or contact.force_n is None or contact.force_std_n is None:
        return np.full(1, np.nan), np.full((1, 1), np.nan)
    if contact.force_status != "valid":
        return np.full(1, np.nan), np.full((1, 1), np.nan)
    return np.array([contact.force_n - truth.force_n]), np.array([[contact.force_std_n**2]])


def tangent_basis(normal: FloatArray) -> FloatArray:
    """Return two orthonormal rows (2, 3) at right angles to a unit vector."""
    along = np.cross(normal, np.eye(3)[np.argmin(np.abs(normal))])
    along /= np.linalg.norm(along)
    return np.stack([along, np.cross(normal, along)])
