"""Identifiers of everything that may be wrong with a pad: diagnoses publish them, the simulator plays them.

Public name: `FaultKind`.
"""

from __future__ import annotations

from enum import StrEnum


class FaultKind(StrEnum):
    """`kind` of a published diagnosis and of a scenario's `[[fault]]`; `description` is one line on it."""

    description: str

    def __new__(cls, value: str, description: str = "") -> FaultKind:
        """Make a member that carries its description."""
        kind = str.__new__(cls, value)
        kind._value_ = value
        kind.description = description
        return kind

    # played by the simulator and diagnosed from a pad's samples
    GUM = "gum", "something sticks to the pad, as a nearly constant contact"
    MOISTURE = "moisture", "moisture between the layers, a leak over an area"
    DEAD_ELECTRODE = "dead_electrode", "broken wire: the electrode floats"
    SHORTED_ELECTRODE = "shorted_electrode", "electrode shorted to the conducting layer or another electrode"
    SWAPPED_CABLES = "swapped_cables", "electrode cables plugged into each other's sockets"
    SATURATED_CHANNEL = "saturated_channel", "channel at an end of its range"
    STUCK_CHANNEL = "stuck_channel", "channel that repeats one count"
    TORN_CORNER = "torn_corner", "corner of the sheet cut off"
    OFFSET = "offset", "amplifier zero that has jumped"
    GAIN_STEP = "gain_step", "channel gain that has changed"
    # played by the simulator only: no fault, but it acts like one
    HEAT = "heat", "pad warmed or cooled by what is held"
    # played by the simulator only: faults of a node, which the CANopen master reports
    EMCY = "emcy", "error reported by EMCY"
    REFUSES_OPERATIONAL = "refuses_operational", "error that keeps the node from being operational"
    BOOT_LOOP = "boot_loop", "node that restarts again and again"
    ILLEGAL_NMT_STATE = "illegal_nmt_state", "heartbeats with an NMT state that CiA 301 doesn't define"
    CHANGED_SETTING = "changed_setting", "object changed by another master or a configuration tool"
    # diagnosed from a pad's samples only
    HELD_OBJECT = "held_object", "object held by the hand; no fault"
    STATIC_LOAD = "static_load", "load that stays: probably gum, or an object that is held still"
    HYSTERESIS_TAIL = "hysteresis_tail", "slowly fading remainder of a press"
    COMMON_DRIFT = "common_drift", "drift shared with other pads: temperature or supply"
    UNEXPLAINED = "unexplained", "static load or contacts that no known fault explains"
    # diagnosed from the measured noise
    NOISE = "noise", "hum or noise of the channels beyond what is stated"
    # diagnosed from serial numbers, the calibration and the excitation
    NODE_REPLACED = "node_replaced", "node with another serial number than before"
    GAINS_CHANGED = "gains_changed", "channel gains that no longer match the calibration"
    SHEET_REPLACED = "sheet_replaced", "sheet that probably isn't the calibrated one"
    FOREIGN_CALIBRATION = "foreign_calibration", "calibration taken over from another node"
    STORE_UNAVAILABLE = "store_unavailable", "calibration store that can't be read or written"
    SHEET_ADAPTED = "sheet_adapted", "sheet adapted to load; excitation off while it recovers"
