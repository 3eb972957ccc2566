"""Latency over an hour at 200 Hz and 1 kHz, beside `cyclictest`.

Nodes, daemon and subscriber as in [latency](latency.md), 5 of 15 pads touched by sliding contacts, with
real-time settings where this user may have them. *Last frame to subscriber*: the daemon's latency in every
period; it starts again every 60,000. *cyclictest*: how late the same machine wakes a thread of that priority
that does nothing, in as many periods; where it is installed.
"""

from __future__ import annotations

from benchmarks.bench_latency import RATES_HZ, distribution
from benchmarks.page import Report, options
from benchmarks.served_hand import VCAN, in_own_network


def main() -> None:
    parser = options(__doc__)
    parser.add_argument("--minutes", type=float, default=60.0, help="of each rate")
    asked = parser.parse_args()
    if not VCAN.exists():
        in_own_network()
    minutes = 0.02 if asked.quick else asked.minutes
    report = Report(asked.quick, "socketcan" if VCAN.exists() else "udp_multicast", minutes_of_a_rate=minutes)
    report.table("By rate", [row for rate_hz in RATES_HZ for row in distribution(rate_hz, 60 * minutes)])
    report.keep()


if __name__ == "__main__":
    main()
