"""The job that ranges one well from another, with a rotating magnet in it."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from magfusion.estimation.ranging.ranging import Ranged, find_range
from magfusion.estimation.ranging.ranging_windows import DepthErrors, RangingLog, ranging_log
from magfusion.estimation.ranging.relative_wells import Wells
from magfusion.estimation.snapshot.priors import trust_of, unexplained
from magfusion.files.table import Span, write_table
from magfusion.jobs.settings import Command, LogSettings, option
from magfusion.model.samples import Log
from magfusion.model.trust import Finding, Trust, Verdict
from magfusion.results.figures import Figure, Figures, Section, heading
from magfusion.results.verdict import trust_figures
from magfusion.units import DEGREE

MIN_SNR = 5.0  # of the strongest window
VAGUE = 0.2  # of the distance


@dataclass(frozen=True, kw_only=True)
class RangeSettings(LogSettings):
    """Depths, and demodulation of the waveform."""

    window: float = option(10.0, "Length of a window", unit="s", least=0.5, most=600.0)
    depth_sigma: float = option(
        0.02, "Sigma of the magnet's depth in a window", unit="m", least=0.0, most=100.0
    )
    depth_scale_sigma: float = option(
        1e-3, "Sigma of the depths' scale, by stretch of the string", least=0.0, most=0.1
    )
    mains_hz: float = option(50.0, "Mains frequency", unit="Hz", least=0.0, most=1e3)


def run_range(settings: RangeSettings, output: Path) -> Figures:
    """Estimate the position of a rotating magnet's well relative to that of a sensor at rest."""
    from magfusion.jobs.inputs import named, read_job
    from magfusion.jobs.result_directory import claim, result_in
    from magfusion.results.plots.ranging import RangePicture, write_range_plot

    job, claimed = settings.job(output), claim(output, "range")
    log, site = read_job(job, unknown=True, rotor=True)
    errors = DepthErrors(settings.depth_sigma, settings.depth_scale_sigma)
    with named(job.log_path):
        ranging = ranging_log(log, site, settings.window, settings.mains_hz, errors)
    result = find_range(site, ranging.windows)
    trust, excess = _judge_ranging(log, ranging, result)
    rotor = site.beacons[0].rotor
    assert rotor is not None
    wells = Wells(result, ranging.windows, rotor.axis_beacon, excess)
    windows, fields = ranging.windows, ranging.windows.fields
    magnet = windows.magnet[:, 1] + windows.magnet_from
    sensor = windows.sensor + windows.sensor_from
    places = wells.places(magnet, sensor)
    trust |= _vague(wells, float(sensor[-1]))
    figures = heading("range", log.name) | trust_figures(trust)
    figures |= _figures(ranging, result, wells, sensor)
    last = places.place[-1], np.sqrt(np.diagonal(places.cov[-1]))
    figures |= Figures(
        *(
            Figure(f"last_{word}_m", float(value), "m", label=f"magnet at the end, {word}")
            for word, value in zip(("ahead", "right", "up"), last[0], strict=True)
        ),
        *(
            Figure(f"last_{word}_sigma_m", float(value), "m", section=Section.REPORT)
            for word, value in zip(("ahead", "right", "up"), last[1], strict=True)
        ),
    )
    sigma = np.sqrt(np.diagonal(places.cov, axis1=1, axis2=2))
    columns: dict[str, object] = {
        "time_ns": Span(log.epoch_ns).stamps(fields.time),
        "magnet_depth_m": magnet,
        "sensor_depth_m": sensor,
        **{f"{w}_m": places.place[:, k] for k, w in enumerate(("ahead", "right", "up"))},
        **{f"{w}_sigma_m": sigma[:, k] for k, w in enumerate(("ahead", "right", "up"))},
        "speed_hz": ranging.speed_hz,
        "sensor_roll_deg": windows.roll / DEGREE,
    }
    with result_in(claimed, figures, trust, job.log_path, output) as directory:
        write_table(columns, directory / "range.parquet")
        picture = RangePicture(magnet, sensor, places.place, places.cov)
        write_range_plot(directory / "range.png", picture, high_side=ranging.high_side)
    return figures


def _judge_ranging(log: Log, ranging_log: RangingLog, ranging: Ranged) -> tuple[Trust, float]:
    from magfusion.estimation.batch.hypothesis_selection import AMBIGUOUS_CHI_SQUARE

    fields = ranging_log.windows.fields
    name = fields.channels[0][0]
    remedy = (
        "Check casing, depths and axes of the sensor, use the part in which both wells are straight"
        " (--start, --end), or declare a larger model_error."
    )
    fitted = unexplained(f"the magnet {name}", ranging.chi_square, ranging.freedom, remedy)
    trust, excess = trust_of(fitted)
    findings = []
    if ranging.rival_chi_square < AMBIGUOUS_CHI_SQUARE * excess:
        text = (
            f"A second well geometry fits almost equally well: its chi square is higher by only"
            f" {ranging.rival_chi_square:.2g}. Continue the pass beyond the sensor."
        )
        findings.append(Finding("ambiguous", text))
    if not ranging.converged:
        findings.append(
            Finding(
                "not_converged",
                "The iteration did not converge: the last pass still moved the wells. Record a"
                " longer pass.",
            )
        )
    snr = np.abs(fields.phasor_sensor[:, 0]) ** 2
    noise = np.trace(fields.phasor_cov[:, 0], axis1=1, axis2=2)
    strongest = float(np.sqrt(np.max(np.sum(snr, axis=1) / np.maximum(noise, 1e-300))))
    if strongest < MIN_SNR:
        text = f"Signal below noise (SNR {strongest:.2g}). Reduce the distance."
        findings.append(Finding("low_signal", text, Verdict.FAILED))
    if not ranging_log.high_side:
        why = "holds no inertial samples" if not log.inertial else "is of an upright hole"
        text = (
            f"The log {why}, so that directions are from the sensor's third axis, not from the high"
            " side, and the sensor is assumed not to rotate."
        )
        findings.append(Finding("assumed", text))
    if not ranging_log.windows.angle_known:
        text = (
            "The angle of the shaft is estimated from the field, not measured: the magnet's angle"
            " about it is undetermined. Distance and direction do not depend on it."
        )
        findings.append(Finding("geometry", text, Verdict.TRUSTWORTHY))
    return trust | Trust(tuple(findings)), excess


def _vague(wells: Wells, sensor: float) -> Trust:
    one = wells.wells_at(sensor)
    if one.distance_sigma <= VAGUE * one.distance:
        return Trust()
    text = (
        f"The sigma of the distance, {one.distance:.3g} m, is {one.distance_sigma:.2g} m. Record a"
        " pass as long as the distance, on both sides of the sensor."
    )
    return Trust((Finding("few_data", text),))


def _figures(ranging_log: RangingLog, ranging: Ranged, wells: Wells, sensor: object) -> Figures:
    figures = [
        Figure("windows", len(ranging_log.windows.fields)),
        Figure("windows_dropped", ranging_log.dropped, section=Section.REPORT),
        Figure("angle", "measured" if ranging_log.windows.angle_known else "followed"),
        Figure("speed_mean_hz", float(np.mean(ranging_log.speed_hz)), "Hz"),
        Figure("speed_spread_hz", float(np.std(ranging_log.speed_hz)), "Hz"),
        Figure(
            "residual_rms",
            float(np.sqrt(ranging.chi_square / ranging.freedom)),
            label="residual (1 expected)",
        ),
    ]
    if ranging_log.inclination is not None:
        figures.append(Figure("inclination_deg", ranging_log.inclination / DEGREE, "deg"))
    for k, depth in enumerate(np.unique(np.round(np.asarray(sensor), 2)), start=1):
        one = wells.wells_at(float(depth))
        rows = (
            ("sensor_depth_m", float(depth), "m"),
            ("distance_m", one.distance, "m"),
            ("distance_sigma_m", one.distance_sigma, "m"),
            ("high_side_deg", one.direction / DEGREE, "deg"),
            ("high_side_sigma_deg", one.direction_sigma / DEGREE, "deg"),
            ("abreast_depth_m", one.depth, "m"),
            ("abreast_depth_sigma_m", one.depth_sigma, "m"),
        )
        figures += [Figure(f"place_{k}_{name}", value, unit) for name, value, unit in rows]
    separate = wells.divergence()
    figures += [
        Figure("leads_right_deg", separate.right / DEGREE, "deg"),
        Figure("leads_right_sigma_deg", separate.right_sigma / DEGREE, "deg"),
        Figure("leads_up_deg", separate.up / DEGREE, "deg"),
        Figure("leads_up_sigma_deg", separate.up_sigma / DEGREE, "deg"),
    ]
    for name, value, sigma, prior in zip(
        ranging.names,
        ranging.values.tolist(),
        np.sqrt(np.diagonal(ranging.cov)[6:]).tolist(),
        ranging.prior_sigma.tolist(),
        strict=True,
    ):
        figures.append(Figure(f"found_{name}", value, section=Section.REPORT))
        figures.append(Figure(f"found_{name}_sigma", sigma, section=Section.REPORT))
        figures.append(Figure(f"found_{name}_prior_sigma", prior, section=Section.REPORT))
    return Figures(*figures)


COMMAND = Command(RangeSettings, run_range, example="magfusion range log -o range")
