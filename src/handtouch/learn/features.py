"""The features of touch, written down once, and the function that makes them from any source.

Public names: `TouchFeatures`, `Feature`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from handtouch.client.hand_arrays import SAMPLED_STATES
from handtouch.wire import ForceStatus, FrameStatus, PadState, PositionStatus

FloatArray = NDArray[np.float32]
Frame = Literal["pad", "link", "palm"]
MAX_AGE_S = 1.0
"""Longest age that is told; older samples, and none at all, have this one"""
_MAX_FORCE_N = 100.0
"""Bound of forces for spaces that need one: ten times the largest that a shipped pad measures"""
_MAX_POSITION_M = 0.5


class Feature(NamedTuple):
    """One number of a pad."""

    name: str
    unit: str
    """empty for a flag, which is 0 or 1"""
    low: float
    high: float
    meaning: str


_FLAGS = (
    Feature("sampled", "", 0.0, 1.0, "the pad is sampled; else nothing of it is known"),
    Feature("touched", "", 0.0, 1.0, "it has a contact"),
    Feature("position_known", "", 0.0, 1.0, "there is a position; else it is 0"),
    Feature("position_valid", "", 0.0, 1.0, "it is in its interval: the status is `valid`"),
    Feature("force_known", "", 0.0, 1.0, "there is a force, 0 N of a clear pad; else it is 0"),
    Feature("force_valid", "", 0.0, 1.0, "it is in its interval: the status is `valid`, or the pad clear"),
)
_AXES = "xyz"
_FRAMES = {"pad": "pad_m", "link": "position_m", "palm": "palm_position_m"}
_VECTORS = {"pad": "force_vector_n", "link": "force_vector_n", "palm": "palm_force_vector_n"}


class TouchFeatures:
    """Layout of the touch of some pads, and the function `of` that fills it: float32, pads one after another.

    The layout is the same, byte for byte, whatever it is filled from: a `Hand`, its `HandArrays` or
    `HandWindow`, a `TactileReading` of a simulation, or the frames of a recording.

    `links`: the pads, in this order. `frame`: of positions: arc lengths on the "pad" (x, y), or the "link" or
    the "palm" (x, y, z; the palm's need its output in the scene). `vector`: force vectors, of pads above a
    shear pad, instead of normal forces. What isn't known is 0, and its flag says so: a policy must read the
    flags. Raises ValueError for no link, a link twice, or another frame.
    """

    def __init__(self, links: Sequence[str], *, frame: Frame = "link", vector: bool = False) -> None:
        if not links or len(set(links)) < len(links):
            raise ValueError(f"links are {list(links)}; give at least one, none twice")
        if frame not in _FRAMES:
            raise ValueError(f'frame is "{frame}"; it is one of {", ".join(_FRAMES)}')
        self.links, self.frame, self.vector = tuple(links), frame, vector
        self.features = (*_FLAGS, *_measured(frame, vector))
        """of each pad"""

    @property
    def names(self) -> list[str]:
        """LINK.FEATURE, in the order of the values."""
        return [f"{link}.{feature.name}" for link in self.links for feature in self.features]

    @property
    def size(self) -> int:
        """Number of values."""
        return len(self.links) * len(self.features)

    @property
    def low(self) -> FloatArray:
        """(size,) least values."""
        return np.tile(np.array([feature.low for feature in self.features], np.float32), len(self.links))

    @property
    def high(self) -> FloatArray:
        """(size,) greatest values."""
        return np.tile(np.array([feature.high for feature in self.features], np.float32), len(self.links))

    def declaration(self, samples: int | None = None) -> dict[str, Any]:
        """Return them as LeRobot declares a feature of a dataset; `samples`: of a window, `of_window`."""
        if samples is None:
            return {"dtype": "float32", "shape": (self.size,), "names": self.names}
        return {"dtype": "float32", "shape": (samples, self.size), "names": ["sample", "feature"]}

    def of(
        self,
        source: Any,
        now_ns: NDArray[np.int64] | int | None = None,
        links: Sequence[str] | None = None,
    ) -> FloatArray:
        """Return the features (..., size) of a source whose columns are (..., pads, ...).

        `now_ns`: time for the ages, on the clock of `sample_ns`; default: the source's own (`Hand.now_ns`,
        the SYNC of a frame, the newest sample of a `TactileReading`). `links`: of the source's pads, where it
        doesn't have them itself: `TactileSensor.links`. A `Hand` that isn't alive has no pad that is sampled.
        Raises LookupError for a link that the source doesn't have, and for a column that isn't published.
        """
        if not getattr(source, "alive", True):
            return self._unsampled()
        read = _reader(source)
        rows = _rows_of(source.links if links is None else links, self.links)
        state, sample_ns = read("state")[..., rows], read("sample_ns")[..., rows]
        sampled = _sampled(source, state, rows)
        touched = sampled & (state == PadState.TOUCHED)
        now = _now_ns(source, sample_ns) if now_ns is None else np.asarray(now_ns)
        age_s = np.where(sample_ns > 0, 1e-9 * (now[..., None] - sample_ns), MAX_AGE_S)
        position_m, position_known, position_valid = self._positions(read, rows, touched)
        force_n, force_known, force_valid = self._forces(read, rows, sampled, touched)
        columns = [
            sampled,
            touched,
            position_known,
            position_valid,
            force_known,
            force_valid,
            *(np.where(position_known, value, 0.0) for value in position_m),
            *(np.where(force_known, value, 0.0) for value in force_n),
            np.clip(age_s, 0.0, MAX_AGE_S),
        ]
        filled: FloatArray = np.stack(columns, axis=-1).astype(np.float32)
        return filled.reshape(*filled.shape[:-2], self.size)

    def of_window(self, window: Any, samples: int) -> FloatArray:
        """Return the newest samples of a `HandWindow`, (samples, size), oldest first.

        Where it has fewer, the first rows are 0: not sampled. Ages are those at each sample's SYNC.
        """
        filled = np.zeros((samples, self.size), np.float32)
        found = self.of(window)[-samples:] if len(window) else filled[:0]
        filled[samples - len(found) :] = found
        return filled

    def _unsampled(self) -> FloatArray:
        values = np.zeros((len(self.links), len(self.features)), np.float32)
        values[:, -1] = MAX_AGE_S
        return values.ravel()

    def _positions(
        self, read: Callable[[str], NDArray[Any]], rows: list[int], touched: NDArray[np.bool_]
    ) -> tuple[list[NDArray[Any]], NDArray[np.bool_], NDArray[np.bool_]]:
        """Return coordinates and standard deviation, where they are known, and where valid."""
        position = read(_FRAMES[self.frame])[..., rows, :]
        prefix = "palm_" if self.frame == "palm" else ""
        std = _root_of_trace(read(f"{prefix}covariance_m2")[..., rows, :, :])
        known = touched & np.isfinite(position).all(axis=-1) & np.isfinite(std)
        valid = known & (read("position_status")[..., rows] == PositionStatus.VALID)
        if self.frame == "palm":
            valid = valid & (read("palm_status")[..., rows] == FrameStatus.VALID)
        return [*np.moveaxis(position, -1, 0), std], known, valid

    def _forces(
        self,
        read: Callable[[str], NDArray[Any]],
        rows: list[int],
        sampled: NDArray[np.bool_],
        touched: NDArray[np.bool_],
    ) -> tuple[list[NDArray[Any]], NDArray[np.bool_], NDArray[np.bool_]]:
        """Return components and standard deviation, where they are known, and where valid."""
        clear = sampled & ~touched
        if self.vector:
            force = np.moveaxis(read(_VECTORS[self.frame])[..., rows, :], -1, 0)
            std = _root_of_trace(read("force_vector_covariance_n2")[..., rows, :, :])
            status = read("force_vector_status")[..., rows]
        else:
            force = read("force_n")[None, ..., rows]
            std, status = read("force_std_n")[..., rows], read("force_status")[..., rows]
        known = clear | touched & np.isfinite(force).all(axis=0) & np.isfinite(std)
        valid = known & (clear | (status == ForceStatus.VALID))
        return [*(np.where(clear, 0.0, value) for value in (*force, std))], known, valid


def _root_of_trace(covariance: NDArray[Any]) -> NDArray[Any]:
    """Return the root of the sum of variances; NaN of unknown ones."""
    return np.asarray(np.sqrt(np.maximum(np.trace(covariance, axis1=-2, axis2=-1), 0.0)))


def _measured(frame: Frame, vector: bool) -> tuple[Feature, ...]:
    axes = _AXES[:2] if frame == "pad" else _AXES
    where = {"pad": "on the pad", "link": "in the link's frame", "palm": "in the palm's frame"}[frame]
    position = tuple(
        Feature(f"{axis}_m", "m", -_MAX_POSITION_M, _MAX_POSITION_M, f"contact position {where}")
        for axis in axes
    )
    names = [f"force_{axis}_n" for axis in _AXES] if vector else ["force_n"]
    low = -_MAX_FORCE_N if vector else 0.0
    force = tuple(
        Feature(name, "N", low, _MAX_FORCE_N, f"force {where}" if vector else "normal force")
        for name in names
    )
    std = "standard deviation of the position: root of the sum of its variances"
    return (
        *position,
        Feature("position_std_m", "m", 0.0, _MAX_POSITION_M, std),
        *force,
        Feature("force_std_n", "N", 0.0, _MAX_FORCE_N, std.replace("position", "force")),
        Feature("age_s", "s", 0.0, MAX_AGE_S, f"age of the sample, {MAX_AGE_S:g} at most"),
    )


def _reader(source: Any) -> Callable[[str], NDArray[Any]]:
    """Return a function that reads a column by its name: an array, or that of a `LinkColumn`."""

    def read(name: str) -> NDArray[Any]:
        column = getattr(source, name)
        return np.asarray(getattr(column, "array", column))

    return read


def _rows_of(present: Sequence[str], links: Sequence[str]) -> list[int]:
    """Return the rows of links, of which those present may have their hand before them.

    Raises LookupError naming those that there are.
    """
    short = [link.rpartition("/")[2] for link in present]
    names = present if len(set(short)) < len(short) else short
    rows: Mapping[str, int] = {
        **{name: row for row, name in enumerate(names)},
        **{link: row for row, link in enumerate(present)},
    }
    for link in links:
        if link not in rows:
            raise LookupError(f"there is no pad on {link!r}; the links are {', '.join(rows)}")
    return [rows[link] for link in links]


def _sampled(source: Any, state: NDArray[Any], rows: list[int]) -> NDArray[np.bool_]:
    """Return where pads are sampled: of a `Hand` also by the age of its frame."""
    sampled = getattr(source, "sampled", None)
    if sampled is None:
        return np.isin(state, SAMPLED_STATES)
    return np.asarray(getattr(sampled, "array", sampled), np.bool_)[..., rows]


def _now_ns(source: Any, sample_ns: NDArray[np.int64]) -> NDArray[np.int64]:
    if hasattr(source, "now_ns"):
        return np.asarray(source.now_ns())
    if hasattr(source, "t_ns"):
        return np.asarray(source.t_ns)
    return np.asarray(sample_ns.max(axis=-1))
