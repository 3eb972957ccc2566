"""Commissioning: press one pad after another to find how the hand is wired, and write it to the deployment.

Modules: `procedure` is the dialogue, `sample_source` reads the buses, `press` detects presses,
`electrode_order` finds what each channel is wired to, `press_instructions` describes where to press,
`node_assignment` maps pads to nodes, `deployment_edit` and `record` write the deployment file.
"""

from __future__ import annotations

from collections.abc import Sequence

from handtouch import client, config
from handtouch.host.endpoints import to_connect

__all__ = ["DaemonRunningError", "refuse_beside_daemon", "select_rows"]

_DAEMON_TIMEOUT_S = 0.5


class DaemonRunningError(Exception):
    """A daemon uses the buses that a procedure needs."""

    exit_status = 1


def select_rows(deployment: config.Deployment, patterns: Sequence[str]) -> list[int]:
    """Return the rows of the pads that match patterns (default: all that can be commissioned).

    Raises ConfigError for a pattern without a pad, or with one whose electrodes are switched: each of its
    channels has several.
    """
    switched = {row for row, (_, pad) in enumerate(deployment.pads) if pad.switch_states}
    if not patterns:
        return [row for row in range(len(deployment.pads)) if row not in switched]
    rows: set[int] = set()
    for pattern in patterns:
        matching = deployment.rows_matching(pattern)
        if not matching:
            remedy = f"matches no pad; pads: {', '.join(deployment.pad_names)}"
            raise config.ConfigError(
                "handtouch commission", (config.Problem("--link", f" {pattern}", remedy),)
            )
        if refused := switched & {*matching}:
            remedy = (
                f"has switch_states, {deployment.pad_names[min(refused)]}: a press doesn't show which "
                "electrode a shared channel is wired to; write electrodes into the file by the wiring diagram"
            )
            raise config.ConfigError(
                "handtouch commission", (config.Problem("--link", f" {pattern}", remedy),)
            )
        rows.update(matching)
    return sorted(rows)


def refuse_beside_daemon(endpoint: str) -> None:
    """Raise DaemonRunningError if a daemon, which would use the same buses, answers at a control endpoint."""
    try:
        client.request("status", endpoint=to_connect(endpoint), timeout_s=_DAEMON_TIMEOUT_S)
    except (TimeoutError, ValueError):  # or it has any free port, which nobody can know
        return
    except (PermissionError, RuntimeError):
        pass  # it runs, and rejects the request
    raise DaemonRunningError(
        f"a daemon is running at {endpoint} and uses these buses; stop it first (Ctrl-C, or systemctl stop "
        "handtouch), and start it again afterwards"
    )
