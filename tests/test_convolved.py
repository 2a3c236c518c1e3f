"""Convolution of columns, against SciPy's; and that no start pays for importing it."""

import numpy as np
import pytest
from scipy.signal import fftconvolve

from magfusion.estimation.data_checks.field_rotation import convolved


@pytest.mark.parametrize(
    ("n", "m", "mode"),
    [
        (400, 1, "valid"),
        (400, 30, "valid"),
        (401, 31, "valid"),
        (400, 30, "same"),
        (401, 31, "same"),
        (20, 50, "same"),
    ],
)
def test_columns_are_convolved_as_by_scipy(n: int, m: int, mode: str) -> None:
    rng = np.random.default_rng(3)
    value, kernel = rng.normal(size=(n, 3)), rng.normal(size=m)
    expected = fftconvolve(value, kernel[:, None], mode=mode, axes=0)
    np.testing.assert_allclose(convolved(value, kernel, mode), expected, atol=1e-12)
