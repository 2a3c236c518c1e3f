"""Navigation in a pipe: records in, a state out at every epoch, or current states at any rate."""

from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, BinaryIO, TextIO

import numpy as np

from magfusion.errors import InputError
from magfusion.estimation.batch.hypothesis_selection import AMBIGUOUS_CHI_SQUARE
from magfusion.estimation.data_checks.stream_buffer import MAX_JUMP
from magfusion.estimation.graph.state import ACCEL_BIAS, GYRO_BIAS, POSITION, ROTATION, VELOCITY
from magfusion.estimation.initialization.online import NoStart
from magfusion.estimation.measurements.signs import along_axis
from magfusion.estimation.online.corrected import corrected
from magfusion.estimation.online.navigator import Navigator, NavigatorSettings
from magfusion.estimation.online.state_of_now import PropagatedState
from magfusion.estimation.online_integrity.judgement import JudgedState
from magfusion.files.checkpoint import run_key
from magfusion.files.named_records import magnetometer_number, site_fields, with_waveform
from magfusion.files.record_samples import aiding_samples, drive_samples
from magfusion.files.records import Record
from magfusion.files.site import load_site
from magfusion.files.standard_streams import write_message
from magfusion.files.stream import Format, NumberedRecord, json_line, read_records
from magfusion.jobs.checkpoint import CheckpointWriter, begin
from magfusion.jobs.inputs import named
from magfusion.jobs.live import LiveSettings, StateSink, state_sinks
from magfusion.jobs.region_option import ANYWHERE, Where
from magfusion.jobs.rotor_inputs import AwaitedAngles, check_streamed_rotors
from magfusion.jobs.stream_clocks import ClockJump, OlderRecords, StreamClocks
from magfusion.jobs.stream_samples import StreamSamples
from magfusion.model.aiding import sensor_named
from magfusion.model.marks import Marks
from magfusion.model.quaternion import of_matrices
from magfusion.model.site import Site
from magfusion.model.trust import Finding, Verdict
from magfusion.results.verdict import finding_rows
from magfusion.units import Array

NOT_ONLINE = "its samples are used by navigate --at-rest only."
WAITING = 1.0  # s; before the first state, as often a sign of life


@dataclass(frozen=True)
class StreamSettings:
    """Settings of a stream."""

    navigator: NavigatorSettings = field(default_factory=NavigatorSettings)
    form: Format = "json"  # of the records
    keep_going: bool = False  # count and skip invalid records
    live: LiveSettings = field(default_factory=LiveSettings)  # other outputs of the states
    checkpoint: Path | None = None  # checkpoint file
    every: float = 30.0  # interval of checkpoints (s of the stream)
    resume: bool = False  # resume from the checkpoint, if there is one, with the next data
    where: Where = ANYWHERE  # constraint on the magnetometer's position, in addition to the site's


def run_stream(
    site_path: Path, settings: StreamSettings, source: BinaryIO, sink: BinaryIO, messages: TextIO
) -> int:
    """Navigate from the records of a stream; write one line of JSON for each state.

    `source`, `sink`: binary; each line is flushed. `messages`: receives messages on skipped
    records. Returns the number of skipped records.
    """
    records = read_records(source, settings.form)
    return navigate_records(site_path, settings, records, sink, messages)


def navigate_records(
    site_path: Path,
    settings: StreamSettings,
    records: Iterable[NumberedRecord],
    sink: BinaryIO,
    messages: TextIO,
) -> int:
    """Navigate from records of any source, as `run_stream`."""
    site = settings.where.bounded(load_site(site_path, several=True))
    check_streamed_rotors(site_path, site)
    samples = StreamSamples(site)
    with state_sinks(settings.live, site, 0, messages) as sinks:
        try:
            return _navigate(site, settings, records, samples, sink, messages, sinks)
        except KeyboardInterrupt:  # the only end of a source that is live
            samples.report(messages)
            raise


def _navigate(
    site: Site,
    settings: StreamSettings,
    records: Iterable[NumberedRecord],
    samples: StreamSamples,
    sink: BinaryIO,
    messages: TextIO,
    others: tuple[StateSink, ...],
) -> int:
    key, place = run_key("stream", site, settings.navigator), settings.checkpoint
    begun = begin(place, key, site, settings.navigator, 0.0, resume=settings.resume)
    navigator = begun.navigator
    refused, saved, reached = 0, -np.inf, -np.inf
    output, angles = _StateWriter(navigator, sink, others), AwaitedAngles(site)
    kept = None if place is None else CheckpointWriter(place, key, messages)
    if not 0.0 <= begun.extra <= max(navigator.newest + MAX_JUMP, 0.0):
        raise InputError(f"{place}: the time that a counter lost is wrong; run without --resume")
    clocks = StreamClocks(settings.navigator.delay, navigator.newest, begun.extra)

    def restart() -> None:
        clocks.reset()
        output.restart(without_prior=True)

    older = OlderRecords(navigator.time if navigator.started else navigator.newest, restart)
    for numbered in older.skipped(clocks.all_unwrapped(records), messages):
        try:
            numbered = _on_clock(numbered, site, clocks, samples, output, messages)
            newest = _process_record(output.navigator, site, numbered, samples, output)
        except InputError as error:
            sentence = numbered.located(error)
            if not (settings.keep_going or isinstance(error, ClockJump)):
                raise InputError(sentence) from error
            refused += 1
            write_message(messages, f"{sentence} (skipped)")
            continue
        angles.see(numbered.record)
        navigator = output.navigator = corrected(output.navigator)
        output.epochs()
        measured = newest > -np.inf
        if not navigator.started and measured and not reached <= newest < reached + WAITING:
            output.write(None, _waiting(navigator, newest))
            reached = newest
        sink.flush()
        if kept is not None and measured and not saved <= newest < saved + settings.every:
            kept.save(output.navigator, numbered.number, clocks.wrapped)
            saved = newest
    with named("standard input"):
        _end(samples, output)
    if output.reference:
        write_message(messages, f"reference: {NOT_ONLINE}")
    samples.report(messages)
    older.report(messages)
    if refused:
        write_message(messages, f"{refused} records were skipped")
    return refused


class _StateWriter:
    """Writes states as they are estimated, and sends them to the other outputs.

    `sink`: binary. Attribute `reference`: whether samples of a reference sensor have arrived, which
    are not used here.
    """

    def __init__(self, navigator: Navigator, sink: BinaryIO, others: tuple[StateSink, ...]) -> None:
        self.navigator, self._sink, self._others = navigator, sink, others
        self._newest, self.reference = -np.inf, False

    def write(self, state: JudgedState | None, output: dict[str, Any]) -> None:
        """Write a state, or the status before the first (None)."""
        self._sink.write(json_line(output))
        for other in self._others:
            other.take(state, output)

    def restart(self, *, without_prior: bool = False) -> None:
        """Navigate on another clock; parameters as `Navigator.restarted`."""
        self.navigator = self.navigator.restarted(without_prior=without_prior)
        self._newest = -np.inf

    def now(self) -> None:
        """Write the current states, before any other processing."""
        for state in self.navigator.take_propagated():
            self.write(state, state_content(self.navigator, state))
            self._newest = state.time
        self._sink.flush()

    def epochs(self) -> None:
        """Write the states of the epochs, except those older than a written current one."""
        for state in self.navigator.take():
            if state.time > self._newest:
                self.write(state, state_content(self.navigator, state))
        self.navigator.take_lagged()


def _on_clock(
    numbered: NumberedRecord,
    site: Site,
    clocks: StreamClocks,
    samples: StreamSamples,
    output: _StateWriter,
    messages: TextIO,
) -> NumberedRecord:
    """Return a record on the clock of the others; after a step, navigation restarts.

    Raises InputError where its stamps are far from the others', and no further record follows it.
    """
    if numbered.record is None:
        return numbered
    record = with_waveform(numbered.record, site)
    step = clocks.step_in(record)
    if step is not None:
        write_message(messages, step.sentence)
        _end(samples, output)
        output.restart()
    for sentence in clocks.set_back(record):
        write_message(messages, sentence)
    clocks.check(record)
    return replace(numbered, record=record)


def _process_record(
    navigator: Navigator,
    site: Site,
    numbered: NumberedRecord,
    samples: StreamSamples,
    output: _StateWriter,
) -> float:
    """Feed a record to the navigator, and count missing data; return its newest time (s)."""
    if numbered.record is None:
        raise InputError(numbered.refusal)
    record, newest = numbered.record, -np.inf
    _process_companions(navigator, record)
    output.reference |= record.reference is not None
    if record.imu is not None:
        own = record.imu
        time, rows = samples.whole("imu", own.time, own.gyro, own.accel)
        newest = max(newest, _last(time))
        if site.platform.inertial:  # if not, the navigator refuses them
            time, rows = samples.tested("imu", time, rows)
        _process_imu(output, time, rows)
    if record.magnetometer is not None:
        field = record.magnetometer.field.copy()
        field[:, site.platform.magnetometer.lacking] = 0.0
        name = record.magnetometer.magnetometer
        magnetometer_number(site, name, "samples")
        time, rows = samples.whole("magnetometer", record.magnetometer.time, field, name=name)
        newest = max(newest, _last(time))
        time, rows = samples.tested("magnetometer", time, rows, name)
        if len(time):
            navigator.add_magnetometer(time, rows, name)
    if record.fields is not None:
        navigator.add_fields(along_axis(site_fields(record.fields, site), site))
        newest = max(newest, record.fields.time)
    return newest


def _process_imu(output: _StateWriter, time: Array, rows: Array) -> None:
    if len(time):
        output.navigator.propagate_imu(time, rows[:, :3], rows[:, 3:])
        output.now()
        output.navigator.advance()


def _end(samples: StreamSamples, output: _StateWriter) -> None:
    """Process the samples that wait for others, and write the states of them."""
    for stream, name, time, rows in samples.end():
        if stream == "imu":
            _process_imu(output, time, rows)
        else:
            output.navigator.add_magnetometer(time, rows, name)
    output.epochs()


def _process_companions(navigator: Navigator, record: Record) -> None:
    """Feed the navigator the data that must precede its samples."""
    if record.temperature is not None:
        for part, degc in record.temperature.degc.items():
            navigator.add_temperature(part, record.temperature.time, degc)
    if record.drive is not None:
        navigator.add_drive(drive_samples(record.drive))
    for sensor, entry in (record.aiding or {}).items():
        declared = sensor_named(navigator.site.aiding, sensor)
        navigator.add_aiding(sensor, aiding_samples(entry, declared.quantity))
    if record.marks is not None:
        navigator.add_marks(Marks(record.marks.start, record.marks.end, record.marks.slot))
    if record.magnetometer is not None and record.magnetometer.slot is not None:
        navigator.add_slots(record.magnetometer.time, record.magnetometer.slot)


def _last(time: Array) -> float:
    return float(np.max(time, initial=-np.inf))


def _waiting(navigator: Navigator, time: float) -> dict[str, Any]:
    """Return a status before the first state, with the reason why a start was rejected."""
    nothing: dict[str, Any] = {"time": time, "started": False, "lost": False, "verdict": None}
    why = navigator.why_no_start
    reasons = why.trust.reasons
    if not reasons and why != NoStart():
        reasons = (Finding("no_start", why.reason, Verdict.FAILED),)
    open_ = True if any(reason.code == "ambiguous" for reason in reasons) else None
    return nothing | {"reasons": finding_rows(reasons), "ambiguous": open_}


def state_content(navigator: Navigator, state: JudgedState) -> dict[str, Any]:
    """Return a state as written: SI units, sigmas of position and velocity in world axes.

    A lost platform has no pose, nor anything derived from it.
    """
    output = {
        "time": state.time,
        "carried_s": state.time - state.epoch if isinstance(state, PropagatedState) else 0.0,
        "started": True,
        "lost": state.is_lost,
        "reset_counter": state.reset_counter,
        "verdict": str(state.verdict),
        "reasons": finding_rows(state.judgement.reasons),
        "remarks": finding_rows(state.judgement.remarks),
        "excluded": list(state.judgement.excluded),
        "heard": list(state.judgement.detected),
        "protection_level_m": state.judgement.protection_level_m,
        "protection_level_deg": state.judgement.protection_level_deg,
    }
    if state.is_lost:
        return output | {"ambiguous": None, "distortion": dict(navigator.distortion)}
    world_from_body, cov = state.world_from_body, state.cov
    rival = navigator.rival_chi_square
    position_cov = world_from_body @ cov[POSITION, POSITION] @ world_from_body.T
    biases, sigmas = _of_imu(navigator, state)
    quaternion = of_matrices(world_from_body[None])[:, 0]
    return output | {
        "ambiguous": rival is not None and rival < AMBIGUOUS_CHI_SQUARE,
        "position": state.position_world.tolist(),
        "quaternion": quaternion.tolist(),
        "velocity": state.velocity_world.tolist(),
        **biases,
        "sigma": {
            "position": _sigma(position_cov),
            "rotation_body": _sigma(cov[ROTATION, ROTATION]),
            "velocity": _sigma(cov[VELOCITY, VELOCITY]),
            **sigmas,
        },
        "distortion": dict(navigator.distortion),
    }


def _of_imu(
    navigator: Navigator, state: JudgedState
) -> tuple[dict[str, list[float]], dict[str, list[float]]]:
    """Return the biases of the IMU and their sigmas; for a motion prior the rate, body axes."""
    gyro, accel = _sigma(state.cov[GYRO_BIAS, GYRO_BIAS]), _sigma(state.cov[ACCEL_BIAS, ACCEL_BIAS])
    if not navigator.site.platform.inertial:
        return {"rate": (-state.gyro_bias_body).tolist()}, {"rate": gyro}
    biases = {
        "gyro_bias": state.gyro_bias_body.tolist(),
        "accel_bias": state.accel_bias_body.tolist(),
    }
    return biases, {"gyro_bias": gyro, "accel_bias": accel}


def _sigma(cov: Array) -> list[float]:
    return [float(s) for s in np.sqrt(np.diagonal(cov))]
