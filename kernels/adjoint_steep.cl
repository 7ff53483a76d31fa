// The adjoint of forwardproject_tilted.cl on CPUs, what adjoint_columns.cl and adjoint_tilted.cl
// leave: the weights of the rays, and those rays that are sampled across z, as a gather.
//
// A voxel sums, over the rays to which it contributes in forward projection, share times
// projection. For a ray that passes the voxel's plane at (x, y) the share is
// hat(x - x of the voxel) hat(y - y of the voxel), hat(x) = max(0, 1 - |x|), times the length of
// ray between two planes, by which weigh_lines multiplies the projections in advance. Every voxel,
// and the one beyond, has to be in front of every source.

#include "pieces.clh"

// Rounding must not leave out a ray that shares in a voxel; one ray too many has no weight.
#define SLACK 1e-2f

// Global size (ceil(rows / LANES), columns, count), rounded up at will.
kernel void weigh_lines(
    global float *restrict projections, // (count, columns + 1, pitch), padded
    const ulong projections_offset,
    global const float *restrict views, // (count, VIEW_FLOATS)
    const ulong views_offset,
    const int columns, // pixels
    const int rows,
    const int pitch, // elements of a padded line
    const int count, // views
    const int cubed, // 1: divide by the square of the advance, as adjoint_tilted has it
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
    const real advance = LARGER(beside, z);
    // lanes behind the last row multiply zeros
    global float *at =
        projections + projections_offset + ((size_t)view * (columns + 1) + c) * pitch + PAD + r;
    const real share = voxel_size * sqrt(x * x + y * y + z * z) / advance;
    const real divisor = cubed ? (z > beside ? (real)(1.0f) : advance * advance) : (real)(1.0f);
    store_global(load_global(at) * (share / divisor), at);
}

// What the rays of a view that are sampled across z give a voxel.
static inline float gather(
    global const float *m, // the view
    global const float *image, // (columns + 1, pitch), padded
    const float voxel[3],
    const int columns,
    const int rows,
    const int pitch)
{
    const int q = 0, l = 1, p = 2;
    const float a = AT(m, voxel[0], voxel[1], voxel[2]);
    const float b = AT(m + 4, voxel[0], voxel[1], voxel[2]);
    const float g = AT(m + 8, voxel[0], voxel[1], voxel[2]);
    // the projection of the square in which rays share in the voxel
    float left = INFINITY, right = -INFINITY, top = INFINITY, bottom = -INFINITY;
    for (int corner = 0; corner < 4; ++corner) {
        const float dq = corner & 1 ? 1.0f : -1.0f;
        const float dl = corner & 2 ? 1.0f : -1.0f;
        const float scale = 1.0f / (g + (dq * m[8 + q] + dl * m[8 + l]));
        const float column = (a + (dq * m[q] + dl * m[l])) * scale;
        const float row = (b + (dq * m[4 + q] + dl * m[4 + l])) * scale;
        left = SMALLER(left, column);
        right = LARGER(right, column);
        top = SMALLER(top, row);
        bottom = LARGER(bottom, row);
    }
    const int first = (int)ceil(clamp(left - SLACK, 0.0f, (float)columns));
    const int last = (int)clamp(right + SLACK, -1.0f, columns - 1.0f);
    const int highest = (int)ceil(clamp(top - SLACK, 0.0f, (float)rows));
    const int lowest = (int)clamp(bottom + SLACK, -1.0f, rows - 1.0f);
    float sum = 0.0f;
    for (int c = first; c <= last; ++c)
        for (int r = highest; r <= lowest; ++r) {
            if (main_axis(m, c, r, 0) != p)
                continue;
            const float t = (voxel[p] - m[12 + p]) / ALONG(float, m, p, c, r);
            const float across = m[12 + q] - voxel[q] + t * ALONG(float, m, q, c, r);
            const float along = m[12 + l] - voxel[l] + t * ALONG(float, m, l, c, r);
            sum += hat(across) * hat(along) * image[c * pitch + r];
        }
    return sum;
}

// Global size (nz, nx, ny), rounded up at will.
kernel void adjoint_steep(
    global float *restrict volume, // (ny, nx, nz), added to
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
    const int count) // views
{
    volume += volume_offset;
    projections += projections_offset + PAD;
    views += views_offset;
    const int z = get_global_id(0);
    const int x = get_global_id(1);
    const int y = get_global_id(2);
    if (z >= nz || x >= nx || y >= ny)
        return;
    float sum = 0.0f;
    for (int view = 0; view < count; ++view) {
        global const float *m = views + view * VIEW_FLOATS;
        global const float *image = projections + (size_t)view * (columns + 1) * pitch;
        const float voxel[3] = {x, y, z + LIFT(m)};
        const float far_x = fabs(x - m[12]);
        const float far_y = fabs(y - m[13]);
        const float far_z = fabs(voxel[2] - m[14]);
        // A ray that shares in a voxel passes its plane within one voxel.
        const float slack = 1.0f + SLACK;
        if (far_z + slack >= LARGER(far_x, far_y))
            sum += gather(m, image, voxel, columns, rows, pitch);
    }
    volume[((size_t)y * nx + x) * nz + z] += sum;
}
