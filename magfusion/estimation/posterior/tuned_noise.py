"""Noise that turned out far from what was declared, said."""

from collections.abc import Iterator, Sequence

from magfusion.estimation.posterior.noise_tuning import OF_MOTION, Tuned
from magfusion.model.trust import Finding, Verdict

FACTOR = 2.999  # a change beyond is said; of a model error no more than three is tried

WORDS = {
    "noise_factor": ("the noise of the fields of {owner}, over what is heard beside its tones", ""),
    "model_error": ("the model error of the fields of {owner}", ""),
    "gyro_noise": ("the noise of the gyroscope", " rad/s/√Hz"),
    "accel_noise": ("the noise of the accelerometer", " m/s²/√Hz"),
    "accel_density": ("the acceleration of the platform", " m/s²/√Hz"),
    "angular_accel_density": ("the angular acceleration of the platform", " rad/s²/√Hz"),
}


def tuned_noise(tuned: Sequence[Tuned]) -> Iterator[Finding]:
    """Yield what is to be said of noise: it makes a doubt where there is more than declared."""
    more = [t for t in tuned if t.factor > FACTOR and t.key not in OF_MOTION]
    less = [t for t in tuned if t.factor < 1.0 / FACTOR]
    faster = [t for t in tuned if t.factor > FACTOR and t.key in OF_MOTION]
    if faster:
        yield Finding(
            "noise_tuned",
            f"The platform moves faster than its motion prior has it: {_listed(faster)}. The sigmas"
            " hold with what was found, which the site.yaml of the result has: declare it.",
            Verdict.TRUSTWORTHY,
        )
    if more:
        yield Finding(
            "noise_tuned",
            f"There is more noise than declared: {_listed(more)}. The sigmas hold with what was"
            " found, which the site.yaml of the result has. Check moments and place of a beacon"
            " that is named, and for iron and machines about it; declare what stays.",
            Verdict.DOUBTFUL,
            max(t.factor for t in more) / FACTOR,
        )
    if less:
        yield Finding(
            "noise_tuned",
            f"There is less noise than declared: {_listed(less)}. The sigmas are those of what was"
            " found, which the site.yaml of the result has.",
            Verdict.TRUSTWORTHY,
        )


def _listed(tuned: Sequence[Tuned]) -> str:
    return "; ".join(_words(t) for t in tuned)


def _words(tuned: Tuned) -> str:
    words, unit = WORDS[tuned.key]
    what = words.format(owner=f"beacon {tuned.owner}")
    return f"{what} is {tuned.found:.2g}{unit} and not {tuned.declared:.2g}{unit}"
