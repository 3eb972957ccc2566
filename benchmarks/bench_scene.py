"""Savings of a tick by scenes: outputs, links, rate, subscriptions; and what palm and base frames add.

The pipeline of the daemon, from the last sample to encoded messages, with the preparation of the next tick;
medians of processor time. Every case has the same samples, and cases take turns, so that a slower machine
affects all. *Outputs and links*: all pads touched by contacts that slide 0.1 mm a tick. *Palm and base*:
steady presses on some of 15 pads, joint states at 1 kHz. Contacts have 20 times the threshold's current.
Savings of the bus are in [idle](idle.md).
"""

from __future__ import annotations

from benchmarks.page import Report, options
from benchmarks.touched_pads import PipelineCase, Touches, hands, in_turns_of
from handtouch.config import load, shipped
from handtouch.config.tables import SceneRequest
from handtouch.core.pad_model import PadModel
from handtouch.hand.robot_models import RobotModels

CONTACTS, EVERYTHING = ("contact/",), ("contact/", "hand/")
SCENES: dict[str, tuple[tuple[str, ...], SceneRequest]] = {
    "all outputs, contacts and hand frames subscribed": (EVERYTHING, SceneRequest()),
    "contacts subscribed": (CONTACTS, SceneRequest()),
    "no subscriber": ((), SceneRequest()),
    "no outputs: begin, current and end only": (EVERYTHING, SceneRequest(outputs=())),
    "position only": (EVERYTHING, SceneRequest(outputs=("position",))),
    "a fifth of the links": (EVERYTHING, SceneRequest(links=("thumb_*",))),
}
PLAIN = ("position", "force")
STATED = {"mount_std_mm": 0.3, "mount_std_deg": 1.0, "joint_std_deg": 0.3}
EXACT = dict.fromkeys(STATED, 0.0)
FRAMES: dict[str, tuple[tuple[str, ...], dict[str, float] | None]] = {
    "no URDF": (PLAIN, None),
    "URDF, palm not asked for": (PLAIN, STATED),
    "palm": ((*PLAIN, "palm"), EXACT),
    "palm, uncertain mounts and joints": ((*PLAIN, "palm"), STATED),
    "palm and base": ((*PLAIN, "palm", "base"), EXACT),
    "palm and base, uncertain mounts and joints": ((*PLAIN, "palm", "base"), STATED),
}
"""Outputs, and what the file states of the hand; None: no URDF."""


def frame_cases(model: PadModel) -> dict[str, PipelineCase]:
    """Return pipelines of the shipped hand by the frames that are asked for."""
    deployment, cases = load(shipped.path("utah_mit.toml")), {}
    for name, (outputs, stated) in FRAMES.items():
        hand = deployment.hands[0].model_copy(update=stated or {})
        robots = RobotModels(deployment.model_copy(update={"hands": (hand,)})) if stated is not None else None
        cases[name] = PipelineCase(
            model, EVERYTHING, SceneRequest.model_validate({"outputs": outputs}), robots
        )
    return cases


def main() -> None:
    quick = options(__doc__).parse_args().quick
    ticks = 20 if quick else 1000
    report, rows = Report(quick, "outputs and links", ticks=ticks), []
    for pads in (15, 60):
        model = hands(pads)
        cases = {name: PipelineCase(model, *scene) for name, scene in SCENES.items()}
        rows += [{"pads": pads, **row} for row in in_turns_of(cases, Touches(model), ticks)]
    report.table("Scenes", rows)
    report.keep()
    report, rows = Report(quick, "palm and base", ticks=ticks), []
    for touched in (0, 1, 5, 15):
        model = PadModel(load(shipped.path("utah_mit.toml")))
        rows_of = in_turns_of(frame_cases(model), Touches(model, touched, 0.0), ticks)
        rows += [{"pads touched": touched, **row} for row in rows_of]
    report.table("Palm and base frames", rows)
    report.keep()


if __name__ == "__main__":
    main()
