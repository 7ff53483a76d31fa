// The correction of a prolongated volume by what its radiographs lack, and planes of volumes moved
// between slabs of different extent.
//
// residual: one work-item a pixel, global size (columns, rows, views). The others: one a voxel,
// global size (planes, columns of voxels). Ranges may be rounded up.

// Measured minus simulated radiograph; 0 at masked pixels, and where the simulated one, moved by
// c + m (q - c) + t to be compared, had to be read beyond its border.
#include "group.clh"

kernel required_group void residual(
    global float *residual, // (views, rows, columns), line integrals; may be `simulated`
    const ulong residual_offset,
    global const float *restrict measured, // (views, rows, columns), line integrals
    const ulong measured_offset,
    global const float *simulated, // (views, rows, columns), line integrals
    const ulong simulated_offset,
    global const float *restrict used, // (rows, columns), 1 or 0
    const ulong used_offset,
    global const float *restrict motion, // (views, 3): t along columns and rows, pixels, and m
    const ulong motion_offset,
    const int rows,
    const int columns,
    const int views)
{
    const int i = get_global_id(0), j = get_global_id(1), view = get_global_id(2);
    if (i >= columns || j >= rows || view >= views)
        return;
    global const float *moved = motion + motion_offset + 3 * view;
    const float ci = 0.5f * (columns - 1), cj = 0.5f * (rows - 1);
    const float u = ci + moved[2] * (i - ci) + moved[0], v = cj + moved[2] * (j - cj) + moved[1];
    // Half a pixel beyond the centre of the outermost ones is still theirs.
    const int on = u > -0.5f && u < columns - 0.5f && v > -0.5f && v < rows - 0.5f;
    const size_t at = ((size_t)view * rows + j) * columns + i;
    const float lack = measured[measured_offset + at] - simulated[simulated_offset + at];
    residual[residual_offset + at] = on ? lack * used[used_offset + j * columns + i] : 0.0f;
}

// volume <- max(0, volume + step update)
kernel required_group void correct(
    global float *restrict volume, // (columns, planes), 1/mm
    const ulong volume_offset,
    global const float *restrict update, // (columns, planes), 1/mm
    const ulong update_offset,
    const float step,
    const int planes,
    const int columns)
{
    const int k = get_global_id(0), j = get_global_id(1);
    if (k >= planes || j >= columns)
        return;
    const size_t at = (size_t)j * planes + k;
    const float moved = volume[volume_offset + at] + step * update[update_offset + at];
    volume[volume_offset + at] = max(0.0f, moved);
}

// Some planes of one volume to another.
kernel required_group void copy_planes(
    global float *restrict target, // (columns, target_planes)
    const ulong target_offset,
    global const float *restrict source, // (columns, source_planes)
    const ulong source_offset,
    const int target_planes,
    const int target_first,
    const int source_planes,
    const int source_first,
    const int planes, // to copy
    const int columns)
{
    const int k = get_global_id(0), j = get_global_id(1);
    if (k >= planes || j >= columns)
        return;
    target[target_offset + (size_t)j * target_planes + target_first + k] =
        source[source_offset + (size_t)j * source_planes + source_first + k];
}
