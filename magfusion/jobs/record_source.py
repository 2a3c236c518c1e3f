"""Records that arrive while a job runs: from standard input, or from topics of ROS 2."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING, TextIO

from magfusion.files.standard_streams import binary_input
from magfusion.jobs.navigate_settings import ROS2, NavigateSettings
from magfusion.model.site import Site

if TYPE_CHECKING:
    from magfusion.files.stream import NumberedRecord


def live_records(
    settings: NavigateSettings, site: Site, messages: TextIO
) -> Iterator[NumberedRecord]:
    """Return the records of the source that the settings name, as they come.

    `messages`: receives a sentence on a topic that is silent. Raises InputError where it cannot be
    read.
    """
    if str(settings.log) == ROS2:
        from magfusion.jobs.inputs import topics_option
        from magfusion.results.records_dds import subscribe

        return subscribe(topics_option(settings.topics), site, messages)
    from magfusion.files.stream import read_records

    return read_records(binary_input(), settings.form)
