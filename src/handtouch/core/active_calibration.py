"""The calibration of one pad as the core applies it: one immutable object, replaced as a whole.

Public name: `ActiveCalibration`.
"""

from __future__ import annotations

from dataclasses import dataclass

from handtouch.calibration.calibration import LawParameters, LearnedParts


@dataclass(frozen=True, slots=True)
class ActiveCalibration:
    """Calibration of a pad, and what is known about its quality.

    gains: (n,) of the electrodes. law, second_law: of the pad's sheet, and of its second one; None, the
    deployment's. gain_covariance: (n n,) of log gains; None, as the deployment states. parts: learned with
    the gains; None, as the deployment states.
    quarantined: no force is published. diagnoses: names of those responsible for `quarantined` or
    `position_unreliable`. dead_electrode: index of an electrode that is connected to nothing, without which
    contacts are located.
    """

    calibration_id: str
    gains: tuple[float, ...] = (1.0,) * 4
    law: LawParameters | None = None
    gain_covariance: tuple[float, ...] | None = None
    parts: LearnedParts | None = None
    quarantined: bool = False
    position_unreliable: bool = False
    dead_electrode: int | None = None
    diagnoses: tuple[str, ...] = ()
    second_law: LawParameters | None = None
