"""Base class of the tables of TOML files, and types of their values."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any

from pydantic import BaseModel, ConfigDict, Field, GetJsonSchemaHandler
from pydantic.json_schema import JsonSchemaValue
from pydantic_core import CoreSchema, PydanticKnownError, core_schema

Positive = Annotated[float, Field(gt=0)]
NonNegative = Annotated[float, Field(ge=0)]
Vector3 = Annotated[tuple[float, float, float], Field(strict=False)]
MIN_CHANNELS, MAX_CHANNELS = 3, 32
"""Channels of a pad"""
CHANNEL_RANGE = f"{MIN_CHANNELS} to {MAX_CHANNELS}"
PER_CHANNEL = Field(strict=False, min_length=MIN_CHANNELS, max_length=MAX_CHANNELS)
"""Constraint of a tuple with a value for each"""
PositivePerChannel = Annotated[tuple[Positive, ...], PER_CHANNEL]
Name = Annotated[str, Field(pattern=r"^[A-Za-z][A-Za-z0-9_\-]*$", max_length=64)]


class Table(BaseModel):
    """A table of the file: frozen, no unknown keys, no silent conversion of types, no NaN or infinity."""

    model_config = ConfigDict(
        frozen=True, extra="forbid", strict=True, allow_inf_nan=False, populate_by_name=False
    )


class OneOfKinds:
    """Marks a table that follows one of several models by its key `kind`.

    Errors and schema are those of a union with that discriminator, but only models of kinds that a file names
    are asked of `kinds`.
    """

    def __init__(self, kinds: Mapping[str, type[Table]]) -> None:
        self._kinds = kinds

    def __get_pydantic_core_schema__(self, *_: object) -> CoreSchema:
        return core_schema.no_info_plain_validator_function(self._validate)

    def __get_pydantic_json_schema__(self, _: CoreSchema, handler: GetJsonSchemaHandler) -> JsonSchemaValue:
        models = {kind: model.__pydantic_core_schema__ for kind, model in self._kinds.items()}
        return handler(core_schema.tagged_union_schema(models, "kind"))

    def _validate(self, value: object) -> Table:
        if not isinstance(value, dict | Table):
            raise PydanticKnownError("model_attributes_type")
        kind = value.get("kind") if isinstance(value, dict) else getattr(value, "kind", None)
        context: dict[str, Any] = {"discriminator": "'kind'"}
        if kind is None:
            raise PydanticKnownError("union_tag_not_found", context)
        if not isinstance(kind, str) or kind not in self._kinds:
            context |= {"tag": str(kind), "expected_tags": ", ".join(map(repr, self._kinds))}
            raise PydanticKnownError("union_tag_invalid", context)
        return self._kinds[kind].model_validate(value)
