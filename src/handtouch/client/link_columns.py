"""Arrays of a hand frame by link, and the wrenches of its contacts.

Public names: `LinkColumn`, `StatusColumn`, `TouchedColumn`, `NotSampledError`, `HandArrays`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from fnmatch import fnmatchcase
from functools import cached_property
from typing import Any, Generic, Literal, Self, TypeVar, cast, overload

import numpy as np
from numpy.lib.mixins import NDArrayOperatorsMixin
from numpy.typing import NDArray

from handtouch import wire
from handtouch.client.names import link_hint
from handtouch.client.wrench import (
    GraspMatrix,
    Wrench,
    contact_wrenches,
    grasp_matrix,
    sum_wrenches,
    turn_covariance,
)

T = TypeVar("T")
StatusT = TypeVar("StatusT", bound=wire.StatusCode)
FrameName = Literal["link", "palm", "base"]
"""Frame of positions, normals and wrenches: of each link, or of the links that the deployment names."""
FloatArray = NDArray[np.float64]
_COLUMNS = wire.COLUMNS[wire.HandFrame]
_OF_PADS = ("state", "sampled", "sample_ns", "total_current_a", "joints_age_s")
"""Columns that also pads without a contact have a value in"""
SAMPLED_STATES = (wire.PadState.CLEAR, wire.PadState.TOUCHED)
"""States of pads of which it is known whether they are touched"""


class LinkColumn(NDArrayOperatorsMixin, Mapping[str, T], Generic[T]):
    """One quantity of every pad: a read-only mapping from link to value, and an array in `array`.

        hand.force_n["index_distal"]     # a number, or a row such as (3,) of position_m
        hand.force_n.array               # (n,) or (n, elements), in the order of hand.links
        hand.force_n * 2, hand.force_n.max()

    numpy accepts it as an array, and arithmetic returns arrays. An unknown link raises KeyError naming the
    closest one. `sum`, `mean`, `min` and `max` are over pads that have a contact, or may have one: clear pads
    don't count, and pads that aren't sampled make the result NaN.
    """

    __slots__ = ("_rows", "array", "clear")

    def __init__(
        self, array: NDArray[Any], rows: Mapping[str, int], clear: NDArray[np.bool_] | None = None
    ) -> None:
        self.array = array
        self.clear = np.zeros(len(array), np.bool_) if clear is None else clear
        """(n,) pads that are sampled and have no contact, where the column is of contacts"""
        self._rows = rows

    def __getitem__(self, link: str) -> T:
        value = self.array[self._row(link)]
        return cast(T, value.item() if self.array.ndim == 1 else value)

    def _row(self, link: str) -> int:
        try:
            return self._rows[link]
        except (KeyError, TypeError):
            if not isinstance(link, str):
                names = ", ".join(self._rows)
                raise TypeError(
                    f"{link!r} is no link; the links are {names}, and rows of numbers are in .array"
                ) from None
            raise KeyError(f"no link {link!r}; {link_hint(link, self._rows)}") from None

    def __iter__(self) -> Iterator[str]:
        return iter(self._rows)

    def __len__(self) -> int:
        return len(self._rows)

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> NDArray[Any]:
        return np.array(self.array, dtype=dtype, copy=copy)

    def __array_ufunc__(self, ufunc: np.ufunc, method: str, *inputs: Any, **options: Any) -> Any:
        arrays = (value.array if isinstance(value, LinkColumn) else value for value in inputs)
        return getattr(ufunc, method)(*arrays, **options)

    def __eq__(self, other: object) -> Any:
        return dict(self) == dict(other) if isinstance(other, Mapping) else self.array == other

    def __ne__(self, other: object) -> Any:
        return dict(self) != dict(other) if isinstance(other, Mapping) else self.array != other

    __hash__ = None  # type: ignore[assignment]

    def sum(self) -> Any:
        """Return the sum, 0 without a contact; of rows by element."""
        return self.array[~self.clear].sum(axis=0)

    def mean(self) -> Any:
        """Return the mean, NaN without a contact."""
        return self._of_touched(np.mean)

    def min(self) -> Any:
        """Return the least value, NaN without a contact."""
        return self._of_touched(np.min)

    def max(self) -> Any:
        """Return the greatest value, NaN without a contact."""
        return self._of_touched(np.max)

    def _of_touched(self, function: Callable[..., Any]) -> Any:
        values = self.array[~self.clear]
        return function(values, axis=0) if len(values) else np.full(self.array.shape[1:], np.nan)[()]

    def __repr__(self) -> str:
        return repr(dict(self))


class StatusColumn(LinkColumn[StatusT]):
    """A status of every pad; its values are codes that equal their names.

    hand.force_status["index_distal"] == "valid"
    hand.force_status == "valid"         # (n,) booleans
    hand.force_status.array              # (n,) codes

    """

    __slots__ = ("_codes",)

    def __init__(self, array: NDArray[Any], rows: Mapping[str, int], codes: type[StatusT]) -> None:
        super().__init__(array, rows)
        self._codes = codes

    def __getitem__(self, link: str) -> StatusT:
        code = int(self.array[self._row(link)])
        try:
            return self._codes(code)
        except ValueError:  # of a later version
            return cast(StatusT, code)

    def __eq__(self, other: object) -> Any:
        return super().__eq__(self._code(other))

    def __ne__(self, other: object) -> Any:
        return super().__ne__(self._code(other))

    __hash__ = None

    def _code(self, other: object) -> object:
        """Return the code of a name. Raises ValueError for an unknown one, which would never be equal."""
        if not isinstance(other, str):
            return other
        for code in self._codes:
            if str(code) == other:
                return code
        raise ValueError(f"{other!r} is no status; they are {', '.join(map(str, self._codes))}")

    def __repr__(self) -> str:
        return repr({link: str(code) for link, code in self.items()})


class NotSampledError(KeyError):
    """A pad isn't sampled, so that nobody knows whether it is touched; the text has link, state and age."""

    def __str__(self) -> str:
        return str(self.args[0])


class TouchedColumn(LinkColumn[bool]):
    """Whether each pad has a contact, where that is known.

    hand.touched["index_distal"]        # raises NotSampledError where the pad isn't sampled
    hand.touched.get("index_distal")    # None there
    hand.touched.array                  # masked there

    """

    __slots__ = ("_reason",)

    def __init__(
        self, array: NDArray[Any], rows: Mapping[str, int], reason: Callable[[int], str] | None = None
    ) -> None:
        super().__init__(array, rows)
        self._reason = reason or (lambda _: "its frame is old")

    def __getitem__(self, link: str) -> bool:
        row = self._row(link)
        if np.ma.getmaskarray(self.array)[row]:
            raise NotSampledError(f"whether {link!r} is touched isn't known: {self._reason(row)}")
        return bool(self.array[row])

    def __repr__(self) -> str:
        return repr({link: self.get(link) for link in self})


class _FrameColumn(Generic[T]):
    """Attribute that returns a column of the newest frame; its name is the column's."""

    def __init__(self, meaning: str) -> None:
        self.__doc__ = meaning

    def __set_name__(self, _: type, name: str) -> None:
        self._name = name

    @overload
    def __get__(self, owner: None, _: type) -> Self: ...
    @overload
    def __get__(self, owner: LinkColumns, _: type) -> LinkColumn[T]: ...
    def __get__(self, owner: LinkColumns | None, _: type) -> Self | LinkColumn[T]:
        return self if owner is None else owner.column(self._name)


class LinkColumns:
    """The columns of `wire.HandFrame` by link, as attributes; a row per pad.

    Unknown values are NaN. Those of the palm and the base raise LookupError while no scene requests them, and
    force vectors for a hand without shear pads.
    """

    state = _FrameColumn[wire.PadState]("State of the pad, a `wire.PadState`; only CLEAR means no contact.")
    touched = _FrameColumn[bool](
        "True where the pad has a contact. Reading it of a pad that isn't sampled raises NotSampledError; "
        "`touched.get(link)` returns None there, and `touched.array` is masked."
    )
    sampled = _FrameColumn[bool]("True where the pad is sampled, so that no contact means none.")
    contact_id = _FrameColumn[int]("Id of the contact, 0 for none.")
    sample_ns = _FrameColumn[int]("Time of the sample on the daemon's clock [ns], 0 before the first.")
    total_current_a = _FrameColumn[float]("Total current of the newest sample [A].")
    position_m = _FrameColumn[FloatArray]("(3,) contact position in the link's frame [m].")
    normal = _FrameColumn[FloatArray]("(3,) outward unit normal of the pad at the position.")
    covariance_m2 = _FrameColumn[FloatArray]("(3, 3) covariance of the position [m^2].")
    mount_covariance_m2 = _FrameColumn[FloatArray]("(3, 3) part of it by the pad's mount [m^2].")
    pad_m = _FrameColumn[FloatArray]("(2,) arc lengths on the pad, from the electrodes x0 and y0 [m].")
    position_status = _FrameColumn[wire.PositionStatus]("Status of the position, a `wire.PositionStatus`.")
    force_n = _FrameColumn[float]("Normal force [N].")
    force_std_n = _FrameColumn[float]("Its standard deviation [N]; NaN where the force is a lower bound.")
    force_status = _FrameColumn[wire.ForceStatus]("Status of the force, a `wire.ForceStatus`.")
    residual = _FrameColumn[float]("Deviation from a point contact, as in `wire.Contact`.")
    residual_std = _FrameColumn[float]("Its standard deviation for a point contact.")
    group = _FrameColumn[int]("The same for contacts that one object may bridge, 0 without contact.")
    palm_status = _FrameColumn[wire.FrameStatus]("Status in the palm's frame, a `wire.FrameStatus`.")
    palm_position_m = _FrameColumn[FloatArray]("(3,) contact position in the palm's frame [m].")
    palm_normal = _FrameColumn[FloatArray]("(3,) outward unit normal in the palm's frame.")
    palm_covariance_m2 = _FrameColumn[FloatArray]("(3, 3) its covariance in the palm's frame [m^2].")
    base_status = _FrameColumn[wire.FrameStatus]("Status in the base's frame, a `wire.FrameStatus`.")
    base_position_m = _FrameColumn[FloatArray]("(3,) contact position in the base's frame [m].")
    base_normal = _FrameColumn[FloatArray]("(3,) outward unit normal in the base's frame.")
    base_covariance_m2 = _FrameColumn[FloatArray]("(3, 3) its covariance in the base's frame [m^2].")
    joints_age_s = _FrameColumn[float]("Time from the sample to the nearest joint state [s].")
    force_vector_status = _FrameColumn[wire.ForceStatus]("Status of the force vector, a `wire.ForceStatus`.")
    force_vector_n = _FrameColumn[FloatArray]("(3,) force on the pad in the link's frame [N].")
    force_vector_covariance_n2 = _FrameColumn[FloatArray]("(3, 3) its covariance [N^2].")
    palm_force_vector_n = _FrameColumn[FloatArray]("(3,) force on the pad in the palm's frame [N].")
    base_force_vector_n = _FrameColumn[FloatArray]("(3,) force on the pad in the base's frame [N].")

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
