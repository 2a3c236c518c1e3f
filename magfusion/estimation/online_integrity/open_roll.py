"""Undetermined roll about a single coil without an IMU: its finding, covariance and comparison."""

from dataclasses import replace

from magfusion.estimation.snapshot.coil_poses import nearest_truth
from magfusion.model.one_axis import opened_poses, roll_is_open
from magfusion.model.samples import Log
from magfusion.model.site import Site
from magfusion.model.trajectory import Trajectory
from magfusion.model.trust import Finding, Verdict

TEXT = (
    "One axis does not determine the roll about it, and there is no IMU. The estimate assumes a"
    " constant roll with the sigma of an unknown angle. Position and direction of the coil are"
    " determined; only their errors are compared with a truth."
)


def roll_findings(site: Site) -> tuple[Finding, ...]:
    """Return the finding that the roll is undetermined, where it is."""
    return (Finding("roll_open", TEXT, Verdict.TRUSTWORTHY),) if roll_is_open(site) else ()


def with_open_roll(states: Trajectory, site: Site) -> Trajectory:
    """Return states with covariances of any roll, where it is undetermined."""
    if not roll_is_open(site) or states.pose_cov is None:
        return states
    return replace(states, pose_cov=opened_poses(site, states.pose_cov))


def comparable(log: Log, states: Trajectory, site: Site) -> Log:
    """Return a log whose truth has the assumed roll, where the roll is undetermined."""
    if log.truth is None or not (log.truth.has_poses and roll_is_open(site)):
        return log
    signed = log.fields is None or log.fields.signed
    return replace(log, truth=nearest_truth(log.truth, states, site, signed=signed))
