// The exact adjoint of forwardproject.cl as a gather, without atomics and always in one order: a
// voxel sums, over the rays to which it contributes in forward projection, share times projection.
//
// For a ray that is sampled across axis p and passes the voxel's plane at (q, l), the share is
// hat(q - q of the voxel) hat(l - l of the voxel), hat(x) = max(0, 1 - |x|), times the length of
// ray between two planes, by which weigh_rays multiplies the projections beforehand.
//
// adjoint_voxels treats any geometry: it tries the pixels of the bounding box of the shadow of the
// voxel's support. adjoint_columns, for CPUs (LANES 8), treats views whose v is parallel to z: the
// share in q belongs to a detector column, and the rows that share in a voxel are linear in z.
//
// A work-item sums BLOCK voxels along z over the given views. Global sizes are (blocks, nx, ny),
// rounded up at will. Every voxel, and one beyond, has to be in front of every source (g > 0).

#include "geometry.clh"

#ifndef BLOCK
#define BLOCK (LANES == 1 ? 1 : 32 * LANES) // whole LANES
#endif

// Rounding must not leave out a ray that shares in a voxel; one ray too many has no weight.
#define SLACK 1e-2f

static inline void put(
    global float *restrict target, const float *sum, const int count, const int accumulate)
{
    for (int k = 0; k < count; ++k)
        target[k] = accumulate ? target[k] + sum[k] : sum[k];
}

// Global size (rows, columns, count), rounded up at will.
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
    projections += projections_offset + PAD;
    views += views_offset;
    const int r = get_global_id(0);
    const int c = get_global_id(1);
    const int view = get_global_id(2);
    if (r >= rows || c >= columns || view >= count)
        return;
    global const float *m = views + view * VIEW_FLOATS;
    const float x = ALONG(float, m, 0, c, r);
    const float y = ALONG(float, m, 1, c, r);
    const float z = ALONG(float, m, 2, c, r);
    const int axis = main_axis(m, c, r, axial);
    const float advance = fabs(axis == 0 ? x : axis == 1 ? y : z);
    projections[((size_t)view * (columns + 1) + c) * pitch + r] *=
        voxel_size * sqrt(x * x + y * y + z * z) / advance;
}

// elements row of a line; `row` is whole, and where it is outside the line the result is undefined
static inline real rows_of(global const float *line, const int rows, const real row)
{
    const float lowest = fmin(FIRST(row), LAST(row));
    if (fmax(FIRST(row), LAST(row)) - lowest <= SPAN) {
        const int base = (int)clamp(lowest, 0.0f, rows - 1.0f);
        return take(load_window(line + base), to_whole(row) - base);
    }
    float at[LANES];
    store_lanes(row, at);
    for (int lane = 0; lane < LANES; ++lane)
        at[lane] = line[(int)clamp(at[lane], 0.0f, rows - 1.0f)];
    return load_lanes(at);
}

// What the rays of one view that are sampled across axis p give LANES voxels (x, y, z) of a column.
static inline real gather(
    global const float *m, // the view
    global const float *image, // (columns, pitch)
    const real voxel[3],
    const int p,
    const int columns,
    const int rows,
    const int pitch)
{
    const int q = p == 0 ? 1 : 0;
    const int l = p == 2 ? 1 : 2;
    // The rays pass the voxel's plane within one voxel of it, and p is their main axis.
    const real reach = fabs(voxel[p] - m[12 + p]) + 1.0f + SLACK;
    if (!ANY((fabs(voxel[q] - m[12 + q]) < reach) & (fabs(voxel[l] - m[12 + l]) < reach)))
        return 0.0f;
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
        left = fmin(left, column);
        right = fmax(right, column);
        top = fmin(top, row);
        bottom = fmax(bottom, row);
    }
    // Along a line of voxels all four are monotonic: its ends bound what lies between.
    const float leftmost = fmin(FIRST(left), LAST(left)) - SLACK;
    const float rightmost = fmax(FIRST(right), LAST(right)) + SLACK;
    const int first = (int)ceil(clamp(leftmost, 0.0f, (float)columns));
    const int last = (int)clamp(rightmost, -1.0f, columns - 1.0f);
    top = ceil(fmax(top - SLACK, 0.0f));
    bottom = fmin(bottom + SLACK, rows - 1.0f);
    real sum = 0.0f;
    for (int c = first; c <= last; ++c) {
        global const float *line = image + c * pitch;
        for (real row = top; ANY(row <= bottom); row += 1.0f) {
            const real x = fabs(ALONG(real, m, 0, c, row));
            const real y = fabs(ALONG(real, m, 1, c, row));
            const real z = fabs(ALONG(real, m, 2, c, row));
            // main_axis() == p
            const whole sampled = p == 0 ? (x >= y) & (x >= z) : p == 1 ? (x < y) & (y >= z) : (x < z) & (y < z);
            const real t = (voxel[p] - m[12 + p]) / ALONG(real, m, p, c, row);
            const real across = m[12 + q] - voxel[q] + t * ALONG(real, m, q, c, row);
            const real along = m[12 + l] - voxel[l] + t * ALONG(real, m, l, c, row);
            const real share = hat(across) * hat(along) * rows_of(line, rows, row);
            sum += WHERE(sampled & (row <= bottom), share);
        }
    }
    return sum;
}

kernel void adjoint_voxels(
    global float *restrict volume, // (ny, nx, nz)
    const ulong volume_offset,
    global const float *restrict projections, // (count, columns + 1, pitch), padded, weighted
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
        for (int k = 0; k < voxels; k += LANES) {
            const real voxel[3] = {(real)(x), (real)(y), (float)(z + k) + RAMP};
            real value = gather(m, image, voxel, 0, columns, rows, pitch);
            value += gather(m, image, voxel, 1, columns, rows, pitch);
            value += gather(m, image, voxel, 2, columns, rows, pitch);
            store_lanes(load_lanes(sum + k) + value, sum + k);
        }
    }
    put(volume + ((size_t)y * nx + x) * nz + z, sum, voxels, accumulate);
}

#if LANES == 8
kernel void adjoint_columns(
    global float *restrict volume, // (ny, nx, nz)
    const ulong volume_offset,
    global const float *restrict projections, // (count, columns + 1, pitch), padded, weighted
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
        const float a = fma(m[0], (float)x, fma(m[1], (float)y, m[3]));
        const float g = fma(m[8], (float)x, fma(m[9], (float)y, m[11]));
        for (int axis = 0; axis < 2; ++axis) {
            const float p = axis ? y : x;
            const float q = axis ? x : y;
            // the rays that pass the plane within one voxel of this column
            const float right = (a + m[1 - axis]) / (g + m[9 - axis]);
            const float left = (a - m[1 - axis]) / (g - m[9 - axis]);
            const int first = (int)ceil(clamp(fmin(left, right) - SLACK, 0.0f, (float)columns));
            const int last = (int)clamp(fmax(left, right) + SLACK, -1.0f, columns - 1.0f);
            for (int c = first; c <= last; ++c) {
                if (main_axis(m, c, 0.0f, 1) != axis)
                    continue;
                const float t = (p - m[12 + axis]) / ALONG(float, m, axis, c, 0.0f);
                const float share = 1.0f - fabs(fma(t, ALONG(float, m, 1 - axis, c, 0.0f), m[13 - axis] - q));
                if (!(share > 0.0f))
                    continue;
                // Ray (c, r) passes the plane at height bottom + rise r. In rows, the voxels are
                // 1 / rise apart, and the rows within 1 / |rise| share in a voxel.
                const float rise = t * m[23];
                const float bottom = fma(t, ALONG(float, m, 2, c, 0.0f), m[14]);
                const float slope = 1.0f / rise;
                const float row = (z - bottom) * slope;
                const float reach = fabs(slope);
                const float start_row = (-reach - row) * rise;
                const float stop_row = (rows - 1.0f + reach - row) * rise;
                if (fmax(start_row, stop_row) < 0.0f || fmin(start_row, stop_row) >= voxels)
                    continue;
                const int start = (int)fmax(fmin(start_row, stop_row), 0.0f) / LANES * LANES;
                const int stop = (int)fmin(fmax(start_row, stop_row), voxels - 1.0f) + 1;
                global const float *line = projections + ((size_t)view * (columns + 1) + c) * pitch;
                if (reach * (LANES - 1) > SPAN) {
                    for (int k = start; k < stop; ++k) {
                        const float centre = fma(slope, (float)k, row);
                        const int from = (int)ceil(clamp(centre - reach, 0.0f, (float)rows));
                        const int to = (int)clamp(centre + reach, -1.0f, rows - 1.0f);
                        for (int r = from; r <= to; ++r)
                            sum[k] += share * fmax(1.0f - fabs((r - centre) * rise), 0.0f) * line[r];
                    }
                    continue;
                }
                const int pairs = (int)ceil(reach);
                const float lowest = fmin(0.0f, (LANES - 1) * slope);
                const real ramp = slope * RAMP;
                for (int k = start; k < stop; k += LANES) {
                    const float r = fma(slope, (float)k, row);
                    const int base = below(r + lowest);
                    const real at = (r - (float)base) + ramp;
                    const whole n = to_whole(at);
                    real offset = to_real(n) - at - (pairs - 1.0f);
                    real value = 0.0f;
                    for (int pair = 0; pair < pairs; ++pair) {
                        const window w = load_window(line + base - (pairs - 1) + 2 * pair);
                        value += hat(rise * offset) * take(w, n) + hat(rise * (offset + 1.0f)) * take(w, n + 1);
                        offset += 2.0f;
                    }
                    store_lanes(load_lanes(sum + k) + share * value, sum + k);
                }
            }
        }
    }
    put(volume + ((size_t)y * nx + x) * nz + z, sum, voxels, accumulate);
}
#endif
