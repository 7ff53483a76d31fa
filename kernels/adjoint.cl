// The exact adjoint of forwardproject.cl as a gather, without atomics and always in one order: a
// voxel sums, over the rays to which it contributes in forward projection, share times projection.
//
// For a ray that is sampled across axis p and passes the voxel's plane at (q, l), the share is
// hat(q - q of the voxel) hat(l - l of the voxel), hat(x) = max(0, 1 - |x|), times the length of
// ray between two planes, by which weigh_rays multiplies the projections in advance.
//
// The forms for GPUs; CPUs run adjoint_columns.cl, or adjoint_tilted.cl and adjoint_steep.cl.
// Neighbouring work-items are neighbours along x and sum VOXELS voxels along z. Where v is parallel
// to z, a column of rays meets the voxels' plane at one q, and at rows evenly spaced along z: where
// a ray weighs, and how much, is one multiply-add a row; adjoint_leaning.cl does alike where v
// leans. Else the rays within the bounding box of a voxel's support are tried one by one. Every
// voxel, and the one beyond, has to be in front of every source.
//
// Global size (nx, ny, ceil(nz / VOXELS)), rounded up at will.

#include "adjoint.clh"

// Global size (columns, rows, count), rounded up at will.
kernel required_group void weigh_rays(
    global float *restrict weighed, // (count, rows, columns)
    const ulong weighed_offset,
    global const float *restrict projections, // (count, rows, columns)
    const ulong projections_offset,
    global const float *restrict views, // (count, VIEW_FLOATS)
    const ulong views_offset,
    const int columns, // pixels
    const int rows,
    const int count, // views
    const float voxel_size) // [mm]
{
    const int c = get_global_id(0), r = get_global_id(1), view = get_global_id(2);
    if (c >= columns || r >= rows || view >= count)
        return;
    global const float *m = views + views_offset + view * VIEW_FLOATS;
    const float x = fabs(ALONG(float, m, 0, c, r)), y = fabs(ALONG(float, m, 1, c, r));
    const float z = fabs(ALONG(float, m, 2, c, r)), beside = LARGER(x, y);
    const float share = voxel_size * sqrt(x * x + y * y + z * z) / LARGER(beside, z);
    const size_t at = ((size_t)view * rows + r) * columns + c;
    weighed[weighed_offset + at] = projections[projections_offset + at] * share;
}

// What the rays that are sampled across axis p, x or y, give VOXELS voxels from (x, y, k = z) on.
always_inlined void add_columns(
    const pencil s,
    global const float *m, // the view
    const int p,
    const float x,
    const float y,
    const float z,
    float *sum)
{
    const int q = 1 - p, columns = s.columns, rows = s.rows;
    const float at_p = p ? y : x, at_q = p ? x : y;
    const float a = fma(m[0], x, fma(m[1], y, m[3])), g = fma(m[8], x, fma(m[9], y, m[11]));
    const float one = (a - m[q]) * reciprocal(g - m[8 + q]);
    const float two = (a + m[q]) * reciprocal(g + m[8 + q]);
    const int left = max((int)ceil(SMALLER(one, two) - SLACK), 0);
    const int right = min((int)floor(LARGER(one, two) + SLACK), columns - 1);
#pragma unroll 1
    for (int c = left; c <= right; ++c) {
        const float dx = ALONG(float, m, 0, c, 0), dy = ALONG(float, m, 1, c, 0);
        const float t = (at_p - m[12 + p]) * reciprocal(p ? dy : dx);
        const float w = 1.0f - fabs(fma(t, p ? dx : dy, m[12 + q] - at_q));
        if ((fabs(dx) >= fabs(dy)) == p || !(w > 0.0f))
            continue;
        // the rows' distance at the voxels' plane, the rows at the first and the last voxel
        const float h = t * m[23], step = reciprocal(h), size = fabs(h), reach = fabs(step);
        const float row0 = (z - fma(t, fma((float)c, m[20], m[17]), m[14])) * step;
        const float row9 = fma(step, (float)(VOXELS - 1), row0);
        const float top = SMALLER(row0, row9), bottom = LARGER(row0, row9);
        if (bottom + reach <= 0.0f || top - reach >= rows - 1.0f)
            continue;
        if (INSIDE || (top >= 1.0f && bottom < rows - 3.0f && size >= 0.5f)) {
            const uint base = UNIT * ((uint)c - BIAS * (uint)COLUMNS);
            const float w1 = 1.0f - size, w2 = w1 - size;
#define ADD(weight, n) share = fma(SATURATE(weight), PIXEL(s.image, at, n), share);
#define TAPS(MORE)                                                                                 \
    _Pragma("unroll") for (int k = 0; k < VOXELS; ++k)                                             \
    {                                                                                              \
        const float row = fma(step, (float)k, row0), whole = (row - 0.5f) + MAGIC;                 \
        const float f = row - (whole - MAGIC);                                                     \
        const uint at = WHOLE(whole) * (UNIT * COLUMNS) + base;                                    \
        float share = SATURATE(fma(-size, f, 1.0f)) * PIXEL(s.image, at, 0);                       \
        ADD(fma(size, f, w1), COLUMNS)                                                             \
        MORE                                                                                       \
        sum[k] = fma(w, share, sum[k]);                                                            \
    }
            if (INSIDE == 2 || (INSIDE != 4 && size >= 1.0f)) {
                TAPS()
            } else {
                TAPS(ADD(fma(-size, f, w1), -COLUMNS) ADD(fma(size, f, w2), 2 * COLUMNS))
            }
#undef TAPS
#undef ADD
        } else {
#pragma unroll 1
            for (int k = 0; k < VOXELS; ++k) {
                const float row = fma(step, (float)k, row0);
                const int from = (int)ceil(clamp(row - reach, 0.0f, (float)rows));
                const int to = (int)clamp(row + reach, -1.0f, rows - 1.0f);
                float share = 0.0f;
#pragma unroll 1
                for (int r = from; r <= to; ++r)
                    share = fma(
                        SATURATE(1.0f - fabs(r - row) * size), s.image[r * columns + c], share);
                share *= w;
#pragma unroll
                for (int n = 0; n < VOXELS; ++n)
                    sum[n] += n == k ? share : 0.0f;
            }
        }
    }
}

// v is parallel to z, and no ray advances fastest along z.
kernel required_group void adjoint_axial(
    global float *restrict volume, // (ny, nx, nz)
    const ulong volume_offset,
    global const float *restrict projections, // (count, rows, columns), weighed
    const ulong projections_offset,
    global const float *restrict views, // (count, VIEW_FLOATS)
    const ulong views_offset,
    const int nx, // voxels
    const int ny,
    const int nz,
    const int columns, // pixels
    const int rows,
    const int count, // views
    const int accumulate) // 1: add to the volume
{
    volume += volume_offset;
    projections += projections_offset;
    views += views_offset;
    const int x = get_global_id(0), y = get_global_id(1), z = get_global_id(2) * VOXELS;
    if (x >= nx || y >= ny || z >= nz)
        return;
    float sum[VOXELS];
#pragma unroll
    for (int k = 0; k < VOXELS; ++k)
        sum[k] = 0.0f;
    for (int view = 0; view < count; ++view) {
        global const float *m = views + view * VIEW_FLOATS;
        const pencil s = {projections + (size_t)view * (rows * COLUMNS), columns, rows};
        // A ray that shares in a voxel passes its plane within one voxel.
        const float far_x = fabs(x - m[12]), far_y = fabs(y - m[13]);
        if (far_x + (1.0f + SLACK) >= far_y)
            add_columns(s, m, 0, x, y, z + LIFT(m), sum);
        if (far_y + (1.0f + SLACK) >= far_x)
            add_columns(s, m, 1, x, y, z + LIFT(m), sum);
    }
    put(volume + ((size_t)y * nx + x) * nz + z, sum, 0, nz - z, accumulate);
}

// What the rays that are sampled across axis p give one voxel, which projects to (column, row).
always_inlined float gather(
    const pencil s,
    const float *m, // the view
    const int p,
    const float *voxel,
    const float g,
    const float column,
    const float row)
{
    const int q = p == 0 ? 1 : 0, l = p == 2 ? 1 : 2, columns = s.columns;
    const float reach_c = support(m, 0, q, l, g, column), reach_r = support(m, 4, q, l, g, row);
    const int left = (int)ceil(clamp(column - reach_c, 0.0f, (float)columns));
    const int right = (int)clamp(column + reach_c, -1.0f, columns - 1.0f);
    const int first = (int)ceil(clamp(row - reach_r, 0.0f, (float)s.rows));
    const int last = (int)clamp(row + reach_r, -1.0f, s.rows - 1.0f);
    const float away_p = voxel[p] - m[12 + p];
    const float away_q = m[12 + q] - voxel[q], away_l = m[12 + l] - voxel[l];
    float sum = 0.0f;
#pragma unroll 1
    for (int c = left; c <= right; ++c) {
        int at = first * COLUMNS + c;
#pragma unroll 1
        for (int r = first; r <= last; ++r, at += COLUMNS) {
            const float dp = ALONG(float, m, p, c, r);
            const float dq = ALONG(float, m, q, c, r), dl = ALONG(float, m, l, c, r);
            // as main_axis() chooses: of equal components x before y before z
            const float size = fabs(dp);
            const int mine = (p == 1 ? size > fabs(dq) : size >= fabs(dq)) &&
                             (p == 2 ? size > fabs(dl) : size >= fabs(dl));
            const float t = away_p * reciprocal(dp);
            const float share = SATURATE(1.0f - fabs(fma(t, dq, away_q))) *
                                SATURATE(1.0f - fabs(fma(t, dl, away_l)));
            sum += mine ? share * s.image[at] : 0.0f;
        }
    }
    return sum;
}

// Any pose of the detector.
kernel required_group void adjoint_voxels(
    global float *restrict volume, // (ny, nx, nz)
    const ulong volume_offset,
    global const float *restrict projections, // (count, rows, columns), weighed
    const ulong projections_offset,
    global const float *restrict views, // (count, VIEW_FLOATS)
    const ulong views_offset,
    const int nx, // voxels
    const int ny,
    const int nz,
    const int columns, // pixels
    const int rows,
    const int count, // views
    const int accumulate) // 1: add to the volume
{
    volume += volume_offset;
    projections += projections_offset;
    views += views_offset;
    const int x = get_global_id(0), y = get_global_id(1), z = get_global_id(2);
    if (x >= nx || y >= ny || z >= nz)
        return;
    float sum = 0.0f;
    for (int view = 0; view < count; ++view) {
        LOAD_VIEW(m, views + view * VIEW_FLOATS);
        const pencil s = {projections + (size_t)view * (rows * COLUMNS), columns, rows};
        const float voxel[3] = {x, y, z + LIFT(m)};
        const float g = AT(m + 8, x, y, voxel[2]), scale = reciprocal(g);
        const float column = AT(m, x, y, voxel[2]) * scale;
        const float row = AT(m + 4, x, y, voxel[2]) * scale;
        // A ray that shares in a voxel passes its plane within one voxel.
        const float slack = 1.0f + SLACK;
        const float far_x = fabs(x - m[12]), far_y = fabs(y - m[13]), far_z = fabs(voxel[2] - m[14]);
        if (far_x + slack >= LARGER(far_y, far_z - slack))
            sum += gather(s, m, 0, voxel, g, column, row);
        if (far_y + slack >= LARGER(far_x, far_z - slack))
            sum += gather(s, m, 1, voxel, g, column, row);
        if (far_z + slack >= LARGER(far_x, far_y))
            sum += gather(s, m, 2, voxel, g, column, row);
    }
    volume += ((size_t)y * nx + x) * nz + z;
    *volume = accumulate ? *volume + sum : sum;
}
