"""Scenarios follow their file, and mistakes in it are reported."""

from __future__ import annotations

import itertools
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from handtouch import config
from handtouch.config import shipped
from handtouch.config.problems import ConfigError
from handtouch.simulate.scenario import Scenario
from handtouch.simulate.touch import ScenarioTouch

fractions = st.floats(0.02, 0.98)
touches = st.builds(
    ScenarioTouch,
    link=st.just("pad"),
    from_s=st.floats(0, 10),
    duration_s=st.floats(0.05, 10),
    path=st.lists(st.tuples(fractions, fractions), min_size=1, max_size=4).map(tuple),
    force_n=st.lists(st.floats(0.01, 20), min_size=1, max_size=4).map(tuple),
    ramp_s=st.floats(0.01, 3),
)


@given(touches, st.floats(0, 1))
def test_touch_stays_on_its_path_and_within_its_forces(touch: ScenarioTouch, part: float) -> None:
    t_s = touch.from_s + part * touch.duration_s
    assert 0 <= touch.force_at(t_s) <= max(touch.force_n) * (1 + 1e-12)
    for axis in range(2):
        along = [point[axis] for point in touch.path]
        assert min(along) - 1e-12 <= touch.position_at(t_s)[axis] <= max(along) + 1e-12


@given(touches)
def test_touch_begins_and_ends_at_path_ends_without_force(touch: ScenarioTouch) -> None:
    assert touch.force_at(touch.from_s) == touch.force_at(touch.until_s) == 0
    assert touch.force_at(touch.from_s - 1) == touch.force_at(touch.until_s + 1) == 0
    assert touch.position_at(touch.from_s) == pytest.approx(touch.path[0], abs=1e-9)
    assert touch.position_at(touch.until_s) == pytest.approx(touch.path[-1], abs=1e-9)


def test_force_passes_through_its_way_points() -> None:
    touch = ScenarioTouch(
        link="a", from_s=1, duration_s=5, path=((0.5, 0.5),), force_n=(1.0, 3.0, 2.0), ramp_s=0.5
    )
    assert [touch.force_at(t) for t in (1.5, 3.5, 5.5)] == pytest.approx([1.0, 3.0, 2.0])
    assert 0 < touch.force_at(1.25) < 1


def test_force_and_position_are_continuous() -> None:
    touch = ScenarioTouch(
        link="a", from_s=0, duration_s=2, path=((0.1, 0.1), (0.9, 0.1), (0.9, 0.5)), force_n=(1.0, 4.0, 2.0)
    )
    times = [k / 1000 for k in range(2001)]
    for before, after in itertools.pairwise(times):
        assert abs(touch.force_at(after) - touch.force_at(before)) < 0.03
        assert abs(touch.position_at(after)[0] - touch.position_at(before)[0]) < 0.002


def test_repeating_scenario_starts_again_after_pause() -> None:
    text = '[[touch]]\nlink = "a"\nfrom_s = 1.0\nduration_s = 1.0\npath = [[0.5, 0.5]]\nforce_n = [1.0]\n'
    once = Scenario.parse(f"pause_s = 0.5\n{text}")
    assert once.duration_s == 2.5
    assert once.contacts_at(1.5)[0].force_n == 1.0
    assert once.contacts_at(4.0) == []
    again = Scenario.parse(f"pause_s = 0.5\nrepeat = true\n{text}")
    assert again.contacts_at(4.0) == once.contacts_at(1.5)


def test_shipped_session_fits_shipped_hand() -> None:
    hand = config.load(shipped.path("utah_mit.toml"))
    session = Scenario.load(shipped.path("utah_mit_session.toml"))
    session.check_links(pad.link for pad in hand.hands[0].pads)
    assert 20 < session.duration_s < 30
    assert max(len(session.contacts_at(k / 10)) for k in range(260)) >= 12
    assert all(0.05 <= part <= 0.95 for touch in session.touches for point in touch.path for part in point)
    assert {touch.link for touch in session.touches} == {pad.link for pad in hand.hands[0].pads}


def test_tour_touches_every_pad(deployment: config.Deployment) -> None:
    tour = Scenario.tour(deployment)
    assert {touch.link for touch in tour.touches} == {"flat", "round", "tapered", "tip"}
    assert tour.repeat


GOOD = '[[touch]]\nlink = "a"\nfrom_s = 0.0\nduration_s = 1.0\npath = [[0.5, 0.5]]\nforce_n = [1.0]\n'
GUM = '[[fault]]\nkind = "gum"\nlink = "a"\nfrom_s = 3.0\nplace = [0.5, 0.5]\n'


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        (GOOD + "force = 2.0", ['[[touch]] 1 "a": force', "force_n"]),
        (GOOD.replace("[[0.5, 0.5]]", "[[0.5, 1.0]]"), ['[[touch]] 1 "a": path[0][1] = 1.0', "0.98"]),
        (GOOD.replace("[1.0]", "[]"), ["force_n = []"]),
        (GOOD.replace("duration_s = 1.0\n", ""), ["duration_s", "is missing"]),
        (GOOD + "hertz_force_n = 2.0", ['[[touch]] 1 "a"', "hertz_force_n = 2 needs radius_mm"]),
        (GOOD + GUM.replace("gum", "chewing_gum"), ['[[fault]] 1 "a".kind = "chewing_gum"', '"moisture"']),
        (GOOD + GUM + "force = 1.0\n", ['[[fault]] 1 "a": force', "force_n"]),
        (GOOD + GUM.replace("0.5, 0.5", "0.5, 1.5"), ['[[fault]] 1 "a": place[1] = 1.5', "0.98"]),
        (GOOD + GUM + "until_s = 2.0\n", ['[[fault]] 1 "a"', "until_s = 2.0 must come after from_s = 3.0"]),
        ("repeat = true", ["touch", "is missing"]),
        ("touch = [", ["TOML", "correct the syntax"]),
    ],
)
def test_mistake_is_reported_with_location_and_remedy(text: str, expected: list[str]) -> None:
    with pytest.raises(ConfigError) as caught:
        Scenario.parse(text, "mine.toml")
    line = str(caught.value)
    assert line.startswith("mine.toml: ")
    assert [part for part in expected if part not in line] == []


def test_touch_on_link_without_pad_is_reported(deployment: config.Deployment) -> None:
    with pytest.raises(ConfigError, match=r'\[\[touch\]\] 1: link = "a".*flat, round'):
        Scenario.parse(GOOD).check_links(pad.link for pad in deployment.hands[0].pads)


def test_unreadable_scenario_is_a_config_error(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="No such file"):
        Scenario.load(tmp_path / "none.toml")
    (tmp_path / "latin.toml").write_bytes(b"\xff")
    with pytest.raises(ConfigError, match="UTF-8"):
        Scenario.load(tmp_path / "latin.toml")
