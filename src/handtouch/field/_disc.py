"""The conformal map of a rectangle onto the unit disc, exact near the crowded images of its short sides.

With s the position from the centre of the rectangle, its shorter side along the real axis, v = pi s / (2
shorter), nome q = exp(-pi longer / shorter) <= exp(-pi), the map that takes the middles of the short sides
to +1 and -1 is

    zeta = theta1(v) theta3(v) / (i theta2(v) theta4(v))

(zeros at the centre and its images by an even number of reflections, poles at the others, |zeta| = 1 on the
boundary). Computed are the defects 1 - zeta and 1 + zeta, each a product without cancellation: of
theta2 theta4 +- i theta1 theta3 all but a quickly falling series factors into 1 - q exp(-+4iv), which
vanishes where the defect does. The derivative needs no theta function: d zeta / ds = C sqrt(product over
corners of (1 - zeta / corner)).
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float64]
ComplexArray = npt.NDArray[np.complex128]


class DiscMap:
    """Rectangle [0, a] x [0, b] onto |zeta| <= 1, for sides within 50:1 of each other.

    A point of the disc is given by its defects from the poles +1 and -1: [1 - zeta, 1 + zeta]; a point of the
    circle by its nearer pole (0 or 1) and the angle from there.
    """

    def __init__(self, a: float, b: float) -> None:
        self._centre = complex(a / 2, b / 2)
        shorter, longer = min(a, b), max(a, b)
        self._turn = 1.0 if a <= b else -1j  # lays the shorter side along the real axis
        self._to_angle = math.pi / (2 * shorter)
        self._half_length = 0.5j * longer
        self._q = math.exp(-math.pi * longer / shorter)
        images = _image_polynomial(self._q)
        signs = (-1.0) ** np.arange(images.size)
        self._images = images * signs
        growth = float(images.sum() / self._images.sum())  # theta1 theta3 / (theta2 theta4) is v times this
        self._growth = -1j * self._turn * self._to_angle * growth
        self._scale = 1.0
        self._scale = 1.0 / complex(self.defects(np.array(a / 2), np.array(b / 2))[0]).real
        corners = self.defects(np.array([0.0, a, a, 0.0]), np.array([0.0, 0.0, b, b]))
        self._corners = CirclePoints.at(corners)

    def defects(self, x: FloatArray, y: FloatArray) -> ComplexArray:
        """[1 - zeta, 1 + zeta], shape (2, ...)."""
        s = (x + 1j * y - self._centre) * self._turn
        w = np.exp(1j * self._to_angle * s)
        inverse = 1 / w
        double_cosine = w * w + inverse * inverse
        below = np.full_like(w, self._images[-1])
        for coefficient in self._images[-2::-1]:
            below = below * (0.5 * double_cosine) + coefficient
        below *= w + inverse
        above = [w * self._factor(s - self._half_length), inverse * self._factor(-s - self._half_length)]
        return np.stack(above) / below

    def derivative(self, defects: ComplexArray) -> ComplexArray:
        """D zeta / d(x + iy) where the defects are given."""
        roots = np.sqrt(self._corners.factors(defects))
        return np.asarray(self._growth * (roots[0] * roots[1]) * (roots[2] * roots[3]))

    def radius(self, defects: ComplexArray) -> FloatArray:
        """Conformal radius, (1 - |zeta|^2) / |d zeta / dz|."""
        near = np.where(np.abs(defects[0]) < np.abs(defects[1]), defects[0], defects[1])
        return np.asarray((2 * near.real - np.abs(near) ** 2) / np.abs(self.derivative(defects)))

    def _factor(self, beyond: ComplexArray) -> ComplexArray:
        """(1 - y) and its series in y = q exp(-4iv); `beyond` is s from the middle of the short side."""
        exponent = -4j * self._to_angle * beyond
        y = np.exp(exponent)
        small = self._q**4 / y
        second = small * small * self._q**4 * (1 + y * (1 + y * (1 + y * (1 + y))))
        series = 1 - small * (1 + y * (1 + y)) + second
        return np.asarray(-np.expm1(exponent) * series * self._scale)


class CirclePoints:
    """Points of the unit circle, each as its nearer pole (0: +1, 1: -1) and its angle from there,
    counter-clockwise.

    """

    def __init__(self, pole: npt.NDArray[np.intp], angle: FloatArray) -> None:
        self.pole, self.angle = pole, angle
        self._constant = -np.expm1(-1j * self.angle)
        self._slope = np.exp(-1j * self.angle)
        self.inverse = self._slope * (1.0 - 2.0 * self.pole)  # 1 / e

    @classmethod
    def at(cls, defects: ComplexArray) -> CirclePoints:
        """The points of the circle that have these defects, (2, n)."""
        pole = np.argmin(np.abs(defects), axis=0)
        near = np.take_along_axis(defects, pole[None], axis=0)[0]
        return cls(pole, -np.sign(near.imag) * 2 * np.arcsin(np.minimum(np.abs(near) / 2, 1.0)))

    def rolled(self, places: int) -> CirclePoints:
        """The same points in another order, as by `numpy.roll`."""
        return CirclePoints(np.roll(self.pole, places), np.roll(self.angle, places))

    def factors(self, defects: ComplexArray) -> ComplexArray:
        """1 - zeta / e for every point e, shape (n, ...)."""
        columns = (-1,) + (1,) * (defects.ndim - 1)
        return np.asarray(self._constant.reshape(columns) + self._slope.reshape(columns) * defects[self.pole])

    def ahead_of(self, pole: int, angle: FloatArray) -> FloatArray:
        """Angle in (-pi, pi] from each point to the places at `angle` (k,) from a pole, shape (n, k)."""
        ahead = angle - self.angle[:, None] + np.pi * (self.pole[:, None] != pole)
        return np.asarray(np.where(ahead > np.pi, ahead - 2 * np.pi, ahead))


def _image_polynomial(q: float) -> FloatArray:
    """Coefficients, in powers of cos 2v, of theta1 theta3 / (2 q^(1/4) sin v).

    With the opposite sign of cos 2v it is theta2 theta4 / (2 q^(1/4) cos v).
    """
    first = np.array([1 - q**2 - q**6 + q**12, 2 * (q**6 - q**2) + 4 * q**12, 4 * (q**6 - q**12), -8 * q**12])
    third = np.array([1 - 2 * q**4, 2 * q - 6 * q**9, 4 * q**4, 8 * q**9])
    return np.convolve(first, third)
