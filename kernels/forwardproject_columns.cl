// forwardproject.cl for CPUs and views whose v is parallel to z: the rays of a detector column
// share their place across the column's plane, and their heights there are linear in the row. So
// two adjacent voxel columns are blended once and the blend is resampled.
//
// A work-item makes BLOCK rows of one column. It sums over the planes from_plane to to_plane - 1
// and adds to what projections hold if from_plane > 0, so that the host can take the volume in
// parts that stay in the cache for all views. Every voxel, and the one beyond, has to be in front
// of every source.

#include "blocks.clh"

// Global size (blocks, columns, count), rounded up at will.
kernel void forward_columns(
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
    const int from_plane, // planes across x or y; from_plane > 0: add to the projections
    const int to_plane,
    const float voxel_size) // [mm]
{
    projections += projections_offset + PAD;
    volume += volume_offset;
    views += views_offset;
    const int r = get_global_id(0) * BLOCK;
    const int c = get_global_id(1);
    const int view = get_global_id(2);
    if (r >= rows || c >= columns || view >= count)
        return;
    const int pixels = min(BLOCK, rows - r);
    global const float *m = views + view * VIEW_FLOATS;
    const int axis = main_axis(m, c, 0.0f, 1);
    const int across = axis ? nx : ny;
    const size_t plane_stride = axis ? (size_t)nx * nz : nz;
    const size_t across_stride = axis ? nz : (size_t)nx * nz;
    const float start_p = m[12 + axis];
    const float start_q = m[13 - axis];
    const float start_z = m[14];
    const int lift = LIFT(m);
    const float advance = ALONG(float, m, axis, c, 0.0f);
    const float drift = ALONG(float, m, 1 - axis, c, 0.0f);
    const float rise = ALONG(float, m, 2, c, (float)r);
    const float rise_per_row = m[23];
    const float inverse = 1.0f / advance;
    const float slope_q = drift * inverse;

    // planes where the column is within one voxel of the volume, one more against rounding
    const int end_plane = min(to_plane, axis ? ny : nx) - 1;
    float enter = from_plane - start_p;
    float leave = end_plane - start_p;
    keep_inside(start_q, slope_q, across, &enter, &leave);
    const int seen = enter <= leave;
    if (!seen && from_plane > 0)
        return;
    const int first_plane = seen ? max((int)(enter + start_p), from_plane) : 0;
    const int last_plane = seen ? min((int)(leave + start_p) + 1, end_plane) : -1;

    float sum[BLOCK];
    for (int k = 0; k < BLOCK; ++k)
        sum[k] = 0.0f;
#ifdef MOMENT
    float moment[BLOCK];
    for (int k = 0; k < BLOCK; ++k)
        moment[k] = 0.0f;
#endif
    for (int plane = first_plane; plane <= last_plane; ++plane) {
        const float q = fma(plane - start_p, slope_q, start_q);
        if (!(q > -1.0f && q < across))
            continue;
        const float t = (plane - start_p) * inverse;
        const float z = fma(t, rise, start_z);
        const float slope = t * rise_per_row;
        // the rows at the volume's ends
        const float per_voxel = 1.0f / slope;
        const float one = (lift - 1 - z) * per_voxel;
        const float other = (lift + nz - z) * per_voxel;
        const float first = SMALLER(one, other);
        const float last = LARGER(one, other);
        if (last < 0.0f || first >= pixels)
            continue;
        const int start = (int)LARGER(first, 0.0f) / LANES * LANES;
        const int stop = (int)SMALLER(last, pixels - 1.0f) + 1;

        const int low = below(q);
        const float next_weight = low + 1 < across ? q - low : 0.0f;
        const float line_weight = low < 0 ? 0.0f : 1.0f - (q - low);
        global const float *line = volume + plane * plane_stride + max(low, 0) * across_stride;
        global const float *next =
            volume + plane * plane_stride + min(low + 1, across - 1) * across_stride;
        if (fabs(slope) * (LANES - 1) > SPAN || nz < PIECE) {
            for (int k = start; k < stop; ++k) {
                const float h = fma(slope, (float)k, z);
                const float value =
                    line_weight * tap(line, nz, lift, h) + next_weight * tap(next, nz, lift, h);
                sum[k] += value;
#ifdef MOMENT
                moment[k] += value / t;
#endif
            }
            continue;
        }
        steps step = steps_from(z, slope, start);
        for (int k = start; k < stop; k += LANES) {
            const int base = step_base(step) - lift;
            const whole at = step_lanes(step);
            real value;
            if ((uint)base <= (uint)(nz - PIECE)) {
                const piece both = blend(line_weight, line + base, next_weight, next + base);
                value = between(both, whole_part(at), fraction(at));
            } else {
                const int within = clamp(base, 0, nz - PIECE);
                const piece both = blend(line_weight, line + within, next_weight, next + within);
                value = between_zeros(both, whole_part(at) + (base - within), fraction(at));
            }
            store_lanes(load_lanes(sum + k) + value, sum + k);
#ifdef MOMENT
            store_lanes(load_lanes(moment + k) + value / t, moment + k);
#endif
            step.lowest += step.advance;
        }
    }
    const float scale = voxel_size * fabs(inverse);
    const float level = advance * advance + drift * drift;
    global float *target = projections + ((size_t)view * (columns + 1) + c) * pitch + r;
    for (int k = 0; k < pixels; ++k) {
        const float climb = fma((float)k, rise_per_row, rise);
        const float integral = sum[k] * scale * sqrt(level + climb * climb);
        target[k] = from_plane > 0 ? target[k] + integral : integral;
#ifdef MOMENT
        global float *other = target + (size_t)count * (columns + 1) * pitch;
        const float over_depth = moment[k] * scale * sqrt(level + climb * climb);
        other[k] = from_plane > 0 ? other[k] + over_depth : over_depth;
#endif
    }
}
