// Voxel-driven back-projection of filtered projections (FDK type):
// volume(i, j, k) = sum over views of p(column, row) / g^2, p interpolated bilinearly where the
// voxel projects into [0, columns - 1] x [0, rows - 1], 0 elsewhere.
//
// backproject_voxels treats any geometry. backproject_columns, for CPUs (LANES 8), treats views
// whose v is parallel to z: the voxels of a column share g and the detector column, and row is
// linear in z. So two adjacent detector columns are blended once and the blend is resampled.
//
// A work-item sums BLOCK voxels along z over the given views. Global sizes are (blocks, nx, ny), of
// backproject_columns (blocks, STRIP, ny ceil(nx / STRIP)), rounded up at will. Every voxel has to
// be in front of every source (g > 0).

#include "geometry.clh"

#ifndef BLOCK
#define BLOCK (LANES == 1 ? 1 : 32 * LANES) // a multiple of LANES LANES
#endif

// How a run of LANES voxels lies in an image.
#define RUNS (BLOCK / LANES)
#define OFF 0
#define TWO 1 // between two columns
#define THREE 2 // among three
#define ODD 4 // neither, or too far along the rows
#define PARTLY 8 // some voxels off the panel

// Columns along x that backproject_columns treats for all y before it goes on: so what they see of
// the projections stays in the cache. Half or twice as many change nothing; all of 448 halve the
// speed for 16 views.
#ifndef STRIP
#define STRIP 32
#endif

static inline void put(
    global float *restrict target, const float *sum, const int count, const int accumulate)
{
    for (int k = 0; k < count; ++k)
        target[k] = accumulate ? target[k] + sum[k] : sum[k];
}

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
    const int z = get_global_id(0) * BLOCK;
    const int x = get_global_id(1);
    const int y = get_global_id(2);
    if (z >= nz || x >= nx || y >= ny)
        return;
    const int voxels = min(BLOCK, nz - z);
    const float last_column = columns - 1;
    const float last_row = rows - 1;

    float sum[BLOCK];
    for (int k = 0; k < BLOCK; ++k)
        sum[k] = 0.0f;
    for (int view = 0; view < count; ++view) {
        global const float *m = views + view * VIEW_FLOATS;
        global const float *image = projections + (size_t)view * (columns + 1) * pitch;
        const float a = fma(m[0], (float)x, fma(m[1], (float)y, m[3]));
        const float b = fma(m[4], (float)x, fma(m[5], (float)y, m[7]));
        const float g = fma(m[8], (float)x, fma(m[9], (float)y, m[11]));
        // Where in the image each run of LANES voxels lies, for LANES runs at a time: known ahead,
        // it keeps no load waiting for a division.
        int firsts[RUNS], bases[RUNS], kinds[RUNS];
        for (int run = 0; run * LANES < voxels; run += LANES) {
            const real begin = z + LANES * (run + RAMP);
            const real end = begin + (LANES - 1.0f);
            const real begin_scale = 1.0f / (m[10] * begin + g);
            const real end_scale = 1.0f / (m[10] * end + g);
            const real begin_column = (m[2] * begin + a) * begin_scale;
            const real end_column = (m[2] * end + a) * end_scale;
            const real begin_row = (m[6] * begin + b) * begin_scale;
            const real end_row = (m[6] * end + b) * end_scale;
            // Both are monotonic in z: the ends bound what lies between.
            const real left = SMALLER(begin_column, end_column);
            const real right = LARGER(begin_column, end_column);
            const real top = SMALLER(begin_row, end_row);
            const real bottom = LARGER(begin_row, end_row);
            const whole first = to_whole(LARGER(left, (real)(0.0f)));
            const whole last = to_whole(SMALLER(right, (real)(last_column))) + 1;
            const whole base = to_whole(LARGER(top, (real)(1.0f - PAD)) + PAD) - PAD;
            whole kind = last > first + 1 ? (whole)(THREE) : (whole)(TWO);
            kind = ((bottom - top > SPAN - 1.0f) | (last > first + 2)) ? (whole)(ODD) : kind;
            const whole within =
                (left >= 0.0f) & (right <= last_column) & (top >= 0.0f) & (bottom <= last_row);
            const whole touching =
                (right >= 0.0f) & (left <= last_column) & (bottom >= 0.0f) & (top <= last_row);
            kind = within ? kind : kind | PARTLY;
            kind = touching ? kind : (whole)(OFF);
            store_lanes(first, firsts + run);
            store_lanes(base, bases + run);
            store_lanes(kind, kinds + run);
        }
        for (int run = 0; run * LANES < voxels; ++run) {
            const int kind = kinds[run];
            if (kind == OFF)
                continue;
            const real height = (float)(z + run * LANES) + RAMP;
            const real scale = 1.0f / (m[10] * height + g);
            const real column = (m[2] * height + a) * scale;
            const real row = (m[6] * height + b) * scale;
            global const float *line = image + (size_t)firsts[run] * pitch;
            const real across = column - (float)firsts[run];
            real value = 0.0f;
            if (kind & ODD) {
                const int lines = (int)LARGER(FIRST(across), LAST(across)) + 2;
                for (int i = 0; i < min(lines, columns - firsts[run]); ++i)
                    value += hat(across - (float)i) * taps(line + i * pitch, rows, row);
            } else {
                value = among(
                    line + bases[run], pitch, across, row - (float)bases[run], kind & THREE);
            }
            value *= scale * scale;
            if (kind & PARTLY)
                value = WHERE(
                    (column >= 0.0f) & (column <= last_column) & (row >= 0.0f) & (row <= last_row),
                    value);
            float *target = sum + run * LANES;
            store_lanes(load_lanes(target) + value, target);
        }
    }
    put(volume + ((size_t)y * nx + x) * nz + z, sum, voxels, accumulate);
}

#if LANES == 8
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
    const int z = get_global_id(0) * BLOCK;
    const int x = get_global_id(1) + get_global_id(2) / ny * STRIP;
    const int y = get_global_id(2) % ny;
    if (z >= nz || get_global_id(1) >= STRIP || x >= nx)
        return;
    const int voxels = min(BLOCK, nz - z);
    const float last_column = columns - 1;
    const float last_row = rows - 1;

    float sum[BLOCK];
    for (int k = 0; k < BLOCK; ++k)
        sum[k] = 0.0f;
    for (int view = 0; view < count; ++view) {
        global const float *m = views + view * VIEW_FLOATS;
        const float g = fma(m[8], (float)x, fma(m[9], (float)y, m[11]));
        const float scale = 1.0f / g;
        const float column = fma(m[0], (float)x, fma(m[1], (float)y, m[3])) * scale;
        if (!(column >= 0.0f && column <= last_column))
            continue;
        const float row =
            fma(m[4], (float)x, fma(m[5], (float)y, fma(m[6], (float)z, m[7]))) * scale;
        const float slope = m[6] * scale;
        // the voxels at the panel's first and last row
        const float per_row = 1.0f / slope;
        const float one = -row * per_row;
        const float other = (last_row - row) * per_row;
        const float first = SMALLER(one, other);
        const float last = LARGER(one, other);
        if (last < 0.0f || first >= voxels)
            continue;
        const int start = (int)LARGER(first, 0.0f) / LANES * LANES;
        const int stop = (int)SMALLER(last, voxels - 1.0f) + 1;

        const int c = (int)column;
        global const float *line = projections + ((size_t)view * (columns + 1) + c) * pitch;
        global const float *next = line + pitch;
        const float next_weight = (column - c) * scale * scale;
        const float line_weight = scale * scale - next_weight;
        if (fabs(slope) * (LANES - 1) > SPAN) {
            for (int k = start; k < stop; ++k) {
                const float r = fma(slope, (float)k, row);
                if (r >= 0.0f && r <= last_row)
                    sum[k] += line_weight * tap(line, rows, r) + next_weight * tap(next, rows, r);
            }
            continue;
        }
        steps step = steps_from(fma(slope, (float)start, row), slope);
        for (int k = start; k < stop; k += LANES) {
            const int base = step_base(step);
            const int8 at = step_lanes(step);
            const float16 blend = line_weight * load_window(line + base) +
                                  next_weight * load_window(next + base);
            float8 value = between(blend, whole_part(at), fraction(at));
            if (k == start || k + LANES >= stop) { // only here may lanes be off the panel
                const float8 r = slope * ((float)k + RAMP) + row;
                value = WHERE((r >= 0.0f) & (r <= last_row), value);
            }
            store_lanes(load_lanes(sum + k) + value, sum + k);
            step.lowest += step.advance;
        }
    }
    put(volume + ((size_t)y * nx + x) * nz + z, sum, voxels, accumulate);
}
#endif
