// Voxel-driven back-projection of filtered projections (FDK type):
// volume(i, j, k) = sum over views of p(column, row) / g^2, p interpolated bilinearly where the
// voxel projects into [0, columns - 1] x [0, rows - 1], 0 elsewhere.
//
// A work-item sums one voxel over the given views. Every voxel has to be in front of every source
// (g > 0). CPUs run backproject_columns.cl and backproject_tilted.cl instead.

#include "detector.clh"

// Global size (nz, nx, ny), rounded up at will.
kernel void backproject_voxels(
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
    const int z = get_global_id(0);
    const int x = get_global_id(1);
    const int y = get_global_id(2);
    if (z >= nz || x >= nx || y >= ny)
        return;
    float sum = 0.0f;
    for (int view = 0; view < count; ++view) {
        global const float *m = views + view * VIEW_FLOATS;
        global const float *image = projections + (size_t)view * (columns + 1) * pitch;
        const float scale = 1.0f / AT(m + 8, x, y, z);
        const float column = AT(m, x, y, z) * scale;
        const float row = AT(m + 4, x, y, z) * scale;
        sum += on_detector(image, columns, rows, pitch, column, row) * scale * scale;
    }
    volume += ((size_t)y * nx + x) * nz + z;
    *volume = accumulate ? *volume + sum : sum;
}
