"""Files that stand in for the kernel's: an IIO device in sysfs, its character device, and its triggers.

The files are real; a FIFO takes the place of /dev/iio:deviceN, and another one that of trigger_now, at which
a thread waits as the kernel does. A node without parts: `python -m tests.node.stand_in FOLDER --deployment
FILE` makes such files for the pads of a deployment, and FOLDER/node.toml. Each line LINK X Y MA [S] on its
standard input is a press: fractions of the pad's sides from x0 and y0, the current, and how long (0.5 s).
"""

from __future__ import annotations

import argparse
import contextlib
import os
import struct
import sys
import threading
import time
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path

import numpy as np
import numpy.typing as npt

from handtouch import config
from handtouch.hand import electrode_network

FULL_SCALE_MA, GAIN_OHM, NOISE_MA = 10.0, -240.0, 0.0003
PRESS_S = 0.5
SCALE_MV = 2400 / (1 << 23)  # 24 bits, reference of 2.4 V


class AdcStandIn:
    """One ADC of `channels` channels of 24 bits as the driver ads131e08 has them (be:s24/32>>8)."""

    def __init__(self, folder: Path, number: int = 0, channels: int = 4, *, has_time: bool = True) -> None:
        self.sysfs, self.devices = folder / "sysfs", folder / "dev"
        self.folder = self.sysfs / f"iio:device{number}"
        self.name, self.channels, self.has_time = f"adc{number}", channels, has_time
        self.triggered = 0
        elements = self.folder / "scan_elements"
        for path in (elements, self.folder / "buffer", self.folder / "trigger", self.devices):
            path.mkdir(parents=True, exist_ok=True)
        self.write("name", self.name)
        self.write("sampling_frequency", "1000")
        self.write("current_timestamp_clock", "realtime")
        for attribute in ("buffer/enable", "buffer/length", "trigger/current_trigger"):
            self.write(attribute, "0")
        for channel in range(channels):
            self.write(f"in_voltage{channel}_raw", "0")
            self.write(f"in_voltage{channel}_scale", f"{SCALE_MV:.12f}")
            self._add_element(f"voltage{channel}", channel, "be:s24/32>>8")
        if has_time:
            self._add_element("timestamp", channels, "le:s64/64>>0")
        self.device = self.devices / self.folder.name
        os.mkfifo(self.device)
        self._queue = os.open(self.device, os.O_RDWR | os.O_NONBLOCK)  # it has a writer at all times
        self._triggers: list[tuple[Path, threading.Thread]] = []

    def write(self, attribute: str, text: str) -> None:
        """Replace an attribute as a whole."""
        path = self.folder / attribute
        new = path.with_name(path.name + ".new")
        new.write_text(f"{text}\n")
        new.replace(path)

    def read(self, attribute: str) -> str:
        return (self.folder / attribute).read_text().strip()

    def set_raw(self, values: Sequence[int]) -> None:
        for channel, value in enumerate(values):
            self.write(f"in_voltage{channel}_raw", str(value))

    def scan(self, values: Sequence[int], time_ns: int) -> bytes:
        """A scan of all channels, as the kernel packs it."""
        data = b"".join(struct.pack(">i", value << 8) for value in values)
        if not self.has_time:
            return data
        return data + bytes(-len(data) % 8) + struct.pack("<q", time_ns)

    def push(self, values: Sequence[int], time_ns: int) -> None:
        """Put a scan into the buffer; what doesn't fit is lost, as in the kernel."""
        try:
            os.write(self._queue, self.scan(values, time_ns))
        except BlockingIOError:
            return

    def push_bytes(self, data: bytes) -> None:
        os.write(self._queue, data)

    def add_trigger(self, name: str, values: Callable[[], Sequence[int]] | None = None) -> None:
        """A trigger; with `values` one of iio-trig-sysfs, each use of which puts a scan into the buffer."""
        folder = self.sysfs / f"trigger{len(list(self.sysfs.glob('trigger*')))}"
        folder.mkdir()
        (folder / "name").write_text(f"{name}\n")
        if values is not None:
            os.mkfifo(folder / "trigger_now")
            trigger = folder / "trigger_now"
            thread = threading.Thread(target=self._convert, args=(trigger, values), daemon=True)
            thread.start()
            self._triggers.append((trigger, thread))

    def close(self) -> None:
        for trigger, thread in self._triggers:
            trigger.write_bytes(b"end")
            thread.join(10)
        os.close(self._queue)

    def _add_element(self, channel: str, index: int, kind: str) -> None:
        for attribute, value in (("en", "0"), ("index", str(index)), ("type", kind)):
            self.write(f"scan_elements/in_{channel}_{attribute}", value)

    def _convert(self, trigger: Path, values: Callable[[], Sequence[int]]) -> None:
        with open(trigger, "rb+", buffering=0) as file:
            while (data := file.read(16)) != b"end":
                if data:
                    self.triggered += 1
                    self.push(values(), time.monotonic_ns())


def raw_of_ma(currents_ma: npt.ArrayLike) -> list[int]:
    """Raw values that the ADC reads for currents."""
    millivolts = np.asarray(currents_ma) * GAIN_OHM
    limit = 1 << 23
    return [int(raw) for raw in np.clip(np.rint(millivolts / SCALE_MV), -limit, limit - 1)]


def touch_ma(
    pad: config.Pad, sheet: config.Sheet, x: float, y: float, total_ma: float
) -> npt.NDArray[np.float64]:
    """Currents x0, xa, y0, yb of a touch at fractions of the pad's sides."""
    network = electrode_network(pad, sheet)
    return np.asarray(total_ma * network.fractions(x * network.a, y * network.b))


def node_text(deployment: config.Deployment, folder: Path, channel: str, *, more: str = "") -> str:
    """File of a node with all pads of a deployment, one-shot on one stand-in each."""
    bus = deployment.buses[0]
    lines = [
        f'sysfs = "{folder}/sysfs"\ndevices = "{folder}/dev"\n',
        f'[bus]\ninterface = "{bus.interface}"\nchannel = "{channel}"\n',
    ]
    for number, entry in enumerate(deployment.pads):
        pad = entry.pad
        lines += [
            f'[adc.adc{number}]\ndevice = "adc{number}"\n{more}',
            f'[[pad]]\nname = "{pad.link}"\nnode_id = {pad.node_id}\nserial = {pad.serial}\n'
            f'adc = "adc{number}"\nchannels = ["voltage0", "voltage1", "voltage2", "voltage3"]\n'
            f"gain_ohm = {GAIN_OHM}\nfull_scale_ma = {FULL_SCALE_MA}\n",
        ]
    return "\n".join(lines)


class Presses:
    """Presses on pads by lines LINK X Y MA [S]: fractions of the sides, current, duration."""

    def __init__(self, deployment: config.Deployment) -> None:
        self._pads = {entry.pad.link: number for number, entry in enumerate(deployment.pads)}
        self._deployment = deployment
        self._pressed: dict[int, tuple[npt.NDArray[np.float64], float]] = {}

    def read(self, lines: Iterable[str]) -> None:
        """Carry out lines as they come."""
        for line in lines:
            link, x, y, total_ma, *seconds = line.split()
            number = self._pads[link]
            pad = self._deployment.pads[number].pad
            sheet = self._deployment.sheets[pad.sheet]
            currents_ma = touch_ma(pad, sheet, float(x), float(y), float(total_ma))
            duration_s = float(seconds[0]) if seconds else PRESS_S
            self._pressed[number] = currents_ma, time.monotonic() + duration_s

    def currents_ma(self, number: int) -> npt.NDArray[np.float64]:
        """Currents of a pad at this time."""
        currents_ma, end_s = self._pressed.get(number, (np.zeros(4), 0.0))
        return currents_ma if time.monotonic() < end_s else np.zeros(4)


def play(
    adcs: Sequence[AdcStandIn], currents_ma: Callable[[int], npt.NDArray[np.float64]], seconds: float
) -> None:
    """Convert at 500 Hz, with noise."""
    noise = np.random.default_rng(1)
    end_s = time.monotonic() + seconds
    while time.monotonic() < end_s:
        for number, adc in enumerate(adcs):
            values = raw_of_ma(currents_ma(number) + noise.normal(0.0, NOISE_MA, 4))
            adc.set_raw(values)
            adc.push(values, time.monotonic_ns())
        time.sleep(0.002)


def main() -> None:
    """Carry out presses for the pads of a deployment, and write the node's file."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--deployment", type=Path, required=True)
    parser.add_argument("--mode", choices=("one-shot", "buffered"), default="one-shot")
    parser.add_argument("--seconds", type=float, default=float("inf"))
    options = parser.parse_args()
    deployment = config.load(options.deployment)
    adcs = [AdcStandIn(options.folder, number) for number in range(len(deployment.pads))]
    more = f'mode = "{options.mode}"\n'
    text = node_text(deployment, options.folder, str(deployment.buses[0].channel), more=more)
    (options.folder / "node.toml").write_text(text)
    print(options.folder / "node.toml", flush=True)
    presses = Presses(deployment)
    threading.Thread(target=presses.read, args=(sys.stdin,), daemon=True).start()
    with contextlib.suppress(KeyboardInterrupt):
        play(adcs, presses.currents_ma, options.seconds)


if __name__ == "__main__":
    main()
