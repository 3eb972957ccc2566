"""Roles of a node's channels: what each of them measures on its pad.

Public names: `ChannelRole`, `CHANNEL_ROLES`, `channel_numbers`, `column_channels`, `channel_count`.
A node's channels are those of one role after the other, in the order of `CHANNEL_ROLES`; the columns of the
core follow it, too."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

from handtouch.config.tables import SIDE_ELECTRODES, Pad


class ChannelRole(NamedTuple):
    """What channels of a pad measure.

    wired: names of a pad's channels in the order of its node's. columns: the same names in the order of the
    core's columns. text: names so many channels in messages.
    """

    text: str
    wired: Callable[[Pad], tuple[str, ...]]
    columns: Callable[[Pad], tuple[str, ...]]


def _shear_electrodes(pad: Pad) -> tuple[str, ...]:
    return tuple(pad.shear_electrodes) if pad.shear else ()


def _shear_columns(pad: Pad) -> tuple[str, ...]:
    return SIDE_ELECTRODES if pad.shear else ()


def _second_sheet(pad: Pad) -> tuple[str, ...]:
    return ("total",) if pad.second_sheet else ()


ELECTRODE, SHEAR, SECOND_SHEET = "electrode", "shear", "second_sheet"
CHANNEL_ROLES: dict[str, ChannelRole] = {
    ELECTRODE: ChannelRole("{} electrodes", lambda pad: pad.electrodes, lambda pad: pad.electrode_names),
    SHEAR: ChannelRole("its shear pad {}", _shear_electrodes, _shear_columns),
    SECOND_SHEET: ChannelRole("its second sheet {}", _second_sheet, _second_sheet),
}
"""Roles by name, in the order of a node's channels."""


def channel_numbers(pad: Pad, role: str) -> tuple[int, ...]:
    """Return the numbers of the node's channels of a role, in the order of the core's columns."""
    first = 0
    for name, one in CHANNEL_ROLES.items():
        wired = one.wired(pad)
        if name == role:
            return tuple(first + wired.index(column) for column in one.columns(pad))
        first += len(wired)
    raise KeyError(role)


def column_channels(pad: Pad) -> tuple[int, ...]:
    """Return the numbers of the node's channels of all roles, in the order of the core's columns."""
    return tuple(number for role in CHANNEL_ROLES for number in channel_numbers(pad, role))


def channel_count(pad: Pad) -> int:
    """Return the number of channels that a pad needs of its node."""
    return sum(len(role.wired(pad)) for role in CHANNEL_ROLES.values())
