// Cyclic cross-correlation of image pairs by Fourier transforms, and its peak.
//
// Images (views, rows, columns) and half spectra (views, rows, columns/2 + 1) are C-ordered. The
// correlation map of a measured and a simulated image has its peak at the shift (u, v) that takes
// the simulated image to the measured one, negative shifts at the far ends.

#include "vectors.clh"

#ifndef GROUP
#define GROUP 1 // work-items that share a view: 1 on CPUs, 64 on GPUs; a power of two
#endif

// Mean of each image. Work-group (GROUP, 1), global size (GROUP, views).
kernel __attribute__((reqd_work_group_size(GROUP, 1, 1))) void means(
    global float *restrict mean, // (views,)
    const ulong mean_offset,
    global const float *restrict image, // (views, pixels)
    const ulong image_offset,
    const int pixels)
{
    mean += mean_offset;
    image += image_offset;
    const int item = get_local_id(0), view = get_global_id(1);
    image += (ulong)view * pixels;
    float8 eight = 0.0f; // eight sums at a time: float addition is not re-ordered by compilers
    const int whole = pixels / 8;
    for (int k = item; k < whole; k += GROUP)
        eight += vload8(k, image);
    const float4 four = eight.lo + eight.hi;
    float sum = (four.x + four.y) + (four.z + four.w);
    for (int k = 8 * whole + item; k < pixels; k += GROUP)
        sum += image[k];
    local float sums[GROUP];
    sums[item] = sum;
    barrier(CLK_LOCAL_MEM_FENCE);
    if (item == 0) {
        for (int k = 1; k < GROUP; ++k)
            sum += sums[k];
        mean[view] = sum / pixels;
    }
}

// (image - mean) * window, padded with zeros at the far ends. Global size (out_columns, out_rows,
// views).
kernel required_group void windowed(
    global float *restrict out, // (views, out_rows, out_columns)
    const ulong out_offset,
    global const float *restrict image, // (views, rows, columns)
    const ulong image_offset,
    global const float *restrict mean, // (views,)
    const ulong mean_offset,
    global const float *restrict window_v, // (rows,)
    const ulong window_v_offset,
    global const float *restrict window_u, // (columns,)
    const ulong window_u_offset,
    const int rows,
    const int columns,
    const int out_rows,
    const int out_columns,
    const int views)
{
    out += out_offset;
    image += image_offset;
    mean += mean_offset;
    window_v += window_v_offset;
    window_u += window_u_offset;
    const int i = get_global_id(0), j = get_global_id(1), view = get_global_id(2);
    if (i >= out_columns || j >= out_rows || view >= views)
        return;
    float value = 0.0f;
    if (i < columns && j < rows)
        value = window_v[j] * window_u[i] *
                (image[((ulong)view * rows + j) * columns + i] - mean[view]);
    out[((ulong)view * out_rows + j) * out_columns + i] = value;
}

// measured := measured * conj(simulated). Global size (count), rounded up at will.
kernel required_group void cross_power(
    global float2 *restrict measured, // spectra, (count,)
    const ulong measured_offset,
    global const float2 *restrict simulated, // spectra, (count,)
    const ulong simulated_offset,
    const int count)
{
    measured += measured_offset;
    simulated += simulated_offset;
    const int k = get_global_id(0);
    if (k >= count)
        return;
    const float2 a = measured[k], b = simulated[k];
    measured[k] = (float2)(a.x * b.x + a.y * b.y, a.y * b.x - a.x * b.y);
}

// Whiten each spectrum: frequencies count alike, but for those whose modulus is below `least` times
// the mean modulus, which fade out. Work-group (GROUP, 1), global size (GROUP, views).
kernel __attribute__((reqd_work_group_size(GROUP, 1, 1))) void whiten(
    global float2 *restrict spectrum, // (views, count)
    const ulong spectrum_offset,
    const float least,
    const int count)
{
    spectrum += spectrum_offset;
    const int item = get_local_id(0), view = get_global_id(1);
    spectrum += (ulong)view * count;
    float sum = 0.0f;
    for (int k = item; k < count; k += GROUP)
        sum += length(spectrum[k]);
    local float sums[GROUP];
    sums[item] = sum;
    barrier(CLK_LOCAL_MEM_FENCE);
    sum = 0.0f;
    for (int k = 0; k < GROUP; ++k)
        sum += sums[k];
    const float floor = least * sum / count;
    for (int k = item; k < count; k += GROUP) {
        const float modulus = length(spectrum[k]) + floor;
        spectrum[k] = modulus > 0.0f ? spectrum[k] / modulus : (float2)(0.0f, 0.0f);
    }
}

// Peak of each map among shifts of at most (reach_u, reach_v), refined by the parabola that fits
// its 3 x 3 neighbours best (at most one pixel away), times `pixel`. A map without peak (blank or
// NaN) gives shift 0; of equal peaks the first wins. Work-group (GROUP, 1), global size (GROUP,
// views).
kernel __attribute__((reqd_work_group_size(GROUP, 1, 1))) void peak(
    global float *restrict shifts, // (views, 2): (u, v)
    const ulong shifts_offset,
    global const float *restrict map, // (views, rows, columns)
    const ulong map_offset,
    const int rows,
    const int columns,
    const int reach_u, // pixels of the map, < columns / 2
    const int reach_v, // likewise, < rows / 2
    const float pixel) // unit of the shifts in pixels of the map
{
    shifts += shifts_offset;
    map += map_offset;
    const int item = get_local_id(0), view = get_global_id(1);
    map += (ulong)view * rows * columns;
    const int width = 2 * reach_u + 1, count = width * (2 * reach_v + 1);
    float best = map[0]; // shift 0 is the one to beat
    int where = count / 2;
    for (int k = item; k < count; k += GROUP) {
        const int u = k % width - reach_u, v = k / width - reach_v;
        const float value = map[(v < 0 ? v + rows : v) * columns + (u < 0 ? u + columns : u)];
        if (value > best) {
            best = value;
            where = k;
        }
    }
    local float values[GROUP];
    local int places[GROUP];
    values[item] = best;
    places[item] = where;
    barrier(CLK_LOCAL_MEM_FENCE);
    if (item != 0)
        return;
    for (int k = 1; k < GROUP; ++k)
        if (values[k] > best || (values[k] == best && places[k] < where)) {
            best = values[k];
            where = places[k];
        }
    const int u = where % width - reach_u, v = where / width - reach_v;
    // Least squares on the nine points for a + bu u + bv v + cuu u^2 + cuv u v + cvv v^2.
    float bu = 0.0f, bv = 0.0f, cuu = 0.0f, cuv = 0.0f, cvv = 0.0f;
    for (int y = -1; y <= 1; ++y)
        for (int x = -1; x <= 1; ++x) {
            const int row = (v + y + rows) % rows, column = (u + x + columns) % columns;
            const float value = map[row * columns + column] - best;
            bu += x * value / 6.0f;
            bv += y * value / 6.0f;
            cuu += (x ? 1.0f / 6.0f : -1.0f / 3.0f) * value;
            cvv += (y ? 1.0f / 6.0f : -1.0f / 3.0f) * value;
            cuv += x * y * value / 4.0f;
        }
    // Top where the gradient vanishes: 2 cuu u + cuv v = -bu, cuv u + 2 cvv v = -bv.
    const float determinant = 4.0f * cuu * cvv - cuv * cuv;
    float du = 0.0f, dv = 0.0f;
    if (determinant > 0.0f && cuu < 0.0f) {
        du = clamp((cuv * bv - 2.0f * cvv * bu) / determinant, -1.0f, 1.0f);
        dv = clamp((cuv * bu - 2.0f * cuu * bv) / determinant, -1.0f, 1.0f);
    }
    shifts[2 * view] = (u + du) * pixel;
    shifts[2 * view + 1] = (v + dv) * pixel;
}

// LANES columns, two apart; not by a vector of 16, see vectors.clh
static inline real every_second(global const float *restrict p)
{
    return (real)(load_global(p).even, load_global(p + LANES).even);
}

// Windowed, halved images for the coarse search: the spline midway between four pixels.
// A work-item makes LANES pixels; beyond the halved image out is filled with 0. Global size (blocks
// of LANES columns, out_rows, views), rounded up at will.
kernel required_group void halve(
    global float *restrict halved, // (views, out_rows, out_columns)
    const ulong halved_offset,
    global const float *restrict coefficients, // lined (views, rows, stride)
    const ulong coefficients_offset,
    global const float *restrict window, // lined (rows / 2, window_stride)
    const ulong window_offset,
    const int window_stride,
    const int rows,
    const int columns,
    const int stride,
    const int out_rows,
    const int out_columns,
    const int views)
{
    halved += halved_offset;
    coefficients += coefficients_offset;
    window += window_offset;
    const int i = get_global_id(0) * LANES, j = get_global_id(1), view = get_global_id(2);
    if (i >= out_columns || j >= out_rows || view >= views)
        return;
    real sum = 0.0f;
    if (i < columns / 2 && j < rows / 2) {
        const float weights[4] = {1.0f / 48.0f, 23.0f / 48.0f, 23.0f / 48.0f, 1.0f / 48.0f};
        for (int k = 0; k < 4; ++k) {
            const int y = clamp(2 * j - 1 + k, 0, rows - 1);
            global const float *p =
                coefficients + ((ulong)view * rows + y) * stride + MARGIN + 2 * i - 1;
            sum += weights[k] * (weights[0] * (every_second(p) + every_second(p + 3)) +
                                 weights[1] * (every_second(p + 1) + every_second(p + 2)));
        }
        sum *= load_global(window + (ulong)j * window_stride + MARGIN + i);
    }
    halved += ((ulong)view * out_rows + j) * out_columns + i;
    if (out_columns - i >= LANES)
        store_global(sum, halved);
    else
        store_some(sum, halved, out_columns - i);
}
