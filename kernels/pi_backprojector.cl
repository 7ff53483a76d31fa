// Back-projection over pi-intervals, for exact helical reconstruction:
// volume(i, j, k) = weight * sum over views of chi(row) p(column, row) / g, p interpolated
// bilinearly at the voxel's projection, to zero over one row outside the detector.
//
// chi and weight: see pi_interval.clh.
//
// The form for GPUs; CPUs run pi_backprojector_columns.cl. v is parallel to z: the voxels of a
// column share g and the detector column, and row is linear in z. A work-item sums VOXELS voxels
// along z, neighbouring ones are neighbours along x.
//
// Global size (nx, ny, ceil((top - bottom) / VOXELS)), rounded up at will.

#include "gpu.clh"
#include "pi_interval.clh"

#ifndef VOXELS
#define VOXELS 8
#endif
#ifndef INSIDE
#define INSIDE 0 // 1 leaves the way with tests out, to count instructions
#endif

kernel required_group void pi_backproject(
    global float *restrict volume, // (ny, nx, nz), added to
    const ulong volume_offset,
    global const float *restrict projections, // (count, rows, columns)
    const ulong projections_offset,
    global const float *restrict views, // (count, VIEW_FLOATS)
    const ulong views_offset, // a multiple of 4
    global const float *restrict window, // (columns + 1, 2) lower and upper border [row]
    const ulong window_offset,
    global const float *restrict spans, // (helices, ny, nx, 2) [plane of the whole volume]
    const ulong spans_offset,
    const int nx, // voxels
    const int ny,
    const int nz,
    const int columns, // pixels
    const int rows,
    const int count, // views
    const int helices,
    const int helix, // that the views are of
    const int first_plane, // of the whole volume, with which this one begins
    const int bottom, // first voxel along z to treat; may be negative
    const int top, // behind the last voxel to treat
    const float z_step) // of the source from view to view, positive [voxel]
{
    volume += volume_offset;
    projections += projections_offset;
    views += views_offset;
    window += window_offset;
    const int x = get_global_id(0), y = get_global_id(1);
    const int z = bottom + get_global_id(2) * VOXELS;
    if (x >= nx || y >= ny || z >= top)
        return;
    const size_t line = (size_t)y * nx + x, of_helix = (size_t)2 * nx * ny;
    spans += spans_offset + 2 * line;
    global const float *own = spans + helix * of_helix;
    const int voxels = min(VOXELS, top - z);
    const int plane = first_plane + z;
    if (own[1] <= plane || own[0] >= plane + voxels - 1)
        return;
    const float fx = x, fy = y, last_row = rows - 1.0f;
    float sum[VOXELS];
#pragma unroll
    for (int k = 0; k < VOXELS; ++k)
        sum[k] = 0.0f;
    for (int view = 0; view < count; ++view) {
        global const float4 *m = (global const float4 *)(views + view * VIEW_FLOATS);
        const float4 pa = m[0], pb = m[1], pg = m[2]; // pa.z == pg.z == 0
        const float fz = z + m[6].x;
        const float scale = reciprocal(fma(pg.x, fx, fma(pg.y, fy, pg.w)));
        const float column = fma(pa.x, fx, fma(pa.y, fy, pa.w)) * scale;
        if (!(column >= 0.0f && column <= columns - 1.0f))
            continue;
        const float slope = pb.z * scale;
        const float row0 = fma(pb.x, fx, fma(pb.y, fy, fma(pb.z, fz, pb.w))) * scale;
        const float row9 = fma(slope, (float)(VOXELS - 1), row0);
        const float first = SMALLER(row0, row9), last = LARGER(row0, row9);
        const int c = (int)column;
        const float h = column - c;
        global const float *border = window + 2 * c;
        const float low = fma(h, border[2] - border[0], border[0]);
        const float high = fma(h, border[3] - border[1], border[1]);
        // half the height over which the window's borders are softened
        const float half_width = fma(0.5f * z_step, fabs(slope), 0.5f);
        if (last <= low - half_width || first >= high + half_width)
            continue;
        const float per_width = 0.5f * reciprocal(half_width);
        global const float *image = projections + (size_t)view * (rows * COLUMNS);
        const float right = h * scale, left = scale - right;
        if (INSIDE || (c < columns - 1 && first >= 0.0f && last < last_row)) {
            const uint base = UNIT * ((uint)c - BIAS * (uint)COLUMNS);
#pragma unroll
            for (int k = 0; k < VOXELS; ++k) {
                const float row = fma(slope, (float)k, row0);
                const float t = (row - 0.5f) + MAGIC;
                const float f = row - (t - MAGIC);
                const uint at = WHOLE(t) * (UNIT * COLUMNS) + base;
                const float p = left * PIXEL(image, at, 0) + right * PIXEL(image, at, 1);
                const float q = left * PIXEL(image, at, COLUMNS) +
                                right * PIXEL(image, at, COLUMNS + 1);
                const float chi = SATURATE(fma(row - low, per_width, 0.5f)) *
                                  SATURATE(fma(high - row, per_width, 0.5f));
                sum[k] = fma(chi, fma(f, q - p, p), sum[k]);
            }
        } else {
            // One voxel after the other: all at once would take twice the registers.
            const int next = c < columns - 1;
#pragma unroll 1
            for (int k = 0; k < VOXELS; ++k) {
                const float row = fma(slope, (float)k, row0);
                const int r = below(clamp(row, -2.0f, rows + 1.0f));
                const float f = row - r;
                float value = 0.0f;
                if (r >= 0 && r < rows) {
                    global const float *at = image + (r * columns + c);
                    value = (1.0f - f) * (left * at[0] + right * at[next]);
                }
                if (r >= -1 && r + 1 < rows) {
                    global const float *at = image + ((r + 1) * columns + c);
                    value = fma(f, left * at[0] + right * at[next], value);
                }
                value *= SATURATE(fma(row - low, per_width, 0.5f)) *
                         SATURATE(fma(high - row, per_width, 0.5f));
#pragma unroll
                for (int n = 0; n < VOXELS; ++n)
                    sum[n] += n == k ? value : 0.0f;
            }
        }
    }
    volume += line * nz + z;
#pragma unroll
    for (int k = 0; k < VOXELS; ++k)
        if ((uint)(z + k) < (uint)(z + voxels))
            volume[k] += sum[k] * share_of(spans, of_helix, helices, helix, (float)(plane + k));
}
