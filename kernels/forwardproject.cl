// Line integrals through a volume by Joseph's method (IEEE Trans. Med. Imaging 1, 192 (1982)): a
// ray is sampled once a plane across the axis along which it advances fastest, bilinearly within
// the plane; the sum is multiplied by the length of ray between two planes. Outside the volume is
// zero, towards which the interpolation runs over one voxel.
//
// A work-item traces one ray. It sums over the planes from_plane to to_plane - 1 and adds to what
// projections hold if from_plane > 0. Every voxel, and the one beyond, has to be in front of every
// source. CPUs run forwardproject_columns.cl and forwardproject_tilted.cl instead.

#include "rays.clh"

// Global size (rows, columns, count), rounded up at will.
kernel void forward_rays(
    global float *restrict projections, // (count, columns + 1, pitch), padded
    const ulong projections_offset,
    global const float *restrict volume, // (ny, nx, nz)
    const ulong volume_offset,
    global const float *restrict views, // (count, VIEW_FLOATS)
    const ulong views_offset,
    const int nx, // voxels
    const int ny,
    const int nz,
    const int columns, // pixels
    const int rows,
    const int pitch, // elements of a padded line
    const int count, // views
    const int from_plane, // planes across x, y or z; from_plane > 0: add to the projections
    const int to_plane,
    const float voxel_size) // [mm]
{
    projections += projections_offset + PAD;
    const int r = get_global_id(0);
    const int c = get_global_id(1);
    const int view = get_global_id(2);
    if (r >= rows || c >= columns || view >= count)
        return;
    const scene s = {
        volume + volume_offset,
        nx,
        ny,
        nz,
        views + views_offset + view * VIEW_FLOATS,
        from_plane,
        to_plane};
    const int axis = main_axis(s.view, c, r, 0);
    const sums integral = voxel_size * stretch(s, c, r, axis) * trace(s, c, r, axis);
    global float *target = projections + ((size_t)view * (columns + 1) + c) * pitch + r;
    *target = from_plane > 0 ? *target + INTEGRAL(integral) : INTEGRAL(integral);
#ifdef MOMENT
    target += (size_t)count * (columns + 1) * pitch;
    *target = from_plane > 0 ? *target + integral.s1 : integral.s1;
#endif
}
