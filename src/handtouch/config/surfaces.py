"""The `surface` table of a pad, one definition for each kind in the registry of `handtouch.field`, to which
entry points of the group `handtouch.surfaces` add (docs/extend.md).

Public names: `SurfaceTable`, `SURFACE_TABLES`, `PadSurface`, `surface_table`. Keys, ranges and descriptions
are declared by the surface classes; nothing here names a shape.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from functools import cache, lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, Self

from pydantic import Field, TypeAdapter, create_model

from handtouch import field
from handtouch.config.base import OneOfKinds, Table
from handtouch.field.embedded_file import embed_file, read_embedded
from handtouch.field.surface import AnisotropicSurface
from handtouch.field.surface_base import SURFACES, Surface, SurfaceKey, surface_keys
from handtouch.host.plugins import load_plugins

load_plugins("handtouch.surfaces", Surface)  # classes that name a kind register themselves


class SurfaceTable(Table):
    """The shape of a sensing surface; its keys, in millimetres and degrees, depend on `kind`."""

    kind: str
    resistivity_ratio: float = Field(
        1.0,
        gt=0,
        description="resistivity of the sheet along x over that along y, as it lies on this pad; "
        "ohm_per_square is then their geometric mean",
    )

    if TYPE_CHECKING:

        def __getattr__(self, key: str) -> Any:
            """Return the value of one of the shape's own keys."""

    def build(self) -> Surface:
        """Return the surface in metres and radians. Raises ValueError for a shape that can't exist."""
        return _build(self)

    @property
    def rectangle_mm(self) -> tuple[float, float]:
        """Sides (a, b) [mm] of the conformal rectangle."""
        surface = self.build()
        return surface.a * 1e3, surface.b * 1e3

    def with_embedded_files(self, folder: Path) -> Self:
        """Return the table with the content of the files that it names, relative to `folder`."""
        names = [key.name for key in surface_keys(SURFACES[self.kind]).values() if key.is_file]
        return self.model_copy(update={name: embed_file(getattr(self, name), folder) for name in names})

    def problems(self) -> Iterator[tuple[str, str]]:
        """Yield (key, remedy) for every reason why no such surface exists; key "" for the whole table."""
        shape = SURFACES[self.kind]
        found = list(shape.check_keys(self.model_dump()))
        if not found:
            try:
                self.build()
            except ValueError as error:
                found = [_in_keys_of_the_file(shape, str(error))]
        yield from found


@lru_cache(maxsize=256)
def _build(table: SurfaceTable) -> Surface:
    surface = SURFACES[table.kind].from_keys(table.model_dump())
    ratio = table.resistivity_ratio
    return surface if ratio == 1 else AnisotropicSurface(surface, ratio)


def _in_keys_of_the_file(shape: type[Surface], text: str) -> tuple[str, str]:
    """Return the key that an error of the constructor is about, and its text with the file's key names."""
    first = ""
    for name, key in surface_keys(shape).items():
        if text.startswith(name):
            first = key.name
        text = text.replace(name, key.name)
    return first, text.removeprefix(first).removeprefix(":").strip()


def _key_field(key: SurfaceKey) -> tuple[Any, Any]:
    """Return type and pydantic field of a key."""
    number = Annotated[float, Field(gt=key.above, lt=key.below, le=key.at_most)]
    examples = None if key.example is None else [key.example]
    if key.is_file:
        return str, Field(min_length=1, description=key.description, examples=examples)
    if key.is_list:
        numbers = Annotated[tuple[number, ...], Field(strict=False, min_length=2)]
        return numbers, Field(description=key.description, examples=examples)
    return float, Field(
        gt=key.above, lt=key.below, le=key.at_most, description=key.description, examples=examples
    )


@cache
def _definition(kind: str) -> type[SurfaceTable]:
    shape = SURFACES[kind]
    fields: dict[str, Any] = {key.name: _key_field(key) for key in surface_keys(shape).values()}
    fields["kind"] = Literal[kind], ...
    doc = (shape.__doc__ or "").partition("\n")[0]
    return create_model(kind.capitalize(), __base__=SurfaceTable, __doc__=doc, __module__=__name__, **fields)


class _SurfaceTables(Mapping[str, type[SurfaceTable]]):
    """Definition of the `surface` table of each kind, made when it is first asked for."""

    def __getitem__(self, kind: str) -> type[SurfaceTable]:
        return _definition(kind)

    def __iter__(self) -> Iterator[str]:
        return iter(sorted(SURFACES))

    def __len__(self) -> int:
        return len(SURFACES)


SURFACE_TABLES = _SurfaceTables()
PadSurface = Annotated[SurfaceTable, OneOfKinds(SURFACE_TABLES)]


def __getattr__(name: str) -> type[SurfaceTable]:
    """Return the definition of a kind by the name of its class, as pickle asks for it."""
    if (kind := name.lower()) not in SURFACES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return SURFACE_TABLES[kind]


@lru_cache(maxsize=64)
def film_of(file: str) -> field.Film:
    """Return the measured film of a file, by its path or embedded. Raises ValueError."""
    return field.Film(read_embedded(file))


_ADAPTER: TypeAdapter[SurfaceTable] = TypeAdapter(PadSurface)


def surface_table(kind: str, **keys: Any) -> SurfaceTable:
    """Return the table of a surface, checked as if it stood in a deployment file."""
    return _ADAPTER.validate_python({"kind": kind, **keys})
