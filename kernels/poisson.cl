// Statistics of transmission data, and the updates of a volume that follow from them.
//
// A ray with line integral l is expected to count q = b exp(-l) + r photons: b are those of the
// open beam, r is background. What was measured is given as line integral p, so that y = b exp(-p)
// + r counts were found. A masked pixel has b = 0: it then has neither gradient nor curvature.
//
// Kernels of rays: one work-item a pixel of a radiograph (`deviance`: of the detector, for all
// views); global size (pixels, views). Kernels of voxels: one a voxel. Ranges may be rounded up.

#include "group.clh"

// Line integrals are taken to lie in this range: a hot pixel may show more than the open beam, and
// none tells less than exp(-30).
#define LEAST -1.0f
#define MOST 30.0f

static inline float expected(const float open_beam, const float integral)
{
    return open_beam * exp(-clamp(integral, LEAST, MOST));
}

// q - y, without the rounding errors of two large numbers
static inline float excess(const float open_beam, const float simulated, const float measured)
{
    const float p = clamp(measured, LEAST, MOST), l = clamp(simulated, LEAST, MOST);
    return expected(open_beam, p) * expm1(p - l);
}

// Adds, for each pixel of the detector, the Poisson deviance 2 (q - y + y log(y / q)) of all views.
kernel required_group void deviance(
    global float *restrict sums, // (pixels)
    const ulong sums_offset,
    global const float *restrict simulated, // (views, pixels), line integrals
    const ulong simulated_offset,
    global const float *restrict measured, // (views, pixels), line integrals
    const ulong measured_offset,
    global const float *restrict open_beam, // (pixels), photons
    const ulong open_beam_offset,
    const float background, // photons
    const int pixels,
    const int views)
{
    const int i = get_global_id(0);
    if (i >= pixels)
        return;
    sums += sums_offset;
    simulated += simulated_offset;
    measured += measured_offset;
    const float b = open_beam[open_beam_offset + i];
    float sum = 0.0f;
    for (int view = 0; view < views; ++view) {
        const size_t at = (size_t)view * pixels + i;
        const float more = excess(b, simulated[at], measured[at]);
        const float y = expected(b, measured[at]) + background;
        sum += y > 0.0f ? 2.0f * (more - y * log1p(more / y)) : 0.0f;
    }
    sums[i] += sum;
}

// (1 - y / q) b exp(-l): by how much the log-likelihood rises with less attenuation along a ray,
// reversed; may overwrite `simulated`.
kernel required_group void gradient(
    global float *gradient, // (views, pixels), photons
    const ulong gradient_offset,
    global const float *simulated, // (views, pixels), line integrals
    const ulong simulated_offset,
    global const float *restrict measured, // (views, pixels), line integrals
    const ulong measured_offset,
    global const float *restrict open_beam, // (pixels), photons
    const ulong open_beam_offset,
    const float background, // photons
    const int pixels,
    const int views)
{
    const int i = get_global_id(0), view = get_global_id(1);
    if (i >= pixels || view >= views)
        return;
    const size_t at = (size_t)view * pixels + i;
    const float l = simulated[simulated_offset + at], p = measured[measured_offset + at];
    const float b = open_beam[open_beam_offset + i];
    const float direct = expected(b, l);
    const float all = direct + background;
    gradient[gradient_offset + at] = all > 0.0f ? excess(b, l, p) * direct / all : 0.0f;
}

// Chord times the curvature of the measured ray's likelihood at its maximum, (y - r)^2 / y; may
// overwrite `chords`.
kernel required_group void curvature(
    global float *weighted, // (views, pixels), photons mm
    const ulong weighted_offset,
    global const float *chords, // (views, pixels), length within the volume, mm
    const ulong chords_offset,
    global const float *restrict measured, // (views, pixels), line integrals
    const ulong measured_offset,
    global const float *restrict open_beam, // (pixels), photons
    const ulong open_beam_offset,
    const float background, // photons
    const int pixels,
    const int views)
{
    const int i = get_global_id(0), view = get_global_id(1);
    if (i >= pixels || view >= views)
        return;
    const size_t at = (size_t)view * pixels + i;
    const float direct = expected(open_beam[open_beam_offset + i], measured[measured_offset + at]);
    const float y = direct + background;
    const float c = y > 0.0f ? direct * direct / y : 0.0f;
    weighted[weighted_offset + at] = chords[chords_offset + at] * c;
}

// Chord times the least curvature of a parabola that touches the ray's negative log-likelihood
// h(l) = q - y log(q) at l and lies above it for all l >= 0: 2 (h(0) - h(l) + l h'(l)) / l^2, at
// l = 0 h''(0). `simulated` may be overwritten.
kernel required_group void optimal_curvature(
    global float *weighted, // (views, pixels), photons mm
    const ulong weighted_offset,
    global const float *simulated, // (views, pixels), line integrals
    const ulong simulated_offset,
    global const float *restrict chords, // (views, pixels), length within the volume, mm
    const ulong chords_offset,
    global const float *restrict measured, // (views, pixels), line integrals
    const ulong measured_offset,
    global const float *restrict open_beam, // (pixels), photons
    const ulong open_beam_offset,
    const float background, // photons
    const int pixels,
    const int views)
{
    const int i = get_global_id(0), view = get_global_id(1);
    if (i >= pixels || view >= views)
        return;
    const size_t at = (size_t)view * pixels + i;
    const float b = open_beam[open_beam_offset + i];
    const float l = clamp(simulated[simulated_offset + at], 0.0f, MOST);
    const float y = expected(b, measured[measured_offset + at]) + background;
    const float direct = expected(b, l);
    const float all = direct + background, first = b + background;
    float c = 0.0f;
    // Below this the difference is rounding; the curvature at 0 is larger by a hundredth at most.
    if (l > 0.02f) {
        const float grown = b - direct; // q(0) - q(l)
        const float logs = y > 0.0f ? y * (log1p(grown / all) - l * direct / all) : 0.0f;
        c = 2.0f * (grown - l * direct - logs) / (l * l);
    } else if (first > 0.0f) {
        c = b * (1.0f - y * background / (first * first));
    }
    weighted[weighted_offset + at] = chords[chords_offset + at] * max(c, 0.0f);
}

// Both sides of the balance that the maximum of the likelihood fulfils along the rays of a voxel:
// b exp(-l), which overwrites `simulated`, and b exp(-l) y / q.
kernel required_group void balance(
    global float *restrict simulated, // (views, pixels), line integrals; then photons
    const ulong simulated_offset,
    global float *restrict found, // (views, pixels), photons
    const ulong found_offset,
    global const float *restrict measured, // (views, pixels), line integrals
    const ulong measured_offset,
    global const float *restrict open_beam, // (pixels), photons
    const ulong open_beam_offset,
    const float background, // photons
    const int pixels,
    const int views)
{
    const int i = get_global_id(0), view = get_global_id(1);
    if (i >= pixels || view >= views)
        return;
    const size_t at = (size_t)view * pixels + i;
    const float b = open_beam[open_beam_offset + i];
    const float direct = expected(b, simulated[simulated_offset + at]);
    const float y = expected(b, measured[measured_offset + at]) + background;
    simulated[simulated_offset + at] = direct;
    found[found_offset + at] = direct > 0.0f ? direct * y / (direct + background) : 0.0f;
}

// mu <- max(0, mu + step numerator / denominator) where the denominator exceeds `least`
kernel required_group void add_step(
    global float *restrict volume, // (voxels), 1/mm
    const ulong volume_offset,
    global const float *restrict numerator, // (voxels), photons mm
    const ulong numerator_offset,
    global const float *restrict denominator, // (voxels), photons mm^2
    const ulong denominator_offset,
    const float step, // subsets, times a relaxation
    const float least, // photons mm^2
    const int planes, // voxels that lie next to each other
    const int columns) // voxels / planes
{
    const int k = get_global_id(0), j = get_global_id(1);
    if (k >= planes || j >= columns)
        return;
    const size_t at = (size_t)j * planes + k;
    const float d = denominator[denominator_offset + at];
    const float mu = volume[volume_offset + at];
    const float moved = mu + step * numerator[numerator_offset + at] / d;
    volume[volume_offset + at] = d > least ? max(0.0f, moved) : mu;
}

// mu <- mu numerator / denominator, by a factor of 4 at most, where rays meet the voxel
kernel required_group void multiply_step(
    global float *restrict volume, // (voxels), 1/mm
    const ulong volume_offset,
    global const float *restrict numerator, // (voxels), photons mm
    const ulong numerator_offset,
    global const float *restrict denominator, // (voxels), photons mm
    const ulong denominator_offset,
    const int planes, // voxels that lie next to each other
    const int columns) // voxels / planes
{
    const int k = get_global_id(0), j = get_global_id(1);
    if (k >= planes || j >= columns)
        return;
    const size_t at = (size_t)j * planes + k;
    const float n = numerator[numerator_offset + at], d = denominator[denominator_offset + at];
    const float factor = d > 0.0f ? clamp(n / d, 0.25f, 4.0f) : n > 0.0f ? 4.0f : 1.0f;
    volume[volume_offset + at] *= factor;
}
