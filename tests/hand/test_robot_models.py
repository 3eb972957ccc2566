"""Errors of a deployment that doesn't fit its URDF name file, key, value and remedy."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

from handtouch.config import (
    ConfigError,
    Deployment,
    load,
    shipped,
)
from handtouch.hand import urdf
from handtouch.hand.body_distance import signed_distance_m
from handtouch.hand.kinematics import HandKinematics
from handtouch.hand.pads import rotation_from_rpy
from handtouch.hand.robot_models import (
    RobotModels,
    check_urdfs,
    drop_invalid_urdfs,
    unchecked_items,
)
from handtouch.hand.urdf import BodyShape, UrdfError

LINK = '<link name="{}"/>'
JOINT = '<joint name="{0}" type="{1}"><parent link="{2}"/><child link="{3}"/></joint>'


def robot(*parts: str) -> str:
    return f"<robot>{''.join(parts)}</robot>"


AB, ABC = [LINK.format(name) for name in "ab"], [LINK.format(name) for name in "abc"]
FIXED = JOINT.format("j", "fixed", "a", "b")
MOUNT = "mount = { position_mm = [26.0, 0.0, 12.5] }"


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("<robot><link", "isn't valid XML"),
        ("<launch/>", "no <robot>"),
        (robot(), "has no link"),
        (robot("<link/>"), "without a name"),
        (robot(LINK.format("a"), LINK.format("a")), "names must differ"),
        (robot(*AB), "has the roots 'a', 'b'"),
        (robot(LINK.format("a"), FIXED), 'child "b", which does not exist'),
        (
            robot(*ABC, *(JOINT.format(f"j{p}", "fixed", p, "c") for p in "ab")),
            'link "c" is the child of joints "ja" and "jb"',
        ),
        (
            robot(*ABC, JOINT.format("j", "fixed", "b", "c"), JOINT.format("k", "fixed", "c", "b")),
            "cycle",
        ),
        (robot(*AB, JOINT.format("j", "ball", "a", "b")), 'is of type "ball"; known are revolute'),
        (
            robot(*AB, FIXED.replace("<parent", '<origin xyz="0 x 0"/><parent')),
            '<origin xyz="0 x 0"> must be 3 numbers',
        ),
        (robot(*AB, '<xacro:property name="r" value="1"/>'), "has tags of xacro; convert it"),
    ],
)  # fmt: skip
def test_unusable_urdf_is_rejected_with_a_remedy(text: str, said: str) -> None:
    with pytest.raises(UrdfError, match=re.escape(said)):
        urdf.parse_urdf(text)


def changed(tmp_path: Path, *changes: tuple[str, str], robot_text: str | None = None) -> Deployment:
    text = shipped.path("utah_mit.toml").read_text()
    for before, after in changes:
        assert before in text
        text = text.replace(before, after, 1)
    (tmp_path / "hand.toml").write_text(text)
    (tmp_path / "utah_mit.urdf").write_text(robot_text or shipped.path("utah_mit.urdf").read_text())
    return load(tmp_path / "hand.toml")


@pytest.mark.parametrize(
    ("file", "said"),
    [
        ("tip.stl", "file tip.stl not found; paths are relative to the URDF's folder"),
        ("package://my_hand/tip.stl", "put the folder my_hand of its ROS package into"),
        ("hand.toml", "hand.toml can't be read; convert it to STL, OBJ or COLLADA"),
    ],
)
def test_a_mesh_that_is_not_used_is_named_with_a_remedy(tmp_path: Path, file: str, said: str) -> None:
    pytest.importorskip("coal")
    text = shipped.path("utah_mit.urdf").read_text()
    shapes = re.compile(r'(<link name="thumb_distal">.*?<geometry>).*?(</geometry>)', re.DOTALL)
    text, count = shapes.subn(rf'\1<mesh filename="{file}"/>\2', text, count=1)
    assert count == 1
    (why,) = unchecked_items(changed(tmp_path, robot_text=text))
    assert why.startswith("right/thumb_distal: position on the link's body not checked: ")
    assert said in why


def test_shipped_hand_fits_its_urdf() -> None:
    deployment = check_urdfs(load(shipped.path("utah_mit.toml")), "utah_mit.toml")
    assert not list(unchecked_items(deployment))
    robots = RobotModels(deployment)
    assert robots.hands == ["right"]
    body = urdf.read_urdf(Path(deployment.hands[0].urdf or "")).bodies
    for pad in deployment.hands[0].pads:
        middle = np.array([pad.mount.position_mm]) * 1e-3
        assert abs(signed_distance_m(body[pad.link], middle, Path())[0]) < 2e-4, pad.link


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (('urdf = "utah_mit.urdf"', 'urdf = "gone.urdf"'), "urdf = .*gone.urdf.*: No such file.*its path"),
        (('palm_link = "palm"', 'palm_link = "plam"'), 'palm_link = "plam": .*did you mean "palm"'),
        (('base_link = "base"', 'joint_names = { index_mpc = "x" }'), 'joint_names = "index_mpc".*index_mcp'),
        (('link = "ring_distal"', 'link = "ring_tip"'), 'link = "ring_tip".*no such link.*mount.link'),
        (
            (MOUNT, MOUNT.replace("{", '{ link = "nowhere",')),
            'mount.link = "nowhere"',
        ),
        (
            ("position_mm = [26.0, 0.0, 12.5]", "position_mm = [26.0, 0.0, 2.5]"),
            r"position_mm = \[26.0, 0.0, 2.5\]: the pad's centre is 10.0 mm inside the body.*move it",
        ),
        (("position_mm = [26.0, 0.0, 12.5]", "position_mm = [26.0, 0.0, 32.5]"), "20.0 mm from the body"),
        (
            (MOUNT, MOUNT.replace("]", "], rpy_deg = [180.0, 0.0, 0.0]")),
            "faces into the body",
        ),
        (('urdf = "utah_mit.urdf"', ""), 'palm_link = "palm": .*needs a URDF'),
    ],
)  # fmt: skip
def test_misfit_is_reported_with_key_value_and_remedy(
    tmp_path: Path, change: tuple[str, str], said: str
) -> None:
    with pytest.raises(ConfigError, match=said):
        check_urdfs(changed(tmp_path, change), "hand.toml")


def test_hand_that_does_not_fit_is_served_in_link_frames_only(tmp_path: Path) -> None:
    scene = ("[touch]", '[scene]\noutputs = ["position", "palm"]\n\n[touch]')
    wrong = changed(tmp_path, scene, ('palm_link = "palm"', 'palm_link = "plam"'))
    deployment, (problem,) = drop_invalid_urdfs(wrong, "hand.toml")
    assert 'did you mean "palm"' in str(problem)
    assert RobotModels(deployment).hands == []
    assert deployment.hands[0].pads == wrong.hands[0].pads
    right = changed(tmp_path, scene)
    assert drop_invalid_urdfs(right, "hand.toml") == (right, ())


def test_palm_output_needs_a_urdf(tmp_path: Path) -> None:
    scene = ("[touch]", '[scene]\noutputs = ["palm"]\n\n[touch]')
    names = [("urdf =", "# urdf ="), ("palm_link", "# palm_link"), ("base_link", "# base_link")]
    with pytest.raises(ConfigError, match=r"\[scene\]: outputs.*needs a hand with a URDF"):
        check_urdfs(changed(tmp_path, scene, *names), "hand.toml")
    check_urdfs(changed(tmp_path, scene), "hand.toml")


def test_joint_states_may_use_other_names(tmp_path: Path) -> None:
    given = 'base_link = "base"\njoint_prefix = "r_"\njoint_names = { index_pip = "second" }'
    (names,) = RobotModels(changed(tmp_path, ('base_link = "base"', given))).joint_names
    assert {"r_index_mcp", "second"} <= set(names)


SQUARES = [
    ((0, 0, 0), (0, 1, 0), (1, 1, 0), (1, 0, 0)),
    ((0, 0, 1), (1, 0, 1), (1, 1, 1), (0, 1, 1)),
    ((0, 0, 0), (1, 0, 0), (1, 0, 1), (0, 0, 1)),
    ((0, 1, 0), (0, 1, 1), (1, 1, 1), (1, 1, 0)),
    ((0, 0, 0), (0, 0, 1), (0, 1, 1), (0, 1, 0)),
    ((1, 0, 0), (1, 1, 0), (1, 1, 1), (1, 0, 1)),
]


def cube() -> str:
    """The unit cube as an STL file."""
    facets = [corners for a, b, c, d in SQUARES for corners in ((a, b, c), (a, c, d))]
    text = "".join(
        "facet normal 0 0 0 outer loop "
        + " ".join(f"vertex {x} {y} {z}" for x, y, z in corners)
        + " endloop endfacet\n"
        for corners in facets
    )
    return f"solid\n{text}endsolid\n"


def test_distances_from_bodies_equal_those_from_their_shapes(tmp_path: Path) -> None:
    points = np.random.default_rng(5).uniform(-2, 2, (200, 3))
    here = np.eye(3), np.zeros(3)
    box = signed_distance_m([BodyShape("box", (2.0, 2.0, 2.0), *here)], points, tmp_path)
    mesh = BodyShape("mesh", (2.0, 2.0, 2.0), np.eye(3), np.full(3, -1.0), "package://some/cube.stl")
    (tmp_path / "some").mkdir()
    (tmp_path / "some/cube.stl").write_text(cube())
    np.testing.assert_allclose(signed_distance_m([mesh], points, tmp_path), box, atol=1e-6)
    distance = np.linalg.norm(points, axis=1)
    np.testing.assert_allclose(
        signed_distance_m([BodyShape("sphere", (0.5,), *here)], points, tmp_path), distance - 0.5
    )
    around, along = np.hypot(points[:, 0], points[:, 1]), np.abs(points[:, 2])
    found = signed_distance_m([BodyShape("cylinder", (0.5, 2.0), *here)], points, tmp_path)
    beside = along < 1
    np.testing.assert_allclose(found[beside & (around > 0.5)], around[beside & (around > 0.5)] - 0.5)
    np.testing.assert_allclose(found[~beside & (around < 0.5)], along[~beside & (around < 0.5)] - 1)
    both = signed_distance_m(
        [BodyShape("box", (2.0, 2.0, 2.0), *here), BodyShape("sphere", (0.5,), *here)], points, tmp_path
    )
    np.testing.assert_allclose(both, np.minimum(box, distance - 0.5))
    assert np.isinf(signed_distance_m([], points, tmp_path)).all()


MOVED = (
    """<joint name="{}" type="revolute"><parent link="{}"/><child link="{}"/><axis xyz="0 1 0"/>{}</joint>"""
)


def chain(*mimics: str, kind: str = "revolute") -> urdf.RobotDescription:
    """Return links a, b, c, d in a row, with joints j0, j1 and j2 of which each may mimic another."""
    links = [LINK.format(name) for name in "abcd"]
    joints = [MOVED.format(f"j{k}", "abcd"[k], "abcd"[k + 1], mimic) for k, mimic in enumerate(mimics)]
    joints[0] = joints[0].replace("revolute", kind)
    return urdf.parse_urdf(robot(*links, *joints))


def test_chained_mimics_multiply() -> None:
    made = chain(
        "",
        '<mimic joint="j0" multiplier="2" offset="0.1"/>',
        '<mimic joint="j1" multiplier="-3" offset="0.5"/>',
    )
    assert made.joints["j1"].mimic == ("j0", 2.0, 0.1)
    assert made.joints["j2"].mimic == ("j0", -6.0, -3 * 0.1 + 0.5)
    kinematics = HandKinematics(made, ["d"], "a", "a")
    assert kinematics.joints == ("j0",)


def test_mimics_in_a_circle_are_refused() -> None:
    with pytest.raises(UrdfError, match="mimic each other"):
        chain('<mimic joint="j1"/>', '<mimic joint="j0"/>', "")


def test_joint_that_mimics_an_absent_one_moves_by_itself_with_a_warning() -> None:
    made = chain('<mimic joint="ghost"/>', '<mimic joint="j0" multiplier="2"/>', "")
    assert made.joints["j0"].mimic is None
    assert made.joints["j1"].mimic == ("j0", 2.0, 0.0)
    assert made.warnings == ('joint "j0" mimics "ghost", which does not exist: it moves by itself',)


@pytest.mark.parametrize(
    ("geometry", "said"),
    [
        ("<cone/>", "has <cone> in its <geometry>; known are box"),
        ("", "has nothing in its <geometry>"),
        ('<mesh filename="a.stl" scale="1"/>', 'scale="1"> must be 3 numbers'),
    ],
)
def test_faulty_shape_is_left_out_with_a_warning(geometry: str, said: str) -> None:
    sound = '<collision><geometry><sphere radius="0.01"/></geometry></collision>'
    faulty = f"<collision><geometry>{geometry}</geometry></collision>"
    made = urdf.parse_urdf(robot(f'<link name="a">{faulty}{sound}<collision/></link>'))
    assert [shape.kind for shape in made.bodies["a"]] == ["sphere"]
    assert said in made.warnings[0]
    assert made.warnings[1] == 'link "a", <collision> has no <geometry>; this body isn\'t used'


def test_elements_of_other_programs_beside_a_shape_do_not_matter() -> None:
    geometry = '<geometry><box size="1 1 1"/><drake:declare_convex/></geometry>'
    text = robot(f'<link name="a"><collision>{geometry}</collision></link>', '<my-tool:note my-tool:x="1"/>')
    for before in (
        "",
        "\n",
        "<!-- a licence -->\n",
        '\n<?xml version="1.0"?>',
        "<!-- x --><?xml version='1.0'?>",
    ):
        made = urdf.parse_urdf(before + text)
        assert [shape.kind for shape in made.bodies["a"]] == ["box"]
        assert made.warnings == ()


@pytest.mark.parametrize("prefixed", ["", "<my-tool:note/>"])
def test_a_text_is_read_whatever_encoding_it_declares(prefixed: str) -> None:
    """As a topic or a parameter has it; a file's bytes are read by its declaration."""
    text = '<?xml version="1.0" encoding="iso-8859-1"?>' + robot('<link name="händ"/>', prefixed)
    for given in (text, text.encode("iso-8859-1")):
        assert list(urdf.parse_urdf(given).bodies) == ["händ"]


@pytest.mark.parametrize("kind", ["fixed", "floating"])
def test_what_only_movable_joints_have_is_ignored_in_others(kind: str) -> None:
    mimic = '<axis xzy="0 0 1"/><mimic joint="j" offset="0.5"/>'
    joint = JOINT.format("k", kind, "b", "c").replace("<parent", f"{mimic}<parent")
    made = urdf.parse_urdf(robot(*ABC, FIXED, joint))
    assert (made.joints["k"].kind, made.joints["k"].mimic) == (kind, None)
    np.testing.assert_array_equal(made.joints["k"].rotation, np.eye(3))


def test_joint_that_mimics_a_floating_one_moves_by_itself_with_a_warning() -> None:
    turning = JOINT.format("k", "revolute", "b", "c").replace("<parent", '<mimic joint="j"/><parent')
    made = urdf.parse_urdf(robot(*ABC, FIXED.replace("fixed", "floating"), turning))
    assert made.joints["k"].mimic is None
    assert "more than one position" in made.warnings[0]


def test_joint_that_mimics_a_fixed_one_stays_at_its_offset_and_needs_no_state() -> None:
    made = chain("", '<mimic joint="j0" multiplier="2" offset="0.3"/>', "", kind="fixed")
    assert HandKinematics(made, ["d"], "a", "a").joints == ("j2",)
    assert made.joints["j1"].kind == "fixed"
    expected = rotation_from_rpy([0.0, 0.3, 0.0])
    assert made.joints["j1"].rotation == pytest.approx(expected)


@pytest.mark.parametrize("kind", ["floating", "planar"])
def test_joint_of_unknown_motion_matters_only_between_palm_base_and_pads(kind: str) -> None:
    made = chain("", "", "", kind=kind)
    assert made.default_base("b") == "b"
    assert HandKinematics(made, ["d"], "b", "b").joints == ("j1", "j2")
    with pytest.raises(UrdfError, match=f'joint "j0" between palm, base and pads is {kind}'):
        HandKinematics(made, ["d"], "a", "a")


def test_default_namespace_is_ignored() -> None:
    text = robot(*AB, FIXED).replace("<robot", '<robot xmlns="http://www.ros.org/urdf"', 1)
    assert list(urdf.parse_urdf(text).joints) == list(urdf.parse_urdf(robot(*AB, FIXED)).joints)


def test_doubtful_mount_is_reported_and_its_hand_keeps_palm_and_base(tmp_path: Path) -> None:
    deep = changed(tmp_path, ("position_mm = [26.0, 0.0, 12.5]", "position_mm = [26.0, 0.0, 32.5]"))
    deployment, (problem,) = drop_invalid_urdfs(deep, "hand.toml")
    assert "20.0 mm from the body" in str(problem)
    assert RobotModels(deployment).hands == ["right"]


@pytest.mark.parametrize(
    "mount",
    [
        "{ position_mm = [26.0, 0.0, 2.5] }",
        "{ position_mm = [26.0, 3.0, 32.5] }",
        "{ position_mm = [26.0, 0.0, 12.5], rpy_deg = [180.0, 0.0, 0.0] }",
        "{ position_mm = [20.0, 25.0, -4.0], rpy_deg = [30.0, 20.0, 10.0] }",
    ],
)
def test_the_proposed_mount_is_on_the_body_and_faces_outward(tmp_path: Path, mount: str) -> None:
    with pytest.raises(ConfigError) as raised:
        check_urdfs(changed(tmp_path, (MOUNT, f"mount = {mount}")), "hand.toml")
    found = re.search(r"nearest place is (position_mm = \[.*?\]), (rpy_deg = \[.*?\])", str(raised.value))
    assert found is not None
    assert "-0.0" not in found[0]
    check_urdfs(changed(tmp_path, (MOUNT, f"mount = {{ {found[1]}, {found[2]} }}")), "hand.toml")


def test_a_mount_that_is_not_given_is_asked_for(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"mount: isn't given.*origin of its link.*state position_mm"):
        check_urdfs(changed(tmp_path, (MOUNT, "")), "hand.toml")


def test_pad_may_lie_on_the_visible_surface_or_on_the_collision_body(tmp_path: Path) -> None:
    text = shipped.path("utah_mit.urdf").read_text()
    (mounted,) = re.findall(r'<link name="index_distal">.*?</link>', text, flags=re.DOTALL)
    box = '<collision><geometry><box size="0.2 0.2 0.2"/></geometry></collision>'
    visible = mounted.replace("<collision>", "<visual>").replace("</collision>", "</visual>")
    both = visible.replace("</link>", f"{box}</link>")
    only_hull = f'<link name="index_distal">{box}</link>'
    check_urdfs(changed(tmp_path, robot_text=text.replace(mounted, both)), "hand.toml")
    with pytest.raises(ConfigError, match="inside the body"):
        check_urdfs(changed(tmp_path, robot_text=text.replace(mounted, only_hull)), "hand.toml")
