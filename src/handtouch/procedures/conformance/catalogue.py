"""Checks of `handtouch conformance`: names, what each tests, and what to do if it fails."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType


@dataclass(frozen=True, slots=True)
class Check:
    """A check: `tests` is what it tests, `remedy` what to do in the node if it fails."""

    name: str
    tests: str
    remedy: str


_CHECKS = (
    Check(
        "sdo.response",
        "the SDO server responds to 0x600 + id on 0x580 + id within 200 ms",
        "check node id, bit rate, termination and power; serve SDO in pre-operational and operational",
    ),
    Check(
        "sdo.single",
        "one response to each request",
        "give each node its own id; send each frame once",
    ),
    Check(
        "sdo.protocol",
        "responses of eight bytes with index and sub-index of the request; toggled segments",
        "use a CANopen stack's SDO server; no block transfers are needed",
    ),
    Check(
        "sdo.absent",
        "absent objects are refused with the abort codes of CiA 301",
        "return 0x06020000 for an absent object, 0x06090011 for an absent sub-index",
    ),
    Check(
        "sdo.length",
        "a write of the wrong length is refused and changes nothing",
        "compare the length with the object's type; return 0x06070010, 0x06070012 or 0x06070013",
    ),
    Check(
        "identity.read",
        "0x1018 can be read, and stays the same",
        "implement 0x1018 sub 0 to 4, read-only",
    ),
    Check(
        "identity.serial",
        "the serial number is not 0, and no other node has it",
        "program a serial number of its own into each node: it identifies a replaced node, and is part of "
        "the LSS address",
    ),
    Check(
        "identity.configured",
        "the identity is that of the deployment",
        "connect the configured node, or correct vendor_id, product_code, revision, serial",
    ),
    Check(
        "objects.read",
        "the objects of the table exist, with the length of their types",
        "add the object to the object dictionary with the type of the table",
    ),
    Check(
        "objects.read_only",
        "a write to a read-only object is refused",
        "refuse with 0x06010002 (read-only) or 0x06010000 (unsupported access)",
    ),
    Check(
        "objects.write",
        "objects that handtouch writes accept a value and return it",
        "make the object writable in pre-operational, and store the value written",
    ),
    Check(
        "eds.objects",
        "objects of the EDS exist with its types, constants with its values",
        "correct the EDS, or the object dictionary",
    ),
    Check(
        "nmt.preoperational",
        "NMT enter pre-operational is followed; no TPDO, SDO works",
        "handle NMT command 128 by id; send TPDOs in operational only",
    ),
    Check(
        "nmt.operational",
        "NMT start is followed",
        "handle NMT command 1 by id; clear latched errors, or set 0x1029 sub 1 to 1 (no change)",
    ),
    Check(
        "nmt.stopped",
        "NMT stop is followed; neither TPDO nor SDO",
        "handle NMT command 2 by id; serve no SDO and send no TPDO when stopped",
    ),
    Check(
        "nmt.addressed",
        "commands to another id are ignored",
        "compare the second byte of an NMT command with the node id, and 0",
    ),
    Check(
        "nmt.reset_communication",
        "NMT reset communication: one boot-up message within 3 s",
        "send 0x700 + id [00] once after the reset; restore 0x1000 to 0x1FFF",
    ),
    Check(
        "nmt.reset_node",
        "NMT reset node: one boot-up message within 3 s",
        "restart the application, and send 0x700 + id [00] once",
    ),
    Check(
        "nmt.no_reboot",
        "no boot-up message without a reset",
        "check supply, watchdog and reset line; a weak supply resets a node when its drive is switched on",
    ),
    Check(
        "heartbeat.format",
        "heartbeats of one byte with state 0, 4, 5 or 127",
        "send the present NMT state, one byte",
    ),
    Check(
        "heartbeat.period",
        "heartbeats at the time of 0x1017, within 10 %",
        "send heartbeats from a timer in every NMT state, with the value of 0x1017 in ms",
    ),
    Check(
        "heartbeat.off",
        "no heartbeat with 0x1017 = 0",
        "stop the heartbeat timer when 0 is written",
    ),
    Check(
        "guarding.response",
        "without 0x1017: responses to node guarding with alternating toggle bit",
        "implement 0x1017; or respond to remote frames 0x700 + id with toggle bit and state",
    ),
    Check(
        "emcy.format",
        "EMCY messages of eight bytes, with the error register as 0x1001 then has it",
        "send error code, error register and five bytes; update 0x1001 before sending",
    ),
    Check(
        "emcy.none",
        "no error: error register 0, no EMCY",
        "remove the cause that the node reports; clear 0x1001 and send EMCY 0x0000 when it is gone",
    ),
    Check(
        "pdo.mapping",
        "the four channels are in TPDOs, or can be mapped",
        "map 0x6401:01 to :04 to TPDO2 (0x1A01)",
    ),
    Check(
        "pdo.configure",
        "the TPDO can be disabled, made synchronous (type 1) and enabled",
        "accept writes of 0x1800 + n sub 1 and 2 in pre-operational, at least while the PDO is disabled",
    ),
    Check(
        "pdo.remapping",
        "the mapping can be written in the order of CiA 301",
        "accept: bit 31 of 0x1800 + n sub 1, 0x1A00 + n sub 0 = 0, entries, sub 0, bit 31 cleared; or make "
        "the mapping read-only",
    ),
    Check(
        "pdo.length",
        "TPDOs have the length of their mapping",
        "send as many bytes as are mapped",
    ),
    Check(
        "pdo.complete",
        "every SYNC is answered by one TPDO, at each rate",
        "latch and send with every SYNC; check cable, termination and the transmit mailbox",
    ),
    Check(
        "pdo.delay",
        "the TPDO follows SYNC within sample_window_fraction of the period, at each rate",
        "latch at SYNC and send at once, from the interrupt; convert before SYNC, not after it",
    ),
    Check(
        "pdo.without_sync",
        "no TPDO without SYNC",
        "send a TPDO of type 1 with SYNC only; set no event timer",
    ),
    Check(
        "pdo.event_timer",
        "type 255: TPDOs at the event timer, without SYNC",
        "implement 0x1800 + n sub 5, or leave idling out",
    ),
    Check(
        "channels.range",
        "no channel is at the end of its range while the pad is untouched",
        "check wiring, virtual ground and supply of the amplifier",
    ),
    Check(
        "channels.noise",
        "every channel of the untouched pad has noise, at most twice noise_counts",
        "a constant count: is the channel converted and its input connected? More noise: check shield, "
        "supply, anti-alias filter",
    ),
    Check(
        "excitation.switch",
        "the excitation object can be switched off and on",
        "make it writable in pre-operational; 1 after power-on",
    ),
    Check(
        "lss.select",
        "LSS selects the node by 0x1018, returns its identity and id, and deselects it",
        "pass 0x1018 sub 1 to 4 to the LSS slave; keep the slave running when the node has an id",
    ),
    Check(
        "lss.compares",
        "LSS doesn't respond to another serial number",
        "compare all four numbers before responding",
    ),
    Check(
        "operator.power_cycle",
        "after power-on: one boot-up message, the same identity and mapping",
        "store node id and mapping in non-volatile memory; send the boot-up message once",
    ),
    Check(
        "operator.press",
        "a press in the middle increases all four channels, its end restores them",
        "a channel without response has an open electrode wire; one that falls has reversed polarity",
    ),
    Check(
        "operator.error",
        "an error caused by the operator is reported by EMCY and 0x1001, and its end by EMCY 0x0000",
        "send EMCY when an error begins and 0x0000 when none is left, each with the error register",
    ),
)

CATALOGUE: Mapping[str, Check] = MappingProxyType({check.name: check for check in _CHECKS})
"""By name, in the order of a report."""
