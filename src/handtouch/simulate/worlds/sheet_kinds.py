"""Kinds of sheets: nominal behaviour of a material.

Public names: `SheetKind`, `SHEET_KINDS` by name, `ELASTOMER`. docs/worlds.md has the source of each number.
The presets of `handtouch.sheet` repeat those of S1 and S2, so that a change of what is compensated doesn't
change what is simulated.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from types import MappingProxyType

from handtouch.config.tables import Behaviour
from handtouch.host.units import GRAM_FORCE_N
from handtouch.simulate.preisach import HomogeneousLoops, PlayLoops
from handtouch.simulate.sheet_physics import BackForces, ElementCreep, PowerCreep, SheetLaw

_HYSTERESIS_FULL_N = 5.0
_MAX_EXPONENT = 0.4


@dataclass(frozen=True)
class SheetKind:
    """Material of a sheet: its nominal behaviour, and how a deployment file describes it."""

    name: str
    law: SheetLaw
    behaviour: Behaviour
    """`[sheet.NAME.behaviour]` of a builder who has measured the nominal sheet, as far as it has keys."""

    def varied(
        self,
        remains: float,
        times: float,
        recovery: float,
        threshold: float,
        creep: float,
        temperature: float,
    ) -> SheetLaw:
        """Return the behaviour of one pad's sheet.

        Factors multiply: what adaptation leaves of the load, times of adaptation, of recovery, threshold,
        creep (its times; of a power law, the exponent), and the temperature coefficient.
        """
        nominal = self.law.adaptation
        total = sum(nominal.shares)
        scale = max(1 - (1 - total) * remains, 0.0) / total if total else 0.0
        adaptation = replace(
            nominal,
            shares=tuple(share * scale for share in nominal.shares),
            times_s=tuple(time_s * times for time_s in nominal.times_s),
            recovery_s=nominal.recovery_s * recovery,
            threshold_n=nominal.threshold_n * threshold,
        )
        law = self.law.creep
        if isinstance(law, PowerCreep):
            law = PowerCreep(min(law.exponent * creep, _MAX_EXPONENT))
        elif isinstance(law, ElementCreep):
            law = replace(law, times_s=tuple(time_s * creep for time_s in law.times_s))
        return replace(
            self.law, adaptation=adaptation, creep=law, gain_per_k=self.law.gain_per_k * temperature
        )


_HOUR_S = 3600.0
_S1 = SheetLaw(
    BackForces((1.0,), (3000.0,), 1.5 * _HOUR_S, 2 * GRAM_FORCE_N, fatigue_s=10_000.0),
    ElementCreep(0.4, (0.6,), (0.25,)),
    gain_per_k=0.01,
    press_std=0.072,
    noise_std=0.01,
)
_S2 = replace(
    _S1,
    adaptation=BackForces((0.851,), (3000.0,), 1.5 * _HOUR_S, 5 * GRAM_FORCE_N),
    press_std=0.171,
)
_FSR = SheetLaw(
    BackForces(threshold_n=0.02),
    PowerCreep(0.021),
    PlayLoops(0.05, _HYSTERESIS_FULL_N),
    gain_per_k=0.003,
    press_std=0.02,
    noise_std=0.01,
)
_FLEXIFORCE = SheetLaw(
    BackForces(threshold_n=0.02),
    PowerCreep(0.021),
    PlayLoops(0.045, _HYSTERESIS_FULL_N),
    gain_per_k=0.0036,
    press_std=0.025,
    noise_std=0.01,
)
_CONDUCTIVE_FILM = SheetLaw(
    BackForces((0.6,), (2000.0,), 5400.0, 0.03),
    ElementCreep(0.7, (0.2, 0.1), (0.4, 30.0)),
    PlayLoops(0.1, _HYSTERESIS_FULL_N),
    gain_per_k=0.01,
    press_std=0.1,
    noise_std=0.01,
)
ELASTOMER = SheetKind(
    "elastomer",
    SheetLaw(
        BackForces(),
        ElementCreep(0.95, (0.03, 0.02), (0.5, 30.0)),
        PlayLoops(0.06, _HYSTERESIS_FULL_N),
        gain_per_k=0.002,
        press_std=0.02,
        noise_std=0.002,
        calibration_n=1.0,
    ),
    Behaviour(preset="unknown"),
)
"""Cover of sensors other than sheets: silicone rubber, loops some 6 % wide; nothing has a model of it."""


def _film_behaviour(law: SheetLaw, width: float, **creep: float) -> Behaviour:
    share = sum(law.adaptation.shares)
    return Behaviour(
        preset="S2",
        adaptation_share=share,
        adaptation_time_s=law.adaptation.times_s[0] if share else None,
        threshold_n=law.adaptation.threshold_n,
        hysteresis_width=width,
        hysteresis_full_scale_n=_HYSTERESIS_FULL_N,
        press_std=law.press_std,
        **creep,
    )


_SLOW = {"creep_share": 0.02, "creep_time_s": 1.0, "slow_creep": 0.02}

_KINDS = (
    SheetKind("S1", _S1, Behaviour(preset="S1")),
    SheetKind("S2", _S2, Behaviour(preset="S2")),
    SheetKind("fsr", _FSR, _film_behaviour(_FSR, 0.05, **_SLOW)),
    SheetKind("flexiforce", _FLEXIFORCE, _film_behaviour(_FLEXIFORCE, 0.045, **_SLOW)),
    SheetKind(
        "conductive_film",
        _CONDUCTIVE_FILM,
        _film_behaviour(_CONDUCTIVE_FILM, 0.1, creep_share=0.3, creep_time_s=0.6),
    ),
    # kinds that no estimator has a model of; the file describes the nearest sheet of the paper
    SheetKind("power_creep", replace(_S2, creep=PowerCreep(0.05)), Behaviour(preset="S2")),
    SheetKind(
        "two_speeds",
        replace(_S2, adaptation=replace(_S2.adaptation, shares=(0.35, 0.5), times_s=(300.0, 6000.0))),
        Behaviour(preset="S2"),
    ),
    SheetKind("steep_creep", replace(_S1, creep=PowerCreep(0.10)), Behaviour(preset="S1")),
    SheetKind(
        "fast_and_slow",
        replace(_S1, adaptation=replace(_S1.adaptation, shares=(0.6, 0.4), times_s=(1000.0, 9000.0))),
        Behaviour(preset="S1"),
    ),
    SheetKind(
        "preisach_without_adaptation",
        replace(
            _S1,
            adaptation=replace(_S1.adaptation, shares=(), times_s=()),
            hysteresis=HomogeneousLoops(1.35),
        ),
        Behaviour(preset="S1"),
    ),
    SheetKind(
        "preisach_and_power_creep",
        replace(_S2, creep=PowerCreep(0.07), hysteresis=HomogeneousLoops(1.5)),
        Behaviour(preset="S2"),
    ),
)

SHEET_KINDS: Mapping[str, SheetKind] = MappingProxyType({kind.name: kind for kind in _KINDS})
"""By name."""
