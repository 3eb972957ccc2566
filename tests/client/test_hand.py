"""The newest state of a hand: never an old frame, contacts that end, wrenches, callbacks, asyncio."""

from __future__ import annotations

import asyncio
import itertools
import threading
import time
from collections.abc import Iterator
from typing import Any, assert_type

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import handtouch
from handtouch import wire
from handtouch.client.hand_arrays import HandArrays
from handtouch.client.hand_state import HandState
from handtouch.client.wrench import contact_wrenches, grasp_matrix
from tests.client.hand_messages import LINKS, make_contact, make_frame

LONGEST_S = 60.0
CLEAR, TOUCHED, STALE = wire.PadState.CLEAR, wire.PadState.TOUCHED, wire.PadState.STALE


def _state_after(*messages: wire.Message) -> HandState:
    state = HandState()
    for order, message in enumerate(messages):
        state.feed(message, order)
    return state


def _arrays(state: HandState) -> HandArrays:
    assert state.arrays is not None
    return state.arrays


# --- arrays by link


def test_columns_are_read_by_link_and_as_arrays() -> None:
    position_m = np.arange(9.0).reshape(3, 3)
    state = (CLEAR, TOUCHED, STALE)
    arrays = HandArrays(make_frame(force_n=(0.5, 1.5, 2.5), position_m=position_m, state=state))
    assert arrays.force_n["index_tip"] == 1.5
    assert dict(arrays.force_n) == {"thumb_tip": 0.5, "index_tip": 1.5, "index_base": 2.5}
    assert np.asarray(arrays.position_m) == pytest.approx(position_m)
    assert arrays.position_m["index_base"] == pytest.approx(position_m[2])
    assert [arrays.touched.get(link) for link in LINKS] == [False, True, None]
    assert list(arrays.sampled.values()) == [True, True, False]
    with pytest.raises(ValueError, match="read-only"):
        arrays.force_n.array[0] = 9.0


def test_an_unknown_link_is_reported_with_the_closest_one() -> None:
    arrays = HandArrays(make_frame())
    with pytest.raises(KeyError, match="did you mean 'index_tip'"):
        arrays.force_n["indx_tip"]
    with pytest.raises(KeyError, match="the links are thumb_tip, index_tip, index_base"):
        arrays.force_n["q"]


def test_an_unknown_link_is_never_a_pad_that_is_not_sampled() -> None:
    arrays = HandArrays(make_frame(state=(CLEAR, TOUCHED, STALE)))
    for shown in (arrays, arrays.as_old()):
        assert shown.touched.get("index_base") is None
        assert "index_base" in shown.touched
        assert "indx_tip" not in shown.touched
        for column in (shown.touched, shown.force_n, shown.state):
            with pytest.raises(KeyError, match="did you mean 'index_tip'"):
                column.get("indx_tip")


def test_a_status_equals_its_name_and_prints_it() -> None:
    arrays = _arrays(
        _state_after(make_frame(state=(0, 1, 5), force_status=(0, 1, 2), position_status=(0, 1, 9)))
    )
    assert arrays.force_status["index_tip"] == "valid" == str(arrays.force_status["index_tip"])
    assert arrays.force_status["index_tip"] is wire.ForceStatus.VALID
    assert arrays.force_status["index_base"] != "valid"
    assert (arrays.force_status == "valid").tolist() == [False, True, False]
    assert arrays.state["index_base"] == "starting"
    assert repr(arrays.state) == "{'thumb_tip': 'clear', 'index_tip': 'touched', 'index_base': 'starting'}"
    assert arrays.position_status["index_base"] == 9  # of a later version
    with pytest.raises(ValueError, match="'vaild' is no status; they are not_computed, valid"):
        _ = arrays.force_status == "vaild"


def test_sums_over_a_hand_leave_clear_pads_out_and_are_unknown_with_an_unknown_pad() -> None:
    force_n = (np.nan, 2.0, 3.0)
    arrays = _arrays(_state_after(make_frame(state=(0, 1, 1), force_n=force_n)))
    assert (arrays.force_n.sum(), arrays.force_n.max(), arrays.force_n.mean()) == (5.0, 3.0, 2.5)
    unknown = _arrays(_state_after(make_frame(state=(2, 1, 1), force_n=force_n)))
    assert np.isnan([unknown.force_n.sum(), unknown.force_n.max()]).all()
    clear = _arrays(_state_after(make_frame(state=(0, 0, 0))))
    assert clear.force_n.sum() == 0.0
    assert np.isnan(clear.force_n.max())


def test_arithmetic_of_columns_returns_arrays() -> None:
    arrays = _arrays(_state_after(make_frame(state=(1, 1, 1), force_n=(1.0, 2.0, 3.0))))
    assert (2 * arrays.force_n + arrays.force_n).tolist() == [3.0, 6.0, 9.0]
    assert (arrays.force_n > 1.5).tolist() == [False, True, True]
    assert np.sqrt(arrays.force_n)[0] == 1.0


def test_a_row_number_is_answered_with_the_links_and_the_array() -> None:
    with pytest.raises(TypeError, match=r"0 is no link; the links are thumb_tip, .*\.array"):
        _ = _arrays(_state_after(make_frame())).force_n[0]  # type: ignore[index]


def test_covariances_are_matrices() -> None:
    arrays = _arrays(_state_after(make_frame(covariance_m2=np.arange(27.0).reshape(3, 9))))
    assert arrays.covariance_m2.array.shape == (3, 3, 3)
    assert arrays.covariance_m2["index_tip"][0].tolist() == [9.0, 10.0, 11.0]


def test_a_frame_prints_as_a_table_of_its_pads() -> None:
    frame = make_frame(
        state=(0, 1, 2), position_status=(0, 1, 0), force_status=(0, 1, 0), force_n=(np.nan, 1.25, np.nan),
        force_std_n=(np.nan, 0.1, np.nan), position_m=np.full((3, 3), 0.0125),
    )  # fmt: skip
    lines = repr(_arrays(_state_after(frame))).splitlines()
    assert lines[1:] == [
        "  thumb_tip: clear",
        "  index_tip: touched at (12.5, 12.5, 12.5) mm, 1.25 +- 0.10 N",
        "  index_base: stale",
    ]


def test_an_output_that_no_scene_requests_is_an_error_that_names_the_output() -> None:
    with pytest.raises(LookupError, match='add "palm" to the outputs of the scene'):
        _ = HandArrays(make_frame()).palm_position_m


def test_ages_are_those_of_samples_at_the_given_time() -> None:
    arrays = HandArrays(make_frame(sample_ns=(10**9, 2 * 10**9, 0)))
    assert list(arrays.age_at(3 * 10**9).values()) == [2.0, 1.0, np.inf]


# --- state from messages


def test_an_older_or_repeated_frame_never_replaces_a_newer_one() -> None:
    state = _state_after(make_frame(7))
    newest = _arrays(state)
    for order, seq in enumerate((6, 7, 1), 1):
        state.feed(make_frame(seq, retained=True), order)
        assert state.arrays is newest
    state.feed(make_frame(8), 9)
    assert _arrays(state).frame.seq == 8


def test_another_session_voids_the_state() -> None:
    state = _state_after(make_frame(7), make_contact("index_tip", "begin", 4))
    state.feed(make_contact("thumb_tip", "begin", 1, session=2), 2)
    assert state.arrays is None
    assert list(state.contacts) == ["thumb_tip"]
    state.feed(make_contact("index_tip", "update", 4, seq=2), 1)  # decoded later, received earlier
    assert list(state.contacts) == ["thumb_tip"]


def test_contacts_begin_and_end() -> None:
    state = _state_after(make_contact("index_tip", "begin", 4))
    assert state.contacts["index_tip"].id == 4
    state.feed(make_contact("index_tip", "end", 4, seq=2), 1)
    assert not state.contacts


def test_a_contact_whose_end_was_lost_ends_with_the_next_frame() -> None:
    begin = make_contact("index_tip", "begin", 4)
    assert list(_state_after(begin, make_frame(contact_id=(0, 4, 0))).contacts) == ["index_tip"]
    assert not _state_after(begin, make_frame(contact_id=(0, 5, 0))).contacts
    # the frame is older than the contact, or is a retained one, which may be older
    assert list(_state_after(make_frame(), begin).contacts) == ["index_tip"]
    assert list(_state_after(begin, make_frame(retained=True)).contacts) == ["index_tip"]


@given(
    events=st.lists(st.tuples(st.sampled_from(LINKS), st.booleans()), max_size=8),
    shuffled=st.randoms(use_true_random=False),
)
def test_contacts_do_not_depend_on_when_messages_are_decoded(
    events: list[tuple[str, bool]], shuffled: Any
) -> None:
    """Only the newest of each topic is decoded, in any order."""
    messages: list[wire.Message] = []
    ids: dict[str, int] = {}
    for number, (link, touches) in enumerate(events, 1):
        if touches:
            messages.append(make_contact(link, "begin", number, seq=number))
            ids[link] = number
        elif link in ids:
            messages.append(make_contact(link, "end", ids.pop(link), seq=number))
        messages.append(make_frame(number, contact_id=[ids.get(name, 0) for name in LINKS]))
    newest = {wire.topic_of(message): (order, message) for order, message in enumerate(messages)}
    waiting = list(newest.values())
    shuffled.shuffle(waiting)
    state = HandState()
    for order, message in waiting:
        state.feed(message, order)
    assert {link: contact.id for link, contact in state.contacts.items()} == ids


# --- wrenches


def _touched_arrays(status: int = wire.ForceStatus.VALID, last: int = TOUCHED) -> HandArrays:
    rng = np.random.default_rng(3)
    normal = rng.normal(size=(3, 3))
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    position_m = rng.normal(scale=0.03, size=(3, 3))
    places: dict[str, Any] = {
        prefix + name: value
        for prefix in ("", "palm_")
        for name, value in (
            ("position_m", position_m),
            ("normal", normal),
            ("covariance_m2", np.tile(1e-7 * np.eye(3).ravel(), (3, 1))),
        )
    }
    return HandArrays(
        make_frame(
            state=(TOUCHED, TOUCHED, last),
            force_n=(1.0, 2.0, 3.0),
            force_std_n=(0.1, 0.2, 0.2),
            force_status=(wire.ForceStatus.VALID, wire.ForceStatus.VALID, status),
            position_status=(wire.PositionStatus.VALID,) * 3,
            palm_status=(wire.FrameStatus.VALID,) * 3,
            **places,
        )
    )


def test_a_contact_pushes_the_link_against_its_normal_at_its_point() -> None:
    arrays = _touched_arrays()
    wrench = arrays.wrenches("link")["index_tip"]
    assert wrench.force_n == pytest.approx(-2.0 * arrays.normal["index_tip"], abs=1e-6)
    assert wrench.point_m == pytest.approx(arrays.position_m["index_tip"])
    moment_nm = np.cross(arrays.position_m["index_tip"], wrench.force_n)
    assert wrench.moment_nm == pytest.approx(moment_nm, abs=1e-6)


def test_the_covariance_of_a_wrench_is_that_of_perturbed_forces_and_positions() -> None:
    rng = np.random.default_rng(1)
    position, normal = np.array([0.03, -0.02, 0.05]), np.array([0.6, 0.0, 0.8])
    tangent = 1e-6 * (np.eye(3) - np.outer(normal, normal))
    many = 200_000
    positions = rng.multivariate_normal(position, tangent, size=many)
    forces = -rng.normal(2.0, 0.1, size=many)[:, None] * normal
    drawn = np.concatenate([forces, np.cross(positions, forces)], axis=1)
    (wrench,) = contact_wrenches(
        position[None], normal[None], tangent[None], np.array([2.0]), np.array([0.1])
    )
    scale = np.sqrt(np.outer(*[np.diag(wrench.covariance) + 1e-12] * 2))
    assert (np.cov(drawn.T) - wrench.covariance) / scale == pytest.approx(np.zeros((6, 6)), abs=0.02)


def test_a_wrench_above_a_shear_pad_has_the_whole_force_and_its_covariance_in_every_frame() -> None:
    rng = np.random.default_rng(5)
    turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    turn *= np.linalg.det(turn)
    normal, position_m = np.array([0.0, 0.6, 0.8]), np.array([0.02, -0.01, 0.03])
    vector_n, root = np.array([0.5, 0.3, -2.0]), rng.normal(scale=0.1, size=(3, 3))
    covariance_n2 = root @ root.T
    valid, unreliable = wire.ForceStatus.VALID, wire.ForceStatus.UNRELIABLE
    arrays = HandArrays(
        make_frame(
            state=(TOUCHED,) * 3,
            force_n=(1.0, 1.0, 1.0),
            force_std_n=(0.1, 0.1, 0.1),
            force_status=(valid,) * 3,
            force_vector_status=(valid, unreliable, valid),
            position_status=(wire.PositionStatus.VALID,) * 3,
            palm_status=(wire.FrameStatus.VALID,) * 3,
            position_m=np.tile(position_m, (3, 1)),
            normal=np.tile(normal, (3, 1)),
            covariance_m2=np.zeros((3, 9)),
            force_vector_n=np.tile(vector_n, (3, 1)),
            force_vector_covariance_n2=np.tile(covariance_n2.ravel(), (3, 1)),
            palm_position_m=np.tile(turn @ position_m, (3, 1)),
            palm_normal=np.tile(turn @ normal, (3, 1)),
            palm_covariance_m2=np.zeros((3, 9)),
            palm_force_vector_n=np.tile(turn @ vector_n, (3, 1)),
        )
    )
    both = np.kron(np.eye(2), turn)
    first, second, _ = (arrays.wrenches("link")[link] for link in arrays.links)
    assert first.force_n == pytest.approx(vector_n)
    assert first.moment_nm == pytest.approx(np.cross(position_m, vector_n))
    assert first.covariance[:3, :3] == pytest.approx(covariance_n2)
    assert second.force_n == pytest.approx(-normal, abs=1e-6)
    palm = arrays.wrenches("palm")[arrays.links[0]]
    assert palm.force_n == pytest.approx(turn @ vector_n, abs=1e-6)
    assert palm.covariance == pytest.approx(both @ first.covariance @ both.T, abs=1e-7)


def test_a_finger_s_wrench_is_the_sum_of_its_contacts_and_names_those_it_lacks() -> None:
    arrays = _touched_arrays()
    each = arrays.wrenches("palm")
    total = arrays.wrench("index_*", "palm")
    assert total.force_n == pytest.approx(each["index_tip"].force_n + each["index_base"].force_n)
    assert total.covariance == pytest.approx(each["index_tip"].covariance + each["index_base"].covariance)
    assert total.missing == ()
    assert arrays.total_force_n("index_*") == pytest.approx((5.0, np.hypot(0.2, 0.2)))
    saturated = _touched_arrays(wire.ForceStatus.LOWER_BOUND)
    assert saturated.wrench("index_*", "palm").missing == ("index_base",)
    assert np.isnan(saturated.wrench("index_*", "palm").force_n).all()
    assert np.isnan(saturated.total_force_n("index_*")).all()
    assert saturated.total_force_n("thumb_*") == pytest.approx((1.0, 0.1))
    stale = _touched_arrays(last=STALE)  # a contact that continues without samples, or none: not known
    assert stale.wrench("index_*", "palm").missing == ("index_base",)
    assert np.isnan(stale.total_force_n("index_*")).all()
    clear = _touched_arrays(last=CLEAR)
    assert clear.wrench("index_*", "palm").missing == ()
    assert clear.total_force_n("index_*") == pytest.approx((2.0, 0.2))
    with pytest.raises(ValueError, match="a frame of its own"):
        arrays.wrench("*", "link")
    with pytest.raises(LookupError, match="no link matches 'ring_\\*'"):
        arrays.wrench("ring_*")


def test_the_grasp_matrix_maps_normal_forces_to_the_opposite_of_the_wrench_on_the_hand() -> None:
    arrays = _touched_arrays()
    grasp = arrays.grasp_matrix("palm")
    assert grasp.links == LINKS
    forces = np.zeros(9)
    forces[::3] = arrays.force_n.array
    total = arrays.wrench("*", "palm")
    on_hand = np.concatenate([total.force_n, total.moment_nm])
    assert grasp.matrix @ forces == pytest.approx(-on_hand, abs=1e-6)


@given(normal=st.tuples(*[st.floats(-1, 1)] * 3).filter(lambda n: np.linalg.norm(n) > 0.1))
def test_the_directions_of_a_contact_are_a_right_handed_frame(normal: tuple[float, float, float]) -> None:
    unit = np.array([normal]) / np.linalg.norm(normal)
    basis = grasp_matrix(np.zeros((1, 3)), unit)[:3]
    assert basis.T @ basis == pytest.approx(np.eye(3), abs=1e-9)
    assert np.linalg.det(basis) == pytest.approx(1.0)
    assert basis[:, 0] == pytest.approx(unit[0])


# --- connection


def _join(publisher: Any, count: int = 3) -> None:
    for _ in range(count):
        assert publisher.poll(1000 * LONGEST_S)
        publisher.recv()


@pytest.fixture
def hand(publisher: Any, endpoints: dict[str, str]) -> Iterator[handtouch.Hand]:
    """A hand whose frames count whatever their age: tests/client/test_age.py has those of ages."""
    with handtouch.Hand("right", endpoint=endpoints["live"], max_age_s=1e9) as made:
        _join(publisher)
        yield made


@pytest.fixture
def frozen(monkeypatch: pytest.MonkeyPatch) -> None:
    """The clock of timeouts stands still: the daemon stays alive however long the machine stalls."""
    now_s = time.monotonic()
    monkeypatch.setattr(time, "monotonic", lambda: now_s)


def _wait_for(hand: handtouch.Hand, seq: int) -> HandArrays:
    for _ in range(round(LONGEST_S / 0.1)):
        if (arrays := hand.wait(0.1)) is not None and arrays.frame.seq == seq:
            return arrays
    raise AssertionError(f"frame {seq} never came")


@pytest.mark.usefixtures("frozen")
def test_latest_returns_the_newest_frame_where_recv_returns_one_of_a_second_ago(
    publisher: Any, endpoints: dict[str, str], hand: handtouch.Hand
) -> None:
    """As after a pause of one second of a program at 200 Hz."""
    with handtouch.connect("hand/right", endpoint=endpoints["live"]) as frames:
        _join(publisher, 2)
        now_ns = time.monotonic_ns()
        for behind in reversed(range(201)):
            t_ns = now_ns - 5_000_000 * behind
            publisher.send_multipart(wire.encode(make_frame(201 - behind, t_ns=t_ns, sample_ns=(t_ns,) * 3)))
        received = frames.recv(LONGEST_S)
        assert received is not None
        assert now_ns - received.t_ns == 10**9
        while frames.recv(LONGEST_S).seq < 201:  # type: ignore[union-attr]
            pass  # all have arrived in this process
        arrays = _wait_for(hand, 201)
    assert arrays.t_ns == now_ns
    assert hand.latest() is arrays
    oldest_s = 1e-9 * (time.monotonic_ns() - now_ns)
    assert oldest_s <= hand.age_s["index_tip"] <= 1e-9 * (time.monotonic_ns() - now_ns)


@pytest.mark.usefixtures("frozen")
def test_messages_of_other_hands_and_malformed_ones_are_ignored(publisher: Any, hand: handtouch.Hand) -> None:
    publisher.send_multipart(wire.encode(make_frame(9, hand="right_arm")))
    publisher.send_multipart([b"contact/right/index_tip", b"\xc1"])
    publisher.send_multipart([b"hand/right"])
    publisher.send_multipart(wire.encode(make_frame(2, hand="right")))
    assert _wait_for(hand, 2).frame.hand == "right"
    assert not hand.contacts
    assert hand.malformed_messages >= 1


@pytest.mark.usefixtures("frozen")
def test_wait_returns_each_frame_once(publisher: Any, hand: handtouch.Hand) -> None:
    publisher.send_multipart(wire.encode(make_frame(1)))
    arrays = _wait_for(hand, 1)
    assert hand.latest() is arrays
    assert hand.wait(0) is None
    publisher.send_multipart(wire.encode(make_frame(2)))
    assert _wait_for(hand, 2).frame.seq == 2


@pytest.mark.parametrize("name", ["", "right/index", "*"])
def test_a_pattern_is_no_name_of_a_hand(name: str) -> None:
    with pytest.raises(ValueError, match="no name of a hand"):
        handtouch.Hand(name)


def test_callbacks_get_every_contact_in_a_thread_of_their_own(publisher: Any, hand: handtouch.Hand) -> None:
    called: list[tuple[str, int, int]] = []
    done = threading.Event()

    def note(contact: wire.Contact) -> None:
        called.append((contact.event, contact.id, threading.get_ident()))
        if contact.event == "end":
            done.set()

    with hand.on_contact(note):
        _join(publisher, 2)
        for seq, event in enumerate(("begin", "update", "update", "end"), 1):
            publisher.send_multipart(wire.encode(make_contact("index_tip", event, 4, seq)))  # type: ignore[arg-type]
        assert done.wait(LONGEST_S)
    events = [(event, number) for event, number, _ in called]
    assert events == [("begin", 4), ("update", 4), ("update", 4), ("end", 4)]
    assert threading.get_ident() not in {thread for *_, thread in called}


def test_what_a_callback_raises_is_raised_by_close(publisher: Any, hand: handtouch.Hand) -> None:
    def fail(arrays: HandArrays) -> None:
        raise ArithmeticError(f"frame {arrays.frame.seq}")

    listener = hand.on_frame(fail)
    end_s = time.monotonic() + LONGEST_S
    for seq in itertools.count(1):
        publisher.send_multipart(wire.encode(make_frame(seq)))
        if not listener.running:
            break
        assert time.monotonic() < end_s
        time.sleep(0.01)
    with pytest.raises(ArithmeticError, match="frame"):
        listener.close()


def test_all_tasks_that_wait_get_the_newest_frame(publisher: Any, hand: handtouch.Hand) -> None:
    async def main() -> list[list[int]]:
        async def read() -> list[int]:
            seqs = []
            async for arrays in hand:
                seqs.append(arrays.frame.seq)
                if seqs[-1] >= 20:
                    break
            return seqs

        tasks = [asyncio.create_task(read()) for _ in range(3)]
        async with asyncio.timeout(LONGEST_S):
            for seq in itertools.count(1):
                if all(task.done() for task in tasks):
                    return await asyncio.gather(*tasks)
                publisher.send_multipart(wire.encode(make_frame(seq)))
                await asyncio.sleep(0.001 * (seq % 3))
        raise AssertionError

    for seqs in asyncio.run(main()):
        assert seqs == sorted(set(seqs))
        assert len(seqs) > 1


def test_waiting_times_out_in_asyncio(publisher: Any, hand: handtouch.Hand) -> None:
    async def main() -> tuple[HandArrays | None, HandArrays | None]:
        nothing = await hand.wait_async(0.01)
        publisher.send_multipart(wire.encode(make_frame(1)))
        return nothing, await hand.wait_async(LONGEST_S)

    nothing, arrays = asyncio.run(main())
    assert nothing is None
    assert arrays is not None
    assert arrays.frame.seq == 1


def test_columns_are_typed() -> None:
    def types(hand: handtouch.Hand) -> None:  # for mypy: never called
        assert_type(hand.force_n["x"], float)
        assert_type(hand.touched["x"], bool)
        assert_type(hand.touched.get("x"), bool | None)
        assert_type(hand.contacts["x"].event, wire.ContactEvent)
        assert_type(handtouch.connect("hand/right").recv(), wire.HandFrame)
        assert_type(handtouch.connect("contact/left/*").recv(), wire.Contact)
        assert_type(handtouch.connect("hand/gripper", kind=wire.HandFrame).recv(), wire.HandFrame)

    assert callable(types)


def test_a_pattern_of_another_kind_is_refused() -> None:
    with pytest.raises(ValueError, match="are no HandFrame"):
        handtouch.connect("contact/*/*", kind=wire.HandFrame)
