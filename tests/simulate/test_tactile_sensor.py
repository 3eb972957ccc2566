"""TactileSensor: MuJoCo's contacts in, the daemon's output out."""

from __future__ import annotations

from dataclasses import fields, replace
from typing import Any

import mujoco
import numpy as np
import pytest

from handtouch import config, wire
from handtouch.config import shipped
from handtouch.core.pipeline import Pipeline
from handtouch.daemon.table_cache import build_pad_model
from handtouch.simulate import TactileReading, TactileSensor
from handtouch.simulate.sheet_history import SimulatedSheetHistory
from handtouch.simulate.tactile import sensor as tactile_sensor
from handtouch.simulate.tactile.mujoco_contacts import ContactReader
from handtouch.simulate.tactile.simulated_pads import LiveSheets
from handtouch.simulate.worlds import SHEET_KINDS, PartSpread, Uniform, World
from handtouch.wire import ForceStatus, PadState, PositionStatus

HAND = config.load(shipped.path("two_finger.toml"))
MASS_KG, BALL_XY_M = 0.1, (0.005, -0.003)
WEIGHT_N = 9.81 * MASS_KG
SCENE = f"""
<mujoco>
  <option timestep="0.002"/>
  <worldbody>
    <body name="thumb_tip">
      <geom name="plate" type="box" size="0.015 0.012 0.002" pos="0 0 -0.002"/>
    </body>
    <body name="index_tip" pos="0.2 0 0">
      <geom type="sphere" size="0.012" pos="0 0 0.001"/>
    </body>
    <body name="ball" pos="{BALL_XY_M[0]} {BALL_XY_M[1]} 0.0213">
      <joint type="slide" axis="0 0 1" damping="1"/>
      <geom type="sphere" size="0.0213" mass="{MASS_KG}"/>
    </body>
  </worldbody>
</mujoco>
"""  # a contact of the radius that the deployment assumes


@pytest.fixture(scope="module")
def model() -> Any:
    return mujoco.MjModel.from_xml_string(SCENE)


class Run:
    """A simulation with a sensor of one environment."""

    def __init__(self, model: Any, world: str | World = "ideal", **options: Any) -> None:
        self.model, self.data = model, mujoco.MjData(model)
        self.sensor = TactileSensor(HAND, model, world, **options)

    def readings(self, count: int) -> list[TactileReading]:
        return [self.reading() for _ in range(count)]

    def reading(self) -> TactileReading:
        for _ in range(self.sensor.steps):
            mujoco.mj_step(self.model, self.data)
        return self.sensor.read(self.data)


@pytest.fixture(scope="module")
def resting(model: Any) -> list[TactileReading]:
    return Run(model).readings(60)


def test_a_resting_ball_is_sensed_at_its_place_with_its_weight(resting: list[TactileReading]) -> None:
    last = resting[-1]
    assert last.touched.tolist() == [True, False]
    assert last.state.tolist() == [PadState.TOUCHED, PadState.CLEAR]
    assert last.position_status[0] == PositionStatus.VALID
    assert last.force_status[0] == ForceStatus.VALID
    error_m = last.position_m[0] - [*BALL_XY_M, 0.0]
    assert np.all(np.abs(error_m) <= 4 * np.sqrt(np.diag(last.covariance_m2[0])) + 1e-7)
    assert abs(last.force_n[0] - WEIGHT_N) < 3 * last.force_std_n[0]
    assert last.force_std_n[0] < 0.2 * WEIGHT_N
    assert np.isnan(last.force_n[1])


class Sink:
    """Collects hand frames."""

    def __init__(self) -> None:
        self.frames: list[wire.HandFrame] = []

    def has_subscriber(self, topic: str) -> bool:
        return topic.startswith("hand/")

    def send(self, message: wire.OutgoingMessage) -> None:
        decoded = wire.decode(wire.encode(message))
        assert isinstance(decoded, wire.HandFrame)
        self.frames.append(decoded)


def test_readings_are_the_hand_frames_of_the_daemons_pipeline_for_the_same_counts(
    model: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(tactile_sensor, "SETTLING_S", 0.0)  # so that the readings have all samples
    run = Run(model, "default", seed=3)
    run.data.qpos[0] = 0.3  # falls for a quarter of a second
    readings = run.readings(50)
    sink = Sink()
    period_ns = round(run.sensor.period_s * 1e9)
    pipeline = Pipeline(build_pad_model(HAND), period_ns, HAND.daemon.sample_window_fraction, sink)
    pipeline.node_state[:] = PadState.CLEAR
    for reading in readings:
        t_ns = int(reading.sample_ns[0])
        pipeline.begin_cycle(t_ns, t_ns)
        for pad, values in enumerate(reading.counts):
            pipeline.slab.write_pdo(pad, values.astype("<i2").tobytes(), t_ns + 1)
        assert pipeline.tick_if_due(t_ns + pipeline.cycle.window_ns) is not None
    assert not readings[0].touched.any()
    assert readings[-1].touched.any()
    layout = wire.COLUMNS[wire.HandFrame]
    for reading, frame in zip(readings, sink.frames, strict=True):
        for name in (field.name for field in fields(reading) if field.name != "counts"):
            assert getattr(reading, name).astype(layout[name].dtype).tobytes() == getattr(frame, name), name


def test_an_environment_reads_as_if_it_were_alone(model: Any) -> None:
    alone = Run(model, "default", seed=5)
    states = [mujoco.MjData(model) for _ in range(3)]
    states[1].qpos[0] = states[2].qpos[0] = 1.0
    together = TactileSensor(HAND, model, "default", seed=5, environments=3)
    for _ in range(20):
        reading = alone.reading()
        for state in states:
            mujoco.mj_step(model, state, together.steps)
        every = together.read(states)
        first = every.environment(0)
        for field in fields(reading):
            one, other = getattr(reading, field.name), getattr(first, field.name)
            np.testing.assert_array_equal(one, other, field.name)
    assert every.position_m.shape == (3, 2, 3)
    assert every.touched[:, 0].tolist() == [True, False, False]
    assert (every.counts[1] != every.counts[2]).any()  # noise of their own


def test_contacts_are_those_of_the_states_that_are_given(model: Any) -> None:
    """Also of states that were read before without a contact, and of others in their place."""
    reader = ContactReader([entry.pad for entry in HAND.pads], model, {})
    near, far = mujoco.MjData(model), mujoco.MjData(model)
    near.qpos[0], far.qpos[0] = -1e-4, 1.0
    assert not len(reader.read([near, far]).pad)  # before the first step
    for state in (near, far):
        mujoco.mj_step(model, state)
    assert reader.read([near, far]).environment.tolist() == [0]
    assert reader.read([far, near]).environment.tolist() == [1]
    assert reader.read([near]).environment.tolist() == [0]
    near.qpos[0] = 1.0
    mujoco.mj_step(model, near)
    assert not len(reader.read([near]).pad)


def test_copies_of_a_hand_share_their_tables() -> None:
    """256 hands of 15 pads would fill the processor's caches otherwise."""
    hand = HAND.hands[0]
    hands = tuple(hand.model_copy(update={"name": name}) for name in ("a", "b"))
    pads = build_pad_model(HAND.model_copy(update={"hands": hands}))
    own = len(hand.pads)
    for made in (pads.surfaces, pads.stage_tolerances(), pads.stage_tables()):
        assert made[0] is made[own]
        assert made[0] is not made[1]


def test_every_environment_has_the_world_of_its_seed(model: Any) -> None:
    parts = World("gains", PartSpread(gain_ratio=Uniform(0.8, 1.2)))
    states = [mujoco.MjData(model) for _ in range(4)]
    sensor = TactileSensor(HAND, model, parts, seed=(1, 2), environments=4)
    for _ in range(20):
        for state in states:
            mujoco.mj_step(model, state, sensor.steps)
        reading = sensor.read(states)
    spread = np.abs(reading.counts[:, None, 0] - reading.counts[:, 0]).max(axis=2)
    alike, different = spread[[0, 1], [2, 3]], spread[[0, 0], [1, 3]]
    assert alike.max() < 10 < different.min()


def test_a_reset_ends_contacts_at_once(model: Any) -> None:
    states = [mujoco.MjData(model) for _ in range(2)]
    sensor = TactileSensor(HAND, model, "ideal", environments=2)

    def read() -> TactileReading:
        for state in states:
            mujoco.mj_step(model, state, sensor.steps)
        return sensor.read(states)

    before = [read() for _ in range(20)][-1]
    assert before.touched[:, 0].tolist() == [True, True]
    states[1].qpos[0] = 1.0
    sensor.reset([1])
    after = read()
    assert after.touched[:, 0].tolist() == [True, False]
    assert after.contact_id[0, 0] == before.contact_id[0, 0]
    assert after.state[1].tolist() == [PadState.STARTING] * 2
    assert np.isnan(after.force_n[1]).all()
    assert read().state[1].tolist() == [PadState.CLEAR] * 2


def test_a_live_sheet_creeps_as_one_whose_load_is_known_in_advance() -> None:
    kind = SHEET_KINDS["S2"]
    law = replace(kind.varied(*[1.0] * 6), noise_std=0.0, press_std=0.0)
    key, period_s, force_n, begin_s = np.uint64(3), 0.005, 2.0, 1.0
    times_s = begin_s + np.array([0.05, 0.5, 3.0])
    step_s = np.array([begin_s - 0.004, begin_s])  # the load of an interval is that of its end
    none = np.zeros(0)
    history = SimulatedSheetHistory(
        law,
        key,
        lambda t: np.where(t >= begin_s, force_n, 0.0),
        np.zeros_like,
        (step_s, step_s[1:], none),
        np.inf,
    )
    live = LiveSheets(law, np.array([key]), period_s)
    reached = []
    for sample in range(1, 801):
        loaded = np.zeros(1, np.intp) if sample * period_s >= begin_s else np.zeros(0, np.intp)
        apparent = live.apparent_force_n(sample * period_s, loaded, np.full(len(loaded), force_n), 0.0)
        if round(sample * period_s, 6) in times_s.round(6):
            reached.append(float(apparent[0]) / force_n)
    assert reached == pytest.approx(history.force_ratio(times_s).tolist(), rel=0.01)
    assert reached[-1] != pytest.approx(reached[0], rel=0.02)


def test_discs_of_a_line_contact_share_the_sheet() -> None:
    """A bar on the pad presses at both of its ends: its centre is where it is, and it is no point."""
    spec = mujoco.MjSpec.from_string(SCENE)
    ball = spec.body("ball")
    ball.pos[2] = 0.003
    ball.geoms[0].type = mujoco.mjtGeom.mjGEOM_CAPSULE
    ball.geoms[0].size = [0.003, 0.008, 0.0]
    ball.geoms[0].quat = [np.sqrt(0.5), 0.0, np.sqrt(0.5), 0.0]  # along x
    bar = spec.compile()
    last = Run(bar).readings(30)[-1]
    assert last.touched[0]
    assert np.abs(last.position_m[0, :2] - BALL_XY_M).max() < 1e-3
    assert last.residual[0] > 5 * last.residual_std[0]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"bodies": {"thumb_tip": "thumb"}}, 'no body "thumb" for link thumb_tip'),
        ({"world": "perfect"}, 'no world "perfect"; known: ideal'),
        ({"environments": 0}, "environments = 0"),
    ],
)
def test_a_sensor_that_fits_no_model_is_refused(model: Any, options: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        TactileSensor(HAND, model, **options)
