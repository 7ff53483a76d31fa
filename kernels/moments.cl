// The integral of a volume along each ray, and that of the volume over the depth g, by the method of
// forwardproject.cl: both are sums of the same samples. CPUs run forwardproject_columns.cl and
// forwardproject_tilted.cl with MOMENT instead.
//
// A work-item traces one ray. Every voxel, and the one beyond, has to be in front of every source.

#define MOMENT

#include "group.clh"
#include "rays.clh"

// Global size (rows, columns, count), rounded up at will.
kernel required_group void moment_rays(
    global float *restrict projections, // (count, rows, columns)
    const ulong projections_offset,
    global float *restrict over_depth, // (count, rows, columns)
    const ulong over_depth_offset,
    global const float *restrict volume, // (ny, nx, nz)
    const ulong volume_offset,
    global const float *restrict views, // (count, VIEW_FLOATS)
    const ulong views_offset,
    const int nx, // voxels
    const int ny,
    const int nz,
    const int columns, // pixels
    const int rows,
    const int count, // views
    const float voxel_size, // [mm]
    const int accumulate) // 1: add to both
{
    const int r = get_global_id(0), c = get_global_id(1), view = get_global_id(2);
    if (r >= rows || c >= columns || view >= count)
        return;
    global const float *m = views + views_offset + view * VIEW_FLOATS;
    const int longest = max(nx, max(ny, nz));
    const scene s = {volume + volume_offset, nx, ny, nz, m, 0, longest};
    const int axis = main_axis(m, c, r, 0);
    const sums integral = voxel_size * stretch(s, c, r, axis) * trace(s, c, r, axis);
    const size_t at = ((size_t)view * rows + r) * columns + c;
    global float *plain = projections + projections_offset + at;
    global float *divided = over_depth + over_depth_offset + at;
    *plain = accumulate ? *plain + integral.s0 : integral.s0;
    *divided = accumulate ? *divided + integral.s1 : integral.s1;
}
