"""Payload of the internal stream from the daemon to its percept process: `PerceptInput`."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from handtouch.wire.columns import Column


@dataclass(frozen=True, slots=True)
class PerceptInput:
    """`percept_input/<hand>`: the contacts of one tick; each message is complete, so that any may be lost.

    Rows of `contact_id` and `requested` are the hand's links, those of all other columns the contacts with a
    new sample. The columns from `palm_position_m` on are empty where nothing is known. Floats are NaN where
    unknown.
    """

    v: int
    session: int
    seq: int
    t_ns: int
    """the tick's SYNC"""
    hand: str
    """name of the hand"""
    contact_id: Annotated[bytes, Column("<u4")]
    """id of the contact on every link, 0 for none"""
    requested: Annotated[bytes, Column("<u1")]
    """requested percepts of every link: bits in the order of the kinds of `percept`, then `action_request`"""
    row: Annotated[bytes, Column("<u4")]
    """index of the contact's link, from 0"""
    sample_ns: Annotated[bytes, Column("<i8")]
    """time of the sample"""
    xy: Annotated[bytes, Column("<f8", 2)]
    """position on the pad's rectangle"""
    pad_m: Annotated[bytes, Column("<f8", 2)]
    """as in `contact`"""
    pad_noise_m2: Annotated[bytes, Column("<f8", 3)]
    """covariance of `pad_m` that is independent in each sample: along, mixed, across"""
    position_m: Annotated[bytes, Column("<f8", 3)]
    """in the link's frame"""
    normal: Annotated[bytes, Column("<f8", 3)]
    """as in `contact`"""
    covariance_m2: Annotated[bytes, Column("<f8", 9)]
    """of `position_m`, row by row"""
    force_n: Annotated[bytes, Column("<f8")]
    """normal force"""
    force_std_n: Annotated[bytes, Column("<f8")]
    """its standard deviation"""
    total_current_a: Annotated[bytes, Column("<f8")]
    """as in `contact`"""
    residual: Annotated[bytes, Column("<f8")]
    """as in `contact`"""
    residual_std: Annotated[bytes, Column("<f8")]
    """as in `contact`"""
    slip_log_odds: Annotated[bytes, Column("<f8")]
    """ln of the odds of slip; infinite while it slips, NaN where slip isn't requested"""
    slip_velocity_m_per_s: Annotated[bytes, Column("<f8", 2)]
    """likeliest velocity on the pad since the likeliest onset of slip"""
    tremor_std_m: Annotated[bytes, Column("<f8", 2)]
    """tremor of the centroid on the pad, as learnt"""
    retained: bool
    palm_position_m: Annotated[bytes, Column("<f8", 3)] = b""
    """in the palm's frame"""
    palm_normal: Annotated[bytes, Column("<f8", 3)] = b""
    """outward unit normal, in the palm's frame"""
    palm_covariance_m2: Annotated[bytes, Column("<f8", 9)] = b""
    """covariance of `palm_position_m`, row by row"""
    palm_rotation: Annotated[bytes, Column("<f8", 9)] = b""
    """of the link's frame in the palm's, row by row"""
    palm_joints_m2: Annotated[bytes, Column("<f8")] = b""
    """part of `palm_covariance_m2` from joints, mean per axis"""
    joints_age_s: Annotated[bytes, Column("<f8")] = b""
    """as in `contact`"""
    force_vector_n: Annotated[bytes, Column("<f8", 3)] = b""
    """as in `contact`, of contacts above shear pads whose position is valid and whose force no lower bound"""
    force_vector_covariance_n2: Annotated[bytes, Column("<f8", 9)] = b""
    """its covariance, row by row"""
    contact_radius_m: Annotated[bytes, Column("<f8")] = b""
    """as in `contact`, of contacts whose radius and force are valid by both sheets of their pad"""
    contact_radius_std_m: Annotated[bytes, Column("<f8")] = b""
    """its standard deviation"""
    clear: Annotated[bytes, Column("<u1")] = b""
    """1 for every link whose pad is sampled and untouched; this and the following are present 20 times a
    second, while `object` is requested"""
    link_poses: Annotated[bytes, Column("<f8", 12)] = b""
    """of every link in the palm: rotation, row by row, and translation"""
    base_pose: Annotated[bytes, Column("<f8", 12)] = b""
    """of the palm in the base, alike"""
    known_object: str = ""
    """name and table of the object, `NAME={JSON}`; empty for none"""
