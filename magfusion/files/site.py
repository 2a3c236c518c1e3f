"""A site as one YAML file: `load_site` validates it, `save_site` round-trips."""

import datetime
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np

from magfusion.errors import InputError
from magfusion.files.field_map import read_field_maps, write_field_maps
from magfusion.files.site_aiding import aiding_entries, aiding_sensor
from magfusion.files.site_beacon import MARKED, BeaconEntry, SlotsEntry
from magfusion.files.site_correlation import load_correlation, save_correlation
from magfusion.files.site_ground import ground_entry, log_sigma
from magfusion.files.site_magnetometer import magnetometer_entries, magnetometer_of, with_left_out
from magfusion.files.site_motion import MotionEntry, imu_entry, intrinsics_entry, prior_entry
from magfusion.files.site_plain import (
    degree_sigma_entry,
    degrees,
    model_of,
    plain,
    rotation_of,
    rpy_deg,
    sigma_entry,
)
from magfusion.files.site_region import region_entry
from magfusion.files.site_rotor import rotor_entry
from magfusion.files.site_schema import ClockEntry, EarthEntry, SiteEntry
from magfusion.files.site_temperature import temperature_entry
from magfusion.files.steel_map import read_steel_fields, write_steel_fields
from magfusion.files.yaml_files import StrictModel, read_yaml, write_yaml
from magfusion.model.arguments import check_arguments
from magfusion.model.field_map import FieldMap
from magfusion.model.physics.earth import earth_field_world
from magfusion.model.platform_motion import NO_IMU
from magfusion.model.site import (
    Beacon,
    BeaconSigma,
    ClockModel,
    Coil,
    EarthModel,
    ImuModel,
    Location,
    MarkedSlots,
    MotionModel,
    Platform,
    Site,
    Slots,
    rotor_coils,
)
from magfusion.model.steel_field import SteelField
from magfusion.model.without_imu import as_declared
from magfusion.units import DEGREE, Array

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

SAME_FIELD = 1e-12  # T; less is rounding
Model = TypeVar("Model", bound="DataclassInstance")


def load_site(
    path: Path | str, *, unknown: bool = False, without: bool = False, several: bool = False
) -> Site:
    """Read a site from its YAML file.

    Parameters
    ----------
    unknown : bool
        Whether beacons that were never surveyed are accepted; few jobs can do with them.
    without : bool
        Whether a site without any beacon is accepted.
    several : bool
        Whether several magnetometers are accepted.

    Returns
    -------
    Site
        With ``earth_field_world`` by the IGRF, axes east, north, up, where the file gives a
        location.

    Raises
    ------
    InputError
        Where the file is no YAML mapping, or a key is unknown, missing, of the wrong type or out
        of range; the sentence names the file, the key's path, what was found and the remedy.
    """
    path = Path(path)
    entry = read_yaml(path, SiteEntry)
    if not entry.beacons and not without:
        raise InputError(f"{path}: beacons: found []; describe at least one beacon.")
    if not unknown:
        _refuse_unknown(entry, path)
    if not several and len(entry.platform.every) > 1:
        raise InputError(
            f"{path}: platform.magnetometers: this job takes one magnetometer; give a site that has"
            f" but one of {', '.join(str(m.name) for m in entry.platform.every)}."
        )
    return site_of_entry(entry, path)


def site_of_entry(entry: SiteEntry, path: Path) -> Site:
    """Return the site that a file describes."""
    location, field_world = _location_and_field(entry, path)
    maps, ground = _field_maps(entry, path), entry.world.conductivity_s_m
    beacons = tuple(map(_beacon, entry.beacons))
    steel = _steel(entry, beacons, path)
    sensors = tuple(map(magnetometer_of, entry.platform.every))
    site = Site(
        gravity=entry.world.gravity_m_s2,
        model_error=entry.world.model_error,
        model_error_length=entry.world.model_error_correlation_m,
        beacons=tuple(
            replace(b, field_map=maps.get(b.name), steel=steel.get(b.name), conductivity=ground)
            for b in beacons
        ),
        log_conductivity_sigma=log_sigma(ground, entry.world.sigma.conductivity_s_m),
        platform=Platform(
            NO_IMU if entry.platform.imu is None else model_of(ImuModel, entry.platform.imu),
            sensors[0],
            model_of(MotionModel, entry.platform.motion),
            None if entry.platform.motion_prior is None else entry.platform.motion_prior.prior(),
            further=sensors[1:],
            imu_intrinsics=None
            if entry.platform.imu_intrinsics is None
            else entry.platform.imu_intrinsics.intrinsics(),
        ),
        earth_field_world=field_world,
        location=location,
        calibration=entry.calibration,
        clock=model_of(ClockModel, entry.clock),
        earth=model_of(EarthModel, entry.world.earth),
        region=None if entry.region is None else entry.region.region(),
        reference_world=None if entry.reference is None else entry.reference.position_m,
        aiding=tuple(map(aiding_sensor, entry.aiding)),
    )
    if entry.correlation is None:
        return site
    return replace(site, correlation=load_correlation(site, path.parent / entry.correlation))


def _location_and_field(entry: SiteEntry, path: Path) -> tuple[Location | None, Array | None]:
    """Return the place, if the file gives it, and the Earth's field there, or that of the file."""
    if entry.world.location is None:
        return None, entry.world.earth_field_t
    location = model_of(Location, entry.world.location)
    try:
        return location, _reference_field(location)
    except InputError as error:
        raise InputError(f"{path}: world.{error}") from error


def _refuse_unknown(entry: SiteEntry, path: Path) -> None:
    for i, beacon in enumerate(entry.beacons):
        if beacon.unknown == "pose" and beacon.rotor is not None and len(entry.beacons) == 1:
            raise InputError(
                f"{path}: beacons[0].unknown: this job needs the pose of beacon {beacon.name};"
                " where a rotor is the only beacon, magfusion range finds the wells from each other"
            )
        if beacon.unknown is not None:
            raise InputError(
                f"{path}: beacons[{i}].unknown: this job needs the {beacon.unknown} of beacon"
                f" {beacon.name}; find it by magfusion smooth or calibrate log, which write it"
                " into their site.yaml."
            )


def save_site(site: Site, path: Path | str) -> None:
    """Write a site as YAML that `load_site` reads back to float precision.

    Parameters
    ----------
    path : Path
        Replaced as a whole, or left as it was if anything fails.  Field maps are written next to
        it, as ``<stem>_field_map.parquet``, a map of steel as ``<stem>_steel.parquet``, a
        correlation as ``<stem>_correlation.parquet``.

    Raises
    ------
    TypeError
        Where the first argument is no site.
    """
    check_arguments("save_site", site=(site, Site))
    path, site = Path(path), as_declared(site)
    maps = {b.name: b.field_map for b in site.every_beacon if b.field_map is not None}
    others, fields, correlation = site_tables(path)
    content = site_content(site)
    if maps:
        content["world"]["field_map"] = others.name
        write_field_maps(maps, others)
    steel = {b.name: b.steel for b in site.every_beacon if b.steel is not None}
    if steel:
        content["world"]["steel"] = fields.name
        write_steel_fields(fields, steel)
    if site.correlation is not None:
        content["correlation"] = correlation.name
        save_correlation(site, correlation)
    write_yaml(content, path)


def site_tables(path: Path) -> list[Path]:
    """Return where maps of fields, a map of steel and a correlation lie next to a site's file."""
    kinds = "field_map", "steel", "correlation"
    return [path.with_name(f"{path.stem}_{kind}.parquet") for kind in kinds]


def site_content(site: Site) -> dict[str, Any]:
    """Return what a site's file holds, without the names of other files."""
    site = as_declared(site)
    content = {
        "magfusion_site": 1,
        "world": _world_entry(site),
        "beacons": [_beacon_entry(b) for b in site.every_beacon],
        "platform": {
            **imu_entry(site.platform.imu),
            **intrinsics_entry(site.platform.imu_intrinsics),
            **magnetometer_entries(with_left_out(site.platform)),
            **_model_entry("motion", site.platform.motion, MotionEntry),
            **prior_entry(site.platform.motion_prior),
        },
        **_model_entry("clock", site.clock, ClockEntry),
        **region_entry(site.region),
        **aiding_entries(site.aiding),
    }
    if site.reference_world is not None:
        content["reference"] = {"position_m": site.reference_world.tolist()}
    if site.calibration is not None:
        content["calibration"] = plain(site.calibration)
    return content


def _field_maps(entry: SiteEntry, path: Path) -> dict[str, FieldMap]:
    if entry.world.field_map is None:
        return {}
    place = path.parent / entry.world.field_map
    maps = read_field_maps(place)
    known = [b.name for b in entry.beacons]
    for name in maps:
        if name not in known:
            raise InputError(
                f"{place}: maps beacon {name}, which {path} does not have (it has "
                f"{', '.join(known)}); learn the map of this site."
            )
    return maps


def _steel(entry: SiteEntry, beacons: tuple[Beacon, ...], path: Path) -> dict[str, SteelField]:
    if entry.world.steel is None:
        return {}
    coils = {beacon.name: len(beacon.coils) for beacon in beacons}
    return read_steel_fields(path.parent / entry.world.steel, coils)


def _reference_field(location: Location) -> Array:
    day = datetime.date.fromisoformat(location.date)
    return earth_field_world(location.latitude_deg, location.longitude_deg, location.height_m, day)


def _is_reference(field_world: Array, location: Location) -> bool:
    """Return whether a field is the one that a reader of the location will take."""
    return float(np.max(np.abs(field_world - _reference_field(location)))) < SAME_FIELD


def _beacon(entry: BeaconEntry) -> Beacon:
    sigma, rotor = entry.sigma, None if entry.rotor is None else entry.rotor.rotor()
    return Beacon(
        name=entry.name,
        position_world=np.full(3, np.nan) if entry.position_m is None else entry.position_m,
        world_from_beacon=np.full((3, 3), np.nan)
        if entry.rpy_deg is None
        else rotation_of(entry.rpy_deg),
        unknown=entry.unknown,
        frequency_hz=entry.frequency_hz,
        coils=tuple(coil.coil() for coil in entry.coils or [])
        if rotor is None
        else rotor_coils(rotor, entry.frequency_hz),
        rotor=rotor,
        synchronised=entry.synchronised,
        slots=_slots(entry.slots),
        model_error=entry.model_error,
        noise_factor=entry.noise_factor,
        hemisphere_beacon=entry.hemisphere,
        temperature_model=None if entry.warming is None else entry.warming.temperature_model(),
        sigma=BeaconSigma(
            position_world=sigma.position_m,
            rotation_beacon=sigma.rotation_deg * DEGREE,
            log_moment=np.broadcast_to(sigma.log_moment, entry.coil_count).copy(),
        ),
    )


def _model_entry(key: str, model: object, entry: type[StrictModel]) -> dict[str, Any]:
    """Return what of a model is not as usual, as an entry under a key; nothing where all is."""
    values = zip(
        entry.model_fields, vars(model).values(), vars(type(model)()).values(), strict=True
    )
    changed = {
        name: float(f"{value / DEGREE:.15g}") if name.endswith("_deg") else float(value)
        for name, value, usual in values
        if value != usual
    }
    return {key: changed} if changed else {}


def _world_entry(site: Site) -> dict[str, Any]:
    entry: dict[str, Any] = {
        "gravity_m_s2": float(site.gravity),
        "model_error": float(site.model_error),
    }
    if site.model_error_length != Site.model_error_length:
        entry["model_error_correlation_m"] = float(site.model_error_length)
    entry |= ground_entry(site)
    field = site.earth_field_world
    if site.location is not None and (field is None or _is_reference(field, site.location)):
        day = datetime.date.fromisoformat(site.location.date)
        entry["location"] = plain(vars(site.location) | {"date": day})
    elif field is not None:
        entry["earth_field_t"] = plain(field)
    return entry | _model_entry("earth", site.earth, EarthEntry)


def _beacon_entry(beacon: Beacon) -> dict[str, Any]:
    place: dict[str, Any] = {}
    if beacon.unknown is not None:
        place["unknown"] = beacon.unknown
    if beacon.unknown in (None, "attitude"):
        place["position_m"] = plain(beacon.position_world)
    if beacon.unknown in (None, "position"):
        place["rpy_deg"] = rpy_deg(beacon.world_from_beacon)
    return {
        "name": beacon.name,
        **place,
        "frequency_hz": float(beacon.frequency_hz),
        **_source_entry(beacon),
        **_slots_entry(beacon),
        "synchronised": bool(beacon.synchronised),
        **_noise_entry(beacon),
        "sigma": {
            "position_m": sigma_entry(beacon.sigma.position_world),
            "rotation_deg": degree_sigma_entry(beacon.sigma.rotation_beacon),
            "log_moment": sigma_entry(beacon.sigma.log_moment),
        },
    }


def _source_entry(beacon: Beacon) -> dict[str, Any]:
    if beacon.rotor is None:
        return {"coils": [_coil_entry(c) for c in beacon.coils]}
    size = np.linalg.norm(beacon.moments_beacon, axis=1)[:2]
    declared = np.linalg.norm(beacon.rotor.turning_moments, axis=1)
    return rotor_entry(beacon.rotor, float(np.mean(np.log(size / declared))))


def _noise_entry(beacon: Beacon) -> dict[str, Any]:
    entry = {} if beacon.model_error is None else {"model_error": float(beacon.model_error)}
    if beacon.noise_factor != Beacon.noise_factor:
        entry["noise_factor"] = float(beacon.noise_factor)
    if beacon.hemisphere_beacon is not None:
        entry["hemisphere"] = plain(beacon.hemisphere_beacon)
    return entry | temperature_entry(beacon.temperature_model)


def _slots(entry: SlotsEntry | str | None) -> Slots | MarkedSlots | None:
    if isinstance(entry, str):
        return MarkedSlots()
    return None if entry is None else model_of(Slots, entry)


def _slots_entry(beacon: Beacon) -> dict[str, Any]:
    slots = beacon.slots
    if slots is None:
        return {}
    if isinstance(slots, MarkedSlots):
        return {"slots": MARKED}
    times = {"duration_s": float(slots.duration), "count": int(slots.count)}
    return {"slots": times | {"start_s": float(slots.start)}}


def _coil_entry(coil: Coil) -> dict[str, Any]:
    entry: dict[str, Any] = {
        "moment_a_m2": plain(coil.moment_beacon),
        "phase_deg": degrees(coil.phase),
    }
    if coil.centre_beacon.any():
        entry["centre_m"] = plain(coil.centre_beacon)
    options = {
        "radius_m": coil.radius,
        "length_m": coil.length,
        "frequency_hz": coil.frequency_hz,
        "slot": coil.slot,
        "current_a": coil.current,
    }
    return entry | {k: plain(v) for k, v in options.items() if v is not None}
