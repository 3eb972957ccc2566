"""Foxglove's messages decoded by the schema that is sent with them, with Google's protobuf."""

from __future__ import annotations

from functools import cache
from typing import Any

from google.protobuf import descriptor_pb2, descriptor_pool, json_format, message_factory


def decode(schema_name: str, schema: bytes, data: bytes) -> dict[str, Any]:
    """Return a message as a dictionary with all its fields."""
    message = _class_of(schema_name, schema).FromString(data)
    return dict(
        json_format.MessageToDict(
            message, preserving_proto_field_name=True, always_print_fields_with_no_presence=True
        )
    )


@cache
def _class_of(schema_name: str, schema: bytes) -> Any:
    pool = descriptor_pool.DescriptorPool()
    for file in descriptor_pb2.FileDescriptorSet.FromString(schema).file:
        pool.Add(file)
    return message_factory.GetMessageClass(pool.FindMessageTypeByName(schema_name))
