"""Windows too short to tell close tones apart, whose samples are kept as they are told together.

Tones half a hertz apart ask for windows of seconds, in which somebody walks past a beacon.  A pose
does not ask for that: a window of a quarter of a second leaves what the tones do together in a few
directions, and a model that knows all of them predicts each of these directions.  Nothing of what
the samples tell of the tones is lost, and none of them counts twice.
"""

from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np

from magfusion.model.audibility import tones_of
from magfusion.model.samples import ImuSamples, Waveform
from magfusion.model.site import Site
from magfusion.model.trust import Finding, Verdict
from magfusion.receiver.admission import Grid, Windows, sample_rate_hz
from magfusion.receiver.design import nuisances_hz
from magfusion.receiver.lockin_receiver import LEAST_SHARE, LockinReceiver
from magfusion.receiver.slots import has_schedule
from magfusion.receiver.windows import LockinSettings, default_settings
from magfusion.units import Array, BoolArray

SHORT_WINDOW = 0.2  # s
NODES = (-0.87, 0.0, 0.87)  # half windows from the centre: what changes in between is a parabola
LONGEST_APART = 1.0  # s; a longer window to tell tones apart holds too much of a walk
SAME_TIMES = 1e-8  # s; sample times that are no farther apart have the same design
FAINTEST = 1e-3  # of the largest singular value; what is below tells nothing
PROBES = 6  # on either side of the tones, a window's resolution apart
CLEAR = 1.5  # resolutions between a probe and a line


def joint_settings(site: Site, asked: LockinSettings | None) -> LockinSettings | None:
    """Return how the close tones of a site are received together; None where they are not.

    Parameters
    ----------
    asked : LockinSettings, optional
        Where windows were asked for nothing else is done.
    """
    usual = _long(site, asked)
    if usual is None or bool(site.platform.further) or bool(site.platform.magnetometer.lacking):
        return None
    return LockinSettings(SHORT_WINDOW, SHORT_WINDOW, usual.mains_hz, 16)


def long_windows(site: Site, asked: LockinSettings | None) -> tuple[Finding, ...]:
    """Return that close tones are received one by one all the same, and why.

    Parameters
    ----------
    asked : LockinSettings, optional
        As of `joint_settings`.
    """
    usual = _long(site, asked)
    if usual is None or joint_settings(site, asked) is not None:
        return ()
    why = "several magnetometers" if site.platform.further else "fewer axes than three"
    text = (
        f"Tones of the beacons are so close that windows of {usual.window:.3g} s tell them apart,"
        f" and with {why} no shorter ones are used: what the platform does within them is known by"
        " the IMU alone, and states are few. Set the frequencies farther apart"
        f"{', or navigate by one magnetometer' if site.platform.further else ''}."
    )
    return (Finding("long_windows", text, Verdict.TRUSTWORTHY, 0.5),)


def _long(site: Site, asked: LockinSettings | None) -> LockinSettings | None:
    """Return the windows that tell close tones apart; None where the tones are not close."""
    if asked is not None or len(site.beacons) < 2 or has_schedule(site):
        return None
    if not site.platform.inertial:
        return None
    if any(beacon.unknown is not None or not beacon.tones for beacon in site.beacons):
        return None
    usual = default_settings(site)
    return None if usual.window <= LONGEST_APART else usual


class JointDesign(NamedTuple):
    """What the samples of a window tell of tones together, whatever the tones are.

    Parameters
    ----------
    across : ndarray, shape (m, directions)
        Orthonormal: what is left of the tones beside steady field, drift and mains.
    tones : ndarray, shape (nodes, directions, 2 tones)
        What the cosines and sines of each tone are there, with the part of each node in them.
    beside : ndarray, shape (m, probes)
        Orthonormal, beside the tones: what noise does.
    """

    across: Array
    tones: Array
    beside: Array

    @staticmethod
    def of(
        elapsed: Array, frequencies_hz: Array, settings: LockinSettings, directions: int | None
    ) -> "JointDesign":
        """Return the design of the samples of a window.

        Parameters
        ----------
        elapsed : ndarray, shape (m,)
            From its centre (s).
        directions : int, optional
            How many are kept; None for those that tell anything.
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
        kept = int(np.sum(size > FAINTEST * size[0])) if directions is None else directions
        rows = min(kept, len(size))
        basis = np.zeros((len(elapsed), kept))
        basis[:, :rows] = across[:, :rows]
        probes_hz = _probes(frequencies_hz, mains_hz, nyquist_hz, settings.window)
        angle = 2.0 * np.pi * elapsed[:, None] * probes_hz
        probes = np.concatenate([np.cos(angle), np.sin(angle)], axis=1)
        known = np.column_stack([fitted, across[:, size > FAINTEST * size[0]]])
        return JointDesign(
            across=basis,
            tones=basis.T @ (_parts(elapsed, 0.5 * settings.window).T[..., None] * tones),
            beside=_orthonormal(_without(probes, known)),
        )


def _parts(elapsed: Array, half: float) -> Array:
    """Return the part of each node in what changes within a window, (m, nodes) (Lagrange)."""
    out = np.ones((len(elapsed), len(NODES)))
    for i, node in enumerate(NODES):
        for other in NODES[:i] + NODES[i + 1 :]:
            out[:, i] *= (elapsed / half - other) / (node - other)
    return out


def _without(columns: Array, fitted: Array) -> Array:
    return np.asarray(columns - fitted @ (fitted.T @ columns))


def _orthonormal(columns: Array) -> Array:
    """Return an orthonormal basis of what columns span."""
    basis, size, _ = np.linalg.svd(columns, full_matrices=False)
    return np.asarray(basis[:, size > FAINTEST * np.max(size, initial=0.0)])


def _probes(frequencies_hz: Array, mains_hz: Array, nyquist_hz: float, window: float) -> Array:
    """Return frequencies beside the tones, clear of all lines (Hz)."""
    lines = np.concatenate([[0.0, nyquist_hz], frequencies_hz, mains_hz])
    reach = PROBES / window
    asked = np.arange(np.min(frequencies_hz) - reach, np.max(frequencies_hz) + reach, 1.0 / window)
    asked = asked[(asked > 0.0) & (asked < nyquist_hz)]
    clear = np.min(np.abs(asked[:, None] - lines), axis=1) > CLEAR / window
    return np.asarray(asked[clear])


@dataclass(eq=False)
class JointDesigns:
    """The designs of windows as they come: those whose sample times are alike have one.

    Parameters
    ----------
    directions : int
        That every design keeps.
    """

    settings: LockinSettings
    frequencies_hz: Array
    directions: int
    kept: list[tuple[Array, JointDesign]] = field(default_factory=list)

    def of(self, elapsed: Array) -> JointDesign:
        """Return the design of the samples of a window, times from its centre (s)."""
        for known, design in self.kept:
            if len(known) == len(elapsed) and np.max(np.abs(known - elapsed)) < SAME_TIMES:
                return design
        design = JointDesign.of(elapsed, self.frequencies_hz, self.settings, self.directions)
        self.kept = [*self.kept[-3:], (elapsed, design)]
        return design


class JointReceiver(LockinReceiver):
    """Of close tones: short windows side by side, admitted by the rules of all others."""

    def beside_lines(self, found: LockinSettings | None) -> None:
        """Take lines that were found beside the tones, before anything begins."""
        if found is not None:
            self.beside = replace(self.settings, lines_hz=found.lines_hz)

    def begin(self, waveform: Waveform, imu: ImuSamples) -> None:
        """Lay windows from the first sample on, as `Receiver.begin`."""
        rate_hz, settings = sample_rate_hz(waveform), self.settings
        grid = Grid(
            centre=settings.first_centre(float(waveform.time[0]) - 0.5 / rate_hz),
            step=settings.step,
            length=settings.window,
            wait=-0.6 / rate_hz,
        )
        self._begin(waveform, imu, grid, LEAST_SHARE, clips=True)

    @cached_property
    def frequencies_hz(self) -> Array:
        """Of the tones, each once (Hz)."""
        return tones_of(self.site).frequencies_hz

    @property
    def nodes(self) -> Array:
        """Times from the centre of a window at which the motion is looked at (s)."""
        return 0.5 * self.settings.window * np.array(NODES)

    @cached_property
    def designs(self) -> JointDesigns:
        """The designs of its windows."""
        assert self.admission is not None
        step, half = self.admission.magnetometer_step, 0.5 * self.settings.window
        whole = np.arange(-half + 0.5 * step, half, step)
        usual = JointDesign.of(whole, self.frequencies_hz, self.settings, None)
        return JointDesigns(self.settings, self.frequencies_hz, usual.across.shape[1])

    def admitted(self, waveform: Waveform, imu: ImuSamples) -> Windows:
        """Begin, and return the usable windows of a whole log."""
        return self._admitted(waveform, imu)

    def _growth(self, windows: Windows, time: Array) -> Array:  # noqa: ARG002
        """Return one: what samples are missing from the directions costs what they told."""
        return np.ones(len(windows))

    def _driven(self, windows: Windows) -> BoolArray:
        return np.ones(len(windows), dtype=bool)
