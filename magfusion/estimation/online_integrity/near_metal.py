"""Metal near a single beacon: estimation of its share of the field, and weights accordingly.

Of several beacons a disturbed one contradicts the others and is rejected.  A single one can only be
compared with the motion: its channels are rejected one by one, the rest moves the state, and a fix
is equally wrong.  The share of the field that the motion does not explain is therefore estimated
over time, and weighted as an error shared by neighbouring epochs: the inertial data bridge a
passing disturbance, and the covariance grows.
"""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from magfusion.estimation.graph.state import MOTION, State, states_of
from magfusion.estimation.measurements.phasors import FieldPhasors
from magfusion.estimation.online_integrity.judgement import Judgement
from magfusion.estimation.online_integrity.recovery import EXPLAINED
from magfusion.estimation.online_integrity.running import DecayingSums, nothing
from magfusion.model.noise import model_error, paired_whitening
from magfusion.model.parameters import Block
from magfusion.model.site import Site
from magfusion.model.trust import Finding
from magfusion.units import Array, BoolArray

MEMORY = 0.15  # s; over which the share is averaged
RELEASE = 1.0  # s; time constant of its decay, as a passing object may return
COMMON = 2.0  # s; correlation time of the error of a hand-held object
QUIET = 1.0  # s; undisturbed time before an onset can be detected
BEYOND = 2.0  # times the model error, which a start estimates
DETECTION_SIGMAS = 5.0  # sigma


class NearMetal:
    """The share of a single beacon's field that is caused by nearby metal."""

    # Squared share; without metal its variance, and its change by a relative one of the noise's.
    _squared_share: DecayingSums
    _noise_freedom: float
    _kept: float  # squared share that is used
    _time: float
    _quiet: float  # s
    _metal_since: float | None

    def __init__(self, site: Site, blocks: tuple[Block, ...]) -> None:
        self.site, self.blocks = site, blocks
        self.single = len(site.beacons) == 1
        self._squared_share, self._kept = nothing(3), 0.0
        self._noise_freedom = np.inf
        self._time, self._quiet, self._metal_since = -np.inf, 0.0, None

    def begin(self, noise_freedom: Mapping[str, float]) -> None:
        """Start with the degrees of freedom of each beacon's estimated noise."""
        self._noise_freedom = min(noise_freedom.values(), default=np.inf)

    @property
    def comes(self) -> bool:
        """Whether the last epoch is the onset: earlier epochs are partly disturbed."""
        return self._metal_since == self._time

    @property
    def near(self) -> bool:
        """Whether metal is near."""
        return self._metal_since is not None

    def weighed(self, phasors: FieldPhasors, state: State, valid: BoolArray) -> FieldPhasors:
        """Return the phasors of an epoch, weighted for nearby metal.

        `state`: the prediction, with its own covariance. `valid` (channels,).
        """
        if not self.single or not np.any(valid):
            return phasors
        step = state.time - self._time if np.isfinite(self._time) else 0.0
        self._time = state.time
        power = np.sum(phasors.measured[0] ** 2, axis=1) / 3.0
        self._update_share(phasors, state, valid, power)
        self._update_verdict(min(step, COMMON))
        if not self.near:
            return phasors
        shared = max(1.0, 2.0 * COMMON / max(step, 1e-6))
        return _with_share(phasors, valid, self._kept * power, shared)

    def _update_share(
        self, phasors: FieldPhasors, state: State, valid: BoolArray, power: Array
    ) -> None:
        """Estimate the squared share of one epoch, by the score of its likelihood."""
        own = phasors.alone()
        rows = own.linearize(states_of([state]), state.calibration, self.blocks)
        size = rows.error.shape[2]
        error = rows.error[0, valid].reshape(-1)
        jacobian = rows.jacobian(len(state.cov) - MOTION)[0, valid].reshape(len(error), -1)
        spread = jacobian @ state.cov @ jacobian.T + np.eye(len(error))
        shape = own.sqrt_information[0, valid] @ _in_phase(phasors.measured[0, valid])
        alone = power[valid, None, None] * shape @ np.swapaxes(shape, 1, 2)
        blocks = np.zeros((len(alone), size, len(alone), size))
        channel = np.arange(len(alone))
        blocks[channel, :, channel] = alone
        along = blocks.reshape(len(error), -1)
        weight = np.linalg.solve(spread, np.column_stack([along, error]))
        shared, seen = weight[:, :-1], weight[:, -1]
        information = float(np.sum(shared * shared.T))
        of_noise = float(np.trace(shared)) / information
        share = float(seen @ along @ seen) / information - of_noise
        result = np.array([share, 2.0 / information, of_noise])
        self._squared_share = self._squared_share.with_sample(result, state.time, MEMORY)

    def _update_verdict(self, step: float) -> None:
        share, variance, of_noise = self._squared_share.mean
        variance = variance / max(self._squared_share.count, 1.0)
        sigma = np.sqrt(variance + of_noise**2 * 2.0 / self._noise_freedom)
        usual = BEYOND * float(np.max(model_error(self.site)))
        self._kept *= float(np.exp(-2.0 * step / RELEASE))
        if share > max(usual**2, DETECTION_SIGMAS * sigma) and self._squared_share.count > 3.0:
            if self._metal_since is None and self._quiet >= QUIET:
                self._metal_since = self._time
            self._kept = max(self._kept, min(share, EXPLAINED**2))
            self._quiet = 0.0
        elif self._kept < usual**2:
            self._quiet, self._metal_since = self._quiet + step, None

    def judgement(self) -> Judgement:
        """Return the judgement on nearby metal."""
        if self._metal_since is None:
            return Judgement()
        name, share = self.site.beacons[0].name, 100.0 * np.sqrt(self._kept)
        text = (
            f"The field of beacon {name} deviates by {share:.2g} % from the prediction by site and"
            f" motion since {self._metal_since:.1f} s: metal or iron is near it or the sensor."
            " Remove it, or wait until it is gone; the sigmas account for it."
        )
        return Judgement((Finding("metal_near", text, weight=share),))


def _in_phase(measured: Array) -> Array:
    """Return the directions (n, 6, 3) of phasors (n, 6), real part first, at their phase."""
    phasor = measured[:, :3] + 1j * measured[:, 3:]
    turn = np.exp(0.5j * np.angle(np.sum(phasor**2, axis=1)))
    both = np.stack([turn.real, turn.imag], axis=1)
    return (both[:, :, None, None] * np.eye(3)).reshape(len(measured), 6, 3)


def _with_share(
    phasors: FieldPhasors, valid: BoolArray, variance: Array, common: float
) -> FieldPhasors:
    """Return phasors with an additional error that a number of epochs share.

    `variance` (channels,) (T^2).
    """
    given = phasors.sqrt_information[0, :, :3, :3]
    some = np.any(given, axis=2) & valid[:, None]  # components that the receiver lacks are zero
    root = given * some[:, :, None] + np.eye(3) * ~some[:, None]
    inverse = np.linalg.inv(root)
    cov = inverse @ np.swapaxes(inverse, 1, 2) * (some[:, :, None] & some[:, None])
    more = variance[:, None, None] * np.eye(3) * some[:, None]
    before = np.ones(len(valid)) if phasors.excess is None else phasors.excess[0]
    own, wide = cov / before[:, None, None] + more, cov + common * more
    less, more_wide = (np.trace(part, axis1=1, axis2=2) for part in (own, wide))
    excess = np.divide(more_wide, less, out=np.ones_like(less), where=less > 0.0)
    whitening = paired_whitening(wide[None], some[None])
    return replace(phasors, sqrt_information=whitening, excess=excess[None])
