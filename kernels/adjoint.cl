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
// a ray weighs, and how much, is one multiply-add a row. Else the rays within the bounding box of a
// voxel's support are tried one by one. Every voxel, and the one beyond, has to be in front of
// every source.
//
// Global size (nx, ny, ceil(nz / VOXELS)), rounded up at will.

#include "gpu.clh"

#ifndef VOXELS
#define VOXELS 8
#endif
#ifndef INSIDE
#define INSIDE 0 // 2, 3 or 4 leaves other ways out than that of so many rows, to count instructions
#endif

// Rounding must not leave out a ray that shares in a voxel; one ray too many has no weight.
#define SLACK 1e-2f

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

// writes a work-item's sums, of voxels `count` of which are in the volume
always_inlined void
put(global float *restrict target, const float *sum, const int count, const int accumulate)
{
#pragma unroll
    for (int k = 0; k < VOXELS; ++k)
        if (k < count)
            target[k] = accumulate ? target[k] + sum[k] : sum[k];
}

// A view's rays and image.
typedef struct {
    global const float *view;
    global const float *image; // (rows, columns), weighed
    int columns, rows;
} pencil;

// What the rays that are sampled across axis p, x or y, give VOXELS voxels from (x, y, z) on.
always_inlined void add_columns(
    const pencil s, const int p, const float x, const float y, const float z, float *sum)
{
    global const float *m = s.view;
    const int q = 1 - p, columns = s.columns, rows = s.rows;
    const float at_p = p ? y : x, at_q = p ? x : y;
    const float a = fma(m[0], x, fma(m[1], y, m[3])), g = fma(m[8], x, fma(m[9], y, m[11]));
    const float one = (a - m[q]) * native_recip(g - m[8 + q]);
    const float two = (a + m[q]) * native_recip(g + m[8 + q]);
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
#define TAPS(MORE)                                                                                 \
    _Pragma("unroll") for (int k = 0; k < VOXELS; ++k)                                             \
    {                                                                                              \
        const float row = fma(step, (float)k, row0), whole = (row - 0.5f) + MAGIC;                 \
        const float f = row - (whole - MAGIC);                                                     \
        const uint at = WHOLE(whole) * (UNIT * COLUMNS) + base;                                    \
        float share = SATURATE(fma(-size, f, 1.0f)) * PIXEL(s.image, at, 0);                       \
        share = fma(SATURATE(fma(size, f, w1)), PIXEL(s.image, at, COLUMNS), share);               \
        MORE                                                                                       \
        sum[k] = fma(w, share, sum[k]);                                                            \
    }
            if (INSIDE == 2 || (INSIDE != 4 && size >= 1.0f)) {
                TAPS()
            } else {
                TAPS(share = fma(SATURATE(fma(-size, f, w1)), PIXEL(s.image, at, -COLUMNS), share);
                     share = fma(SATURATE(fma(size, f, w2)), PIXEL(s.image, at, 2 * COLUMNS), share);)
            }
#undef TAPS
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
        const pencil s = {m, projections + (size_t)view * (rows * COLUMNS), columns, rows};
        // A ray that shares in a voxel passes its plane within one voxel.
        const float far_x = fabs(x - m[12]), far_y = fabs(y - m[13]);
        if (far_x + (1.0f + SLACK) >= far_y)
            add_columns(s, 0, x, y, z, sum);
        if (far_y + (1.0f + SLACK) >= far_x)
            add_columns(s, 1, x, y, z, sum);
    }
    put(volume + ((size_t)y * nx + x) * nz + z, sum, nz - z, accumulate);
}

// Loads a view.
#define LOAD_VIEW(m, from)                                                                         \
    float m[VIEW_FLOATS];                                                                          \
    _Pragma("unroll") for (int n = 0; n < VIEW_FLOATS; ++n) m[n] = (from)[n]

// How far, in columns, rays may lie from a voxel's projection at (column, g) and share in it: of
// (a, g) plus any (da, dg), column moves by (da - column dg) / (g + dg). q and l are the axes across
// p; `row` is 0 for columns and 4 for rows.
always_inlined float
support(const float *m, const int row, const int q, const int l, const float g, const float column)
{
    const float size = fabs(fma(-column, m[8 + q], m[row + q])) +
                       fabs(fma(-column, m[8 + l], m[row + l]));
    const float nearest = g - fabs(m[8 + q]) - fabs(m[8 + l]);
    return fma(size, native_recip(nearest) * (1.0f + 1e-5f), SLACK);
}

// As add_columns(), of a detector in any pose whose rows follow each other roughly along z.
always_inlined void add_leaning(
    const pencil s,
    const float *m, // the view
    const int p,
    const float x,
    const float y,
    const float z,
    const int mixed, // rays that pass here may be sampled across either axis
    float *sum)
{
    const int q = 1 - p, columns = s.columns, rows = s.rows;
    const float last = VOXELS - 1;
    const float a = AT(m, x, y, z), g = AT(m + 8, x, y, z);
    const float a9 = fma(last, m[2], a), g9 = fma(last, m[10], g);
    const float one = a * native_recip(g), two = a9 * native_recip(g9);
    const float reach_one = support(m, 0, q, 2, g, one), reach_two = support(m, 0, q, 2, g9, two);
    const float low = SMALLER(one - reach_one, two - reach_two);
    const float high = LARGER(one + reach_one, two + reach_two);
    const int left = (int)ceil(clamp(low, 0.0f, (float)columns));
    const int right = (int)clamp(high, -1.0f, columns - 1.0f);
    const float away_p = (p ? y : x) - m[12 + p];
    const float away_q = m[12 + q] - (p ? x : y), away_z = m[14] - z;
    const float turn = fma(m[23], away_p, m[21 + p] * away_z);
#pragma unroll 1
    for (int c = left; c <= right; ++c) {
        const float dp = fma((float)c, m[18 + p], m[15 + p]);
        const float dq = fma((float)c, m[18 + q], m[15 + q]);
        const float dz = fma((float)c, m[20], m[17]);
        // The row that passes voxel k's height in its plane is (start + k dp) / (turn - k m[21 + p]).
        const float start = -fma(away_z, dp, away_p * dz);
        const float row0 = start * native_recip(turn);
        const float row9 = fma(last, dp, start) * native_recip(fma(-last, m[21 + p], turn));
        const float top = SMALLER(row0, row9), bottom = LARGER(row0, row9);
        // the rows' distance at the voxels' plane; along the block it changes by parts of a percent
        const float inverse = native_recip(fma(row0, m[21 + p], dp));
        const float size =
            fabs(away_p * (m[23] * dp - m[21 + p] * dz)) * inverse * inverse * 0.99f;
        const float reach = native_recip(size);
        if (bottom + reach <= 0.0f || top - reach >= rows - 1.0f)
            continue;
        // Share of the ray along (p, q, z) in a voxel that is away_z below the source.
#define SHARE(p, q, z, away_z)                                                                     \
    (SATURATE(1.0f - fabs(fma(away_p * native_recip(p), q, away_q))) *                             \
     SATURATE(1.0f - fabs(fma(away_p * native_recip(p), z, away_z))))
        // Three rows around hold all that share where they are more than 2/3 of a voxel apart.
        if (INSIDE || (!mixed && top >= 2.0f && bottom < rows - 3.0f && size >= 2.0f / 3.0f)) {
            const uint base = UNIT * ((uint)c - BIAS * (uint)COLUMNS);
#define TAP(n)                                                                                     \
    {                                                                                              \
        const float ray_p = fma((float)(n), m[21 + p], at_p);                                      \
        const float ray_q = fma((float)(n), m[21 + q], at_q);                                      \
        const float ray_z = fma((float)(n), m[23], at_z);                                          \
        const float share = SHARE(ray_p, ray_q, ray_z, away_z - (float)k);                         \
        total = fma(share, PIXEL(s.image, at, (n) * COLUMNS), total);                              \
    }
#define TAPS(BEFORE, MORE)                                                                         \
    _Pragma("unroll") for (int k = 0; k < VOXELS; ++k)                                             \
    {                                                                                              \
        const float row = fma((float)k, dp, start) *                                               \
                          native_recip(fma((float)-k, m[21 + p], turn));                           \
        const float rounded = (row - BEFORE) + MAGIC, whole = rounded - MAGIC;                     \
        const uint at = WHOLE(rounded) * (UNIT * COLUMNS) + base;                                  \
        const float at_p = fma(whole, m[21 + p], dp), at_q = fma(whole, m[21 + q], dq);            \
        const float at_z = fma(whole, m[23], dz);                                                  \
        float total = sum[k];                                                                      \
        TAP(0)                                                                                     \
        TAP(1)                                                                                     \
        MORE                                                                                       \
        sum[k] = total;                                                                            \
    }
            if (INSIDE == 2 || (INSIDE != 3 && size >= 1.0f)) {
                TAPS(0.5f, )
            } else {
                TAPS(0.0f, TAP(-1))
            }
#undef TAPS
#undef TAP
        } else {
#pragma unroll 1
            for (int k = 0; k < VOXELS; ++k) {
                const float row =
                    fma((float)k, dp, start) * native_recip(fma((float)-k, m[21 + p], turn));
                const int from = (int)ceil(clamp(row - reach - SLACK, 0.0f, (float)rows));
                const int to = (int)clamp(row + reach + SLACK, -1.0f, rows - 1.0f);
                float total = 0.0f;
#pragma unroll 1
                for (int r = from; r <= to; ++r) {
                    const float ray_p = fma((float)r, m[21 + p], dp);
                    const float ray_q = fma((float)r, m[21 + q], dq);
                    const float ray_z = fma((float)r, m[23], dz);
                    // x before y, as main_axis() chooses
                    const int mine = p ? fabs(ray_p) > fabs(ray_q) : fabs(ray_p) >= fabs(ray_q);
                    const float share = SHARE(ray_p, ray_q, ray_z, away_z - (float)k);
                    total += mine ? share * s.image[r * columns + c] : 0.0f;
                }
#pragma unroll
                for (int n = 0; n < VOXELS; ++n)
                    sum[n] += n == k ? total : 0.0f;
            }
        }
#undef SHARE
    }
}

// Any pose of the detector whose rows follow each other roughly along z, within 45 degrees; no ray
// advances fastest along z.
kernel required_group void adjoint_leaning(
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
        LOAD_VIEW(m, views + view * VIEW_FLOATS);
        const pencil s = {views, projections + (size_t)view * (rows * COLUMNS), columns, rows};
        // A ray that shares in a voxel passes its plane within one voxel.
        const float far_x = fabs(x - m[12]), far_y = fabs(y - m[13]);
        const int x_too = far_x + (1.0f + SLACK) >= far_y, y_too = far_y + (1.0f + SLACK) >= far_x;
        if (x_too)
            add_leaning(s, m, 0, x, y, z, y_too, sum);
        if (y_too)
            add_leaning(s, m, 1, x, y, z, x_too, sum);
    }
    put(volume + ((size_t)y * nx + x) * nz + z, sum, nz - z, accumulate);
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
    const float voxel[3] = {x, y, z};
    float sum = 0.0f;
    for (int view = 0; view < count; ++view) {
        LOAD_VIEW(m, views + view * VIEW_FLOATS);
        const pencil s = {views, projections + (size_t)view * (rows * COLUMNS), columns, rows};
        const float g = AT(m + 8, x, y, z), scale = reciprocal(g);
        const float column = AT(m, x, y, z) * scale, row = AT(m + 4, x, y, z) * scale;
        // A ray that shares in a voxel passes its plane within one voxel.
        const float slack = 1.0f + SLACK;
        const float far_x = fabs(x - m[12]), far_y = fabs(y - m[13]), far_z = fabs(z - m[14]);
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
