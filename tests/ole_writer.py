"""A writer of the OLE containers that Zeiss uses: just enough of [MS-CFB] for small files."""

import struct
from itertools import pairwise
from pathlib import Path

_SECTOR, _MINI, _CUTOFF = 512, 64, 4096
_FREE, _END, _FAT = 0xFFFFFFFF, 0xFFFFFFFE, 0xFFFFFFFD


def write_ole(path: Path, streams: dict[str, bytes]) -> None:
    """Write streams named like ``Storage/Stream``; storages are made as they are needed."""
    entries: list[dict] = [{"name": "Root Entry", "kind": 5, "children": []}]
    index = {"": 0}
    for name, data in streams.items():
        parts = name.split("/")
        for depth in range(1, len(parts)):
            storage = "/".join(parts[:depth])
            if storage not in index:
                _add(entries, index, storage, {"kind": 1, "children": []})
        _add(entries, index, name, {"kind": 2, "data": data})
    fat: list[int] = []
    sectors: list[bytes] = []

    def chain(data: bytes) -> int:
        first = len(sectors)
        pieces = [data[k : k + _SECTOR] for k in range(0, len(data), _SECTOR)]
        for k, piece in enumerate(pieces):
            sectors.append(piece.ljust(_SECTOR, b"\0"))
            fat.append(first + k + 1 if k < len(pieces) - 1 else _END)
        return first if pieces else _END

    small, mini_fat = b"", []
    for entry in entries:
        data = entry.get("data")
        entry["start"], entry["size"] = _END, 0
        if data is None:
            continue
        entry["size"] = len(data)
        if len(data) >= _CUTOFF:
            entry["start"] = chain(data)
        elif data:
            count, first = -(-len(data) // _MINI), len(mini_fat)
            entry["start"] = first
            mini_fat += [*range(first + 1, first + count), _END]
            small += data.ljust(count * _MINI, b"\0")
    entries[0]["start"], entries[0]["size"] = chain(small), len(small)
    packed = struct.pack(f"<{len(mini_fat)}I", *mini_fat)
    packed += b"\xff" * (-len(packed) % _SECTOR)
    mini_start, mini_count = chain(packed), len(packed) // _SECTOR
    directory = chain(b"".join(_directory(entry, entries) for entry in entries))
    count = 1
    while count * _SECTOR // 4 < len(fat) + count:
        count += 1
    places = list(range(len(sectors), len(sectors) + count))
    table = fat + [_FAT] * count
    table += [_FREE] * (count * _SECTOR // 4 - len(table))
    header = struct.pack(
        "<8s16sHHHHH6xIIIIIIIIII",
        b"\xd0\xcf\x11\xe0\xa1\xb1\x1a\xe1", b"", 0x3E, 3, 0xFFFE, 9, 6, 0, count, directory, 0,
        _CUTOFF, mini_start, mini_count, _END, 0, places[0],
    )  # fmt: skip
    header += struct.pack(f"<{len(places) - 1}I", *places[1:])
    body = b"".join(sectors) + struct.pack(f"<{len(table)}I", *table)
    path.write_bytes(header.ljust(_SECTOR, b"\xff") + body)


def _add(entries: list[dict], index: dict[str, int], name: str, entry: dict) -> None:
    parent, _, own = name.rpartition("/")
    index[name] = len(entries)
    entries[index[parent]]["children"].append(len(entries))
    entries.append({"name": own, **entry})


def _directory(entry: dict, entries: list[dict]) -> bytes:
    """128 bytes; the children of a storage hang on each other's right side."""
    children = sorted(
        entry.get("children", ()),
        key=lambda k: (len(entries[k]["name"]), entries[k]["name"].upper()),
    )
    for this, following in pairwise(children):
        entries[this]["right"] = following
    name = entry["name"].encode("utf-16-le") + b"\0\0"
    return struct.pack(
        "<64sHBBIII16sI8s8sIQ", name, len(name), entry["kind"], 1, _FREE,
        entry.get("right", _FREE), children[0] if children else _FREE, b"", 0, b"", b"",
        entry["start"], entry["size"],
    )  # fmt: skip
