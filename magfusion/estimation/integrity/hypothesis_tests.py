"""The usual mistake that explains a log, of what people get wrong.

The finite list of them is tried on a thinned log: those of beacons and magnetometer on snapshots of
the fields, those of the inertial sensor on how fixes of the fields move.  One is named only where
it explains the log, and clearly better than any other.
"""

from dataclasses import replace

import numpy as np

from magfusion.estimation.data_checks.resolution import step_of_axes
from magfusion.estimation.demodulation.demodulation import demodulated
from magfusion.estimation.integrity.beacon_causes import (
    MISFIT,
    beacon_causes,
    matrix_causes,
    survey_causes,
)
from magfusion.estimation.integrity.corrected_site import with_magnetometer
from magfusion.estimation.integrity.explanation import ENOUGH, MARGIN, Explanation, clearly_best
from magfusion.estimation.integrity.fault_candidates import EPOCH_SHIFT, SAMPLE_RATE
from magfusion.estimation.integrity.field_causes import global_causes
from magfusion.estimation.integrity.field_snapshots import Snapshots, snapshots_of
from magfusion.estimation.integrity.motion_causes import (
    EYE,
    gyro_unit_causes,
    motion_causes,
    timing_causes,
    with_quarter_turn,
)
from magfusion.estimation.integrity.motion_comparison import compared, surveyed
from magfusion.estimation.integrity.phase_causes import phase_causes
from magfusion.model.noise import model_error
from magfusion.model.parameters import initial_calibration
from magfusion.model.samples import FieldSamples, ImuSamples, Log
from magfusion.model.site import Site
from magfusion.model.without_imu import logged
from magfusion.receiver.cycles import whole_cycles
from magfusion.receiver.slots import has_schedule
from magfusion.receiver.windows import LockinSettings
from magfusion.units import Array, BoolArray

MAX_DURATION = 100.0  # s; of a longer log parts are tried
PARTS = 4
MIN_EPOCHS = 8  # epochs
MIN_TRAVEL = 0.3  # m; who goes less far sees each beacon from one side
MIN_SPAN = 20.0  # s; in less, other rates of clocks are not refuted by what they lead to
OF_MOTION = "the motion by the fields against that by the inertial sensor"
QUANTISED, LEFT_HANDED = "quantised", "magnetometer_axes"  # codes
DISTORTION = 0.3  # of a step, in phasors: 1/sqrt(12) of each sample
STRANGE = 1e3  # and above which it is no field of this site


def cause_of(
    log: Log, site: Site, settings: LockinSettings | None = None
) -> tuple[Explanation, str] | None:
    """Return the mistake that explains a log, with the sentences that state it.

    Raises InputError, EstimationError where the log holds no field that is usable.
    """
    log, site = logged(log, site)
    part = _part(log)
    samples = _demodulated(part, site, settings)
    samples = samples.rows(np.asarray(samples.valid.any(axis=1)))
    if len(samples) < MIN_EPOCHS:
        return None
    known = snapshots_of(samples, part.imu, site)
    tried = _of_fields(known, samples, _static(part, site))
    of_fields, of_motion = clearly_best(tried), None
    if of_fields is None and any(one.clear for one in tried):
        return None  # it is of the fields, whichever it is: no inertial sensor explains it
    if of_fields is None and (rest := _unexplained(known, part, samples)) is not None:
        return rest
    if of_fields is None or known.excess < MISFIT:
        # As declared the fields may be so: what explains them is weighed against what moves.
        of_motion = clearly_best(_of_motion(known, samples, part.imu))
    if of_motion is not None and (of_fields is None or of_motion.fall > of_fields.fall):
        return of_motion, of_motion.text(OF_MOTION)
    if of_fields is not None and of_fields.code == LEFT_HANDED:
        of_fields = replace(of_fields, site=_with_right_axes(samples, part.imu, site))
    if of_fields is not None and of_fields.code in (EPOCH_SHIFT, SAMPLE_RATE):
        of_fields = _on_a_clock(of_fields, site, samples, part.imu)
    if of_fields is not None:
        return of_fields, of_fields.text(f"the fields at {len(known.samples)} epochs")
    return None


def _unexplained(
    known: Snapshots, part: Log, samples: FieldSamples
) -> tuple[Explanation, str] | None:
    """Return the finding on fields that no single mistake explains."""
    before, freedom, excess = known.joint_chi_square, max(known.freedom, 1.0), known.excess
    if excess < MISFIT or not _moves(known):
        return None
    rms = float(np.sqrt(excess))
    # Relative; a refined site has an error of each beacon, in place of the world's.
    share = rms * float(np.sqrt(np.mean(model_error(known.site) ** 2)))
    if excess > STRANGE:
        code, text = (
            "other_site",
            f"The fields contradict the site's file as a whole (residual {rms:.3g} where 1 is"
            " expected), and no single usual mistake explains it. Check that the site is that of"
            " this room, with these beacons at these frequencies.",
        )
    elif rounded := _rounded(part, samples, known.site, share):
        code, text = QUANTISED, rounded
    else:
        code, text = (
            "iron",
            f"The fields deviate from the beacons' by about {100.0 * share:.2g} % from place to"
            " place, and neither another survey nor other moments explain it: as iron in the room"
            " does, or a line near a tone. Learn a field map (magfusion calibrate fieldmap), or"
            f" declare {world_model_error(known.site, share)}.",
        )
    return Explanation(code, text, "", before, before, freedom, catch_all=True), text


def world_model_error(site: Site, share: float) -> str:
    """Return the words by which a site declares a share of the field as model error."""
    own = any(beacon.model_error is not None for beacon in site.beacons)
    return f"world.model_error {share:.2g}" + (" and omit that of the beacons" if own else "")


def _rounded(log: Log, samples: FieldSamples, site: Site, share: float) -> str | None:
    """Return the finding on fields that the steps of the magnetometer distort."""
    step = coarse_steps(log, site)
    if step is None or share > distorted_by(step, samples):
        return None
    return of_steps(step, share)


def coarse_steps(log: Log, site: Site) -> float | None:
    """Return the magnetometer's steps (T) if they are larger than its noise.

    Steps below the noise only add to it; larger ones distort the fields, by less than a step.
    """
    wave, density = log.waveform, site.platform.magnetometer.noise_density
    if wave is None or len(wave) < MIN_EPOCHS:
        return None
    step = float(np.max(step_of_axes(wave.measured_sensor)))
    rounding = step * np.sqrt(float(np.median(np.diff(wave.time))) / 6.0)  # T/sqrt(Hz), one-sided
    return None if rounding < density else step


def distorted_by(step: float, samples: FieldSamples) -> float:
    """Return the largest share of the fields that steps (T) distort."""
    return DISTORTION * step / float(np.nanmedian(np.linalg.norm(samples.phasor_sensor, axis=2)))


def of_steps(step: float, share: float, about: str = "about") -> str:
    """Return the finding on steps (T) that distort the fields by a share."""
    return (
        f"The magnetometer's steps of {step:.2g} T are larger than its noise, and distort the"
        f" fields by {about} {100.0 * share:.2g} %. Choose a smaller range, or more digits."
    )


def _demodulated(log: Log, site: Site, settings: LockinSettings | None) -> FieldSamples:
    """Return phasors rotated by the gyro, or as they are where their noise is less.

    Nothing of the fields may hang on an inertial sensor that is itself in doubt: a gyro whose axes
    or signs are wrong makes more noise of the Earth field than none does.
    """
    still = replace(log, imu=replace(log.imu, gyro_body=np.zeros_like(log.imu.gyro_body)))
    trials = []
    for one in (log, still):
        samples = demodulated(one, site, settings).fields
        if has_schedule(site):
            samples = whole_cycles(samples, one.imu, site)
        noise = np.trace(samples.phasor_cov, axis1=2, axis2=3)
        trials.append((float(np.nanmedian(noise)), samples))
    return min(trials, key=lambda pair: pair[0])[1]


def _static(log: Log, site: Site) -> float | None:
    """Return the usual size of the field, relative to the Earth's."""
    if log.vectors is None or site.earth_field_world is None:
        return None
    size = np.linalg.norm(log.vectors.measured_sensor, axis=1)
    return float(np.median(size) / np.linalg.norm(site.earth_field_world))


def _of_fields(known: Snapshots, samples: FieldSamples, static: float | None) -> list[Explanation]:
    tried = [*matrix_causes(known, static), *beacon_causes(known), *phase_causes(known, samples)]
    best = clearly_best(tried)
    if best is None or best.after > ENOUGH * best.expected:
        tried += global_causes(known)
    # Of a platform at rest, and of one beacon with two possible faults, no more is known.
    if _moves(known) and not any(one.clear and one.after < known.freedom for one in tried):
        tried += survey_causes(known)
    return tried


def _moves(known: Snapshots) -> bool:
    place = known.fixes.position_world[:, 0]
    return float(np.max(np.ptp(place, axis=0))) > MIN_TRAVEL


def _of_motion(known: Snapshots, samples: FieldSamples, imu: ImuSamples) -> list[Explanation]:
    site = known.site
    if not site.platform.inertial:
        return []
    every = surveyed(samples, known.calibration)
    motion = compared(every, imu, site)
    if motion is None:
        return []
    before, _ = motion.explained(EYE, EYE)
    return [
        *motion_causes(motion, site),
        *gyro_unit_causes(every, imu, site, before, motion.freedom),
        *timing_causes(every, imu, site, before, motion.freedom),
    ]


def _with_right_axes(samples: FieldSamples, imu: ImuSamples, site: Site) -> Site | None:
    """Return a site with the axes of a left-handed magnetometer; None where motion has none.

    The fields determine its handedness, the motion which of the axes are reversed or exchanged.
    """
    if site.platform.further or not site.platform.inertial:
        return None
    reversed_axes = with_magnetometer(site, matrix=-site.platform.magnetometer.matrix)
    every = surveyed(samples, initial_calibration(reversed_axes, float(np.mean(samples.time))))
    motion = compared(every, imu, reversed_axes)
    return None if motion is None else with_quarter_turn(motion, reversed_axes)


def _on_a_clock(
    clocked: Explanation, declared: Site, samples: FieldSamples, imu: ImuSamples
) -> Explanation:
    """Return what explains the phases, or its rival, whose magnetometer has another clock.

    As the motion has it, which compares the magnetometer with the inertial sensor.
    """
    if clocked.site is None or clocked.rival is None or clocked.rival.site is None:
        return clocked
    before, squares = declared.platform.magnetometer, []
    ahead = (1.0 + clocked.site.platform.magnetometer.clock_rate) / (1.0 + before.clock_rate) - 1.0
    tones_hz = np.concatenate([beacon.tone_frequencies_hz for beacon in declared.beacons])
    turn = 2.0 * np.pi * ahead * tones_hz * samples.time[:, None]
    still = replace(samples, phasor_sensor=samples.phasor_sensor * np.exp(-1j * turn)[..., None])
    every = surveyed(still, initial_calibration(clocked.site, float(np.mean(samples.time))))
    for site in (clocked.site, clocked.rival.site):
        own = site.platform.magnetometer
        rate = (1.0 + own.clock_rate) / (1.0 + before.clock_rate)
        time = (imu.time - (own.clock_offset - before.clock_offset)) / rate
        motion = compared(every, replace(imu, time=time), site)
        if motion is None:
            return clocked
        squares.append(motion.explained(EYE, EYE)[0])
    if squares[0] > squares[1] + MARGIN:
        return replace(clocked.rival, rival=replace(clocked, rival=None))
    if clocked.code == EPOCH_SHIFT:
        return clocked
    # In a few seconds neither rate is refuted, nor what follows from it.
    is_short = samples.time[-1] - samples.time[0] < MIN_SPAN
    is_refuted = squares[1] > squares[0] + MARGIN
    return replace(clocked, rival=None) if is_short or is_refuted else clocked


def _part(log: Log) -> Log:
    """Return a log, or of a long one some parts of it."""
    first, last = float(log.imu.time[0]), float(log.imu.time[-1])
    if last - first <= MAX_DURATION:
        return log
    begins = np.linspace(first, last - MAX_DURATION / PARTS, PARTS)

    def within(time: Array) -> BoolArray:
        elapsed = time[:, None] - begins
        return np.asarray(np.any((elapsed >= 0.0) & (elapsed < MAX_DURATION / PARTS), axis=1))

    imu, wave, fields = log.imu, log.waveform, log.fields
    kept = within(imu.time)
    return replace(
        log,
        imu=ImuSamples(imu.time[kept], imu.gyro_body[kept], imu.accel_body[kept]),
        waveform=None if wave is None else wave.rows(within(wave.time)),
        fields=None if fields is None else fields.rows(within(fields.time)),
        static=None,
    )
