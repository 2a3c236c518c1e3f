"""`magfusion calibrate ...`: commands that refine a site."""

from magfusion.cli.app import calibrate

__all__ = ["calibrate"]
