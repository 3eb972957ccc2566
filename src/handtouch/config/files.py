"""Files that a deployment refers to.

Public name: `deployment_files`.
"""

from __future__ import annotations

from pathlib import Path

from handtouch.config.tables import Deployment


def deployment_files(deployment: Deployment) -> dict[str, bytes]:
    """Return path -> content of the existing files that a deployment names: EDS and URDF."""
    named = {node.eds for node in deployment.nodes.values() if node.eds}
    named |= {hand.urdf for hand in deployment.hands if hand.urdf}
    return {path: Path(path).read_bytes() for path in sorted(named) if Path(path).is_file()}
