"""Base class of the tables of TOML files, and types of their values."""

from __future__ import annotations

from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field

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
