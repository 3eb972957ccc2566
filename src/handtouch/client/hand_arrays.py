"""Arrays of a hand frame by link, and the wrenches of its contacts.

Public names: `FrameName`, `LinkColumns`, `HandArrays`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from fnmatch import fnmatchcase
from functools import cached_property
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from handtouch import wire
from handtouch.arrays import FloatArray
from handtouch.client.frame_columns import FrameColumns
from handtouch.client.link_column import FrameColumn, LinkColumn, StatusColumn, TouchedColumn
from handtouch.client.wrench import (
    GraspMatrix,
    Wrench,
    contact_wrenches,
    grasp_matrix,
    sum_wrenches,
    turn_covariance,
)

FrameName = Literal["link", "palm", "base"]
"""Frame of positions, normals and wrenches: of each link, or of the links that the deployment names."""
_COLUMNS = wire.COLUMNS[wire.HandFrame]
_OF_PADS = ("state", "sampled", "sample_ns", "total_current_a", "joints_age_s")
"""Columns that also pads without a contact have a value in"""
SAMPLED_STATES = (wire.PadState.CLEAR, wire.PadState.TOUCHED)
"""States of pads of which it is known whether they are touched"""


class LinkColumns(FrameColumns):
    """The columns of `wire.HandFrame` by link, as attributes; a row per pad.

    Unknown values are NaN. Those of the palm and the base raise LookupError while no scene requests them, and
    force vectors for a hand without shear pads.
    """

    touched = FrameColumn[bool](
        "True where the pad has a contact. Reading it of a pad that isn't sampled raises NotSampledError; "
        "`touched.get(link)` returns None there, and `touched.array` is masked."
    )
    sampled = FrameColumn[bool]("True where the pad is sampled, so that no contact means none.")

    def column(self, name: str) -> LinkColumn[Any]:
        """Return a column by its name. Raises LookupError while it isn't published."""
        raise NotImplementedError


class HandArrays(LinkColumns):
    """All pads of a hand at one tick, as arrays by link; immutable."""

    def __init__(self, frame: wire.HandFrame, rows: Mapping[str, int] | None = None) -> None:
        self.frame = frame
        """the message it was made of"""
        self._rows = rows if rows is not None else {link: row for row, link in enumerate(frame.links)}
        self._cache: dict[str, LinkColumn[Any]] = {}

    @property
    def links(self) -> tuple[str, ...]:
        """Links in the order of the rows."""
        return self.frame.links

    @property
    def t_ns(self) -> int:
        """SYNC of the tick, on the daemon's monotonic clock."""
        return self.frame.t_ns

    def column(self, name: str) -> LinkColumn[Any]:
        """Return a column by its name. Raises LookupError while no scene requests it."""
        found = self._cache.get(name)
        if found is None:
            found = self._cache[name] = self._make_column(name)
        return found

    def as_old(self) -> HandArrays:
        """Return the same frame as one too old to be believed: no pad counts as sampled."""
        old = HandArrays(self.frame, self._rows)
        nothing = np.zeros(len(self.links), np.bool_)
        old._cache["sampled"] = LinkColumn(nothing, self._rows)
        old._cache["touched"] = TouchedColumn(np.ma.MaskedArray(nothing, mask=True), self._rows)
        return old

    def age_at(self, now_ns: int) -> LinkColumn[float]:
        """Return the age [s] of each pad's sample at a time on the daemon's clock; infinite without one."""
        sample_ns = self.sample_ns.array
        age_s = np.where(sample_ns > 0, (now_ns - sample_ns) * 1e-9, np.inf)
        return LinkColumn(age_s, self._rows)

    def wrenches(self, frame: FrameName = "palm", links: str = "*") -> dict[str, Wrench]:
        """Return the wrench of each contact on links that match a pattern, about the origin of the frame.

        Contacts without a valid force, or a valid position in that frame, are left out. A valid force vector
        counts in place of the normal force. Raises LookupError while no scene requests the frame.
        """
        rows = self._rows_of(links) & self._usable(frame)
        made = contact_wrenches(
            *self._geometry(frame, rows), *self._forces(rows), *self._force_vectors(frame, rows)
        )
        return dict(zip(self._names(rows), made, strict=True))

    def wrench(self, links: str = "*", frame: FrameName = "palm") -> Wrench:
        """Return the total wrench of the contacts on links that match a pattern, such as a finger's.

        `missing` names the links that it lacks: without a valid sample, force or position. In the frame
        "link" the pattern must match one link. Raises LookupError for a pattern without a link and while no
        scene requests the frame, ValueError for several links in the frame "link".
        """
        rows = self._rows_of(links)
        if frame == "link" and rows.sum() > 1:
            raise ValueError(f"{links!r} matches {rows.sum()} links, and each has a frame of its own")
        missing = self._names(rows & ~self._is_clear & ~self._usable(frame))
        return sum_wrenches(list(self.wrenches(frame, links).values()), missing)

    def require(self, links: str | Sequence[str] = "*") -> None:
        """Raise NotSampledError naming the pads on links that match the patterns and aren't sampled."""
        for pattern in (links,) if isinstance(links, str) else links:
            for link in self._names(self._rows_of(pattern) & ~self.sampled.array):
                _ = self.touched[link]

    def total_force_n(self, links: str = "*") -> tuple[float, float]:
        """Return the sum of the normal forces on links that match a pattern, and its standard deviation [N].

        NaN if one of them has no valid sample or force. Raises LookupError for a pattern without a link.
        """
        rows = self._rows_of(links) & ~self._is_clear
        if not self._valid_force[rows].all():
            return float("nan"), float("nan")
        force_n, std_n = self._forces(rows)
        return float(force_n.sum()), float(np.sqrt((std_n**2).sum()))

    def grasp_matrix(self, frame: FrameName = "palm", links: str = "*") -> GraspMatrix:
        """Return the map from contact forces to the wrench on the object, for valid positions.

        Raises LookupError as `wrench`.
        """
        rows = self._rows_of(links) & self._is_located(frame)
        position_m, normal, _ = self._geometry(frame, rows)
        return GraspMatrix(grasp_matrix(position_m, normal), self._names(rows))

    @cached_property
    def _is_clear(self) -> NDArray[np.bool_]:
        return np.asarray(self.sampled.array & (self.state.array == wire.PadState.CLEAR))

    @cached_property
    def _valid_force(self) -> NDArray[np.bool_]:
        touched = self.sampled.array & (self.state.array == wire.PadState.TOUCHED)
        return np.asarray(touched & (self.force_status.array == wire.ForceStatus.VALID))

    def _is_located(self, frame: FrameName) -> NDArray[np.bool_]:
        if frame == "link":
            return np.asarray(self.position_status.array == wire.PositionStatus.VALID)
        return np.asarray(self.column(f"{frame}_status").array == wire.FrameStatus.VALID)

    def _usable(self, frame: FrameName) -> NDArray[np.bool_]:
        return np.asarray(self._valid_force & self._is_located(frame))

    def _geometry(
        self, frame: FrameName, rows: NDArray[np.bool_]
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        prefix = "" if frame == "link" else f"{frame}_"
        names = ("position_m", "normal", "covariance_m2")
        position_m, normal, covariance_m2 = (
            self.column(prefix + name).array[rows].astype(np.float64) for name in names
        )
        return position_m, normal, covariance_m2

    def _forces(self, rows: NDArray[np.bool_]) -> tuple[FloatArray, FloatArray]:
        force_n, std_n = (c.array[rows].astype(np.float64) for c in (self.force_n, self.force_std_n))
        return force_n, std_n

    def _force_vectors(self, frame: FrameName, rows: NDArray[np.bool_]) -> tuple[FloatArray, ...]:
        """Return force vectors and covariances in a frame, NaN where none is valid; () without shear pads."""
        prefix = "" if frame == "link" else f"{frame}_"
        if not (self.frame.force_vector_status and getattr(self.frame, f"{prefix}force_vector_n")):
            return ()
        valid = self.force_vector_status.array[rows] == wire.ForceStatus.VALID
        names = ("force_vector_n", "normal", "force_vector_covariance_n2")
        vector_n, normal, covariance_n2 = (self.column(name).array[rows].astype(np.float64) for name in names)
        vector_n[~valid] = np.nan
        if frame == "link":
            return vector_n, covariance_n2
        turned_n, turned = (self.column(prefix + name).array[rows].astype(np.float64) for name in names[:2])
        turned_n[~valid] = np.nan
        return turned_n, turn_covariance(covariance_n2, normal, vector_n, (turned, turned_n))

    def _rows_of(self, pattern: str) -> NDArray[np.bool_]:
        rows = np.array([fnmatchcase(link, pattern) for link in self.links], np.bool_)
        if not rows.any():
            raise LookupError(f"no link matches {pattern!r}; the links are {', '.join(self.links)}")
        return rows

    def _names(self, rows: NDArray[np.bool_]) -> tuple[str, ...]:
        return tuple(link for link, chosen in zip(self.links, rows, strict=True) if chosen)

    def _make_column(self, name: str) -> LinkColumn[Any]:
        if name == "touched":
            state = self.state.array
            is_unknown = ~np.isin(state, SAMPLED_STATES)
            touched = np.ma.MaskedArray(state == wire.PadState.TOUCHED, mask=is_unknown)
            return TouchedColumn(touched, self._rows, self._why_unknown)
        codes = _COLUMNS[name].codes if name in _COLUMNS else None
        if codes is not None:
            return StatusColumn(self._make_array(name), self._rows, codes)
        is_of_contact = name not in _OF_PADS
        return LinkColumn(self._make_array(name), self._rows, self._is_clear if is_of_contact else None)

    def _why_unknown(self, row: int) -> str:
        state, sample_ns = int(self.state.array[row]), int(self.sample_ns.array[row])
        age_s = 1e-9 * (self.t_ns - sample_ns)
        age = f"its last sample is {age_s:.3f} s old" if sample_ns else "no sample yet"
        known = [member.text for member in wire.PadState if member == state]
        return f"the pad is {known[0] if known else f'in state {state}'}, {age}"

    def __repr__(self) -> str:
        """A line for each pad: link, state, position and force."""
        lines = [f"hand {self.frame.hand}, tick {self.frame.tick}"]
        for link, state in self.state.items():
            line = f"{link}: {state}"
            if state == "touched":
                x, y, z = 1e3 * self.position_m[link]
                line += f" at ({x:.1f}, {y:.1f}, {z:.1f}) mm" if self.position_status[link] == "valid" else ""
                force, std = self.force_n[link], self.force_std_n[link]
                status = self.force_status[link]
                line += f", {force:.2f} +- {std:.2f} N" if status == "valid" else f", force {status}"
            lines.append(line)
        return "\n  ".join(lines)

    def _make_array(self, name: str) -> NDArray[Any]:
        if name == "sampled":
            return np.isin(self.state.array, SAMPLED_STATES)
        data = getattr(self.frame, name)
        if not data and self.links and name.startswith("force_vector"):
            raise LookupError(f"{name} needs a pad with a shear pad; see docs/shear.md")
        if not data and self.links:
            output = name.split("_")[0] if name != "group" else "palm"
            raise LookupError(f'no scene requests {name}; add "{output}" to the outputs of the scene')
        array = _COLUMNS[name].to_array(data)
        return array.reshape(-1, 3, 3) if array.shape[1:] == (9,) else array
