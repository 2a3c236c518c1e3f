"""The questions of ``magfusion init``, on a terminal: each answer is validated at once."""

from collections.abc import Callable, Iterable
from dataclasses import replace
from pathlib import Path
from typing import TypeVar

from rich.console import Console
from rich.prompt import Prompt

from magfusion.errors import InputError
from magfusion.estimation.data_checks.tones import Tone
from magfusion.files.instruments import UNNAMED, named_imu, named_magnetometer
from magfusion.files.site_draft import beacon_draft, numbers, place_of
from magfusion.jobs.init_settings import InitSettings

Answer = TypeVar("Answer")
_SCREEN = Console(stderr=True, highlight=False, emoji=False)


def recording() -> Path | None:
    """Prompt for a recording."""
    _SCREEN.print("An empty answer skips the question, or uses the default in brackets.")

    def there(text: str) -> Path | None:
        if not text:
            return None
        path = Path(text).expanduser()
        if not path.exists():
            raise InputError(f"{path}: there is no such file or directory")
        return path

    return _prompt("A log with the beacons switched on, to find their tones in", there)


def answered(settings: InitSettings, tones: Iterable[Tone]) -> InitSettings:
    """Prompt for all values of a site.

    `tones`: of the recording; the name of each is a question.
    """
    detected = list(tones)
    beacons: list[str] = []
    for tone in detected:
        coils = "two coils" if tone.rotating else "one coil"
        _SCREEN.print(
            f"{tone.meant_hz:g} Hz, {coils}, {1e9 * tone.amplitude:.3g} nT:", style="bold"
        )
        beacons += _beacon(beacons, tone)
    while not detected and (more := _beacon(beacons, None)):
        beacons += more
    imu = _prompt("IMU (--list-imus lists them)", lambda text: named_imu(text).name, UNNAMED)
    magnetometer = _prompt(
        "Magnetometer (--list-magnetometers)", lambda text: named_magnetometer(text).name, UNNAMED
    )
    return replace(
        settings,
        beacon=tuple(beacons),
        imu=imu,
        magnetometer=magnetometer,
        lever=_prompt("Magnetometer from the IMU, in its axes: x,y,z in m", _vector),
        mounting=_prompt("Magnetometer against the IMU: roll,pitch,yaw in degrees", _vector),
        location=_prompt("Latitude,longitude,height,date, for gravity and heading", _place),
    )


def _beacon(before: list[str], tone: Tone | None) -> list[str]:
    """Return a beacon from an option; None if there are no more, or a line is no beacon."""
    selected = {text.split()[0] for text in before}
    free_parameters = next((c for c in "ABCDEFGHIJKLMNOPQRSTUVWXYZ" if c not in selected), "")

    def new(text: str) -> str:
        if text in selected:
            raise InputError(f"{text} is already described; give another name")
        if text:
            beacon_draft(text)
        return text

    if tone is None:
        name = _prompt(f"Name of {'the first' if not before else 'another'} beacon", new)
    else:
        name = _prompt("  Name (- if it is no beacon of yours)", new, free_parameters)
        name = "" if name == "-" else name
    if not name:
        return []
    words = name
    if tone is None:
        words += _key(words, "frequency_hz", "  Frequency in Hz", needed=True)
    else:
        words += f" frequency_hz={tone.meant_hz!r}"
    usual = "" if tone is None else ("xy" if tone.rotating else "x")
    words += _key(words, "axes", "  Axes of its coils: x, xy (rotating)", usual or "xy")
    words += _key(words, "moment_a_m2", "  Peak moment of each coil, in A m^2")
    words += _key(words, "position_m", "  Position: x,y,z in m")
    words += _key(words, "rpy_deg", "  Attitude: roll,pitch,yaw in degrees")
    words += _key(words, "synchronised", "  Does its drive keep to the log's clock", "no")
    return [words]


def _key(words: str, key: str, question: str, usual: str = "", needed: bool = False) -> str:
    def read(text: str) -> str:
        if not text and needed:
            raise InputError("it is required here; or give a recording")
        findings = f" {key}={text.replace(' ', '')}" if text else ""
        beacon_draft(words + findings)
        return findings

    return _prompt(question, read, usual)


def _vector(text: str) -> str | None:
    if text:
        numbers("here", text.replace(" ", ""), (3,))
    return text.replace(" ", "") or None


def _place(text: str) -> str | None:
    if text:
        place_of(text)
    return text or None


def _prompt(question: str, read: Callable[[str], Answer], usual: str = "") -> Answer:
    """Prompt until the answer is valid."""
    shown = f"{question} \\[{usual}]" if usual else question
    while True:
        try:
            text = Prompt.ask(shown, console=_SCREEN, default=usual, show_default=False)
        except EOFError:
            raise InputError(
                "the answers ended before the last question; answer all questions"
            ) from None
        try:
            return read(text.strip())
        except InputError as error:
            _SCREEN.print(f"  {error}", style="red", markup=False)
