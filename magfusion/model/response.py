"""Frequency response of a magnetometer relative to its response to static fields.

Fluxgates, search coils and anti-aliasing filters attenuate a tone and shift its phase.  Between
the given frequencies both are linear in the frequency's logarithm.  A recording of volts is read as
if one volt were `NOMINAL_T_PER_V`; the response of its receiver is relative to that.
"""

from dataclasses import dataclass

import numpy as np

from magfusion.units import Array, ComplexArray

NOMINAL_T_PER_V = 1e-6  # of a coil of about 0.5 m^2 with an amplifier of 200 at 1.5 kHz
TABULATED_HZ = (1.0, 1e5)  # of a pick-up coil
# Linear interpolation errs by h^2/8 of the second derivative of log-gain over log-frequency, which
# is 4 Q^2 at resonance: with h = ln(10)/2000 and Q = 10 by 7e-5.
POINTS_PER_DECADE = 2000


@dataclass(frozen=True)
class PickupCoil:
    """Receive coil with an amplifier: ``V = j w N A g B / (1 - (f/f0)^2 + j f / (f0 Q))``."""

    turns: float  # N
    area: float  # a, mean of the turns (m^2)
    resonance_hz: float  # f0, of its inductance and all capacitance across it
    quality: float  # Q
    amplifier_gain: float  # g

    def volts_per_tesla(self, frequency_hz: Array) -> ComplexArray:
        """Return the sensitivity to alternating fields (V/T), shape (n,)."""
        ratio = frequency_hz / self.resonance_hz
        flux = 2j * np.pi * frequency_hz * self.turns * self.area * self.amplifier_gain
        return np.asarray(flux / (1.0 - ratio**2 + 1j * ratio / self.quality))


@dataclass(frozen=True, eq=False)
class FrequencyResponse:
    """Response of all three axes, or of one."""

    frequency_hz: Array  # (n,), increasing, above zero (Hz)
    gain: Array  # (n,), measured amplitude relative to the field's
    phase: Array  # (n,), measured phase relative to the field's (rad); negative for a lag
    coil: PickupCoil | None = None  # whose response it is

    @staticmethod
    def of_coil(coil: PickupCoil) -> "FrequencyResponse":
        """Tabulate the response of a coil to volts as they are read (`NOMINAL_T_PER_V`)."""
        lowest, highest = TABULATED_HZ
        count = int(np.log10(highest / lowest) * POINTS_PER_DECADE) + 1
        frequency_hz = np.geomspace(lowest, highest, count)
        gain = NOMINAL_T_PER_V * coil.volts_per_tesla(frequency_hz)
        return FrequencyResponse(frequency_hz, np.abs(gain), np.unwrap(np.angle(gain)), coil)

    @property
    def axes(self) -> tuple["FrequencyResponse", ...]:
        """Response of each axis: all the same."""
        return self, self, self

    def at(self, frequency_hz: Array) -> tuple[Array, Array]:
        """Return logarithm of the gain, and phase (rad), at some frequencies (Hz).

        The gain at zero frequency is one.
        """
        steady = frequency_hz == 0.0
        where = np.log(np.where(steady, 1.0, frequency_hz))
        known = np.log(self.frequency_hz)
        size = np.interp(where, known, np.log(self.gain))
        return np.where(steady, 0.0, size), np.where(
            steady, 0.0, np.interp(where, known, self.phase)
        )


@dataclass(frozen=True, eq=False)
class AxisResponses:
    """Responses of axes that differ."""

    x: FrequencyResponse
    y: FrequencyResponse
    z: FrequencyResponse

    @property
    def axes(self) -> tuple[FrequencyResponse, FrequencyResponse, FrequencyResponse]:
        """Responses of the three axes."""
        return self.x, self.y, self.z

    def factor(self, frequency_hz: Array) -> ComplexArray:
        """Return the complex gain of each axis, shape (n, 3), at frequencies (n,)."""
        return np.exp(log_response(self, frequency_hz))


@dataclass(frozen=True, eq=False)
class ResponseSigma:
    """Prior standard deviations of the responses of y and z relative to x; zero means known.

    What all axes share cannot be distinguished from a beacon's moment and drive phase.
    """

    frequency_hz: Array  # (k,), increasing; of all tones at least (Hz)
    gain: Array  # (k, 2), of the logarithm
    phase: Array  # (k, 2) (rad)


def log_response(
    response: FrequencyResponse | AxisResponses | None, frequency_hz: Array
) -> ComplexArray:
    """Return log-gain + 1j phase of each axis, shape (n, 3), at frequencies (n,) (Hz)."""
    if response is None:
        return np.zeros((len(frequency_hz), 3), dtype=np.complex128)
    parts = [axis.at(frequency_hz) for axis in response.axes]
    return np.stack([size + 1j * phase for size, phase in parts], axis=-1)


def changed_axes(
    response: FrequencyResponse | AxisResponses | None, frequency_hz: Array, change: ComplexArray
) -> AxisResponses:
    """Return a response at the given frequencies with y and z changed.

    `frequency_hz` (k,): increasing (Hz). `change` (k, 2): of log-gain + 1j phase.
    """
    log = log_response(response, frequency_hz)
    log[:, 1:] += change
    return AxisResponses(*(FrequencyResponse(frequency_hz, np.exp(a.real), a.imag) for a in log.T))
