"""The separable form of a rectangle's harmonic measure: two functions of one coordinate each, and algebra.

Of one pair of opposite sides let T0 and T1 be tan(pi f / 2) of their fractions f. On a rectangle

* T0 / T1 depends on the distance from side 0 alone, never on the position along it: it is
  cs(kappa d; k')^2 / k, a Jacobi elliptic function whose nome is exp(-2 pi depth / length);
* T0 T1 = tan(arctan(delta / g) / 2)^2, where g = w + 1/w and w^2 is that same ratio of the *other* pair.

So two functions, `SideRatio` of x and of y, give all four fractions, their derivatives and the conformal
radius by algebra on positive numbers, which keeps relative accuracy however small a fraction is. It follows
from w = sn(z) mapping the rectangle to the half plane (sides seen under the angles pi f), from the
addition theorem of sn / cn, and from Landen's transformation.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from handtouch.arrays import FloatArray

_TERM_ORDERS = (1, 2, 3)  # theta series: the largest nome used is exp(-pi), and exp(-16 pi) is below rounding


def theta_two(nome: float) -> float:
    """theta_2(0) / (2 nome^(1/4))."""
    return 1.0 + sum(math.pow(nome, n * (n + 1)) for n in _TERM_ORDERS)


def theta_three(nome: float) -> float:
    """theta_3(0)."""
    return 1.0 + 2 * sum(math.pow(nome, n * n) for n in _TERM_ORDERS)


def theta_four(nome: float) -> float:
    """theta_4(0)."""
    return 1.0 + 2 * sum((-1.0) ** n * math.pow(nome, n * n) for n in _TERM_ORDERS)


@dataclass(frozen=True)
class SideRatio:
    """Ratio G(d) = root * sqrt(T0 / T1) at distance d from side 0; sides `depth` apart and `length` long."""

    depth: float
    length: float

    @cached_property
    def deep(self) -> bool:
        """True if the series in exp(-2 pi depth / length) converges faster than the other one."""
        return 2 * self.depth > self.length

    @cached_property
    def nome(self) -> float:
        """Nome of the series in use, at most exp(-pi)."""
        ratio = self.depth / self.length
        return math.exp(-2 * math.pi * ratio) if self.deep else math.exp(-math.pi / (2 * ratio))

    @cached_property
    def root(self) -> float:
        """sqrt(G(d) G(depth - d)), the same for every d; underflows harmlessly for very deep pairs."""
        return math.exp(-math.pi * self.depth / (2 * self.length)) if self.deep else 1.0

    @cached_property
    def moduli(self) -> tuple[float, float]:
        """The modulus k and its complement k', neither by subtraction from 1."""
        q = self.nome
        three = theta_three(q) ** 2
        vanishing = 4 * math.sqrt(q) * theta_two(q) ** 2 / three
        other = theta_four(q) ** 2 / three
        return (vanishing, other) if self.deep else (other, vanishing)

    @cached_property
    def wavenumber(self) -> float:
        """kappa: the argument of the elliptic functions is kappa d."""
        three = theta_three(self.nome) ** 2
        return math.pi * three / (self.length if self.deep else 2 * self.depth)

    @cached_property
    def slope(self) -> float:
        """The factor in -d ln G / dd = slope * hypot(G(d) + G(depth - d), root * delta)."""
        if self.deep:
            return 2 * math.pi / self.length * theta_two(self.nome) * theta_three(self.nome)
        return self.wavenumber * math.sqrt(self.moduli[0])

    def __call__(self, distance: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return G at `distance` from side 0 and at the mirrored distance; infinite on side 0, zero on side
        1.
        """
        return self._deep_pair(distance) if self.deep else self._shallow_pair(distance)

    def _deep_pair(self, near: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Evaluate a ratio of theta functions of imaginary argument, scaled so that nothing overflows."""
        unit = -math.pi / self.length
        far = self.depth - near
        decay, decay_far = np.exp(unit * near), np.exp(unit * far)
        image, image_far = decay * decay, decay_far * decay_far
        part = -np.expm1(2 * unit * near) * self._images(image, image_far)
        part_far = -np.expm1(2 * unit * far) * self._images(image_far, image)
        quotient = part_far / part
        return decay * quotient, decay_far / quotient

    def _images(self, image: FloatArray, image_far: FloatArray) -> FloatArray:
        """Return sum_n (-1)^n q^(n^2) far^n (1 - near^(2n+1)) / (1 - near), the images beyond the first."""
        q = self.nome
        geometric: FloatArray | float = 1.0
        total: FloatArray = np.ones_like(image)
        power: FloatArray | float = 1.0
        factor: FloatArray | float = 1.0
        for n in _TERM_ORDERS:
            weight = (-1) ** n * q ** (n * n)
            if abs(weight) < 1e-18:
                break
            for _ in range(2):
                power = power * image
                geometric = geometric + power
            factor = factor * image_far
            total = total + weight * factor * geometric
        return total

    def _shallow_pair(self, near: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Evaluate a ratio of theta functions of real argument."""
        p2, p6, p12 = (self.nome ** (n * (n + 1)) for n in _TERM_ORDERS)
        unit = math.pi / (2 * self.depth)
        far = self.depth - near
        c = np.cos(2 * unit * near)
        d = 2 * (2 * c * c - 1)
        e = 2 * c * (d - 1)
        c = 2 * c
        even = 1 - p2 + p6 * (1 + d) - p12 * (1 + d)
        odd = p2 * c - p6 * c + p12 * (e + c)
        quotient = (np.sin(unit * far) * (even + odd)) / (np.sin(unit * near) * (even - odd))
        return quotient, 1 / quotient
