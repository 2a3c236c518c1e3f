"""Bursts of coils that follow no clock: when they are marked, and what is made of them."""

from collections import Counter
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet
import pytest
from example_log import example_log
from pydantic import ValidationError
from time_slots_and_mains import tracker

from magfusion.errors import InputError
from magfusion.files.log import read_log, write_log
from magfusion.files.plain_data import resume, to_plain
from magfusion.files.records import Record
from magfusion.files.site import load_site, save_site
from magfusion.jobs.import_log import ImportSettings, run_import
from magfusion.model.marks import SILENT, UNKNOWN_SLOT, Marks, SlotColumn, marks_of_column
from magfusion.model.samples import FieldSamples, ImuSamples, Waveform
from magfusion.model.site import MarkedSlots, Site, Slots
from magfusion.receiver.ambient import uneven_weights
from magfusion.receiver.cycles import cycles, joins, whole_cycles
from magfusion.receiver.marked import OUTSIDE, TOO_SHORT, MarkedReceiver
from magfusion.receiver.receivers import received, receiver_of
from magfusion.receiver.turn import turn_of

RATE_HZ, CARRIER_HZ = 20e3, 6e3
COUPLING = 1e-7 * np.random.default_rng(7).standard_normal((3, 3))  # T; a coil a row


def _site(carrier_hz: float = CARRIER_HZ, *, synchronised: bool = True) -> Site:
    site = tracker(carrier_hz, Slots(2e-3, 4))
    beacon = replace(site.beacons[0], slots=MarkedSlots(), synchronised=synchronised)
    return replace(site, beacons=(beacon,))


def _marks(duration: float, seed: int = 3, order: tuple[int, ...] = (0, 1, 2, SILENT)) -> Marks:
    """Return bursts of 1.2 to 2.5 ms with pauses of up to as much."""
    rng = np.random.default_rng(seed)
    count = int(duration / 1.3e-3)
    burst, pause = rng.uniform(1.2e-3, 2.5e-3, count), rng.uniform(1e-4, 2.5e-3, count)
    end = 1.0 + np.cumsum(burst + pause)
    marks = Marks(end - burst, end, np.resize(np.array(order, dtype=np.int64), count))
    return marks.rows(marks.end < 1.0 + duration)


def _waveform(marks: Marks, duration: float, carrier_hz: float = CARRIER_HZ) -> Waveform:
    """Return coils of known fields in the Earth field, hum and noise, with a current that lags."""
    rng = np.random.default_rng(4)
    time = 1.0 + np.arange(int(duration * RATE_HZ)) / RATE_HZ
    field = np.zeros((len(time), 3))
    tone = np.cos(2.0 * np.pi * carrier_hz * time)
    for begin, end, slot in zip(marks.begin, marks.end, marks.slot, strict=True):
        own = (time >= begin) & (time < end)
        if slot >= 0:
            field[own] += tone[own, None] * COUPLING[slot]
    hum = 1.5e-7 * np.cos(2.0 * np.pi * 50.0 * time + 0.4)[:, None] * [0.6, 0.0, 0.8]
    noise = 1e-9 * rng.standard_normal(field.shape)
    return Waveform(time, field + hum + noise + [2e-5, 1e-5, 4e-5], marks)


def _still(end: float) -> ImuSamples:
    time = np.arange(0.9, end + 0.1, 2e-3)
    return ImuSamples(time, np.zeros((len(time), 3)), np.zeros((len(time), 3)))


def _slots_beside(waveform: Waveform) -> np.ndarray:
    """Return the slot of each sample, as a driver would write it."""
    assert waveform.marks is not None
    slot = np.full(len(waveform), UNKNOWN_SLOT)
    for begin, end, one in zip(*vars(waveform.marks).values(), strict=True):
        slot[(waveform.time >= begin) & (waveform.time < end)] = one
    return slot


@pytest.mark.parametrize("carrier_hz", [CARRIER_HZ, 0.0])
def test_each_burst_gives_its_coils_field_at_its_own_time(carrier_hz: float) -> None:
    marks = _marks(1.0)
    result, dropped = received(_waveform(marks, 1.0, carrier_hz), _still(2.0), _site(carrier_hz))
    driven = marks.rows(marks.slot != SILENT)
    channel = np.argmax(result.valid, axis=1)
    assert not dropped
    assert np.array_equal(channel, driven.slot)
    assert np.max(np.abs(result.time - 0.5 * (driven.begin + driven.end))) < 1.0 / RATE_HZ
    rows = np.arange(len(result))
    error = result.phasor_sensor[rows, channel] - COUPLING[channel]
    assert np.max(np.abs(np.mean(error, axis=0))) < 1e-10
    sigma = np.sqrt(np.trace(result.phasor_cov[rows, channel], axis1=1, axis2=2).mean() / 3.0)
    off = float(np.sqrt(np.mean(error.real**2)))
    # Hum of 150 nT is most of what pulses of direct current are under.
    assert off < (1.4 * sigma if carrier_hz else 3e-9)
    if carrier_hz:  # of 1 nT in 24 to 50 samples
        assert off > 0.7 * sigma


def test_the_ambient_field_of_uneven_bursts_is_told_with_the_mains() -> None:
    rng = np.random.default_rng(5)
    edges = np.cumsum(rng.uniform(0.5e-3, 6e-3, 400))
    centre, length = 0.5 * (edges[1:] + edges[:-1]), 0.7 * np.diff(edges)
    phase = 2.0 * np.pi * 50.0 * centre
    # A mean over a burst, by integration.
    inner = centre[:, None] + length[:, None] * (np.arange(200) + 0.5 - 100) / 200
    field = 3.0 + 2.0 * inner + 0.8 * np.cos(2.0 * np.pi * 50.0 * inner + 0.3)
    mean = field.mean(axis=1)
    silent = np.arange(len(centre)) % 4 == 3
    driven = ~silent
    index, weight = uneven_weights(
        centre[driven], length[driven], centre[silent], length[silent], 8, 50.0
    )
    result = np.sum(weight * mean[silent][index], axis=1)
    inside = slice(50, -50)
    assert np.max(np.abs(result - mean[driven])[inside]) < 1e-4
    assert np.ptp(phase) > 100.0


def test_what_is_far_from_any_silence_has_no_ambient_field() -> None:
    driven, silent = np.array([0.0, 5.0]), np.array([0.1, 0.2])
    length = np.full(2, 2e-3)
    _, weight = uneven_weights(driven, length, silent, length, 8, 0.0)
    assert np.array_equal(np.isnan(weight).any(axis=1), [False, True])


@pytest.mark.parametrize("carrier_hz", [CARRIER_HZ, 0.0])
def test_a_stream_in_odd_pieces_gives_what_the_log_gives(carrier_hz: float) -> None:
    site, waveform, imu = _site(carrier_hz), _waveform(_marks(1.0), 1.0, carrier_hz), _still(2.0)
    whole, _ = received(waveform, imu, site)
    marks = waveform.marks
    assert marks is not None
    for others in (False, True):
        receiver = receiver_of(site)
        slot, parts, end, rng = _slots_beside(waveform), [], 0, np.random.default_rng(1)
        while end < len(waveform):
            first, end = end, min(end + int(rng.integers(50, 900)), len(waveform))
            if others:
                receiver.add_slots(waveform.time[first:end], slot[first:end])
            else:
                start_time, until = waveform.time[first], waveform.time[end - 1]
                reported = (marks.end > start_time) & (marks.end <= until)
                receiver.add_marks(marks.rows(reported | ((first == 0) & (marks.end <= until))))
            come = Waveform(waveform.time[:end], waveform.measured_sensor[:end])
            if receiver.grid is None and end > 3000:
                receiver.begin(come, imu)
            if receiver.grid is not None:
                parts.append(receiver.push(come, imu, float(come.time[-1])))
        result = FieldSamples.joined(parts)
        kept = np.isin(whole.time, result.time) if not others else np.ones(len(whole), dtype=bool)
        assert len(result) > len(whole) - 8
        if others:  # edges of bursts are those of samples
            assert np.max(np.abs(result.time - whole.time[: len(result)])) < 1.0 / RATE_HZ
        elif carrier_hz:
            ours, neighbours = result.phasor_sensor, whole.phasor_sensor[kept]
            assert np.allclose(ours, neighbours, rtol=1e-9, atol=0.0, equal_nan=True)


@pytest.mark.slow
def test_bursts_of_a_short_cycle_are_one_epoch_in_a_stream_too() -> None:
    site, waveform, imu = _site(), _waveform(_marks(1.0), 1.0), _still(2.0)
    assert joins(site, waveform.marks)
    receiver, parts = MarkedReceiver(site), []
    receiver.joined = True
    receiver.begin(waveform, imu)
    for until in np.arange(1.1, 2.0, 1e-3):  # where a burst ends it matters no more
        parts.append(receiver.push(waveform, imu, float(until)))
    epochs = FieldSamples.joined(parts)
    slots, _ = received(waveform, imu, site)
    alone = whole_cycles(slots, imu, site)
    whole = epochs.rows(np.all(epochs.valid, axis=1))
    assert len(whole) > 0.9 * len(alone) > 50
    assert epochs.ahead is not None
    middle = np.mean(whole.ahead_or_zero, axis=1)
    assert np.max(np.abs(middle)) < 1e-12
    assert np.max(np.ptp(whole.ahead_or_zero, axis=1)) <= 0.012


@pytest.mark.parametrize(
    ("slots", "sizes"),
    [
        ([0, 1, 2, 0, 1, 2], [3, 3]),
        ([2, 0, 1, 1, 2, 0], [3, 3]),  # in any order
        ([0, 1, 0, 1, 2, 1, 2], [2, 3, 2]),  # one is lost
    ],
)
def test_a_coil_that_comes_again_begins_another_epoch(slots: list[int], sizes: list[int]) -> None:
    site, time = _site(), 3e-3 * np.arange(len(slots))
    phasor = np.full((len(slots), 3, 3), np.nan, dtype=complex)
    phasor[np.arange(len(slots)), slots] = 1e-7
    cov = np.where(np.isnan(phasor.real), np.nan, 1.0)[..., None] * 1e-20 * np.eye(3)
    rows = FieldSamples(time, np.full(len(time), 2e-3), site.channels, phasor, cov)
    result = cycles(rows, turn_of(_still(1.0), site), site)
    assert np.sum(result.valid, axis=1).tolist() == sizes


def test_slots_beside_samples_are_bursts_in_whatever_pieces() -> None:
    time = np.arange(40) * 1e-3
    slot = np.repeat([UNKNOWN_SLOT, 0, UNKNOWN_SLOT, 1, SILENT, 2, 2, UNKNOWN_SLOT], 5)
    whole = marks_of_column(time, slot)
    assert whole.slot.tolist() == [0, 1, SILENT, 2]
    assert np.allclose(whole.begin, [4.5e-3, 14.5e-3, 19.5e-3, 24.5e-3], rtol=0.0, atol=1e-12)
    assert np.allclose(whole.end, [9.5e-3, 19.5e-3, 24.5e-3, 34.5e-3], rtol=0.0, atol=1e-12)
    column, parts = SlotColumn(), Marks.none()
    for first, last in [(0, 3), (3, 4), (4, 22), (22, 23), (23, 31), (31, 40)]:
        parts = parts.joined(column.add_samples(time[first:last], slot[first:last]))
        parts = parts.joined(
            column.add_samples(time[first:last], slot[first:last])
        )  # twice: no matter
    for ours, others in zip(vars(parts).values(), vars(whole).values(), strict=True):
        assert np.allclose(ours, others, rtol=0.0, atol=1e-12)


def test_a_checkpoint_in_the_middle_of_a_burst_goes_on() -> None:
    site, waveform, imu = _site(0.0), _waveform(_marks(0.6), 0.6, 0.0), _still(1.6)
    slot, half = _slots_beside(waveform), 7000
    runs = []
    for cut in (False, True):
        receiver = receiver_of(site)
        receiver.add_slots(waveform.time[:half], slot[:half])
        early = waveform.rows(slice(half))
        receiver.begin(early, imu)
        receiver.push(early, imu, float(early.time[-1]))
        if cut:
            data, receiver = to_plain(receiver), receiver_of(site)
            resume(receiver, data, "receiver")
        receiver.add_slots(waveform.time[half:], slot[half:])
        runs.append(receiver.push(waveform, imu, float(waveform.time[-1])))
    assert len(runs[0]) > 50
    assert np.array_equal(*(run.phasor_sensor for run in runs), equal_nan=True)


@pytest.mark.slow
def test_what_is_kept_does_not_grow() -> None:
    site, waveform, imu = _site(), _waveform(_marks(6.0), 6.0), _still(7.0)
    receiver, kept = MarkedReceiver(site), []
    marks = waveform.marks
    assert marks is not None
    receiver.begin(waveform.rows(slice(4000)), imu)
    receiver.bursts = type(receiver.bursts)(site)
    for end in range(4000, len(waveform), 4000):
        now = waveform.time[end - 1]
        own = (marks.end > waveform.time[end - 4000]) & (marks.end <= now)
        receiver.add_marks(marks.rows(own))
        receiver.push(waveform.rows(slice(end)), imu, float(now))
        kept.append(len(receiver.bursts))
    assert max(kept[-3:]) <= max(kept[5:10]) + 20


def test_bursts_that_are_of_no_use_are_counted() -> None:
    marks = _marks(0.5)
    short = marks.begin[5] + 2e-4
    odd = replace(marks, end=np.where(np.arange(len(marks)) == 5, short, marks.end))
    before = Marks(np.array([0.2]), np.array([0.202]), np.array([0]))
    behind = Marks(np.array([1.9]), np.array([1.902]), np.array([2]))
    waveform = replace(_waveform(marks, 0.5), marks=before.joined(odd).joined(behind))
    assert marks.slot[5] != SILENT
    _, dropped = received(waveform, _still(1.6), _site())
    assert dropped == Counter({TOO_SHORT: 1, OUTSIDE: 2})


@pytest.mark.parametrize(
    ("marks", "sentence"),
    [
        (None, "the log has no marks"),
        (Marks(np.array([1.1]), np.array([1.2]), np.array([7])), "slot 7 at 1.1.* is of no coil"),
        (
            Marks(np.array([1.1, 1.15]), np.array([1.2, 1.3]), np.array([0, 1])),
            "does not follow the one that ends at 1.2",
        ),
        (Marks(np.array([1.2]), np.array([1.1]), np.array([0])), "does not follow"),
        (Marks(np.array([9.1]), np.array([9.2]), np.array([0])), "outside of the samples: 1"),
    ],
)
def test_marks_that_cannot_be_are_refused(marks: Marks | None, sentence: str) -> None:
    waveform = replace(_waveform(_marks(0.3), 0.3), marks=marks)
    with pytest.raises(InputError, match=sentence):
        received(waveform, _still(1.4), _site())


def test_a_long_burst_is_taken_in_pieces() -> None:
    marks = Marks(np.array([1.0]), np.array([3.5]), np.array([1]))
    result, _ = received(_waveform(marks, 2.6), _still(3.7), _site())
    assert result.window.tolist() == pytest.approx([1.0, 1.0, 0.5])


def _table(path: Path, **columns: list[float | None]) -> None:
    pa.parquet.write_table(pa.table(columns), path)


def test_a_log_keeps_its_marks(tmp_path: Path) -> None:
    log = example_log()
    assert log.waveform is not None
    at = log.waveform.time
    marks = Marks(at[[10, 30]], at[[20, 45]], np.array([0, SILENT]))
    write_log(replace(log, waveform=replace(log.waveform, marks=marks)), tmp_path / "log")
    again = read_log(tmp_path / "log").waveform
    assert again is not None
    assert again.marks is not None
    assert np.allclose(again.marks.begin, marks.begin, rtol=0.0, atol=1e-9)
    assert again.marks.slot.tolist() == [0, SILENT]
    part = read_log(tmp_path / "log", start=float(at[25])).waveform
    assert part is not None
    assert part.marks is not None
    assert part.marks.slot.tolist() == [SILENT]


@pytest.mark.parametrize(
    ("rows", "sentence"),
    [
        (([10, 20], [25, 30], [0, 1]), "row 1 .*before the burst of the row above has ended"),
        (([10, 20], [15, 20], [0, 1]), "end_ns, row 1 .*after the row's time_ns"),
        (([10, 20], [15, 25], [0, -3]), "slot, row 1 .*number of a coil's slot"),
        (([10, 20], [15, 25], [0, None]), "slot, row 1 .*no value"),
    ],
)
def test_tables_of_marks_that_cannot_be_are_refused(
    tmp_path: Path, rows: tuple[list[int | None], ...], sentence: str
) -> None:
    log = example_log()
    write_log(log, tmp_path / "log")
    time, end = ([1000 * t + log.epoch_ns for t in stamps if t is not None] for stamps in rows[:2])
    _table(tmp_path / "log" / "marks.parquet", time_ns=time, end_ns=end, slot=rows[2])
    with pytest.raises(InputError, match=sentence):
        read_log(tmp_path / "log")


def test_slots_beside_samples_are_read_and_refused(tmp_path: Path) -> None:
    log = example_log()
    write_log(log, tmp_path / "log")
    path = tmp_path / "log" / "magnetometer.parquet"
    table = pa.parquet.read_table(path)
    slot: list[float | None] = [None, None, *[0] * 50, *[-1] * 50, *[2] * (len(table) - 102)]
    pa.parquet.write_table(table.append_column("slot", pa.array(slot, pa.int64())), path)
    result = read_log(tmp_path / "log").waveform
    assert result is not None
    assert result.marks is not None
    assert result.marks.slot.tolist() == [0, SILENT, 2]
    slot[7] = 1.5
    pa.parquet.write_table(table.append_column("slot", pa.array(slot, pa.float64())), path)
    with pytest.raises(InputError, match=r"column slot, row 7 .*1.5; write the number"):
        read_log(tmp_path / "log")
    _table(tmp_path / "log" / "marks.parquet", time_ns=[1], end_ns=[2], slot=[0])
    with pytest.raises(InputError, match="keep one of them"):
        read_log(tmp_path / "log")


def test_a_site_says_that_its_slots_are_marked(tmp_path: Path) -> None:
    save_site(_site(), tmp_path / "site.yaml")
    assert "slots: marked" in (tmp_path / "site.yaml").read_text()
    assert load_site(tmp_path / "site.yaml").beacons[0].slots == MarkedSlots()


@pytest.mark.parametrize(
    ("old", "new", "sentence"),
    [
        ("slots: marked", "slots: by hand", r"slots: found 'by hand'; write \{duration_s, count\}"),
        ("slot: 1", "slot: null", r"coils\[1\].slot: found None; give the number in the marks"),
        ("slots: marked", "slots: {count: 4}", r"slots.duration_s: is missing"),
    ],
)
def test_a_site_of_marked_slots_is_checked(
    tmp_path: Path, old: str, new: str, sentence: str
) -> None:
    path = tmp_path / "site.yaml"
    save_site(_site(), path)
    path.write_text(path.read_text().replace(old, new))
    with pytest.raises(InputError, match=sentence):
        load_site(path)


def test_pulses_have_their_coils_sign(tmp_path: Path) -> None:
    save_site(_site(0.0, synchronised=False), tmp_path / "site.yaml")
    with pytest.raises(InputError, match="synchronised: found False; write true: marks give"):
        load_site(tmp_path / "site.yaml")


@pytest.mark.parametrize(
    ("record", "sentence"),
    [
        ({"marks": {"start": [1, 2], "end": [2], "slot": [0, 1]}}, "end has 1 rows for 2 times"),
        ({"marks": {"start": 1, "end": 2, "slot": None}}, "should have a slot"),
        ({"marks": {"start": 1, "end": float("nan"), "slot": 0}}, "a time in seconds"),
        ({"magnetometer": {"time": 1, "field": [0, 0, 1], "slot": 0.5}}, "null, -1 where no coil"),
    ],
)
def test_records_of_marks_are_checked(record: dict[str, object], sentence: str) -> None:
    with pytest.raises(ValidationError, match=sentence):
        Record.model_validate(record)


def test_a_foreign_table_brings_the_slot_beside_its_samples(tmp_path: Path) -> None:
    reported = ["0", "", "1", "-1", "2"]
    rows = [f"{0.01 * k:.2f},1e-5,2e-5,{4e-5 + 1e-9 * k:.9f},{reported[k // 8]}" for k in range(40)]
    (tmp_path / "mag.csv").write_text("\n".join(["t,bx,by,bz,mux", *rows]) + "\n")
    findings = ("magnetometer.time=t[s]", "magnetometer.field=bx,by,bz[T]", "magnetometer.slot=mux")
    settings = ImportSettings(magnetometer=tmp_path / "mag.csv", map=findings)
    run_import(settings, tmp_path / "log")
    result = read_log(tmp_path / "log").waveform
    assert result is not None
    assert result.marks is not None
    assert result.marks.slot.tolist() == [0, 1, SILENT, 2]
    assert len(result) == 40


def test_what_hum_leaves_of_pulses_is_in_their_covariance() -> None:
    marks = _marks(1.0)
    waveform = _waveform(marks, 1.0, 0.0)
    rng = np.random.default_rng(17)
    # A line that nobody foretells: its phase walks within a few cycles.
    phase = 2.0 * np.pi * 170.0 * waveform.time
    phase += np.cumsum(0.05 * rng.standard_normal(len(phase)))
    line = 2e-8 * np.cos(phase)[:, None] * [0.6, 0.0, 0.8]
    for others in (0.0, 1.0):
        wave = replace(waveform, measured_sensor=waveform.measured_sensor + others * line)
        result, _ = received(wave, _still(2.0), _site(0.0))
        channel, rows = np.argmax(result.valid, axis=1), np.arange(len(result))
        error = (result.phasor_sensor[rows, channel] - COUPLING[channel]).real
        cov = result.phasor_cov[rows, channel]
        nees = np.einsum("ni,nij,nj->n", error, np.linalg.inv(cov), error)
        assert 1.5 < np.mean(nees) < 6.0
