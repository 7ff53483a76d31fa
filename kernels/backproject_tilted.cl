// backproject.cl for CPUs and any views. The projection of a line of voxels along z is a straight
// line on the detector, which slowly passes from one detector column to the next. So LANES
// successive voxels are interpolated at once, mostly between two columns; where their projection
// crosses a column, among as many as it takes.
//
// A work-item sums BLOCK voxels along z over the given views, in vectors as backproject_columns.cl
// has them. Every voxel has to be in front of every source (g > 0).

#include "blocks.clh"
#include "detector.clh"

#ifndef STRIP
#define STRIP 32 // as in backproject_columns.cl
#endif

// Adds what one view gives to `voxels` voxels along z from (x, y, k = base) on. Which lanes share a
// vector and how it is read depends on the whole volume's planes only.
static inline void add_shadow(
    float *sum,
    global const float *m, // the view
    global const float *image,
    const int columns,
    const int rows,
    const int pitch,
    const int x,
    const int y,
    const int base,
    const int voxels)
{
    // (a, b, g) at height k is (a, b, g) + k (m[2], m[6], m[10])
    const float a = AT(m, x, y, 0.0f);
    const float b = AT(m + 4, x, y, 0.0f);
    const float g = AT(m + 8, x, y, 0.0f);
    float enter = m[25], leave = m[26];
    keep_positive(a, m[2], &enter, &leave);
    keep_positive((columns - 1.0f) * g - a, (columns - 1.0f) * m[10] - m[2], &enter, &leave);
    keep_positive(b, m[6], &enter, &leave);
    keep_positive((rows - 1.0f) * g - b, (rows - 1.0f) * m[10] - m[6], &enter, &leave);
    if (!(enter <= leave))
        return;
    const float first_height = ceil(enter), last_height = floor(leave);
    const int first = (int)first_height - base, last = (int)last_height - base;
    const int start = max(first, 0), stop = min(last + 1, voxels);
    if (start >= stop)
        return;

    // rows passed a voxel, times g^2
    const float climb = m[6] * g - m[10] * b;
    const float nearest = SMALLER(fma(m[10], enter, g), fma(m[10], leave, g));
    if (fabs(climb) * (LANES - 1) > (SPAN - 2.0f) * nearest * nearest) {
        for (int k = start; k < stop; ++k) {
            const float height = base + k;
            const float scale = 1.0f / fma(m[10], height, g);
            const float column = fma(m[2], height, a) * scale;
            const float row = fma(m[6], height, b) * scale;
            sum[k] += on_detector(image, columns, rows, pitch, column, row) * scale * scale;
        }
        return;
    }
    for (int table = start / LANES * LANES; table < stop; table += LANES * LANES) {
        // Where in the image each run of LANES voxels lies, for LANES runs at a time: known ahead,
        // it keeps no load waiting for a division.
        int lefts[LANES], crossings[LANES], bases[LANES];
        {
            const real begin = (float)(base + table) + LANES * RAMP;
            const real from = LARGER(begin, (real)(first_height));
            const real to = SMALLER(begin + (LANES - 1.0f), (real)(last_height));
            const real from_scale = 1.0f / (m[10] * from + g);
            const real to_scale = 1.0f / (m[10] * to + g);
            const real from_column = (m[2] * from + a) * from_scale;
            const real to_column = (m[2] * to + a) * to_scale;
            const real from_row = (m[6] * from + b) * from_scale;
            const real to_row = (m[6] * to + b) * to_scale;
            // Both are monotonic in z: the ends bound what lies between.
            const whole left = to_whole(SMALLER(from_column, to_column));
            store_whole(left, lefts);
            store_whole(to_whole(LARGER(from_column, to_column)) - left, crossings);
            store_whole(to_whole(SMALLER(from_row, to_row)), bases);
        }
        for (int run = 0; run < LANES; ++run) {
            const int k = table + run * LANES;
            if (k >= stop)
                break;
            const int edge = k < first || k + LANES > last + 1;
            real t = (float)(base + k) + RAMP;
            if (edge) // lanes off the detector take the place of one on it
                t = SMALLER(LARGER(t, (real)(first_height)), (real)(last_height));
            const real scale = 1.0f / (m[10] * t + g);
            const real column = (m[2] * t + a) * scale;
            const real row = (m[6] * t + b) * scale;
            const real across = column - (float)lefts[run];
            const real beyond = row - (float)bases[run];
            const whole n = to_whole(beyond);
            const real along = beyond - to_real(n);
            global const float *line = image + (size_t)lefts[run] * pitch + bases[run];
            const real low = between(load_piece(line), n, along);
            const real high = between(load_piece(line + pitch), n, along);
            real value = low + across * (high - low);
            if (crossings[run]) {
                value = low * LARGER(1.0f - across, (real)(0.0f)) + high * hats(across - 1.0f);
                for (int i = 2; i <= crossings[run] + 1; ++i) {
                    // From one element before, now and then: clang makes permutations only where
                    // it computes the subscripts, so that they have to change from line to line.
                    const int before = i & 1 ? 0 : 1;
                    const real place = beyond + (float)before;
                    const whole at = to_whole(place);
                    const piece w = load_piece(line + i * pitch - before);
                    value += hats(across - (float)i) * between(w, at, place - to_real(at));
                }
            }
            value *= scale * scale;
            if (edge)
                value = WHERE(
                    ((float)(base + k) + RAMP == t) & (column >= 0.0f) & (column <= columns - 1.0f) &
                        (row >= 0.0f) & (row <= rows - 1.0f),
                    value);
            store_lanes(load_lanes(sum + k) + value, sum + k);
        }
    }
}

// Global size (blocks, STRIP, ny ceil(nx / STRIP)), rounded up at will.
kernel void backproject_tilted(
    global float *restrict volume, // (ny, nx, nz)
    const ulong volume_offset,
    global const float *restrict projections, // (count, columns + 1, pitch), padded
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
    const int accumulate) // 1: add to the volume
{
    volume += volume_offset;
    projections += projections_offset + PAD;
    views += views_offset;
    const int z = get_global_id(0) * BLOCK - ((int)LIFT(views) & (LANES - 1));
    const int x = get_global_id(1) + get_global_id(2) / ny * STRIP;
    const int y = get_global_id(2) % ny;
    if (z >= nz || get_global_id(1) >= STRIP || x >= nx)
        return;
    const int begin = max(-z, 0), end = min(BLOCK, nz - z);
    global float *target = volume + ((size_t)y * nx + x) * nz + (z + begin);

    float sum[BLOCK];
    for (int k = 0; k < BLOCK; ++k)
        sum[k] = 0.0f;
    fetch(sum + begin, target, end - begin, accumulate);
    for (int view = 0; view < count; ++view)
        add_shadow(
            sum,
            views + view * VIEW_FLOATS,
            projections + (size_t)view * (columns + 1) * pitch,
            columns,
            rows,
            pitch,
            x,
            y,
            z + (int)LIFT(views + view * VIEW_FLOATS),
            end);
    put(target, sum + begin, end - begin, 0);
}
