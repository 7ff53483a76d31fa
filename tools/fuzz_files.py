"""Damage files at random and read them: every answer has to be a value or an InputError.

Seeds of each kind (NXtomo, TIFF, alignments, volumes) are made anew; a mutation flips bytes, cuts
the file, or replaces fields by ones of another type. Every file is read in full by a worker
process, so that a crash or a hang of a library is an answer as well, and open files are counted.
Hangs, of a minute or more, are counted and no error: two files in a thousand make tifffile or HDF5
loop.

    python tools/fuzz_files.py --files 1000 --seed 0
"""

from __future__ import annotations

import argparse
import random
import signal
import subprocess
import sys
import tempfile
import traceback
import warnings
from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path

import h5py
import numpy as np
import tifffile

import clra
from clra.errors import InputError
from clra.io.frames.stacks import FrameStack, RawLayout
from clra.io.nxtomo.writer import write_nxtomo
from clra.io.volumes.volume_files import read_volume
from clra.methods.alignment.result import AlignmentResult, Iteration

# Seconds after which a file counts as one that hangs the reader, and bytes that a worker may have.
_LONGEST, _MEMORY = 60, 6 << 30


def write_seeds(folder: Path) -> list[Path]:
    """Write whole files of each kind; return their paths."""
    random_numbers = np.random.default_rng(0)
    geometry = clra.helix(
        7, angle_step=0.5, z_step=0.1, source_to_axis=5, source_to_detector=50, pixel_size=0.5,
        shape=(6, 8),
    )  # fmt: skip
    motion = clra.Motion(shift_u=np.arange(7.0), shift_v=np.ones(7))
    counts = random_numbers.integers(200, 900, (7, 6, 8)).astype(np.uint16)
    flats, darks = np.full((2, 6, 8), 1000, np.uint16), np.full((1, 6, 8), 10, np.uint16)
    made = [folder / name for name in ("counts.nxs", "packed.nxs", "exact.nxs")]
    write_nxtomo(made[0], counts, geometry, flats=flats, darks=darks)
    write_nxtomo(made[1], counts, geometry, flats=flats, darks=darks)
    with h5py.File(made[1], "r+") as file:
        group = file["entry/instrument/detector"]
        pixels = group["data"][()]
        del group["data"]
        group.create_dataset(
            "data", data=pixels, chunks=(2, 6, 8), compression="gzip", shuffle=True
        )
    mask = np.ones((6, 8), np.bool_)
    mask[:, 0] = False
    lines = -np.log(counts / 1000.0).astype(np.float32)
    clra.write_scan(made[2], clra.Scan(lines, geometry, truth=motion, mask=mask))
    made += [folder / name for name in ("plain.tif", "packed.tif", "pages.tif")]
    tifffile.imwrite(made[3], counts, photometric="minisblack")
    tifffile.imwrite(made[4], counts, photometric="minisblack", compression="zlib", predictor=True)
    with tifffile.TiffWriter(made[5], bigtiff=True) as writer:
        for page in counts:
            writer.write(page, contiguous=False, photometric="minisblack")
    made.append(folder / "motion.h5")
    step = Iteration("QR", 1, 0.5, 0.5, 1.0, 0.9, 0.1, 2.0)
    result = AlignmentResult.from_motion(motion)
    clra.write_alignment(made[-1], clra.AlignmentResult(**{**vars(result), "history": (step,)}))
    grid = clra.VolumeGrid(shape=(3, 4, 5), voxel_size=0.1)
    for name in ("volume.h5", "volume_clra.tif"):
        made.append(folder / name)
        clra.write_volume(made[-1], np.ones(grid.shape, np.float32), grid)
    return made


def read(path: Path) -> None:
    """Read a file of whatever kind in full."""
    if path.suffix == ".nxs":
        scan = clra.read_scan(path)
        scan.read(0, scan.views)
        scan.geometry.to_astra()
    elif path.name.startswith("volume"):
        read_volume(path)
    elif path.suffix == ".tif":
        stack = FrameStack(path, RawLayout())
        try:
            stack[0 : stack.shape[0]]
        finally:
            stack.close()
    else:
        clra.read_alignment(path)


def flip(path: Path, chance: random.Random) -> str:
    """Change some bytes."""
    data = bytearray(path.read_bytes())
    for _ in range(chance.choice((1, 1, 3, 10, 100))):
        data[chance.randrange(len(data))] = chance.randrange(256)
    path.write_bytes(data)
    return "flip"


def cut(path: Path, chance: random.Random) -> str:
    """Cut the file short, or cut a piece out of it."""
    data = path.read_bytes()
    start = chance.randrange(len(data))
    end = len(data) if chance.random() < 0.7 else min(len(data), start + chance.randrange(1, 500))
    path.write_bytes(data[:start] + data[end:])
    return "cut"


def retype(path: Path, chance: random.Random) -> str:
    """Replace a field of an HDF5 file, or an attribute, by something of another type."""
    if not h5py.is_hdf5(path):
        return flip(path, chance)
    strange = (
        "text", b"\xff\xfe", np.nan, np.inf, -1, 2**62, 1e300, np.zeros(0), np.ones((2, 2)),
        np.arange(3) + 1j, np.array(["a", "b"], dtype="S3"), np.full(100, np.nan),
        np.zeros(7, np.int8), np.array(True), h5py.Empty("f4"), np.zeros((7, 1, 3)),
    )  # fmt: skip
    with h5py.File(path, "r+") as file:
        names: list[str] = []
        file.visit(names.append)
        item = file[chance.choice(names)]
        value = chance.choice(strange)
        if item.attrs and chance.random() < 0.4:
            item.attrs[chance.choice(list(item.attrs))] = value
        else:
            parent, name = item.parent, item.name
            del parent[name]
            if chance.random() < 0.1:
                parent.create_group(name)
            elif chance.random() > 0.1:
                parent[name] = value
    return "retype"


MUTATIONS: tuple[Callable[[Path, random.Random], str], ...] = (flip, flip, cut, retype)


def try_files(seeds: Sequence[Path], folder: Path, first: int, last: int, seed: int) -> None:
    """Read files number `first` to `last - 1`; print a line each: number, how, answer."""
    for number in range(first, last):
        chance = random.Random(1_000_003 * seed + number)
        source = chance.choice(seeds)
        path = folder / f"{source.stem}{source.suffix}"
        path.write_bytes(source.read_bytes())
        how = f"{source.name} {chance.choice(MUTATIONS)(path, chance)}"
        print(number, how, flush=True)
        signal.alarm(_LONGEST)
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                read(path)
            answer = "read"
        except InputError as error:
            answer = "refused" if path.name in str(error) else f"UNNAMED {error}"
        except BaseException as error:  # whatever it is, it is what the fuzzer looks for
            place = traceback.extract_tb(error.__traceback__)[-1]
            answer = f"BARE {type(error).__name__}: {error} ({place.filename}:{place.lineno})"
        signal.alarm(0)
        print(number, "=", " ".join(answer.split()), flush=True)
        path.unlink(missing_ok=True)


def _open_files() -> int:
    folder = Path("/proc/self/fd")
    return len(list(folder.iterdir())) if folder.is_dir() else 0


def fuzz(files: int, seed: int, batch: int = 250) -> tuple[Counter[str], list[str]]:
    """Return how often each answer was given, and each that is wrong with its file's number."""
    answers: Counter[str] = Counter()
    wrong: list[str] = []
    number = 0
    while number < files:
        last = min(number + batch, files)
        arguments = ["--worker", str(number), str(last), "--seed", str(seed)]
        done = subprocess.run(
            [sys.executable, __file__, *arguments], capture_output=True, text=True, check=False
        )
        told = done.stdout.splitlines()
        how = "before the first file"
        for line in told:
            head, _, rest = line.partition(" ")
            if head == "open":
                begun, ended = rest.split()
                if begun != ended:
                    wrong.append(f"{begun} files open before, {ended} after")
            elif rest.startswith("= "):
                answer = rest[2:]
                answers[answer.split()[0]] += 1
                if answer not in ("read", "refused"):
                    wrong.append(f"{head} {how}: {answer}")
                number = int(head) + 1
            else:
                how = rest
        if done.returncode == -signal.SIGALRM:
            # Loops inside tifffile and HDF5, which nothing in this process could end.
            answers["hangs"] += 1
            number += 1
        elif done.returncode:
            answers["CRASH"] += 1
            wrong.append(f"{number} {how}: exit status {done.returncode} {done.stderr[-300:]}")
            number += 1
    return answers, wrong


def main() -> None:
    """Run the fuzzer, or, as a worker, a part of it."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--files", type=int, default=1000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--worker", type=int, nargs=2, help=argparse.SUPPRESS)
    given = parser.parse_args()
    if given.worker:
        _work(*given.worker, given.seed)
        return
    answers, wrong = fuzz(given.files, given.seed)
    print(", ".join(f"{answer}: {count}" for answer, count in answers.most_common()))
    print("\n".join(wrong))
    sys.exit(bool(wrong))


def _work(first: int, last: int, seed: int) -> None:
    import resource

    resource.setrlimit(resource.RLIMIT_AS, (_MEMORY, _MEMORY))
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "seeds").mkdir()
        seeds = write_seeds(folder / "seeds")
        for path in seeds:  # opens once what stays open: caches, libraries
            read(path)
        begun = _open_files()
        try_files(seeds, folder, first, last, seed)
        print("open", begun, _open_files(), flush=True)


if __name__ == "__main__":
    main()
