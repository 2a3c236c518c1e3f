"""How a magnetometer answers to fields of some frequencies, beside how it answers to steady ones.

Fluxgates, search coils and the filters before a converter lose amplitude and turn the phase of a
tone.  In between the frequencies that are given, both are linear in the frequency's logarithm.
"""

from dataclasses import dataclass

import numpy as np

from magfusion.units import Array, ComplexArray


@dataclass(frozen=True, eq=False)
class FrequencyResponse:
    """Of all three axes, or of one.

    Parameters
    ----------
    frequency_hz : ndarray, shape (n,)
        Increasing, above zero (Hz).
    gain : ndarray, shape (n,)
        Amplitude that is measured, as a share of the field's.
    phase : ndarray, shape (n,)
        Of what is measured, ahead of the field's (rad); below zero where it lags.
    """

    frequency_hz: Array
    gain: Array
    phase: Array

    @property
    def axes(self) -> tuple["FrequencyResponse", ...]:
        """What each axis has: all the same."""
        return self, self, self

    def at(self, frequency_hz: Array) -> tuple[Array, Array]:
        """Return logarithm of the gain, and phase (rad), at some frequencies (Hz).

        A steady field is measured as it is.
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
    """Of axes that answer each in its own way.

    Parameters
    ----------
    x, y, z : FrequencyResponse
    """

    x: FrequencyResponse
    y: FrequencyResponse
    z: FrequencyResponse

    @property
    def axes(self) -> tuple[FrequencyResponse, FrequencyResponse, FrequencyResponse]:
        """All three."""
        return self.x, self.y, self.z

    def factor(self, frequency_hz: Array) -> ComplexArray:
        """Return what is measured as a share of the field, shape (n, 3), at frequencies (n,)."""
        parts = [axis.at(frequency_hz) for axis in self.axes]
        return np.stack([np.exp(size + 1j * phase) for size, phase in parts], axis=-1)
