"""The page beside every result: whole, self-contained, the verdict first, nothing of it code."""

import json
import re
import shutil
import subprocess
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
from conftest import run_command
from matplotlib.image import imread
from scipy.spatial.transform import Rotation

from magfusion.cli import main
from magfusion.errors import EstimationError
from magfusion.jobs.coverage import CoverageSettings
from magfusion.jobs.settings import Command
from magfusion.model.site import Site
from magfusion.model.trajectory import Trajectory
from magfusion.model.trust import Finding, StateTrust, Trust, Unverified, Verdict
from magfusion.results.errors import trajectory_errors
from magfusion.results.figures import Figure, Figures, ParameterEstimate, heading
from magfusion.results.page import PAGE
from magfusion.results.page_motion import MotionPage
from magfusion.results.plots.chart import Chart, ChartBand, ChartLine, svg, thinned, ticks
from magfusion.results.provenance import Run, recorded_as
from magfusion.results.report import FAILED, dropped_figures, write_report
from magfusion.results.verdict import trust_figures
from magfusion.simulation.demo_site import demo_site

EVIL = '<script>alert("x")</script>'
N = 400
ABC = "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad"  # FIPS 180-4
VOID = {"meta", "img", "path", "circle", "br"}
MAX_BYTES = 5_000_000  # bytes
TRUST = Trust(
    (
        Finding("beacon_fault", f"The field of beacon {EVIL} is false.", Verdict.DOUBTFUL),
        Finding("gap", "The IMU has a gap.", Verdict.TRUSTWORTHY),
    ),
    (Unverified("sensor.position", "0.1 cm", 0.002, 0.01),),
)


class Page(HTMLParser):
    """What a browser would make of a page, as far as it is judged here."""

    def __init__(self, path: Path) -> None:
        super().__init__()
        self.source = path.read_text(encoding="utf-8")
        self.open: list[str] = []
        self.tags: list[str] = []
        self.addresses: list[str] = []
        self.words: list[str] = []
        self.feed(self.source)
        self.close()
        assert not self.open

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        self.addresses += [v or "" for k, v in attrs if k in ("src", "href", "xlink:href")]
        assert not [k for k, _ in attrs if k.startswith("on")]
        if tag not in VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:  # noqa: ARG002
        self.tags.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        if self.open and self.open[-1] != "style":
            self.words.append(data)

    @property
    def text(self) -> str:
        return " ".join(" ".join(self.words).split())

    def check(self) -> None:
        """Hold it to what every page must keep to."""
        assert len(self.source.encode()) < MAX_BYTES
        assert all(address.startswith("data:image/png;base64,") for address in self.addresses)
        assert not {"script", "link", "iframe", "object"} & set(self.tags)
        assert not re.search(r"(?i)https?:|@import|url\(", self.source)


def _site() -> Site:
    site = demo_site()
    first, *others = site.beacons
    return replace(site, beacons=(replace(first, name=EVIL), *others))


def _motion(truth: bool = True) -> MotionPage:
    rng = np.random.default_rng(3)
    time = np.linspace(0.0, 80.0, N)
    true = Trajectory(
        time,
        Rotation.from_rotvec(0.02 * np.outer(time, [0, 0, 1])).as_matrix(),
        np.stack([np.cos(0.1 * time), np.sin(0.1 * time), 0.01 * time], axis=1),
    )
    cov = np.tile(np.diag([1e-3] * 3 + [2e-3] * 3) ** 2, (N, 1, 1))
    moved = true.position_world + 2e-3 * rng.standard_normal((N, 3))
    states = replace(true, position_world=moved, pose_cov=cov)
    level = np.where(np.arange(N) < 50, np.nan, 0.02)
    excluded = tuple((EVIL,) if k < 7 else () for k in range(N))
    trust = StateTrust((Verdict.DOUBTFUL,) * N, level, level, excluded)
    residuals = {EVIL: (time, np.abs(rng.standard_normal(N)))}
    errors = trajectory_errors(states, true) if truth else None
    return MotionPage(_site(), states, true if truth else None, errors, residuals, trust)


def _figures() -> Figures:
    known = {"label": "position", "sigma": 0.01, "prior_sigma": 0.05}
    shift = ParameterEstimate("{beacon}.position_x_m", 0.25, "m", EVIL, declared=-6.0, **known)
    turn = ParameterEstimate("{beacon}.rotation_x_deg", -0.1, "deg", EVIL, **known)
    return (
        heading("smooth", f"log of {EVIL}")
        | trust_figures(TRUST)
        | Figures(Figure("ate_m", 0.0123, "m"), shift, turn)
        | dropped_figures({"saturated": 17, "too short": 0})
    )


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> Page:
    place = tmp_path_factory.mktemp("result")
    (place / "log").mkdir()
    (place / "log" / "imu.csv").write_text("abc")
    run = Run("magfusion smooth 'a log'", {"tune": True}, frozenset({"tune"}), (place / "log",))
    with recorded_as(run):
        write_report(place, _figures(), _motion())
    assert json.loads((place / "report.json").read_text())["verdict"] == "doubtful"
    return Page(place / PAGE)


def test_a_page_is_well_formed_and_asks_nothing_of_the_network(page: Page) -> None:
    page.check()
    assert "svg" in page.tags


def test_what_a_user_named_is_text_and_no_code(page: Page) -> None:
    assert "<script" not in page.source
    for where in ("Beacon", "The field of beacon", "states without beacon", "log of"):
        assert f"{where} {EVIL}" in page.text


def test_the_verdict_comes_first_with_its_reasons(page: Page) -> None:
    text = page.text[page.text.index("magfusion smooth") :]
    order = [
        "DOUBTFUL",
        "beacon_fault",
        "Noticed: The IMU has a gap.",
        "Fixed, not observable",
        "sensor.position 0.1 cm 2 0.01",
        "Plan",
        "Height",
        "Errors against the truth",
        "Residuals by beacon",
        "Calibration, before and after",
        "Rejected or omitted data",
        "Command, inputs and versions",
    ]
    places = [text.index(words) for words in order]
    assert places == sorted(places)


def test_the_page_says_what_was_found_refused_and_how_it_was_run(page: Page) -> None:
    assert "-6.000 ± 0.05 -5.750 ± 0.01 +5.00 yes" in page.text  # 0.25 m of a sigma of 0.05
    assert "Δ 0 ± 0.05 Δ -0.100 ± 0.01 -2.00 yes" in page.text
    assert "windows dropped saturated 17" in page.text
    begin, end = map(page.text.index, ("Rejected or omitted data", "Command, inputs and versions"))
    refused = page.text[begin:end]
    assert "too short" not in refused
    assert f"states without beacon {EVIL}, which contradicts 7" in page.text
    assert "magfusion smooth 'a log'" in page.text
    assert f"imu.csv 3 {ABC}" in page.text
    assert "tune True given" in page.text


def test_without_truth_the_page_shows_what_is_claimed(tmp_path: Path) -> None:
    write_report(tmp_path, _figures(), _motion(truth=False))
    result = Page(tmp_path / PAGE)
    result.check()
    assert "Estimated accuracy" in result.text
    assert "protection level" in result.text
    assert "called from Python" in result.text


@pytest.mark.parametrize("states", [1, 2])
def test_a_page_of_hardly_any_states_is_written(states: int, tmp_path: Path) -> None:
    motion = _motion(truth=False)
    few = {name: part[:states] for name, part in vars(motion.states).items() if part is not None}
    write_report(tmp_path, _figures(), MotionPage(motion.site, Trajectory(**few)))
    Page(tmp_path / PAGE).check()


def test_a_direction_that_is_open_hides_nothing(tmp_path: Path) -> None:
    motion = _motion()
    assert motion.states.pose_cov is not None
    for value in (1e12, np.inf, np.nan):
        cov = motion.states.pose_cov.copy()
        cov[5, 3, 3] = value
        states = replace(motion.states, pose_cov=cov)
        assert motion.errors is not None
        errors = replace(motion.errors, pose_cov=cov)
        write_report(tmp_path, _figures(), replace(motion, states=states, errors=errors))
        result = Page(tmp_path / PAGE)
        result.check()
        assert "error (mm)" in result.text


def test_of_a_failed_job_the_page_lies_with_what_was_found(tmp_path: Path) -> None:
    (tmp_path / FAILED).mkdir()
    failed = Trust((Finding("no_solution", "There is none.", Verdict.FAILED),))
    write_report(tmp_path, heading("match", "log") | trust_figures(failed))
    assert {path.name for path in tmp_path.iterdir()} == {"report.json", FAILED}
    result = Page(tmp_path / FAILED / PAGE)
    assert "FAILED Do not use" in result.text


def test_pictures_are_inside_as_far_as_there_is_room(tmp_path: Path) -> None:
    (tmp_path / "beacon.png").write_bytes(b"\x89PNG")
    (tmp_path / "large.png").write_bytes(bytes(MAX_BYTES))
    write_report(tmp_path, _figures())
    result = Page(tmp_path / PAGE)
    result.check()
    assert result.addresses == ["data:image/png;base64,iVBORw=="]
    assert "see large.png, in the same directory" in result.text


def test_a_command_tells_its_page_how_it_was_called(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    site, output = tmp_path / "site.yaml", tmp_path / "reach"
    site.write_text("abc")
    output.mkdir()

    def run(settings: CoverageSettings, output: Path) -> Figures:
        write_report(output, heading("coverage", settings.site.name))
        return heading("coverage", settings.site.name)

    monkeypatch.setattr("magfusion.jobs.coverage.COMMAND", Command(CoverageSettings, run))
    run_command("coverage", site, "-o", output, "--height", 1)
    result = Page(output / PAGE)
    result.check()
    assert f"magfusion coverage {site} -o {output} --height 1" in result.text
    assert f"{site} 3 {ABC}" in result.text
    assert "height 1.0 given" in result.text
    assert "spacing default" in result.text


def test_a_command_that_fails_tells_it_too(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def run(settings: CoverageSettings, output: Path) -> Figures:
        raise EstimationError(f"{settings.site}: there is none in {output}")

    monkeypatch.setattr("magfusion.jobs.coverage.COMMAND", Command(CoverageSettings, run))
    (tmp_path / "site.yaml").write_text("abc")
    with pytest.raises(SystemExit) as ended:
        main(["coverage", str(tmp_path / "site.yaml"), "-o", str(tmp_path / "reach")])
    assert ended.value.code == 1
    assert "there is none" in capsys.readouterr().err
    result = Page(tmp_path / "reach" / FAILED / PAGE)
    assert f"magfusion coverage {tmp_path / 'site.yaml'}" in result.text
    assert "there is none" in result.text


CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "chrome"))), "")


@pytest.mark.slow
@pytest.mark.skipif(not CHROMIUM, reason="no chromium is installed")
def test_a_browser_shows_the_verdict_the_charts_and_nothing_beside_the_page(
    page: Page, tmp_path: Path
) -> None:
    width, height = 1120, 2400
    (tmp_path / PAGE).write_text(page.source, encoding="utf-8")
    subprocess.run(
        [
            *(CHROMIUM, "--headless", "--no-sandbox", "--disable-gpu", "--hide-scrollbars"),
            *(f"--window-size={width},{height}", f"--screenshot={tmp_path / 'page.png'}"),
            *(f"--user-data-dir={tmp_path / 'profile'}", f"file://{tmp_path / PAGE}"),
        ],
        check=True,
        capture_output=True,
        timeout=120,
    )
    pixels = np.rint(255 * imread(tmp_path / "page.png")[..., :3]).astype(int)
    assert pixels.shape[:2] == (height, width)

    def rows_of(colour: tuple[int, int, int]) -> np.ndarray:
        return np.flatnonzero((pixels == colour).all(axis=2).sum(axis=1))

    doubtful, band, error = (255, 246, 221), (201, 216, 238), (192, 57, 43)
    assert rows_of(doubtful)[0] < 150  # the banner comes first
    assert np.sum((pixels[:400] == doubtful).all(axis=2)) > 50_000
    for colour in (band, error):
        assert len(rows_of(colour)) > 100
        assert rows_of(colour)[0] > rows_of(doubtful)[0]
    assert np.all(pixels[:, -10:] == 255)  # nothing runs out of the page


# Charts ---------------------------------------------------------------------------------------


def test_ticks_are_round_and_within() -> None:
    rng = np.random.default_rng(5)
    for low, span in zip(rng.normal(0.0, 1e3, 300), 10.0 ** rng.uniform(-6, 6, 300), strict=True):
        result = ticks(low, low + span)
        assert 2 <= len(result) <= 7
        assert low - 1e-6 * span <= result[0]
        assert result[-1] <= low + span * (1 + 1e-6)
        step = f"{result[1] - result[0]:.1e}"
        assert step[0] in "125"


def test_a_thinned_line_keeps_its_extremes_and_its_gaps() -> None:
    y = np.random.default_rng(1).standard_normal(100_000)
    y[50_000] = 40.0
    y[70_000] = -40.0
    y[30_000] = np.nan
    rows = thinned(y)
    assert len(rows) < 2000
    assert {0, 30_000, 50_000, 70_000, 99_999} <= set(rows.tolist())
    assert np.all(np.diff(rows) > 0)


@pytest.mark.parametrize("log", [False, True])
@pytest.mark.parametrize("values", [[0.0, 0.0], [np.nan, np.nan], [1e-12, 1e9], [5.0, 5.0]])
def test_any_numbers_can_be_drawn(values: list[float], log: bool) -> None:
    x, y = np.arange(2.0), np.array(values)
    drawn = svg(Chart("t", "x", "y", (ChartLine(x, y),), (ChartBand(x, y, y + 1.0),), log=log))
    assert "nan" not in drawn
    assert "inf" not in drawn
