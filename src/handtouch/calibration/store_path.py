"""Where the calibrations of a deployment are stored.

Public name: `store_path`.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from handtouch.config import Deployment


def store_path(deployment: Deployment | None = None, folder: Path | None = None) -> Path:
    """Return the store's path: `[daemon] store`, relative to the deployment file's folder.

    Else in the state folder given by systemd, or $XDG_STATE_HOME/handtouch, or ~/.local/state/handtouch.
    Nodes on a bus between programs are simulated, with the serial numbers of real ones: they have a store of
    their own.
    """
    if deployment is not None and deployment.daemon.store is not None:
        return (folder or Path()) / Path(deployment.daemon.store).expanduser()
    is_simulated = deployment is not None and any(bus.is_cableless for bus in deployment.buses)
    name = "simulated.db" if is_simulated else "calibrations.db"
    if state_folder := os.environ.get("STATE_DIRECTORY"):
        return Path(state_folder.split(":")[0]) / name
    home = os.environ.get("XDG_STATE_HOME", "")
    state = Path(home) if Path(home).is_absolute() else Path.home() / ".local" / "state"
    return state / "handtouch" / name
