"""The table `[shear.NAME]`: a kind of shear pad, its electrode pattern, film and elastic layer.

Public names: `Shear`, `ShearPatternTable`, the tables of its kinds and `SHEAR_PATTERNS`, by their kind.
"""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from handtouch.config.base import Positive, Table
from handtouch.field.elastic_layer import ElasticLayer
from handtouch.field.shear import BarPattern, DiscPattern, FilmLaw, ShearPattern

_MM = 1e-3


class _PairedBars(Table):
    bars: Annotated[int, Field(ge=1, le=50)] = Field(
        description="bars of one direction, of each field", examples=[2]
    )
    pitch_mm: Positive = Field(description="distance of neighbouring bars, across them", examples=[3.4])
    overlap_mm: Positive = Field(
        description="overlap of a bar with either of its electrodes at rest", examples=[0.6]
    )
    length_mm: Positive = Field(description="length of the electrodes along the bars", examples=[6.0])
    gap_mm: Positive = Field(description="gap between the two electrodes under a bar", examples=[0.4])


class Bars(_PairedBars):
    """Parallel bars across x, over pairs of electrodes x0 and xa: the component x."""

    kind: Literal["bars"]

    def build(self, film_m: float) -> ShearPattern:
        """Return the pattern over a film."""
        sizes = (self.overlap_mm * _MM, self.length_mm * _MM, self.gap_mm * _MM)
        return BarPattern.single(self.bars, self.pitch_mm * _MM, *sizes, film_m)


class CrossedBars(_PairedBars):
    """Two fields of bars across x and two across y: both components."""

    kind: Literal["crossed_bars"]

    def build(self, film_m: float) -> ShearPattern:
        """Return the pattern over a film."""
        sizes = (self.overlap_mm * _MM, self.length_mm * _MM, self.gap_mm * _MM)
        return BarPattern.crossed(self.bars, self.pitch_mm * _MM, *sizes, film_m)


class Pinwheel(Table):
    """Four single bars around the centre: both components, and twist."""

    kind: Literal["pinwheel"]
    arm_mm: Positive = Field(description="distance of the bars from the centre", examples=[4.0])
    overlap_mm: Positive = Field(description="overlap of a bar with its electrode at rest", examples=[0.6])
    length_mm: Positive = Field(description="length of the electrodes along the bars", examples=[5.0])

    def build(self, film_m: float) -> ShearPattern:
        """Return the pattern over a film."""
        return BarPattern.pinwheel(self.arm_mm * _MM, self.overlap_mm * _MM, self.length_mm * _MM, film_m)


class Discs(Table):
    """Round plates, each over four sectors: both components, whatever the twist."""

    kind: Literal["discs"]
    discs: Annotated[int, Field(ge=1, le=200)] = Field(description="number of round plates")
    radius_mm: Positive = Field(description="radius of a plate")
    gap_mm: Positive = Field(description="gap between sectors, less than the radius")

    def build(self, film_m: float) -> ShearPattern:
        """Return the pattern over a film. Raises ValueError for a gap wider than the radius."""
        return DiscPattern(self.discs, self.radius_mm * _MM, self.gap_mm * _MM, film_m)


SHEAR_PATTERNS: dict[str, type[Table]] = {
    "bars": Bars,
    "crossed_bars": CrossedBars,
    "pinwheel": Pinwheel,
    "discs": Discs,
}
"""Tables of patterns by their kind."""
ShearPatternTable = Annotated[Bars | CrossedBars | Pinwheel | Discs, Field(discriminator="kind")]


class Shear(Table):
    """`[shear.NAME]`: a kind of shear pad: electrode pattern, resistive film, elastic layer."""

    pattern: ShearPatternTable = Field(description="electrodes, by `kind`")
    film_mm: Positive = Field(description="thickness of the film between the facing electrodes")
    film_ohm_mm2: Positive = Field(description="resistance times area across the film without load")
    film_reference_kpa: Positive = Field(
        50.0, description="pressure that multiplies the film's conductance by 2^film_alpha"
    )
    film_alpha: float = Field(
        0.3, gt=0, le=2, description="exponent of the film's conductance, (1 + p / film_reference_kpa)^alpha"
    )
    plate_mm: Positive = Field(description="side of the square plate that carries the normal force")
    stiffness_n_per_mm: Annotated[tuple[Positive, Positive], Field(strict=False)] = Field(
        description="tangential stiffness of the elastic layer along x and y"
    )
    stiffness_std: Annotated[float, Field(ge=0, le=1)] = Field(
        0.12, description="relative error of both stiffnesses together (1 sigma), before calibration"
    )
    axis_std: Annotated[float, Field(ge=0, le=1)] = Field(
        0.06, description="relative error of each axis by itself, electrodes included (1 sigma)"
    )
    hysteresis: Annotated[float, Field(ge=0, le=1)] = Field(
        0.05, description="half-width of the layer's loop as a fraction of the greatest force since the tare"
    )
    zero_std_n: Annotated[float, Field(ge=0)] = Field(
        0.02, description="error of a component at rest after the tare (1 sigma)"
    )

    def build_pattern(self) -> ShearPattern:
        """Return the pattern in metres. Raises ValueError for one that can't exist."""
        return self.pattern.build(self.film_mm * _MM)

    def build_film(self) -> FilmLaw:
        """Return the film's law in SI units."""
        side = self.plate_mm * _MM
        return FilmLaw(
            siemens_per_m2=1e6 / self.film_ohm_mm2,
            reference_pa=1e3 * self.film_reference_kpa,
            alpha=self.film_alpha,
            plate_m2=side**2,
            gyration_m2=side**2 / 12,
        )

    def build_layer(self) -> ElasticLayer:
        """Return the elastic layer in SI units."""
        x, y = self.stiffness_n_per_mm
        return ElasticLayer(
            (1e3 * x, 1e3 * y), self.stiffness_std, self.axis_std, self.hysteresis, self.zero_std_n
        )
