"""The daemon with simulated nodes of taxels: contacts on links with intervals."""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from handtouch import wire
from handtouch.cli.demo import in_process_deployment
from handtouch.config import Deployment, load, parse, shipped
from handtouch.daemon.daemon import HandtouchDaemon
from handtouch.field.measured import PressTable
from handtouch.procedures.calibrate import find_pad
from handtouch.simulate.scenario import Scenario
from handtouch.simulate.score import score_contacts
from handtouch.simulate.simulated_hand import SimulatedHand
from handtouch.simulate.worlds import WORLDS, Family

from .conftest import START_S, run_in_threads
from .served_daemon import ServedDaemon

TOUCHES = "".join(
    f"""
[[touch]]
link = "{link}"
from_s = {0.3 + 0.7 * number:.2f}
duration_s = 0.5
path = [[{x}, {y}], [{1 - x:.2f}, {y}]]
force_n = [{force}, {force}]
"""
    for number, (x, y, force) in enumerate([(0.3, 0.3, 1.0), (0.6, 0.7, 3.0), (0.25, 0.6, 0.6)])
    for link in ("tip", "middle")
)


LINKS = ("tip", "middle")


def array_of_32() -> Deployment:
    """Return a deployment whose pad `middle` has 32 taxels in four rows of eight."""
    text = shipped.path("taxels.toml").read_text(encoding="utf-8")
    places = [[x, y] for y in (-7.5, -2.5, 2.5, 7.5) for x in np.arange(-17.5, 18.0, 5.0).tolist()]
    kept, pad = text[: text.index("[node.nine_channel]")], text[text.rindex("[[hand.pad]]") :]
    pad = pad.replace("length_mm = 12.0, width_mm = 12.0", "length_mm = 40.0, width_mm = 20.0")
    return parse(
        f"""{kept}
[node.five_channel]
channels = {[f"0x6401:{number}" for number in range(1, 33)]}
unit = "N"
full_scale = 32.767
noise_counts = 2.0

[response.barometers]
kind = "taxels"
positions_mm = {places}
width_mm = 3.0
signal_per_n = 0.5

[[hand]]
name = "palm"

{pad}"""
    )


@contextmanager
def served(
    folder: Path, deployment: Deployment, touches: str = TOUCHES
) -> Iterator[tuple[ServedDaemon, SimulatedHand]]:
    """Run the daemon and its hand, which plays the touches again and again."""
    drawn = WORLDS["default"].draw(Family.TUNING.seed(3))
    deployment = in_process_deployment(drawn.describe(deployment))
    settings = {"supervise": True, "store": "calibrations.db"}
    deployment = deployment.model_copy(update={"daemon": deployment.daemon.model_copy(update=settings)})
    hand = SimulatedHand.open(deployment, Scenario.parse(f"repeat = true\n{touches}"), drawn)
    with hand, HandtouchDaemon.open(deployment, folder=folder) as daemon:
        hand.start()
        made = ServedDaemon(daemon)
        with run_in_threads(daemon.run, made.listen):
            yield made, hand


def updates(daemon: ServedDaemon, links: tuple[str, ...] = LINKS) -> list[wire.Contact] | None:
    """Return the contacts; None before there are a hundred of each pad."""
    found = [one for one in list(daemon.contacts) if one.event == "update"]
    return found if all(sum(one.link == link for one in found) > 100 for link in links) else None


def test_contacts_of_taxels_are_on_their_links_with_true_intervals(tmp_path: Path) -> None:
    with served(tmp_path, load(shipped.path("taxels.toml"))) as (daemon, hand):
        contacts = daemon.wait("touched", lambda: updates(daemon))
        links = {link.name: link for link in score_contacts(contacts, hand.truth).links}
    assert links.keys() == set(LINKS)
    for link in links.values():
        assert link.pad_error_m < 1.5e-3
        assert link.position_coverage > 0.85
    firm = [one.force_n for one in contacts if one.force_status == "valid" and one.force_n]
    assert 0.4 < np.median(firm) < 4.0


def test_contacts_of_32_taxels_arrive_in_eight_tpdos(tmp_path: Path) -> None:
    touches = "".join(f"[[touch]]{part}" for part in TOUCHES.split("[[touch]]") if '"middle"' in part)
    with served(tmp_path, array_of_32(), touches) as (daemon, hand):
        contacts = daemon.wait("touched", lambda: updates(daemon, ("middle",)))
        (link,) = score_contacts(contacts, hand.truth).links
    assert link.pad_error_m < 2e-3
    assert link.position_coverage > 0.7


PRESSES = [(x, y) for y in (0.15, 0.85) for x in (0.12, 0.4, 0.65, 0.88)]


def press_scenario(quiet_s: float) -> str:
    """Return presses of a pad, of which the zero before each is known."""
    return "".join(
        f"""
[[touch]]
link = "palm_heel"
from_s = {quiet_s + 1.3 * number:.2f}
duration_s = 0.75
path = [[{x}, {y}]]
force_n = [1.0]
"""
        for number, (x, y) in enumerate(PRESSES)
    )


def test_presses_of_a_pad_become_its_map_guided_and_from_the_recording(rig: Any) -> None:
    surface = find_pad(load(rig.config), "palm_heel").pad.surface.build()
    places_mm = 1e3 * np.array(PRESSES) * surface.extent_m
    table = rig.folder / "places.csv"
    table.write_text("x_mm,y_mm\n" + "".join(f"{x:.3f},{y:.3f}\n" for x, y in places_mm))
    rig.scenario.write_text(press_scenario(quiet_s=1.2))
    command = ["calibrate", "palm_heel", "--config", str(rig.config), "--positions", str(table), "--map"]
    files = {name: rig.folder / f"{name}.npz" for name in ("guided", "recorded")}
    rig.start("run")
    with rig.recording() as recording:
        guided = rig.start_command(*command, str(files["guided"]), "--json")
        rig.wait("asked", lambda _: "[1/8] press at" in rig.printed("calibrate"))
        rig.start("simulate", "--world", "default", "--scenario", str(rig.scenario))
        assert guided.wait(START_S) == 0, rig.all_printed()
    assert rig.printed("calibrate").count("] press at (") == len(PRESSES)
    status, printed = rig.call(*command, str(files["recorded"]), "--from", str(recording))
    assert status == 0, printed
    error_mm = re.search(r"what is stated +([\d.]+) mm", printed)
    assert error_mm is not None
    assert float(error_mm[1]) < 1.0
    assert "Far from the map" not in printed
    assert 'press_map = "recorded.npz" in the [[hand.pad]] of right/palm_heel' in printed
    presses = [PressTable(file.read_bytes()) for file in files.values()]
    np.testing.assert_allclose(presses[0].signals, presses[1].signals, rtol=0.02)
    np.testing.assert_allclose(1e3 * presses[0].place_m, places_mm, atol=1.0)
