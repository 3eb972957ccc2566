"""What a node is made from: its kind and its identity."""

from __future__ import annotations

from dataclasses import dataclass

from canopen import ObjectDictionary

from handtouch.canbus.objects import eds

from .inputs import CHANNELS, Limits
from .objects import Address, Objects

ANALOGUE_INPUTS: tuple[Address, ...] = tuple((0x6401, sub) for sub in (1, 2, 3, 4))
"""CiA 401: read analogue input 16 bit."""
IDENTITY, SERIAL = 0x1018, 4
_EXCITATION = (0x2100, 0)


@dataclass(frozen=True)
class Unit:
    """`channels` are the objects that carry the four channels; None in the identity is as the EDS has it.

    `excitation` is the object that switches it, None for 0x2100 where the EDS calls that so.
    """

    eds: str
    vendor_id: int | None = None
    product_code: int | None = None
    serial: int | None = None
    channels: tuple[Address, ...] = ANALOGUE_INPUTS
    excitation: Address | None = None
    strict_pdo: bool = False

    def dictionary(self, node_id: int) -> ObjectDictionary:
        """Its objects. Raises ValueError for an EDS that can't be read, has no TPDO or is overfull."""
        dictionary = eds.load(self.eds, node_id)
        tpdos = eds.tpdos(dictionary)
        if not tpdos:
            raise ValueError(f"{self.eds}: has no TPDO (object 0x1800 and up) that could carry the channels")
        for tpdo in tpdos:
            bits = sum(entry[2] for entry in tpdo.entries)
            if bits > 64:
                raise ValueError(f"{self.eds}: TPDO{tpdo.number} maps {bits} bits, 64 fit into a frame")
        return dictionary

    def identify(self, objects: Objects) -> None:
        """Write its identity into its objects."""
        for sub, value in ((1, self.vendor_id), (2, self.product_code), (SERIAL, self.serial)):
            if value is not None:
                objects.preset(IDENTITY, sub, value)

    def switch(self, objects: Objects) -> Address | None:
        """The object that switches the excitation. Raises ValueError for one that the EDS hasn't got."""
        if self.excitation is None:
            usual = objects.find(*_EXCITATION)  # with another vendor it may be anything
            return _EXCITATION if usual is not None and "excitation" in usual.name.lower() else None
        if objects.integer_type(*self.excitation) is None:
            index, sub = self.excitation
            raise ValueError(f"{self.eds}: has no integer 0x{index:04X}:{sub:02X} to switch the excitation")
        return self.excitation

    def limits(self, objects: Objects) -> Limits:
        """Least and greatest count of each channel. Raises ValueError for objects that can't be channels."""
        if len(set(self.channels)) != CHANNELS:
            raise ValueError(f"channels must be four different objects, got {self.channels}")
        limits = []
        for index, sub in self.channels:
            kind = objects.integer_type(index, sub)
            if kind is None:
                raise ValueError(
                    f"{self.eds}: has no integer 0x{index:04X}:{sub:02X} to carry a channel; "
                    "say which objects do by `channels`"
                )
            bits, signed = kind
            limits.append((-(1 << bits - 1), (1 << bits - 1) - 1) if signed else (0, (1 << bits) - 1))
        return limits
