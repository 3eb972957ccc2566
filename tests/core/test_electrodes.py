"""Pads with electrodes on arcs of their outline, beside one with four sides."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from handtouch import wire
from handtouch.client.subscriber import columns
from handtouch.config import ConfigError, parse
from handtouch.core.events import decode_calibration, encode_calibration
from handtouch.core.pad_model import PadModel
from handtouch.core.pipeline import Pipeline
from handtouch.core.slab import ChannelField, Slab
from handtouch.core.stages.rows import VALUE_COUNT, VALUE_SLICES
from handtouch.core.stages.solve import ContactSolver
from handtouch.core.state import TickState
from handtouch.daemon.table_cache import build_pad_model
from handtouch.field.contact_law import ContactLaw
from handtouch.field.outline_network import BoundaryElectrode, OutlineNetwork
from handtouch.field.outline_surface import OutlineSurface
from handtouch.hand import pad_network, pad_surface
from tests.deployments import SIX_ARCS, THREE_ARCS, arcs_text
from tests.exact_pads import electrodes_of


@pytest.fixture(scope="module")
def model() -> PadModel:
    return build_pad_model(parse(arcs_text()))


def test_fractions_of_arcs_are_those_of_the_outline_itself() -> None:
    pad = parse(arcs_text()).pads[1].pad
    surface = pad_surface(pad)
    assert isinstance(surface, OutlineSurface)
    network = pad_network(pad, parse(arcs_text()).sheets[pad.sheet])
    ends = [(1e-3 * begin, 1e-3 * end) for begin, end in pad.arcs_mm]
    expected = OutlineNetwork(
        surface.outline.at_origin(), [BoundaryElectrode(begin, end) for begin, end in ends], 1.0
    )
    x, y = np.random.default_rng(1).uniform(0.05, 0.95, (2, 50)) * [[network.a], [network.b]]
    np.testing.assert_allclose(
        network.fractions(x, y), expected.fractions(*surface.from_rectangle(x, y)), atol=1e-7
    )


def test_three_currents_locate_a_contact_beside_a_pad_of_four(model: PadModel) -> None:
    assert model.channels == 4
    at = np.array([[0.3, 0.4], [0.62, 0.55]])
    currents = np.zeros((2, 4))
    for row, (network, place) in enumerate(zip(model.networks, at, strict=True)):
        fractions = network.fractions(place[0] * network.a, place[1] * network.b)
        currents[row, : len(fractions)] = 2e-3 * fractions
    values = np.full((2, VALUE_COUNT), np.nan)
    ContactSolver(model, currents, np.zeros(2), np.ones(2, np.bool_), values).solve_contacts(
        np.arange(2).data
    )
    sides = np.array([(network.a, network.b) for network in model.networks])
    np.testing.assert_allclose(values[:, VALUE_SLICES["xy"]] / sides, at, atol=1e-4)
    assert np.isfinite(values[:, VALUE_SLICES["force_n"]]).all()
    assert np.isnan(values[:, VALUE_SLICES["residual"]]).ravel().tolist() == [False, True]


def test_channels_that_a_pad_lacks_read_zero_and_are_at_no_limit() -> None:
    slab = Slab(2, 6)
    slab.set_layout(1, tuple(ChannelField(k // 4, 16 * (k % 4), 16, True) for k in range(6)))
    slab.write_pdo(0, np.arange(1, 5).astype("<i2").tobytes(), 10)
    slab.write_pdo(1, np.arange(1, 5).astype("<i2").tobytes(), 10)
    assert not slab.fresh[1]  # its second PDO is missing
    slab.write_pdo(1, np.array([5, 6, 0, 0]).astype("<i2").tobytes(), 11, 1)
    assert slab.unpack_counts().tolist() == [[1, 2, 3, 4, 0, 0], [1, 2, 3, 4, 5, 6]]
    assert not slab.saturated(slab.unpack_counts()).any()


def test_a_state_names_its_number_of_channels_unless_it_is_four() -> None:
    assert "channels" not in TickState.empty(2).layout()
    assert TickState.empty(2, channels=6).layout().endswith(", 6 channels")


@pytest.mark.parametrize(
    ("arcs", "message"),
    [
        ({"a": (0.0, 10.0), "b": (20.0, 30.0)}, "channels"),
        ({**THREE_ARCS, "left": (5.0, 27.5)}, "end and left touch or overlap"),
        (
            {"end": THREE_ARCS["end"], "right": THREE_ARCS["right"], "left": THREE_ARCS["left"]},
            "left must follow right",
        ),
        ({**THREE_ARCS, "right": (28.9812, 200.0)}, "edge is 56.549 mm long"),
    ],
)
def test_impossible_arcs_are_refused(arcs: dict[str, tuple[float, float]], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        parse(arcs_text(arcs))


def solved(model: PadModel, fractions: NDArray[np.float64], total_a: float) -> NDArray[np.float64]:
    """Return the contact values of the disc with these currents."""
    currents, values = np.zeros((2, model.channels)), np.full((2, VALUE_COUNT), np.nan)
    currents[1, : len(fractions)] = total_a * fractions
    solver = ContactSolver(model, currents, np.zeros(2), np.ones(2, np.bool_), values)
    solver.solve_contacts(np.array([1]).data)
    return np.asarray(values[1])


def test_contacts_are_located_without_a_dead_electrode() -> None:
    deployment = parse(arcs_text(SIX_ARCS))
    model = build_pad_model(deployment)
    network, sheet, whole = electrodes_of(model)[1], deployment.sheets["s"], model.calibrations[1]
    at = np.array([0.35, 0.62]) * (network.a, network.b)
    floating = network.with_series_ohm([math.inf if k == 2 else 0.0 for k in range(6)])
    fractions = floating.fractions(*at)
    assert fractions[2] == 0
    law = ContactLaw(sheet.contact_ohm_mm2 * 1e-6, sheet.alpha, sheet.contact_radius_mm * 1e-3, 0.0)
    scale_m = pad_surface(deployment.pads[1].pad).scale(*at)
    drive_v = deployment.nodes["arcs"].drive_v
    whole_a, total_a = (
        float(
            law.current(
                1.5,
                drive_v,
                sheet.ohm_per_square,
                pad.spreading_radius(*at) * scale_m,
                pad.series_resistance(*at),
            )
        )
        for pad in (network, floating)
    )
    assert total_a < 0.98 * whole_a

    before = solved(model, network.fractions(*at), whole_a)
    model.set_calibration(1, replace(whole, dead_electrode=2))
    found = solved(model, fractions, total_a)
    np.testing.assert_allclose(found[VALUE_SLICES["xy"]], at, atol=1e-4 * network.a)
    assert found[VALUE_SLICES["force_n"]] == pytest.approx(before[VALUE_SLICES["force_n"]], rel=1e-3)
    assert found[VALUE_SLICES["squared_misfit"]] < 1e-3
    trace = [values[VALUE_SLICES["covariance_m2"]][::4].sum() for values in (before, found)]
    assert trace[1] > trace[0]
    noisy = fractions.copy()
    noisy[2] = 0.3  # whatever an open channel reads
    np.testing.assert_allclose(solved(model, noisy, total_a)[VALUE_SLICES["xy"]], at, atol=1e-4 * network.a)

    model.set_calibration(1, whole)
    np.testing.assert_array_equal(solved(model, network.fractions(*at), whole_a), before)


class RawMessages:
    """Keeps the raw messages, as a client decodes them."""

    def __init__(self) -> None:
        self.received: list[wire.Raw] = []

    def has_subscriber(self, topic: str) -> bool:
        return topic.startswith("raw/")

    def send(self, message: wire.OutgoingMessage) -> None:
        decoded = wire.decode(wire.encode(message))
        assert isinstance(decoded, wire.Raw)
        self.received.append(decoded)


@pytest.mark.parametrize("arcs", [THREE_ARCS, SIX_ARCS], ids=["three", "six"])
def test_raw_counts_have_as_many_columns_as_the_pad_with_most_electrodes(
    arcs: dict[str, tuple[float, float]],
) -> None:
    sink, now_ns = RawMessages(), 10**9
    pipeline = Pipeline(build_pad_model(parse(arcs_text(arcs))), 5_000_000, 0.6, sink)
    pipeline.begin_cycle(now_ns, now_ns)
    for pad, count in enumerate((4, len(arcs))):
        pipeline.slab.set_layout(
            pad, tuple(ChannelField(k // 4, 16 * (k % 4), 16, True) for k in range(count))
        )
        read = np.where(np.arange(8) < count, np.arange(1, 9), 0).astype("<i2")
        for number in range(-(-count // 4)):
            pipeline.slab.write_pdo(pad, read[4 * number : 4 * number + 4].tobytes(), now_ns + 10, number)
    pipeline.finish_cycle(now_ns + 5_000_000, now_ns + 5_000_000)
    (raw,) = sink.received
    expected = [[1, 2, 3, 4, 0, 0], [1, 2, 3, 4, 5, 6]] if len(arcs) == 6 else [[1, 2, 3, 4], [1, 2, 3, 0]]
    assert columns(raw)["counts"].tolist() == expected


def test_a_loaded_state_continues_without_its_dead_electrode() -> None:
    deployment = parse(arcs_text(SIX_ARCS))
    network = electrodes_of(build_pad_model(deployment))[1]
    floating = network.with_series_ohm([math.inf if k == 2 else 0.0 for k in range(6)])
    counts = np.rint(8000 * floating.fractions(0.4 * network.a, 0.6 * network.b)).astype("<i2")

    def pressed(pipeline: Pipeline, cycles: range) -> NDArray[np.float64]:
        for cycle in cycles:
            sync_ns = 10**9 + cycle * 5_000_000
            pipeline.begin_cycle(sync_ns, sync_ns)
            for number, part in enumerate((counts[:4], np.append(counts[4:], [0, 0]).astype("<i2"))):
                pipeline.slab.write_pdo(1, part.tobytes(), sync_ns + 10, number)
            pipeline.finish_cycle(sync_ns + 5_000_000, sync_ns + 5_000_000)
        return np.array(pipeline.tick.columns.values[1])

    def started() -> Pipeline:
        made = Pipeline(build_pad_model(deployment), 5_000_000, 0.6, RawMessages())
        made.node_state[:] = wire.PadState.CLEAR
        made.slab.set_layout(1, tuple(ChannelField(k // 4, 16 * (k % 4), 16, True) for k in range(6)))
        return made

    first, second = started(), started()
    first.set_calibration(1, replace(first.calibrations[1], dead_electrode=2))
    values = pressed(first, range(5))
    place = values[VALUE_SLICES["xy"]] / (network.a, network.b)
    np.testing.assert_allclose(place, [0.4, 0.6], atol=2e-3)
    recorded = [decode_calibration(encode_calibration(one)) for one in first.calibrations]
    second.load_state(first.save_state(), first.state.layout(), recorded)
    # a pipeline skips its first cycle, which has been processed: both solve as many samples
    np.testing.assert_array_equal(pressed(second, range(4, 7)), pressed(first, range(5, 7)))
