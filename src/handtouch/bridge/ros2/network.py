"""DDS participant with ROS 2's names, qualities of service and type hashes.

Public names: `RosNetwork`, `RosWriter`, `RosReader`, `Quality`, `RosNetworkError`, `ros_name`.
"""

from __future__ import annotations

import logging
import re
from enum import Enum
from types import new_class
from typing import Any

from cyclonedds.core import DDSException, Policy, Qos
from cyclonedds.domain import DomainParticipant
from cyclonedds.idl import IdlStruct
from cyclonedds.internal import InvalidSample
from cyclonedds.pub import DataWriter
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic
from cyclonedds.util import duration

from handtouch.bridge.ros2.type_hash import type_hash

_log = logging.getLogger("handtouch.bridge")
_BLOCKING_S = 0.1
"""Longest that a reliable subscriber which doesn't keep up may delay a message"""


class RosNetworkError(RuntimeError):
    """No DDS participant can be opened; the text contains the remedy."""

    exit_status = 2


class Quality(Enum):
    """Quality of service of a topic."""

    SENSOR_DATA = "best effort, volatile, depth 5: ROS 2's profile for sensor data"
    STREAM = "reliable, volatile, depth 5: received by subscribers that ask for either reliability"
    STATE = "reliable, transient local, depth 1: late subscribers receive the last message"

    @property
    def qos(self) -> Qos:
        """Policies of DDS."""
        # ROS 2 encodes messages by the first version of XCDR
        encoding = Policy.DataRepresentation(use_cdrv0_representation=True, use_xcdrv2_representation=False)
        if self is Quality.SENSOR_DATA:
            return Qos(encoding, Policy.Reliability.BestEffort, Policy.History.KeepLast(5))
        if self is Quality.STREAM:  # a reader that stalls has the latest five kept for it, and delays nobody
            return Qos(
                encoding,
                Policy.Reliability.Reliable(duration(seconds=_BLOCKING_S)),
                Policy.Durability.Volatile,
                Policy.History.KeepLast(5),
            )
        return Qos(
            encoding,
            Policy.Reliability.Reliable(duration(seconds=_BLOCKING_S)),
            Policy.Durability.TransientLocal,
            Policy.History.KeepLast(1),
        )


class RosWriter:
    """Writer of a topic, created by `RosNetwork.writer`."""

    def __init__(
        self, participant: DomainParticipant, topic: Topic[Any], kind: type[IdlStruct], qos: Qos
    ) -> None:
        self._writer = DataWriter[Any](participant, topic, qos=qos)
        self._encoded: Any = new_class("Encoded", (_Encoded, kind))

    @property
    def is_read(self) -> bool:
        """There is a reader now."""
        # a listener, called in a thread of DDS, can delay the end of the process by half a minute
        status = self._writer.get_publication_matched_status()  # type: ignore[no-untyped-call]
        return bool(status.current_count)

    def write(self, message: IdlStruct | bytes) -> None:
        """Send a message, encoded already or not."""
        if isinstance(message, bytes):
            encoded = self._encoded.__new__(self._encoded)
            encoded.data = message
            self._writer.write(encoded)
        else:
            self._writer.write(message)


class _Encoded:
    """A message that DDS sends as it is."""

    data: bytes

    def serialize(self, **_: object) -> bytes:
        return self.data


class RosReader:
    """Reader of a topic, created by `RosNetwork.reader`."""

    def __init__(self, participant: DomainParticipant, topic: Topic[Any], qos: Qos) -> None:
        self._reader = DataReader[Any](participant, topic, qos=qos)
        self._name, self._has_reported = topic.get_name(), False

    def take(self, count: int) -> list[Any]:
        """Return messages that have arrived, at most `count`; malformed ones are logged once and dropped."""
        messages = []
        for _ in range(count):
            try:
                taken = self._reader.take(1)  # a malformed one loses those taken with it
            except Exception as error:  # noqa: BLE001 - decoding raises many kinds
                if not self._has_reported:
                    _log.warning("%s: malformed message dropped: %s", self._name, error)
                self._has_reported = True
                continue
            if not taken:
                break
            messages += [message for message in taken if not isinstance(message, InvalidSample)]
        return messages


class RosNetwork:
    """Participant of a domain; topics are below `namespace`, absolute ones (with a slash in front) not.

    Raises RosNetworkError.
    """

    def __init__(self, domain: int, namespace: str = "") -> None:
        try:
            self._participant = DomainParticipant(domain)
        except DDSException as error:
            raise RosNetworkError(
                f"can't open DDS domain {domain}: {error}; check the network interface, and CYCLONEDDS_URI "
                "if it is set"
            ) from error
        self._namespace = namespace.strip("/")

    def writer(self, name: str, kind: type[IdlStruct], quality: Quality) -> RosWriter:
        """Return a writer of a topic."""
        qos = quality.qos + Qos(_type_hash_policy(kind))
        return RosWriter(self._participant, self._topic(name, kind), kind, qos)

    def reader(self, name: str, kind: type[IdlStruct], quality: Quality) -> RosReader:
        """Return a reader of a topic."""
        qos = quality.qos + Qos(_type_hash_policy(kind))
        return RosReader(self._participant, self._topic(name, kind), qos)

    def _topic(self, name: str, kind: type[IdlStruct]) -> Topic[Any]:
        full = (
            name if name.startswith("/") else f"/{self._namespace}/{name}" if self._namespace else f"/{name}"
        )
        return Topic(self._participant, f"rt{full}", kind)


def ros_name(text: str) -> str:
    """Return a text as a part of a ROS name: letters, digits and single underscores, no digit in front."""
    name = re.sub(r"_+", "_", re.sub(r"[^0-9A-Za-z]", "_", text)).rstrip("_") or "_"
    return f"_{name}" if name[0].isdigit() else name


def _type_hash_policy(kind: type[IdlStruct]) -> Policy.Userdata:
    return Policy.Userdata(f"typehash={type_hash(kind)};".encode())
