"""The command line is made of the jobs' settings, starts light, and completes what is typed."""

import dataclasses
import importlib
import importlib.util
import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import Worked

import magfusion
from magfusion.errors import InputError
from magfusion.estimation.batch.batch import SmootherSettings
from magfusion.estimation.online.navigator import NavigatorSettings
from magfusion.jobs import JOBS
from magfusion.jobs.calibrate_log import LogCalibrationSettings, run_calibrate_log
from magfusion.jobs.inputs import Job, read_estimate
from magfusion.jobs.navigate_settings import NavigateSettings
from magfusion.jobs.settings import Command, Settings, argument, option, options, required
from magfusion.jobs.smooth import SmoothSettings, run_smooth
from magfusion.model.groups import GROUPS
from magfusion.model.parameters import GROUPS as OF_PARAMETERS
from magfusion.model.trust import Risk
from magfusion.receiver.windows import LockinSettings

# What a job is, is known without these; of all jobs together, the list, without anything heavy.
HEAVY = {"gtsam", "matplotlib", "rerun", "scipy.signal", "scipy.stats"}
HEAVY_OF_ALL = HEAVY | {"filterpy", "msgpack", "numpy", "pandas", "pyarrow", "rosbags", "scipy"}
MAX_MEMORY = 80.0  # MB
HELP = """
import sys
from pathlib import Path
from magfusion.cli import main
try:
    main(sys.argv[1:])
finally:
    # Not by getrusage, which begins with what the parent had.
    told = Path("/proc/self/status").read_text().split("VmHWM:")
    print(float(told[1].split()[0]) / 1e3, *sys.modules, file=sys.stderr)
"""
# Each command in a process of its own, which begins with what all may import.
HELP_OF_EACH = """
import os, sys
from magfusion.cli import main
import numpy, pyarrow, scipy.interpolate, scipy.optimize, scipy.spatial
for command in sys.argv[1:]:
    if os.fork():
        os.wait()
        continue
    try:
        main([*command.split(), "--help"])
    finally:
        print(f"{command}:", *sys.modules, file=sys.stderr)
"""


def _child(*arguments: str, **environment: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, *arguments],
        env=os.environ | environment,
        capture_output=True,
        text=True,
        check=False,
    )


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="reads /proc")
def test_the_list_of_commands_is_shown_without_anything_heavy() -> None:
    done = _child("-c", HELP, "--help")
    assert "Usage: magfusion" in done.stdout
    memory, *modules = done.stderr.split()
    assert not set(modules) & HEAVY_OF_ALL
    assert float(memory) < MAX_MEMORY


@pytest.mark.slow
@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="forks")
def test_help_is_shown_without_what_only_the_work_needs() -> None:
    done = _child("-c", HELP_OF_EACH, *JOBS)
    assert done.returncode == 0
    for command in JOBS:
        assert f"Usage: magfusion {command}" in done.stdout
    lines = [line.partition(": ") for line in done.stderr.splitlines()]
    assert [command for command, _, _ in lines] == list(JOBS)
    heavy = {command: HEAVY & set(modules.split()) for command, _, modules in lines}
    assert not any(heavy.values()), heavy


# Options are fields ---------------------------------------------------------------------------


def _commands() -> dict[str, Command]:
    return {
        name: importlib.import_module(f"magfusion.jobs.{module}").COMMAND
        for name, (module, _) in JOBS.items()
    }


def test_every_field_of_a_jobs_settings_is_an_option_with_its_help() -> None:
    for name, command in _commands().items():
        for field in dataclasses.fields(command.settings):
            assert "option" in field.metadata, f"{name}: {field.name}"
        for field, requested in options(command.settings):
            assert requested.sentence[0].isupper(), f"{name}: {field.name}"
            assert requested.sentence.endswith("."), f"{name}: {field.name}"


@dataclasses.dataclass(frozen=True, kw_only=True)
class _Query(Settings):
    place: Path = argument("Where")
    length: float = option(2.0, "Length", unit="m", least=1.0, most=3.0, note="of the rod")
    width: float | None = option(None, "Width", unit="m", above=0.0)
    weight: float = option(1.0, "Weight", least=0.0)
    count: int = option(0, "How many", least=0)
    mode: bool = option(False, "How", name="way", words={"slow": False, "fast": True})
    name: str = required("Whose")


def test_help_tells_unit_bounds_and_note() -> None:
    sentences = {field.name: requested.sentence for field, requested in options(_Query)}
    assert sentences["length"] == "Length, 1 to 3 m; of the rod."
    assert sentences["width"] == "Width, m."
    assert sentences["mode"] == "How."


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        ({"length": 0.5}, "--length must lie between 1 and 3 m; got 0.5"),
        ({"length": float("nan")}, "--length must lie between 1 and 3 m; got nan"),
        ({"width": 0.0}, "--width must be above 0 m; got 0"),
        ({"width": float("inf")}, "--width must be above 0 m; got inf"),
        ({"weight": -1.0}, "--weight must be at least 0; got -1"),
        ({"count": -1}, "--count must not be negative; got -1"),
    ],
)
def test_a_number_out_of_its_bounds_is_refused(change: dict[str, Any], sentence: str) -> None:
    _Query(place=Path(), name="A")
    with pytest.raises(InputError) as refused:
        _Query(place=Path(), name="A", **change)
    assert str(refused.value) == sentence


def test_the_defaults_of_options_are_those_of_the_estimators() -> None:
    log = Path("log")
    job = Job(log, None, Path("out"))
    assert SmoothSettings(log=log).smoother(job) == SmootherSettings()
    assert NavigateSettings(log=log).navigator(job) == NavigatorSettings(risk=Risk())
    assert GROUPS == OF_PARAMETERS


# The window that is asked is the window that is used ------------------------------------------


@pytest.mark.slow
def test_the_lockin_of_the_settings_is_used(worked: Worked, tmp_path: Path) -> None:
    """It was once overwritten by another of the job."""
    settings = SmootherSettings(lockin=LockinSettings(window=0.8, step=0.6))
    figures = run_smooth(Job(worked.log, None, tmp_path / "run"), settings)
    assert figures["window_s"] == pytest.approx(0.8, rel=0.01)
    time = read_estimate(tmp_path / "run").time
    assert np.median(np.diff(time)) == pytest.approx(0.6, rel=0.01)


@pytest.mark.slow
def test_the_calibration_by_a_log_uses_the_window_that_is_asked(
    worked: Worked, tmp_path: Path
) -> None:
    settings = LogCalibrationSettings(log=worked.log, window=0.8, step=0.6)
    figures = run_calibrate_log(settings, tmp_path / "run")
    assert figures["window_s"] == pytest.approx(0.8, rel=0.01)


# The program, and the shell -------------------------------------------------------------------


@pytest.mark.slow
def test_the_module_is_the_program(worked: Worked) -> None:
    done = _child("-m", "magfusion", "evaluate", str(worked.smoothed), str(worked.log), "--json")
    assert (done.returncode, done.stderr) == (0, "")
    assert json.loads(done.stdout.splitlines()[-1])["job"] == "evaluate"
    assert _child("-m", "magfusion", "fix").stderr.startswith("magfusion: Missing argument")


def _completed(*words: str) -> set[str]:
    answer = _child(
        "-m",
        "magfusion",
        _MAGFUSION_COMPLETE="complete_bash",
        COMP_WORDS=" ".join(("magfusion", *words)),
        COMP_CWORD=str(len(words)),
    )
    assert answer.returncode == 0, answer.stderr
    return set(answer.stdout.split())


@pytest.mark.slow
def test_the_shell_completes_commands_options_and_choices() -> None:
    assert _completed("s") == {"smooth", "survey", "sheet", "simulate"}
    assert _completed("calibrate", "f") == {"fieldmap"}
    assert _completed("calibrate", "log", "--cross") == {"--cross-validate"}
    assert _completed("smooth", "--coupling", "") == {"tight", "loose"}


def test_the_script_for_the_shell_is_shown() -> None:
    shown = _child(
        "-m",
        "magfusion",
        "--show-completion",
        "bash",
        _TYPER_COMPLETE_TEST_DISABLE_SHELL_DETECTION="1",
    )
    assert shown.returncode == 0, shown.stderr
    assert "_MAGFUSION_COMPLETE=complete_bash" in shown.stdout
    assert "complete -o default -F _magfusion_completion magfusion" in shown.stdout


# The names of the package ---------------------------------------------------------------------


@pytest.mark.slow
def test_the_package_offers_its_names_and_loads_nothing_before_they_are_asked_for() -> None:
    lines = (
        "import sys, magfusion as mf",
        "assert set(mf.__all__) <= set(dir(mf))",
        "assert not {'numpy', 'scipy', 'gtsam'} & set(sys.modules)",
        "from magfusion import *",
        "print(smooth.__module__, Navigator.__module__)",
    )
    done = _child("-c", "\n".join(lines))
    assert done.stdout.split() == [
        "magfusion.results.smoothed",
        "magfusion.estimation.online.navigator",
    ]


def test_a_name_that_the_package_does_not_offer_is_told() -> None:
    with pytest.raises(AttributeError, match="no attribute 'smoothe'"):
        _ = magfusion.smoothe


@pytest.mark.slow
@pytest.mark.parametrize(
    ("given", "threads"),
    [
        ({}, "1"),
        ({"OPENBLAS_NUM_THREADS": "2"}, "2"),
        ({"OMP_NUM_THREADS": "2"}, None),
    ],
)
def test_blas_has_one_thread_unless_more_are_asked_for(
    given: dict[str, str], threads: str | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
        monkeypatch.delenv(name, raising=False)
    for name, number in given.items():
        monkeypatch.setenv(name, number)
    reported = f"""
import os, sys
import magfusion.cli
assert "numpy" not in sys.modules
sys.argv = ["magfusion", "smooth", "nowhere", "--debug"]
try:
    magfusion.cli.main()
except SystemExit:
    pass
assert os.environ.get("OPENBLAS_NUM_THREADS") == {threads!r}
"""
    done = _child("-c", reported)
    assert done.returncode == 0, done.stderr


@pytest.mark.slow
def test_who_imports_statistics_while_a_filter_is_made_has_all_of_them() -> None:
    reported = """
import threading
found = []
def statistics():
    import scipy.stats
    found.append(scipy.stats)
thread = threading.Thread(target=statistics)
thread.start()
import magfusion.estimation.online.ekf
thread.join()
import scipy.stats
assert found == [scipy.stats]
assert scipy.stats.chi2.cdf(0.0, 1) == 0.0
"""
    done = _child("-c", reported)
    assert done.returncode == 0, done.stderr


def test_a_command_looks_for_garbage_but_not_among_what_it_imported(tmp_path: Path) -> None:
    reported = """
import gc, sys
from magfusion.jobs import smooth
from magfusion.cli import main
def run(settings):
    assert gc.isenabled() and gc.get_freeze_count() > 10_000, gc.get_freeze_count()
smooth.COMMAND = smooth.Command(smooth.SmoothSettings, run)
sys.argv = ["magfusion", "smooth", "."]
main()
"""
    done = subprocess.run(
        [sys.executable, "-c", reported], check=False, capture_output=True, text=True, cwd=tmp_path
    )
    assert done.returncode == 0, done.stderr
