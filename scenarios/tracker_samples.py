"""What a converter gives of a head before a source: drift of the drive, mains, noise and steps."""

import json
from itertools import pairwise
from typing import Any

import numpy as np
from scipy.interpolate import CubicSpline
from tracker_coils import CURRENT, FORMERS, LAYERS, ROWS, WIRE, winding_field
from tracker_head import GRAVITY, Config, Head
from tracker_plate import plate_fields

from magfusion.units import Array

RATE_HZ, FIELD_KNOTS_HZ = 20e3, 1000.0
EARTH_WORLD = np.array([0.0, 2e-5, -4.5e-5])  # T
BITS, RANGE = 16, 100e-6  # T
PIECE = 0.01  # s
MIN_SAMPLES = 8  # of a slot; for shorter ones the converter is a faster one
SOURCE_PPM = 20.0  # of a crystal
UNKNOWN = 0.0123  # s; when a cycle of a clock of its own begins
PLATE_KNOTS_HZ = 50.0

REGION = """region:
  half_space: {normal: [1, 0, 0]}
"""
IMU = """  imu:
    gyro_noise: 1.0e-4
    accel_noise: 1.0e-3
    gyro_bias_walk: 1.0e-6
    accel_bias_walk: 1.0e-5
    gyro_bias_sigma: 5.0e-3
    accel_bias_sigma: 0.05
    time_offset_sigma_s: 0.001
"""
PRIOR = """  motion_prior:
    accel_density_m_s2_rthz: 2.0
    angular_accel_density_rad_s2_rthz: 3.0
"""


def sample_times(config: Config) -> Array:
    """Return the stamps of the converter (s)."""
    rate_hz = RATE_HZ * np.ceil(MIN_SAMPLES * config.slots * config.rate_hz / RATE_HZ)
    return np.asarray(np.arange(int(config.duration * rate_hz)) / rate_hz)


def waveform(
    config: Config, head: Head, rng: np.random.Generator, gates: Array | None = None
) -> tuple[Array, Array]:
    """Return stamps and what the converter gives of three axes (T).

    Parameters
    ----------
    gates : ndarray, shape (n, 3), optional
        Share of its current that each coil has at each sample, where no clock determines it.
    """
    time = sample_times(config)
    knots = np.arange(0.0, config.duration + 2.0 / FIELD_KNOTS_HZ, 1.0 / FIELD_KNOTS_HZ)
    own_clock = (
        time if config.source_ppm is None else (time - UNKNOWN) * (1 + 1e-6 * config.source_ppm)
    )
    slot = np.floor(own_clock / config.cycle * config.slots + 1e-9).astype(int) % config.slots
    if gates is None:
        gates = (slot[:, None] == np.arange(3)).astype(float)
    current = np.exp(2j * np.pi * config.carrier_hz * own_clock)
    current *= 1.0 - config.drive_drift * time / 60.0
    coarse = np.arange(0.0, config.duration + 2.0 / PLATE_KNOTS_HZ, 1.0 / PLATE_KNOTS_HZ)
    metal = plate_fields(head, coarse)[0] if config.plate else None
    world_from_body = head.turn(knots)
    body = CubicSpline(knots, world_from_body.inv().apply(EARTH_WORLD))(time)
    for axis, former in enumerate(FORMERS):
        coil_world = winding_field(former, axis, head.place(knots))
        driven = (gates[:, axis] * current)[:, None]
        own = CubicSpline(knots, world_from_body.inv().apply(coil_world))(time)
        body += driven.real * own
        if metal is not None:
            added = CubicSpline(coarse, metal[axis])(knots)
            for wave, part in ((driven.real, added.real), (-driven.imag, added.imag)):
                body += wave * CubicSpline(knots, world_from_body.inv().apply(part))(time)
    hum = sum(
        share * np.cos(2.0 * np.pi * order * 49.97 * time + phase)
        for order, share, phase in ((1, 1.0, 0.3), (3, 0.3, 1.1), (5, 0.1, 2.0))
    )
    toward = CubicSpline(knots, world_from_body.inv().apply([0.6, 0.0, 0.8]))(time)
    body += config.mains * np.asarray(hum)[:, None] * toward
    body += config.noise * rng.standard_normal(body.shape)
    step = 2.0 * RANGE / 2**BITS
    return time, step * np.round(body / step)


def site_text(config: Config) -> str:
    """Return the site as its owner would write it."""
    coils = "".join(
        f"""
      - slot: {axis}
        winding:
          axis: {np.eye(3)[axis].tolist()}
          current_a: {CURRENT}
          layers: {LAYERS}
          rows: {ROWS}
          inner_radius_m: {former}
          wire_m: {WIRE}"""
        for axis, former in enumerate(FORMERS)
    )
    return f"""magfusion_site: 1
world:
  gravity_m_s2: {GRAVITY}
  earth_field_t: {EARTH_WORLD.tolist()}
  model_error: 0.002
beacons:
  - name: T
    position_m: [0, 0, 0]
    rpy_deg: [0, 0, 0]
    frequency_hz: {config.carrier_hz}
    slots: {{duration_s: {config.cycle / config.slots!r}, count: {config.slots}}}
    synchronised: {"true" if config.source_ppm is None else "false"}
    coils:{coils}
{REGION if config.hemisphere else ""}platform:
{IMU if config.inertial else PRIOR}  magnetometer:
    noise_density_t_rthz: 1.4e-11
"""


def records(config: Config) -> bytes:
    """Return the streams as the lines that a driver would write, every hundredth of a second."""
    rng = np.random.default_rng(config.seed + 1)
    head = Head(config)
    wave, imu = waveform(config, head, rng), head.imu(config, rng)
    lines, edges = [], PIECE * np.arange(round(config.duration / PIECE) + 1)
    for begin, end in pairwise(edges.tolist()):
        own = slice(*np.searchsorted(imu[0], [begin - 1e-9, end - 1e-9]))
        rows = slice(*np.searchsorted(wave[0], [begin - 1e-9, end - 1e-9]))
        record: dict[str, Any] = {
            "magnetometer": {"time": wave[0][rows].tolist(), "field": wave[1][rows].tolist()},
        }
        if config.inertial:
            parts = (part[own].tolist() for part in imu)
            record = {"imu": dict(zip(("time", "gyro", "accel"), parts, strict=True))} | record
        lines.append(json.dumps(record).encode())
    return b"\n".join(lines) + b"\n"
