"""Text of small deployments for tests: one virtual bus, one kind of node, one sheet, one hand `h`."""

from __future__ import annotations

PLANE = '{ kind = "plane", length_mm = 30.0, width_mm = 24.0 }'
CYLINDER = '{ kind = "cylinder", radius_mm = 10.0, length_mm = 30.0, arc_deg = 150.0 }'
TOUCH = """
begin_threshold_n = 0.1
end_threshold_n = 0.05
begin_samples = 2
end_samples = 2
"""


def deployment_text(
    *pads: str,
    daemon: str = "sync_period_ms = 5.0",
    channel: str = "test",
    full_scale_ma: float = 10.0,
    noise_counts: float = 1.0,
    contact_radius_mm: float = 2.5,
    contact_radius_std_mm: float = 0.5,
    touch: str = TOUCH,
) -> str:
    """Return the text of a deployment with pads of `pad_text`; `daemon`, `touch`: keys of these tables."""
    return f"""
[daemon]
{daemon}

[[bus]]
name = "can0"
interface = "virtual"
channel = "{channel}"

[node.n]
drive_v = 5.0
full_scale_ma = {full_scale_ma}
noise_counts = {noise_counts}

[sheet.s]
ohm_per_square = 2400.0
contact_ohm_mm2 = 20000.0
alpha = 1.5
contact_radius_mm = {contact_radius_mm}
contact_radius_std_mm = {contact_radius_std_mm}

[touch]
{touch.strip()}

[[hand]]
name = "h"
""" + "".join(pads)


def pad_text(link: str, node_id: int, surface: str = PLANE, extra: str = "") -> str:
    """Return the table of a pad; `extra`: further keys, one per line."""
    return f"""
[[hand.pad]]
link = "{link}"
bus = "can0"
node_id = {node_id}
node = "n"
sheet = "s"
surface = {surface}
gap_mm = 0.6
{extra}
"""
