"""The first state of an online estimator: the smoother over the data gathered so far."""

from dataclasses import dataclass

import numpy as np

from magfusion.errors import EstimationError, InputError
from magfusion.fusion.batch import SmootherSettings, smooth
from magfusion.fusion.buffers import Buffer
from magfusion.fusion.handover import last_state
from magfusion.fusion.state import State
from magfusion.parameters import held_blocks
from magfusion.receiver.windows import LockinSettings, default_settings
from magfusion.records.samples import FieldSamples, ImuSamples, Log, SteadyFields, Waveform
from magfusion.site import Site

AMBIGUOUS_CHI_SQUARE = 20.0  # below this a mirrored trajectory explains the data nearly as well


@dataclass(frozen=True, eq=False)
class Outset:
    """Where an online estimator begins.

    Parameters
    ----------
    state : State
    lockin : LockinSettings, optional
        How the waveform is demodulated; None where phasors come.
    rate_hz : float
        Of the waveform.
    rival_chi_square : float, optional
        By how much the data preferred this start to its rival.
    """

    state: State
    lockin: LockinSettings | None
    rate_hz: float
    rival_chi_square: float | None

    @property
    def ambiguous(self) -> bool:
        """Whether a mirrored start explains the data nearly as well."""
        rival = self.rival_chi_square
        return rival is not None and rival < AMBIGUOUS_CHI_SQUARE


def find_outset(
    site: Site,
    imu: ImuSamples,
    waveform: Buffer,
    fields: list[FieldSamples],
    until: float,
    estimate: tuple[str, ...] | None,
    lockin: LockinSettings | None,
    steady: list[SteadyFields] | None = None,
) -> Outset | None:
    """Return the state at the last epoch before a time; None where the data do not tell it.

    Parameters
    ----------
    site : Site
    imu : ImuSamples
    waveform : Buffer
    fields : list of FieldSamples
        One epoch each; used where there are any.
    until : float
        (s)
    estimate : tuple of str, optional
        Groups of calibration parameters.
    lockin : LockinSettings, optional
    steady : list of SteadyFields, optional
        Beside ``fields``; None where the Earth field is not to be measured.
    """
    time, rows = waveform.rows()
    used = None if fields else (default_settings(site) if lockin is None else lockin)
    whole = [s for s in fields if s.time[0] <= until]
    log = Log(
        name="the beginning",
        epoch_ns=0,
        source="online",
        imu=imu,
        waveform=None if fields else Waveform(time[time <= until], rows[time <= until]),
        fields=_joined(whole) if whole else None,
        steady=_joined_steady(steady, whole) if whole and steady else None,
    )
    earth = steady is not None
    settings = SmootherSettings(estimate=estimate, lockin=used, loss="huber", earth=earth)
    try:
        result = smooth(log, site, settings)
        state = last_state(result, held_blocks(site, result.blocks, earth=earth))
    except (EstimationError, InputError, RuntimeError, np.linalg.LinAlgError):
        return None
    rate_hz = 0.0 if used is None else 1.0 / float(np.median(np.diff(time)))
    return Outset(state, used, rate_hz, result.rival_chi_square)


def _joined(parts: list[FieldSamples]) -> FieldSamples:
    return FieldSamples(
        time=np.concatenate([p.time for p in parts]),
        window=np.concatenate([p.window for p in parts]),
        channels=parts[0].channels,
        phasor_sensor=np.concatenate([p.phasor_sensor for p in parts]),
        phasor_cov=np.concatenate([p.phasor_cov for p in parts]),
    )


def _joined_steady(parts: list[SteadyFields], fields: list[FieldSamples]) -> SteadyFields | None:
    """Return the steady fields of the epochs; None where one has none."""
    known = {float(part.time[0]): part for part in parts}
    wanted = [known.get(float(s.time[0])) for s in fields]
    found = [part for part in wanted if part is not None]
    if len(found) < len(wanted):
        return None
    return SteadyFields(
        time=np.concatenate([p.time for p in found]),
        measured_sensor=np.concatenate([p.measured_sensor for p in found]),
        cov=np.concatenate([p.cov for p in found]),
    )
