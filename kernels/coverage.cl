// Views that see a voxel, W, on a coarse grid; and a volume divided by it.
//
// W(x) = sum over views of the view's weight times that of the row that x falls on, linear between
// rows, 0 for a view on whose detector [0, columns - 1] x [0, rows - 1] the projection does not
// lie. Where rays have weights, W(x) is the part that such a sum is of the one without row weights
// and without top and bottom of the detector. It varies over many voxels, so that it is computed
// once for a block of them, in its middle, and interpolated linearly. The last block of an axis may
// be cut short by the grid's end: its middle is `last` in units of whole blocks, at most their
// number less 1.
//
// Global sizes, rounded up at will: of coverage one work-item a coarse voxel, (nz, nx, ny); of
// normalise one a voxel, along the volume's axes from last to first.

#include "group.clh"

kernel required_group void coverage(
    global float *restrict seen, // W, (ny, nx, nz) of the coarse grid
    const ulong seen_offset,
    global const float *restrict matrices, // (views, 12), from coarse (i, j, k, 1) to (a, b, g)
    const ulong matrices_offset,
    global const float *restrict view_weight, // (views)
    const ulong view_weight_offset,
    global const float *restrict row_weight, // (rows)
    const ulong row_weight_offset,
    global const float *restrict ray_weight, // (views, samples), evenly along the columns
    const ulong ray_weight_offset,
    const int nx, // coarse voxels
    const int ny,
    const int nz,
    const float last_x, // middles of the last coarse voxels
    const float last_y,
    const float last_z,
    const float first, // plane of the whole grid with which this one begins, in coarse voxels
    const int columns, // pixels; at least 2, as are rows
    const int rows,
    const int views,
    const int samples) // at least 2; 0 where rays have no weights
{
    seen += seen_offset;
    matrices += matrices_offset;
    view_weight += view_weight_offset;
    row_weight += row_weight_offset;
    ray_weight += ray_weight_offset;
    const int k = get_global_id(0), i = get_global_id(1), j = get_global_id(2);
    if (k >= nz || i >= nx || j >= ny)
        return;
    const float x = min((float)i, last_x), y = min((float)j, last_y), z = first + min((float)k, last_z);
    float sum = 0.0f, needed = 0.0f;
    for (int view = 0; view < views; ++view) {
        global const float *m = matrices + 12 * view;
        const float a = m[0] * x + m[1] * y + m[2] * z + m[3];
        const float b = m[4] * x + m[5] * y + m[6] * z + m[7];
        const float g = m[8] * x + m[9] * y + m[10] * z + m[11];
        const float column = a / g, row = b / g;
        // Written so that a NaN is not on the detector.
        const int beside = g > 0.0f && column >= 0.0f && column <= columns - 1.0f;
        const int on = beside && row >= 0.0f && row <= rows - 1.0f;
        const int r = on ? min((int)row, rows - 2) : 0;
        const float f = row - r;
        const float weight = row_weight[r] + f * (row_weight[r + 1] - row_weight[r]);
        float ray = view_weight[view];
        if (samples) {
            const float at = beside ? column * ((samples - 1) / (columns - 1.0f)) : 0.0f;
            const int c = min((int)at, samples - 2);
            global const float *t = ray_weight + (size_t)view * samples + c;
            ray *= t[0] + (at - c) * (t[1] - t[0]);
        }
        needed += beside ? ray : 0.0f;
        sum += on ? ray * weight : 0.0f;
    }
    const float part = needed > 0.0f ? sum / needed : 0.0f;
    seen[((size_t)j * nx + i) * nz + k] = samples ? part : sum;
}

// Where a voxel lies between the middles of coarse ones: index of the lower, and how far on; beyond
// the outermost middles the fraction goes beyond 0 and 1, which continues W along its slope.
static inline int between(
    const int index, const float inverse, const int coarse, const float last, float *fraction)
{
    const float at = (index + 0.5f) * inverse - 0.5f;
    const int low = clamp((int)at, 0, max(coarse - 2, 0));
    *fraction = coarse > 1 ? (at - low) / (min(low + 1.0f, last) - low) : 0.0f;
    return low;
}

kernel required_group void normalise(
    global float *restrict volume, // (ny, nx, nz), or (nz, ny, nx) if slices is set
    const ulong volume_offset,
    global const float *restrict seen, // W, (coarse_y, coarse_x, coarse_z)
    const ulong seen_offset,
    const int nx, // voxels
    const int ny,
    const int nz,
    const int first, // plane of the whole grid that is this volume's first
    const int coarse_x, // coarse voxels
    const int coarse_y,
    const int coarse_z,
    const float last_x, // middles of the last coarse voxels
    const float last_y,
    const float last_z,
    const float inverse_xy, // 1 / (voxels in a coarse one), along x and y
    const float inverse_z,
    const float axis_x, // index along x and y at which the rotation axis lies
    const float axis_y,
    const float radius, // of the field of view, voxels
    const float least, // a voxel with less W is set to 0
    const float scale,
    const float lowest, // smaller values are raised to it
    const int slices)
{
    volume += volume_offset;
    seen += seen_offset;
    const int fast = get_global_id(0), middle = get_global_id(1), slow = get_global_id(2);
    const int i = slices ? fast : middle, j = slices ? middle : slow, k = slices ? slow : fast;
    if (i >= nx || j >= ny || k >= nz)
        return;
    float fx, fy, fz;
    const int x = between(i, inverse_xy, coarse_x, last_x, &fx);
    const int y = between(j, inverse_xy, coarse_y, last_y, &fy);
    const int z = between(first + k, inverse_z, coarse_z, last_z, &fz);
    const size_t right = min(x + 1, coarse_x - 1) - x, up = min(z + 1, coarse_z - 1) - z;
    const size_t back = min(y + 1, coarse_y - 1) - y;
    global const float *w = seen + ((size_t)y * coarse_x + x) * coarse_z + z;
    float sum = 0.0f;
    for (int c = 0; c < 8; ++c) {
        const int cx = c & 1, cy = c >> 1 & 1, cz = c >> 2;
        sum += (cx ? fx : 1.0f - fx) * (cy ? fy : 1.0f - fy) * (cz ? fz : 1.0f - fz) *
               w[(cy * back * coarse_x + cx * right) * coarse_z + cz * up];
    }
    const float dx = i - axis_x, dy = j - axis_y;
    const size_t at = slices ? ((size_t)k * ny + j) * nx + i : ((size_t)j * nx + i) * nz + k;
    const int good = sum > least && dx * dx + dy * dy <= radius * radius;
    volume[at] = good ? max(volume[at] * scale / sum, lowest) : 0.0f;
}
