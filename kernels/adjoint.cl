// The exact adjoint of forwardproject.cl as a gather, without atomics and always in one order: a
// voxel sums, over the rays to which it contributes in forward projection, share times projection.
//
// For a ray that is sampled across axis p and passes the voxel's plane at (q, l), the share is
// hat(q - q of the voxel) hat(l - l of the voxel), hat(x) = max(0, 1 - |x|), times the length of
// ray between two planes, by which weigh_rays multiplies the projections beforehand.
//
// adjoint_voxels treats any geometry: a voxel tries the pixels of the bounding box of its support's
// shadow. adjoint_columns, for CPUs (LANES 8), treats views whose v is parallel to z. There the
// share in q belongs to a detector column and the rows that share in a voxel are linear in z. So
// each detector column is resampled once and given to the two voxel columns beside it.
//
// A work-item sums BLOCK voxels along z over the given views, adjoint_columns those of WIDTH
// neighbouring columns. Every voxel, and the one beyond, has to be in front of every source.

#include "geometry.clh"

#ifndef BLOCK
#define BLOCK (LANES == 1 ? 1 : 32 * LANES) // whole LANES
#endif
#ifndef WIDTH
#define WIDTH 16
#endif

// Rounding must not leave out a ray that shares in a voxel; one ray too many has no weight.
#define SLACK 1e-2f

static inline void put(
    global float *restrict target, const float *sum, const int count, const int accumulate)
{
    for (int k = 0; k < count; ++k)
        target[k] = accumulate ? target[k] + sum[k] : sum[k];
}

// Global size (ceil(rows / LANES), columns, count), rounded up at will.
kernel void weigh_rays(
    global float *restrict projections, // (count, columns + 1, pitch), padded
    const ulong projections_offset,
    global const float *restrict views, // (count, VIEW_FLOATS)
    const ulong views_offset,
    const int columns, // pixels
    const int rows,
    const int pitch, // elements of a padded line
    const int count, // views
    const int axial, // 1: rays are sampled across x or y only
    const float voxel_size) // [mm]
{
    const int r = get_global_id(0) * LANES;
    const int c = get_global_id(1);
    const int view = get_global_id(2);
    if (r >= rows || c >= columns || view >= count)
        return;
    global const float *m = views + views_offset + view * VIEW_FLOATS;
    const real row = r + RAMP;
    const real x = fabs(ALONG(real, m, 0, c, row));
    const real y = fabs(ALONG(real, m, 1, c, row));
    const real z = fabs(ALONG(real, m, 2, c, row));
    const real beside = LARGER(x, y);
    const real advance = axial ? beside : LARGER(beside, z);
    // lanes behind the last row multiply zeros
    global float *at =
        projections + projections_offset + ((size_t)view * (columns + 1) + c) * pitch + PAD + r;
    store_lanes(load_lanes(at) * voxel_size * sqrt(x * x + y * y + z * z) / advance, at);
}

// elements `row` of a line, row >= 0 and whole; zero where row >= rows
static inline real elements(global const float *line, const int rows, const real row)
{
    const float lowest = SMALLER(FIRST(row), LAST(row));
    const float highest = LARGER(FIRST(row), LAST(row));
    if (highest - lowest < WINDOW && lowest < rows) {
        const int base = (int)lowest;
        return WHERE(row < rows, take(load_window(line + base), to_whole(row) - base));
    }
    float at[LANES];
    store_lanes(row, at);
    for (int lane = 0; lane < LANES; ++lane)
        at[lane] = at[lane] < rows ? line[(int)at[lane]] : 0.0f;
    return load_lanes(at);
}

// What the rays of a view that are sampled across axis p give LANES voxels (x, y, z) along z.
// Inlined by force: as a function of any axis it keeps its vectors in memory.
__attribute__((always_inline)) static inline real gather(
    global const float *m, // the view
    global const float *image, // (columns + 1, pitch), padded
    const real voxel[3],
    const int p,
    const int columns,
    const int rows,
    const int pitch)
{
    const int q = p == 0 ? 1 : 0;
    const int l = p == 2 ? 1 : 2;
    const real a = m[0] * voxel[0] + m[1] * voxel[1] + m[2] * voxel[2] + m[3];
    const real b = m[4] * voxel[0] + m[5] * voxel[1] + m[6] * voxel[2] + m[7];
    const real g = m[8] * voxel[0] + m[9] * voxel[1] + m[10] * voxel[2] + m[11];
    real left = INFINITY, right = -INFINITY, top = INFINITY, bottom = -INFINITY;
    for (int corner = 0; corner < 4; ++corner) {
        const float dq = corner & 1 ? 1.0f : -1.0f;
        const float dl = corner & 2 ? 1.0f : -1.0f;
        const real scale = 1.0f / (g + (dq * m[8 + q] + dl * m[8 + l]));
        const real column = (a + (dq * m[q] + dl * m[l])) * scale;
        const real row = (b + (dq * m[4 + q] + dl * m[4 + l])) * scale;
        left = SMALLER(left, column);
        right = LARGER(right, column);
        top = SMALLER(top, row);
        bottom = LARGER(bottom, row);
    }
    // All four are monotonic along z: the ends bound what lies between.
    const float leftmost = SMALLER(FIRST(left), LAST(left)) - SLACK;
    const float rightmost = LARGER(FIRST(right), LAST(right)) + SLACK;
    const int first = (int)ceil(clamp(leftmost, 0.0f, (float)columns));
    const int last = (int)clamp(rightmost, -1.0f, columns - 1.0f);
    if (SMALLER(FIRST(top), LAST(top)) > rows || LARGER(FIRST(bottom), LAST(bottom)) < -1.0f)
        return 0.0f;
    top = ceil(clamp(top - SLACK, (real)(0.0f), (real)(rows)));
    const int tries = (int)(highest_lane(SMALLER(bottom, (real)(rows)) - top) + SLACK) + 1;
    real sum = 0.0f;
    for (int c = first; c <= last; ++c) {
        real row = top;
        for (int i = 0; i < tries; ++i) {
            const real d[3] = {
                ALONG(real, m, 0, c, row), ALONG(real, m, 1, c, row), ALONG(real, m, 2, c, row)};
            const real t = (voxel[p] - m[12 + p]) / d[p];
            const real across = m[12 + q] - voxel[q] + t * d[q];
            const real along = m[12 + l] - voxel[l] + t * d[l];
            const real share = hat(across) * hat(along) * elements(image + c * pitch, rows, row);
            sum += WHERE(sampled_across(p, d), share);
            row += 1.0f;
        }
    }
    return sum;
}

// Global size (blocks, nx, ny), rounded up at will.
kernel void adjoint_voxels(
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
    const int accumulate) // 1: add to the volume
{
    volume += volume_offset;
    projections += projections_offset + PAD;
    views += views_offset;
    const int z = get_global_id(0) * BLOCK;
    const int x = get_global_id(1);
    const int y = get_global_id(2);
    if (z >= nz || x >= nx || y >= ny)
        return;
    const int voxels = min(BLOCK, nz - z);
    float sum[BLOCK];
    for (int k = 0; k < BLOCK; ++k)
        sum[k] = 0.0f;
    for (int view = 0; view < count; ++view) {
        global const float *m = views + view * VIEW_FLOATS;
        global const float *image = projections + (size_t)view * (columns + 1) * pitch;
        // How far the voxels are from the source along each axis; along z, at most and at least.
        const float low = z - m[14];
        const float high = z + voxels - 1 - m[14];
        const float far_x = fabs(x - m[12]);
        const float far_y = fabs(y - m[13]);
        const float far_z = LARGER(fabs(low), fabs(high));
        const float near_z = LARGER(low, -high);
        // A ray that shares in a voxel passes its plane within one voxel.
        const float slack = 1.0f + SLACK;
        const int across_x = far_x + slack >= LARGER(far_y, near_z);
        const int across_y = far_y + slack >= LARGER(far_x, near_z);
        const int across_z = far_z + slack >= LARGER(far_x, far_y);
        for (int k = 0; k < voxels; k += LANES) {
            const real voxel[3] = {(real)(x), (real)(y), (float)(z + k) + RAMP};
            real value = 0.0f;
            if (across_x)
                value += gather(m, image, voxel, 0, columns, rows, pitch);
            if (across_y)
                value += gather(m, image, voxel, 1, columns, rows, pitch);
            if (across_z)
                value += gather(m, image, voxel, 2, columns, rows, pitch);
            store_lanes(load_lanes(sum + k) + value, sum + k);
        }
    }
    put(volume + ((size_t)y * nx + x) * nz + z, sum, voxels, accumulate);
}

#if LANES == 8
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
    steps step = steps_from(fma(slope, (float)start, row), slope);
    if (reach <= 1.0f) { // two rows share in a voxel
        for (int k = start; k < stop; k += LANES) {
            const int8 at = step_lanes(step);
            const int8 n = whole_part(at);
            const float8 f = fraction(at) * decline;
            const float16 w = load_window(line + step_base(step));
            const float8 value = LARGER(1.0f - f, 0.0f) * take(w, n) +
                                 LARGER(1.0f - decline + f, 0.0f) * take(w, n + 1);
            store_lanes(load_lanes(sums[0] + k) + weights[0] * value, sums[0] + k);
            store_lanes(load_lanes(sums[1] + k) + weights[1] * value, sums[1] + k);
            step.lowest += step.advance;
        }
    } else { // four do
        for (int k = start; k < stop; k += LANES) {
            const int8 at = step_lanes(step);
            const int8 n = whole_part(at);
            const float8 above = 1.0f - fraction(at) * decline;
            const float8 under = 2.0f - decline - above;
            const float16 v = load_window(line + step_base(step) - 1);
            const float16 w = load_window(line + step_base(step) + 1);
            const float8 value = LARGER(above - decline, 0.0f) * take(v, n) +
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
                (z - bottom) / rise,
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
#endif
