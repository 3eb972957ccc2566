"""Tables of docs/firmware.md; `make tables` writes them. The page marks each by `<!-- table: NAME -->`.

Currents of a pad, and what each part of its electronics costs in position: random errors are per channel and
sample; their effect is the Cramer-Rao bound, median over the inner 80 % of the pad. Systematic errors shift
the location, to first order; those of the four channels are independent, and their effect is the standard
deviation, median over the pad.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path

import numpy as np
import numpy.typing as npt

from handtouch import config
from handtouch.config import shipped
from handtouch.hand.expected_error import (
    EDGE_MARGIN,
    FIRM_TOUCH_N,
    PadDesign,
    error_summary,
    expected_error,
    pad_design,
)
from handtouch.procedures.conformance import CATALOGUE, REQUIRED_OBJECTS

PAGE = Path(__file__).with_name("firmware.md")
_TABLE = re.compile(r"(?<=<!-- table: )(objects|checks|currents|electronics)( -->\n)(?:\|.*\n)*")
_CONFIG = "utah_mit.toml"
FloatArray = npt.NDArray[np.float64]
CurrentErrors = Callable[[FloatArray], FloatArray]
"""Currents (4, ...) -> errors of them (k, 4, ...) in k cases [A]."""

_FORCES_N = (0.1, 1.0, 10.0)
_BOLTZMANN_J_K, _ROOM_K = 1.380649e-23, 300.0
OUTPUT_V = 2.5
"""Output of an amplifier at full scale, either side of the virtual ground."""
BANDWIDTH_HZ = 10e3
"""Bandwidth of the amplifier; the converter averages over it."""
AMPLIFIER_V_RTHZ = 10e-9
_STEPS = 15


def feedback_ohm(pad: PadDesign) -> float:
    """Return the feedback resistor whose drop at full scale is OUTPUT_V."""
    return OUTPUT_V / pad.full_scale_a


def current_rows(pad: PadDesign) -> Iterator[tuple[str, ...]]:
    """Yield rows: force, total current, smallest and largest current of an electrode, counts of these."""
    x, y = _positions(pad)
    fractions = pad.network.fractions(x, y)
    per_count = pad.full_scale_a / 2**15
    for force in _FORCES_N:
        total = expected_error(pad, force, x, y)[1]
        currents = fractions * total
        low, high = float(currents.min()), float(currents.max())
        yield (
            f"{force:g} N",
            f"{1e3 * float(np.median(total)):.3g} mA",
            f"{1e3 * low:.2g} to {1e3 * high:.2g} mA",
            f"{low / per_count:.0f} to {high / per_count:.0f}",
        )


def error_rows(pad: PadDesign) -> Iterator[tuple[str, ...]]:
    """Yield rows: source, its size in a channel, position error at a light and at a firm touch."""
    step_a = pad.full_scale_a / 2**15
    resistor = feedback_ohm(pad)
    noise_bandwidth_hz = BANDWIDTH_HZ * math.pi / 2
    johnson_a = math.sqrt(4 * _BOLTZMANN_J_K * _ROOM_K * noise_bandwidth_hz / resistor)
    gain_ohm = 1 / float(np.max(np.diag(pad.network.conductance))) * pad.network.sheet_ohm_per_square
    amplifier_a = AMPLIFIER_V_RTHZ * math.sqrt(noise_bandwidth_hz) * (1 / gain_ohm + 1 / resistor)
    random = (
        ("quantisation, 16 bit", step_a / math.sqrt(12)),
        ("quantisation, 12 bit", 16 * step_a / math.sqrt(12)),
        (f"noise of the {resistor:g} ohm feedback resistor", johnson_a),
        ("amplifier, 10 nV per root Hz", amplifier_a),
        ("noise of 1 count", step_a),
        ("noise of 4 counts", 4 * step_a),
    )
    for name, noise_a in random:
        yield (name, _format_current(noise_a, step_a), *_bounds(pad, noise_a))
    systematic: tuple[tuple[str, str, CurrentErrors], ...] = (
        ("gains 1 % off", "1 %", lambda currents: _each_channel(0.01 * currents)),
        ("gains 0.1 % off", "0.1 %", lambda currents: _each_channel(0.001 * currents)),
        ("1 ohm in each electrode's wire", "1 ohm", lambda currents: _series_errors(pad, currents, 1.0)),
        (
            "virtual grounds drift by 0.1 mV",
            _format_current(1e-4 / gain_ohm, step_a),
            lambda currents: _offset_errors(pad, currents, 1e-4),
        ),
    )
    for name, size, errors in systematic:
        shifts = (location_shift_m(pad, force, errors) for force in (pad.light_touch_n, FIRM_TOUCH_N))
        yield (name, size, *map(_format_length, shifts))


def _bounds(pad: PadDesign, noise_a: float) -> Iterator[str]:
    """Yield the position noise from a noise current alone, at both forces."""
    scale = noise_a / pad.noise_a
    for force in (pad.light_touch_n, FIRM_TOUCH_N):
        yield _format_length(scale * error_summary(pad, force)[0])


def location_shift_m(pad: PadDesign, force_n: float, errors: CurrentErrors) -> float:
    """Return the root mean square shift of the location over the cases of `errors`, median over the pad."""
    x, y = _positions(pad)
    total = expected_error(pad, force_n, x, y)[1]
    fractions, jacobian = pad.network.fractions_with_jacobian(x, y)
    slopes = jacobian / pad.surface.scales(x, y)
    columns = np.moveaxis(np.concatenate([slopes, fractions[:, None]], axis=1), (0, 1), (-2, -1))
    relative = np.moveaxis(errors(fractions * total) / total, 1, -1)[..., None]
    shift = np.linalg.pinv(columns) @ relative
    return float(np.median(np.sqrt(np.mean(shift[..., 0, 0] ** 2 + shift[..., 1, 0] ** 2, axis=0))))


def _each_channel(errors: FloatArray) -> FloatArray:
    """Return four cases: the error of one channel each, doubled, so that their mean square is the sum."""
    cases = np.zeros((4, *errors.shape))
    for channel in range(4):
        cases[channel, channel] = 2 * errors[channel]
    return cases


def _series_errors(pad: PadDesign, currents: FloatArray, ohm: float) -> FloatArray:
    """Return the changes of the currents from equal series resistors, at the same total: one case."""
    x, y = _positions(pad)
    fractions = pad.network.with_series_ohm((ohm,) * 4).fractions(x, y)
    return np.asarray((fractions * currents.sum(0) - currents)[None])


def _offset_errors(pad: PadDesign, currents: FloatArray, offset_v: float) -> FloatArray:
    """Return the currents through the sheet from the potential of one electrode: four cases, doubled."""
    through = pad.network.conductance / pad.network.sheet_ohm_per_square * offset_v
    return np.stack([2 * np.broadcast_to(column[:, None, None], currents.shape) for column in through.T])


def _positions(pad: PadDesign) -> tuple[FloatArray, FloatArray]:
    steps = np.linspace(EDGE_MARGIN, 1 - EDGE_MARGIN, _STEPS)
    x, y = np.meshgrid(steps * pad.network.a, steps * pad.network.b)
    return x, y


def _format_current(current_a: float, step_a: float) -> str:
    return f"{1e6 * current_a:.2g} uA, {current_a / step_a:.2g} counts"


def _format_length(length_m: float) -> str:
    micrometres = 1e6 * length_m
    return f"{micrometres / 1e3:.2g} mm" if micrometres >= 100 else f"{micrometres:.2g} um"


def with_tables(page: str) -> str:
    """Return a page with all marked tables."""
    return _TABLE.sub(
        lambda mark: mark[1] + mark[2] + "".join(f"{row}\n" for row in _TABLES[mark[1]]()), page
    )


def _objects() -> Iterator[str]:
    yield "| object | type | access | value after power-on | |"
    yield "|---|---|---|---|---|"
    for row in REQUIRED_OBJECTS:
        subs = f"{row.index:04X}:00" + (f" to :{row.last_sub:02d}" if row.last_sub else "")
        remark = f"optional: {row.remark}" if row.optional else row.remark
        types, defaults = ", ".join(row.types), ", ".join(row.defaults)
        yield f"| 0x{subs} {row.name} | {types} | {row.access} | {defaults} | {remark} |"


def _checks() -> Iterator[str]:
    yield from _head("check", "tests")
    yield from (f"| `{check.name}` | {check.tests} |" for check in CATALOGUE.values())


def _currents() -> Iterator[str]:
    yield from _head("force", "total", "one electrode, anywhere on the inner 80 %", "counts")
    yield from _rows(current_rows(_pad()))


def _electronics() -> Iterator[str]:
    pad = _pad()
    yield from _head("source", "in a channel", f"at {pad.light_touch_n:g} N", f"at {FIRM_TOUCH_N:g} N")
    yield from _rows(error_rows(pad))


def _pad() -> PadDesign:
    return pad_design(config.load(shipped.path(_CONFIG)))


def _head(*titles: str) -> Iterator[str]:
    yield f"| {' | '.join(titles)} |"
    yield "|---" * len(titles) + "|"


def _rows(rows: Iterable[tuple[str, ...]]) -> Iterator[str]:
    yield from (f"| {' | '.join(cells)} |" for cells in rows)


_TABLES: dict[str, Callable[[], Iterator[str]]] = {
    "objects": _objects,
    "checks": _checks,
    "currents": _currents,
    "electronics": _electronics,
}


if __name__ == "__main__":
    PAGE.write_text(with_tables(PAGE.read_text(encoding="utf-8")), encoding="utf-8")
