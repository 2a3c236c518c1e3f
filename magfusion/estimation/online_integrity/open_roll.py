"""The roll about a single coil that neither field nor IMU tells: what is said, and compared."""

from dataclasses import replace

from magfusion.estimation.snapshot.coil_poses import nearest_truth
from magfusion.model.one_axis import opened_poses, roll_is_open
from magfusion.model.samples import Log
from magfusion.model.site import Site
from magfusion.model.trajectory import Trajectory
from magfusion.model.trust import Finding, Verdict

TEXT = (
    "One axis tells nothing of the roll about it, and there is no IMU: a roll that does not turn is"
    " taken, and its sigma is that of any. Place and direction of the coil are told; of errors"
    " against a truth, these alone."
)


def roll_findings(site: Site) -> tuple[Finding, ...]:
    """Return that the roll is open, where it is."""
    return (Finding("roll_open", TEXT, Verdict.TRUSTWORTHY),) if roll_is_open(site) else ()


def with_open_roll(states: Trajectory, site: Site) -> Trajectory:
    """Return states of an estimate with covariances of any roll, where it is open."""
    if not roll_is_open(site) or states.pose_cov is None:
        return states
    return replace(states, pose_cov=opened_poses(site, states.pose_cov))


def comparable(log: Log, states: Trajectory, site: Site) -> Log:
    """Return a log whose truth has the roll that was taken, where nothing tells it."""
    if log.truth is None or not roll_is_open(site):
        return log
    signed = log.fields is None or log.fields.signed
    return replace(log, truth=nearest_truth(log.truth, states, site, signed=signed))
