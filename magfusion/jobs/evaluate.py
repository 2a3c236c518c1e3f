"""The job that compares a trajectory with a truth."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

from scipy.spatial.transform import Rotation

from magfusion.errors import InputError
from magfusion.files.bag_topics import is_bag
from magfusion.files.open import open_log
from magfusion.files.site_draft import numbers
from magfusion.jobs.settings import Command, TopicSettings, argument, option
from magfusion.model.trajectory import Trajectory
from magfusion.model.trust import Finding
from magfusion.results.association import associate
from magfusion.results.figures import Figure, Figures, Section


@dataclass(frozen=True, kw_only=True)
class EvaluateSettings(TopicSettings):
    """Trajectories to compare, for `magfusion.jobs.inputs.read_estimate`, or a log with truth."""

    estimate: Path = argument("Result directory, TUM file or table")
    truth: Path = argument("Log with truth, TUM file or table; positions or attitudes may be alone")
    align: Literal["none", "se3", "yaw"] = option(
        "none",
        "Motion of the estimate that fits the truth",
        note="yaw: about the vertical, with a translation",
    )
    align_poses: int | None = option(
        None, "Number of first poses that --align uses", metavar="N", note="default: all", least=3
    )
    align_time: bool = option(False, "Estimate a constant offset of the clocks")
    lever_arm: str = option(
        "0,0,0",
        "From the body to the point that the truth tracks, in body axes, m",
        metavar="X,Y,Z",
    )
    mounting: str = option(
        "0,0,0",
        "Of the frame that the truth tracks, against the body, degrees",
        metavar="ROLL,PITCH,YAW",
    )
    truth_axes: Literal["enu", "ned"] = option(
        "enu", "Axes of the truth", note="ned: z down, of a body forward, right, down"
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.align_poses is not None and self.align == "none":
            raise InputError("--align-poses requires --align se3 or --align yaw; give one")


def run_evaluate(settings: EvaluateSettings) -> Figures:
    """Compare a trajectory with a truth."""
    from magfusion.jobs.inputs import named
    from magfusion.results.errors import trajectory_errors
    from magfusion.results.report import error_figures
    from magfusion.results.truth_frame import frame_remarks, unit_text

    findings: list[Finding] = []
    true, epoch_ns, remarks = _read_truth(settings, findings)
    result = _read_estimate(settings, epoch_ns, findings)
    with named(f"{settings.estimate} against {settings.truth}"):
        result, aligned = _aligned(settings, result, true)
        pairs = associate(result, true)
        # In a smaller unit no step is small enough for an interpolation to millimetres.
        unit = unit_text(associate(result, true, any_motion=True))
        if unit and len(pairs.truth) < 3:
            raise InputError(unit)
        errors = error_figures(trajectory_errors(result, true))
        frames = [*remarks, unit] if unit else frame_remarks(pairs, remarks)
    remarks = [*(finding.text for finding in findings), *frames]
    notes = Figures(*[Figure("notes", remarks, section=Section.NOTES)] * bool(remarks))
    return Figures(Figure("job", "evaluate", section=Section.TITLE)) | errors | aligned | notes


def _read_estimate(
    settings: EvaluateSettings, epoch_ns: int, findings: list[Finding]
) -> Trajectory:
    """Return the poses of the frame that the truth tracks."""
    from magfusion.jobs.inputs import read_any_poses
    from magfusion.results.alignment import tracked_point

    lever = numbers("--lever-arm", settings.lever_arm, (3,))
    mounting = numbers("--mounting", settings.mounting, (3,))
    estimate = read_any_poses(settings.estimate, epoch_ns, findings)
    if not any((*lever, *mounting)):
        return estimate
    if not estimate.has_attitude:
        raise InputError(
            f"{settings.estimate}: has no attitude, which --lever-arm and --mounting require; omit"
            " them"
        )
    return tracked_point(estimate, lever, Rotation.from_euler("xyz", mounting, degrees=True))


def _aligned(
    settings: EvaluateSettings, estimate: Trajectory, truth: Trajectory
) -> tuple[Trajectory, Figures]:
    """Return the estimate on the clock and in the world of the truth, and how it came there."""
    from magfusion.results.alignment import align_world, clock_offset

    figures = Figures()
    if settings.align_time:
        offset = clock_offset(estimate, truth)
        estimate = replace(estimate, time=estimate.time + offset)
        figures |= Figures(Figure("time_offset_s", offset, "s", label="clock offset"))
    if settings.align == "none":
        return estimate, figures
    pairs = associate(estimate, truth).first(settings.align_poses)
    estimate = align_world(estimate, pairs, settings.align)
    figures |= Figures(
        Figure("alignment", settings.align), Figure("alignment_poses", len(pairs.truth))
    )
    return estimate, figures


def _read_truth(
    settings: EvaluateSettings, findings: list[Finding]
) -> tuple[Trajectory, int, list[str]]:
    """Return the truth, the zero of its clock (ns), and what contradicts it in its log."""
    from magfusion.estimation.data_checks.truth import truth_findings
    from magfusion.jobs.inputs import read_any_poses, topics_option
    from magfusion.results.alignment import from_ned

    path, topics = settings.truth, topics_option(settings.topics)
    is_result = (path / "trajectory.parquet").is_file()
    ned = settings.truth_axes == "ned"
    if is_result or not (path.is_dir() or is_bag(path)):
        poses = read_any_poses(path, findings=findings)
        return from_ned(poses) if ned else poses, 0, []
    log = open_log(path, topics=topics)
    if log.truth is None:
        raise InputError(f"{path}: has no truth; give a log with truth, a TUM file or a table")
    poses = from_ned(log.truth) if ned else log.truth
    findings += [one for one in log.findings if "truth" in one.text.partition(": ")[0]]
    contradictions = truth_findings(replace(log, truth=poses))
    return poses, log.epoch_ns, [one.text for one in contradictions]


COMMAND = Command(EvaluateSettings, run_evaluate, example="magfusion evaluate run log")
