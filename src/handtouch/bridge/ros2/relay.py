"""Relay from one daemon to ROS 2, and of joint states to the daemon.

Public names: `RosRelay`, `JointStateRelay`, `relay_received`, `TOPICS`.
"""

from __future__ import annotations

import logging
import math
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from handtouch import wire
from handtouch.bridge.ros2 import conversion
from handtouch.bridge.ros2 import messages as ros
from handtouch.bridge.ros2.conflation import Conflation
from handtouch.bridge.ros2.contact_messages import ContactArray
from handtouch.bridge.ros2.conversion import Stamper
from handtouch.bridge.ros2.network import Quality, RosNetwork, RosWriter, ros_name
from handtouch.client import Subscriber
from handtouch.client.daemon_clock import MIN_AGE_LIMIT_S, age_limit_s
from handtouch.client.robot import Robot

TOPICS = ("contact/*/*", "hand/*", "health/*/*", "service")
"""Topics of the daemon that are relayed"""
_DIAGNOSTICS_PERIOD_NS = 1_000_000_000
_MARKER_PERIOD_NS = 33_000_000
_MAX_JOINT_STATES_PER_POLL = 32
_MAX_MESSAGES_PER_ROUND = 2000
_COLUMNS = wire.COLUMNS[wire.HandFrame]
_CLEAR, _TOUCHED = int(wire.PadState.CLEAR), int(wire.PadState.TOUCHED)
_log = logging.getLogger("handtouch.bridge")


def relay_received(source: Subscriber[Any], waiting: Conflation, relay: RosRelay, longest_s: float) -> bool:
    """Relay all messages that have arrived, the newest of each topic; return False if none has in a time.

    Raises PermissionError if the daemon rejects the key.
    """
    message = source.recv(longest_s)
    if message is None:
        return False
    waiting.add(message)
    for _ in range(_MAX_MESSAGES_PER_ROUND):
        if (message := source.recv(0)) is None:
            break
        waiting.add(message)
    relay.count_losses(waiting.replaced, source.lost_messages)
    for message in waiting.take():
        relay.relay(message)
    return True


class RosRelay:
    """Relay of a daemon's messages; `palm_links`: frame of the palm by hand, absent where unknown.

    `clock_s`: clock of receptions, by which `expire` judges silence.
    """

    def __init__(
        self,
        network: RosNetwork,
        stamper: Stamper,
        palm_links: Mapping[str, str],
        clock_s: Callable[[], float] = time.monotonic,
    ) -> None:
        self._network, self._stamper, self._clock_s = network, stamper, clock_s
        self._palm_links = palm_links
        self._hands: dict[str, _HandRelay] = {}
        self._diagnostics = network.writer("/diagnostics", ros.DiagnosticArray, Quality.STATE)
        self._statuses: dict[str, ros.DiagnosticStatus] = {}
        self._sent_ns = 0  # time of the last diagnostics
        self._newest_ns = 0
        self._waiting: list[wire.Message] = []  # until the daemon's wall clock is known
        self._session: int | None = None
        self._dropped_inputs = 0
        self._relayed = 0
        self._losses = self._reported_losses = 0, 0

    def count_losses(self, replaced: int, lost: int) -> None:
        """Report that so many messages were replaced by newer ones, or lost before the bridge, in total."""
        self._losses = replaced, lost

    def relay(self, message: wire.Message) -> None:
        """Relay one message of the daemon."""
        self._relayed += 1
        if isinstance(message, wire.Service):
            self._stamper.wall_offset_ns = message.wall_offset_ns
            self._update_service(message)
        elif self._stamper.wall_offset_ns is None:
            self._waiting.append(message)
            return
        for earlier in self._waiting:
            self._relay_now(earlier)
        self._waiting.clear()
        self._relay_now(message)

    def _relay_now(self, message: wire.Message) -> None:
        match message:
            case wire.Contact():
                self._hand(message.hand).add_contact(message)
            case wire.Percept():
                self._hand(message.hand).send_object(message)
            case wire.HandFrame():
                self._hand(message.hand).end_tick(message, self._clock_s())
            case wire.Health():
                self._update_status(conversion.pad_status(message))
        if not isinstance(message, wire.Contact):  # the time of an end or a retained one isn't of the newest
            self._newest_ns = max(self._newest_ns, message.t_ns)
            if self._newest_ns - self._sent_ns >= _DIAGNOSTICS_PERIOD_NS:
                self._update_bridge()
                self._send_diagnostics()

    def _update_service(self, service: wire.Service) -> None:
        if service.session != self._session:
            self._session, self._newest_ns, self._sent_ns = service.session, 0, 0
            self._dropped_inputs = 0
            self._statuses.clear()
            _log.info("daemon %s connected, hands: %s", service.version, ", ".join(service.hands))
        for hand in service.hands:
            self._hand(hand).begin_session(service.session)
            self._hand(hand).links = tuple(service.hands[hand])
            self._hand(hand).longest_silence_s = age_limit_s(service.frame_period_s or service.period_s)
        self._update_status(conversion.daemon_status(service))
        for name, bus in service.buses.items():
            self._update_status(conversion.bus_status(name, bus))
        if service.inputs:
            self._update_status(conversion.inputs_status(service.inputs, self._dropped_inputs))
            self._dropped_inputs = sum(service.inputs["dropped"].values())

    def expire(self) -> None:
        """Publish that all is unknown of a hand without a frame for too long, as the daemon hangs."""
        now_s = self._clock_s()
        silent = [hand for hand in self._hands.values() if hand.is_silent(now_s)]
        for hand in silent:
            hand.lose_all()
        if silent:
            self._update_status(conversion.daemon_status(None, "no frame; the daemon or its host hangs"))

    def end_session(self) -> None:
        """Publish that the daemon is disconnected, so that all is unknown; nothing if that is published."""
        if self._session is None:
            return
        _log.warning(
            "daemon disconnected; %d messages relayed, %d replaced by newer ones, %d lost",
            self._relayed,
            *self._losses,
        )
        self._session = None
        for hand in self._hands.values():
            hand.lose_all()
        self._statuses = {"handtouch: daemon": conversion.daemon_status(None)}
        self._send_diagnostics()

    def _update_status(self, status: ros.DiagnosticStatus) -> None:
        """Keep a status, and send all at once if its level or text changed."""
        before = self._statuses.get(status.name)
        self._statuses[status.name] = status
        changed = before is not None and (before.level, before.message) != (status.level, status.message)
        if changed and self._newest_ns:
            self._send_diagnostics()

    def _update_bridge(self) -> None:
        """Keep the bridge's own status: behind if messages were dropped since the last diagnostics."""
        status = conversion.bridge_status(
            self._relayed, *self._losses, is_behind=self._losses != self._reported_losses
        )
        before = self._statuses.get(status.name)
        self._statuses[status.name] = status
        if status.level and not (before and before.level):
            _log.warning(
                "bridge too slow: %d updates replaced by newer ones, %d messages lost so far", *self._losses
            )
        self._reported_losses = self._losses

    def _send_diagnostics(self) -> None:
        self._sent_ns = self._newest_ns
        header = self._stamper.header(self._newest_ns, "")
        self._diagnostics.write(ros.DiagnosticArray(header, list(self._statuses.values())))

    def _hand(self, name: str) -> _HandRelay:
        if name not in self._hands:
            palm = self._palm_links.get(name, "")
            self._hands[name] = _HandRelay(name, palm, self._network, self._stamper)
        return self._hands[name]


class _HandRelay:
    """Topics of one hand.

    A wrench of zero is published for a pad that is sampled and not touched; one of NaN for a sample without a
    force, and, stamped with the last sample, when the pad isn't sampled any more. Then there is none until it
    is: there are never two of NaN for a sample.
    """

    def __init__(self, name: str, palm_link: str, network: RosNetwork, stamper: Stamper) -> None:
        self.links: tuple[str, ...] = ()
        self.longest_silence_s = MIN_AGE_LIMIT_S
        self._name, self._palm_link, self._stamper, self._network = name, palm_link, stamper, network
        self._root = ros_name(name)
        self._contacts = network.writer(f"{self._root}/contacts", ContactArray, Quality.STREAM)
        self._markers = network.writer(f"{self._root}/markers", ros.MarkerArray, Quality.STATE)
        self._wrenches: dict[str, RosWriter] = {}
        self._object: RosWriter | None = None
        self._tick_contacts: list[wire.Contact] = []
        self._active: dict[str, wire.Contact] = {}
        self._session: int | None = None
        self._known_ns: dict[str, int] = {}  # sampled links -> time of the sample
        self._lost_ns: dict[str, int] = {}  # links that were lost -> newest sample, unknown by now
        self._nan_ns: dict[str, int] = {}  # links -> time of their last wrench of NaN
        self._sum_ns: int | None = None  # time of the sum, None once it is unknown
        self._shown: dict[str, tuple[wire.Contact, bool]] = {}  # link with markers -> its contact, unknown
        self._unknown: dict[str, wire.Contact] = {}  # contacts that were lost sight of
        self._marked_ns = self._t_ns = 0
        self._received_s: float | None = None

    def add_contact(self, contact: wire.Contact) -> None:
        """Add a contact of the present tick."""
        self._tick_contacts.append(contact)
        link = contact.link
        is_known = contact.end_reason == "released" if contact.event == "end" else contact.fresh
        is_known = is_known and contact.t_ns > self._lost_ns.get(link, -1)
        if not is_known and (contact.event != "end" or link in self._active):
            self._unknown[link] = contact
        if contact.event == "end":
            self._active.pop(link, None)
        else:
            self._active[link] = contact
        if not is_known:
            self._lose(link, contact.t_ns)
            return
        self._unknown.pop(link, None)
        self._known_ns[link] = contact.t_ns
        wrench = conversion.encode_wrench(contact, self._stamper)
        if wrench is None:
            self._write_nan(link, contact.frame, contact.t_ns)
        elif (writer := self._writer_of(link)).is_read:
            writer.write(wrench)

    def end_tick(self, frame: wire.HandFrame, received_s: float) -> None:
        """Publish the contacts of the tick whose frame this is, which follows them."""
        contacts, self._tick_contacts = self._tick_contacts, []
        self.links = frame.links
        self._t_ns, self._received_s = frame.t_ns, received_s
        if self._contacts.is_read:
            self._contacts.write(conversion.encode_contacts(contacts, frame, self._palm_link, self._stamper))
        ids = self._update_pads(frame)
        if ids != {link: contact.id for link, contact in self._active.items()}:
            self._lose_sum()
        elif contacts or self._sum_ns is None:
            self._send_sum(frame.t_ns)
        if abs(frame.t_ns - self._marked_ns) >= _MARKER_PERIOD_NS:
            self._send_markers(frame.t_ns)

    def send_object(self, percept: wire.Percept) -> None:
        """Publish the pose of the object in the hand while it is determined."""
        if percept.kind == "object" and percept.state == "estimated" and percept.poses and self._palm_link:
            if self._object is None:
                topic = f"{self._root}/object"
                self._object = self._network.writer(topic, ros.PoseWithCovarianceStamped, Quality.STREAM)
            self._object.write(conversion.object_pose(percept, self._palm_link, self._stamper))

    def _update_pads(self, frame: wire.HandFrame) -> dict[str, int] | None:
        """Publish what the frame says of pads; return ids of contacts by link, None if one isn't sampled."""
        state, contact_id, sample_ns = (
            _COLUMNS[name].to_array(getattr(frame, name)).tolist()
            for name in ("state", "contact_id", "sample_ns")
        )
        are_sampled = True
        for link, pad_state, t_ns in zip(frame.links, state, sample_ns, strict=True):
            is_sampled = pad_state in (_CLEAR, _TOUCHED) and t_ns > self._lost_ns.get(link, -1)
            are_sampled = are_sampled and is_sampled
            if not is_sampled:
                if link in self._active:
                    self._unknown[link] = self._active[link]
                self._lose(link, t_ns)
            elif pad_state == _CLEAR:
                self._unknown.pop(link, None)
                if link not in self._known_ns and (writer := self._writer_of(link)).is_read:
                    writer.write(conversion.encode_plain_wrench(t_ns, link, 0.0, self._stamper))
                self._known_ns[link] = t_ns
        if not are_sampled:
            return None
        return {link: id for link, id in zip(frame.links, contact_id, strict=True) if id}

    def is_silent(self, now_s: float) -> bool:
        """Return True if there was no frame for `longest_silence_s`."""
        return self._received_s is not None and now_s - self._received_s > self.longest_silence_s

    def begin_session(self, session: int) -> None:
        """Note the daemon's session: the clock of another one may be another."""
        if session != self._session:
            self._session = session
            self._lost_ns.clear()
            self._nan_ns.clear()

    def lose_all(self) -> None:
        """Publish that everything is unknown: the daemon is disconnected or silent."""
        self._received_s = None
        for link, t_ns in list(self._known_ns.items()):
            self._lose(link, t_ns)
        self._lose_sum()
        self._unknown.update(self._active)
        self._active.clear()
        self._tick_contacts.clear()
        self._send_markers(self._t_ns)

    def _lose(self, link: str, t_ns: int) -> None:
        """Publish once that the wrench of a link is unknown, since a sample of this time."""
        known_ns = self._known_ns.pop(link, None)
        if known_ns is None:
            return
        self._lost_ns[link] = t_ns = max(known_ns, t_ns)  # what is unknown stays so until a newer sample
        frame = contact.frame if (contact := self._unknown.get(link)) else link
        self._write_nan(link, frame, t_ns)

    def _write_nan(self, link: str, frame: str, t_ns: int) -> None:
        """Publish that the wrench of a sample is unknown, unless it was published before."""
        if t_ns > self._nan_ns.get(link, -1):
            self._nan_ns[link] = t_ns
            self._writer_of(link).write(conversion.encode_plain_wrench(t_ns, frame, math.nan, self._stamper))

    def _lose_sum(self) -> None:
        if self._sum_ns is not None and self._palm_link:
            nan = conversion.encode_plain_wrench(self._sum_ns, self._palm_link, math.nan, self._stamper)
            self._writer_of("").write(nan)
        self._sum_ns = None

    def _send_sum(self, t_ns: int) -> None:
        if not self._palm_link:
            return
        wrench = conversion.encode_sum(self._active.values(), t_ns, self._palm_link, self._stamper)
        if wrench is None:
            self._lose_sum()
            return
        self._sum_ns = t_ns
        if (writer := self._writer_of("")).is_read:
            writer.write(wrench)

    def _send_markers(self, t_ns: int) -> None:
        self._marked_ns = t_ns
        contacts = {**self._active, **self._unknown} if self._markers.is_read else {}
        shown = {link: (contact, link in self._unknown) for link, contact in contacts.items()}
        if not (shown or self._shown):
            return
        markers: list[ros.Marker] = []
        for link, (contact, _) in self._shown.items():
            if link not in shown:
                markers += conversion.removed_markers(contact.frame, t_ns, self._number(link), self._stamper)
        for link, (contact, is_unknown) in shown.items():
            if not is_unknown:
                markers += conversion.contact_markers(contact, self._number(link), self._stamper)
            elif self._shown.get(link) != (contact, True):
                markers += conversion.unknown_markers(contact, self._number(link), self._stamper)
        self._shown = shown
        if markers:
            self._markers.write(ros.MarkerArray(markers))

    def _number(self, link: str) -> int:
        return self.links.index(link) if link in self.links else len(self.links)

    def _writer_of(self, link: str) -> RosWriter:
        """Return the writer of a link's wrench; of the palm's for an empty name."""
        if link not in self._wrenches:
            parts = [self._root, ros_name(link), "wrench"] if link else [self._root, "wrench"]
            self._wrenches[link] = self._network.writer("/".join(parts), ros.WrenchStamped, Quality.STREAM)
        return self._wrenches[link]


class JointStateRelay:
    """Forwards joint states from ROS 2 to the daemon, to each hand those with any of its joints.

    `joints`: names of joints by hand.
    """

    def __init__(
        self,
        network: RosNetwork,
        topic: str,
        robot: Robot,
        stamper: Stamper,
        joints: Mapping[str, Sequence[str]],
    ) -> None:
        self._reader = network.reader(topic, ros.RosJointState, Quality.SENSOR_DATA)
        self._robot, self._stamper = robot, stamper
        self._joints = {hand: set(names) for hand, names in joints.items()}
        self._refusal = ""

    def run(self, stop: threading.Event, poll_s: float) -> None:
        """Forward joint states until `stop`."""
        while not stop.is_set():
            if not self.forward_waiting():
                stop.wait(poll_s)

    def forward_waiting(self) -> int:
        """Forward the joint states that have arrived; return their number."""
        states = self._reader.take(_MAX_JOINT_STATES_PER_POLL)
        for state in states:
            self._forward(state)
        return len(states)

    def _forward(self, state: ros.RosJointState) -> None:
        if not state.name or len(state.position) != len(state.name):
            return  # velocities or efforts only
        positions = dict(zip(state.name, state.position, strict=True))
        velocities = dict(zip(state.name, state.velocity, strict=False))
        t_ns = self._stamper.monotonic_ns(state.header.stamp)
        if t_ns is not None and t_ns < 0:
            self._log_refusal(
                "their stamps aren't of this host's clock but, for instance, of simulated time "
                "(use_sim_time); send stamps of the wall clock, or 0"
            )
            return
        for hand, names in self._joints.items():
            chosen = {name: value for name, value in positions.items() if name in names}
            if not chosen:
                continue
            known = {name: velocities[name] for name in chosen if name in velocities}
            try:
                self._robot.send_joints(
                    hand, chosen, t_ns=t_ns, velocity_rad_s=known if known.keys() == chosen.keys() else None
                )
            except (ValueError, PermissionError) as error:
                self._log_refusal(f"hand {hand}: {error}")
            else:
                self._refusal = ""

    def _log_refusal(self, reason: str) -> None:
        """Log why a joint state isn't forwarded, once for each reason in a row."""
        if reason != self._refusal:
            _log.warning("joint states aren't forwarded: %s", reason)
        self._refusal = reason
