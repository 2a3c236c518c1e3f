"""Frequency response of a magnetometer relative to its response to steady fields.

Fluxgates, search coils and anti-aliasing filters attenuate a tone and shift its phase.  Between
the given frequencies both are linear in the frequency's logarithm.
"""

from dataclasses import dataclass

import numpy as np

from magfusion.units import Array, ComplexArray


@dataclass(frozen=True, eq=False)
class FrequencyResponse:
    """Response of all three axes, or of one.

    Parameters
    ----------
    frequency_hz : ndarray, shape (n,)
        Increasing, above zero (Hz).
    gain : ndarray, shape (n,)
        Measured amplitude relative to the field's.
    phase : ndarray, shape (n,)
        Measured phase relative to the field's (rad); negative for a lag.
    """

    frequency_hz: Array
    gain: Array
    phase: Array

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
    """Responses of axes that differ.

    Parameters
    ----------
    x, y, z : FrequencyResponse
    """

    x: FrequencyResponse
    y: FrequencyResponse
    z: FrequencyResponse

    @property
    def axes(self) -> tuple[FrequencyResponse, FrequencyResponse, FrequencyResponse]:
        """Responses of the three axes."""
        return self.x, self.y, self.z

    def factor(self, frequency_hz: Array) -> ComplexArray:
        """Return the complex gain of each axis, shape (n, 3), at frequencies (n,)."""
        parts = [axis.at(frequency_hz) for axis in self.axes]
        return np.stack([np.exp(size + 1j * phase) for size, phase in parts], axis=-1)
