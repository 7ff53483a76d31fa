// Real spectra from complex transforms of half the length, and back.
//
// A real line x of even length N is transformed as the complex line z[m] = x[2m] + i x[2m+1] of
// length M = N/2. With Z its transform, E(k) = (Z(k) + conj Z(-k)) / 2 and
// O(k) = (Z(k) - conj Z(-k)) / 2i, the spectrum of x is X(k) = E(k) + exp(-2 pi i k/N) O(k),
// k = 0..M. In two dimensions -k negates the row's frequency too. Lines of odd length are
// transformed as complex lines of the same length, with imaginary part 0.
//
// Layouts are C-ordered: image (items, rows, columns), spectrum (items, rows, columns/2 + 1), work
// (items, rows, width) with width = columns/2 for even columns, else columns. Each work-item makes
// one complex element; global sizes are (width or columns/2 + 1, rows, items), rounded up at will.

#include "group.clh"

static inline float2 conjugate(const float2 a) { return (float2)(a.x, -a.y); }

static inline float2 product(const float2 a, const float2 b)
{
    return (float2)(a.x * b.x - a.y * b.y, a.x * b.y + a.y * b.x);
}

// exp(i pi a), a in [-1, 1]
static inline float2 unit(const float a) { return (float2)(cospi(a), sinpi(a)); }

kernel required_group void real_to_work(
    global float2 *restrict work, // complex lines to be transformed
    const ulong work_offset,
    global const float *restrict image, // real lines
    const ulong image_offset,
    const int columns, // of the real image
    const int rows,
    const int items)
{
    work += work_offset;
    image += image_offset;
    const int paired = !(columns & 1), width = paired ? columns / 2 : columns;
    const int k = get_global_id(0), row = get_global_id(1), item = get_global_id(2);
    if (k >= width || row >= rows || item >= items)
        return;
    const ulong i = ((ulong)item * rows + row) * width + k;
    work[i] = paired ? vload2(i, image) : (float2)(image[i], 0.0f);
}

kernel required_group void work_to_real(
    global float *restrict image, // real lines
    const ulong image_offset,
    global const float2 *restrict work, // complex lines, transformed back
    const ulong work_offset,
    const int columns, // of the real image
    const int rows,
    const int items)
{
    image += image_offset;
    work += work_offset;
    const int paired = !(columns & 1), width = paired ? columns / 2 : columns;
    const int k = get_global_id(0), row = get_global_id(1), item = get_global_id(2);
    if (k >= width || row >= rows || item >= items)
        return;
    const ulong i = ((ulong)item * rows + row) * width + k;
    if (paired)
        vstore2(work[i], i, image);
    else
        image[i] = work[i].x;
}

// Global size (columns/2 + 1, rows, items).
kernel required_group void work_to_spectrum(
    global float2 *restrict spectrum, // half spectrum
    const ulong spectrum_offset,
    global const float2 *restrict work, // transform of the complex lines
    const ulong work_offset,
    const int columns, // of the real image
    const int rows,
    const int items,
    const int two_axes) // 1: rows were transformed too; 0: columns only
{
    spectrum += spectrum_offset;
    work += work_offset;
    const int k = get_global_id(0), row = get_global_id(1), item = get_global_id(2);
    if (k > columns / 2 || row >= rows || item >= items)
        return;
    const ulong first = (ulong)item * rows;
    float2 value;
    if (columns & 1) {
        value = work[(first + row) * columns + k];
    } else {
        const int width = columns / 2;
        const int other = two_axes && row > 0 ? rows - row : row;
        const float2 a = work[(first + row) * width + k % width];
        const float2 b = conjugate(work[(first + other) * width + (width - k) % width]);
        const float2 even = 0.5f * (a + b), difference = 0.5f * (a - b);
        const float2 odd = (float2)(difference.y, -difference.x);
        value = even + product(unit(-2.0f * k / columns), odd);
    }
    spectrum[(first + row) * (columns / 2 + 1) + k] = value;
}

// Global size (width, rows, items).
kernel required_group void spectrum_to_work(
    global float2 *restrict work, // to be transformed back
    const ulong work_offset,
    global const float2 *restrict spectrum, // half spectrum of a real image
    const ulong spectrum_offset,
    const int columns, // of the real image
    const int rows,
    const int items,
    const int two_axes) // as in work_to_spectrum
{
    work += work_offset;
    spectrum += spectrum_offset;
    const int odd_length = columns & 1;
    const int width = odd_length ? columns : columns / 2, half_width = columns / 2 + 1;
    const int k = get_global_id(0), row = get_global_id(1), item = get_global_id(2);
    if (k >= width || row >= rows || item >= items)
        return;
    const ulong first = (ulong)item * rows;
    const int other = two_axes && row > 0 ? rows - row : row;
    float2 value;
    if (odd_length) {
        value = k < half_width ? spectrum[(first + row) * half_width + k]
                               : conjugate(spectrum[(first + other) * half_width + columns - k]);
    } else {
        const float2 a = spectrum[(first + row) * half_width + k];
        const float2 b = conjugate(spectrum[(first + other) * half_width + width - k]);
        const float2 even = 0.5f * (a + b);
        const float2 odd = product(unit(2.0f * k / columns), 0.5f * (a - b));
        value = even + (float2)(-odd.y, odd.x);
    }
    work[(first + row) * width + k] = value;
}

// spectrum *= multiplier, for every item, and for every row where rows were not transformed.
// Global size (columns/2 + 1, rows, items).
kernel required_group void multiply_spectrum(
    global float2 *restrict spectrum, // half spectrum
    const ulong spectrum_offset,
    global const float *restrict multiplier, // (rows or 1, columns/2 + 1, parts)
    const ulong multiplier_offset, // in factors, of `parts` elements
    const int parts, // 1: real factors, 2: complex ones
    const int columns, // of the real image
    const int rows,
    const int items,
    const int two_axes) // as in work_to_spectrum
{
    spectrum += spectrum_offset;
    multiplier += multiplier_offset * parts;
    const int half_width = columns / 2 + 1;
    const int k = get_global_id(0), row = get_global_id(1), item = get_global_id(2);
    if (k >= half_width || row >= rows || item >= items)
        return;
    const ulong n = (two_axes ? (ulong)row * half_width : 0) + k;
    const ulong at = ((ulong)item * rows + row) * half_width + k;
    spectrum[at] = parts == 2 ? product(spectrum[at], vload2(n, multiplier))
                              : spectrum[at] * multiplier[n];
}
