"""The worked example of the documentation: a third-party hand."""

from __future__ import annotations

import math
import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from handtouch.cli.check import run
from handtouch.config import ConfigError, load
from handtouch.core.stages.kinematics import LinkPoses
from handtouch.hand.robot_models import RobotModels, check_urdfs, unchecked_items

DOCS = Path(__file__).parents[2] / "docs"
TEXT = (DOCS / "hand.md").read_text()


def written(folder: Path, allegro: Path) -> Path:
    """The deployment in docs/hand.md, as a file."""
    blocks = re.findall(r"```toml\n(.*?)```", TEXT, flags=re.S)
    (example,) = (block for block in blocks if "allegro_right_hand.urdf" in block)
    path = folder / "hand.toml"
    path.write_text(example.replace("allegro_right_hand.urdf", str(allegro)))
    return path


def test_documented_example_fits_the_hand(
    tmp_path: Path, allegro: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = written(tmp_path, allegro)
    assert run(path, as_json=False, schema=False) == 0, capsys.readouterr()
    deployment = check_urdfs(load(path), str(path))
    assert not list(unchecked_items(deployment))
    (kinematics,) = RobotModels(deployment).kinematics
    assert kinematics.joints == ("joint_0.0", "joint_1.0", "joint_2.0", "joint_3.0")
    poses = LinkPoses(kinematics)
    straight = poses.pose_in_palm(2)
    # phalanx lengths published by the maker, spread by 5 degrees
    assert straight.translation_m[2] == pytest.approx(0.1355 * math.cos(math.radians(5)) - 0.0015, abs=1e-4)
    poses.set_joint_positions(np.array([0.0, 1.0, 1.0, 1.0]))
    assert poses.pose_in_palm(2).translation_m[0] > 0.04  # it closes towards the palm's side, x


@pytest.mark.usefixtures("allegro")
def test_the_how_to_s_commands_find_the_urdf_and_all_its_meshes(tmp_path: Path) -> None:
    written(tmp_path, Path("allegro_right_hand.urdf")).rename(tmp_path / "allegro.toml")
    section = (DOCS / "howto.md").read_text().partition("## ... equip an Allegro hand")[2]
    _install, *commands = section.split("```")[1].strip().splitlines()
    environment = {**os.environ, "PATH": f"{Path(sys.executable).parent}:{os.environ['PATH']}"}
    script = "\n".join(["set -e", *commands])
    done = subprocess.run(
        ["bash", "-c", script], cwd=tmp_path, env=environment, capture_output=True, text=True
    )
    assert (done.returncode, done.stderr) == (0, "")
    assert "no warnings" in done.stdout


def test_pad_facing_into_the_hand_is_reported(tmp_path: Path, allegro: Path) -> None:
    path = written(tmp_path, allegro)
    path.write_text(path.read_text().replace("rpy_deg = [180.0, -102.5, 0.0]", "rpy_deg = [0.0, -77.5, 0.0]"))
    with pytest.raises(ConfigError, match=r"index_tip.*rpy_deg.*faces into the body"):
        check_urdfs(load(path), str(path))
