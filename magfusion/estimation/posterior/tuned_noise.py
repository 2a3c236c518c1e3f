"""Findings of noise far from the declared values."""

from collections.abc import Container, Iterator, Sequence

import numpy as np

from magfusion.estimation.posterior.noise_tuning import OF_IMU, OF_MOTION, Tuned
from magfusion.model.noise import model_error_cov
from magfusion.model.samples import FieldSamples
from magfusion.model.site import Site
from magfusion.model.trust import Finding, Verdict

FACTOR = 2.999  # a larger change is reported; that of a model error is limited to three

WORDS = {
    "noise_factor": ("the noise of the fields of {owner}, over that measured near its tones", ""),
    "model_error": ("the model error of the fields of {owner}", ""),
    "gyro_noise": ("the noise of the gyroscope", " rad/s/√Hz"),
    "accel_noise": ("the noise of the accelerometer", " m/s²/√Hz"),
    "accel_density": ("the acceleration of the platform", " m/s²/√Hz"),
    "angular_accel_density": ("the angular acceleration of the platform", " rad/s²/√Hz"),
}


def covered_beacons(tuned: Sequence[Tuned], fields: FieldSamples, site: Site) -> set[str]:
    """Return the beacons whose declared model error is larger than what their noise has grown to.

    The tuning counts the part of a model error that changes from epoch to epoch as noise.
    """
    errors = {
        b.name: site.model_error if b.model_error is None else b.model_error for b in site.beacons
    }
    result = set()
    for one in (t for t in tuned if t.key == "noise_factor"):
        own = np.array([name == one.owner for name, _ in fields.channels])
        used = fields.valid & own
        noise = np.sum(np.trace(fields.phasor_cov[used], axis1=1, axis2=2))
        model = model_error_cov(fields.phasor_sensor[used], errors[one.owner])
        declared = one.declared**2 * noise + np.sum(np.trace(model, axis1=1, axis2=2))
        if one.estimated**2 * noise < declared:
            result.add(one.owner)
    return result


def tuned_noise(tuned: Sequence[Tuned], covered: Container[str] = ()) -> Iterator[Finding]:
    """Yield the findings of estimated noise: more than declared makes a result doubtful.

    `covered`: beacons whose declared model error covers their noise.
    """
    more = [
        t
        for t in tuned
        if t.factor > FACTOR
        and t.key not in OF_MOTION
        and not (t.key == "noise_factor" and t.owner in covered)
    ]
    less = [t for t in tuned if t.factor < 1.0 / FACTOR]
    faster = [t for t in tuned if t.factor > FACTOR and t.key in OF_MOTION]
    if faster:
        yield Finding(
            "noise_tuned",
            f"The platform moves faster than its motion prior: {_listed(faster)}. Estimated values"
            " were used and written to site.yaml; declare them.",
            Verdict.TRUSTWORTHY,
        )
    if more:
        yield _more(more)
    if less:
        yield Finding(
            "noise_tuned",
            f"Noise below the declared value: {_listed(less)}. Estimated values were used and"
            " written to site.yaml.",
            Verdict.TRUSTWORTHY,
        )


def _more(more: Sequence[Tuned]) -> Finding:
    text, weight = f"Noise above the declared value: {_listed(more)}.", max(t.factor for t in more)
    used, remedy = "Estimated values were used and written to site.yaml", None
    if all(t.key in OF_IMU for t in more):
        text += f" {used}; declare them, or the values of the data sheet."
        remedy = {f"platform.imu.{t.key}": float(f"{t.estimated:.3g}") for t in more}
    else:
        text += (
            f" {used}. Check moments and position of the beacons listed, and iron and machines near"
            " them; declare the remaining noise."
        )
    return Finding("noise_tuned", text, Verdict.DOUBTFUL, weight / FACTOR, remedy=remedy)


def _listed(tuned: Sequence[Tuned]) -> str:
    return "; ".join(_words(t) for t in tuned)


def _words(tuned: Tuned) -> str:
    words, unit = WORDS[tuned.key]
    what = words.format(owner=f"beacon {tuned.owner}")
    return f"{what} is {tuned.estimated:.2g}{unit}, declared {tuned.declared:.2g}{unit}"
