"""The engines that are compared solve the same problem."""

import pytest
from bench_engines import ENGINES, LAG, bench_engine
from bench_fusion import make_scene

from magfusion.estimation.graph.graph import initial_estimate


@pytest.mark.slow
def test_all_engines_have_the_error_and_the_sigma_of_our_loop() -> None:
    scene = make_scene(LAG + 5, 1)
    start = initial_estimate(scene.start, scene.declared)
    figures = {
        name: bench_engine(engine, scene.problem(), start, scene.truth)
        for name, engine in ENGINES.items()
    }
    ours = figures["bordered"]
    for own in figures.values():
        assert own["error_m"] == pytest.approx(ours["error_m"], rel=0.02)
        assert own["sigma_m"] == pytest.approx(ours["sigma_m"], rel=0.02)
        assert own["nees_per_axis"] == pytest.approx(ours["nees_per_axis"], rel=0.05)
    assert 0.3 < ours["nees_per_axis"] < 2.0
