"""Lock-in: raw waveform to phasors, one least-squares design a window.

The window is long against the motion, so that a plain lock-in leaks the Earth field and the other
beacons into each tone.  The gyro therefore rotates each sample into non-rotating axes, and the
result back into those at the window's centre; the design has a linear ramp for each tone.
"""

from dataclasses import dataclass

import numpy as np

from magfusion.model.detection_range import tones_of
from magfusion.model.quaternion import inverse, matrices, rotate
from magfusion.model.samples import FieldSamples, ImuSamples, Log, StaticFields, Waveform
from magfusion.model.site import Site
from magfusion.receiver.admission import (
    Windows,
    meets_silence,
    sample_rate_hz,
    silences,
    usual_step,
)
from magfusion.receiver.design import Designs, Maps, nuisances_hz
from magfusion.receiver.noise import noise_around_tones, not_below, smoothed_over_windows
from magfusion.receiver.turn import (
    BodyTurn,
    body_from_measured,
    body_turn_of,
    measured_from_body,
    on_clock,
    zero_rate_filler,
)
from magfusion.receiver.windows import LockinSettings
from magfusion.units import AnyArray, Array, BoolArray, ComplexArray, IntArray

MAX_COMPARED = 50  # windows by which two clocks are compared
MIN_COMPARED_SHARE = 0.8  # of the samples of the fullest
AT_ONCE = 1 << 14  # samples rotated at once, so that they fit the CPU cache
UNSEEN_TURN = 1.0  # rad/s; of a person or a vehicle, in gaps of the gyro


@dataclass(frozen=True, eq=False)
class WindowOperator:
    """Linear map from samples to phasors, kept to apply it to predictions as well."""

    designs: Designs  # from the sample times alone
    channels: tuple[tuple[str, int], ...]
    body_from_measured: Array  # (3, 3)
    # (4, samples), rotates each sample to non-rotating axes; quaternions, scalar first
    still_from_body: Array
    # (windows, 3, 3), rotates the fields back at the centre of each window
    measured_from_still: Array
    declared_noise: float  # of a sample, one sigma (T)
    # (windows,), windows in a gap of the gyro: the ramps follow the unknown rotation, and its
    # square is noise
    unseen: BoolArray
    # (windows,), windows whose noise differs from that of their neighbours: their rotation was
    # estimated without a gyro
    is_separable: BoolArray
    # axes that the receiver lacks. The samples of the others cannot be rotated, so that the square
    # of any rotation is noise, unless a prediction has been subtracted
    lacking: tuple[int, ...] = ()
    # (channels,), tone of each channel, where several beacons share a frequency
    tone_of_channel: IntArray | None = None
    ac_coupled: bool = False  # whether the samples hold no static field

    @property
    def frequencies_hz(self) -> Array:
        """Frequency of each channel (Hz)."""
        return self._by_channel(self.designs.frequencies_hz, axis=0)

    def _by_channel(self, by_tone: AnyArray, axis: int = 1) -> AnyArray:
        if self.tone_of_channel is None:
            return by_tone
        return np.take(by_tone, self.tone_of_channel, axis=axis)

    def demodulate(self, measured_sensor: Array) -> tuple[FieldSamples, StaticFields]:
        """Turn raw samples into phasors and the static field, each with covariance.

        `measured_sensor` (samples, 3) (T). Where a prediction has been subtracted, the noise next
        to the tones excludes the leakage of motion. For the static field, subtract the known offset
        or a prediction first: the gyro rotates an offset along with the samples.
        """
        samples, static, _ = self.demodulate_both(measured_sensor)
        return samples, static

    def demodulate_both(
        self, measured_sensor: Array, others: Array | None = None
    ) -> tuple[FieldSamples, StaticFields, ComplexArray]:
        """Return `demodulate` of a waveform, and the phasors of another at the same sample times.

        `others` (samples, 3): the other waveform (T); without it the last result is empty. Returns
        (n, channels, 3), phasors of the other: measured axes at the centre of the window (T).
        """
        still, parts = self._still(measured_sensor), []
        other = None if others is None else self._still(others)
        n, none = len(self.designs.frequencies_hz), np.zeros((0, 0, 3), dtype=np.complex128)
        for rows, maps in self.designs.pieces():
            turn, field = self.measured_from_still[rows], _of_windows(still, maps)
            fitted = maps.solver @ field
            noise = noise_around_tones(maps.probes @ field[:, None], maps.dimensions)
            result = self._phasor(rows, fitted[:, 1:])
            own, by = maps.variance, none
            if other is not None:
                by = self._phasor(rows, maps.solver[:, 1:] @ _of_windows(other, maps))
            parts.append(
                (
                    result,
                    self._bent(rows, maps, result),
                    0.5 * (own[:, 1 : 1 + n] + own[:, 1 + n :]),
                    turn[:, None] @ noise @ np.swapaxes(turn, 1, 2)[:, None],
                    (turn @ fitted[:, 0, :, None])[..., 0],
                    own[:, 0],
                    by,
                )
            )
        phasor, bent, unit, noise, constant, constant_unit, by = (
            part[0] if len(part) == 1 else np.concatenate(part) for part in zip(*parts, strict=True)
        )
        centre, settings = self.designs.windows.centre, self.designs.settings
        smooth = smoothed_over_windows(
            noise, centre, settings.step, settings.noise_windows, self.unseen | self.is_separable
        )
        smooth = not_below(smooth, self.declared_noise)
        samples = FieldSamples(
            time=centre,
            window=np.full(len(centre), settings.window),
            channels=self.channels,
            phasor_sensor=self._by_channel(phasor),
            phasor_cov=self._by_channel(
                unit[..., None, None] * smooth + bent[..., None, None] * np.eye(3)
            ),
            axes="".join(axis for k, axis in enumerate("xyz") if k not in self.lacking),
        )
        spread = constant_unit[:, None, None] * np.mean(smooth, axis=1)
        constant[:, range(3) if self.ac_coupled else self.lacking] = np.nan
        return samples, StaticFields(centre, constant, spread), self._by_channel(by)

    def unexplained(self, measured_sensor: Array) -> Array:
        """Return the residual power of each window, shape (n,) (T^2)."""
        still, out = self._still(measured_sensor), []
        for _, maps in self.designs.pieces():
            design, normal = self.designs.separated_design(maps.elapsed, maps.weight)
            field, projected = _of_windows(still, maps), np.swapaxes(design, -1, -2)
            fitted = np.linalg.solve(normal, projected @ field)
            residual = field - design @ fitted
            out.append(np.sum(residual**2, axis=(1, 2)) / np.sum(maps.weight, axis=1))
        return np.concatenate(out)

    def _still(self, measured_sensor: Array) -> Array:
        """Return the samples in non-rotating axes, shape (samples, 3)."""
        out = np.empty_like(measured_sensor)
        for begin in range(0, len(out), AT_ONCE):
            rows = slice(begin, begin + AT_ONCE)
            in_body = self.body_from_measured @ measured_sensor[rows].T
            out[rows] = rotate(self.still_from_body[:, rows], in_body).T
        return out

    def _bent(self, rows: slice, maps: Maps, result: ComplexArray) -> Array:
        """Return the variance of phasors (n, tones, 3) by the square of an unobserved rotation.

        Shape (n, tones) (T^2): the response of the design to a tone that decreases with time
        squared.
        """
        n = len(self.designs.frequencies_hz)
        out, unseen = np.zeros((len(maps.elapsed), n)), self.unseen[rows] | bool(self.lacking)
        if not unseen.any():
            return out
        elapsed = maps.elapsed[unseen]
        cosine = self.designs.design(elapsed, maps.weight[unseen])[..., 2 : 2 + n]
        square = (UNSEEN_TURN * elapsed[..., None]) ** 2  # half of it for each transverse axis
        out[unseen] = np.einsum("ntm,nmt->nt", maps.solver[unseen, 1 : 1 + n], square * cosine) ** 2
        return out * np.nansum(np.abs(result) ** 2, axis=-1)

    def _phasor(self, rows: slice, fitted: Array) -> ComplexArray:
        """Return phasors of the cosines and sines, shape (n, 2 tones, 3), of some windows."""
        frequencies, centre = self.designs.frequencies_hz, self.designs.windows.centre[rows]
        cosine, sine = fitted[:, : len(frequencies)], fitted[:, len(frequencies) :]
        reference = np.exp(-2j * np.pi * frequencies * centre[:, None])
        still = (cosine - 1j * sine) * reference[..., None]
        result = still @ np.swapaxes(self.measured_from_still[rows], 1, 2)
        result[..., self.lacking] = np.nan
        return np.asarray(result)


def _of_windows(still: Array, maps: Maps) -> Array:
    """Return the samples of windows, zero where padded, shape (n, m, 3)."""
    return still[maps.sample] * maps.weight[..., None]


def window_operator(
    waveform: Waveform,
    imu: ImuSamples,
    site: Site,
    settings: LockinSettings,
    windows: Windows,
    imu_step: float | None = None,
    designs: Designs | None = None,
    nyquist_hz: float | None = None,
    turn: BodyTurn | None = None,
) -> WindowOperator:
    """Return the map from a waveform to phasors, with the gyro's rotation of each sample.

    Parameters
    ----------
    imu : ImuSamples
        As from `magfusion.receiver.turn.on_clock`.
    site : Site
        Tones, magnetometer matrix and mounting.
    windows : Windows
        Admitted windows.
    imu_step : float, optional
        Median time between two inertial samples (s), if the stream may have none.
    designs : Designs, optional
        Designs of the same windows, if already computed.
    nyquist_hz : float, optional
        Nyquist frequency of the magnetometer, if known.
    turn : BodyTurn, optional
        Rotation of the stream, if known; recomputed where it has gaps.
    """
    nyquist_hz = sample_rate_hz(waveform) / 2.0 if nyquist_hz is None else nyquist_hz
    step = usual_step(imu.time, "imu") if imu_step is None else imu_step
    margin = 2.0 * step + 3.0 * site.platform.imu.time_offset_sigma
    silence = silences(imu.time, step, margin)
    if turn is None or len(silence[0]) > 1:  # the last gap follows the stream
        still_from_body = body_turn_of(zero_rate_filler(imu, silence))
        turn = BodyTurn(still_from_body(waveform.time), still_from_body(windows.centre))
    from_body, still = measured_from_body(site), turn.at_samples
    at_centre = matrices(inverse(turn.at_centres))
    lacking = site.platform.magnetometer.lacking
    if lacking:
        from_body = np.eye(3)
        at_centre = np.broadcast_to(from_body, at_centre.shape)
        still = np.zeros_like(still)
        still[0] = 1.0
    tones = tones_of(site)
    return WindowOperator(
        designs=designs_of(waveform, site, settings, windows) if designs is None else designs,
        channels=site.channels,
        body_from_measured=np.eye(3) if lacking else body_from_measured(site),
        still_from_body=still,
        measured_from_still=from_body @ at_centre,
        declared_noise=site.platform.magnetometer.noise_density * float(np.sqrt(nyquist_hz)),
        unseen=meets_silence(windows, settings.window, 0.5 / nyquist_hz, silence),
        is_separable=np.zeros(len(windows), dtype=bool),
        lacking=lacking,
        tone_of_channel=tones.of_channel if tones.reused else None,
        ac_coupled=site.platform.magnetometer.ac_coupled,
    )


def designs_of(
    waveform: Waveform, site: Site, settings: LockinSettings, windows: Windows
) -> Designs:
    """Return the lock-in designs for the sample times of windows."""
    frequencies, nyquist_hz = tones_of(site).frequencies_hz, sample_rate_hz(waveform) / 2.0
    nuisances = nuisances_hz(settings, frequencies, nyquist_hz)
    return Designs(settings, frequencies, nuisances, waveform.time, windows)


def unexplained(log: Log, site: Site, settings: LockinSettings) -> Array:
    """Return the residual power of a series of windows, shape (windows,) (T^2).

    `log`: with a waveform.
    """
    waveform, half = log.waveform, 0.5 * settings.window
    assert waveform is not None
    first, last = waveform.time[0] + half, waveform.time[-1] - half
    centre = np.linspace(first, max(first, last), MAX_COMPARED)
    begin = np.searchsorted(waveform.time, centre - half)
    count = np.searchsorted(waveform.time, centre + half) - begin
    rows = count > MIN_COMPARED_SHARE * np.max(count)
    length = np.full(len(centre), settings.window)
    number = np.arange(len(centre))
    windows = Windows(number, centre, begin, count, length, np.zeros_like(number)).rows(rows)
    imu = on_clock(log.imu, site.platform.imu.time_offset)
    operator = window_operator(waveform, imu, site, settings, windows)
    return operator.unexplained(waveform.measured_sensor - site.platform.magnetometer.offset)
