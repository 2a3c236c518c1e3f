"""Beacons that change between logs are named with their dates; without a change, nothing is."""

from dataclasses import replace

import numpy as np
import pytest

from magfusion.estimation.batch.batch import SmootherSettings
from magfusion.estimation.batch.calendar import (
    Calendar,
    LogBlocks,
    PlatformCalibration,
    SiteChange,
    names_of,
)
from magfusion.estimation.batch.change_between_logs import find_changes, period_tests
from magfusion.estimation.batch.joint import (
    LogInformation,
    apart_in_sigmas,
    known_by,
    total_information,
)
from magfusion.estimation.posterior.marginalized_log import MarginalizedLog
from magfusion.jobs.joint_calendar import describe_change
from magfusion.jobs.joint_tasks import considered_of, shared_of, together_settings
from magfusion.model.parameters import dimension, prior_sigma
from magfusion.model.site import BeaconSigma
from magfusion.simulation.demo_site import demo_site
from magfusion.units import DEGREE, Array

SETTINGS = together_settings(SmootherSettings(tune=False))
DAY = 86400.0  # s
BEGIN = 1.7e9  # s, Unix
LOGS = 24
PLATFORMS = 2


def platform() -> PlatformCalibration:
    """Return the demo's site, roughly surveyed."""
    plain = replace(demo_site(coil_radius=None), model_error=1e-4)
    sigma = BeaconSigma(np.full(3, 0.02), np.full(3, 1.0 * DEGREE), np.full(2, 0.01))
    site = replace(plain, beacons=tuple(replace(b, sigma=sigma) for b in plain.beacons))
    return PlatformCalibration(shared_of(site, SETTINGS), considered_of(site, SETTINGS))


def block_of(calendar: Calendar, name: str) -> slice:
    return next(b.columns for b in calendar.shared.blocks if b.name == name)


class Year:
    """Quadratic logs of two platforms: each determines some directions of what is shared."""

    def __init__(self, true: Calendar, seed: int, detected: str = "ABCD") -> None:
        rng = np.random.default_rng(seed)
        scale = prior_sigma(true.shared.blocks)
        self.truth = rng.standard_normal(len(scale)) * np.minimum(scale, 0.02)
        self.logs: list[LogBlocks] = []
        self.information: list[LogInformation] = []
        self.true = true
        for i in range(LOGS):
            own = true.platforms[i % PLATFORMS]
            blocks = [b for b in own.shared.blocks if len(b.owner) > 1 or b.owner in detected]
            log = LogBlocks(
                BEGIN + 10.0 * DAY * i, i % PLATFORMS, names_of(blocks), names_of(own.considered)
            )
            self.logs.append(log)
            self.information.append(self.drawn(log, rng))

    def drawn(self, log: LogBlocks, rng: np.random.Generator) -> LogInformation:
        columns, common = self.true.columns(log)
        unit = prior_sigma(self.true.platforms[0].shared.blocks)
        size = len(columns)
        rows = rng.standard_normal((size - 6, size)) / unit[:size]  # six unknown directions
        information = rows.T @ rows
        gradient = rows.T @ rng.standard_normal(size - 6)
        none = np.zeros((size, size))
        part = MarginalizedLog(information, gradient, np.zeros((size, len(common))), none, none)
        return LogInformation(self.truth[columns], part)

    def load(self, i: int) -> LogInformation:
        return self.information[i]


def start(calendar: Calendar) -> Array:
    return np.zeros(dimension(calendar.shared.blocks))


def calendar_of(*changes: SiteChange) -> Calendar:
    return Calendar((platform(),) * PLATFORMS, changes)


def test_nothing_is_named_where_nothing_changed() -> None:
    plain = calendar_of()
    for seed in range(3):
        year = Year(plain, seed)
        assert find_changes(plain, year.logs, year.load, start) == []


def test_a_moved_and_an_exchanged_beacon_and_a_sensor_are_named_with_their_dates() -> None:
    after = [BEGIN + 10.0 * DAY * (k - 0.5) for k in (9, 15, 18)]
    changes = (
        SiteChange("B", after[0]),
        SiteChange("D", after[1]),
        SiteChange("magnetometer", after[2], 1),
    )
    true = calendar_of(*changes)
    year = Year(true, 3)
    for old, new, size in (
        ("B.position", changes[0].name + ".position", 0.15),
        ("D.log_moment", changes[1].name + ".log_moment", 0.08),
        ("magnetometer of platform 2.matrix", changes[2].name + ".matrix", 0.01),
    ):
        year.truth[block_of(true, new)] = year.truth[block_of(true, old)] + size
    for change, kinds in zip(
        changes, (("rotation", "log_moment"), ("rotation", "position"), ()), strict=True
    ):
        before = change.owner if change.platform < 1 else f"{change.owner} of platform 2"
        for kind in kinds:
            year.truth[block_of(true, f"{change.name}.{kind}")] = year.truth[
                block_of(true, f"{before}.{kind}")
            ]
    rng = np.random.default_rng(8)
    year.information = [year.drawn(log, rng) for log in year.logs]
    plain = calendar_of()
    found = find_changes(plain, year.logs, year.load, start)
    assert {(one.change.owner, one.change.platform) for one in found} == {
        ("B", -1),
        ("D", -1),
        ("magnetometer", 1),
    }
    by_owner = {one.change.owner: one for one in found}
    for change in changes:
        first, last = by_owner[change.owner].between
        assert first <= change.time <= last
        assert last - first <= 40.0 * DAY
    calendar = calendar_of(*(one.change for one in found))
    at = start(calendar)
    every = [calendar.whole(one, log) for one, log in zip(year.information, year.logs, strict=True)]
    known = known_by(calendar.shared, total_information(calendar.shared, every, at), at)
    causes = {one.change.owner: describe_change(one, calendar, known).cause for one in found}
    assert causes == {"B": "moved", "D": "exchanged", "magnetometer": "changed"}
    report = describe_change(by_owner["B"], calendar, known)
    assert report.row["moved_m"] == pytest.approx(0.15 * np.sqrt(3.0), abs=0.02)  # m
    assert "B was moved between 2024-" in report.finding.text
    now = known.of(*calendar.columns(calendar.on(1, np.inf)))
    truth = year.truth[true.columns(true.on(1, np.inf))[0]]
    assert 0.6 < apart_in_sigmas(now.step, truth, now.honest) < 1.5


def test_a_month_differs_from_the_others_by_what_changed_in_it() -> None:
    plain = calendar_of()
    year = Year(plain, 5)
    shift = block_of(plain, "C.position")
    rng = np.random.default_rng(6)
    for i in range(6, 9):
        truth, year.truth = year.truth, year.truth.copy()
        year.truth[shift] += 0.05  # m
        year.information[i] = year.drawn(year.logs[i], rng)
        year.truth = truth
    tests = period_tests(plain, year.logs, year.load, start(plain), [i // 3 for i in range(LOGS)])
    (third,) = (one for one in tests[2] if one.owner == "C")
    assert third.chi_square > 50.0 > 5.0 * third.freedom
    assert third.logs == 3
    kinds = [b for b in plain.shared.blocks if b.owner == "C"]
    offset = sum(len(b.sigma) for b in kinds[: [b.kind for b in kinds].index("position")])
    np.testing.assert_allclose(third.difference[offset : offset + 3], 0.05, atol=0.02)  # m
    quiet = [one for one in tests[0] if one.owner == "A"]
    assert quiet[0].chi_square < 5.0 * quiet[0].freedom


def test_logs_that_detect_different_beacons_are_added() -> None:
    """Of many beacons each log has parameters of those that it detects only."""
    plain = calendar_of()
    some, all_ = Year(plain, 7, detected="AB"), Year(plain, 7)
    whole = plain.whole(some.information[0], some.logs[0])
    undetected = block_of(plain, "C.position")
    assert not np.any(whole.part.information[undetected])
    assert np.any(plain.whole(all_.information[0], all_.logs[0]).part.information[undetected])
    at = start(plain)
    known = known_by(plain.shared, whole.taken_at(plain.shared, at), at)
    sigma = np.sqrt(np.diagonal(known.cov))
    np.testing.assert_allclose(sigma[undetected], prior_sigma(plain.shared.blocks)[undetected])
