"""What the tick has to know of every pad, as columns over all hands; computed once from the deployment."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from handtouch import config
from handtouch.canbus.objects.channels import ELECTRODES, Channels, channels_of, in_order
from handtouch.config import Deployment
from handtouch.field import LocatorBank
from handtouch.field.network import ElectrodeNetwork
from handtouch.field.strength import ContactLaw, Strength
from handtouch.hand import Placement, mount_of, network_of, surface_of
from handtouch.supervise.calibration import Calibration, Law
from handtouch.supervise.strength import SheetBehaviour, behaviour_of

FloatArray = NDArray[np.float64]
_LEAST_ALPHA = 0.1


class PadModel:
    """Columns of the n pads of a deployment, in its order; the same order as the slab's.

    `hands`, `links`, `frames` (links of the URDF) and `calibration` (n,) are names; `rows_of_hand`;
    `ampere_per_count` (n, 4) of the electrodes x0, xa, y0, yb, their noise as `noise_counts` (n,) and
    `noise_a` (n, 4); `gains` (n, 4) are in `ampere_per_count` (what channels read untouched is followed by
    the tick: `Tick.baseline`),
    `gain_covariance` (n, 4, 4) is that of their logarithms, `quarantined` (n,): no force is told;
    `vague` (n,): no place is to be relied on; `findings` (n,): names of what says either;
    `laws` (n,) are those that a calibration has put in the place of the file's, else None;
    thresholds `on_n`, `off_n` [N] and the total currents `on_a`, `off_a` [A] that stand for them in the
    middle of the pad; `begin_samples`, `end_samples`; `slow_touch_s`: what takes longer to reach `off_n` is
    drift; `behaviours` (n,): how sheets creep, adapt and remember, None where that isn't modelled. `locator`
    finds contacts, `placement` puts them on their links, `force` weighs them.
    """

    def __init__(self, deployment: Deployment) -> None:
        entries = [(hand.name, pad) for hand in deployment.hands for pad in hand.pads]
        pads = [pad for _, pad in entries]
        nodes = [deployment.nodes[pad.node] for pad in pads]
        sheets = [deployment.sheets[pad.sheet] for pad in pads]
        touches = [pad.touch or deployment.touch for pad in pads]
        self.size = len(pads)
        self.hands = [hand for hand, _ in entries]
        self.links = [pad.link for pad in pads]
        self.frames = [pad.mount.link or pad.link for pad in pads]
        self.rows_of_hand = _rows(self.hands)
        self.nominal = [nominal_of(pad, deployment) for pad in pads]
        self.calibration = list(self.nominal)
        kinds = {name: channels_of(node.channels, node.eds) for name, node in deployment.nodes.items()}
        self.ampere_per_count = np.array(
            [_ampere_per_count(pad, deployment, kinds[pad.node]) for pad in pads]
        )
        counts = [math.hypot(node.noise_counts, 1 / math.sqrt(12)) for node in nodes]  # and quantisation
        self.noise_counts = np.array(counts)
        self.noise_a = self.noise_counts[:, None] * self.ampere_per_count
        self.largest_counts = np.array([min(c.limits[1] for c in kinds[pad.node]) for pad in pads])
        self._nominal_a = self.ampere_per_count.copy()
        self.gains = np.ones((self.size, 4))
        self.gain_covariance = np.zeros((self.size, 4, 4))
        self.quarantined = np.zeros(self.size, dtype=np.bool_)
        self.vague = np.zeros(self.size, dtype=np.bool_)
        self.findings: list[tuple[str, ...]] = [()] * self.size
        self.doubted = False
        self.on_n = np.array([touch.on_n for touch in touches])
        self.off_n = np.array([touch.off_n for touch in touches])
        self.begin_samples = np.array([touch.begin_samples for touch in touches])
        self.end_samples = np.array([touch.end_samples for touch in touches])
        self.slow_touch_s = np.array([touch.slow_touch_s for touch in touches])
        kinds_of_sheet = {name: _behaviour(sheet) for name, sheet in deployment.sheets.items()}
        self.behaviours = [kinds_of_sheet[pad.sheet] for pad in pads]
        networks = networks_of(deployment)
        full_scale_a = np.array([node.full_scale_ma * 1e-3 for node in nodes])
        finest = float((self.noise_a.min(axis=1) / full_scale_a).min())  # noise of the strongest contact
        self.locator = LocatorBank(networks, tolerance=finest / 10)
        self.placement = Placement([(surface_of(pad), *mount_of(pad)) for pad in pads])
        self._drive_v = np.array([node.drive_v for node in nodes])
        self.laws: list[Law | None] = [None] * self.size
        self._file_laws = [law_of(sheet) for sheet in sheets]
        self._sheet_ohm = np.array([sheet.ohm_per_square for sheet in sheets])
        self._series_form = np.stack([network.series_form for network in networks])
        self._has_series = np.array([any(pad.series_ohm) for pad in pads])
        self._law = ContactLaw(
            np.array([sheet.contact_ohm_mm2 * 1e-6 for sheet in sheets]),
            np.array([sheet.alpha for sheet in sheets]),
            np.array([sheet.contact_radius_mm * 1e-3 for sheet in sheets]),
            np.array([sheet.contact_radius_std_mm * 1e-3 for sheet in sheets]),
            np.array([sheet.reference_kpa * 1e3 for sheet in sheets]),
        )
        self._law_axes = np.zeros((3, 3, self.size))
        """parameters of `Law.covariance` by its axes by pads: a standard deviation along each axis"""
        self._axis_laws: tuple[ContactLaw, FloatArray] | None = None
        self._middle = self._middles(networks)
        self.on_a, self.off_a = (self._threshold(force) for force in (self.on_n, self.off_n))

    def apply(self, pad: int, calibration: Calibration, name: str) -> None:
        """Take over the gains and the law of the unit of a pad; offsets are for `Tick.baseline`.

        What isn't known is as the deployment file says.
        """
        gains = calibration.gains.factors if calibration.gains else (1.0,) * 4
        self.calibrate(pad, gains, name, calibration.law)

    def calibrate(self, pad: int, gains: ArrayLike, name: str, law: Law | None = None) -> None:
        """Multiply the currents of the channels x0, xa, y0, yb of a pad by gains; tell it by `name`.

        `law` weighs its contacts, None: the file's. Where series resistors shape the currents, locations go
        on with the file's sheet resistance.
        """
        if law != self.laws[pad]:
            self._weigh_by(pad, law)
        self.gains[pad] = gains
        self.ampere_per_count[pad] = self._nominal_a[pad] * self.gains[pad]
        self.noise_a[pad] = self.noise_counts[pad] * self.ampere_per_count[pad]
        self.calibration[pad] = name

    @property
    def on_counts(self) -> FloatArray:
        """(n,) sum of the channels that begins a contact."""
        return np.asarray(self.on_a / self.ampere_per_count.mean(axis=1))

    @property
    def off_counts(self) -> FloatArray:
        """(n,) sum of the channels that ends it."""
        return np.asarray(self.off_a / self.ampere_per_count.mean(axis=1))

    def law(self, pad: int) -> Law:
        """What weighs the contacts of a pad: the law of its calibration, or the file's."""
        return self.laws[pad] or self._file_laws[pad]

    def doubt(
        self,
        pad: int,
        log_gain_covariance: ArrayLike,
        quarantined: bool,
        vague: bool = False,
        findings: tuple[str, ...] = (),
    ) -> None:
        """Gains of a pad are that uncertain, (4, 4) of their logarithms; `quarantined`: tell no force;
        `vague`: tell places as not to be relied on; because of `findings`."""
        self.gain_covariance[pad] = log_gain_covariance
        self.quarantined[pad], self.vague[pad] = quarantined, vague
        self.findings[pad] = findings
        self.doubted = bool(self.gain_covariance.any() or self.quarantined.any())

    def take_over(self, other: PadModel) -> None:
        """Correct all pads as the model did that this one replaces."""
        for pad in range(self.size):
            corrected = bool((other.gains[pad] != 1).any()) or other.calibration[pad] != other.nominal[pad]
            name = other.calibration[pad] if corrected else self.calibration[pad]
            self.calibrate(pad, other.gains[pad], name, other.laws[pad])
            self.doubt(
                pad,
                other.gain_covariance[pad],
                bool(other.quarantined[pad]),
                bool(other.vague[pad]),
                other.findings[pad],
            )

    def force(
        self,
        index: NDArray[np.intp],
        currents: FloatArray,
        total_a: FloatArray,
        total_std_a: FloatArray,
        radius_m: FloatArray,
    ) -> Strength:
        """Weigh contacts on the pads `index` (n,) by their totals, with standard deviation, and place.

        The place is told by currents (4, n), in any unit, and the spreading radius there.
        """
        return self._law.take(index).force(
            total_a,
            self._drive_v[index],
            self._sheet_ohm[index],
            radius_m,
            self._resistors(index, currents),
            current_std_a=total_std_a,
        )

    def law_std(
        self,
        index: NDArray[np.intp],
        currents: FloatArray,
        total_a: FloatArray,
        radius_m: FloatArray,
        force_n: FloatArray,
    ) -> FloatArray:
        """Standard deviation [N] of forces (n,) because laws of calibrations are known only so well;
        arguments as of `force`. Delta method along the axes of the covariance; 0 for the file's law, which
        has none."""
        if self._axis_laws is None:
            return np.zeros(len(index))
        law, sheet_ohm = self._axis_laws
        rows = (index + self.size * np.arange(3)[:, None]).ravel()
        along = law.take(rows).force(
            np.tile(total_a, 3),
            np.tile(self._drive_v[index], 3),
            sheet_ohm[rows],
            np.tile(radius_m, 3),
            np.tile(self._resistors(index, currents), 3) if self._has_series.any() else 0.0,
        )
        return np.asarray(np.sqrt(np.square(along.force_n.reshape(3, -1) - force_n).sum(axis=0)))

    def _resistors(self, index: NDArray[np.intp], currents: FloatArray) -> FloatArray | float:
        """What series resistors add to the way from contact to ground [ohm] (n,): sum of phi_i V_i / I."""
        if not self._has_series[index].any():
            return 0.0
        with np.errstate(divide="ignore", invalid="ignore"):
            fractions = currents / currents.sum(axis=0)
        return np.asarray(np.einsum("in,nij,jn->n", fractions, self._series_form[index], fractions))

    def _weigh_by(self, pad: int, law: Law | None) -> None:
        """Put a law in force, and the thresholds [A] with it."""
        self.laws[pad] = law
        taken, old = law or self._file_laws[pad], self._law
        contact, alpha = np.array(old.contact_ohm_m2), np.array(old.alpha)
        contact[pad], alpha[pad] = taken.contact_ohm_mm2 * 1e-6, taken.alpha
        self._sheet_ohm[pad] = taken.ohm_per_square
        self._law = replace(old, contact_ohm_m2=contact, alpha=alpha)
        spread, ways = np.linalg.eigh(np.array(taken.covariance))
        self._law_axes[:, :, pad] = ways * np.sqrt(np.maximum(spread, 0.0))
        self._axis_laws = self._laws_along() if self._law_axes.any() else None
        self.on_a[pad] = self._threshold(self.on_n)[pad]
        self.off_a[pad] = self._threshold(self.off_n)[pad]

    def _laws_along(self) -> tuple[ContactLaw, FloatArray]:
        """Laws a standard deviation along each axis of all pads, and their sheet resistances: (3 n,), axis by
        axis."""
        law, (log_layer, alpha, log_sheet) = self._law, self._law_axes
        along = ContactLaw(
            (np.asarray(law.contact_ohm_m2) * np.exp(log_layer)).ravel(),
            np.maximum(np.asarray(law.alpha) + alpha, _LEAST_ALPHA).ravel(),
            np.tile(np.asarray(law.radius_m), 3),
            np.tile(np.asarray(law.radius_std_m), 3),
            np.tile(np.asarray(law.reference_pa), 3),
        )
        return along, (self._sheet_ohm * np.exp(log_sheet)).ravel()

    def _middles(self, networks: Sequence[ElectrodeNetwork]) -> tuple[FloatArray, FloatArray | float]:
        """Spreading radius [m] in the middle of each pad, and what resistors add there [ohm]."""
        x, y = np.array([(net.a / 2, net.b / 2) for net in networks]).T
        pads = np.arange(self.size)
        scale = self.placement.place(pads, x, y, np.zeros((self.size, 2, 2))).scale
        radius_m = self.locator.conformal_radius(pads, x, y) * scale
        return radius_m, self._resistors(pads, self.locator.fractions(pads, x, y))

    def _threshold(self, force_n: FloatArray) -> FloatArray:
        """Total current of a contact of that force in the middle of each pad."""
        return self._law.current(force_n, self._drive_v, self._sheet_ohm, *self._middle)


def _behaviour(sheet: config.Sheet) -> SheetBehaviour | None:
    return behaviour_of(sheet.behaviour) if sheet.behaviour else None


def _ampere_per_count(pad: config.Pad, deployment: Deployment, channels: Channels) -> list[float]:
    """Of the electrodes x0, xa, y0, yb."""
    node = deployment.nodes[pad.node]
    scale = [node.channel_scale[pad.electrodes.index(name)] for name in ELECTRODES]
    return [
        node.full_scale_ma * 1e-3 / (node.full_scale_counts or channel.limits[1]) * factor
        for channel, factor in zip(in_order(channels, pad.electrodes), scale, strict=True)
    ]


def _rows(hands: list[str]) -> dict[str, slice]:
    """Rows of each hand; the pads of a hand follow one another."""
    first = {hand: hands.index(hand) for hand in hands}
    return {hand: slice(start, start + hands.count(hand)) for hand, start in first.items()}


def networks_of(deployment: Deployment) -> list[ElectrodeNetwork]:
    """Electrodes of every pad; pads of one make share one object, and with it one table."""
    made: dict[tuple[object, ...], ElectrodeNetwork] = {}
    networks = []
    for pad in (pad for hand in deployment.hands for pad in hand.pads):
        sheet = deployment.sheets[pad.sheet]
        make = (pad.surface, pad.gap_mm, pad.series_ohm, sheet.ohm_per_square)
        if make not in made:
            made[make] = network_of(pad, sheet)
        networks.append(made[make])
    return networks


def law_of(sheet: config.Sheet) -> Law:
    """What the deployment file says of a sheet; it tells no covariance."""
    return Law(sheet.contact_ohm_mm2, sheet.alpha, sheet.ohm_per_square, ((0.0,) * 3,) * 3)


def nominal_of(pad: config.Pad, deployment: Deployment) -> str:
    """Name of the calibration that the deployment file itself is; it changes with the pad's tables.

    Not with `serial`: calibrations are bound to that besides, and a unit that took another's place keeps its
    own when the file is told of it.
    """
    parts = (
        pad.model_copy(update={"serial": None}),
        deployment.nodes[pad.node],
        deployment.sheets[pad.sheet],
    )
    text = "".join(part.model_dump_json() for part in parts)
    return "nominal-" + hashlib.sha256(text.encode()).hexdigest()[:12]
