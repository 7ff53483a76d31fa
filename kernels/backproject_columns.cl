// backproject.cl for CPUs and views whose v is parallel to z: the voxels of a column share g and
// the detector column, and row is linear in z. So two adjacent detector columns are blended once
// and the blend is resampled.
//
// A work-item sums BLOCK voxels along z over the given views, in vectors that begin at multiples of
// LANES of the whole volume's planes; so each voxel gets the same bits in any slab. Every voxel has
// to be in front of every source (g > 0).

#include "blocks.clh"

// Lines along x that are treated for all y before going on: so what they see of the projections
// stays in the cache. Half or twice as many change nothing; all of 448 halve the speed for 16
// views.
#ifndef STRIP
#define STRIP 32
#endif

// Blocks begin as many voxels before the slab as its plane 0 is after a multiple of LANES. Global size
// (blocks, STRIP, ny ceil(nx / STRIP)), rounded up at will.
kernel void backproject_columns(
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
    const int z = get_global_id(0) * BLOCK - ((int)LIFT(views) & (LANES - 1));
    const int x = get_global_id(1) + get_global_id(2) / ny * STRIP;
    const int y = get_global_id(2) % ny;
    if (z >= nz || get_global_id(1) >= STRIP || x >= nx)
        return;
    const int begin = max(-z, 0), end = min(BLOCK, nz - z);
    global float *target = volume + ((size_t)y * nx + x) * nz + (z + begin);
    const float last_column = columns - 1;
    const float last_row = rows - 1;

    float sum[BLOCK];
    for (int k = 0; k < BLOCK; ++k)
        sum[k] = 0.0f;
    fetch(sum + begin, target, end - begin, accumulate);
    for (int view = 0; view < count; ++view) {
        global const float *m = views + view * VIEW_FLOATS;
        const float g = fma(m[8], (float)x, fma(m[9], (float)y, m[11]));
        const float scale = 1.0f / g;
        const float column = fma(m[0], (float)x, fma(m[1], (float)y, m[3])) * scale;
        if (!(column >= 0.0f && column <= last_column))
            continue;
        const int origin = z + (int)LIFT(m);
        const float row = fma(m[4], (float)x, fma(m[5], (float)y, m[7])) * scale; // at k = 0
        const float slope = m[6] * scale;
        // the voxels at the detector's first and last row
        const float per_row = 1.0f / slope;
        const float one = -row * per_row;
        const float other = (last_row - row) * per_row;
        const int first = below(LARGER(SMALLER(one, other), origin - 1.0f)) - origin;
        const int last = below(SMALLER(LARGER(one, other), (float)(origin + BLOCK))) - origin;
        const int from = first & -LANES; // where the vector begins
        const int start = max(from, 0);
        const int stop = min(last + 1, end);
        if (start >= stop)
            continue;

        const int c = (int)column;
        global const float *line = projections + ((size_t)view * (columns + 1) + c) * pitch;
        global const float *next = line + pitch;
        const float next_weight = (column - c) * scale * scale;
        const float line_weight = scale * scale - next_weight;
        if (fabs(slope) * (LANES - 1) > SPAN) {
            for (int k = start; k < stop; ++k) {
                const float r = fma(slope, (float)(origin + k), row);
                if (r >= 0.0f && r <= last_row)
                    sum[k] += line_weight * tap(line, rows, 0, r) + next_weight * tap(next, rows, 0, r);
            }
            continue;
        }
        steps step = steps_from(row, slope, origin + start);
        for (int k = start; k < stop; k += LANES) {
            const int base = step_base(step);
            const whole at = step_lanes(step);
            const piece both = blend(line_weight, line + base, next_weight, next + base);
            real value = between(both, whole_part(at), fraction(at));
            if (k <= from || k + LANES > last) { // only here may lanes be off the detector
                const real r = slope * ((float)(origin + k) + RAMP) + row;
                value = WHERE((r >= 0.0f) & (r <= last_row), value);
            }
            store_lanes(load_lanes(sum + k) + value, sum + k);
            step.lowest += step.advance;
        }
    }
    put(target, sum + begin, end - begin, 0);
}
