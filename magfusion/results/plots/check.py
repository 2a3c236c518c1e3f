"""A quick check of a log as a picture: spectrum, signal to noise, gravity and static field."""

from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from magfusion.estimation.integrity.quick_check import Look


def write_check_plot(path: Path, look: Look) -> None:
    """Write a PNG of the spectrum, each beacon's signal to noise, gravity and static field."""
    figure = Figure(figsize=(10.0, 8.0), layout="constrained")
    top, middle, bottom = figure.subplots(3, 1)
    if look.spectrum is not None:
        one = look.spectrum
        top.semilogy(one.frequency_hz, 1e9 * np.sqrt(np.maximum(one.power, 1e-30)), lw=0.7)
        peaks = [(line.frequency_hz, 1e9 * line.amplitude) for line in look.lines or ()]
        for frequency, amplitude in peaks:
            at, shift = (frequency, amplitude), (0.0, 3.0)
            kind: dict[str, Any] = {"rotation": 90, "fontsize": 7, "ha": "center", "va": "bottom"}
            top.annotate(f"{frequency:.2f}", at, shift, textcoords="offset points", **kind)
        if peaks:  # room for the labels
            top.set_ylim(top=20.0 * max(amplitude for _, amplitude in peaks))
    top.set_title("spectrum of the field, the lines with their frequencies (Hz)", fontsize=10)
    top.set(xlabel="frequency (Hz)", ylabel="amplitude (nT)")
    if look.detected is not None:
        for k, name in enumerate(look.detected.beacons):
            snr = np.maximum(look.detected.snr[:, k], 1e-2)
            middle.semilogy(look.detected.time, snr, ".-", ms=2, lw=0.6, label=f"beacon {name}")
        middle.legend(loc="upper right", fontsize="small", ncols=4)
        low, high = middle.get_ylim()
        middle.set_ylim(low, high * (high / low) ** 0.2)  # room for the legend
    middle.set_title("signal to noise of each beacon", fontsize=10)
    middle.set(xlabel="time (s)", ylabel="signal to noise")
    means = look.means
    if len(means):
        force = np.linalg.norm(means.force_body, axis=1)
        bottom.plot(means.time, force, ".-", c="tab:red")
        field = bottom.twinx()
        size = 1e6 * np.linalg.norm(means.field_body, axis=1)
        field.plot(means.time, size, ".-", c="tab:blue")
        field.set_ylabel("static field (µT)", color="tab:blue")
    bottom.set_title("means of some seconds: about constant without iron on the body", fontsize=10)
    bottom.set(xlabel="time (s)")
    bottom.set_ylabel("specific force (m/s²)", color="tab:red")
    for one_gap in look.timings:
        for begin, end in zip(one_gap.gap_begin, one_gap.gap_end, strict=True):
            middle.axvspan(begin, end, color="0.9")
            bottom.axvspan(begin, end, color="0.9")
    verdict = str(look.trust.verdict)
    reason = f" ({look.trust.reasons[0].code})" if look.trust.reasons else ""
    figure.suptitle(f"Check of a log: {verdict}{reason}")
    figure.savefig(path, dpi=100, metadata={"Software": None})
