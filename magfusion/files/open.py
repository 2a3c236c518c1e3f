"""Any log that magfusion reads, by its path."""

from pathlib import Path

from magfusion.errors import InputError
from magfusion.files.bag_topics import Topics, is_bag, refuse_bag_folders
from magfusion.files.log import read_log
from magfusion.files.log_header import HEADER, is_log
from magfusion.model.progress import Report, quiet
from magfusion.model.samples import Log
from magfusion.model.site import Site


def open_log(
    path: Path | str,
    start: float | None = None,
    end: float | None = None,
    topics: Topics | None = None,
    report: Report = quiet,
    site: Site | None = None,
) -> Log:
    """Read a log, an EuRoC folder or a bag, whichever the path is.

    Parameters
    ----------
    start, end : float, optional
        The part with start <= time < end, in seconds since the log's epoch.
    topics : Topics, optional
        Of a bag that has several of one type.
    report : callable
        Called with the part of a bag that has been read.
    site : Site, optional
        Whose aiding sensors are read of a bag, by the names of their topics, and whose tones of a
        recording.

    Raises
    ------
    InputError
        Where the path is none of them, or as the reader of its kind.
    """
    path = Path(path)
    if not path.exists():
        raise InputError(f"{path}: there is no such file or directory; give the path of a log.")
    if is_log(path):
        return read_log(path, start, end, site)
    # What reads other formats is not needed for a log of ours, and takes a third of a second.
    from magfusion.files.foreign.euroc import is_euroc, read_euroc

    if is_euroc(path):
        return read_euroc(path, start, end)
    if is_bag(path):
        from magfusion.files.bag import read_bag

        aiding = () if site is None else site.aiding
        return read_bag(path, start, end, topics, report, aiding)
    refuse_bag_folders(path)
    raise InputError(
        f"{path}: is no log: found neither {HEADER} nor the tables of a log, mav0/imu0/data.csv"
        " (EuRoC), or .mcap, .db3 or .bag (bags of ROS); give the path of one of them, or convert"
        " other tables by magfusion import."
    )
