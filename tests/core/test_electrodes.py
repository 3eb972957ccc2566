"""Pads with electrodes on arcs of their outline, beside one with four sides."""

from __future__ import annotations

import numpy as np
import pytest

from handtouch.config import ConfigError, parse
from handtouch.core.contact_solver import VALUE_COUNT, VALUE_SLICES, make_solver
from handtouch.core.pad_model import PadModel
from handtouch.core.slab import ChannelField, Slab
from handtouch.core.state import TickState
from handtouch.field.outline_network import BoundaryElectrode, OutlineNetwork
from handtouch.field.outline_surface import OutlineSurface
from handtouch.hand import pad_network, pad_surface
from tests.deployments import deployment_text, pad_text

ARCS = {"end": (50.187, 6.3617), "left": (7.7754, 27.5675), "right": (28.9812, 48.7732)}


def hand_text(arcs: dict[str, tuple[float, float]] = ARCS) -> str:
    """Return a hand of a pad with four sides and a disc with electrodes on arcs."""
    text = deployment_text(pad_text("plane", 1))
    first, _, node = text.partition("[node.n]")
    channels = ", ".join(f'"0x6401:{sub}"' for sub in range(1, len(arcs) + 1))
    text = f"{first}[node.arcs]\nchannels = [{channels}]\n{node.partition('[')[0]}[node.n]{node}"
    listed = ", ".join(f"{name} = [{begin}, {end}]" for name, (begin, end) in arcs.items())
    pad = pad_text("disc", 2).replace('node = "n"', f'node = "arcs"\nelectrode_arcs_mm = {{ {listed} }}')
    surface = (
        'surface = { kind = "outline", outline_x_mm = [9, -9], outline_y_mm = [0, 0], '
        "edge_turn_deg = [180, 180], corners_mm = [35.3429, 49.4801, 7.0686, 21.2058] }"
    )
    lines = [surface if line.startswith("surface") else line for line in pad.splitlines()]
    lines = ["gap_mm = 0.0" if line.startswith("gap_mm") else line for line in lines]
    return text + "\n" + "\n".join(lines) + "\n"


@pytest.fixture(scope="module")
def model() -> PadModel:
    return PadModel(parse(hand_text()))


def test_fractions_of_arcs_are_those_of_the_outline_itself() -> None:
    pad = parse(hand_text()).pads[1].pad
    surface = pad_surface(pad)
    assert isinstance(surface, OutlineSurface)
    network = pad_network(pad, parse(hand_text()).sheets[pad.sheet])
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
    make_solver(model, currents, np.zeros(2), np.ones(2, np.bool_), values).solve_contacts(np.arange(2).data)
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
        ({**ARCS, "left": (5.0, 27.5)}, "end and left touch or overlap"),
        ({"end": ARCS["end"], "right": ARCS["right"], "left": ARCS["left"]}, "left must follow right"),
        ({**ARCS, "right": (28.9812, 200.0)}, "outline is 56.549 mm long"),
    ],
)
def test_impossible_arcs_are_refused(arcs: dict[str, tuple[float, float]], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        parse(hand_text(arcs))
