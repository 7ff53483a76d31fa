// Voxel-driven back-projection of filtered projections (FDK type):
// volume(i, j, k) = sum over views of p(column, row) / g^2, p interpolated bilinearly where the
// voxel projects into [0, columns - 1] x [0, rows - 1], 0 elsewhere.
//
// The forms for GPUs; CPUs run backproject_columns.cl and backproject_tilted.cl. A work-item sums
// VOXELS voxels along z, neighbouring ones are neighbours along x. Where v is parallel to z, a
// block's voxels share g and the column. A block that projects into the detector as a whole takes
// a way without tests. Every voxel has to be in front of every source (g > 0). Blocks that begin at
// multiples of VOXELS of the whole volume's planes give each voxel the same bits in any slab: those
// at the slab's ends may reach beyond it.
//
// Global size (nx, ny, ceil((top - bottom) / VOXELS)), rounded up at will.

#ifndef VOXELS
#define VOXELS 16
#endif
#include "voxels.clh"

#ifndef INSIDE
#define INSIDE 0 // 1 leaves the way with tests out, to count instructions
#endif

// bilinear interpolation, where columns and rows may be 1
always_inlined float on_detector(
    global const float *image,
    const int columns,
    const int rows,
    const float column,
    const float row)
{
    if (!(column >= 0.0f && column <= columns - 1.0f && row >= 0.0f && row <= rows - 1.0f))
        return 0.0f;
    const int c = max(min((int)column, columns - 2), 0);
    const int r = max(min((int)row, rows - 2), 0);
    const int next = columns > 1;
    const int below = rows > 1 ? columns : 0;
    const float f = row - r;
    const float h = column - c;
    image += r * columns + c;
    const float low = fma(h, image[next] - image[0], image[0]);
    const float high = fma(h, image[below + next] - image[below], image[below]);
    return fma(f, high - low, low);
}

// v is parallel to z.
kernel required_group void backproject_axial(
    global float *restrict volume, // (ny, nx, nz)
    const ulong volume_offset,
    global const float *restrict projections, // (count, rows, columns)
    const ulong projections_offset,
    global const float *restrict views, // (count, VIEW_FLOATS)
    const ulong views_offset, // a multiple of 4
    const int nx, // voxels
    const int ny,
    const int nz,
    const int columns, // pixels
    const int rows,
    const int count, // views
    const int bottom, // first voxel along z to treat; may be negative
    const int top, // behind the last voxel to treat
    const int accumulate) // 1: add to the volume
{
    volume += volume_offset;
    projections += projections_offset;
    views += views_offset;
    const int x = get_global_id(0), y = get_global_id(1);
    const int z = bottom + get_global_id(2) * VOXELS;
    if (x >= nx || y >= ny || z >= top)
        return;
    const float fx = x, fy = y;
    const float last_column = columns - 1.0f, last_row = rows - 1.0f;
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
        const float slope = pb.z * scale;
        const float row0 = fma(pb.x, fx, fma(pb.y, fy, fma(pb.z, fz, pb.w))) * scale;
        const float row9 = fma(slope, (float)(VOXELS - 1), row0);
        const float first = SMALLER(row0, row9), last = LARGER(row0, row9);
        if (!(column >= 0.0f && column <= last_column && last >= 0.0f && first <= last_row))
            continue;
        global const float *image = projections + (size_t)view * (rows * COLUMNS);
        if (INSIDE || (COLUMNS > 1 && first >= 0.0f && last < last_row)) {
            const int c = min((int)column, COLUMNS - 2);
            const float s2 = scale * scale, right = (column - (float)c) * s2, left = s2 - right;
            const uint base = UNIT * ((uint)c - BIAS * (uint)COLUMNS);
#pragma unroll
            for (int k = 0; k < VOXELS; ++k) {
                const float row = fma(slope, (float)k, row0);
                const float t = (row - 0.5f) + MAGIC;
                const float f = row - (t - MAGIC);
                const uint at = WHOLE(t) * (UNIT * COLUMNS) + base;
                const float low = left * PIXEL(image, at, 0) + right * PIXEL(image, at, 1);
                const float high = left * PIXEL(image, at, COLUMNS) +
                                   right * PIXEL(image, at, COLUMNS + 1);
                sum[k] = fma(f, high, fma(1.0f - f, low, sum[k]));
            }
        } else {
            const float s2 = scale * scale;
#pragma unroll
            for (int k = 0; k < VOXELS; ++k)
                sum[k] = fma(
                    s2, on_detector(image, COLUMNS, rows, column, fma(slope, (float)k, row0)),
                    sum[k]);
        }
    }
    put(volume + ((size_t)y * nx + x) * nz + z, sum, -z, top - z, accumulate);
}

// Any pose of the detector.
kernel required_group void backproject_voxels(
    global float *restrict volume, // (ny, nx, nz)
    const ulong volume_offset,
    global const float *restrict projections, // (count, rows, columns)
    const ulong projections_offset,
    global const float *restrict views, // (count, VIEW_FLOATS)
    const ulong views_offset, // a multiple of 4
    const int nx, // voxels
    const int ny,
    const int nz,
    const int columns, // pixels
    const int rows,
    const int count, // views
    const int bottom, // first voxel along z to treat; may be negative
    const int top, // behind the last voxel to treat
    const int accumulate) // 1: add to the volume
{
    volume += volume_offset;
    projections += projections_offset;
    views += views_offset;
    const int x = get_global_id(0), y = get_global_id(1);
    const int z = bottom + get_global_id(2) * VOXELS;
    if (x >= nx || y >= ny || z >= top)
        return;
    const float fx = x, fy = y;
    const float last_column = columns - 1.0f, last_row = rows - 1.0f;
    float sum[VOXELS];
#pragma unroll
    for (int k = 0; k < VOXELS; ++k)
        sum[k] = 0.0f;
    for (int view = 0; view < count; ++view) {
        global const float4 *m = (global const float4 *)(views + view * VIEW_FLOATS);
        const float4 pa = m[0], pb = m[1], pg = m[2];
        const float fz = z + m[6].x;
        const float a = fma(pa.x, fx, fma(pa.y, fy, fma(pa.z, fz, pa.w)));
        const float b = fma(pb.x, fx, fma(pb.y, fy, fma(pb.z, fz, pb.w)));
        const float g = fma(pg.x, fx, fma(pg.y, fy, fma(pg.z, fz, pg.w)));
        // The block projects to a straight line: if both ends are inside so is all of it.
        const float s0 = reciprocal(g), s9 = reciprocal(fma(pg.z, (float)(VOXELS - 1), g));
        const float c0 = a * s0, c9 = fma(pa.z, (float)(VOXELS - 1), a) * s9;
        const float r0 = b * s0, r9 = fma(pb.z, (float)(VOXELS - 1), b) * s9;
        const float left = SMALLER(c0, c9), right = LARGER(c0, c9);
        const float first = SMALLER(r0, r9), last = LARGER(r0, r9);
        if (!(right >= 0.0f && left <= last_column && last >= 0.0f && first <= last_row))
            continue;
        global const float *image = projections + (size_t)view * (rows * COLUMNS);
        // away from the borders by more than rounding
        const int inside = left >= 0.001f && right < last_column - 0.001f && first >= 0.001f &&
                           last < last_row - 0.001f;
        if (INSIDE || inside) {
            const uint base = 0u - UNIT * BIAS * (uint)(COLUMNS + 1);
#pragma unroll
            for (int k = 0; k < VOXELS; ++k) {
                const float scale = reciprocal(fma(pg.z, (float)k, g));
                const float column = fma(pa.z, (float)k, a) * scale;
                const float row = fma(pb.z, (float)k, b) * scale;
                const float tr = (row - 0.5f) + MAGIC, tc = (column - 0.5f) + MAGIC;
                const float f = row - (tr - MAGIC), h = column - (tc - MAGIC);
                const uint at = WHOLE(tr) * (UNIT * COLUMNS) + (UNIT * WHOLE(tc) + base);
                const float p = PIXEL(image, at, 0), q = PIXEL(image, at, COLUMNS);
                const float low = fma(h, PIXEL(image, at, 1) - p, p);
                const float high = fma(h, PIXEL(image, at, COLUMNS + 1) - q, q);
                sum[k] = fma(scale * scale, fma(f, high - low, low), sum[k]);
            }
        } else {
            // One voxel after the other: all at once would take twice the registers.
#pragma unroll 1
            for (int k = 0; k < VOXELS; ++k) {
                const float scale = reciprocal(fma(pg.z, (float)k, g));
                const float column = fma(pa.z, (float)k, a) * scale;
                const float row = fma(pb.z, (float)k, b) * scale;
                const float value =
                    scale * scale * on_detector(image, COLUMNS, rows, column, row);
#pragma unroll
                for (int n = 0; n < VOXELS; ++n)
                    sum[n] += n == k ? value : 0.0f;
            }
        }
    }
    put(volume + ((size_t)y * nx + x) * nz + z, sum, -z, top - z, accumulate);
}
