"""What is computed, what is skipped and for whom, in lines for people; for `handtouch scene` and `status`.

Public names: `scene_lines`.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

_FEW = 4


def scene_lines(told: Mapping[str, Any]) -> Iterator[str]:
    """Lines for the daemon's answer to `scene`: the scenes in force, then pads that fare alike together."""
    for scene in told["scenes"]:
        rate = "every SYNC" if scene["rate_hz"] is None else f"{scene['rate_hz']:g} Hz"
        within = f", within {scene['tolerance_mm']:g} mm" if scene["tolerance_mm"] else ""
        lease = "" if scene["lease_s"] is None else f", for another {scene['lease_s']:.0f} s"
        yield (
            f"scene of {scene['of']}: links {', '.join(scene['links']) or 'none'}; "
            f"{', '.join(scene['outputs']) or 'touched only'}{within}; {rate}{lease}"
        )
    alike: dict[tuple[str, ...], list[str]] = {}
    for pad in told["pads"]:
        alike.setdefault(_fare(pad), []).append(f"{pad['hand']}/{pad['link']}")
    for (computed, skipped, whom), names in alike.items():
        few = ", ".join(names[:_FEW]) + (f" and {len(names) - _FEW} more" if len(names) > _FEW else "")
        yield f"{few}: computed {computed}{whom}{skipped}"


def _fare(pad: Mapping[str, Any]) -> tuple[str, ...]:
    whys: dict[str, list[str]] = {}
    for output, why in pad["skipped"].items():
        whys.setdefault(why, []).append(output)
    skipped = "; ".join(f"{', '.join(outputs)} ({why})" for why, outputs in whys.items())
    rate = f" at {pad['rate_hz']:g} Hz" if pad["computed"] else ""
    whom = [*pad["scenes"], *(f"subscriber to {prefix or 'all'}" for prefix in pad["subscriptions"])]
    return (
        (", ".join(pad["computed"]) or "nothing") + rate,
        f"; skipped {skipped}" if skipped else "",
        f", for {', '.join(whom)}" if whom and pad["computed"] else "",
    )
