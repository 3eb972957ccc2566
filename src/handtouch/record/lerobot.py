"""Export of recordings as a LeRobot dataset, format v3.0: the features of touch at a policy's frame rate.

Public names: `export_lerobot`, `LerobotCounts`. Needs pyarrow.

Episodes are what a mark, a gap or another session of the daemon separates. A frame has the newest touch
(`observation.touch`), all samples since the frame before (`observation.touch_window`, oldest first, rows of 0
where there were fewer), and where they were recorded the joint positions (`observation.state`).
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from handtouch import wire
from handtouch.client.window import HandWindow
from handtouch.learn import TouchFeatures
from handtouch.learn.features import Frame
from handtouch.record.recording import Recording
from handtouch.record.schemas import MARK

TOUCH, WINDOW, STATE = "observation.touch", "observation.touch_window", "observation.state"
_VERSION, _CHUNK_FILES = "v3.0", 1000
_QUANTILES = {"q01": 0.01, "q10": 0.1, "q50": 0.5, "q90": 0.9, "q99": 0.99}
_INDICES = ("frame_index", "episode_index", "index", "task_index")
_LEFT_OUT = "-"
"""Text of a mark after which frames belong to no episode"""
_MAX_SAMPLES = 1000
"""Samples between two frames: 1 kHz at one frame a second"""
FloatArray = NDArray[np.float32]


class LerobotCounts(NamedTuple):
    """What was written, and why not more."""

    episodes: int
    frames: int
    samples: int
    """rows of `observation.touch_window`"""
    joints: tuple[str, ...]
    """of `observation.state`; empty without joint states"""


@dataclass
class _Episode:
    """Hand frames without a gap, and joint positions in between."""

    task: str
    """text of the mark that it begins with"""
    frames: list[wire.HandFrame] = field(default_factory=list)
    joints_ns: list[int] = field(default_factory=list)
    positions: list[list[float]] = field(default_factory=list)

    def times_ns(self, fps: float) -> NDArray[np.int64]:
        """Return the times of its frames: from the first sample, with joints from their first position on."""
        first_ns = max(self.frames[0].t_ns, self.joints_ns[0] if self.joints_ns else 0)
        count = int((self.frames[-1].t_ns - first_ns) * 1e-9 * fps) + 1
        steps = np.rint(np.arange(max(count, 0)) * (1e9 / fps)).astype(np.int64)
        return np.asarray(first_ns + steps)


def export_lerobot(
    recording: Recording,
    folder: Path,
    hand: str = "",
    *,
    fps: float = 30.0,
    frame: Frame = "link",
    max_gap_s: float = 1.0,
    task: str = "touch",
    on_progress: Callable[[str], None] = lambda _: None,
) -> LerobotCounts:
    """Write the frames of a hand into a folder, as a LeRobot dataset; the recording is read twice.

    `hand`: by default the only one. `max_gap_s`: longest time between two frames of an episode. `task`: of
    episodes that begin with no mark, or with one without text.
    Raises ValueError for a recording without frames of the hand, several hands, or a rate that is too low,
    OSError if the folder isn't empty, ImportError without pyarrow.
    """
    if folder.exists() and any(folder.iterdir()):
        raise OSError(f"{folder}: isn't empty; give a new folder for the dataset")
    samples, hand, joints = _survey(recording, hand, fps)
    features: TouchFeatures | None = None
    writer: _DatasetWriter | None = None
    for number, episode in enumerate(_episodes(recording, hand, joints, max_gap_s)):
        if episode.task == _LEFT_OUT:
            continue
        if features is None or writer is None:
            features = TouchFeatures(episode.frames[0].links, frame=frame)
            writer = _DatasetWriter(folder, features, samples, joints, fps)
        on_progress(f"{number} episodes written to {folder}")
        columns = _columns_of(episode, features, samples, fps, bool(joints))
        if len(columns[TOUCH]):
            writer.add(columns, episode.task or task)
    if writer is None or not writer.lengths:
        raise ValueError(
            f"{recording.path}: no frame of hand {hand} was recorded for a whole period of {fps:g} Hz"
        )
    writer.finish()
    return LerobotCounts(len(writer.lengths), sum(writer.lengths), samples, joints)


def _survey(recording: Recording, hand: str, fps: float) -> tuple[int, str, tuple[str, ...]]:
    """Return the most samples between two dataset frames, the hand, and its joints whose position was ever
    known. Raises ValueError."""
    hands: set[str] = set()
    joints: dict[str, dict[str, bool]] = {}
    longest, before, within = 0, 0, 0
    for entry in recording.read("hand", "joints"):
        payload = entry.payload
        name = str(payload.get("hand"))
        if entry.topic.startswith("joints/"):
            known = joints.setdefault(name, {})
            for joint, position_rad in zip(payload["names"], payload["position_rad"], strict=True):
                known[joint] = known.get(joint, False) or position_rad is not None
            continue
        hands.add(name)
        if hand and name != hand:
            continue
        slot = int(payload["t_ns"] * 1e-9 * fps)
        within = within + 1 if slot == before else 1
        before, longest = slot, max(longest, within)
    if not hands:
        raise ValueError(f"{recording.path}: holds no hand frames; record with `handtouch record --hand`")
    if hand and hand not in hands:
        raise ValueError(
            f"{recording.path}: holds no frames of hand {hand!r}; it has {', '.join(sorted(hands))}"
        )
    if not hand and len(hands) > 1:
        raise ValueError(
            f"{recording.path}: holds several hands; give --hand, one of {', '.join(sorted(hands))}"
        )
    if longest > _MAX_SAMPLES:
        raise ValueError(f"{longest} samples between two frames of {fps:g} Hz; give a higher --fps")
    (hand,) = {hand} if hand else hands
    known_joints = tuple(joint for joint, known in joints.get(hand, {}).items() if known)
    return longest + 1, hand, known_joints  # one more, as frames don't begin with slots


def _episodes(recording: Recording, hand: str, joints: Sequence[str], max_gap_s: float) -> Iterator[_Episode]:
    """Yield the episodes of a hand."""
    episode = _Episode("")
    for entry in recording.read("hand", "joints", MARK):
        payload = entry.payload
        if entry.topic == MARK:
            if episode.frames:
                yield episode
            episode = _Episode(str(payload["text"]), [], episode.joints_ns[-1:], episode.positions[-1:])
            continue
        if payload.get("hand") != hand:
            continue
        if entry.topic.startswith("joints/"):
            values = dict(zip(payload["names"], payload["position_rad"], strict=True))
            if all(values.get(name) is not None for name in joints):
                episode.joints_ns.append(payload["t_ns"])
                episode.positions.append([values[name] for name in joints])
            continue
        frame = wire.from_map(wire.HandFrame, entry.payload, entry.topic)
        last = episode.frames[-1] if episode.frames else frame
        changed = (frame.session, frame.links) != (last.session, last.links)
        if changed or frame.t_ns - last.t_ns > 1e9 * max_gap_s:
            yield episode
            kept = slice(0, 0) if changed else slice(-1, None)  # joints stand still in a gap
            episode = _Episode(episode.task, [], episode.joints_ns[kept], episode.positions[kept])
        if not episode.frames or frame.seq > last.seq:
            episode.frames.append(frame)
    if episode.frames:
        yield episode


def _columns_of(
    episode: _Episode, features: TouchFeatures, samples: int, fps: float, with_joints: bool
) -> dict[str, NDArray[Any]]:
    """Return the columns of an episode's frames; none where joints were never known."""
    touch_ns = np.array([frame.t_ns for frame in episode.frames], np.int64)
    known = not with_joints or bool(episode.joints_ns)
    times_ns = episode.times_ns(fps) if known else np.zeros(0, np.int64)
    newest = np.searchsorted(touch_ns, times_ns, side="right") - 1
    first = np.concatenate([newest[:1], newest[:-1] + 1])
    each = features.of(HandWindow(episode.frames))
    window = np.zeros((len(times_ns), samples, features.size), np.float32)
    for row, (begin, end) in enumerate(zip(first.tolist(), newest.tolist(), strict=True)):
        rows = each[max(begin, end + 1 - samples) : end + 1]
        window[row, samples - len(rows) :] = rows
    shown = HandWindow([episode.frames[index] for index in newest.tolist()])
    touch = features.of(shown, now_ns=times_ns) if len(shown) else each[:0]
    columns: dict[str, NDArray[Any]] = {TOUCH: touch, WINDOW: window}
    if with_joints and known:
        at = np.searchsorted(np.array(episode.joints_ns), times_ns, side="right") - 1
        columns[STATE] = np.array(episode.positions, np.float32)[np.maximum(at, 0)]
    columns["timestamp"] = np.arange(len(times_ns), dtype=np.float32) / np.float32(fps)
    return columns


class _DatasetWriter:
    """Files of a dataset: one Parquet file an episode, and the tables and figures in `meta`."""

    def __init__(
        self,
        folder: Path,
        features: TouchFeatures,
        samples: int,
        joints: tuple[str, ...],
        fps: float,
    ) -> None:
        self.lengths: list[int] = []
        self._folder, self._fps = folder, fps
        self._tasks: list[str] = []
        self._task_of: list[int] = []
        one: dict[str, Any] = {"shape": (1,), "names": None}
        self._features: dict[str, dict[str, Any]] = {
            TOUCH: features.declaration(),
            WINDOW: features.declaration(samples),
            **(
                {STATE: {"dtype": "float32", "shape": (len(joints),), "names": list(joints)}}
                if joints
                else {}
            ),
            "timestamp": {"dtype": "float32", **one},
            **{name: {"dtype": "int64", **one} for name in _INDICES},
        }
        self._stats: list[dict[str, dict[str, NDArray[Any]]]] = []

    def add(self, columns: dict[str, NDArray[Any]], task: str) -> None:
        """Add an episode with its task in words."""
        if task not in self._tasks:
            self._tasks.append(task)
        self._task_of.append(self._tasks.index(task))
        number, length = len(self.lengths), len(columns["timestamp"])
        first = sum(self.lengths)
        columns["frame_index"] = np.arange(length)
        columns["episode_index"] = np.full(length, number)
        columns["index"] = np.arange(first, first + length)
        columns["task_index"] = np.full(length, self._task_of[-1])
        self._write(f"data/{_file_name(number)}", {name: columns[name] for name in self._features})
        self._stats.append({name: _statistics(columns[name]) for name in self._features})
        self.lengths.append(length)

    def finish(self) -> None:
        """Write what describes the episodes."""
        ends = np.cumsum(self.lengths)
        episodes: dict[str, Any] = {
            "episode_index": np.arange(len(ends)),
            "tasks": [[self._tasks[number]] for number in self._task_of],
            "length": np.array(self.lengths),
            "data/chunk_index": np.arange(len(ends)) // _CHUNK_FILES,
            "data/file_index": np.arange(len(ends)) % _CHUNK_FILES,
            "dataset_from_index": ends - self.lengths,
            "dataset_to_index": ends,
            "meta/episodes/chunk_index": np.zeros(len(ends), np.int64),
            "meta/episodes/file_index": np.zeros(len(ends), np.int64),
        }
        for name in self._features:
            for key in self._stats[0][name]:
                episodes[f"stats/{name}/{key}"] = [stats[name][key].tolist() for stats in self._stats]
        self._write(f"meta/episodes/{_file_name(0)}", episodes)
        self._write_tasks()
        self._write_json("meta/stats.json", self._all_statistics())
        self._write_json(
            "meta/info.json",
            {
                "codebase_version": _VERSION,
                "robot_type": "handtouch",
                "total_episodes": len(self.lengths),
                "total_frames": sum(self.lengths),
                "total_tasks": len(self._tasks),
                "chunks_size": _CHUNK_FILES,
                "data_files_size_in_mb": 100,
                "video_files_size_in_mb": 200,
                "fps": int(self._fps) if float(self._fps).is_integer() else self._fps,
                "splits": {"train": f"0:{len(self.lengths)}"},
                "data_path": "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet",
                "video_path": None,
                "features": self._features,
            },
        )

    def _all_statistics(self) -> dict[str, Any]:
        """Return those of all episodes: of quantiles the means weighted by frames, as LeRobot has them."""
        counts = np.array(self.lengths, np.float64)
        found: dict[str, Any] = {}
        for name in self._features:
            each = {
                key: np.stack([stats[name][key] for stats in self._stats]) for key in self._stats[0][name]
            }
            weights = (counts / counts.sum()).reshape(-1, *[1] * (each["mean"].ndim - 1))
            mean = (weights * each["mean"]).sum(axis=0)
            variance = (weights * (each["std"] ** 2 + (each["mean"] - mean) ** 2)).sum(axis=0)
            found[name] = {
                "min": each["min"].min(axis=0).tolist(),
                "max": each["max"].max(axis=0).tolist(),
                "mean": mean.tolist(),
                "std": np.sqrt(variance).tolist(),
                "count": [int(counts.sum())],
                **{key: (weights * each[key]).sum(axis=0).tolist() for key in _QUANTILES},
            }
        return found

    def _write_tasks(self) -> None:
        """Write the table that pandas reads with the task as its index."""
        import pyarrow

        index = "__index_level_0__"
        described: list[dict[str, Any]] = [
            {"name": "task_index", "field_name": "task_index", "pandas_type": "int64", "numpy_type": "int64"},
            {"name": None, "field_name": index, "pandas_type": "unicode", "numpy_type": "object"},
        ]
        columns = [{**one, "metadata": None} for one in described]
        pandas = {
            "index_columns": [index],
            "column_indexes": [],
            "columns": columns,
            "pandas_version": "2.0.0",
        }
        numbers = pyarrow.array(range(len(self._tasks)), pyarrow.int64())
        table = pyarrow.table({"task_index": numbers, index: self._tasks})
        self._write_table("meta/tasks.parquet", table.replace_schema_metadata({"pandas": json.dumps(pandas)}))

    def _write(self, name: str, columns: Mapping[str, Any]) -> None:
        import pyarrow

        arrays = {
            key: _arrow_array(values) if isinstance(values, np.ndarray) else values
            for key, values in columns.items()
        }
        self._write_table(name, pyarrow.table(arrays))

    def _write_table(self, name: str, table: Any) -> None:
        from pyarrow import parquet

        path = self._folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        parquet.write_table(table, path, compression="zstd")

    def _write_json(self, name: str, content: Any) -> None:
        path = self._folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(json.dumps(content, indent=4) + "\n", encoding="utf-8")


def _file_name(number: int) -> str:
    return f"chunk-{number // _CHUNK_FILES:03d}/file-{number % _CHUNK_FILES:03d}.parquet"


def _arrow_array(values: NDArray[Any]) -> Any:
    """Return an Arrow array of rows: lists of fixed length for vectors, lists of lists for matrices."""
    import pyarrow

    if values.ndim == 1:
        return pyarrow.array(values)
    inner = _arrow_array(values.reshape(-1, *values.shape[2:]))
    if values.ndim == 2:
        return pyarrow.FixedSizeListArray.from_arrays(inner, values.shape[1])
    offsets = np.arange(0, len(values) * values.shape[1] + 1, values.shape[1], dtype=np.int32)
    return pyarrow.ListArray.from_arrays(
        pyarrow.array(offsets), inner.cast(pyarrow.list_(inner.type.value_type))
    )


def _statistics(values: NDArray[Any]) -> dict[str, NDArray[Any]]:
    """Return the figures of a column over its rows; those of numbers have the shape (1,)."""
    values = values.reshape(len(values), 1) if values.ndim == 1 else values
    return {
        "min": values.min(axis=0),
        "max": values.max(axis=0),
        "mean": values.mean(axis=0, dtype=np.float64),
        "std": values.std(axis=0, dtype=np.float64),
        "count": np.array([len(values)]),
        **{name: np.quantile(values, part, axis=0) for name, part in _QUANTILES.items()},
    }
