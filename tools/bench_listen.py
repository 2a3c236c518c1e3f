"""Time `listen` of a sound card against the obvious way to do its part, in one run.

Four tones at 1 to 1.5 kHz in three channels of 48 kHz are received in blocks as a card delivers
them, from memory.  Printed are, in a second of sound:

- processor time of `listen` (bands, search for lost samples, records as MessagePack or JSON);
- the same without the search and the records: the bands alone;
- the obvious way: each channel is mixed with each tone and filtered by `scipy.signal.upfirdn` with
  one filter of the same bands, and of the same delay;

and the latency of the samples: from the instant of each to that when its record is written.  The
delay of the filter and the wait for the end of a block are exact, the rest is measured.
A card, a pipe and `navigate` are not part of it.
"""

import argparse
import io
import json
import time
from collections.abc import Callable
from dataclasses import replace

import numpy as np
from scipy.signal import firwin, kaiserord, upfirdn

from magfusion.files.stream_contents import write_record
from magfusion.jobs.listen_sound import BLOCK, WARM_UP, SoundSource
from magfusion.model.bandpass import PASS_HZ, STOP_DB, WIDEST_HZ, BandFilter, BandSampler
from magfusion.model.response import FrequencyResponse, PickupCoil
from magfusion.model.site import Coil, Site
from magfusion.simulation.demo_site import demo_site
from magfusion.units import Array

RATE_HZ = 48_000
TONES_HZ = (1010.0, 1130.0, 1270.0, 1430.0)
COIL = PickupCoil(1000.0, 5e-4, 4000.0, 5.0, 200.0)
MAX_LATENCY = 0.05  # s
MAX_SHARE = 0.1  # of a core


def card_site() -> Site:
    """Return the demo's beacons at tones of a sound card, with pick-up coils."""
    site = demo_site()
    coils = (Coil(np.array([3.0, 0, 0]), 0.0), Coil(np.array([0, 3.0, 0]), -np.pi / 2))
    beacons = [
        replace(b, coils=coils, frequency_hz=f, synchronised=False)
        for b, f in zip(site.beacons, TONES_HZ, strict=True)
    ]
    response = FrequencyResponse.of_coil(COIL)
    magnetometer = replace(site.platform.magnetometer, response=response, ac_coupled=True)
    platform = replace(site.platform, magnetometer=magnetometer)
    return replace(site, beacons=tuple(beacons), platform=platform)


def sound(seconds: float) -> Array:
    """Return tones whose vectors turn slowly, with noise of -120 dB, (n, 3)."""
    rng, at = np.random.default_rng(0), np.arange(round(seconds * RATE_HZ)) / RATE_HZ
    result = rng.normal(0.0, 1e-6, (len(at), 3))
    for tone_hz in TONES_HZ:
        rate, phase = rng.normal(0.0, 2.0, 3), rng.uniform(0.0, 6.0, 3)
        result += (
            0.1 * np.cos(rate * at[:, None] + phase) * np.cos(2 * np.pi * tone_hz * at)[:, None]
        )
    return result


def blocks(samples: Array) -> list[Array]:
    """Return what a card delivers."""
    length = int(BLOCK * RATE_HZ)
    return [samples[k : k + length] for k in range(0, len(samples), length)]


def share(run: Callable[[], object], seconds: float) -> float:
    """Return the processor time of each second of sound."""
    begin = time.process_time()
    run()
    return (time.process_time() - begin) / seconds


def listened(samples: Array, site: Site, form: str) -> list[float]:
    """Return the latency of each sample but for those that `WARM_UP` leaves out (s)."""
    source, sink, result = SoundSource("card", RATE_HZ, "x,y,z", 1.0, site), io.BytesIO(), []
    received = 0
    for block in blocks(samples):
        received += len(block)
        begin = time.process_time()
        for record in source.records(block, received / RATE_HZ):
            write_record(record, sink, form)  # type: ignore[arg-type]
            written = received / RATE_HZ + time.process_time() - begin
            result += [written - at for at in record["baseband"]["time"]]
    return result


def mixed(samples: Array, decimation: int) -> None:
    """Reduce as a user of scipy does at once; the filter's history is not even kept."""
    length, beta = kaiserord(STOP_DB, WIDEST_HZ / (0.5 * RATE_HZ))
    taps = firwin(length | 1, PASS_HZ + 0.5 * WIDEST_HZ, window=("kaiser", beta), fs=RATE_HZ)
    for block in np.array_split(samples, max(len(samples) // RATE_HZ, 1)):
        at = np.arange(len(block)) / RATE_HZ
        for tone_hz in TONES_HZ:
            carrier = np.exp(-2j * np.pi * tone_hz * at)
            upfirdn(taps, block * carrier[:, None], down=decimation, axis=0)


def main() -> int:
    """Print the figures; 1 where a limit of `listen` is exceeded."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n\n")[0])
    parser.add_argument("--seconds", type=float, default=20.0, help="length of the sound")
    seconds = parser.parse_args().seconds
    samples, site = sound(seconds), card_site()
    band = BandFilter.of_site(site, RATE_HZ)
    assert band is not None
    sampler, latency = BandSampler(band), np.array(listened(samples, site, "msgpack"))
    figures = {
        "listen_msgpack": share(lambda: listened(samples, site, "msgpack"), seconds),
        "listen_json": share(lambda: listened(samples, site, "json"), seconds),
        "bands": share(lambda: [sampler.push(block) for block in blocks(samples)], seconds),
        "scipy": share(lambda: mixed(samples, band.decimation), seconds),
        "latency_filter_s": band.middle / RATE_HZ,
        "latency_block_s": BLOCK,
        "latency_p50_s": float(np.median(latency)),
        "latency_p99_s": float(np.percentile(latency, 99)),
        "left_out_s": WARM_UP,
    }
    print(json.dumps({name: round(value, 5) for name, value in figures.items()}, indent=1))
    return int(figures["listen_msgpack"] > MAX_SHARE or figures["latency_p99_s"] > MAX_LATENCY)


if __name__ == "__main__":
    raise SystemExit(main())
