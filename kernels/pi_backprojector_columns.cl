// pi_backprojector.cl for CPUs: the same sums over views, with the window and the parts of helices of
// pi_interval.clh.
//
// v is parallel to z: the voxels of a column share g and the detector column, and row is linear in
// z. A work-item sums BLOCK voxels along z over the given views. Global sizes are
// (blocks, strip, ny ceil(nx / strip)), rounded up at will.

#include "blocks.clh"
#include "pi_interval.clh"

// 0 to 1: how far inside the window, whose borders are softened by a half width of 1 / (2
// per_width)
static inline real inside(const real row, const float low, const float high, const float per_width)
{
    const real from_low = clamp((row - low) * per_width + 0.5f, (real)(0.0f), (real)(1.0f));
    return from_low * clamp((high - row) * per_width + 0.5f, (real)(0.0f), (real)(1.0f));
}

kernel void pi_columns(
    global float *restrict volume, // (ny, nx, nz), added to
    const ulong volume_offset,
    global const float *restrict projections, // (count, columns + 1, pitch), padded
    const ulong projections_offset,
    global const float *restrict views, // (count, VIEW_FLOATS)
    const ulong views_offset,
    global const float *restrict window, // (columns + 1, 2) lower and upper border [row]
    const ulong window_offset,
    global const float *restrict spans, // (helices, ny, nx, 2) [plane of the whole volume]
    const ulong spans_offset,
    const int nx, // voxels
    const int ny,
    const int nz,
    const int columns, // pixels
    const int rows,
    const int pitch, // elements of a padded line
    const int count, // views
    const int helices,
    const int helix, // that the views are of
    const int first_plane, // of the whole volume, with which this one begins
    const int bottom, // first voxel along z to treat; may be negative
    const int top, // behind the last voxel to treat
    const int strip, // columns of voxels along x that are treated for all y before others are
    const float z_step) // of the source from view to view, positive [voxel]
{
    volume += volume_offset;
    projections += projections_offset + PAD;
    views += views_offset;
    window += window_offset;
    spans += spans_offset;
    const int z = bottom + get_global_id(0) * BLOCK;
    const int x = get_global_id(1) + get_global_id(2) / ny * strip;
    const int y = get_global_id(2) % ny;
    if (z >= top || (int)get_global_id(1) >= strip || x >= nx)
        return;
    const int voxels = min(BLOCK, top - z);
    const size_t column_of_voxels = (size_t)y * nx + x;
    const size_t of_helix = (size_t)2 * nx * ny;
    global const float *own = spans + helix * of_helix + 2 * column_of_voxels;
    const int plane = first_plane + z;
    if (own[1] <= plane || own[0] >= plane + voxels - 1)
        return;

    float sum[BLOCK];
    for (int k = 0; k < BLOCK; ++k)
        sum[k] = 0.0f;
    for (int view = 0; view < count; ++view) {
        global const float *m = views + view * VIEW_FLOATS;
        const float g = fma(m[8], (float)x, fma(m[9], (float)y, m[11]));
        const float scale = 1.0f / g;
        const float column = fma(m[0], (float)x, fma(m[1], (float)y, m[3])) * scale;
        if (!(column >= 0.0f && column <= columns - 1.0f))
            continue;
        const int origin = z + (int)LIFT(m);
        const float row = fma(m[4], (float)x, fma(m[5], (float)y, m[7])) * scale; // at k = 0
        const float slope = m[6] * scale;
        const int c = (int)column;
        const float f = column - c;
        global const float *border = window + 2 * c;
        const float low = fma(f, border[2] - border[0], border[0]);
        const float high = fma(f, border[3] - border[1], border[1]);
        const float half_width = 0.5f + 0.5f * fabs(slope) * z_step;
        const float per_width = 0.5f / half_width;
        const float per_row = 1.0f / slope;
        // the voxels at the window's borders, and by how many voxels these are softened
        const float one = (low - row) * per_row;
        const float other = (high - row) * per_row;
        const float lowest = SMALLER(one, other);
        const float highest = LARGER(one, other);
        const float soft = half_width * fabs(per_row);
        const int first = below(LARGER(lowest - soft, origin - 1.0f)) - origin;
        const int last = below(SMALLER(highest + soft, (float)(origin + BLOCK))) - origin;
        const int start = max(first & -LANES, 0);
        const int stop = min(last + 1, voxels);
        if (start >= stop)
            continue;

        global const float *line = projections + ((size_t)view * (columns + 1) + c) * pitch;
        global const float *next = line + pitch;
        const float next_weight = f * scale;
        const float line_weight = scale - next_weight;
        if (fabs(slope) * (LANES - 1) <= SPAN) {
            steps step = steps_from(row, slope, origin + start);
            for (int k = start; k < stop; k += LANES) {
                const int base = step_base(step);
                const whole at = step_lanes(step);
                const piece both = blend(line_weight, line + base, next_weight, next + base);
                real value = between(both, whole_part(at), fraction(at));
                const float height = origin + k;
                if (height < lowest + soft || height + (LANES - 1) > highest - soft)
                    value *= inside(slope * (height + RAMP) + row, low, high, per_width);
                store_lanes(load_lanes(sum + k) + value, sum + k);
                step.lowest += step.advance;
            }
            continue;
        }
        for (int k = start; k < stop; ++k) {
            const float r = fma(slope, (float)(origin + k), row);
            const float chi = FIRST(inside((real)(r), low, high, per_width));
            sum[k] += chi * (line_weight * tap(line, rows, 0, r) + next_weight * tap(next, rows, 0, r));
        }
    }

    volume += column_of_voxels * nz + z;
    spans += 2 * column_of_voxels;
    for (int k = max(-z, 0); k < voxels; ++k)
        volume[k] += sum[k] * share_of(spans, of_helix, helices, helix, (float)(plane + k));
}
