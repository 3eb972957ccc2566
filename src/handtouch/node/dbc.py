"""Raw CAN frames described by a DBC file, for hands whose sensors speak CAN but not CANopen.

Public names: `DbcSource`, `DbcReader`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Literal, cast

import can
import numpy as np
from pydantic import Field

from handtouch.canbus.bus.port import BusError, open_bus
from handtouch.canbus.bus.receivers import arrival_ns
from handtouch.config.problems import suggest_name
from handtouch.config.tables import Bus
from handtouch.node.adc_fault import AdcError, AdcFaultKind
from handtouch.node.iio import AdcReading
from handtouch.node.source import Source, SourceReader

if TYPE_CHECKING:
    from cantools.database import Database, Message, Signal

_MAX_FRAMES = 1000  # read at a time
_MAX_SPAN_PERIODS = 0.5
"""Between the frames of one sample: more is a frame of the sample before, where one was lost"""


class DbcSource(Source):
    """`[source.NAME]` with `kind = "dbc"`: signals of CAN frames. Each pad has a socket of its own."""

    is_shared: ClassVar[bool] = False

    kind: Literal["dbc"] = Field(description="signals of CAN frames, as a DBC file describes them")
    file: str = Field(
        min_length=1,
        description="DBC file (or KCD, SYM, ARXML), relative to this one",
        examples=["hand.dbc"],
    )
    interface: str = Field("socketcan", description="python-can interface of the hand's bus")
    channel: str | int = Field(description="python-can channel", examples=["can1"])
    options: dict[str, str | int | float | bool] = Field(
        default_factory=dict,
        description="further options of python-can's interface",
        examples=[{"port": 43114}],
    )

    def problem_of(self, channel: str, folder: Path) -> str:
        """Return why a pad can't have this channel; empty if it can."""
        try:
            _find_signal(_load_database(folder / self.file), channel)
        except (ImportError, OSError, ValueError) as error:
            return str(error)
        return ""

    def limits_of(self, channel: str, folder: Path) -> tuple[float, float]:
        """Return the lowest and highest value of a signal, in its unit; infinite for a float."""
        return self.limits or _signal_limits(_find_signal(_load_database(folder / self.file), channel)[1])

    def make_reader(self, channels: Sequence[str], folder: Path, clock: Callable[[], int]) -> DbcReader:
        """Return a reader of these signals."""
        return DbcReader(self, channels, folder, clock)


@lru_cache
def _load_database(path: Path) -> Database:
    """Load a file. Raises ImportError, OSError and ValueError with the remedy."""
    try:
        import cantools
    except ImportError as error:
        raise ImportError(
            "needs cantools: pip install cantools, or handtouch with the extra `dbc`"
        ) from error
    try:
        return cantools.database.load_file(path, strict=True)  # type: ignore[return-value]
    except OSError as error:
        raise OSError(f"file {path}: {error.strerror}; give the path of the DBC file") from error
    except cantools.Error as error:
        raise ValueError(f"file {path}: {str(error).splitlines()[0]}") from error


def _find_signal(database: Database, channel: str) -> tuple[Message, Signal]:
    """Return the signal of a name SIGNAL or MESSAGE.SIGNAL. Raises ValueError."""
    message_name, _, name = channel.rpartition(".")
    found = [
        (message, signal)
        for message in database.messages
        for signal in message.signals
        if signal.name == name and message_name in ("", message.name)
    ]
    if len(found) == 1:
        return found[0]
    if found:
        names = ", ".join(f"{message.name}.{name}" for message, _ in found)
        raise ValueError(f"several messages have it: give one of {names}")
    known = [f"{message.name}.{signal.name}" for message in database.messages for signal in message.signals]
    shown = ", ".join(known[:8]) + (f" and {len(known) - 8} more" if len(known) > 8 else "")
    raise ValueError(f"{suggest_name(channel, known)}the file has {shown or 'no signal'}")


_Key = tuple[int, bool]
"""Of a message: its identifier, and whether that has 29 bits."""


class DbcReader(SourceReader):
    """Reads the signals of one pad: a sample is complete when each of them has come since the last.

    Times are the kernel's receive stamps; malformed are frames of a known identifier without such signals.
    """

    unit: ClassVar[str] = "frames"

    def __init__(
        self, source: DbcSource, channels: Sequence[str], folder: Path, clock: Callable[[], int]
    ) -> None:
        super().__init__(source, channels, folder, clock)
        self._source = source
        self._max_span_ns = round(_MAX_SPAN_PERIODS * 1e9 / source.rate_hz)
        self._bus: can.BusABC | None = None
        self._messages: dict[_Key, Message] = {}
        self._places: dict[_Key, list[tuple[int, str]]] = {}
        database = _load_database(folder / source.file)
        for row, channel in enumerate(channels):
            message, signal = _find_signal(database, channel)
            key = message.frame_id, message.is_extended_frame
            self._messages[key] = message
            self._places.setdefault(key, []).append((row, signal.name))
        self._values = np.zeros(len(channels))
        self._stamps_ns = np.zeros(len(channels), np.int64)  # of the frames of the next sample, 0 without

    def open(self) -> None:
        """Open the bus with a filter for the pad's messages. Raises AdcError."""
        source = self._source
        try:
            self._bus = open_bus(
                Bus(name="source", interface=source.interface, channel=source.channel, options=source.options)
            )
        except BusError as error:
            raise AdcError(AdcFaultKind.FILE_MISSING, str(error)) from error
        if source.interface == "socketcan":  # in the kernel; elsewhere `recv` ends at a frame that it filters
            filters: Any = [
                {"can_id": number, "can_mask": 0x1FFFFFFF if extended else 0x7FF, "extended": extended}
                for number, extended in self._messages
            ]
            self._bus.set_filters(filters)
        self._stamps_ns[:] = 0
        self._begin()

    def receive(self) -> None:
        """Read the frames that have arrived. Raises AdcError."""
        if self._bus is None:
            return
        try:
            for _ in range(_MAX_FRAMES):
                frame = self._bus.recv(0.0)
                if frame is None:
                    return
                self._take(frame)
        except (can.CanError, OSError) as error:
            raise AdcError(AdcFaultKind.READ_FAILED, f"{self._source.channel}: {error}") from error

    def close(self) -> None:
        """Close the bus."""
        if self._bus is not None:
            self._bus.shutdown()
            self._bus = None

    def _missing(self) -> str:
        missing = [channel for channel, ns in zip(self._channels, self._stamps_ns, strict=True) if not ns]
        return f"{self._source.channel}: no frame with {', '.join(missing)}"

    def _take(self, frame: can.Message) -> None:
        key = frame.arbitration_id, frame.is_extended_id
        message = self._messages.get(key)
        if message is None or frame.is_error_frame or frame.is_remote_frame:
            return
        try:
            decoded: Any = message.decode(bytes(frame.data), decode_choices=False)
            found = [(row, float(decoded[name])) for row, name in self._places[key] if name in decoded]
        except Exception:  # noqa: BLE001 - cantools and bitstruct raise several kinds for short frames
            self.malformed += 1
            return
        stamp_ns = arrival_ns(frame, self._clock())
        for row, value in found:  # a multiplexed signal comes in another frame of this message
            self._values[row], self._stamps_ns[row] = value, stamp_ns
        self._stamps_ns[self._stamps_ns < stamp_ns - self._max_span_ns] = 0
        if not self._stamps_ns.all():
            return
        first_ns, last_ns = int(self._stamps_ns.min()), int(self._stamps_ns.max())
        self._keep(AdcReading(self._values.copy(), last_ns, last_ns - first_ns))
        self._stamps_ns[:] = 0


def _signal_limits(signal: Signal) -> tuple[float, float]:
    """Return the ends of a signal's range, in its unit."""
    if signal.is_float:
        return -np.inf, np.inf
    bits = signal.length
    low, high = (-(1 << bits - 1), (1 << bits - 1) - 1) if signal.is_signed else (0, (1 << bits) - 1)
    ends = sorted(float(cast("float", signal.raw_to_scaled(end, False))) for end in (low, high))
    return ends[0], ends[1]
