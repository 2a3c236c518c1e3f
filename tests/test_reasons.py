"""Reasons of a report: one of each code, each sentence once, with every remedy."""

from typing import Any

from magfusion.model.trust import Finding, Trust
from magfusion.results.verdict import MAX_TEXTS, trust_figures


def reasons(*findings: Finding) -> list[Any]:
    rows = trust_figures(Trust(findings))["reasons"]
    assert isinstance(rows, list)
    return rows


def test_a_sentence_of_two_checks_stands_once() -> None:
    (row,) = reasons(Finding("gap", "A gap."), Finding("gap", "A gap."))
    assert row["text"] == "A gap."


def test_the_remedies_of_one_code_are_one() -> None:
    gyro = Finding("imu_noise", "Gyro.", weight=2.0, remedy={"platform.imu.gyro_noise": 1e-3})
    accel = Finding("imu_noise", "Accel.", remedy={"platform.imu.accel_noise": 1e-2})
    (row,) = reasons(accel, gyro)
    assert row["text"] == "Gyro. Accel."
    assert row["remedy"] == {"platform.imu.gyro_noise": 1e-3, "platform.imu.accel_noise": 1e-2}


def test_of_two_values_that_of_the_more_important_finding_is_the_remedy() -> None:
    (row,) = reasons(
        Finding("gravity", "A.", weight=1.0, remedy={"world.gravity_m_s2": 9.7}),
        Finding("gravity", "B.", weight=5.0, remedy={"world.gravity_m_s2": 9.8}),
    )
    assert row["remedy"] == {"world.gravity_m_s2": 9.8}


def test_more_sentences_than_a_reader_reads_are_counted() -> None:
    (row,) = reasons(*(Finding("gap", f"Gap {k}.") for k in range(MAX_TEXTS + 2)))
    assert row["text"].count("Gap") == MAX_TEXTS
    assert row["text"].endswith("2 more of this kind.")


def test_what_they_explain_is_one_list() -> None:
    (row,) = reasons(
        Finding("body_iron", "A.", explained=("gyro_field",)),
        Finding("body_iron", "B.", explained=("gyro_field", "earth_field")),
    )
    assert row["explains"] == ["gyro_field", "earth_field"]
    assert "remedy" not in row
