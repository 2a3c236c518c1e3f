"""Keys of a magnetometer's frequency response."""

from dataclasses import astuple
from typing import Annotated, Any

import numpy as np
from pydantic import Field

from magfusion.files.site_plain import degree_sigma_entry, sigma_entry
from magfusion.files.site_values import (
    HIGHEST_FREQUENCY,
    LOWEST_FREQUENCY,
    MAX_ANGLE,
    AboveZero,
    at_least_one,
    between,
    refusal_at,
    sigma_array,
)
from magfusion.files.yaml_files import StrictModel
from magfusion.model.response import AxisResponses, FrequencyResponse, PickupCoil, ResponseSigma
from magfusion.units import DEGREE, Array


class ResponseEntry(StrictModel):
    """The response at one frequency."""

    frequency_hz: Annotated[float, between(LOWEST_FREQUENCY, HIGHEST_FREQUENCY)]
    gain: Annotated[float, Field(gt=0.0), between(1e-6, 1e6)]
    phase_deg: Annotated[float, between(-MAX_ANGLE, MAX_ANGLE)] = 0.0


Listed = Annotated[list[ResponseEntry], at_least_one("frequency")]


class ResponseSigmaEntry(StrictModel):
    """Sigmas of the responses of y and z relative to x at one frequency."""

    frequency_hz: Annotated[float, between(LOWEST_FREQUENCY, HIGHEST_FREQUENCY)]
    gain: Annotated[Array, sigma_array(2, largest=1.0)]
    phase_deg: Annotated[Array, sigma_array(2, largest=90.0)]


class AxisResponsesEntry(StrictModel):
    """The response of each axis where they differ."""

    x: Listed
    y: Listed
    z: Listed

    @property
    def axes(self) -> dict[str, list[ResponseEntry]]:
        """Each by its letter."""
        return {"x": self.x, "y": self.y, "z": self.z}


class CoilEntry(StrictModel):
    """A pick-up coil with its amplifier, recorded as volts."""

    turns: Annotated[AboveZero, between(1.0, 1e6)]
    area_m2: Annotated[AboveZero, between(1e-9, 1e3)]
    resonance_hz: Annotated[float, between(LOWEST_FREQUENCY, 1e9)]
    quality: Annotated[AboveZero, between(1e-3, 1e4)]
    amplifier_gain: Annotated[AboveZero, between(1e-6, 1e8)] = 1.0

    def response(self) -> FrequencyResponse:
        """Return its response to volts as they are read."""
        return FrequencyResponse.of_coil(PickupCoil(*self.model_dump().values()))


class AxisCoilsEntry(StrictModel):
    """The coil of each axis where they differ."""

    x: CoilEntry
    y: CoilEntry
    z: CoilEntry


def responses_of(
    shared_by: list[ResponseEntry] | CoilEntry | None,
    separately: AxisResponsesEntry | AxisCoilsEntry | None,
) -> FrequencyResponse | AxisResponses | None:
    """Return the entries of all axes, or of each."""
    if separately is not None:
        return AxisResponses(*(_response(getattr(separately, axis)) for axis in "xyz"))
    return _response(shared_by) if shared_by else None


def _response(entries: list[ResponseEntry] | CoilEntry) -> FrequencyResponse:
    """Return the response of a coil, or the entries in order of frequency."""
    if isinstance(entries, CoilEntry):
        return entries.response()
    rows = sorted((e.frequency_hz, e.gain, e.phase_deg * DEGREE) for e in entries)
    return FrequencyResponse(*np.array(rows).T)


def response_sigma(entries: list[ResponseSigmaEntry] | None) -> ResponseSigma | None:
    """Return the sigmas of all entries, in order of frequency."""
    if entries is None:
        return None
    rows = sorted(entries, key=lambda entry: entry.frequency_hz)
    columns = zip(*((e.frequency_hz, e.gain, e.phase_deg * DEGREE) for e in rows), strict=True)
    return ResponseSigma(*map(np.array, columns))


def response_sigma_entry(sigma: ResponseSigma | None) -> dict[str, Any]:
    """Return their entry of a site's file."""
    if sigma is None:
        return {}
    rows = zip(sigma.frequency_hz, sigma.gain, sigma.phase, strict=True)
    keys = tuple(ResponseSigmaEntry.model_fields)
    parts = ((float(f), sigma_entry(g), degree_sigma_entry(p)) for f, g, p in rows)
    return {"response_sigma": [dict(zip(keys, row, strict=True)) for row in parts]}


def check_response_sigma(
    entries: list[ResponseSigmaEntry], tones_hz: Array, at: tuple[str | int, ...]
) -> None:
    """Reject rows that are repeated, or a tone without one.

    `at`: their place in the site's file.
    """
    given = sorted(entry.frequency_hz for entry in entries)
    tones = np.unique(tones_hz[tones_hz > 0.0]).tolist()
    if len(set(given)) < len(given) or not set(tones) <= set(given):
        known = ", ".join(f"{tone:g}" for tone in tones)
        raise refusal_at(at, given, f"give one row for each tone: {known} Hz")


def check_response(
    entries: list[ResponseEntry], tones_hz: Array, at: tuple[str | int, ...]
) -> None:
    """Reject a repeated frequency, and tones beyond those that are given.

    `at`: their place in the site's file.
    """
    given = [entry.frequency_hz for entry in entries]
    for k, frequency in enumerate(given):
        if frequency in given[:k]:
            remedy = "give each frequency once"
            raise refusal_at((*at, k, "frequency_hz"), frequency, remedy)
    beyond = [f for f in tones_hz if f > 0.0 and not min(given) <= f <= max(given)]
    if beyond:
        remedy = f"give it as far as the tone at {beyond[0]:g} Hz, too"
        raise refusal_at(at, given, remedy)


def response_entry(response: FrequencyResponse | AxisResponses | None) -> dict[str, Any]:
    """Return its entry of a site's file."""
    if response is None:
        return {}
    if isinstance(response, AxisResponses):
        key = "axis_responses" if response.x.coil is None else "axis_coils"
        axes = zip("xyz", response.axes, strict=True)
        return {key: {axis: _rows(own) for axis, own in axes}}
    return {"response" if response.coil is None else "coil": _rows(response)}


def _rows(response: FrequencyResponse) -> list[dict[str, float]] | dict[str, float]:
    if response.coil is not None:
        values = astuple(response.coil)
        return dict(zip(CoilEntry.model_fields, map(float, values), strict=True))
    rows = zip(response.frequency_hz, response.gain, response.phase / DEGREE, strict=True)
    return [
        {"frequency_hz": float(f), "gain": float(g), "phase_deg": round(float(p), 12)}
        for f, g, p in rows
    ]
