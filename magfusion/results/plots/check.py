"""A quick check of a log as a picture: spectrum, signal to noise, gravity and static field."""

from pathlib import Path

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from magfusion.estimation.integrity.quick_check import Look


def write_check_plot(path: Path, look: Look) -> None:
    """Write a PNG of the spectrum, each beacon's signal to noise, gravity and static field."""
    figure = Figure(figsize=(11.0, 9.0), layout="constrained")
    FigureCanvasAgg(figure)
    top, middle, bottom = figure.subplots(3, 1)
    if look.spectrum is not None:
        one = look.spectrum
        top.semilogy(one.frequency_hz, 1e9 * np.sqrt(np.maximum(one.power, 1e-30)), lw=0.7)
        for line in look.lines or ():
            size = f"{line.frequency_hz:.2f}"
            top.annotate(size, (line.frequency_hz, 1e9 * line.amplitude), fontsize=7)
    top.set(xlabel="frequency (Hz)", ylabel="amplitude (nT)")
    if look.detected is not None:
        for k, name in enumerate(look.detected.beacons):
            snr = np.maximum(look.detected.snr[:, k], 1e-2)
            middle.semilogy(look.detected.time, snr, ".-", ms=2, lw=0.6, label=name)
        middle.legend(loc="upper right", fontsize="small", ncols=4)
    middle.set(xlabel="time (s)", ylabel="signal to noise")
    means = look.means
    if len(means):
        force = np.linalg.norm(means.force_body, axis=1)
        bottom.plot(means.time, force, ".-", c="tab:red")
        field = bottom.twinx()
        size = 1e6 * np.linalg.norm(means.field_body, axis=1)
        field.plot(means.time, size, ".-", c="tab:blue")
        field.set_ylabel("static field (uT)", color="tab:blue")
    bottom.set(xlabel="time (s)")
    bottom.set_ylabel("mean specific force (m/s^2)", color="tab:red")
    for one_gap in look.timings:
        for begin, end in zip(one_gap.gap_begin, one_gap.gap_end, strict=True):
            middle.axvspan(begin, end, color="0.9")
            bottom.axvspan(begin, end, color="0.9")
    verdict = str(look.trust.verdict)
    figure.suptitle(f"{verdict}: {look.trust.reasons[0].code}" if look.trust.reasons else verdict)
    figure.savefig(path, dpi=110, metadata={"Software": None})
