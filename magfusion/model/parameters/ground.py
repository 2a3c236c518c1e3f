"""Parameter of the surrounding ground or water."""

from dataclasses import replace

import numpy as np

from magfusion.model.ground import conductivity_of, in_ground
from magfusion.model.parameters.parameter import PERCENT, Calibration, Parameter, PhasorView
from magfusion.model.site import Site
from magfusion.units import Array, ComplexArray


class _Conductivity(Parameter):
    """Logarithm of the conductivity: additive for the estimators, a factor for the ground."""

    group, owner, kind = "ground", "ground", "conductivity"
    display_unit = PERCENT
    words = "the ground's conductivity"
    negligible = 2e-3
    declared = True

    def sigma(self, site: Site, owner: str) -> Array:
        return np.array([site.log_conductivity_sigma if conductivity_of(site) else 0.0])

    def moved(self, calibration: Calibration, owner: str, step: Array) -> Calibration:
        moved = conductivity_of(calibration.site) * float(np.exp(step[0]))
        return replace(calibration, site=in_ground(calibration.site, moved))

    def difference(self, old: Calibration, new: Calibration, owner: str) -> Array:
        before, after = (conductivity_of(c.site) for c in (old, new))
        return np.log([after / before]) if before else np.zeros(1)

    def refined(self, site: Site, calibration: Calibration, owner: str, sigma: Array) -> Site:
        return replace(site, log_conductivity_sigma=float(sigma[0]))

    def phasor_jacobian(self, view: PhasorView, owner: str) -> ComplexArray | None:
        result = view.whole.log_conductivity
        return None if result is None else result[..., None]


CONDUCTIVITY = _Conductivity()
