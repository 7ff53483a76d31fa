// The adjoint of forwardproject.cl on GPUs, see adjoint.cl, of views in any pose whose rows follow
// each other roughly along z, within 45 degrees, where no ray advances fastest along z.
//
// A work-item sums VOXELS voxels along z. Of each detector column that may share in them it finds
// the row that passes a voxel's height in the voxel's plane, and takes the rays of two or three
// rows around; where rows are less than 2/3 of a voxel apart, along the borders and where rays are
// sampled across either axis, it tries the rays one by one.
//
// Global size (nx, ny, ceil(nz / VOXELS)), rounded up at will.

#include "adjoint.clh"

// What the rays that are sampled across axis p, x or y, give VOXELS voxels from (x, y, k = z) on.
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
    const float one = a * reciprocal(g), two = a9 * reciprocal(g9);
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
        // The row that passes voxel k's height in its plane: (start + k dp) / (turn - k m[21 + p]).
        const float start = -fma(away_z, dp, away_p * dz);
        const float row0 = start * reciprocal(turn);
        const float row9 = fma(last, dp, start) * reciprocal(fma(-last, m[21 + p], turn));
        const float top = SMALLER(row0, row9), bottom = LARGER(row0, row9);
        // the rows' distance at the voxels' plane; along the block it changes by parts of a percent
        const float inverse = reciprocal(fma(row0, m[21 + p], dp));
        const float size =
            fabs(away_p * (m[23] * dp - m[21 + p] * dz)) * inverse * inverse * 0.99f;
        const float reach = reciprocal(size);
        if (bottom + reach <= 0.0f || top - reach >= rows - 1.0f)
            continue;
        // Share of the ray along (p, q, z) in a voxel that is away_z below the source.
#define SHARE(p, q, z, away_z)                                                                     \
    (SATURATE(1.0f - fabs(fma(away_p * reciprocal(p), q, away_q))) *                               \
     SATURATE(1.0f - fabs(fma(away_p * reciprocal(p), z, away_z))))
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
                          reciprocal(fma((float)-k, m[21 + p], turn));                             \
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
                    fma((float)k, dp, start) * reciprocal(fma((float)-k, m[21 + p], turn));
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
        const pencil s = {projections + (size_t)view * (rows * COLUMNS), columns, rows};
        // A ray that shares in a voxel passes its plane within one voxel.
        const float far_x = fabs(x - m[12]), far_y = fabs(y - m[13]);
        const int x_too = far_x + (1.0f + SLACK) >= far_y, y_too = far_y + (1.0f + SLACK) >= far_x;
        if (x_too)
            add_leaning(s, m, 0, x, y, z + LIFT(m), y_too, sum);
        if (y_too)
            add_leaning(s, m, 1, x, y, z + LIFT(m), x_too, sum);
    }
    put(volume + ((size_t)y * nx + x) * nz + z, sum, 0, nz - z, accumulate);
}
