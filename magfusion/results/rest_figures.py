"""Figures of integrated rests."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

import numpy as np

from magfusion.results.figures import Figure, Figures

if TYPE_CHECKING:
    from magfusion.estimation.rests.stationary_integration import IntegratedRests


def rest_figures(rested: IntegratedRests) -> Figures:
    """Return the number of rests, and the strength of each tone in them.

    Amplitudes are the peak of the field's magnitude, corrected for noise, of the median rest.
    """
    amplitude, detected = rested.amplitude(), rested.detected
    channels = rested.fields.channels
    return Figures(
        Figure("rests", len(rested.fields)),
        Figure("rest_s", float(np.sum(rested.fields.window)), "s", label="time at rest"),
        *(
            Figure(
                f"amplitude_{{beacon}}_{tone}_t",
                float(np.median(np.nan_to_num(amplitude[:, c]))),
                "T",
                beacon,
                label=f"amplitude of tone {tone}",
            )
            for c, (beacon, tone) in enumerate(channels)
        ),
        *(
            Figure(
                f"heard_{{beacon}}_{tone}",
                int(np.sum(detected[:, c])),
                "",
                beacon,
                label=f"rests with tone {tone}",
            )
            for c, (beacon, tone) in enumerate(channels)
        ),
        *_reference_figures(rested),
    )


def _reference_figures(rested: IntegratedRests) -> Iterator[Figure]:
    """Yield the factor by which the reference reduces each sigma; one where it is not used."""
    if rested.gain is None:
        return
    gain = np.median(np.where(np.isnan(rested.gain), 1.0, rested.gain), axis=0)
    for c, (beacon, tone) in enumerate(rested.fields.channels):
        label = f"reference's gain at tone {tone}"
        yield Figure(f"reference_gain_{{beacon}}_{tone}", float(gain[c]), "", beacon, label=label)
