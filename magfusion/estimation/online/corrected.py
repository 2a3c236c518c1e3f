"""Correct the site of a navigator: a navigator of the site in which a mistake is undone.

A correction is accepted only if no test contradicts the corrected states, as offline.
"""

import numpy as np

from magfusion.errors import InputError
from magfusion.estimation.integrity.correction import Correction, Trial, best_trial
from magfusion.estimation.online.navigator import Navigator
from magfusion.files.site_changes import changed_keys
from magfusion.model.trust import Verdict


def corrected(navigator: Navigator) -> Navigator:
    """Return a navigator with the latest mistake of the site undone; the same one without any.

    The newest input (12 s) is processed again, which takes about as long as a start.  Call it after
    each piece of data, and use what it returns in place of the argument.

    Parameters
    ----------
    navigator : Navigator
        Unchanged, but for the corrections that it offers, which are taken.

    Returns
    -------
    Navigator
        With the mistake in `Navigator.corrected`, if no test contradicts its states.
    """

    def tried(correction: Correction) -> Trial[Navigator] | None:
        try:
            trial = navigator.with_correction(correction)
        except (RuntimeError, InputError, np.linalg.LinAlgError):
            return None
        judgement = trial.judgement
        every = trial.started and len(judgement.reasons) == len(trial.corrected)
        gross = trial.started and correction.clear and judgement.verdict is not Verdict.FAILED
        return Trial(trial, every, gross, trial.remainder)

    # What no key of the site's file describes cannot be corrected.
    possible = navigator.take_corrections()
    waiting = (one for one in possible if changed_keys(navigator.declared, one.site))
    return best_trial(waiting, tried) or navigator
