"""Restoring a navigator from a checkpoint."""

from typing import Any

import numpy as np

from magfusion.errors import InputError
from magfusion.estimation.graph.measurement import Measurement
from magfusion.estimation.online.navigator import Navigator
from magfusion.estimation.online.navigator_data import navigator_rules
from magfusion.estimation.online.navigator_settings import NavigatorSettings
from magfusion.files.site_changes import with_content
from magfusion.model.site import Site


def restored(
    site: Site,
    settings: NavigatorSettings,
    checkpoint: Any,
    measurements: tuple[type[Measurement], ...] = (),
) -> Navigator:
    """Return the navigator of a checkpoint.

    `site`, `settings`: of the navigator that made it. `checkpoint`: as returned by
    `Navigator.checkpoint`. `measurements`: kinds of measurements from outside the package that were
    added to it. Raises InputError if it is no checkpoint, or does not fit the site.
    """
    parts = checkpoint.get("parts") if isinstance(checkpoint, dict) else None
    loop = parts.get("_loop") if isinstance(parts, dict) else None
    applied = loop.get("corrections") if isinstance(loop, dict) else None
    content = applied.get("content") if isinstance(applied, dict) else None
    navigator = Navigator(site, settings)
    if isinstance(content, str):
        declared, navigator = navigator.declared, Navigator(with_content(site, content), settings)
        navigator.declared = declared
    rules = navigator_rules(navigator.site, navigator.blocks, measurements)
    try:
        navigator.go_on_from(checkpoint, rules)
    except np.linalg.LinAlgError as error:
        raise InputError(f"its covariance is invalid ({error}); run without --resume") from error
    return navigator
