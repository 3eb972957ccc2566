"""Cause, remedy and consequences of each fault in plain language.

Public: `describe_channel_faults`, `describe_static_load`, `describe_contact_fault`,
`describe_loose_electrode`, each from what a detector found to a `PadDiagnosis`; `named_electrodes`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np

from handtouch.arrays import FloatArray
from handtouch.config.tables import SIDE_ELECTRODES
from handtouch.field.estimate import estimate
from handtouch.supervisor.diagnose.channel_faults import ChannelFault
from handtouch.supervisor.diagnose.contact_faults import ContactFault
from handtouch.supervisor.diagnose.loose_electrodes import LooseElectrode
from handtouch.supervisor.diagnose.model import DiagnosisModel, PadDiagnosis
from handtouch.supervisor.diagnose.static_load import StaticLoad
from handtouch.wire.faults import FaultKind
from handtouch.wire.health import Diagnosis

_ASSUMED_PRESSURE_PA = 20e3
"""Pressure assumed under a stuck object, to estimate its size: that of 0.4 N on a disc of 5 mm diameter."""
_MIN_CHANNELS_WITH_DEAD = 5
"""Channels of a pad that locates contacts without one, which leaves at least one number over."""

_STATIC_LOAD_TEXTS = {
    FaultKind.HELD_OBJECT: ("an object is held: it has the hand's tremor, or touches other pads too", ""),
    FaultKind.GUM: (
        "an object sticks to the pad, like gum: a contact of constant position and force, without tremor",
        "inspect and clean the pad; until then, contacts elsewhere on it are merged with this one",
    ),
    FaultKind.STATIC_LOAD: (
        "static load, probably gum ({probability:.0%}), or an object that is held still",
        "look whether something sticks to the pad; touches elsewhere on it tell which",
    ),
    FaultKind.HYSTERESIS_TAIL: (
        "the remainder of a press fades only slowly",
        "wait, or leave the pad untouched",
    ),
    FaultKind.OFFSET: (
        "the zero of channel {electrodes} has jumped: it alone shows a signal, which no contact causes",
        "tare the pad while nothing touches it; if the offset returns, check the amplifier",
    ),
    FaultKind.MOISTURE: (
        "leakage between the layers over an area, which developed slowly, as with moisture",
        "dry the pad and seal its rim; if the leakage stays, replace the sheet",
    ),
    FaultKind.COMMON_DRIFT: (
        "it drifts together with other pads of the hand: temperature or supply, not a contact",
        "let the hand reach its temperature and tare it; check the supply",
    ),
    FaultKind.UNEXPLAINED: (
        "unexplained static load for more than 5 min",
        "inspect the pad; if nothing touches it, tare it",
    ),
}
_CHANNEL_FAULT_TEXTS = {
    FaultKind.STUCK_CHANNEL: (
        "channel {electrodes} repeats one count: even an untouched channel has noise",
        "restart the node; if it persists, its converter is broken: replace the node",
    ),
    FaultKind.SATURATED_CHANNEL: (
        "channel {electrodes} is at an end of its range, whatever touches the pad",
        "check its amplifier and wire",
    ),
    FaultKind.SHORTED_ELECTRODE: (
        "electrode {electrodes} is shorted to the conducting layer: its channel is at the end of its range "
        "and the others carry the current that its potential drives through the sheet",
        "look for a crushed rim or a whisker between electrode and layer; switch the pad off until then",
    ),
}


def describe_channel_faults(
    model: DiagnosisModel, pad: int, faults: Mapping[int, ChannelFault]
) -> list[PadDiagnosis]:
    """Return one diagnosis for each kind of fault among the channels of a pad."""
    link, electrodes, diagnoses = model.links[pad], model.electrodes[pad], []
    for kind in sorted({fault.kind for fault in faults.values()}):
        of_kind = {channel: fault for channel, fault in faults.items() if fault.kind == kind}
        names = tuple(electrodes[channel] for channel in sorted(of_kind))
        cause, remedy = _CHANNEL_FAULT_TEXTS[kind]
        values = {
            f"{electrodes[c]} {k}": v for c, fault in of_kind.items() for k, v in fault.evidence.items()
        }
        since_ns = min(fault.since_ns for fault in of_kind.values())
        cause = cause.format(electrodes=" and ".join(names))
        published = Diagnosis(
            kind,
            cause,
            _evidence_text(values),
            remedy,
            since_ns,
            confidence=min(fault.confidence for fault in of_kind.values()),
            position_valid=False,
            force_valid=False,
        )
        diagnoses.append(PadDiagnosis(published, link, values, names))
    return diagnoses


def named_electrodes(model: DiagnosisModel, pad: int, load: StaticLoad) -> tuple[str, ...]:
    """Return the electrodes that the diagnosis of a static load names."""
    return (model.electrodes[pad][load.channel],) if load.kind == FaultKind.OFFSET else ()


def describe_static_load(
    model: DiagnosisModel, pad: int, load: StaticLoad, is_located: bool = True
) -> PadDiagnosis:
    """Return the diagnosis of a classified static load; is_located: all its channels are healthy."""
    assert load.kind is not None
    kind = load.kind
    names = named_electrodes(model, pad, load)
    position: tuple[float, float] | None = None
    size: float | None = None
    if is_located and kind in (
        FaultKind.GUM,
        FaultKind.STATIC_LOAD,
        FaultKind.MOISTURE,
        FaultKind.HELD_OBJECT,
        FaultKind.HYSTERESIS_TAIL,
    ):
        position, radius_m = _load_position(model, pad, load.level_counts)
        size = 2 * radius_m if kind == FaultKind.GUM and radius_m is not None else None
    cause, remedy = _STATIC_LOAD_TEXTS[kind]
    cause = cause.format(electrodes=" and ".join(names), probability=load.probability)
    if position is not None:
        along, across = (f"{1e3 * at:.0f} mm" for at in position)
        by_arcs = model.electrodes[pad] != SIDE_ELECTRODES
        cause += (
            f"; at u = {along}, v = {across} of its drawing"
            if by_arcs
            else f"; {along} from electrode x0 and {across} from y0"
        )
    if size is not None:
        cause += f", about {1e3 * size:.0f} mm across"
    values = dict(load.evidence)
    published = Diagnosis(
        kind,
        cause,
        _evidence_text(values),
        remedy,
        load.since_ns,
        min(max(load.probability, 0.0), 1.0),
        position,
        size,
        position_valid=kind in (FaultKind.HELD_OBJECT, FaultKind.STATIC_LOAD, FaultKind.HYSTERESIS_TAIL),
        force_valid=kind in (FaultKind.HELD_OBJECT, FaultKind.STATIC_LOAD),
    )
    return PadDiagnosis(published, model.links[pad], values, names)


def describe_contact_fault(model: DiagnosisModel, pad: int, fault: ContactFault) -> PadDiagnosis:
    """Return the diagnosis of a fault that a pad's contacts have in common."""
    hypothesis = fault.hypothesis
    names = hypothesis.electrodes
    values = {"nats": fault.nats, "contacts": float(fault.contacts)}
    position_valid = force_valid = False
    if fault.rival is not None:
        gain, cut = sorted((hypothesis, fault.rival), key=lambda h: h.kind != FaultKind.GAIN_STEP)
        names = gain.electrodes
        cause = (
            f"channel {names[0]} collects too {'little' if gain.factor < 1 else 'much'}: its gain is about "
            f"{gain.factor:.2f} times the former one, or the sheet is torn at the corner of "
            f"{' and '.join(cut.electrodes)}"
        )
        remedy = (
            "touch the pad near that corner, which distinguishes the two; check whether the sheet is torn"
        )
    elif hypothesis.kind == FaultKind.UNEXPLAINED:
        cause = "contacts on the pad never look like a point contact, and no known fault explains them"
        remedy = "inspect the pad; if several objects touch it at a time, that is the reason"
    elif hypothesis.kind == FaultKind.DEAD_ELECTRODE:
        cause, remedy, is_located = _describe_dead_electrode(model, pad, names[0])
        position_valid = force_valid = is_located
    elif hypothesis.kind == FaultKind.SHORTED_ELECTRODE:
        cause = f"electrodes {names[0]} and {names[1]} are shorted to one another"
        remedy = "check where their wires or the two ends of the electrodes meet"
    elif hypothesis.kind == FaultKind.SWAPPED_CABLES:
        pairs = " or ".join(f"{' and '.join(h.electrodes)}" for h in (hypothesis, *fault.alternatives))
        cause = f"cables are swapped: {pairs}; further swaps that mirror the pad are not observable"
        remedy = "plug them in as the deployment file states; `handtouch commission` shows which is which"
        force_valid = True
    elif hypothesis.kind == FaultKind.GAIN_STEP:
        cause = f"the gain of channel {names[0]} is about {hypothesis.factor:.2f} times the former one"
        others = {h.electrodes[0]: h.factor for h in fault.alternatives if h.electrodes != names}
        cause += "".join(f", or that of {name} {factor:.2f} times" for name, factor in others.items())
        remedy = "touch the pad all over, so that it calibrates itself; if it persists, replace the node"
        values["factor"] = hypothesis.factor
    else:
        mm = [
            1e3 * part * side for part, side in zip(hypothesis.cut, model.surfaces[pad].extent_m, strict=True)
        ]
        cause = (
            f"the sheet is torn at the corner of {names[0]} and {names[1]}: about {mm[0]:.0f} mm along x and "
            f"{mm[1]:.0f} mm along y no longer conduct"
        )
        corners = dict.fromkeys(h.electrodes for h in fault.alternatives if h.electrodes != names)
        cause += "".join(f"; or at that of {' and '.join(corner)}" for corner in corners)
        remedy = "replace the sheet; until then don't rely on positions near that corner"
        values.update(along_x_mm=mm[0], along_y_mm=mm[1])
    published = Diagnosis(
        fault.kind,
        cause,
        _evidence_text(values),
        remedy,
        fault.since_ns,
        min(max(fault.probability, 0.0), 1.0),
        position_valid=position_valid,
        force_valid=force_valid,
    )
    return PadDiagnosis(published, model.links[pad], values, names)


def describe_loose_electrode(model: DiagnosisModel, pad: int, loose: LooseElectrode) -> PadDiagnosis:
    """Return the diagnosis of an electrode that opened: `dead_electrode`, always or part of the time."""
    name, values = model.electrodes[pad][loose.channel], loose.evidence
    is_located = False
    if loose.is_dead:
        values["contacts"] = float(loose.contacts)
        cause, remedy, is_located = _describe_dead_electrode(model, pad, name)
    else:
        cause = (
            f"electrode {name} is open part of the time: under contacts, its current stops and returns from "
            "one sample to the next, and the other electrodes take it over"
        )
        remedy = (
            "move the cable while the pad is pressed to find the loose contact: wire, crimp, socket, or the "
            "glue between electrode and sheet"
        )
    published = Diagnosis(
        FaultKind.DEAD_ELECTRODE,
        cause,
        _evidence_text(values),
        remedy,
        loose.since_ns,
        loose.confidence,
        position_valid=is_located,
        force_valid=is_located,
    )
    return PadDiagnosis(published, model.links[pad], values, (name,))


def _describe_dead_electrode(model: DiagnosisModel, pad: int, name: str) -> tuple[str, str, bool]:
    """Return cause and remedy, and whether contacts are located with the other electrodes."""
    is_located = len(model.electrodes[pad]) >= _MIN_CHANNELS_WITH_DEAD
    remedy = "check the wire and the socket of that electrode"
    remedy += "; until then, contacts are located with the others" if is_located else ""
    return f"electrode {name} carries no current: its wire is broken or unplugged", remedy, is_located


def _evidence_text(values: Mapping[str, float]) -> str:
    return ", ".join(f"{name} {value:.3g}" for name, value in values.items())


def _load_position(
    model: DiagnosisModel, pad: int, level_counts: FloatArray
) -> tuple[tuple[float, float] | None, float | None]:
    """Return arc lengths [m] and radius [m] of a contact that reads `level_counts` (c,)."""
    network, sheet = model.networks[pad], model.sheets[pad]
    current = level_counts * model.ampere_per_count[pad, : len(level_counts)]
    noise = float(model.noise_counts[pad] * model.ampere_per_count[pad].max())
    found = estimate(network, current, noise)
    if not (np.isfinite(found.x) and np.isfinite(found.y)):  # one of them alone places nothing
        return None, None
    u, v = model.surfaces[pad].from_rectangle(float(found.x), float(found.y))
    ohm = float(model.drive_v[pad] / found.total)
    contact = sheet.contact_ohm_mm2 * 1e-6 * (1e3 * sheet.reference_kpa / _ASSUMED_PRESSURE_PA) ** sheet.alpha
    radius = math.sqrt(contact / (math.pi * ohm))
    return (float(u), float(v)), radius
