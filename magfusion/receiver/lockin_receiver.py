"""Receiver of simultaneous tones: overlapping windows, each a lock-in."""

from functools import cached_property

import numpy as np

from magfusion.errors import InputError
from magfusion.model.bandpass import is_bandpass
from magfusion.model.detection_range import tones_of
from magfusion.model.samples import FieldSamples, ImuSamples, Waveform
from magfusion.model.site import Site
from magfusion.receiver.admission import WindowGrid, Windows, sample_rate_hz
from magfusion.receiver.cells import owned_by
from magfusion.receiver.design import Designs, Maps, nuisances_hz, separable, variance_growth
from magfusion.receiver.even_samples import Spacing
from magfusion.receiver.lockin import WindowOperator, designs_of, window_operator
from magfusion.receiver.receiver import Receiver
from magfusion.receiver.turn import BodyTurn
from magfusion.receiver.windows import LockinSettings, default_settings, sent_frequencies_hz
from magfusion.units import Array, BoolArray, IntArray

MIN_SHARE = 0.5  # of the samples of a window: its design shows whether they suffice


class LockinReceiver(Receiver):
    """Receiver of simultaneous tones: overlapping windows, long against the motion."""

    history_length = 0
    # With the extra lines fitted with the tones; part of a checkpoint.
    extra_lines: LockinSettings | None

    def __init__(self, site: Site, settings: LockinSettings | None = None) -> None:
        super().__init__(site)
        self._given, self.extra_lines = settings, None
        self._designs: Designs | None = None
        self._even: dict[Spacing, Maps] = {}
        self._even_by: tuple[LockinSettings, bytes, float] | None = None
        self._lines_hz = np.zeros(0)

    @property
    def settings(self) -> LockinSettings:
        """Window and step, chosen from the tones if not given."""
        return self._chosen if self.extra_lines is None else self.extra_lines

    @cached_property
    def _chosen(self) -> LockinSettings:
        return default_settings(self.site) if self._given is None else self._given

    @cached_property
    def _sent(self) -> Array:
        return sent_frequencies_hz(self.site)

    def check(self) -> None:
        """Refuse tones that cannot be separated, as `Receiver.check`."""
        sent_frequencies_hz(self.site)

    def begin(self, waveform: Waveform, imu: ImuSamples) -> None:
        """Lay windows from the first sample on, as `Receiver.begin`."""
        rate_hz = sample_rate_hz(waveform)
        frequencies = self._sent
        highest = float(np.max(frequencies))
        if highest > 0.45 * rate_hz and not is_bandpass(self.site, rate_hz):
            raise InputError(
                f"magnetometer: sampled at {rate_hz:.4g} Hz, too slow for the tone at {highest:g}"
                f" Hz; at least {highest / 0.45:.4g} Hz are needed"
            )
        window = self.settings.window
        if not separable(1.0 / rate_hz, self.settings, frequencies):
            raise InputError(
                f"magnetometer: {window * rate_hz:.3g} samples in a window of {window:.3g} s are"
                " too few to separate tones, drift and static field; choose a longer window"
                f" (--window), or sample faster than at {rate_hz:.4g} Hz"
            )
        grid = WindowGrid(
            centre=self.settings.first_centre(float(waveform.time[0]) - 0.5 / rate_hz),
            step=self.settings.step,
            length=window,
            wait=-0.6 / rate_hz,  # the last sample is half a step earlier
        )
        self._begin(waveform, imu, grid, MIN_SHARE, clips=True)

    def whole(self, waveform: Waveform, imu: ImuSamples) -> tuple[Windows, FieldSamples]:
        """Return windows and phasors as `Receiver.whole`, each phasor of one beacon."""
        windows, result = super().whole(waveform, imu)
        return windows, owned_by(result, self.site)

    def sent(self, waveform: Waveform, imu: ImuSamples) -> FieldSamples:
        """Return the phasors of each channel, of any beacon on its frequency."""
        return super().whole(waveform, imu)[1]

    def phasors(
        self, waveform: Waveform, imu: ImuSamples, windows: Windows, site: Site
    ) -> tuple[FieldSamples, IntArray]:
        """Return the phasors of windows, corrected for rotation only."""
        operator = self.operator(waveform, imu, windows, site)
        return operator.demodulate(waveform.measured_sensor)[0], windows.number

    def operator(
        self,
        waveform: Waveform,
        imu: ImuSamples,
        windows: Windows,
        site: Site,
        turn: BodyTurn | None = None,
    ) -> WindowOperator:
        """Return the map from a waveform to phasors, as of `window_operator`.

        What depends on the sample times alone is cached until they change.
        """
        known = self._designs
        if known is None or known.windows is not windows or known.time is not waveform.time:
            known = self._designs = designs_of(waveform, site, self.settings, windows)
        return window_operator(
            waveform, imu, site, self.settings, windows, designs=known, turn=turn
        )

    def operator_of_one(
        self, waveform: Waveform, imu: ImuSamples, window: Windows, site: Site, turn: BodyTurn
    ) -> WindowOperator:
        """Return the map from the samples of one window to its phasors, as of `window_operator`."""
        assert self.admission is not None
        nyquist_hz = 0.5 / self.admission.magnetometer_step
        tones_hz = tones_of(site).frequencies_hz
        even, lines_hz = self._even_maps(tones_hz, nyquist_hz)
        designs = Designs(self.settings, tones_hz, lines_hz, waveform.time, window, even)
        return window_operator(
            waveform,
            imu,
            site,
            self.settings,
            window,
            self.admission.imu_step,
            designs,
            nyquist_hz,
            turn,
        )

    def _even_maps(self, tones_hz: Array, nyquist_hz: float) -> tuple[dict[Spacing, Maps], Array]:
        """Return the cached maps of evenly spaced samples, and the lines in their designs.

        The cache is cleared when the settings change.
        """
        by = (self.settings, tones_hz.tobytes(), nyquist_hz)
        if self._even_by != by:
            self._even, self._even_by = {}, by
            self._lines_hz = nuisances_hz(self.settings, tones_hz, nyquist_hz)
        return self._even, self._lines_hz

    def _driven(self, windows: Windows) -> BoolArray:
        return np.ones(len(windows), dtype=bool)

    def _growth(self, windows: Windows, time: Array) -> Array:
        assert self.admission is not None
        frequencies = self._sent
        step = self.admission.magnetometer_step
        return variance_growth(windows, time, step, self.settings, frequencies)
