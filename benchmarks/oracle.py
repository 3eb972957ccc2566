"""Least uncertainty that an estimator of contacts can honestly state in a simulated world.

Public names: `PadOracle`, `OracleCovariances`; `Patches`, shapes of contacts that a world draws.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from benchmarks.scores import laplace_covariance
from handtouch import config
from handtouch.field import ContactLaw, Electrode, ElectrodeNetwork, Surface
from handtouch.hand import pad_surface
from handtouch.simulate.contact_patch import ContactPatch, Profile
from handtouch.simulate.solved_contact import PatchNodes
from handtouch.simulate.virtual_hand import VirtualHand
from handtouch.simulate.worlds import DrawnWorld, HiddenPad

FloatArray = NDArray[np.float64]
_STEP = 1e-4
"""Of differences: of a side, or in the parameter's own unit."""
_DIRECTIONS = 8
_NEAREST = 1e-3
"""Of a patch's position to an edge, in sides."""


@dataclass(frozen=True)
class OracleCovariances:
    """Of n touches: covariance of position (n, 2, 2) [m^2] and of force (n, 1, 1) [N^2] by the oracle, and
    the least standard deviation of force from noise alone (n,) [N]."""

    position_m2: FloatArray
    force_n2: FloatArray
    force_bound_n: FloatArray


@dataclass(frozen=True)
class _Hidden:
    """Hidden parameters of one touch: differences from their true values; logarithms of ratios."""

    log_gain: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)
    gap_m: tuple[float, ...] = (0.0,) * 8
    log_length: float = 0.0
    log_width: float = 0.0
    log_anisotropy: float = 0.0
    log_sheet: float = 0.0
    radius_m: float = 0.0
    log_layer: float = 0.0
    alpha: float = 0.0
    lead_ohm: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)


@dataclass(frozen=True)
class Patches:
    """Shapes of contacts on a pad, all as likely, in any direction: their readings by the simulator.

    A contact's centre of pressure and force are given; what its shape does to the currents isn't known.
    """

    hand: VirtualHand
    row: int
    radius_m: float
    shapes: Sequence[tuple[Profile, float]]
    """Profile and elongation."""

    def covariances(self, place: FloatArray, force_n: FloatArray, gains: FloatArray) -> FloatArray:
        """Return the covariances (n, c, c) [A^2] of the currents by shape of contacts at fractions of the
        pad (2, n) with forces (n,)."""
        angles = np.pi * np.arange(_DIRECTIONS) / _DIRECTIONS * 2
        forms = [
            ContactPatch(self.radius_m, elongation, float(angle), profile).column(np.ones(1))[:, 0]
            for profile, elongation in self.shapes
            for angle in angles
        ]
        n, k = len(force_n), len(forms)
        patch = np.tile(np.array(forms).T, n)
        target, force = np.repeat(place, k, axis=1), np.repeat(force_n, k)
        shape, position = self.hand.virtual_pads[self.row].shape, target
        for _ in range(2):  # over an edge, the centre of what presses on the pad is another one
            centre = PatchNodes.of_patches(shape, position, patch).centres(shape, position)
            position = np.clip(position + target - centre, _NEAREST, 1 - _NEAREST)
        rows = np.full(n * k, self.row, np.intp)
        currents = gains * self.hand.solve_contacts(rows, position, patch, force)
        away = currents.reshape(n, k, -1)
        away = away - away.mean(axis=1, keepdims=True)
        return np.asarray(np.einsum("nki,nkj->nij", away, away) / k)


class PadOracle:
    """Readings of a pad as a function of contact and hidden parameters, about the true ones.

    `learnt`: information (p, p) of earlier contacts about the hidden parameters, None without any.
    `patches`: shapes of contacts, None: round and pressed on evenly.
    Nearer an edge than twice a contact's radius the currents are those of `ContactLaw`, whose spreading
    resistance has a lower limit there; the simulator's are up to a quarter larger.
    """

    def __init__(
        self,
        pad: config.Pad,
        sheet: config.Sheet,
        hidden: HiddenPad,
        drive_v: float,
        noise_a: FloatArray,
        prior_std: dict[str, float],
        learnt: FloatArray | None = None,
        patches: Patches | None = None,
    ) -> None:
        self.surface: Surface = pad_surface(pad)
        self.surface_name = type(pad.surface).__name__.lower()
        length_m, width_m = self._size_m()
        self.aspect = max(length_m, width_m) / min(length_m, width_m)
        self._pad, self._sheet, self._hidden = pad, sheet, hidden
        self._drive_v, self._noise_a, self._prior_std = drive_v, noise_a, prior_std
        self._learnt, self._patches = learnt, patches

    @classmethod
    def build(
        cls,
        drawn: DrawnWorld,
        deployment: config.Deployment,
        hand: str,
        pad: config.Pad,
        noise_a: FloatArray,
        patches: Patches | None = None,
    ) -> PadOracle:
        """Return the oracle of a pad in a drawn world, with that world's distributions for prior."""
        world, sheet = drawn.world, deployment.sheets[pad.sheet]
        parts, surface = world.parts, pad_surface(pad)
        length_mm = 1e3 * surface.extent_m[0]
        width_mm = length_mm * surface.b / surface.a
        prior_std = {
            "log_gain": parts.gain_ratio.std,
            "gap_m": 1e-3 * parts.gap_offset_mm.std,
            "log_length": parts.length_offset_mm.std / length_mm,
            "log_width": parts.width_offset_mm.std / width_mm,
            "log_anisotropy": parts.anisotropy_ratio.std,
            "log_sheet": parts.sheet_ohm_ratio.std,
            "radius_m": 1e-3 * world.contacts.radius_sigma.std * sheet.contact_radius_std_mm,
            "log_layer": world.sheets.contact_ohm_ratio.std,
            "alpha": world.sheets.alpha_offset.std,
            "lead_ohm": parts.lead_ohm.std,
        }
        drive_v, hidden = deployment.nodes[pad.node].drive_v, drawn.pad(hand, pad)
        return cls(pad, drawn.sheet(hand, pad, sheet), hidden, drive_v, noise_a, prior_std, patches=patches)

    def edge_distance(self, u_m: FloatArray, v_m: FloatArray) -> FloatArray:
        """Return the distance (n,) from the nearest edge as a fraction of that side's own direction."""
        x, y = self.surface.to_rectangle(u_m, v_m)
        s, t = x / self.surface.a, y / self.surface.b
        return np.asarray(np.min([s, 1 - s, t, 1 - t], axis=0))

    def with_contacts(self, contacts: FloatArray, noise_a: FloatArray) -> PadOracle:
        """Return the oracle after contacts at unknown places with unknown forces: the number that each leaves
        over, as four currents have three unknowns, is information about the pad.

        contacts: (3, k) true arc lengths [m] and forces [N]. noise_a: (4,) of the mean of its samples.
        """
        design, _ = self._design(*contacts)
        whitened = self._whitened(design, noise_a, *contacts)
        contact = whitened[:, :, :3] / np.linalg.norm(whitened[:, :, :3], axis=1, keepdims=True)
        left_over = np.linalg.qr(contact, mode="complete").Q[:, :, 3]
        scores = np.einsum("nc,ncp->np", left_over, whitened[:, :, 3:])
        learnt = scores.T @ scores + (0.0 if self._learnt is None else self._learnt)
        return PadOracle(
            self._pad, self._sheet, self._hidden, self._drive_v, self._noise_a, self._prior_std, learnt,
            self._patches,
        )  # fmt: skip

    def covariances(self, u_m: FloatArray, v_m: FloatArray, force_n: FloatArray) -> OracleCovariances:
        """Return covariances at true contacts: arc lengths (n,) [m] and forces (n,) [N]."""
        design, prior = self._design(u_m, v_m, force_n)
        learnt = np.zeros((len(prior), len(prior)))
        if self._learnt is not None:
            learnt[3:, 3:] = self._learnt
        whitened = self._whitened(design, self._noise_a, u_m, v_m, force_n)
        full = laplace_covariance(whitened, np.ones(design.shape[1]), prior, learnt)
        noise_only = laplace_covariance(design[:, :, :3], self._noise_a, prior[:3])
        metres = self._metres(u_m, v_m, len(prior))
        position = metres @ full @ np.swapaxes(metres, 1, 2)
        force = full[:, 2:3, 2:3] * (force_n**2)[:, None, None]
        return OracleCovariances(position, force, np.sqrt(noise_only[:, 2, 2]) * force_n)

    def _whitened(
        self,
        design: FloatArray,
        noise_a: FloatArray,
        u_m: FloatArray,
        v_m: FloatArray,
        force_n: FloatArray,
    ) -> FloatArray:
        """Return derivatives (n, 4, p) of what noise and shapes of contacts vary by 1, independently."""
        if self._patches is None:
            return np.asarray(design / noise_a[:, None])
        _, y = self.surface.to_rectangle(u_m, v_m)
        place = np.stack([u_m / self.surface.extent_m[0], y / self.surface.b])
        gains = np.array(self._hidden.gain_ratio)
        covariance = self._patches.covariances(place, force_n, gains) + np.diag(noise_a**2)
        return np.asarray(np.linalg.solve(np.linalg.cholesky(covariance), design))

    def _design(
        self, u_m: FloatArray, v_m: FloatArray, force_n: FloatArray
    ) -> tuple[FloatArray, list[float]]:
        """Return derivatives (n, 4, 3 + p) by x, y, ln of force and hidden parameters, and their priors."""
        x, y = self.surface.to_rectangle(u_m, v_m)
        side = _STEP * min(self.surface.a, self.surface.b)
        contact = np.stack([x, y, np.log(force_n)])
        columns = []
        for step in np.diag([side, side, _STEP]):
            more, less = contact + step[:, None], contact - step[:, None]
            change = self._readings(more, _Hidden()) - self._readings(less, _Hidden())
            columns.append(change / (2 * step.max()))
        prior = [np.inf] * 3
        for _, std, above, below, width in self._shifts():
            columns.append((self._readings(contact, above) - self._readings(contact, below)) / width)
            prior.append(std)
        return np.moveaxis(np.array(columns), 0, -1).swapaxes(0, 1), prior

    def _metres(self, u_m: FloatArray, v_m: FloatArray, parameters: int) -> FloatArray:
        """Return derivatives (n, 2, parameters) of the position [m] from the pad's middle; x and y are
        fractions of a pad of unknown size."""
        x, y = self.surface.to_rectangle(u_m, v_m)
        along, around = self.surface.scales(x, y)
        metres = np.zeros((len(u_m), 2, parameters))
        metres[:, 0, 0], metres[:, 1, 1] = along, around
        for number, (name, *_) in enumerate(self._shifts(), 3):
            if name == "log_length":
                metres[:, 0, number] = u_m - self.surface.extent_m[0] / 2
            elif name == "log_width":
                metres[:, 1, number] = (y - self.surface.b / 2) * around
        return metres

    def _size_m(self) -> tuple[float, float]:
        middle = self.surface.a / 2, self.surface.b / 2
        return self.surface.extent_m[0], float(self.surface.b * self.surface.scale(*middle))

    def _shifts(self) -> Iterator[tuple[str, float, _Hidden, _Hidden, float]]:
        """Yield name, prior deviation, two shifted values and their distance of every hidden parameter."""
        for name, std in self._prior_std.items():
            if std == 0:
                continue
            zero = getattr(_Hidden(), name)
            step = min(std, 1e-5 if name.endswith("_m") else 1e-3)
            for index in range(len(zero) if isinstance(zero, tuple) else 1):
                pair = []
                for sign in (step, -step):
                    moved = (
                        sign
                        if not isinstance(zero, tuple)
                        else tuple(sign * (k == index) for k in range(len(zero)))
                    )
                    pair.append(_Hidden(**{name: moved}))  # type: ignore[arg-type]
                yield name, std, pair[0], pair[1], 2 * step

    def _readings(self, contact: FloatArray, hidden: _Hidden) -> FloatArray:
        """Return the currents (4, n) that the channels report of contacts: x, y, ln of force (3, n)."""
        x, y, log_force = contact
        stretch = np.exp(hidden.log_length - hidden.log_width + hidden.log_anisotropy / 2)
        sheet_ohm = self._sheet.ohm_per_square * np.exp(hidden.log_sheet)
        network = self._network(stretch, sheet_ohm, hidden)
        at = stretch * x, y
        fractions = network.fractions(*at)
        law = ContactLaw(
            self._sheet.contact_ohm_mm2 * 1e-6 * np.exp(hidden.log_layer),
            self._sheet.alpha + hidden.alpha,
            self._sheet.contact_radius_mm * 1e-3 + hidden.radius_m,
            reference_pa=self._sheet.reference_kpa * 1e3,
        )
        spreading_m = network.spreading_radius(*at) * self.surface.scale(x, y)
        series_ohm = np.einsum("in,ij,jn->n", fractions, network.series_quadratic_form, fractions)
        total = law.current(np.exp(log_force), self._drive_v, sheet_ohm, spreading_m, series_ohm)
        gains = np.array(self._hidden.gain_ratio) * np.exp(hidden.log_gain)
        return np.asarray(gains[:, None] * total * fractions)

    def _network(self, stretch: float, sheet_ohm: float, hidden: _Hidden) -> ElectrodeNetwork:
        """Return the pad's network with its true gaps and these differences, before and after by side."""
        surface = self.surface
        shifts = np.reshape(hidden.gap_m, (2, 4))
        true_m = 1e-3 * np.array([self._hidden.gap_before_mm, self._hidden.gap_after_mm])
        before, after = np.maximum(true_m + shifts, 0.0)
        length_m = surface.extent_m[0]
        electrodes = []
        for number, side in enumerate(("x0", "xa")):
            u = 0.0 if side == "x0" else length_m
            _, ends = surface.to_rectangle([u, u], [before[number], after[number]])
            electrodes.append(Electrode(side, float(ends[0]), float(surface.b - ends[1])))  # type: ignore[arg-type]
        for number, side in enumerate(("y0", "yb"), 2):
            ends, _ = surface.to_rectangle([before[number], length_m - after[number]], [0.0, 0.0])
            electrodes.append(Electrode(side, float(stretch * ends[0]), float(stretch * ends[1])))  # type: ignore[arg-type]
        series_ohm = np.maximum(np.add(self._hidden.series_ohm, hidden.lead_ohm), 0.0)
        return ElectrodeNetwork.from_sides(
            stretch * surface.a, surface.b, electrodes, sheet_ohm, tuple(series_ohm.tolist())
        )
