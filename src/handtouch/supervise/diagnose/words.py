"""Findings in plain words: cause, remedy, and what stays trustworthy.

Public: `of_channels`, `of_standing`, `of_contacts`, each from what a witness found to a `Finding`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np

from handtouch.canbus.objects.channels import ELECTRODES
from handtouch.supervise.diagnose.channels import ChannelFault
from handtouch.supervise.diagnose.contacts import Verdict
from handtouch.supervise.diagnose.findings import DiagnosisModel, Finding, FloatArray, Kind
from handtouch.supervise.diagnose.standing import Standing

_PRESSING_PA = 20e3
"""Pressure supposed under what sticks, to tell its size: that of 0.4 N on a disc 5 mm across."""

_STANDING = {
    Kind.HELD_OBJECT: ("an object is held: it trembles with the hand, or touches other pads too", ""),
    Kind.STUCK_CONTACT: (
        "something sticks to it, like gum: a contact that keeps its place and strength and doesn't tremble",
        "look at the pad and clean it; until then touches elsewhere on it are told together with this one",
    ),
    Kind.HYSTERESIS_TAIL: ("what is left of a press fades only slowly", "wait, or leave the pad untouched"),
    Kind.OFFSET: (
        "the zero of channel {electrodes} has jumped: it alone reads something, which no contact does",
        "tare the pad while nothing touches it; if it comes again, look at the amplifier",
    ),
    Kind.MOISTURE: (
        "the layers leak into each other over an area, and the leak came slowly, as moisture does",
        "dry the pad and seal its rim; if it stays, change the sheet",
    ),
    Kind.COMMON_DRIFT: (
        "it rises and falls with other pads of the hand: temperature or supply, not a contact",
        "let the hand come to its temperature and tare it; check the supply",
    ),
    Kind.UNEXPLAINED: (
        "something has been standing on it for minutes, and I can't explain what",
        "look at the pad; if nothing touches it, tare it",
    ),
}
_CHANNELS = {
    Kind.STUCK_CHANNEL: (
        "channel {electrodes} shows one count for ever: even an untouched channel has noise",
        "restart the node; if it stays, its converter is broken: change the node",
    ),
    Kind.SATURATED_CHANNEL: (
        "channel {electrodes} is at an end of its range whatever touches the pad",
        "look at its amplifier and wire",
    ),
    Kind.SHORTED_ELECTRODE: (
        "electrode {electrodes} is shorted to the conducting layer: its channel is at the end of its range "
        "and the other three carry the current that its potential drives through the sheet",
        "look for a crushed rim or a whisker between electrode and layer; switch the pad off until then",
    ),
}


def of_channels(link: str, faults: Mapping[int, ChannelFault]) -> list[Finding]:
    """Findings, one a kind, of the channels of a pad that have faults."""
    found = []
    for kind in sorted({fault.kind for fault in faults.values()}):
        mine = {channel: fault for channel, fault in faults.items() if fault.kind == kind}
        names = tuple(ELECTRODES[channel] for channel in sorted(mine))
        cause, remedy = _CHANNELS[kind]
        evidence = {f"{ELECTRODES[c]} {k}": v for c, fault in mine.items() for k, v in fault.evidence.items()}
        since = min(fault.since_ns for fault in mine.values())
        cause = cause.format(electrodes=" and ".join(names))
        found.append(Finding(kind, link, since, cause, remedy, evidence, 1.0, False, False, names))
    return found


def electrodes_of(standing: Standing) -> tuple[str, ...]:
    """Those that a finding of what stands on a pad names."""
    return (ELECTRODES[standing.channel],) if standing.kind == Kind.OFFSET else ()


def of_standing(model: DiagnosisModel, pad: int, standing: Standing) -> Finding:
    """A finding of what stands on a pad."""
    assert standing.kind is not None
    kind, level = standing.kind, standing.level
    names = electrodes_of(standing)
    place: tuple[float, float] | None = None
    size: float | None = None
    if kind in (Kind.STUCK_CONTACT, Kind.MOISTURE, Kind.HELD_OBJECT, Kind.HYSTERESIS_TAIL):
        place, radius_m = _place(model, pad, level)
        size = 2 * radius_m if kind == Kind.STUCK_CONTACT and radius_m is not None else None
    cause, remedy = _STANDING[kind]
    cause = cause.format(electrodes=" and ".join(names))
    if place is not None:
        cause += f"; {1e3 * place[0]:.0f} mm from electrode x0 and {1e3 * place[1]:.0f} mm from y0"
    if size is not None:
        cause += f", about {1e3 * size:.0f} mm across"
    location = kind in (Kind.HELD_OBJECT, Kind.HYSTERESIS_TAIL)
    strength = kind == Kind.HELD_OBJECT
    return Finding(
        kind, model.links[pad], standing.since_ns, cause, remedy, dict(standing.evidence), standing.share,
        location, strength, names, place, size,
    )  # fmt: skip


def of_contacts(model: DiagnosisModel, pad: int, verdict: Verdict) -> Finding:
    """A finding of what a pad's contacts have in common."""
    hypothesis = verdict.hypothesis
    names = hypothesis.electrodes
    evidence = {"nats": verdict.nats, "contacts": float(verdict.contacts)}
    strength = False
    if verdict.rival is not None:
        gain, cut = sorted((hypothesis, verdict.rival), key=lambda h: h.kind != Kind.GAIN_STEP)
        names = gain.electrodes
        cause = (
            f"channel {names[0]} collects too {'little' if gain.factor < 1 else 'much'}: its gain is about "
            f"{gain.factor:.2f} times what it was, or the sheet is torn at the corner of "
            f"{' and '.join(cut.electrodes)}"
        )
        remedy = (
            "touch the pad near that corner, which tells one from the other; look whether the sheet is torn"
        )
    elif hypothesis.kind == Kind.UNEXPLAINED:
        cause = (
            "what touches the pad never looks like a touch at one place, and no fault that I know explains it"
        )
        remedy = "look at the pad; if many things touch it at a time, that is the reason"
    elif hypothesis.kind == Kind.DEAD_ELECTRODE:
        cause = f"electrode {names[0]} takes no current: its wire is broken or out of its socket"
        remedy = "look at the wire and the socket of that electrode"
    elif hypothesis.kind == Kind.SHORTED_ELECTRODE:
        cause = f"electrodes {names[0]} and {names[1]} are shorted to one another"
        remedy = "look where their wires or the two ends of the electrodes meet"
    elif hypothesis.kind == Kind.SWAPPED_ELECTRODES:
        both = " or ".join(f"{' and '.join(h.electrodes)}" for h in (hypothesis, *verdict.also))
        cause = f"cables are swapped: {both}; swaps that mirror the pad besides can't be seen"
        remedy = "plug them in as the deployment file says; `handtouch commission` shows which is which"
        strength = True
    elif hypothesis.kind == Kind.GAIN_STEP:
        cause = f"the gain of channel {names[0]} is about {hypothesis.factor:.2f} times what it was"
        remedy = "touch the pad all over, so that it calibrates itself; if it goes on, change the node"
        evidence["factor"] = hypothesis.factor
    else:
        mm = [
            1e3 * part * side for part, side in zip(hypothesis.cut, model.surfaces[pad].extent_m, strict=True)
        ]
        cause = (
            f"the sheet is torn at the corner of {names[0]} and {names[1]}: some {mm[0]:.0f} mm along x and "
            f"{mm[1]:.0f} mm along y conduct no more"
        )
        remedy = "change the sheet; until then don't rely on places near that corner"
        evidence.update(along_x_mm=mm[0], along_y_mm=mm[1])
    return Finding(
        verdict.kind, model.links[pad], verdict.since_ns, cause, remedy, evidence, verdict.share,
        False, strength, names,
    )  # fmt: skip


def _place(
    model: DiagnosisModel, pad: int, level: FloatArray
) -> tuple[tuple[float, float] | None, float | None]:
    """Arc lengths [m] of a contact of `level` counts (4,), and the radius that its current tells of."""
    network, sheet = model.networks[pad], model.sheets[pad]
    current = level * model.ampere_per_count[pad]
    noise = float(model.noise_counts[pad] * model.ampere_per_count[pad].max())
    found = network.estimate(current, noise)
    if not bool(np.isfinite(found.x)):
        return None, None
    u, v = model.surfaces[pad].from_rectangle(float(found.x), float(found.y))
    ohm = float(model.drive_v[pad] / found.total)
    contact = sheet.contact_ohm_mm2 * 1e-6 * (1e3 * sheet.reference_kpa / _PRESSING_PA) ** sheet.alpha
    radius = math.sqrt(contact / (math.pi * ohm))
    return (float(u), float(v)), radius
