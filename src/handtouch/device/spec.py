"""Specification of a simulated node: its kind and its identity."""

from __future__ import annotations

from dataclasses import dataclass

from canopen import ObjectDictionary

from handtouch.canbus import cia301
from handtouch.config import eds
from handtouch.config.base import MAX_CHANNELS, MIN_CHANNELS
from handtouch.config.channels import integer_limits
from handtouch.config.eds import REAL32
from handtouch.device.inputs import CHANNELS, ChannelLimits
from handtouch.device.object_values import Address, ObjectValues

ANALOGUE_INPUTS: tuple[Address, ...] = tuple((cia301.ANALOGUE_INPUTS, sub) for sub in (1, 2, 3, 4))
"""CiA 401: read analogue input 16 bit."""
_DEFAULT_EXCITATION = (0x2100, 0)


@dataclass(frozen=True)
class DeviceSpec:
    """Kind and identity of a node; identity fields that are None are those of the EDS.

    `channels` : the objects of the channels, at most 32
    `counts_per_unit` : those that are REAL32 carry the count divided by this
    `excitation` : the object that switches the excitation, None for 0x2100 if it has that name in the EDS
    `strict_pdo` : a valid PDO can't be changed
    `simulates_excitation` : without excitation the inputs read 0, and after it they settle; False where the
    sampler measures them
    """

    eds: str
    vendor_id: int | None = None
    product_code: int | None = None
    serial: int | None = None
    channels: tuple[Address, ...] = ANALOGUE_INPUTS
    counts_per_unit: tuple[float | None, ...] = (None,) * CHANNELS
    excitation: Address | None = None
    strict_pdo: bool = False
    simulates_excitation: bool = True

    def load_dictionary(self, node_id: int) -> ObjectDictionary:
        """Load the EDS. Raises ValueError if it is unreadable, or has no TPDO or one beyond 64 bits."""
        dictionary = eds.load_eds(self.eds, node_id)
        tpdos = eds.default_tpdos(dictionary)
        if not tpdos:
            raise ValueError(f"{self.eds}: has no TPDO (object 0x1800 and up) that could carry the channels")
        for tpdo in tpdos:
            bits = sum(entry[2] for entry in tpdo.entries)
            if bits > 64:
                raise ValueError(f"{self.eds}: TPDO{tpdo.number} maps {bits} bits, 64 fit into a frame")
        return dictionary

    def write_identity(self, objects: ObjectValues) -> None:
        """Make the identity the default of its objects."""
        for sub, value in ((1, self.vendor_id), (2, self.product_code), (cia301.SERIAL_SUB, self.serial)):
            if value is not None:
                objects.set_default(cia301.IDENTITY, sub, value)

    def find_excitation(self, objects: ObjectValues) -> Address | None:
        """Return the object that switches the excitation. Raises ValueError if it isn't in the EDS."""
        if self.excitation is None:
            variable = objects.find_variable(*_DEFAULT_EXCITATION)  # another vendor may use it otherwise
            is_switch = variable is not None and "excitation" in variable.name.lower()
            return _DEFAULT_EXCITATION if is_switch else None
        if objects.integer_type(*self.excitation) is None:
            index, sub = self.excitation
            raise ValueError(f"{self.eds}: has no integer 0x{index:04X}:{sub:02X} to switch the excitation")
        return self.excitation

    def channel_limits(self, objects: ObjectValues) -> ChannelLimits:
        """Return the minimum and maximum count of each channel: what its TPDO carries of its object.

        Raises ValueError for unsuitable objects.
        """
        if (
            len(set(self.channels)) != len(self.channels)
            or not MIN_CHANNELS <= len(self.channels) <= MAX_CHANNELS
        ):
            raise ValueError(
                f"channels must be {MIN_CHANNELS} to {MAX_CHANNELS} different objects, got {self.channels}"
            )
        tpdos = eds.default_tpdos(objects.object_dictionary)
        carried = {(index, sub): bits for tpdo in tpdos for index, sub, bits in tpdo.entries}
        limits = []
        for index, sub in self.channels:
            kind = REAL32[:2] if objects.is_real32(index, sub) else objects.integer_type(index, sub)
            if kind is None:
                raise ValueError(
                    f"{self.eds}: has no integer or REAL32 0x{index:04X}:{sub:02X} to carry a channel; "
                    "name the objects of the channels in `channels`"
                )
            bits, signed = kind
            limits.append(integer_limits(min(bits, carried.get((index, sub), bits)), signed))
        return limits
