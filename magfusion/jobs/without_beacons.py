"""Whether a site has no beacon, of which smooth and navigate find the orientation alone."""

from magfusion.errors import InputError
from magfusion.files.site import load_site
from magfusion.jobs.inputs import Job

OF_BEACONS = {
    "blend",
    "checkpoint",
    "foxglove",
    "horizon",
    "live",
    "mavlink",
    "realtime",
    "resume",
    "ros2",
}


def refuse_without_beacons(given: set[str]) -> None:
    """Refuse what was given of `navigate` that only a position has."""
    refused = sorted(given & OF_BEACONS)
    if refused:
        raise InputError(
            f"--{refused[0].replace('_', '-')} is not for a site without beacons, where only the"
            " orientation is found; leave it out"
        )


def without_beacons(job: Job) -> bool:
    """Tell whether a job's site has no beacon, so that only the orientation can be found."""
    if not job.declared_path.is_file():
        return False
    return not load_site(job.declared_path, unknown=True, without=True, several=True).beacons
