"""The conformal map of a rectangle onto the unit disc, exact near corners and crowded images of short sides.

With s the position from the centre of the rectangle, its shorter side along the real axis, v = pi s / (2
shorter), nome q = exp(-pi longer / shorter) <= exp(-pi), the map is, up to a turn,

    zeta = theta1(v) theta3(v) / (theta2(v) theta4(v))

(zeros at the centre and its images by an even number of reflections, poles at the others, |zeta| = 1 on the
boundary). Computed are the defects from the four corners, 1 - zeta / corner: each vanishes twice at its
corner and at the images of that, so it is C exp(-+iv) theta1(v - v_corner)^2 / (theta2(v) theta4(v)), a
product without cancellation. The derivative needs no theta function: d zeta / ds = C sqrt(product of the
defects).
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from handtouch.arrays import FloatArray

ComplexArray = npt.NDArray[np.complex128]


class DiscMap:
    """Rectangle [0, a] x [0, b] onto |zeta| <= 1, corner (0, 0) to zeta = 1, for sides within 50:1 of each
    other.

    A point of the disc is given by its defects 1 - zeta / corner from the corners (0, 0), (a, 0), (a, b), (0,
    b).
    """

    def __init__(self, a: float, b: float) -> None:
        shorter, longer = min(a, b), max(a, b)
        turn = 1.0 if a <= b else -1j  # rotates the shorter side onto the real axis
        self._centre = complex(a / 2, b / 2)
        self._rate = turn * math.pi / (2 * shorter)
        self._corner_points = np.array([0, a, complex(a, b), complex(0, b)])
        below_real = ((self._corner_points - self._centre) * turn).imag < 0
        self._raised = np.where(below_real, 1j, -1j)  # corner's factor exp(-+iv), as an exponent of v
        q = math.exp(-math.pi * longer / shorter)
        self._first, third = _theta_polynomials(q)
        images = np.convolve(self._first, third)
        self._images = images * (-1.0) ** np.arange(images.size)  # the same with the sign of cos 2v changed
        self._scale = np.ones(4, np.complex128)
        self._scale = 1 / self.defects(np.asarray(a / 2), np.asarray(b / 2))
        at_corners = self.defects(self._corner_points.real, self._corner_points.imag)  # [seen from, corner]
        self.corner_angles = angle_of(at_corners)
        self.corner_images = 1 - at_corners[0]
        v = self._rate * (self._corner_points[0] - self._centre)
        first_corner = (
            np.tan(v)
            * np.polyval(images[::-1], np.cos(2 * v))
            / np.polyval(self._images[::-1], np.cos(2 * v))
        )
        self._growth = self._rate * images.sum() / self._images.sum() / first_corner

    def defects(self, x: FloatArray, y: FloatArray) -> ComplexArray:
        """1 - zeta / corner, shape (4, ...)."""
        z = x + 1j * y
        column = (4,) + (1,) * z.ndim
        v = self._rate * (z - self._centre)
        below = _polynomial(self._images, np.cos(2 * v)) * np.cos(v)
        sine = np.sin(self._rate * (z - self._corner_points.reshape(column)))
        theta = sine * _polynomial(self._first, 1 - 2 * sine * sine)
        raised = np.exp(self._raised.reshape(column) * v)
        return np.asarray(self._scale.reshape(column) * raised * theta * theta / below)

    def derivative(self, defects: ComplexArray) -> ComplexArray:
        """Return d zeta / d(x + iy) where the defects are given."""
        roots = np.sqrt(defects)
        return np.asarray(self._growth * (roots[0] * roots[1]) * (roots[2] * roots[3]))

    def radius(self, defects: ComplexArray) -> FloatArray:
        """Conformal radius, (1 - |zeta|^2) / |d zeta / dz|."""
        nearest = np.argmin(np.abs(defects), axis=0)
        near = np.take_along_axis(defects, nearest[None], axis=0)[0]
        inside = np.maximum(2 * near.real - np.abs(near) ** 2, 0.0)
        return np.asarray(inside / np.abs(self.derivative(defects)))


class CirclePoints:
    """Points e of the unit circle, each as its nearest corner of a `DiscMap` and the angle from there.

    `defects`: theirs, shape (4, n). `inverse`: 1 / e, shape (n,).
    """

    def __init__(self, disc: DiscMap, defects: ComplexArray) -> None:
        self.corner = np.argmin(np.abs(defects), axis=0)
        self.angle = angle_of(np.take_along_axis(defects, self.corner[None], axis=0)[0])
        self._turns = disc.corner_angles
        self._constant = -np.expm1(-1j * self.angle)
        self._slope = np.exp(-1j * self.angle)
        self.inverse = self._slope * np.conj(disc.corner_images[self.corner])

    def factors(self, defects: ComplexArray) -> ComplexArray:
        """Return 1 - zeta / e for points (4, ...), shape (n, ...)."""
        column = (-1,) + (1,) * (defects.ndim - 1)
        return np.asarray(self._constant.reshape(column) + self._slope.reshape(column) * defects[self.corner])

    def angle_to(self, corner: npt.NDArray[np.intp] | int, angle: FloatArray) -> FloatArray:
        """Return the angle in (-pi, pi] from each point (n, 1) to points given by corner and angle from
        there.
        """
        ahead = angle - self.angle[:, None] + self._turns[self.corner[:, None], np.asarray(corner)]
        ahead = np.where(ahead > np.pi, ahead - 2 * np.pi, ahead)
        return np.asarray(np.where(ahead <= -np.pi, ahead + 2 * np.pi, ahead))


def angle_of(defect: ComplexArray) -> FloatArray:
    """Return the angle t of a point of the circle whose defect is 1 - exp(it), small ones to their last
    digit.
    """
    size = np.abs(defect)
    small = -np.sign(defect.imag) * 2 * np.arcsin(np.minimum(size, 1.0) / 2)
    return np.asarray(np.where(size < 1, small, np.angle(1 - defect)))


def _theta_polynomials(q: float) -> tuple[FloatArray, FloatArray]:
    """Coefficients, in powers of cos 2v, of theta1(v) / (2 q^(1/4) sin v) and of theta3(v)."""
    first = np.array([1 - q**2 - q**6 + q**12, 2 * (q**6 - q**2) + 4 * q**12, 4 * (q**6 - q**12), -8 * q**12])
    third = np.array([1 - 2 * q**4, 2 * q - 6 * q**9, 4 * q**4, 8 * q**9])
    return first, third


def _polynomial(coefficients: FloatArray, argument: ComplexArray) -> ComplexArray:
    value = np.full_like(argument, coefficients[-1])
    for coefficient in coefficients[-2::-1]:
        value = value * argument + coefficient
    return value
