"""Text of small deployments for tests and benchmarks: one kind of node, one sheet, one hand."""

from __future__ import annotations

from collections.abc import Mapping

PLANE = '{ kind = "plane", length_mm = 30.0, width_mm = 24.0 }'
CYLINDER = '{ kind = "cylinder", radius_mm = 10.0, length_mm = 30.0, arc_deg = 150.0 }'
TOUCH = """
begin_threshold_n = 0.1
end_threshold_n = 0.05
begin_ms = 5.0
end_ms = 5.0
"""
EXACT_NODE = "gain_std = 0.0\nseries_std = 0.0\n"
PLAIN_SHEET = "crowding = false\ncontact_elongation_std = 0.0\ncontact_tilt_std = 0.0\nunevenness_std = 0.0\n"
SHEET_TOLERANCES = (
    *("ohm_per_square_std", "contact_ohm_std", "alpha_std"),
    *("anisotropy_std", "gap_std_mm", "size_std_mm"),
)
EXACT_SHEET = "".join(f"{name} = 0.0\n" for name in SHEET_TOLERANCES)


def deployment_text(
    *pads: str,
    daemon: str = "sync_period_ms = 5.0",
    channel: str = "test",
    full_scale_ma: float = 10.0,
    noise_counts: float = 1.0,
    contact_radius_mm: float = 2.5,
    contact_radius_std_mm: float = 0.5,
    touch: str = TOUCH,
    buses: Mapping[str, str] | None = None,
    hand: str = "h",
    exact_parts: bool = False,
) -> str:
    """Return the text of a deployment with pads of `pad_text`; `daemon`, `touch`: keys of these tables.

    `exact_parts`: without tolerances. Currents are uniform over contacts, as exact theory has them.

    `buses`: channels by name; one bus `can0` at `channel` if left out.
    """
    bus_tables = "".join(
        f'[[bus]]\nname = "{name}"\ninterface = "virtual"\nchannel = "{at}"\n\n'
        for name, at in (buses or {"can0": channel}).items()
    )
    return f"""
[daemon]
{daemon}

{bus_tables}
[node.n]
drive_v = 5.0
full_scale_ma = {full_scale_ma}
noise_counts = {noise_counts}
series_std_ohm = 0.0
{EXACT_NODE if exact_parts else ""}
[sheet.s]
ohm_per_square = 2400.0
contact_ohm_mm2 = 20000.0
alpha = 1.5
contact_radius_mm = {contact_radius_mm}
contact_radius_std_mm = {contact_radius_std_mm}
{PLAIN_SHEET}{EXACT_SHEET if exact_parts else ""}
[touch]
{touch.strip()}

[[hand]]
name = "{hand}"
""" + "".join(pads)


def pad_text(
    link: str, node_id: int, surface: str = PLANE, extra: str = "", *, bus: str = "can0", gap_mm: float = 0.6
) -> str:
    """Return the table of a pad; `extra`: further keys, one per line."""
    return f"""
[[hand.pad]]
link = "{link}"
bus = "{bus}"
node_id = {node_id}
node = "n"
sheet = "s"
surface = {surface}
gap_mm = {gap_mm}
{extra}
"""


THREE_ARCS = {"end": (50.187, 6.3617), "left": (7.7754, 27.5675), "right": (28.9812, 48.7732)}
SIX_ARCS = {
    "a": (0.5, 8.9),
    "b": (9.9, 18.3),
    "c": (19.3, 27.7),
    "d": (28.7, 37.2),
    "e": (38.2, 46.6),
    "f": (47.6, 56.0),
}


def arcs_text(arcs: dict[str, tuple[float, float]] = THREE_ARCS) -> str:
    """Return a hand of a pad with four sides and a disc with electrodes on arcs."""
    text = deployment_text(pad_text("plane", 1))
    first, _, node = text.partition("[node.n]")
    channels = ", ".join(f'"0x6401:{sub}"' for sub in range(1, len(arcs) + 1))
    text = f"{first}[node.arcs]\nchannels = [{channels}]\n{node.partition('[')[0]}[node.n]{node}"
    listed = ", ".join(f"{name} = [{begin}, {end}]" for name, (begin, end) in arcs.items())
    pad = pad_text("disc", 2).replace('node = "n"', f'node = "arcs"\nelectrode_arcs_mm = {{ {listed} }}')
    surface = (
        'surface = { kind = "outline", outline_x_mm = [9, -9], outline_y_mm = [0, 0], '
        "edge_turn_deg = [180, 180], corners_mm = [35.3429, 49.4801, 7.0686, 21.2058] }"
    )
    lines = [surface if line.startswith("surface") else line for line in pad.splitlines()]
    lines = ["gap_mm = 0.0" if line.startswith("gap_mm") else line for line in lines]
    return text + "\n" + "\n".join(lines) + "\n"
