"""How a magnetometer answers to fields of some frequencies, beside how it answers to steady ones.

Fluxgates, search coils and the filters before a converter lose amplitude and turn the phase of a
tone.  In between the frequencies that are given, both are linear in the frequency's logarithm.
"""

from dataclasses import dataclass

import numpy as np

from magfusion.units import Array


@dataclass(frozen=True, eq=False)
class FrequencyResponse:
    """Of all three axes.

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
