"""The `[object.NAME]` tables: objects that a hand handles, with their shape and mass.

Public names: `ObjectTable`, `OBJECT_SHAPES`, `MeshShape`, `BoltShape`, `BoxShape`, `CylinderShape`,
`SphereShape`, `ObjectShape`.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field

from handtouch.config.base import Table
from handtouch.field.embedded_file import embed_file

_Size = Annotated[float, Field(gt=0, le=1000)]


class CylinderShape(Table):
    """A cylinder along z; its frame is at its centre."""

    kind: Literal["cylinder"]
    diameter_mm: _Size = Field(description="diameter", examples=[12.0])
    length_mm: _Size = Field(description="length along z", examples=[150.0])


class BoxShape(Table):
    """A box; its frame is at its centre, parallel to its sides."""

    kind: Literal["box"]
    size_mm: Annotated[tuple[_Size, _Size, _Size], Field(strict=False)] = Field(
        description="whole lengths along x, y and z", examples=[(40.0, 100.0, 30.0)]
    )


class SphereShape(Table):
    """A sphere; its frame is at its centre."""

    kind: Literal["sphere"]
    diameter_mm: _Size = Field(description="diameter", examples=[60.0])


class BoltShape(Table):
    """A round head on a shank along z; its frame is in the middle of the whole length, z towards the free
    end."""

    kind: Literal["bolt"]
    diameter_mm: _Size = Field(description="diameter of the shank", examples=[10.0])
    length_mm: _Size = Field(description="length of the shank, without the head", examples=[40.0])
    head_diameter_mm: _Size = Field(description="diameter of the head", examples=[17.0])
    head_length_mm: _Size = Field(description="length of the head along z", examples=[6.4])


class MeshShape(Table):
    """A closed surface from an STL file; its frame is that of the file."""

    kind: Literal["mesh"]
    file: str = Field(
        min_length=1, description="binary or ASCII STL file, relative to this file", examples=["mug.stl"]
    )
    unit_mm: _Size = Field(1.0, description="length of the file's unit; 1000 for a file in metres")


ObjectShape = Annotated[
    CylinderShape | BoxShape | SphereShape | BoltShape | MeshShape, Field(discriminator="kind")
]
OBJECT_SHAPES: dict[str, type[Table]] = {
    "cylinder": CylinderShape,
    "box": BoxShape,
    "sphere": SphereShape,
    "bolt": BoltShape,
    "mesh": MeshShape,
}
"""Shapes by their `kind`"""


class ObjectTable(Table):
    """`[object.NAME]`: a known object, whose pose percept `object` estimates in the hands that name it."""

    shape: ObjectShape = Field(
        description="its shape, see below",
        examples=[{"kind": "sphere", "diameter_mm": 60.0}],
    )

    def with_embedded_files(self, folder: Path) -> ObjectTable:
        """Return it with the content of its mesh, if it is one, whose path is relative to a folder."""
        if self.shape.kind != "mesh":
            return self
        shape = self.shape.model_copy(update={"file": embed_file(self.shape.file, folder)})
        return self.model_copy(update={"shape": shape})
