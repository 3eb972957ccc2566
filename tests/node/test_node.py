"""A node samples at SYNC, names failures of its ADC by EMCY, and recovers from each."""

from __future__ import annotations

import errno
import json
import os
import struct
import subprocess
import time
from pathlib import Path
from typing import Any

import can
import pytest

from handtouch.canbus import cia305
from handtouch.node.adc_fault import AdcError, AdcFaultKind
from handtouch.node.excitation import GET_LINE, LINE_REQUEST, LINE_VALUES, SET_VALUES, GpioLine
from handtouch.node.identity_store import IdentityStore
from handtouch.node.iio import IioDevice
from handtouch.node.noise import measure_noise
from handtouch.node.settings import load
from tests.node.conftest import NodeBench
from tests.node.stand_in import AdcStandIn, raw_of_ma

MS = 1_000_000
FREE = "mode = 'buffered'\nrate_hz = 1000\nbuffer_scans = 100"
TRIGGERED = "mode = 'buffered'\ntrigger = 'at-sync'\ntimeout_ms = 1000.0"


def emergencies(frames: list[tuple[int, bytes]]) -> list[tuple[int, int, int, int, int]]:
    """(error code, register, kind, channels, errno) of the EMCY messages of node 5."""
    return [struct.unpack("<HBBBHx", data) for identifier, data in frames if identifier == 0x85]


def counts_of_ma(currents: list[float]) -> tuple[int, ...]:
    return tuple(round(value / 10.0 * 32767) for value in currents)


def test_boot_up_and_a_sample_at_sync_have_the_calibrated_currents(bench: Any) -> None:
    bench.adc.set_raw(raw_of_ma([1.0, 2.0, -0.5, 4.0]))
    trim = bench.folder / "trim.toml"
    trim.write_text("gain = [1.0, 1.0, 1.0, 0.5]\noffset_ma = [0.5, 0.0, 0.0, 0.0]\n")
    bench.start(pad="trim = 'trim.toml'")
    assert bench.counts() == pytest.approx(counts_of_ma([0.5, 2.0, -0.5, 2.0]), abs=1)
    assert bench.read_object(0x1018, 4) == 77
    assert bench.read_object(0x6401, 4) == pytest.approx(counts_of_ma([2.0])[0], abs=1)


@pytest.mark.parametrize("count", [3, 6])
def test_a_pad_may_have_another_number_of_channels(tmp_path: Path, count: int) -> None:
    adc = AdcStandIn(tmp_path, channels=count)
    bench = NodeBench(tmp_path, adc)
    try:
        currents_ma = [1.0, 2.0, 3.0, 4.0, 5.0, 6.0][:count]
        adc.set_raw(raw_of_ma(currents_ma))
        channels = ", ".join(f'"voltage{k}"' for k in range(count))
        bench.start(
            pad=f'[[pad]]\nname = "tip"\nnode_id = 5\nserial = 77\nadc = "main"\ngain_ohm = -240.0\n'
            f"channels = [{channels}]"
        )
        bench.sync()
        read = [bench.read_object(0x6401, sub + 1) for sub in range(count)]
        assert read == pytest.approx(counts_of_ma(currents_ma), abs=1)
        adc.set_raw([*raw_of_ma(currents_ma[:-1]), 1 << 30])
        emergencies = [data for _ in range(5) for identifier, data in bench.sync() if identifier == 0x85]
        assert [data[4] for data in emergencies] == [1 << count - 1]
    finally:
        bench.service.close()
        adc.close()


def test_five_channels_of_12_bits_are_in_one_tpdo(tmp_path: Path) -> None:
    adc = AdcStandIn(tmp_path, channels=5)
    bench = NodeBench(tmp_path, adc)
    try:
        adc.set_raw([*raw_of_ma([1.0, 2.0, -3.0, 4.0]), 1 << 30])
        channels = ", ".join(f'"voltage{k}"' for k in range(5))
        bench.start(
            pad=f'[[pad]]\nname = "tip"\nnode_id = 5\nserial = 77\nadc = "main"\ngain_ohm = -240.0\n'
            f"bits = 12\nchannels = [{channels}]"
        )
        frames = bench.sync()
        assert [(identifier, len(data)) for identifier, data in frames] == [(0x285, 8)]
        word = int.from_bytes(frames[0][1], "little")
        counts = [(word >> 12 * k & 0xFFF ^ 0x800) - 0x800 for k in range(5)]
        assert counts == pytest.approx([205, 409, -614, 819, -2048], abs=1)
        assert word >> 60 == 0
        emergencies = [data for _ in range(5) for identifier, data in bench.sync() if identifier == 0x85]
        assert [data[4] for data in emergencies] == [1 << 4]
    finally:
        bench.service.close()
        adc.close()


def test_offset_and_scale_of_iio_may_be_shared_by_all_channels(bench: Any) -> None:
    for channel in range(4):
        (bench.adc.folder / f"in_voltage{channel}_scale").unlink()
    bench.adc.write("in_voltage_scale", "0.24")
    bench.adc.write("in_voltage2_offset", "-1000")
    bench.adc.set_raw([-1000, 0, 0, 0])
    bench.start()
    assert bench.counts() == (counts_of_ma([1.0])[0], 0, counts_of_ma([1.0])[0], 0)


def test_a_freely_running_adc_gives_the_mean_of_its_newest_scans(bench: Any) -> None:
    bench.start(FREE + "\naverage_scans = 2")
    bench.take()
    for number in range(10):
        bench.t_ns += MS
        bench.adc.push(raw_of_ma([0.1 * number] * 4), bench.t_ns)
    assert bench.adc.read("buffer/enable") == "1"
    assert [bench.adc.read(f"scan_elements/in_{name}_en") for name in ("voltage0", "timestamp")] == ["1", "1"]
    assert bench.adc.read("current_timestamp_clock") == "monotonic"
    bench.t_ns -= 5 * MS  # so that SYNC comes with the last scan
    assert bench.counts() == pytest.approx(counts_of_ma([0.85] * 4), abs=1)
    summary = bench.service.sampling.adcs[0].timing.summary()
    assert (summary.mean_s, summary.span_s) == pytest.approx((-0.0005, 0.001), abs=1e-9)


def test_sync_starts_the_conversion_with_a_trigger_of_iio_trig_sysfs(bench: Any) -> None:
    bench.adc.add_trigger("at-sync", lambda: raw_of_ma([0.5, 0.25, 0.125, bench.adc.triggered * 1e-3]))
    bench.t_ns = time.monotonic_ns()  # as the stand-in stamps scans
    bench.start(TRIGGERED)
    triggered = bench.adc.triggered
    bench.adc.push(raw_of_ma([9.0] * 4), 1)  # an old scan
    bench.t_ns = time.monotonic_ns() - 5 * MS
    assert bench.counts() == pytest.approx(counts_of_ma([0.5, 0.25, 0.125, (triggered + 1) * 1e-3]), abs=1)
    assert bench.adc.triggered == triggered + 1


def test_an_adc_without_time_stamps_is_used_and_that_is_reported(tmp_path: Path, bench: Any) -> None:
    old = AdcStandIn(tmp_path, 1, has_time=False)
    text = bench.write(FREE).read_text().replace('"adc0"', '"adc1"')
    (bench.folder / "node.toml").write_text(text)
    bench.write = lambda *_: bench.folder / "node.toml"
    bench.start()
    old.push(raw_of_ma([1.0] * 4), 0)
    assert bench.counts() == pytest.approx(counts_of_ma([1.0] * 4), abs=1)
    assert "there are no time stamps" in bench.service.status()
    bench.service.close()
    old.close()


@pytest.mark.parametrize(
    ("break_it", "mend", "kind", "number"),
    [
        ("unlink", "set_raw", AdcFaultKind.FILE_MISSING, errno.ENOENT),
        ("empty", "set_raw", AdcFaultKind.SHORT_READ, 0),
        ("garbage", "set_raw", AdcFaultKind.READ_FAILED, 0),
    ],
)
def test_failures_of_a_sysfs_file_are_named_and_end(
    bench: Any, break_it: str, mend: str, kind: AdcFaultKind, number: int
) -> None:
    bench.adc.set_raw([0] * 4)
    bench.start()
    assert bench.counts() == (0, 0, 0, 0)
    path = bench.adc.folder / "in_voltage2_raw"
    if break_it == "unlink":
        path.unlink()
    else:
        path.write_text({"empty": "", "garbage": "busy\n"}[break_it])
    frames = bench.sync()
    assert emergencies(frames) == [(0x5000, 0x81, kind, 0b1111, number)]
    assert bench.counts() is None  # no old value passes for a new one
    assert bench.read_object(0x1001, 0) == 0x81
    getattr(bench.adc, mend)([0] * 4)
    assert emergencies(bench.run(1200)) == [(0, 0, kind, 0, 0)]
    assert bench.counts() == (0, 0, 0, 0)
    assert bench.read_object(0x1001, 0) == 0


@pytest.mark.parametrize(
    ("number", "kind"),
    [
        (errno.EBUSY, AdcFaultKind.BUSY),
        (errno.ENODEV, AdcFaultKind.FILE_MISSING),
        (errno.ENXIO, AdcFaultKind.FILE_MISSING),
        (errno.EIO, AdcFaultKind.READ_FAILED),
        (errno.ETIMEDOUT, AdcFaultKind.READ_FAILED),
    ],
)
def test_kinds_of_failed_system_calls(number: int, kind: AdcFaultKind) -> None:
    error = AdcError.of_os_error("/sys/x", OSError(number, os.strerror(number)))
    assert (error.kind, error.number) == (kind, number)
    assert str(error).startswith(f"{kind.text}: /sys/x: ")


def test_an_overrun_is_named_and_the_next_scan_is_used(bench: Any) -> None:
    bench.start(FREE)
    bench.adc.push([0] * 4, bench.t_ns)
    bench.run(1)
    for _ in range(100):
        bench.adc.push(raw_of_ma([9.0] * 4), bench.t_ns)
    kinds = [emergency[2] for emergency in emergencies(bench.sync())]
    assert kinds == [AdcFaultKind.OVERRUN]
    bench.adc.push([0] * 4, bench.t_ns + 5 * MS)
    bench.sync()  # opens it again
    bench.adc.push([0] * 4, bench.t_ns + 5 * MS)
    assert bench.counts() == (0, 0, 0, 0)


def test_part_of_a_scan_is_a_short_read_and_the_next_scans_are_whole(bench: Any) -> None:
    bench.start(FREE)
    bench.adc.push_bytes(b"12345")
    kinds = [emergency[2] for emergency in emergencies(bench.sync())]
    assert kinds == [AdcFaultKind.SHORT_READ]
    bench.sync()
    bench.adc.push(raw_of_ma([1.0] * 4), bench.t_ns + 5 * MS)
    assert bench.counts() == pytest.approx(counts_of_ma([1.0] * 4), abs=1)


def test_an_adc_that_stops_converting_is_named(bench: Any) -> None:
    bench.start(FREE)
    bench.adc.push([0] * 4, bench.t_ns + 5 * MS)
    assert bench.counts() == (0, 0, 0, 0)
    assert bench.counts() is not None  # 5 ms old
    assert bench.counts() is None  # too old for a sample
    kinds = [emergency[2] for emergency in emergencies([frame for _ in range(20) for frame in bench.sync()])]
    assert kinds == [AdcFaultKind.NO_CONVERSION]


def test_saturated_channels_are_reported_and_still_sent(bench: Any) -> None:
    bench.start()
    bench.adc.set_raw([-(1 << 23), 0, 0, 0])
    frames = [frame for _ in range(4) for frame in bench.sync()]
    assert emergencies(frames) == [(0x2100, 0x03, AdcFaultKind.SATURATED, 0b0001, 0)]
    assert bench.counts() is not None
    bench.adc.set_raw([0] * 4)
    frames = [frame for _ in range(210) for frame in bench.sync()]
    assert emergencies(frames) == [(0, 0, AdcFaultKind.SATURATED, 0, 0)]


def test_an_adc_is_found_by_its_label_where_two_have_one_name(adc: AdcStandIn, tmp_path: Path) -> None:
    second = AdcStandIn(tmp_path, 1)
    second.write("name", "adc0")
    assert adc.read("name") == second.read("name")
    with pytest.raises(AdcError, match='"adc0" is the name of iio:device0 and iio:device1; give the label'):
        IioDevice.find("adc0", second.sysfs)
    second.write("label", "index")
    assert IioDevice.find("index", second.sysfs).folder == second.folder
    assert IioDevice.find(str(second.folder)).folder == second.folder
    second.close()


def test_a_node_boots_with_a_failed_adc_and_reports_it_after_each_reset(bench: Any) -> None:
    (bench.adc.folder / "in_voltage0_raw").unlink()
    assert [emergency[2] for emergency in emergencies(bench.start())] == [AdcFaultKind.FILE_MISSING]
    bench.send(0, bytes((130, 5)))
    assert [emergency[2] for emergency in emergencies(bench.run(100))] == [AdcFaultKind.FILE_MISSING]
    assert "tip 0x05 pre-operational (file missing)" in bench.service.status()


def test_a_vanished_device_is_found_again(bench: Any) -> None:
    bench.start()
    away = bench.folder / "away"
    bench.adc.folder.rename(away)
    frames = [frame for _ in range(100) for frame in bench.sync()]
    assert emergencies(frames) == [(0x5000, 0x81, AdcFaultKind.FILE_MISSING, 0b1111, errno.ENOENT)]
    away.rename(bench.adc.folder)
    bench.run(1200)
    assert bench.counts() == (0, 0, 0, 0)


def test_excitation_follows_object_2100_and_is_off_without_a_node(bench: Any) -> None:
    switch = bench.folder / "switch"
    bench.start(pad=f"excitation = {{ file = '{switch}' }}")
    bench.run(25)
    assert switch.read_text() == "1\n"
    bench.adc.set_raw(raw_of_ma([0.01] * 4))
    bench.send(0x605, bytes.fromhex("2F00210000000000"))
    bench.run(25)
    assert switch.read_text() == "0\n"
    assert bench.counts() == pytest.approx(
        counts_of_ma([0.01] * 4), abs=1
    )  # as measured: nothing is simulated
    bench.send(0x605, bytes.fromhex("2F00210001000000"))
    bench.run(25)
    bench.service.close()
    assert switch.read_text() == "0\n"


def test_a_failed_switch_is_named_and_samples_go_on(bench: Any) -> None:
    folder = bench.folder / "leds"
    frames = bench.start(pad=f"excitation = {{ file = '{folder}/brightness' }}")
    assert [emergency[2] for emergency in emergencies(frames)] == [AdcFaultKind.EXCITATION_FAILED]
    assert bench.counts() == (0, 0, 0, 0)
    folder.mkdir()
    assert emergencies(bench.run(30)) == [(0, 0, AdcFaultKind.EXCITATION_FAILED, 0, 0)]


def test_a_gpio_line_that_is_no_gpio_chip_is_a_named_failure(tmp_path: Path) -> None:
    (tmp_path / "gpiochip0").touch()
    with pytest.raises(AdcError, match=r"excitation failed: .*gpiochip0 line 3: Inappropriate ioctl"):
        GpioLine(str(tmp_path / "gpiochip0"), 3).set(True)


def test_structures_of_the_gpio_ioctls_are_those_of_the_kernels_header(tmp_path: Path) -> None:
    source = tmp_path / "gpio.c"
    source.write_text(
        "#include <linux/gpio.h>\n#include <stdio.h>\n#include <stddef.h>\nint main(void) {\n"
        'printf("%u %u %zu %zu %zu %zu %zu %zu", GPIO_V2_GET_LINE_IOCTL, GPIO_V2_LINE_SET_VALUES_IOCTL,\n'
        "sizeof(struct gpio_v2_line_request), sizeof(struct gpio_v2_line_values),\n"
        "offsetof(struct gpio_v2_line_request, consumer),\n"
        "offsetof(struct gpio_v2_line_request, config.attrs),\n"
        "offsetof(struct gpio_v2_line_request, num_lines), offsetof(struct gpio_v2_line_request, fd)); }\n"
    )
    done = subprocess.run(["cc", str(source), "-o", str(tmp_path / "gpio")], capture_output=True, check=False)
    if done.returncode:
        assert os.environ.get("CI") != "true", "CI needs a C compiler and linux/gpio.h (linux-libc-dev)"
        pytest.skip("no C compiler, or no linux/gpio.h")
    printed = subprocess.run([str(tmp_path / "gpio")], capture_output=True, text=True, check=True).stdout
    # every field of the packed request has its own value; the offset of each is where that value lies
    packed = LINE_REQUEST.pack(*range(64), b"consumer", 1, 2, b"attributes", 3, 4, 5)
    offsets = [packed.rindex(part) for part in (b"consumer", b"attributes", struct.pack("=II", 3, 4))]
    own = [GET_LINE, SET_VALUES, LINE_REQUEST.size, LINE_VALUES.size, *offsets, LINE_REQUEST.size - 4]
    assert printed.split() == [str(number) for number in own]


def test_after_a_pause_only_the_newest_sync_is_answered(bench: Any) -> None:
    bench.start()
    for identifier, data in ((0x80, b""), (0x605, bytes.fromhex("4018100400000000")), (0x80, b"")):
        bench.wire.incoming.append(can.Message(arbitration_id=identifier, data=data, is_extended_id=False))
    bench.service.poll(0.0)
    assert [identifier for identifier, _ in bench.take()] == [0x585, 0x285]
    assert bench.service.status().endswith("; 1 SYNCs missed in pauses")


def test_an_id_assigned_by_lss_is_kept_over_a_restart(bench: Any) -> None:
    bench.start()
    address = (0, 0x401, 0x10000, 77)
    for command, value in zip(cia305.SELECT, address, strict=True):
        answer = bench.send(0x7E5, struct.pack("<BI3x", command, value))
    assert answer == [(0x7E4, bytes([cia305.SELECTED]) + bytes(7))]
    bench.send(0x7E5, bytes((cia305.CONFIGURE_ID, 9)) + bytes(6))
    assert bench.send(0x7E5, bytes([cia305.STORE]) + bytes(7)) == [(0x7E4, bytes([cia305.STORE]) + bytes(7))]
    bench.service.close()
    bench.start()
    assert bench.send(0, bytes((130, 9)))[0] == (0x709, b"\0")


def test_a_pad_without_an_id_is_silent_until_lss_assigns_one(bench: Any) -> None:
    path = bench.write()
    path.write_text(path.read_text().replace("node_id = 5\n", ""))
    bench.write = lambda *_: path
    assert bench.start() == []
    assert "tip no node id" in bench.service.status()
    bench.send(0x7E5, bytes((cia305.SWITCH_GLOBAL, 1)) + bytes(6))
    bench.send(0x7E5, bytes((cia305.CONFIGURE_ID, 9)) + bytes(6))
    assert bench.send(0x7E5, bytes((cia305.SWITCH_GLOBAL, 0)) + bytes(6)) == [(0x709, b"\0")]


def test_an_id_that_cannot_be_stored_is_refused_by_lss(bench: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    bench.start()

    def fail(*_: object) -> None:
        raise OSError(errno.EROFS, "Read-only file system")

    monkeypatch.setattr(os, "fsync", fail)
    bench.send(0x7E5, bytes((cia305.SWITCH_GLOBAL, 1)) + bytes(6))
    bench.send(0x7E5, bytes((cia305.CONFIGURE_ID, 9)) + bytes(6))
    assert bench.send(0x7E5, bytes([cia305.STORE]) + bytes(7)) == [
        (0x7E4, bytes([cia305.STORE, 1]) + bytes(6))
    ]


def test_a_serial_number_is_drawn_once_and_kept(tmp_path: Path) -> None:
    path = tmp_path / "new" / "state.json"
    stores = [IdentityStore(path) for _ in range(2)]
    for store in stores:
        store.load()
    first = stores[0].identity("tip", None, None)
    again = IdentityStore(path)
    again.load()
    assert again.identity("tip", None, None) == first
    assert first.serial > 0
    assert stores[1].identity("tip", None, None).serial != first.serial
    path.write_text(json.dumps({"tip": {"serial": "x"}}))
    with pytest.raises(ValueError, match=r"state\.json: is damaged"):
        again.load()


def test_only_frames_for_nodes_pass_the_kernels_filter(bench: Any) -> None:
    bench.start()
    identifiers = [
        identifier
        for identifier in range(0x800)
        if any((identifier ^ f["can_id"]) & f["can_mask"] == 0 for f in bench.wire.filters)
    ]
    assert {0x000, 0x080, 0x7E5} <= set(identifiers)
    assert not set(identifiers) & set(range(0x181, 0x600))


def test_time_from_sync_to_sample_counts_from_the_kernels_receive_stamp(bench: Any) -> None:
    bench.t_ns = time.monotonic_ns()
    bench.start()
    bench.t_ns = time.monotonic_ns()
    late = can.Message(arbitration_id=0x80, timestamp=time.time() - 0.004, is_extended_id=False)
    bench.wire.incoming.append(late)
    bench.service.poll(0.0)
    summary = bench.service.sampling.adcs[0].timing.summary()
    assert summary.samples == 1
    assert 0.003 < summary.mean_s < 0.5


def test_noise_of_known_samples_is_measured(bench: Any) -> None:
    """Values that alternate by two counts around their mean have a standard deviation of one count."""
    step_ma = 10.0 / 32767
    path = bench.write()
    calls = 0

    def advance(_seconds: float) -> None:
        nonlocal calls
        calls += 1
        bench.adc.set_raw(raw_of_ma([1.0 + (-1) ** calls * step_ma, 2.0, 0.0, 0.0]))

    (noise,) = measure_noise(load(path), 1000, 0.0, advance)
    assert noise.std_counts == pytest.approx([1.0, 0.0, 0.0, 0.0], abs=0.02)
    assert noise.mean_ma == pytest.approx([1.0, 2.0, 0.0, 0.0], abs=1e-5)
    assert noise.std_ma[0] == pytest.approx(step_ma, rel=0.02)
