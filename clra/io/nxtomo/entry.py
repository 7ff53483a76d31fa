"""Which group of an NXtomo file is the scan, and which is its detector."""

from __future__ import annotations

import h5py

from clra.errors import InputError
from clra.io.hdf5 import find, peek, text


def scan_entry(file: h5py.File, name: str | None) -> h5py.Group:
    """Return the group of the scan.

    Parameters
    ----------
    file : h5py.File
        Where to look: at the root, and below its groups.
    name : str or None
        Which; only needed where there are several.

    Raises
    ------
    InputError
        If there is none, or several and no name: those found are listed.
    """
    entries = _entries(file)
    if name is not None:
        group = find(file, name)
        if isinstance(group, h5py.Group):
            return group
        listed = ", ".join(map(text, entries)) or "none"
        raise InputError.at(file.filename, "entry", repr(name), f"one of: {listed}")
    named = {n: g for n, g in entries.items() if _definition(g) == "NXtomo"}
    entries = named or entries
    if not entries:
        found = f"groups {', '.join(map(text, file)) or 'none'}"
        raise InputError.at(
            file.filename, "/", found, "an NXtomo entry with instrument/detector/data"
        )
    if len(entries) > 1:
        listed = ", ".join(map(text, entries))
        raise InputError.at(
            file.filename,
            "/",
            f"{len(entries)} scans: {listed}",
            "one: say which with entry= / --entry",
        )
    return next(iter(entries.values()))


def _entries(file: h5py.File) -> dict[str, h5py.Group]:
    """List the groups that may be scans: at the root and below groups of the root."""
    found = {}
    for name in file:
        group = peek(file, name)
        if not isinstance(group, h5py.Group):
            continue
        inner = [(f"{name}/{part}", peek(group, part)) for part in group]
        for path, candidate in [(name, group), *inner]:
            if isinstance(candidate, h5py.Group) and (
                _definition(candidate) == "NXtomo" or _detectors(candidate)
            ):
                found[path] = candidate
    return found


def _definition(group: h5py.Group) -> str:
    definition = peek(group, "definition")
    if isinstance(definition, h5py.Dataset):
        return text(definition)
    return text(group.attrs.get("definition", ""))


def _detectors(entry: h5py.Group) -> list[h5py.Group]:
    """List the detectors: the one that NXtomo names, or those that tell their frames apart."""
    instrument = peek(entry, "instrument")
    if not isinstance(instrument, h5py.Group):
        return []
    detector = peek(instrument, "detector")
    if isinstance(detector, h5py.Group):
        return [detector]
    parts = [peek(instrument, name) for name in instrument]
    return [p for p in parts if isinstance(p, h5py.Group) and "data" in p and "image_key" in p]


def scan_detector(entry: h5py.Group) -> h5py.Group:
    """Return the detector of a scan.

    Raises
    ------
    InputError
        If there is none, several, or its data lead nowhere.
    """
    detectors = _detectors(entry)
    if not detectors:
        where = f"{entry.name}/instrument/detector"
        raise InputError.at(entry.file.filename, where, "nothing", "the detector of an NXtomo scan")
    for detector in detectors:
        find(detector, "data")
    if len(detectors) > 1:
        listed = ", ".join(d.name for d in detectors)
        where = f"{entry.name}/instrument"
        raise InputError.at(entry.file.filename, where, f"several detectors: {listed}", "one")
    return detectors[0]
