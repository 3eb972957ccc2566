"""Registry of percept estimators: a new kind of percept is added here.

Public names: `build_percept_pipeline`.
"""

from __future__ import annotations

from handtouch.percept.motion import MotionEstimator
from handtouch.percept.pipeline import PerceptPipeline
from handtouch.percept.samples import ContactBuffer, PerceptEstimator
from handtouch.percept.shape import PairDistanceFunction, ShapeEstimator
from handtouch.percept.stiffness_estimator import StiffnessEstimator
from handtouch.percept.texture import TextureEstimator


def build_percept_pipeline(
    buffer: ContactBuffer, period_ns: int, pair_m: PairDistanceFunction | None = None
) -> PerceptPipeline:
    """Build the pipeline of all estimators for a buffer whose samples come every `period_ns`.

    pair_m: see `ShapeEstimator`.
    """
    parts: list[PerceptEstimator] = [
        MotionEstimator(buffer, period_ns),
        StiffnessEstimator(buffer.size),
        ShapeEstimator(buffer.size, pair_m=pair_m),
        TextureEstimator(buffer.size),
    ]
    return PerceptPipeline(buffer, parts)
