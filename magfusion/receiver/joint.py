"""Joint reception of close tones in windows too short to separate them.

Tones half a hertz apart need windows of seconds to be separated, in which a walking user passes a
beacon.  A pose does not need separate tones: a window of a quarter of a second leaves their joint
effect in a few directions, and a model of all tones predicts each of these directions.  No
information of the samples is lost, and none counts twice.
"""

from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np

from magfusion.model.detection_range import tones_of
from magfusion.model.samples import ImuSamples, Waveform
from magfusion.model.site import Site
from magfusion.model.trust import Finding, Verdict
from magfusion.receiver.admission import WindowGrid, Windows, sample_rate_hz
from magfusion.receiver.design import nuisances_hz
from magfusion.receiver.lockin_receiver import MIN_SHARE, LockinReceiver
from magfusion.receiver.slots import has_schedule
from magfusion.receiver.windows import LockinSettings, default_settings
from magfusion.units import Array

SHORT_WINDOW = 0.2  # s
NODES = (-0.87, 0.0, 0.87)  # half windows from the centre: changes in between are a parabola
MAX_SEPARATING_WINDOW = 1.0  # s; longer windows to separate tones hold too much motion
SAME_TIMES = 1e-8  # s; sample times that are no farther apart have the same design
MIN_SINGULAR_VALUE = 1e-3  # of the largest singular value; smaller ones carry no information
PROBES = 6  # on either side of the tones, a window's resolution apart
CLEAR = 1.5  # resolutions between a probe and a line


def joint_settings(site: Site, requested: LockinSettings | None) -> LockinSettings | None:
    """Return the settings for joint reception of a site's close tones; None if they are not close.

    `requested`: requested windows; then there is no joint reception.
    """
    usual = _long(site, requested)
    if usual is None or bool(site.platform.further) or bool(site.platform.magnetometer.lacking):
        return None
    return LockinSettings(SHORT_WINDOW, SHORT_WINDOW, usual.mains_hz, 16)


def long_windows(site: Site, requested: LockinSettings | None) -> tuple[Finding, ...]:
    """Return a finding, with the reason, if close tones are received separately.

    `requested`: as of `joint_settings`.
    """
    usual = _long(site, requested)
    if usual is None or joint_settings(site, requested) is not None:
        return ()
    why = "several magnetometers" if site.platform.further else "fewer axes than three"
    text = (
        f"Tones of the beacons are so close that separating them takes windows of"
        f" {usual.window:.3g} s; with {why} no shorter ones are used. Motion within a window is"
        " known from the IMU alone, and states are few. Set the frequencies farther apart"
        f"{', or navigate by one magnetometer' if site.platform.further else ''}."
    )
    return (Finding("long_windows", text, Verdict.TRUSTWORTHY, 0.5),)


def _long(site: Site, requested: LockinSettings | None) -> LockinSettings | None:
    """Return the windows that separate close tones; None where the tones are not close."""
    if requested is not None or len(site.beacons) < 2 or has_schedule(site):
        return None
    if not site.platform.inertial:
        return None
    if any(beacon.unknown is not None or not beacon.tones for beacon in site.beacons):
        return None
    usual = default_settings(site)
    return None if usual.window <= MAX_SEPARATING_WINDOW else usual


class JointDesign(NamedTuple):
    """Information of a window's samples on all tones together."""

    # (m, directions), orthonormal: the tones orthogonal to static field, drift and mains
    across: Array
    # (nodes, directions, 2 tones), cosines and sines of each tone in these directions, by node
    tones: Array
    extra_design: Array  # (m, probes), orthonormal, next to the tones: directions of noise

    @staticmethod
    def of(
        elapsed: Array, frequencies_hz: Array, settings: LockinSettings, directions: int | None
    ) -> "JointDesign":
        """Compute the design of a window's samples.

        `elapsed` (m,): times from its centre (s). `directions`: how many are kept; None for all
        that carry information.
        """
        nyquist_hz = 0.5 / float(np.median(np.diff(elapsed)))
        mains_hz = nuisances_hz(settings, np.zeros(1), nyquist_hz)
        mains_hz = np.concatenate([mains_hz, settings.lines_hz])
        angle = 2.0 * np.pi * elapsed[:, None] * mains_hz
        steady = np.stack([np.ones_like(elapsed), elapsed * (2.0 / settings.window)], axis=1)
        fitted = _orthonormal(np.column_stack([steady, np.cos(angle), np.sin(angle)]))
        angle = 2.0 * np.pi * elapsed[:, None] * frequencies_hz
        tones = np.concatenate([np.cos(angle), np.sin(angle)], axis=1)
        across, size, _ = np.linalg.svd(_without(tones, fitted), full_matrices=False)
        kept = (
            int(np.sum(size > MIN_SINGULAR_VALUE * size[0])) if directions is None else directions
        )
        rows = min(kept, len(size))
        basis = np.zeros((len(elapsed), kept))
        basis[:, :rows] = across[:, :rows]
        probes_hz = _probes(frequencies_hz, mains_hz, nyquist_hz, settings.window)
        angle = 2.0 * np.pi * elapsed[:, None] * probes_hz
        probes = np.concatenate([np.cos(angle), np.sin(angle)], axis=1)
        known = np.column_stack([fitted, across[:, size > MIN_SINGULAR_VALUE * size[0]]])
        return JointDesign(
            across=basis,
            tones=basis.T @ (_parts(elapsed, 0.5 * settings.window).T[..., None] * tones),
            extra_design=_orthonormal(_without(probes, known)),
        )


def _parts(elapsed: Array, half: float) -> Array:
    """Return the Lagrange weight of each node at each sample, (m, nodes)."""
    out = np.ones((len(elapsed), len(NODES)))
    for i, node in enumerate(NODES):
        for other in NODES[:i] + NODES[i + 1 :]:
            out[:, i] *= (elapsed / half - other) / (node - other)
    return out


def _without(columns: Array, fitted: Array) -> Array:
    return np.asarray(columns - fitted @ (fitted.T @ columns))


def _orthonormal(columns: Array) -> Array:
    """Return an orthonormal basis of the span of columns."""
    basis, size, _ = np.linalg.svd(columns, full_matrices=False)
    return np.asarray(basis[:, size > MIN_SINGULAR_VALUE * np.max(size, initial=0.0)])


def _probes(frequencies_hz: Array, mains_hz: Array, nyquist_hz: float, window: float) -> Array:
    """Return probe frequencies next to the tones, clear of all lines (Hz)."""
    lines = np.concatenate([[0.0, nyquist_hz], frequencies_hz, mains_hz])
    reach = PROBES / window
    requested = np.arange(
        np.min(frequencies_hz) - reach, np.max(frequencies_hz) + reach, 1.0 / window
    )
    requested = requested[(requested > 0.0) & (requested < nyquist_hz)]
    clear = np.min(np.abs(requested[:, None] - lines), axis=1) > CLEAR / window
    return np.asarray(requested[clear])


@dataclass(eq=False)
class JointDesigns:
    """Designs of successive windows; those with equal sample times share one.

    `directions`: number kept by every design.
    """

    settings: LockinSettings
    frequencies_hz: Array
    directions: int
    kept: list[tuple[Array, JointDesign]] = field(default_factory=list)

    def of(self, elapsed: Array) -> JointDesign:
        """Return the design for sample times from a window's centre (s)."""
        for known, design in self.kept:
            if len(known) == len(elapsed) and np.max(np.abs(known - elapsed)) < SAME_TIMES:
                return design
        design = JointDesign.of(elapsed, self.frequencies_hz, self.settings, self.directions)
        self.kept = [*self.kept[-3:], (elapsed, design)]
        return design


class JointReceiver(LockinReceiver):
    """Receiver of close tones: short contiguous windows, admitted by the common rules."""

    def fit_extra_lines(self, result: LockinSettings | None) -> None:
        """Set extra lines to fit with the tones; call it before `begin`."""
        if result is not None:
            self.extra_lines = replace(self.settings, lines_hz=result.lines_hz)

    def begin(self, waveform: Waveform, imu: ImuSamples) -> None:
        """Lay windows from the first sample on, as `Receiver.begin`."""
        rate_hz, settings = sample_rate_hz(waveform), self.settings
        grid = WindowGrid(
            centre=settings.first_centre(float(waveform.time[0]) - 0.5 / rate_hz),
            step=settings.step,
            length=settings.window,
            wait=-0.6 / rate_hz,
        )
        self._begin(waveform, imu, grid, MIN_SHARE, clips=True)

    @cached_property
    def frequencies_hz(self) -> Array:
        """Distinct frequencies of the tones (Hz)."""
        return tones_of(self.site).frequencies_hz

    @property
    def nodes(self) -> Array:
        """Times from the centre of a window at which the motion is evaluated (s)."""
        return 0.5 * self.settings.window * np.array(NODES)

    @cached_property
    def designs(self) -> JointDesigns:
        """Designs of its windows."""
        assert self.admission is not None
        step, half = self.admission.magnetometer_step, 0.5 * self.settings.window
        whole = np.arange(-half + 0.5 * step, half, step)
        usual = JointDesign.of(whole, self.frequencies_hz, self.settings, None)
        return JointDesigns(self.settings, self.frequencies_hz, usual.across.shape[1])

    def admitted(self, waveform: Waveform, imu: ImuSamples) -> Windows:
        """Begin, and return the usable windows of a whole log."""
        return self._admitted(waveform, imu)

    def _growth(self, windows: Windows, time: Array) -> Array:  # noqa: ARG002
        """Return one: directions without samples only lose their information."""
        return np.ones(len(windows))
