"""Lines of the daemon's scenes for `handtouch scene` and `status`: what is computed and for which client.

Public names: `scene_lines`.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

_MAX_NAMES = 4


def scene_lines(answer: Mapping[str, Any]) -> Iterator[str]:
    """Format the daemon's answer to `scene`: active scenes, then pads grouped by their outputs."""
    for scene in answer["scenes"]:
        rate = "every SYNC" if scene["rate_hz"] is None else f"{scene['rate_hz']:g} Hz"
        lease = "" if scene["lease_s"] is None else f"; expires in {scene['lease_s']:.0f} s"
        yield (
            f"scene of {scene['owner']}: links {', '.join(scene['links']) or 'none'}; "
            f"{', '.join(scene['outputs']) or 'touched only'}; {rate}{lease}"
        )
    alike: dict[tuple[str, ...], list[str]] = {}
    for pad in answer["pads"]:
        alike.setdefault(_pad_text(pad), []).append(f"{pad['hand']}/{pad['link']}")
    for (computed, not_computed, clients), names in alike.items():
        shown = ", ".join(names[:_MAX_NAMES]) + (
            f" and {len(names) - _MAX_NAMES} more" if len(names) > _MAX_NAMES else ""
        )
        yield f"{shown}: computed {computed}{clients}{not_computed}"


def _pad_text(pad: Mapping[str, Any]) -> tuple[str, ...]:
    reasons: dict[str, list[str]] = {}
    for output, reason in pad["not_computed"].items():
        reasons.setdefault(reason, []).append(output)
    not_computed = "; ".join(f"{', '.join(outputs)} ({reason})" for reason, outputs in reasons.items())
    rate = f" at {pad['rate_hz']:g} Hz" if pad["computed"] else ""
    clients = [*pad["scenes"], *(f"subscriber to {prefix or 'all'}" for prefix in pad["subscriptions"])]
    return (
        (", ".join(pad["computed"]) or "nothing") + rate,
        f"; not computed {not_computed}" if not_computed else "",
        f", for {', '.join(clients)}" if clients and pad["computed"] else "",
    )
