"""The job that writes a site file: from options, a recording's tones, or questions."""

import sys
import tempfile
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

from rich.console import Console
from rich.table import Table

from magfusion.errors import InputError
from magfusion.estimation.data_checks.data_cleaning import clean_log
from magfusion.estimation.data_checks.tones import Tone, Transmitted, transmitted
from magfusion.files.atomic import whole_file
from magfusion.files.instruments import UNNAMED, imus, magnetometers, named_imu, named_magnetometer
from magfusion.files.open import open_log
from magfusion.files.site import load_site
from magfusion.files.site_draft import BeaconDraft, beacon_draft, numbers, place_of
from magfusion.files.site_text import SiteDraft, site_text, to_do
from magfusion.jobs.init_questions import answered, recording
from magfusion.jobs.init_settings import InitSettings
from magfusion.jobs.settings import Command
from magfusion.model.physics.earth import gravity
from magfusion.model.site import Site
from magfusion.model.trust import Finding, Trust
from magfusion.results.figures import Figure, Figures, Section, heading
from magfusion.results.verdict import trust_figures

NEAR_HZ = 0.5  # of a declared frequency, a line is that beacon


def run_init(settings: InitSettings, output: Path) -> Figures | None:
    """Write a commented site file, in which undeclared values are marked.

    `output`: file to write; an existing file is not overwritten.
    """
    if settings.list_imus or settings.list_magnetometers:
        _list(settings)
        return None
    if output.exists() or output.is_symlink():
        raise InputError(f"{output}: already exists; give another file with -o, or remove it")
    settings, mounted = _mounted(settings)
    transmitted = _detect_transmitters(settings)
    settings, transmitted = _complete_settings(settings, transmitted)
    draft, findings = _draft(settings, transmitted)
    _write(site_text(draft), output)
    findings += [Finding("assumed", f"{sentence}.") for sentence in to_do(draft)]
    return (
        heading("init", output.name)
        | trust_figures(Trust(tuple(findings)))
        | mounted
        | _figures(draft, transmitted)
    )


def _mounted(settings: InitSettings) -> tuple[InitSettings, Figures]:
    """Return lever arm and mounting from the transforms of a bag, and their chain of frames."""
    if settings.bag is None:
        return settings, Figures()
    from magfusion.files.foreign.bag_extrinsics import read_extrinsics
    from magfusion.jobs.inputs import topics_option

    result = read_extrinsics(settings.bag, topics_option(settings.topics))
    # Rounded: composing a chain makes 89.99999999 of 90 degrees.
    place, angles = result.position_body, result.body_from_sensor.as_euler("xyz", degrees=True)
    lever, mounting = (
        ",".join(f"{v + 0.0:.6f}" for v in three.round(6)) for three in (place, angles)
    )
    settings = replace(
        settings, lever=settings.lever or lever, mounting=settings.mounting or mounting
    )
    figures = (
        ("frames", result.chain),
        ("lever_m", settings.lever),
        ("mounting_deg", settings.mounting),
    )
    return settings, Figures(*(Figure(name, value) for name, value in figures))


def _detect_transmitters(settings: InitSettings) -> Transmitted | None:
    """Return the transmitters in the recording, if there is one."""
    if settings.log is None:
        return None
    from magfusion.jobs.inputs import topics_option

    log = open_log(settings.log, topics=topics_option(settings.topics))
    if log.waveform is None:
        raise InputError(
            f"{settings.log}: has no magnetometer samples to find tones in; omit --log, and give"
            " frequency_hz with each --beacon"
        )
    site = _bare_site(settings)
    result = transmitted(clean_log(log, site), site if settings.mounting is not None else None)
    if result is None:
        raise InputError(
            f"{settings.log}: is too short for a spectrum; record at least ten seconds, or omit"
            " --log"
        )
    return result


def _complete_settings(
    settings: InitSettings, transmitted: Transmitted | None
) -> tuple[InitSettings, Transmitted | None]:
    """Prompt for undeclared values on a terminal."""
    if settings.described:
        return settings, transmitted
    if sys.stdin is not None and sys.stdin.isatty():
        if settings.log is None:
            settings = replace(settings, log=recording())
            transmitted = _detect_transmitters(settings)
        return answered(settings, () if transmitted is None else transmitted.tones), transmitted
    if transmitted is None:
        raise InputError(
            "no description given; give --beacon, --log or --imu (see magfusion init --help), or"
            " run it on a terminal for questions"
        )
    return settings, transmitted


def _draft(
    settings: InitSettings, transmitted: Transmitted | None
) -> tuple[SiteDraft, list[Finding]]:
    beacons = [beacon_draft(text) for text in settings.beacon]
    names = [beacon.name for beacon in beacons]
    for name in names:
        if names.count(name) > 1:
            raise InputError(f"--beacon {name}: is given twice; use unique names")
    beacons, findings = _with_tones(beacons, transmitted)
    place = None if settings.location is None else place_of(settings.location)
    lever, mounting = settings.lever, settings.mounting
    return SiteDraft(
        tuple(beacons),
        named_imu(settings.imu or UNNAMED),
        named_magnetometer(settings.magnetometer or UNNAMED),
        place,
        None if place is None else round(gravity(place.latitude_deg, place.height_m), 4),
        None if lever is None else numbers("--lever", lever, (3,)),
        None if mounting is None else numbers("--mounting", mounting, (3,)),
    ), findings


def _with_tones(
    beacons: list[BeaconDraft], transmitted: Transmitted | None
) -> tuple[list[BeaconDraft], list[Finding]]:
    """Return the beacons with the tones of the recording, and findings on their consistency."""
    silent = [beacon.name for beacon in beacons if beacon.frequency_hz is None]
    if transmitted is None:
        if silent:
            raise InputError(
                f"--beacon {silent[0]}: frequency_hz is missing; give it in Hz, or a recording with"
                " --log, in which to find it"
            )
        return beacons, []
    free_slots = _free_tones(beacons, transmitted.tones)
    findings = _switched_off(beacons, transmitted.tones, free_slots)
    if len(silent) > 1 or (silent and len(free_slots) != 1):
        raise InputError(
            f"--beacon {silent[0]}: frequency_hz is missing, and the recording does not determine"
            f" it (significant: {_listed(free_slots) or 'no other tone'}); give frequency_hz"
        )
    if not beacons and not transmitted.tones:
        others = f" (other lines: {'; '.join(transmitted.others)})" if transmitted.others else ""
        text = f"The recording has no significant tone{others}: the site has no beacons."
        return [], [*findings, Finding("assumed", text)]
    if not beacons:
        tones = zip(_names(), transmitted.tones, strict=False)
        return [_of_tone(BeaconDraft(name), tone) for name, tone in tones], findings
    if silent:
        return [
            _of_tone(b, free_slots[0]) if b.frequency_hz is None else b for b in beacons
        ], findings
    return beacons, findings + _undeclared(free_slots)


def _near(tone: Tone, frequencies_hz: Iterable[float]) -> bool:
    """Return whether a tone is at one of some frequencies."""
    return any(abs(tone.frequency_hz - f) <= NEAR_HZ for f in frequencies_hz)


def _free_tones(beacons: list[BeaconDraft], tones: Iterable[Tone]) -> list[Tone]:
    """Return the tones that are at no beacon's frequency."""
    declared = [f for beacon in beacons for f in beacon.frequency_hz or ()]
    return [tone for tone in tones if not _near(tone, declared)]


def _switched_off(
    beacons: list[BeaconDraft], tones: Iterable[Tone], free_slots: list[Tone]
) -> list[Finding]:
    """Return which frequencies of beacons are not in a recording, and the other tones."""
    return [
        Finding(
            "silent_beacon",
            f"beacon {beacon.name} is not detected at {f:g} Hz in the recording: it is switched"
            " off, far away, or has another frequency"
            f" ({_listed(free_slots) or 'no other tone is significant'}).",
        )
        for beacon in beacons
        for f in beacon.frequency_hz or ()
        if not any(_near(tone, (f,)) for tone in tones)
    ]


def _undeclared(tones: Iterable[Tone]) -> list[Finding]:
    """Return findings on tones of a recording that belong to no beacon."""
    return [
        Finding(
            "undeclared_line",
            f"{_listed([tone])} transmits in the recording, and no --beacon has this frequency.",
        )
        for tone in tones
    ]


def _names() -> list[str]:
    letters = "ABCDEFGHIJKLMNOPQRSTUVWXYZ"
    return [*letters, *(first + second for first in letters for second in letters)]


def _of_tone(beacon: BeaconDraft, tone: Tone) -> BeaconDraft:
    axes = beacon.axes or ("xy" if tone.rotating else "x")
    return replace(beacon, frequency_hz=(tone.meant_hz,), axes=axes)


def _listed(tones: list[Tone]) -> str:
    return ", ".join(
        f"{tone.meant_hz:g} Hz ({1e9 * tone.amplitude:.3g} nT,"
        f" {'two coils' if tone.rotating else 'one coil'})"
        for tone in tones
    )


def _bare_site(settings: InitSettings) -> Site:
    """Return the platform alone: how magnetometer and gyroscope are mounted."""
    draft, _ = _draft(replace(settings, beacon=()), None)
    with tempfile.TemporaryDirectory() as directory:
        path = Path(directory) / "site.yaml"
        path.write_text(site_text(replace(draft, place=None)), encoding="utf-8")
        return load_site(path, without=True)


def _write(text: str, output: Path) -> None:
    """Write a site file after validation."""
    with whole_file(output) as unfinished:
        unfinished.write_text(text, encoding="utf-8")
        try:
            load_site(unfinished, unknown=True, without=True)
        except InputError as error:
            findings = str(error).replace(f"{unfinished}: ", "")
            raise InputError(f"the description is not a valid site: {findings}") from error


def _figures(draft: SiteDraft, transmitted: Transmitted | None) -> Figures:
    figures = Figures(
        Figure("beacons", len(draft.beacons)),
        Figure("imu", draft.imu.name),
        Figure("magnetometer", draft.magnetometer.name),
    )
    for beacon in draft.beacons:
        assert beacon.frequency_hz is not None
        figures |= Figures(
            Figure("frequency_{beacon}_hz", beacon.frequency_hz[0], "Hz", beacon=beacon.name)
        )
    if transmitted is not None:
        result = [
            f"{tone.frequency_hz:.5f} ± {tone.sigma_hz:.5f} Hz, {1e9 * tone.amplitude:.3g} nT,"
            f" axes 1:{1.0 / max(tone.roundness, 1e-3):.3g}"
            for tone in transmitted.tones
        ]
        figures |= Figures(
            Figure("tones", result, label="tones in the recording"),
            Figure("other_lines", list(transmitted.others), section=Section.REPORT),
        )
    return figures


def _list(settings: InitSettings) -> None:
    """Print the instruments that are known by name."""
    console = Console(highlight=False, emoji=False)
    if settings.list_imus:
        table = Table("IMU", "gyro", "accel", "gyro walk", "accel walk", "source", box=None)
        for name, sheet in imus().items():
            imu = sheet.model
            densities = (imu.gyro_noise, imu.accel_noise, imu.gyro_bias_walk, imu.accel_bias_walk)
            table.add_row(name, *(f"{value:.3g}" for value in densities), sheet.source)
        console.print(table)
        console.print(
            "gyro rad/s/sqrt(Hz), accel m/s^2/sqrt(Hz), walks per sqrt(s); magfusion allan LOG"
            " measures yours"
        )
    if settings.list_magnetometers:
        table = Table("magnetometer", "nT/sqrt(Hz)", "source", box=None)
        for name, one in magnetometers().items():
            table.add_row(name, f"{1e9 * one.noise_density:.3g}", one.source)
        console.print(table)


COMMAND = Command(
    InitSettings,
    run_init,
    output="site.yaml",
    output_file="File to write; an existing file is not overwritten",
    example="magfusion init --imu BMI088 --magnetometer RM3100 --beacon 'A position_m=0,0,1"
    " rpy_deg=0,0,90 frequency_hz=25 moment_a_m2=220 axes=xy' -o new_site.yaml",
)
