// adjoint.cl for CPUs and views whose v is parallel to z: the share across a plane belongs to a
// detector column, and the rows that share in a voxel are linear in z. So each detector column is
// resampled once and given to the two voxel columns beside it.
//
// A work-item sums BLOCK voxels along z of WIDTH neighbouring columns over the given views. Every
// voxel, and the one beyond, has to be in front of every source.

#include "blocks.clh"

#ifndef WIDTH
#define WIDTH 16
#endif

#define SLACK 1e-2f // as in adjoint.clh

// Adds what one detector column gives to `voxels` voxels of two neighbouring columns. The voxels
// are `slope` rows apart and the first is at `row`; a row shares in voxels within |slope| rows.
static inline void spread(
    global const float *line,
    const int rows,
    const float row,
    const float slope,
    const float weights[2],
    float *sums[2],
    const int voxels)
{
    const float reach = fabs(slope);
    const float decline = 1.0f / reach; // of the share, per row
    const float one = (-reach - row) / slope;
    const float other = (rows - 1.0f + reach - row) / slope;
    const float first = SMALLER(one, other);
    const float last = LARGER(one, other);
    if (last < 0.0f || first >= voxels)
        return;
    const int start = (int)LARGER(first, 0.0f) / LANES * LANES;
    const int stop = (int)SMALLER(last, voxels - 1.0f) + 1;
    if (reach * (LANES - 1) > SPAN) {
        for (int k = start; k < stop; ++k) {
            const float centre = fma(slope, (float)k, row);
            const int from = (int)ceil(clamp(centre - reach, 0.0f, (float)rows));
            const int to = (int)clamp(centre + reach, -1.0f, rows - 1.0f);
            float value = 0.0f;
            for (int r = from; r <= to; ++r)
                value += LARGER(1.0f - fabs(r - centre) * decline, 0.0f) * line[r];
            sums[0][k] += weights[0] * value;
            sums[1][k] += weights[1] * value;
        }
        return;
    }
    steps step = steps_from(row, slope, start);
    if (reach <= 1.0f) { // two rows share in a voxel
        for (int k = start; k < stop; k += LANES) {
            const whole at = step_lanes(step);
            const whole n = whole_part(at);
            const real f = fraction(at) * decline;
            const piece w = load_piece(line + step_base(step));
            const real value = LARGER(1.0f - f, 0.0f) * take(w, n) +
                                 LARGER(1.0f - decline + f, 0.0f) * take(w, n + 1);
            store_lanes(load_lanes(sums[0] + k) + weights[0] * value, sums[0] + k);
            store_lanes(load_lanes(sums[1] + k) + weights[1] * value, sums[1] + k);
            step.lowest += step.advance;
        }
    } else { // four do
        for (int k = start; k < stop; k += LANES) {
            const whole at = step_lanes(step);
            const whole n = whole_part(at);
            const real above = 1.0f - fraction(at) * decline;
            const real under = 2.0f - decline - above;
            const piece v = load_piece(line + step_base(step) - 1);
            const piece w = load_piece(line + step_base(step) + 1);
            const real value = LARGER(above - decline, 0.0f) * take(v, n) +
                                 above * take(v, n + 1) + under * take(w, n) +
                                 LARGER(under - decline, 0.0f) * take(w, n + 1);
            store_lanes(load_lanes(sums[0] + k) + weights[0] * value, sums[0] + k);
            store_lanes(load_lanes(sums[1] + k) + weights[1] * value, sums[1] + k);
            step.lowest += step.advance;
        }
    }
}

// Global size (blocks, planes across the axis, ceil(voxels beside each other in them / WIDTH)),
// rounded up at will: (blocks, nx, ceil(ny / WIDTH)) for axis 0, (blocks, ny, ceil(nx / WIDTH)) for
// axis 1. The sum over both axes is the adjoint.
kernel void adjoint_columns(
    global float *restrict volume, // (ny, nx, nz)
    const ulong volume_offset,
    global const float *restrict projections, // (count, columns + 1, pitch), padded, weighed
    const ulong projections_offset,
    global const float *restrict views, // (count, VIEW_FLOATS)
    const ulong views_offset,
    const int nx, // voxels
    const int ny,
    const int nz,
    const int columns, // pixels
    const int rows,
    const int pitch, // elements of a padded line
    const int count, // views
    const int axis, // of the rays: those sampled across x, 0, or y, 1
    const int accumulate) // 1: add to the volume
{
    volume += volume_offset;
    projections += projections_offset + PAD;
    views += views_offset;
    const int z = get_global_id(0) * BLOCK;
    const int plane = get_global_id(1);
    const int side = get_global_id(2) * WIDTH;
    if (z >= nz || plane >= (axis ? ny : nx) || side >= (axis ? nx : ny))
        return;
    const int voxels = min(BLOCK, nz - z);
    const int width = min(WIDTH, (axis ? nx : ny) - side);

    float sum[(WIDTH + 2) * BLOCK]; // one column more at each side, for what goes elsewhere
    for (int k = 0; k < (WIDTH + 2) * BLOCK; ++k)
        sum[k] = 0.0f;
    for (int view = 0; view < count; ++view) {
        global const float *m = views + view * VIEW_FLOATS;
        // the detector columns whose rays pass the plane within one voxel of these
        float ends[2];
        for (int end = 0; end < 2; ++end) {
            const float beside = end ? side + width : side - 1;
            const float x = axis ? beside : plane;
            const float y = axis ? plane : beside;
            ends[end] =
                fma(m[0], x, fma(m[1], y, m[3])) / fma(m[8], x, fma(m[9], y, m[11]));
        }
        const float left = SMALLER(ends[0], ends[1]) - SLACK;
        const float right = LARGER(ends[0], ends[1]) + SLACK;
        const int first = (int)ceil(clamp(left, 0.0f, (float)columns));
        const int last = (int)clamp(right, -1.0f, columns - 1.0f);
        for (int c = first; c <= last; ++c) {
            if (main_axis(m, c, 0.0f, 1) != axis)
                continue;
            const float t = (plane - m[12 + axis]) / ALONG(float, m, axis, c, 0.0f);
            const float q = fma(t, ALONG(float, m, 1 - axis, c, 0.0f), m[13 - axis]) - side;
            if (!(q > -1.0f && q < width))
                continue;
            const int low = below(q);
            const float weights[2] = {1.0f - (q - low), q - low};
            float *sums[2] = {sum + (low + 1) * BLOCK, sum + (low + 2) * BLOCK};
            // ray (c, r) passes the plane at the height bottom + rise r
            const float rise = t * m[23];
            const float bottom = fma(t, ALONG(float, m, 2, c, 0.0f), m[14]);
            spread(
                projections + ((size_t)view * (columns + 1) + c) * pitch,
                rows,
                (z + LIFT(m) - bottom) / rise,
                1.0f / rise,
                weights,
                sums,
                voxels);
        }
    }
    for (int i = 0; i < width; ++i) {
        const size_t x = axis ? side + i : plane;
        const size_t y = axis ? plane : side + i;
        put(volume + (y * nx + x) * nz + z, sum + (i + 1) * BLOCK, voxels, accumulate);
    }
}
