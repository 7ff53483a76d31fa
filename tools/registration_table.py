"""Errors of the registration of single pairs of images, and of phase correlation beside it.

``python tools/registration_table.py`` makes pairs of 256 x 256 pixels by closed form, blobs or
spheres, with shifts of up to 10 pixels and magnifications of 0.998 to 1.002, 4000 photons a pixel
in the measured image, and a wrong gain, offset and slope in the simulated one, which is sharp,
blurred, or smeared by a motion of +-9 pixels. It prints median and 95th percentile of the errors.
"""

import numpy as np
import pyopencl.array as cl_array
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from clra.ops.registration.gauss_newton import Registration
from clra.ops.registration.phase_correlation import PhaseCorrelation
from clra.ops.streaming.stream import Stream

Floats = NDArray[np.float64]

PAIRS, SIZE, COUNTS = 40, 256, 4000
SHIFT, MAGNIFICATION, SMEAR = 10.0, 0.002, 9.0
HEAD = (
    "| pairs | shift [pixel] | magnification | phase correlation [pixel] | of it beyond 1 pixel |\n"
    "|---|---|---|---|---|"
)


def blobs(random: np.random.Generator) -> Floats:
    """Place, size and height of many small Gaussians."""
    count = SIZE * SIZE // 70
    place = random.uniform(-0.75 * SIZE, 0.75 * SIZE, (2, count))
    height = random.uniform(0.03, 0.15, count) * random.choice([-1, 1], count)
    return np.array([*place, random.uniform(1.5, 8, count), height])


def spheres(random: np.random.Generator) -> Floats:
    """Three concentric pairs of spheres, one above the other; the outer two are cut."""
    place = random.uniform(-5, 5, (2, 3))
    place[1] += np.array([-170.0, 0.0, 170.0])
    shells = np.array([*place, [80.0] * 3, [0.006, 0.008, 0.010]])
    cores = np.array([*place, [45.0] * 3, [0.006, 0.006, 0.006]])
    return np.concatenate([shells, cores], axis=1)


def image(things: Floats, *, round_: bool, shift: Floats, magnification: float) -> Floats:
    """Line integrals of spheres, or blobs on a level of 1, from elsewhere; four points a pixel."""
    fine = (np.arange(2 * SIZE) + 0.5) / 2 - SIZE / 2
    picture = np.full((2 * SIZE, 2 * SIZE), 0.0 if round_ else 1.0)
    for x, y, size, height in things.T:
        u, v = ((fine - s) / magnification - c for s, c in zip(shift, (x, y), strict=True))
        if round_:
            chord = np.clip(size**2 - v[:, None] ** 2 - u**2, 0, None)
            picture += 2 * height * np.sqrt(chord)
        else:
            near_u, near_v = (np.abs(d) < 5 * size for d in (u, v))
            along_u, along_v = (
                np.exp(-0.5 * (d[near] / size) ** 2) for d, near in ((u, near_u), (v, near_v))
            )
            picture[np.ix_(near_v, near_u)] += height * np.outer(along_v, along_u)
    return picture.reshape(SIZE, 2, SIZE, 2).mean(axis=(1, 3))


def pair(seed: int, kind: str, spoilt: str) -> tuple[Floats, Floats, Floats]:
    """Measured and simulated image, and the true (u, v, magnification)."""
    random = np.random.default_rng(seed)
    round_ = kind == "spheres"
    things = (spheres if round_ else blobs)(random)
    truth = np.array([*random.uniform(-SHIFT, SHIFT, 2), 1.0])
    truth[2] += random.uniform(-MAGNIFICATION, MAGNIFICATION)
    seen = image(things, round_=round_, shift=truth[:2], magnification=truth[2])
    counts = np.maximum(random.poisson(COUNTS * np.exp(-seen)), 1)
    still = image(things, round_=round_, shift=np.zeros(2), magnification=1.0)
    if spoilt == "blurred by sigma 2":
        still = gaussian_filter(still, 2.0)
    elif spoilt == "smeared over +-9 pixels":
        moves = random.uniform(-SMEAR, SMEAR, (60, 2))
        moves -= moves.mean(axis=0)
        along_u, along_v = (
            np.exp(-2j * np.pi * np.multiply.outer(move, f))
            for move, f in zip(moves.T, (np.fft.rfftfreq(SIZE), np.fft.fftfreq(SIZE)), strict=True)
        )
        still = np.fft.irfft2(np.fft.rfft2(still) * (along_v.T @ along_u) / len(moves))
    ramp = 0.1 * np.arange(SIZE) / SIZE
    return -np.log(counts / COUNTS), 0.8 * still + 0.05 + ramp, truth


def row(stream: Stream, kind: str, spoilt: str) -> str:
    measured, simulated, truth = (
        np.array(part) for part in zip(*(pair(k, kind, spoilt) for k in range(PAIRS)), strict=True)
    )
    device = [cl_array.to_device(stream.queue, i.astype(np.float32)) for i in (measured, simulated)]
    estimates = stream.empty((PAIRS, 10))
    shifts = stream.empty((PAIRS, 2))
    Registration(stream.context, (SIZE, SIZE), views=PAIRS)(stream.queue, estimates, *device)
    PhaseCorrelation(stream.context, (SIZE, SIZE))(stream.queue, shifts, *device).wait()
    found = estimates.get()
    ours, theirs = (np.linalg.norm(f[:, :2] - truth[:, :2], axis=1) for f in (found, shifts.get()))
    grown = np.abs(found[:, 2] - truth[:, 2])
    told = [
        " / ".join(format(np.quantile(error, q), form) for q in (0.5, 0.95))
        for error, form in ((ours, ".3f"), (grown, ".1e"), (theirs, ".3f"))
    ]
    return f"| {kind}, {spoilt} | {' | '.join(told)} | {100 * np.mean(theirs > 1):.0f} % |"


def main() -> None:
    print(HEAD)
    stream = Stream()
    for kind, spoilt in (
        ("blobs", "sharp"),
        ("blobs", "blurred by sigma 2"),
        ("spheres", "blurred by sigma 2"),
        ("blobs", "smeared over +-9 pixels"),
        ("spheres", "smeared over +-9 pixels"),
    ):
        print(row(stream, kind, spoilt), flush=True)


if __name__ == "__main__":
    main()
