"""A LeRobot dataset of a recording: the documented files, every sample, and nothing invented."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from handtouch import wire
from handtouch.client.hand_arrays import HandArrays
from handtouch.learn import TouchFeatures
from handtouch.record.lerobot import STATE, TOUCH, WINDOW, export_lerobot
from handtouch.record.recording import Recording
from tests.record.conftest import PERIOD_NS, WALL_NS, RecordingSession

parquet = pytest.importorskip("pyarrow.parquet", reason="needs the extra export")
JOINTS = ("base_joint", "tip_joint")


def joints(seq: int, t_ns: int, known: int = len(JOINTS)) -> list[bytes]:
    """Return joint positions, the first `known` of them, that tell their time."""
    positions, ages = (1e-9 * t_ns, 0.5), (0.0, 0.0)
    unknown = (None,) * (len(JOINTS) - known)
    message = wire.JointPositions(
        v=1, session=7, seq=seq, t_ns=t_ns, hand="h", names=JOINTS,
        position_rad=positions[:known] + unknown, age_s=ages[:known] + unknown, retained=False,
    )  # fmt: skip
    return wire.encode(message)


class Recorded:
    """A recording of strokes with joint states, and the frames in it."""

    def __init__(self, session: RecordingSession) -> None:
        self.session, self.hand = session, session.hand
        self.frames: list[wire.HandFrame] = []
        self._seq = 0

    def stroke(self, ticks: int, with_joints: bool = True, known: int = len(JOINTS)) -> None:
        for _ in range(ticks):
            if with_joints and self._seq % 4 == 0:
                self.session.take(joints(self._seq + 1, self.hand.t_ns, known))
            self._seq += 1
            self.hand.stroke_step(self._seq % 40 / 40, np.random.default_rng(self._seq))

    def finish(self) -> Recording:
        self.session.recorder.poll(self.hand.t_ns)
        self.session.recorder.finish()
        self.frames = [m for m in self.hand.sink.messages if isinstance(m, wire.HandFrame)]
        return Recording(self.session.paths[0])


@pytest.fixture
def recorded(session: RecordingSession) -> Recorded:
    return Recorded(session)


def rows(folder: Path, number: int = 0) -> dict[str, Any]:
    table = parquet.read_table(folder / f"data/chunk-000/file-{number:03d}.parquet")
    return {name: np.array(table[name].to_pylist()) for name in table.column_names}


def test_every_sample_is_in_one_window_and_the_newest_is_the_frame_s(
    recorded: Recorded, tmp_path: Path
) -> None:
    recorded.stroke(200)
    recording = recorded.finish()
    counts = export_lerobot(recording, tmp_path / "set", fps=30.0)
    found = rows(tmp_path / "set")
    features = TouchFeatures(recorded.frames[0].links)
    assert found[WINDOW].shape == (counts.frames, counts.samples, features.size)
    sampled = features.names.index("plane.age_s")
    assert sampled
    each = [features.of(HandArrays(frame)) for frame in recorded.frames]
    filled = [row for window in found[WINDOW] for row in window.astype(np.float32) if row.any()]
    assert [row.tobytes() for row in filled] == [row.tobytes() for row in each[: len(filled)]]
    assert len(each) - len(filled) <= round(1e9 / 30 / PERIOD_NS)  # after the last whole period
    newest = found[WINDOW][:, -1].astype(np.float32)
    ages = [name.endswith("age_s") for name in features.names]
    assert np.array_equal(newest[:, ~np.array(ages)], found[TOUCH].astype(np.float32)[:, ~np.array(ages)])
    assert (found[TOUCH][:, ages] >= newest[:, ages] - 1e-6).all()  # it is as old as it is at the frame
    state_s = found[STATE][:, 0]
    assert np.diff(state_s) == pytest.approx(1 / 30, abs=5 * 4e-9 * PERIOD_NS)
    assert counts.joints == JOINTS


def test_episodes_end_at_gaps_and_sessions(recorded: Recorded, tmp_path: Path) -> None:
    for ticks in (100, 60, 80):
        recorded.stroke(ticks)
        recorded.hand.t_ns += 3_000_000_000
    counts = export_lerobot(recorded.finish(), tmp_path / "set", fps=50.0)
    assert counts.episodes == 3
    info = json.loads((tmp_path / "set/meta/info.json").read_text())
    assert (info["total_episodes"], info["total_frames"]) == (3, counts.frames)
    episodes = parquet.read_table(tmp_path / "set/meta/episodes/chunk-000/file-000.parquet").to_pylist()
    first = 0
    for number, episode in enumerate(episodes):
        found = rows(tmp_path / "set", number)
        assert set(found["episode_index"]) == {number}
        assert found["index"].tolist() == list(range(first, first + episode["length"]))
        assert found["frame_index"].tolist() == list(range(episode["length"]))
        assert found["timestamp"] == pytest.approx(np.arange(episode["length"]) / 50.0)
        assert (episode["dataset_from_index"], episode["dataset_to_index"]) == (
            first,
            first + episode["length"],
        )
        first += episode["length"]


def test_declared_features_are_those_of_the_files(recorded: Recorded, tmp_path: Path) -> None:
    recorded.stroke(100)
    export_lerobot(recorded.finish(), tmp_path / "set", fps=100.0, frame="pad", task="stroke both pads")
    info = json.loads((tmp_path / "set/meta/info.json").read_text())
    found = rows(tmp_path / "set")
    assert set(info["features"]) == set(found)
    for name, feature in info["features"].items():
        shape = () if feature["shape"] == [1] else tuple(feature["shape"])
        assert found[name].shape[1:] == shape, name
        assert feature["names"] is None or len(feature["names"]) in (shape[0], len(shape))
    stats = json.loads((tmp_path / "set/meta/stats.json").read_text())
    for name, one in stats.items():
        values = found[name].astype(np.float64)
        assert np.array(one["mean"]) == pytest.approx(values.mean(axis=0), rel=1e-5, abs=1e-7), name
        assert one["count"] == [len(values)]
        assert np.isfinite(np.array(one["q50"])).all()
    tasks = parquet.read_table(tmp_path / "set/meta/tasks.parquet").to_pylist()
    assert tasks == [{"task_index": 0, "__index_level_0__": "stroke both pads"}]


def test_a_recording_without_joints_or_before_them_has_no_invented_state(
    recorded: Recorded, tmp_path: Path
) -> None:
    recorded.stroke(50, with_joints=False)
    first_ns = recorded.hand.t_ns
    recorded.stroke(100)
    recording = recorded.finish()
    export_lerobot(recording, tmp_path / "set", fps=100.0)
    state_s = rows(tmp_path / "set")[STATE][:, 0]
    assert state_s[0] == pytest.approx(1e-9 * first_ns, abs=4e-9 * PERIOD_NS)
    assert len(state_s) == pytest.approx(50, abs=2)


@pytest.mark.parametrize("known", [0, 1])
def test_joints_that_were_never_known_are_left_out(recorded: Recorded, tmp_path: Path, known: int) -> None:
    recorded.stroke(100, known=known)
    counts = export_lerobot(recorded.finish(), tmp_path / "set", fps=100.0)
    assert counts.joints == JOINTS[:known]
    assert len(rows(tmp_path / "set")["timestamp"]) == pytest.approx(50, abs=3)


@pytest.mark.parametrize(
    ("options", "said"),
    [({"hand": "left"}, "frames of hand 'left'; it has h"), ({"fps": 0.01}, "give a higher --fps")],
)
def test_what_can_t_be_exported_says_so(
    recorded: Recorded, tmp_path: Path, options: dict[str, Any], said: str
) -> None:
    recorded.stroke(1200)
    recording = recorded.finish()
    with pytest.raises(ValueError, match=said):
        export_lerobot(recording, tmp_path / "set", **options)
    (tmp_path / "full").mkdir()
    (tmp_path / "full/file").touch()
    with pytest.raises(OSError, match="isn't empty"):
        export_lerobot(recording, tmp_path / "full")


def test_marks_begin_episodes_name_their_tasks_and_leave_out(recorded: Recorded, tmp_path: Path) -> None:
    def mark(text: str) -> None:
        recorded.session.recorder.add_mark(text, recorded.hand.t_ns + WALL_NS)

    recorded.stroke(60)
    for text in ("pick", "-", "place", "pick", ""):
        mark(text)
        recorded.stroke(60)
    counts = export_lerobot(recorded.finish(), tmp_path / "set", fps=30.0, task="other")
    assert counts.episodes == 5  # what follows "-" is left out
    episodes = parquet.read_table(tmp_path / "set/meta/episodes/chunk-000/file-000.parquet")
    assert episodes["tasks"].to_pylist() == [["other"], ["pick"], ["place"], ["pick"], ["other"]]
    names = parquet.read_table(tmp_path / "set/meta/tasks.parquet").to_pydict()
    numbers = dict(zip(names["__index_level_0__"], names["task_index"], strict=True))
    assert [set(rows(tmp_path / "set", k)["task_index"]) for k in range(5)] == [
        {numbers[name]} for name in ("other", "pick", "place", "pick", "other")
    ]
    assert json.loads((tmp_path / "set/meta/info.json").read_text())["total_tasks"] == 3
    features = TouchFeatures(recorded.frames[0].links)
    each = [features.of(HandArrays(frame)) for frame in recorded.frames]
    for number, part in enumerate((0, 1, 3, 4, 5)):
        window = rows(tmp_path / "set", number)[WINDOW].astype(np.float32)
        assert window[0, -1].tobytes() == each[60 * part].tobytes()  # the first sample after the mark
