"""Sites without a beacon, with which smooth and navigate estimate the orientation alone."""

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
    """Reject options of `navigate` that require a position."""
    refused = sorted(given & OF_BEACONS)
    if refused:
        raise InputError(
            f"--{refused[0].replace('_', '-')} is not available for a site without beacons, where"
            " only the orientation is estimated; omit it"
        )


def without_beacons(job: Job) -> bool:
    """Return whether a job's site has no beacon, so that only the orientation is observable."""
    if not job.declared_path.is_file():
        return False
    return not load_site(job.declared_path, unknown=True, without=True, several=True).beacons
