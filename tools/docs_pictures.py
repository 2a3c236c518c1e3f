"""Make the pictures of README and documentation by the commands that they illustrate.

``python tools/docs_pictures.py [NAME ...]``; those of the viewer require xvfb-run, those of a
page chromium; ``stability`` takes an hour.
"""

import argparse
import re
import shutil
import subprocess
import sys
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple

from PIL import Image

ROOT = Path(__file__).resolve().parents[1]
WINDOW = (1600, 1000)  # of the viewer
VIEWS = (0.036, 0.971)  # of the height: between the viewer's menu and its time
SHOT = "shot.png"
SCREEN = "3400x2200x24"  # the pointer, at its centre, is outside the window
PAGE_WINDOW = (1120, 1500)
WIDTH = 860  # px
QUALITY = 90  # of a WebP, in percent; a PNG is lossless


class Picture(NamedTuple):
    """A picture: its place, the commands that make it, and the file with it in their directory."""

    place: str
    commands: tuple[str, ...]
    file: str
    page: str = "README.md"  # whose files the commands use, besides those of README


def _simulated(command: str) -> tuple[str, ...]:
    return (
        "magfusion simulate --site site.yaml -o log --duration 60 --random-field 0.005",
        command,
    )


_DESIGN = (
    "magfusion design site.yaml --beacons 3 --hall hall.yaml --spacing 1.5 --grid 2"
    " --starts 2 --random 20 -o design"
)

PICTURES = {
    "readme": Picture(
        ".github/readme.webp", ("magfusion demo --no-show",), "magfusion_demo/run.rrd"
    ),
    "recording": Picture(
        "docs/screenshots/recording.webp", ("magfusion demo --no-show",), "magfusion_demo/run.rrd"
    ),
    "report": Picture(
        ".github/report.webp", _simulated("magfusion smooth log -o run"), "run/report.html"
    ),
    "check": Picture(
        "docs/screenshots/check.png",
        _simulated("magfusion check log -o checked"),
        "checked/check.png",
    ),
    "calibrate": Picture(
        "docs/screenshots/calibrate.png",
        _simulated("magfusion calibrate log log -o calibration"),
        "calibration/calibration.png",
    ),
    "coverage": Picture(
        "docs/figures/coverage.png",
        ("magfusion coverage site.yaml -o coverage --extra-beacon --spacing 1",),
        "coverage/coverage.png",
    ),
    "design": Picture(
        "docs/figures/design.png",
        (_DESIGN,),
        "design/design.png",
        "docs/jobs/design.md",
    ),
    "error_budget": Picture(
        "docs/figures/error_budget.png",
        (_DESIGN,),
        "design/error_budget.png",
        "docs/jobs/design.md",
    ),
    "drift": Picture(
        "docs/screenshots/drift.png",
        ("magfusion drift --hours 2 --estimator both -o drift",),
        "drift/stability.png",
    ),
    "stability": Picture(
        ".github/stability.png",
        ("magfusion drift --hours 48 --worlds 8 --estimator both --seed 11 -o drift",),
        "drift/stability.png",
    ),
    "tracker": Picture(
        "docs/screenshots/tracker.webp",
        (
            "magfusion simulate --site tracker.yaml --no-perturb -o head --duration 9"
            " --motion turn --box 0.3,0.5,-0.15,0.15,-0.12,0.12 --seed 2",
            "magfusion navigate head -o tracked --estimator ekf",
        ),
        "tracked/run.rrd",
        "docs/tracker.md",
    ),
}

# Of the pages of the papers: a scenario with its options, and its picture.
PAPERS = {
    "000_table_1": ("tracker_table1.py", "tracker_table1_rows"),
    "001_figure_2": ("twelve_positions.py", "twelve_positions"),
    "001_figure_4": ("roll_matching.py", "roll_matching"),
    "001_figure_6": ("attitude_matching.py", "attitude_matching"),
    "002_figures_5_6": ("beacon_calibration.py", "beacon_calibration"),
    "004_figure_6": ("coverage_radius.py", "coverage_radius"),
}
PICTURES |= {
    name: Picture(
        f"docs/papers/{name}.png",
        (f"python scenarios/{scenario} -o drawn",),
        f"drawn/{drawn}.png",
    )
    for name, (scenario, drawn) in PAPERS.items()
}


def make(picture: Picture) -> Path:
    """Make a picture in a directory of its own, and return its place."""
    place = ROOT / picture.place
    with TemporaryDirectory() as name:
        directory = Path(name)
        for page in ("README.md", picture.page):
            text = (ROOT / page).read_text(encoding="utf-8")
            for block in re.findall(r"^```yaml\n(.*?)^```$", text, re.M | re.S):
                head = re.match(r"# (\S+\.yaml)", block)
                if head:
                    (directory / head[1]).write_text(block, encoding="utf-8")
        for command in picture.commands:
            line = command.replace("scenarios/", f"{ROOT}/scenarios/")
            subprocess.run(line.split(), cwd=directory, check=True)
        built = directory / picture.file
        if built.suffix == ".rrd":
            built = _screenshot(built, directory / SHOT)
        if built.suffix == ".html":
            built = _page(built, directory / SHOT)
        save(built, place)
    return place


def _screenshot(recording: Path, png: Path) -> Path:
    """Return what the viewer shows of a recording when it opens."""
    screen = shutil.which("xvfb-run")
    if screen is None:
        raise SystemExit("xvfb-run is not installed; install it for pictures of the viewer")
    viewer = [sys.executable, "-m", "rerun", str(recording), "--screenshot-to", str(png)]
    size = "x".join(map(str, WINDOW))
    display = [screen, "-a", "-s", f"-screen 0 {SCREEN}"]
    subprocess.run([*display, *viewer, "--window-size", size], check=True, timeout=300)
    with Image.open(png) as image:
        low, high = (round(share * image.height) for share in VIEWS)
        image.crop((0, low, image.width, high)).save(png)
    return png


def _page(page: Path, png: Path) -> Path:
    """Return the head of a page as a browser shows it."""
    browser = shutil.which("chromium") or shutil.which("google-chrome")
    if browser is None:
        raise SystemExit("chromium is not installed; install it for pictures of pages")
    size = ",".join(map(str, PAGE_WINDOW))
    options = ["--headless", "--no-sandbox", "--disable-gpu", "--hide-scrollbars"]
    shot = [f"--window-size={size}", f"--screenshot={png}", page.resolve().as_uri()]
    subprocess.run([browser, *options, *shot], check=True, timeout=300)
    return png


def save(built: Path, place: Path, width: int = WIDTH) -> None:
    """Save a picture with all its colours, no wider than a page has room."""
    image = Image.open(built).convert("RGB")
    if image.width > 1.2 * width:
        height = round(image.height * width / image.width)
        image = image.resize((width, height), Image.Resampling.LANCZOS)
    place.parent.mkdir(parents=True, exist_ok=True)
    image.save(place, optimize=True, quality=QUALITY)


def main() -> None:
    """Make those that are named, or all."""
    parser = argparse.ArgumentParser(description="Make the pictures of README and docs.")
    parser.add_argument("names", nargs="*", choices=[*PICTURES, []])
    for name in parser.parse_args().names or PICTURES:
        print(make(PICTURES[name]))


if __name__ == "__main__":
    main()
