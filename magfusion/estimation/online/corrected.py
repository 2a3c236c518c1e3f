"""What is found is used: a navigator of the site in which a mistake is undone.

A correction is accepted only if no test contradicts the corrected states, as offline.
"""

import numpy as np

from magfusion.errors import InputError
from magfusion.estimation.integrity.correction import MOST_SOLUTIONS, Correction
from magfusion.estimation.online.navigator import Navigator
from magfusion.files.site_changes import changed_keys
from magfusion.model.trust import Verdict


def corrected(navigator: Navigator) -> Navigator:
    """Return a navigator with the mistake undone that was found last; the same one without any.

    The newest input is processed again, which takes about as long as a start.
    """
    possible = navigator.take_corrections()
    # What no key of the site's file describes cannot be corrected.
    waiting = [one for one in possible if changed_keys(navigator.declared, one.site)]
    best = navigator
    for _ in range(MOST_SOLUTIONS):
        if not waiting:
            break
        correction = waiting.pop(0)
        trial = _tried(navigator, correction)
        if trial is None:
            continue
        if _is_better(trial, correction):
            best = trial
            if trial.remainder is None:
                break
        if trial.remainder is not None:
            waiting.insert(0, trial.remainder._replace(finding=correction.finding))
    return best


def _tried(navigator: Navigator, correction: Correction) -> Navigator | None:
    try:
        return navigator.with_correction(correction)
    except (RuntimeError, InputError, np.linalg.LinAlgError):
        return None


def _is_better(trial: Navigator, correction: Correction) -> bool:
    """Return whether the correction explains everything, or a gross mistake is undone by it."""
    if not trial.started:
        return False
    judgement = trial.judgement
    gross = correction.clear and judgement.verdict is not Verdict.FAILED
    return gross or len(judgement.reasons) == len(trial.corrected)
