"""One quantity of every pad of a hand, by link.

Public names: `LinkColumn`, `StatusColumn`, `TouchedColumn`, `FrameColumn`, `NotSampledError`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from typing import Any, Generic, Protocol, Self, TypeVar, cast, overload

import numpy as np
from numpy.lib.mixins import NDArrayOperatorsMixin
from numpy.typing import NDArray

from handtouch import wire
from handtouch.client.names import link_hint

T = TypeVar("T")
DefaultT = TypeVar("DefaultT")
StatusT = TypeVar("StatusT", bound=wire.StatusCode)


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

    @overload
    def get(self, link: str, /) -> T | None: ...
    @overload
    def get(self, link: str, /, default: T | DefaultT) -> T | DefaultT: ...
    def get(self, link: str, /, default: Any = None) -> Any:
        """Return the value, or `default` where it isn't known now.

        Raises KeyError for an unknown link, which would be unknown for ever.
        """
        self._row(link)
        try:
            return self[link]
        except NotSampledError:
            return default

    def __contains__(self, link: object) -> bool:
        return link in self._rows

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


class HasColumns(Protocol):
    """An object with columns by name."""

    def column(self, name: str) -> LinkColumn[Any]:
        """Return a column by its name. Raises LookupError while it isn't published."""


class FrameColumn(Generic[T]):
    """Attribute that returns a column of the newest frame; its name is the column's."""

    def __init__(self, meaning: str) -> None:
        self.__doc__ = meaning

    def __set_name__(self, _: type, name: str) -> None:
        self._name = name

    @overload
    def __get__(self, owner: None, _: type) -> Self: ...
    @overload
    def __get__(self, owner: HasColumns, _: type) -> LinkColumn[T]: ...
    def __get__(self, owner: HasColumns | None, _: type) -> Self | LinkColumn[T]:
        return self if owner is None else owner.column(self._name)
