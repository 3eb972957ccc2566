"""Shear pads: accuracy and coverage of the tangential force by world.

The example pad of [shear pads](../shear.md): 14 mm, 12 N/mm, film of 0.15 mm. Every touch is on another drawn
pad of the reporting family: tared, loaded 3 times for 0.1 to 3 s by up to 3 N at normal forces up to 8 N, 2
mm off the centre at most; then one load is scored. The contact above is known with 1 mm and 10 %. *As built*:
stated tolerances of parts only; *calibrated*: by four loads of 2 N, known to 1 %. Errors in newton; by size
of the force: crossed bars.

*Through the daemon's pipeline*: fingers of [shear.toml](../../config/shear.toml), neither tared nor
calibrated, with drawn parts, sheets and mounts, of which only spreads are stated. Touches of 0.2 to 12 N
anywhere on a pad, pulled by up to 0.6 of that, follow each other as in [worlds](worlds.md), 16 of them before
those that are scored. The tangential part is scored along the pad's axes as stated, where it has a
covariance: a vector whose normal force is a lower bound has none. Intervals are of touches; those of a finger
share its pads.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from benchmarks.hand_touches import TouchReadings, draw_touches, estimates
from benchmarks.page import Report, Row, options, progress
from benchmarks.scores import Estimates, EstimateScore, Share, bin_labels, concatenate, slices
from handtouch import wire
from handtouch.config import load, shipped
from handtouch.config.shear import Shear
from handtouch.core.pad_model import PadModel
from handtouch.field.elastic_layer import calibrate_layer
from handtouch.field.shear_estimate import ShearPad
from handtouch.hand import mount_transform
from handtouch.simulate.scenario import Scenario
from handtouch.simulate.shear_pad import LayerHistory, SimulatedShearPad
from handtouch.simulate.truth import GroundTruth
from handtouch.simulate.virtual_hand import VirtualHand
from handtouch.simulate.worlds import WORLDS, DrawnWorld, Family

FloatArray = NDArray[np.float64]

DRIVE_V, FULL_SCALE_A, COUNTS, NOISE_COUNTS = 5.0, 25e-3, 32767, 1.0
BARS = {
    "kind": "crossed_bars",
    "bars": 2,
    "pitch_mm": 3.4,
    "overlap_mm": 0.6,
    "length_mm": 6.0,
    "gap_mm": 0.4,
}
PATTERNS: dict[str, dict[str, Any]] = {
    "crossed bars": BARS,
    "discs": {"kind": "discs", "discs": 9, "radius_mm": 2.0, "gap_mm": 0.4},
}
MAX_NORMAL_N, FRICTION, MAX_FORCE_N = 8.0, 0.8, 3.0
CENTRE_STD_M, NORMAL_STD = 1e-3, 0.1
"""Errors of the contact above: its centre, and its normal force, relative."""
REFERENCE_STD = 0.01
PART_STD = 0.03
CREEP_STD = 0.01
"""Displacement by creep after 2 s, as of references, against that after 0.1 to 3 s."""
REFERENCES_N = 2.0 * np.array([[1.0, -1.0, 0.0, 0.0], [0.0, 0.0, 1.0, -1.0]])
EARLIER_LOADS = 3
PULL, WARM_UP = 0.6, 16
"""Greatest tangential over normal force; touches before those that are scored, until sheets and rest are
known."""


def shear_table(pattern: str) -> Shear:
    """Return the example's pad with a pattern."""
    return Shear(
        pattern=PATTERNS[pattern],  # type: ignore[arg-type]
        film_mm=0.15,
        film_ohm_mm2=9000.0,
        plate_mm=14.0,
        stiffness_n_per_mm=(12.0, 12.0),
    )


class Load(NamedTuple):
    """A load on the pad: tangential and normal force, centre of pressure, time that it lasts."""

    force_n: FloatArray
    normal_n: float
    centre_m: FloatArray
    held_s: float


class Bench:
    """One drawn pad with its node, loads and estimator."""

    def __init__(self, drawn: DrawnWorld, nominal: Shear) -> None:
        self.rng = np.random.default_rng((drawn.seed, 5))
        hidden = drawn.shear("bench/tip")
        self._history = LayerHistory(nominal, hidden)
        self._pad = SimulatedShearPad(nominal, DRIVE_V, hidden)
        gains = drawn.world.parts.gain_ratio.sample(self.rng, 4)
        self._counts_per_a = COUNTS / FULL_SCALE_A * gains[: self._pad.channels]
        self._noise = NOISE_COUNTS * float(drawn.world.electronics.noise_ratio.sample(self.rng, 1)[0])
        self.stated = drawn.world.shear.describe(nominal)
        self._estimator = ShearPad(nominal.build_pattern(), DRIVE_V, nominal.build_film(), PART_STD)
        self._loads: list[Load] = []
        self._moved: list[FloatArray] = []

    def apply(self, load: Load) -> None:
        """Apply a load, which is read at its end, and take it off."""
        for share in np.linspace(0.2, 1.0, 5):
            moved = self._history.advance(share * load.force_n, load.held_s / 5)
        self._loads.append(load)
        self._moved.append(moved)
        for _ in range(3):
            self._history.advance(np.zeros(2), 0.3)

    def estimates(self) -> tuple[FloatArray, FloatArray]:
        """Return displacements (2, n) from the first load, and covariances (n, 2, 2), that are estimated."""
        normal = np.array([load.normal_n for load in self._loads])
        centre = np.array([load.centre_m for load in self._loads]).T
        amperes = self._pad.currents(np.array(self._moved).T, normal, centre)
        counts = amperes * self._counts_per_a[:, None] + self._noise * self.rng.standard_normal(amperes.shape)
        found = self._estimator.estimate(
            np.rint(counts) * FULL_SCALE_A / COUNTS,
            np.hypot(NOISE_COUNTS, 0.3) * FULL_SCALE_A / COUNTS,
            normal_force_n=normal * (1 + NORMAL_STD * self.rng.standard_normal(len(normal))),
            centre_m=centre + CENTRE_STD_M * self.rng.standard_normal(centre.shape),
            centre_std_m=CENTRE_STD_M,
            normal_force_std_n=NORMAL_STD * normal,
        )
        return found.motion[:2] - found.motion[:2, :1], found.covariance[:, :2, :2]

    def random_load(self) -> Load:
        """Draw a load within friction."""
        normal = float(self.rng.uniform(0.5, MAX_NORMAL_N))
        size = float(self.rng.uniform(0, min(FRICTION * normal, MAX_FORCE_N)))
        angle = float(self.rng.uniform(0, 2 * np.pi))
        force = size * np.array([np.cos(angle), np.sin(angle)])
        return Load(force, normal, self.rng.uniform(-2e-3, 2e-3, 2), float(self.rng.uniform(0.1, 3)))


def force_errors(pattern: str, world: str, seed: int) -> list[Estimates]:
    """Return the error of one load on one drawn pad, before and after its calibration."""
    drawn = WORLDS[world].draw(Family.REPORTING.seed(seed))
    bench = Bench(drawn, shear_table(pattern))
    bench.apply(Load(np.zeros(2), 0.0, np.zeros(2), 0.1))  # tare
    factor = 1 + REFERENCE_STD * bench.rng.standard_normal()
    for force in REFERENCES_N.T:
        bench.apply(Load(force * factor, 3.0, np.zeros(2), 2.0))
        bench.apply(Load(np.zeros(2), 0.0, np.zeros(2), 0.1))
    for _ in range(EARLIER_LOADS):
        bench.apply(bench.random_load())
    load = bench.random_load()
    bench.apply(load)
    moved, covariance = bench.estimates()
    stated = bench.stated.build_layer()
    known = calibrate_layer(
        moved[:, 1:9:2],
        REFERENCES_N,
        float(np.hypot(REFERENCE_STD, CREEP_STD)),
        released_m=moved[:, 2:10:2],
    )
    found = []
    for layer in (stated, known):
        peak = np.hypot(*layer.force(moved).vector_n).max()
        estimate = layer.force(moved[:, -1], covariance[-1], peak)
        found.append(
            Estimates(
                (estimate.vector_n - load.force_n)[None],
                estimate.covariance_n2[None],
                np.array([bool(np.isfinite(estimate.vector_n).all())]),
                np.ones(1),
                estimate.covariance_n2[None],
                {"force": bin_labels([np.hypot(*load.force_n)], (0.5, 1.5), "N")},
            )
        )
    return found


def world_rows(touches: int) -> tuple[list[Row], list[Row]]:
    """Scores by pattern and world, and by size of the force."""
    rows, by_force = [], []
    for world in ("default", "harsh"):
        for pattern in PATTERNS:
            pairs = [force_errors(pattern, world, seed) for seed in range(touches)]
            for number, state in enumerate(("as built", "calibrated")):
                every = concatenate([pair[number] for pair in pairs])
                head = {"world": world, "pattern": pattern, "pad": state}
                rows.append(head | EstimateScore.of_estimates(every).row(bounds=False))
                if pattern == "crossed bars":
                    by_force += [
                        {"world": world, "pad": state, "force": label}
                        | EstimateScore.of_estimates(some).row(bounds=False)
                        for label, some in slices(every, "force")
                    ]
            progress(f"{world}, {pattern}")
    return rows, by_force


def tangential_error(
    contact: wire.Contact | None, truth: GroundTruth, rotation: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return error (2,) [N] and covariance (2, 2) along a pad's axes; NaN without a vector."""
    if contact is None or contact.force_vector_n is None or contact.force_vector_covariance_n2 is None:
        return np.full(2, np.nan), np.full((2, 2), np.nan)
    assert truth.force_vector_n is not None
    axes = rotation[:, :2].T
    covariance = np.reshape(contact.force_vector_covariance_n2, (3, 3))
    return axes @ np.subtract(contact.force_vector_n, truth.force_vector_n), axes @ covariance @ axes.T


def served_forces(world: str, number: int, touches: int) -> Estimates:
    """Return errors of tangential forces of a drawn finger's touches, through the daemon's pipeline."""
    drawn = WORLDS[world].draw(Family.REPORTING.seed(number))
    deployment = drawn.describe(load(shipped.path("shear.toml")))
    model, rng = PadModel(deployment), np.random.default_rng((drawn.seed, 7))
    pulled = []
    for touch in draw_touches(model.links, WARM_UP + touches, drawn.seed):
        size = rng.uniform(0.0, PULL) * touch.force_n[0]
        angle = rng.uniform(0.0, 2 * np.pi)
        force = float(size * np.cos(angle)), float(size * np.sin(angle))
        pulled.append(touch.model_copy(update={"tangential_n": (force,)}))
    hand = VirtualHand(deployment, Scenario(touch=tuple(pulled)), drawn)
    readings = TouchReadings.of_hand(hand, deployment, range(WARM_UP, WARM_UP + touches))
    contacts = readings.contacts(model, deployment)
    pads = {entry.pad.link: entry.pad for entry in deployment.pads}
    truths = list(readings.truths.items())
    errors = [
        tangential_error(contacts.get(key), truth, mount_transform(pads[key[1]])[0]) for key, truth in truths
    ]
    forces = np.array([truth.force_n for _, truth in truths])
    found = [contacts[key].force_vector_status if key in contacts else "" for key, _ in truths]
    columns = {
        "pattern": np.array([pads[key[1]].shear for key, _ in truths]),
        "normal force": bin_labels(forces, (1.0, 2.5), "N"),
        "status": np.array(found),
    }
    unknown = np.full(len(truths), np.nan)
    return estimates(errors, unknown, np.full((len(truths), 2, 2), np.nan), columns)


def served_rows(fingers: int, touches: int) -> list[Row]:
    """Scores through the pipeline by world and pattern, and by normal force."""
    rows: list[Row] = []
    for world in ("default", "harsh"):
        every = concatenate([served_forces(world, number, touches) for number in range(fingers)])
        for head in ("pattern", "normal force"):
            for label, some in slices(every, head):
                score = EstimateScore.of_estimates(some).row(bounds=False)
                scored = {"with covariance, %": score.pop("valid, %")}
                statuses = {
                    f"`{status}`, %": Share.of_mask(some.columns["status"] == status)
                    for status in ("valid", "unreliable", "lower_bound", "invalid")
                }
                rows.append({"world": world, "touches of": label, **score, **scored, **statuses})
        progress(f"pipeline, {world}")
    return rows


def main() -> None:
    quick = options(__doc__).parse_args().quick
    touches = 20 if quick else 400  # drawn pads of each row
    report = Report(quick, touches_of_a_row=touches)
    worlds, by_force = world_rows(touches)
    fingers, of_pad = (1, 3) if quick else (8, 16)
    report.table("Through the daemon's pipeline", served_rows(fingers, of_pad))
    report.table("By world and pattern", worlds)
    report.table("By size of the force", by_force)
    report.keep()


if __name__ == "__main__":
    main()
